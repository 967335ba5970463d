"""Drape coefficients after Cusick: equilibria against the ends of long damped rollouts.

    python -m benchmarks.drape_coefficient
    python -m benchmarks.drape_coefficient --quick     # seconds: shows that it runs

A disk of cloth, 30 cm wide, lies on a pedestal of 18 cm, which holds its middle, and hangs over the
rim. The drape coefficient is the area of its shadow beyond the pedestal, divided by the area of the
flat ring: 100 % for a stiff plate. The disk falls for `--seconds`, with five bending stiffnesses,
with and without friction. `simulator.equilibrium` starts from the rollout after `--fold` seconds,
when the folds have formed, and from the flat disk; with friction also from the end of the rollout,
which anchors friction there.

Columns: bending stiffness [mJ]; drape coefficient at the end of the rollout [%]; largest distance
of a vertex at that end to the equilibria found from the folds, from the flat disk and from the end
[m]; speed at the end of the rollout [m/s]; processor time of the rollout [s]; processor time of the
equilibrium from the folds, relative to the rollout, and of the first call of a simulator, which
includes the construction of its engines.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import click
import numpy as np
import torch
from tqdm import tqdm

import diffcloth_torch as dc
from diffcloth_torch.config.shapes import disk

RADIUS, PEDESTAL, HELD = 0.15, 0.09, 0.06  # [m]
BENDINGS = (1e-3, 2e-4, 5e-5, 2e-5, 1e-5)  # [J]
FRICTIONS = (0.0, 0.3)
DT = 0.02  # [s]


class Drape(NamedTuple):
    """A disk on its pedestal; the first `rim` vertices are its outline, in order."""

    simulator: dc.Simulator
    rim: int

    def coefficient(self, state: dc.State) -> float:
        """Area of the shadow beyond the pedestal, divided by the area of the flat ring."""
        x, y = state.positions[: self.rim, :2].T.numpy()
        shadow = 0.5 * abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
        pedestal = np.pi * PEDESTAL**2
        return float((shadow - pedestal) / (np.pi * RADIUS**2 - pedestal))


def make(bending: float, friction: float, edge_length: float) -> Drape:
    """A disk just above a pedestal, flat."""
    vertices, _, faces = disk(RADIUS, edge_length)
    vertices[:, 2] = 0.0015
    cloth = dc.Cloth(
        vertices,
        faces,
        material=dc.Material(
            stretch=500.0, bending=bending, density=0.15, damping=0.02, friction=friction
        ),
        pins={"middle": np.flatnonzero(np.hypot(*vertices[:, :2].T) < HELD).tolist()},
        name="disk",
    )
    pedestal = dc.RigidBody.cylinder(
        PEDESTAL, 0.02, pose=[0, 0, -0.01, 1, 0, 0, 0], friction=friction, name="pedestal"
    )
    simulator = dc.Simulator(
        dc.Scene([cloth], [pedestal]), DT, solver=dc.SolverOptions(tolerance=1e-9)
    )
    return Drape(simulator, round(2 * np.pi * RADIUS / edge_length))


def fall(drape: Drape, seconds: float, fold: float) -> tuple[dc.State, dc.State]:
    """The states of a rollout after `fold` seconds and at its end."""
    state = folded = drape.simulator.initial_state()
    with torch.no_grad():
        for k in range(round(seconds / DT)):
            state = drape.simulator.step(state)
            if k + 1 == round(fold / DT):
                folded = state
    return folded, state


def distance(a: dc.State, b: dc.State) -> float:
    """Largest distance of a vertex between two states [m]."""
    return float((a.positions - b.positions).norm(dim=-1).max())


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option("--edge", default=0.012, type=click.FloatRange(0.004, 0.05), help="Edges [m].")
@click.option("--seconds", default=6.0, type=click.FloatRange(min=0.1), help="Of the rollout.")
@click.option("--fold", default=0.5, type=click.FloatRange(min=0.02), help="Start of the search.")
@click.option("--quick", is_flag=True, help="Coarse, short and two stiffnesses.")
def main(edge: float, seconds: float, fold: float, quick: bool) -> None:
    torch.set_num_threads(1)
    bendings = BENDINGS
    if quick:
        edge, seconds, fold, bendings = 0.03, 0.6, 0.3, (1e-3, 2e-4)
    for friction in FRICTIONS:
        print(f"\nfriction {friction:g}, {seconds:g} s of rollout, folds after {fold:g} s")
        print(
            "bending  coefficient  from folds   from flat    from end       speed  rollout  "
            "equilibrium  first"
        )
        for bending in tqdm(bendings, disable=None, leave=False):
            tqdm.write(_row(make(bending, friction, edge), bending, seconds, fold))


def _row(drape: Drape, bending: float, seconds: float, fold: float) -> str:
    (folded, end), rollout = _timed(lambda: fall(drape, seconds, fold))
    find = drape.simulator.equilibrium
    of_flat, first = _timed(lambda: find(drape.simulator.initial_state()))
    of_folds, again = _timed(lambda: find(folded))
    distances = [distance(end, e) for e in (of_folds, of_flat, find(end))]
    speed = float(end.velocities.norm(dim=-1).max())
    return (
        f"{1e3 * bending:7g} {drape.coefficient(end):11.2%} "
        + "".join(f"{d:12.1e}" for d in distances)
        + f"{speed:12.1e}{rollout:9.1f}{again / rollout:13.3f}{first / rollout:7.3f}"
    )


def _timed(f: Callable[[], object]):
    start = time.process_time()
    result = f()
    return result, time.process_time() - start


if __name__ == "__main__":
    main()
