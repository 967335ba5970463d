"""How much energy contact gives to bodies that turn fast.

    python -m benchmarks.turns            # a minute
    python -m benchmarks.turns --quick    # seconds

Boxes of three shapes are thrown on a floor without gravity, with a first turn of so many radians a
step. The columns: steps in contact; throws that are refused in the end, as the box turned by more
than 1 rad before or after a step; steps in which the kinetic and the stored energy together rise by
more than a thousandth of the kinetic energy; the largest rise over the kinetic energy, negative
where all steps lose.
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


def rises(size: tuple[float, float, float], turn: float, throws: int) -> Iterator[float | None]:
    """Of each step in contact the rise of energy over the kinetic energy; None where refused."""
    for seed in range(throws):
        try:
            simulator, state = thrown(size, turn, seed)
        except dc.IntersectingState:
            continue
        for _ in range(STEPS):
            kinetic = float(simulator.kinetic_energy(state))
            before = kinetic + float(simulator.energy(state))
            try:
                with torch.no_grad():
                    state = simulator.step(state)
            except dc.TurnedTooFar:
                yield None
                break
            if state.body_forces.any():
                after = float(simulator.kinetic_energy(state)) + float(simulator.energy(state))
                yield (after - before) / kinetic


@click.command(help=__doc__.splitlines()[0])
@click.option("--throws", default=80, show_default=True, help="Of each shape and turn.")
@click.option("--quick", is_flag=True, help="8 throws.")
def main(throws: int, quick: bool) -> None:
    """Print a line for each shape and turn."""
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


if __name__ == "__main__":
    main()
