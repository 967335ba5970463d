"""Schemes, metrics and elastic solvers on the same passive scenes: accuracy and cost.

    python -m benchmarks.schemes            # minutes
    python -m benchmarks.schemes --quick    # seconds, on small meshes

A sheet of 1 m falls on a sphere, slides over a floor, or falls on a box, without driving forces.

pairs       largest number of intersecting pairs of triangles in a state, found by the IPC Toolkit
momentum    |change of linear momentum - impulse of gravity and of the bodies| over the impulse
            of gravity in a step, the largest
energy      sum of the rises of mechanical energy in single steps, over the available energy:
            kinetic energy at the start, plus gravity's over the drop to the lowest state
strain      largest strain of an edge in any state [%]
iterations  Newton iterations of a step, + iterations of Projective Dynamics
time        processor time of a step and its gradient [ms]
gradient    relative error of the derivative of a random function of a step's end by its velocities,
            against central differences, the median over the checked steps
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

import click
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import diffcloth_torch as dc
from benchmarks.crossings import Crossings
from benchmarks.experiments import stretch, table
from benchmarks.scenes import DT, sheet

COLUMNS = (
    "pairs",
    "momentum",
    "energy",
    "strain [%]",
    "iterations",
    "time [ms]",
    "gradient",
)

THICKNESS = 4e-3  # thickness of the bodies [m]; nodes keep half of it as distance
CHECKED = 5  # steps whose gradients are compared with differences


@dataclass(frozen=True)
class Scene:
    """The body below a sheet, the start velocity of the sheet [m/s], and the number of steps."""

    body: Callable[[], dc.RigidBody]
    velocity: tuple[float, float, float]
    steps: int

    def make(self, size: int) -> dc.Scene:
        return dc.Scene([level(size)], [self.body()])


def level(size: int) -> dc.Cloth:
    """A level, off-center sheet, just above the range of its barrier."""
    vertices, faces = sheet(size)
    place = (0.02, 0.03, THICKNESS / 2 + 0.12 / (size - 1))
    return dc.Cloth(vertices + place, faces, material=dc.Material(bending=1e-4))


SCENES = {
    "sphere": Scene(
        lambda: dc.RigidBody.sphere(0.2, pose=[0, 0, -0.2, 1, 0, 0, 0], thickness=THICKNESS),
        (0.0, 0.0, 0.0),
        60,
    ),
    "floor": Scene(lambda: dc.RigidBody.plane(4.0, thickness=THICKNESS), (0.8, 0.3, 0.0), 20),
    "box": Scene(
        lambda: dc.RigidBody.box(0.4, pose=[0, 0, -0.2, 1, 0, 0, 0], thickness=THICKNESS),
        (0.0, 0.0, 0.0),
        60,
    ),
}

METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "coupled": ("coupled", {}),
    "split, energy": ("split", {"metric": "energy"}),
    "split, mass": ("split", {"metric": "mass"}),
    "split, identity": ("split", {"metric": "identity"}),
    "split, elastic": ("split", {"metric": "elastic"}),
    "split, elastic, local/global": ("split", {"metric": "elastic", "elastic": "projective"}),
    "projective": ("projective", {}),
    "projective, local/global": ("projective", {"elastic": "projective"}),
}
"""Name -> scheme and options of the solver."""


@dataclass(frozen=True)
class Rollout:
    """States, reports and times of one method on one scene."""

    states: list[dc.State]
    seconds: list[float]
    errors: list[float]
    failure: str | None


def roll_out(simulator: dc.Simulator, velocity: tuple[float, float, float], steps: int) -> Rollout:
    """Run steps, each with its gradient, and check some of the gradients."""
    state = simulator.initial_state()
    speed = torch.tensor(velocity, dtype=torch.float64)
    states = [state.replace(velocities=state.velocities + speed)]
    checked = set(np.linspace(steps / 4, steps - 1, CHECKED).astype(int).tolist())
    seconds, errors = [], []
    for k in tqdm(range(steps), disable=None, leave=False):
        start = time.process_time()
        try:
            after, slope = step_and_slope(simulator, states[-1], k)
            seconds.append(time.process_time() - start)
            if k in checked:
                errors.append(abs(slope / difference(simulator, states[-1], k) - 1))
        except dc.SimulationError as failure:
            return Rollout(states, seconds, errors, f"step {k}: {failure}")
        states.append(after)
    return Rollout(states, seconds, errors, None)


def weights(state: dc.State, seed: int) -> tuple[Tensor, Tensor]:
    """Weights of a function of positions, and a direction of velocities [m/s]."""
    generator = torch.Generator().manual_seed(seed)
    shape = state.positions.shape
    function, direction = torch.randn(2, *shape, dtype=torch.float64, generator=generator)
    return function, direction


def step_and_slope(simulator: dc.Simulator, state: dc.State, seed: int) -> tuple[dc.State, float]:
    """The state after a step, and the directional derivative of a function of this state."""
    function, direction = weights(state, seed)
    velocities = state.velocities.clone().requires_grad_()
    after = simulator.step(state.replace(velocities=velocities))
    (gradient,) = torch.autograd.grad((after.positions * function).sum(), velocities)
    return after.detach(), (gradient * direction).sum().item()


def difference(simulator: dc.Simulator, state: dc.State, seed: int) -> float:
    """Central difference of the same function along the same direction."""
    function, direction = weights(state, seed)
    epsilon = 1e-4
    values = []
    for sign in (1, -1):
        moved = state.replace(velocities=state.velocities + sign * epsilon * direction)
        with torch.no_grad():
            values.append((simulator.step(moved).positions * function).sum().item())
    return (values[0] - values[1]) / (2 * epsilon)


def momentum_error(mass: Tensor, states: list[dc.State]) -> float:
    """Largest change of momentum without a force, over the impulse of gravity in a step."""
    weight = mass.sum() * torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
    largest = 0.0
    for before, after in itertools.pairwise(states):
        change = mass @ (after.velocities - before.velocities)
        impulse = DT * (weight - after.body_forces.sum(dim=0))
        largest = max(largest, ((change - impulse).norm() / (DT * weight.norm())).item())
    return largest


def energy_gained(simulator: dc.Simulator, mass: Tensor, states: list[dc.State]) -> float:
    """Sum of the rises of the mechanical energy, over the available energy."""
    kinetic = [simulator.kinetic_energy(state).item() for state in states]
    energies = [simulator.energy(s).item() + k for s, k in zip(states, kinetic, strict=True)]
    rises = np.maximum(np.diff(energies), 0).sum()
    heights = torch.stack([mass @ state.positions[:, 2] for state in states])
    available = kinetic[0] + 9.81 * (heights[0] - heights.min()).item()
    return float(rises / available)


def iterations(reports: list[dc.Report]) -> str:
    """Mean Newton iterations of a step, and local/global iterations if there are any."""
    counts = [report.counts.get("local_global", 0) for report in reports]
    newton = f"{sum(report.iterations for report in reports) / len(reports):.1f}"
    return newton + (f" + {sum(counts) / len(reports):.0f}" if any(counts) else "")


def row(simulator: dc.Simulator, rollout: Rollout) -> list[str]:
    states, scene = rollout.states, simulator.scene
    reports = [state.report for state in states[1:]]
    if not reports:
        return ["-"] * len(COLUMNS)
    mass = simulator.vertex_masses()
    crossings = Crossings(scene)
    return [
        f"{max(crossings.count(state) for state in states)}",
        f"{momentum_error(mass, states):.0e}",
        f"{energy_gained(simulator, mass, states):.2g}",
        f"{100 * (max(stretch(scene, state) for state in states) - 1):.1f}",
        iterations(reports),
        f"{1e3 * sum(rollout.seconds) / len(reports):.0f}",
        f"{median(rollout.errors):.0e}" if rollout.errors else "-",
    ]


@click.command(help=__doc__.replace("\n\n", "\n\n\b\n"))
@click.option("--scene", "names", multiple=True, type=click.Choice(list(SCENES)))
@click.option(
    "--method", "methods", multiple=True, type=click.Choice(list(METHODS)), help="By default all."
)
@click.option("--size", default=16, show_default=True, help="Vertices along a side of the sheet.")
@click.option("--quick", is_flag=True, help="7 x 7 vertices, 10 steps.")
def main(names: tuple[str, ...], methods: tuple[str, ...], size: int, quick: bool) -> None:
    torch.set_num_threads(1)
    for name in names or SCENES:
        scene = SCENES[name]
        rows, failures = [], []
        for method in methods or METHODS:
            scheme, options = METHODS[method]
            solver = dc.SolverOptions(tolerance=1e-9, **options)
            made = scene.make(7 if quick else size)
            simulator = dc.Simulator(made, DT, scheme=scheme, solver=solver)
            rollout = roll_out(simulator, scene.velocity, 10 if quick else scene.steps)
            rows.append((method, row(simulator, rollout)))
            failures += [f"{method}, {rollout.failure}"] if rollout.failure else []
        click.echo(table(name, COLUMNS, rows))
        click.echo("".join(f"\n{failure}" for failure in failures), nl=bool(failures))


if __name__ == "__main__":
    main()
