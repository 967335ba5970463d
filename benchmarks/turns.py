"""Energy that contact adds to rotating bodies.

    python -m benchmarks.turns            # two minutes
    python -m benchmarks.turns --quick    # seconds

The first table throws boxes of three shapes on a floor without gravity, with an initial rotation
of so many radians per step. Columns: steps in contact; throws that are finally refused, because
the box rotated by more than 1 rad before or after a step; steps in which the sum of kinetic and
stored energy rises by more than a thousandth of the kinetic energy; the largest rise over the
kinetic energy, negative if all steps lose energy.

The second table rolls balls that are meshes on a level floor for `--seconds`. The corner that
carries the weight adds g h^2 / (1.4 r) of the kinetic energy of a solid ball in a step, at any
speed: the force acts at the corner's position at the end of the step, slightly behind the middle
of its arc. Columns: faces; time step; radians per step; steps; rises as before; the largest rise;
the formula; the energy at the end over the energy at the start.
"""

from __future__ import annotations

from collections.abc import Iterator

import click
import numpy as np
import torch

import diffcloth_torch as dc

DT = 0.008  # [s]
SIZES = {
    "1 : 1 : 1": (0.06, 0.06, 0.06),
    "1 : 1.6 : 2.6": (0.05, 0.08, 0.13),
    "1 : 2 : 20": (0.01, 0.02, 0.2),
}
TURNS = (0.1, 0.2, 0.4, 0.6, 0.8, 1.0)  # [rad]
STEPS = 8
RADIUS, GRAVITY = 0.05, 9.81
SUBDIVISIONS = (1, 2, 3)
TIME_STEPS = (0.01, 0.005, 0.0025)  # [s]
SPEEDS = (5.0, 20.0)  # [rad/s]


def thrown(
    size: tuple[float, float, float], turn: float, seed: int
) -> tuple[dc.Simulator, dc.State]:
    """A box above a floor that turns by `turn` rad a step, and reaches the floor soon."""
    rng = np.random.default_rng(seed)
    pose, axis = rng.normal(size=4), rng.normal(size=3)
    pose /= np.linalg.norm(pose)
    reach = float(np.linalg.norm(size)) / 2
    height = reach * (0.8 + 0.25 * rng.random())
    box = dc.RigidBody.box(size, motion="dynamic", density=400, pose=[0, 0, height, *pose])
    simulator = dc.Simulator(
        dc.Scene([], [dc.RigidBody.plane(3.0), box], gravity=(0, 0, 0)),
        DT,
        contact=dc.ContactOptions(barrier_distance=reach / 60),
    )
    speed = turn / DT
    velocities = torch.zeros(2, 6, dtype=torch.float64)
    velocities[1, 2] = -0.3 * speed * reach
    velocities[1, 3:] = torch.from_numpy(axis / np.linalg.norm(axis) * speed)
    return simulator, simulator.initial_state().replace(body_velocities=velocities)


def energy(simulator: dc.Simulator, state: dc.State) -> float:
    """Kinetic and stored [J]."""
    return float(simulator.kinetic_energy(state)) + float(simulator.energy(state))


def rolling(subdivisions: int, dt: float, speed: float) -> tuple[int, dc.Simulator, dc.State]:
    """The number of faces of a ball that rolls on a floor, and its start."""
    gap = 5e-4
    pose = [0, 0, RADIUS + gap, 1, 0, 0, 0]
    ball = dc.RigidBody.sphere(
        RADIUS, subdivisions=subdivisions, motion="dynamic", density=500, pose=pose
    )
    simulator = dc.Simulator(
        dc.Scene([], [dc.RigidBody.plane(100.0), ball]),
        dt,
        contact=dc.ContactOptions(barrier_distance=2 * gap),
    )
    velocities = torch.zeros(2, 6, dtype=torch.float64)
    velocities[1, 0], velocities[1, 4] = speed * (RADIUS + gap), speed
    start = simulator.initial_state().replace(body_velocities=velocities)
    return len(ball.faces), simulator, start


def roll(subdivisions: int, dt: float, speed: float, seconds: float) -> str:
    """A line of the second table."""
    faces, simulator, state = rolling(subdivisions, dt, speed)
    start = before = energy(simulator, state)
    found = []
    for _ in range(round(seconds / dt)):
        kinetic = float(simulator.kinetic_energy(state))
        with torch.no_grad():
            state = simulator.step(state)
        after = energy(simulator, state)
        found.append((after - before) / kinetic)
        before = after
    risen = sum(rise > 1e-3 for rise in found)
    formula = GRAVITY * dt**2 / (1.4 * RADIUS)
    return (
        f"{faces:6}{1e3 * dt:7.1f}{speed * dt:7.3f}{len(found):7}{risen:7}"
        f"{max(found):10.4f}{formula:9.4f}{before / start:8.3f}"
    )


def rises(size: tuple[float, float, float], turn: float, throws: int) -> Iterator[float | None]:
    """Rise of energy over the kinetic energy for each step in contact; None if refused."""
    for seed in range(throws):
        try:
            simulator, state = thrown(size, turn, seed)
        except dc.IntersectingState:
            continue
        for _ in range(STEPS):
            kinetic = float(simulator.kinetic_energy(state))
            before = energy(simulator, state)
            try:
                with torch.no_grad():
                    state = simulator.step(state)
            except dc.TurnedTooFar:
                yield None
                break
            if state.body_forces.any():
                yield (energy(simulator, state) - before) / kinetic


@click.command(help=__doc__.splitlines()[0])
@click.option("--throws", default=80, show_default=True, help="Of each shape and turn.")
@click.option("--seconds", default=0.8, type=click.FloatRange(min=0.05), help="Of each roll.")
@click.option("--quick", is_flag=True, help="8 throws, and one ball for a moment.")
def main(throws: int, seconds: float, quick: bool) -> None:
    """Print a line for each shape and turn, and for each ball."""
    torch.set_num_threads(1)
    click.echo(f"{'shape':16}{'rad':>5}{'steps':>7}{'refused':>9}{'rise':>6}{'largest':>10}")
    for shape, size in SIZES.items():
        for turn in TURNS:
            found = list(rises(size, turn, 8 if quick else throws))
            taken = [rise for rise in found if rise is not None]
            largest = f"{max(taken):.4f}" if taken else "-"
            risen = sum(rise > 1e-3 for rise in taken)
            refused = len(found) - len(taken)
            click.echo(f"{shape:16}{turn:5.1f}{len(taken):7}{refused:9}{risen:6}{largest:>10}")
    click.echo(
        f"\n{'faces':>6}{'h [ms]':>7}{'rad':>7}{'steps':>7}{'rise':>7}{'largest':>10}{'formula':>9}"
        f"{'end':>8}"
    )
    for subdivisions in SUBDIVISIONS[:1] if quick else SUBDIVISIONS:
        for dt in TIME_STEPS[:1] if quick else TIME_STEPS:
            for speed in SPEEDS:
                click.echo(roll(subdivisions, dt, speed, 10 * dt if quick else seconds))


if __name__ == "__main__":
    main()
