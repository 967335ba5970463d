"""Time the Jacobian of a rollout by three parameters, forward and by differences.

    python -m benchmarks.tangents
    python -m benchmarks.tangents --size 12 --steps 5      # seconds

A sheet with two pinned corners falls onto a sphere. The residuals are positions of vertices at some
of the steps, the parameters stretch, friction and bending. Printed are medians over `--repeats` of
the rollout without derivatives, of `torch.func.jacfwd`, and of central differences, in seconds and
in rollouts; and the largest difference of the two Jacobians, relative, column by column.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import click
import torch

import diffcloth_torch as dc

NAMES = ("stretch", "friction", "bending")
VALUES = torch.tensor([550.0, 0.4, 1e-5], dtype=torch.float64)
APART = 1e-4  # relative, of the points of differences


def residuals_of(size: int, steps: int) -> Callable[[torch.Tensor], torch.Tensor]:
    cloth = dc.Cloth.grid(size, size, pose=[0, 0, 0.3, 1, 0, 0, 0], pins={"corners": [0, size - 1]})
    sim = dc.Simulator(dc.Scene([cloth], [dc.RigidBody.sphere(0.25)]), dt=0.01)
    with torch.no_grad():
        start = sim.rollout(sim.initial_state(), steps=10)[-1]
    parameters = sim.default_parameters()

    def residuals(values: torch.Tensor) -> torch.Tensor:
        given = parameters.replace(**dict(zip(NAMES, values, strict=True)))
        states = sim.rollout(start, parameters=given, steps=steps)
        return torch.cat([state.positions[::7].flatten() for state in states[3::4]])

    return residuals


def differences(function: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
    columns = []
    with torch.no_grad():
        for k, value in enumerate(VALUES):
            step = torch.zeros_like(VALUES)
            step[k] = APART * value
            columns.append((function(VALUES + step) - function(VALUES - step)) / (2 * step[k]))
    return torch.stack(columns, dim=-1)


def seconds(call: Callable[[], torch.Tensor]) -> tuple[float, torch.Tensor]:
    start = time.perf_counter()
    found = call()
    return time.perf_counter() - start, found


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option("--size", default=24, type=click.IntRange(min=4), help="Vertices a side.")
@click.option("--steps", default=20, type=click.IntRange(min=4))
@click.option("--repeats", default=5, type=click.IntRange(min=1))
def main(size: int, steps: int, repeats: int) -> None:
    torch.set_num_threads(1)
    residuals = residuals_of(size, steps)

    def alone() -> torch.Tensor:
        with torch.no_grad():
            return residuals(VALUES)

    calls = {
        "rollout": alone,
        "jacfwd": lambda: torch.func.jacfwd(residuals)(VALUES),
        "differences": lambda: differences(residuals),
    }
    times: dict[str, list[float]] = {name: [] for name in calls}
    found = {}
    alone()  # warm-up, not timed
    for _ in range(repeats):
        for name, call in calls.items():
            taken, found[name] = seconds(call)
            times[name].append(taken)
    medians = {name: statistics.median(taken) for name, taken in times.items()}
    click.echo(f"{size} x {size}, {steps} steps, {len(found['rollout'])} residuals")
    for name, taken in medians.items():
        click.echo(f"{name:12} {taken:8.3f} s {taken / medians['rollout']:6.2f} rollouts")
    jacobian, difference = found["jacfwd"], found["differences"]
    for k, name in enumerate(NAMES):
        error = (jacobian - difference)[:, k].norm() / jacobian[:, k].norm()
        click.echo(f"{name:12} {float(error):8.1e} apart")


if __name__ == "__main__":
    main()
