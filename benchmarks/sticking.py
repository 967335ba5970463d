"""Cost of a smaller slip velocity, and creep of objects that a gripper holds.

    python -m benchmarks.sticking
    python -m benchmarks.sticking --quick     # seconds: shows that it runs

The first part runs the scenes of `benchmarks/scenes.py` in contact, at each slip velocity: Newton
iterations and processor time of a step, medians of `--steps` steps in the scene's regime. The
second part holds a cloth and a box between two plates against gravity for `--seconds`: the distance
by which they sink, beside the law v = e (1 - sqrt(1 - T / (mu N))) with the load T and the normal
forces N.
"""

from __future__ import annotations

import math
import time
from statistics import median

import click
import torch
from tqdm import tqdm

import diffcloth_torch as dc
from benchmarks.scenes import BUCKLING, DT, SCENES, in_regime

NAMES = ("plane", "sphere", "self-contact", "two-sheets", "moving-body", "twist", "crumple")
SLIPS = (1e-3, 1e-4, 1e-5, 1e-6)  # [m/s]
FRICTION = 0.6
GAP = 0.6  # gap between a plate and the held object, relative to the barrier distance


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option("--size", default=16, type=click.IntRange(min=4), help="Vertices a side.")
@click.option("--steps", default=12, type=click.IntRange(min=1))
@click.option("--seconds", default=60.0, type=click.FloatRange(min=0.1), help="Of holding.")
@click.option("--quick", is_flag=True, help="Small and short.")
def main(size: int, steps: int, seconds: float, quick: bool) -> None:
    torch.set_num_threads(1)
    names, slips = NAMES, SLIPS
    if quick:
        size, steps, seconds, names, slips = 6, 2, 0.2, ("plane", "two-sheets"), (1e-3, 1e-4)
    print(f"{size} x {size}, {steps} steps; iterations / ms a step at a slip velocity [m/s] of")
    print(f"{'':14}" + "".join(f"{slip:>16g}" for slip in slips))
    for name in tqdm(names, disable=None, leave=False):
        cells = (_cost(name, size, steps, slip) for slip in slips)
        tqdm.write(f"{name:14}" + "".join(f"{n:>8g} /{ms:>6.1f}" for n, ms in cells))
    print(f"\nHeld for {seconds:g} s: creep, and that of the law [mm]")
    for what in ("cloth", "box"):
        for slip in slips:
            share, way, law = held(what, slip, seconds)
            print(
                f"{what:6} {share:>6.1%} of its friction, {slip:>6g} m/s: {1e3 * way:.4f}, "
                f"{1e3 * law:.4f}"
            )


def _cost(name: str, size: int, steps: int, slip: float) -> tuple[float, float]:
    scene = (SCENES | BUCKLING)[name](size)
    simulator = dc.Simulator(
        scene.scene,
        DT,
        contact=dc.ContactOptions(slip_velocity=slip),
        solver=dc.SolverOptions(max_iterations=1000),
    )
    state = in_regime(simulator, scene, 0)
    iterations, milliseconds = [], []
    with torch.no_grad():
        for _ in range(steps):
            start = time.process_time()
            state = simulator.step(state, scene.control(state))
            milliseconds.append(1e3 * (time.process_time() - start))
            iterations.append(state.report.iterations)
    return median(iterations), median(milliseconds)


def held(what: str, slip: float, seconds: float) -> tuple[float, float, float]:
    """Share of friction that the load needs, measured creep and creep by the law [m]."""
    d_hat, thickness = 1e-3, 0.02 if what == "box" else 0.0
    x = thickness / 2 + GAP * d_hat + 0.01
    plates = [
        dc.RigidBody.box(
            (0.02, 0.04, 0.04), friction=FRICTION, pose=[side * x, 0, 0, 1, 0, 0, 0], name=name
        )
        for side, name in ((-1, "left"), (1, "right"))
    ]
    cloths: list[dc.Cloth] = []
    if what == "box":
        shape = (thickness, 0.03, 0.05)
        plates.append(
            dc.RigidBody.box(shape, motion="dynamic", mass=0.02, friction=FRICTION, name="box")
        )
    else:
        upright = [math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0]
        material = dc.Material(friction=FRICTION, damping=0.05)
        pose = [0, 0, -0.06, *upright]
        cloths.append(dc.Cloth.grid(9, 9, (0.2, 0.2), material=material, pose=pose, name="cloth"))
    contact = dc.ContactOptions(barrier_distance=d_hat, slip_velocity=slip, barrier_stiffness=200.0)
    simulator = dc.Simulator(dc.Scene(cloths, plates), 0.02, contact=contact)

    def height(state: dc.State) -> float:
        """Height of the box, or mean height of the cloth's vertices between the plates [m]."""
        if what == "box":
            return float(state.body_poses[-1, 2])
        start = simulator.initial_state().positions
        near = (start[:, 1].abs() < 0.02) & (start[:, 2].abs() < 0.02)
        return float(state.positions[near, 2].mean())

    state = simulator.initial_state()
    with torch.no_grad():
        for _ in range(50):  # until the object hangs
            state = simulator.step(state)
        start = height(state)
        steps = round(seconds / simulator.dt)
        for _ in tqdm(range(steps), disable=None, leave=False):
            state = simulator.step(state)
        wrenches = simulator.contact_wrenches(state)
    normal = sum(abs(float(wrenches[name][0])) for name in ("left", "right"))
    load = sum(float(wrenches[name][2]) for name in ("left", "right"))
    share = abs(load) / (FRICTION * normal)
    law = slip * (1 - math.sqrt(max(0.0, 1 - share))) * seconds
    return share, start - height(state), law


if __name__ == "__main__":
    main()
