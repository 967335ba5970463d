"""Round bodies and their meshes down an incline: deviation from rolling, and cost.

    python -m benchmarks.rolling
    python -m benchmarks.rolling --quick     # seconds: shows that it runs

A ball and a cylinder of radius 5 cm start half the barrier distance above an incline of .3 rad and
roll for `--seconds`; cylinders start on one of their sides. Columns: faces; speed over g sin(.3) t
/ (1 + I / (m r^2)), minus one, at each barrier distance (a body rolls on its radius and the gap,
which makes it faster by up to the gap over the radius); processor time of a step [ms], the median
over the barrier distances.
"""

from __future__ import annotations

import functools
import math
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import click
import torch
from torch import Tensor

import diffcloth_torch as dc
from diffcloth_torch.geometry.rotation import quaternion_exp, quaternion_multiply, rotate

RADIUS, LENGTH = 0.05, 0.2  # [m]
ANGLE, GRAVITY = 0.3, 9.81
DISTANCES = (1e-3, 2e-4)  # [m]


def rotation_about(axis: str, degrees: float) -> Tensor:
    """Unit quaternion of a rotation about a coordinate axis."""
    turn = torch.zeros(3, dtype=torch.float64)
    turn["xyz".index(axis)] = math.radians(degrees)
    return quaternion_exp(turn)


class Shape(NamedTuple):
    """A function that makes a body, and its moment of inertia about y at the start over m r^2."""

    make: Callable[..., dc.RigidBody]
    moment: float
    turn: Tensor = rotation_about("x", 0)


def ball(**how: object) -> Shape:
    return Shape(functools.partial(dc.RigidBody.sphere, RADIUS, **how), 2 / 5)


def cylinder(rings: int) -> Shape:
    # Vertices are at multiples of 360 / (6 rings) degrees from the body's x.
    down = 90 - 360 / (6 * rings) / 2
    turn = quaternion_multiply(rotation_about("x", 90), rotation_about("z", down))
    return Shape(functools.partial(dc.RigidBody.cylinder, RADIUS, LENGTH, rings=rings), 1 / 2, turn)


def capsule() -> Shape:
    moment = (LENGTH / 2 + 4 / 3 * RADIUS * 2 / 5) / (LENGTH + 4 / 3 * RADIUS)
    make = functools.partial(dc.RigidBody.capsule, RADIUS, LENGTH, smooth=True)
    return Shape(make, moment, rotation_about("x", 90))


SHAPES = {
    "ball, subdivisions=1": ball(subdivisions=1),
    "ball, subdivisions=2": ball(subdivisions=2),
    "ball, subdivisions=3": ball(subdivisions=3),
    "ball, subdivisions=4": ball(subdivisions=4),
    "ball, smooth": ball(smooth=True),
    "cylinder, rings=2": cylinder(2),
    "cylinder, rings=5": cylinder(5),
    "cylinder, rings=8": cylinder(8),
    "cylinder, rings=10": cylinder(10),
    "cylinder, rings=16": cylinder(16),
    "capsule, smooth": capsule(),
}


def roll(shape: Shape, distance: float, seconds: float, dt: float) -> tuple[int, float, float]:
    """Number of faces, speed over a round body's speed minus one, and seconds of a step."""
    slope = rotation_about("y", math.degrees(ANGLE))
    downhill, _, normal = rotate(slope, torch.eye(3, dtype=slope.dtype))
    at = normal * (RADIUS + distance / 2)
    plane = dc.RigidBody.plane(8.0, pose=[0, 0, 0, *slope], friction=0.6)
    pose = torch.cat([at, quaternion_multiply(slope, shape.turn)])
    body = shape.make(motion="dynamic", density=500.0, friction=0.6, pose=pose, name="round")
    contact = dc.ContactOptions(barrier_distance=distance)
    simulator = dc.Simulator(dc.Scene([], [plane, body]), dt, contact=contact)
    state = simulator.initial_state()
    steps = round(seconds / dt)
    start = time.process_time()
    with torch.no_grad():
        state = simulator.rollout(state, steps=steps)[-1]
    spent = time.process_time() - start
    speed = float(state.body_velocities[1, :3] @ downhill)
    expected = seconds * GRAVITY * math.sin(ANGLE) / (1 + shape.moment)
    return len(body.faces), speed / expected - 1, spent / steps


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option("--seconds", default=0.4, type=click.FloatRange(min=0.01), help="Of each roll.")
@click.option("--dt", default=0.005, type=click.FloatRange(min=1e-4), help="Time step [s].")
@click.option("--quick", is_flag=True, help="Two steps of a ball and a cylinder.")
def main(seconds: float, dt: float, quick: bool) -> None:
    torch.set_num_threads(1)
    shapes = SHAPES
    if quick:
        seconds = 2 * dt
        shapes = {name: SHAPES[name] for name in ("ball, smooth", "cylinder, rings=5")}
    columns = "".join(f"{f'{1e3 * d:g} mm':>9}" for d in DISTANCES)
    print(f"{'body':<22}{'faces':>6}{columns}{'ms':>7}")
    for name, shape in shapes.items():
        rolls = [roll(shape, distance, seconds, dt) for distance in DISTANCES]
        errors = "".join(f"{error:+9.1%}" for _, error, _ in rolls)
        spent = statistics.median(each for _, _, each in rolls)
        print(f"{name:<22}{rolls[0][0]:6}{errors}{1e3 * spent:7.1f}")


if __name__ == "__main__":
    main()
