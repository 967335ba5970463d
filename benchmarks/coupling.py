"""Cost of bodies and grippers that forces move: `monolithic` beside prescribed motion.

    python -m benchmarks.coupling            # a minute or two
    python -m benchmarks.coupling --quick    # seconds, on small meshes

A free body, or a floating gripper with driven fingers, falls on a sheet. Every step is repeated
from the same state with the resulting poses prescribed: the same problem with known coordinates.
Both are timed alternately; values are processor times [ms], medians over the steps in contact.
Backward is of a random loss of positions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from statistics import median

import click
import torch

import diffcloth_torch as dc

DT = 0.01  # [s]


@dataclass(frozen=True)
class Pair:
    """Two simulators of one scene: free motion, and its replay as prescribed motion."""

    free: dc.Simulator
    given: dc.Simulator
    control: dc.Control
    replay: Callable[[dc.State], dc.Control]


def sheet(size: int) -> dc.Cloth:
    """A sheet of 1 m, held at two edges."""
    edges = [i for i in range(size * size) if i % size in (0, size - 1)]
    return dc.Cloth.grid(size, size, pins={"edges": edges}, name="sheet")


def body(size: int) -> Pair:
    """A box of 300 g that falls on the sheet."""
    start = {"pose": [0.013, 0.007, 0.13, 1, 0.02, 0.01, 0]}
    free = dc.RigidBody.box(0.2, motion="dynamic", mass=0.3, **start)
    given = dc.RigidBody.box(0.2, motion="kinematic", **start)
    simulators = [dc.Simulator(dc.Scene([sheet(size)], [b]), DT) for b in (free, given)]
    return Pair(
        *same_barrier(simulators),
        dc.Control(),
        lambda after: dc.Control(body_poses=after.body_poses),
    )


def gripper(size: int, **bounds: float) -> Pair:
    """A hand on a floating base: its palm falls on the sheet while its fingers close."""
    # Turned over: the fingers point down, and end 1 cm above the sheet.
    options = {"pose": [0.013, 0.007, 0.1, 0, 1, 0, 0], "name": "hand", **bounds}
    robots = [
        dc.Robot.load(dc.robots.GRIPPER, base="floating", stiffness=200.0, damping=5.0, **options),
        dc.Robot.load(dc.robots.GRIPPER, base="kinematic", actuation="position", **options),
    ]
    simulators = [dc.Simulator(dc.Scene([sheet(size)], [], [robot]), DT) for robot in robots]
    return Pair(
        *same_barrier(simulators),
        dc.Control(joint_positions={"left_finger_joint": 0.01, "right_finger_joint": 0.01}),
        lambda after: dc.Control(
            base_poses=after.base_poses, joint_positions=after.joint_positions
        ),
    )


def limited_gripper(size: int) -> Pair:
    """The gripper with joint friction, and drives at the limits of their efforts and speeds."""
    return gripper(size, effort_limits=2.0, velocity_limits=0.05, joint_friction=0.2)


PAIRS = {"free body": body, "gripper": gripper}


def same_barrier(simulators: list[dc.Simulator]) -> list[dc.Simulator]:
    """Both simulators with the largest barrier stiffness of the first, due to its free bodies."""
    stiffness = float(simulators[0].default_parameters().barrier_stiffness.max())
    contact = dc.ContactOptions(barrier_stiffness=stiffness)
    return [dc.Simulator(simulator.scene, DT, contact=contact) for simulator in simulators]


def timed(
    simulator: dc.Simulator, state: dc.State, control: dc.Control
) -> tuple[dc.State, float, float]:
    """A step and its gradient, with their processor times [ms]."""
    generator = torch.Generator().manual_seed(0)
    start = state.replace(
        positions=state.positions.detach().requires_grad_(),
        velocities=state.velocities.detach().requires_grad_(),
    )
    t0 = time.process_time()
    after = simulator.step(start, control)
    t1 = time.process_time()
    weights = torch.randn(after.positions.shape, generator=generator, dtype=torch.float64)
    (after.positions * weights).sum().backward()
    t2 = time.process_time()
    return after.detach(), 1e3 * (t1 - t0), 1e3 * (t2 - t1)


def measure(pair: Pair, steps: int) -> Iterator[tuple[float, ...]]:
    """Times of the steps in contact: forward and backward, free and given, and their iterations."""
    state = pair.free.initial_state()
    known = state
    for _ in range(steps):
        after, forward, backward = timed(pair.free, state, pair.control)
        same = known.replace(
            positions=state.positions,
            velocities=state.velocities,
            body_poses=state.body_poses,
            base_poses=state.base_poses,
            joint_positions=state.joint_positions,
        )
        known, forward_given, backward_given = timed(pair.given, same, pair.replay(after))
        if after.report.contact_count > 0:
            yield (
                forward,
                forward_given,
                backward,
                backward_given,
                after.report.iterations,
                known.report.iterations,
            )
        state = after


@click.command(help=__doc__)
@click.option("--size", default=24, show_default=True, help="Vertices along a side of the sheet.")
@click.option("--steps", default=40, show_default=True)
@click.option("--quick", is_flag=True, help="8 x 8 vertices, 12 steps.")
def main(size: int, steps: int, quick: bool) -> None:
    """Print a table."""
    torch.set_num_threads(1)
    if quick:
        size, steps = 8, 12
    titles = ("forward", "given", "ratio", "backward", "given", "ratio", "Newton", "given", "steps")
    click.echo(f"{'':10}" + "".join(f"{title:>10}" for title in titles))
    for name, make in PAIRS.items():
        rows = list(measure(make(size), steps))
        f, fg, b, bg, n, ng = (median(column) for column in zip(*rows, strict=True))
        numbers = (f, fg, f / fg, b, bg, b / bg, n, ng, len(rows))
        click.echo(f"{name:10}" + "".join(f"{number:10.3g}" for number in numbers))


if __name__ == "__main__":
    main()
