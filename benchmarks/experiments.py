"""The experiments of the paper's section V.B by scheme: results and intersections.

    python -m benchmarks.experiments                       # minutes
    python -m benchmarks.experiments --pictures docs/images
    python -m benchmarks.experiments --quick               # seconds, on small meshes

Each row is one run of configs/tie.yaml or configs/cloth_on_cube.yaml. `pairs` is the largest number
of intersecting pairs of triangles in a state, as found by the IPC Toolkit; `states` is the number
of states with any. `stuck` counts steps that did not converge, or after which the run could not
continue. `distance` is the largest final distance of a control point from its target, `stretch` the
largest length of an edge over its length at rest, over all states. `turns` is the final number of
turns of a strip's ends around each other. Times are processor times.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import torch
from tqdm import tqdm

import diffcloth_torch as dc
from benchmarks.crossings import Crossings
from diffcloth_torch.config.viewers import open_viewers
from diffcloth_torch.tasks.control_points import ControlPoints
from diffcloth_torch.tasks.registry import load_task

CONFIGS = Path(__file__).resolve().parents[1] / "configs"


@dataclass(frozen=True)
class Experiment:
    """A configuration, its assignments for zero friction, and its assignments for a short form."""

    config: str
    frictionless: tuple[str, ...]
    short: tuple[str, ...]


EXPERIMENTS = {
    "tie": Experiment(
        "tie.yaml",
        ("scene.cloths.tie.material.friction=0", "scene.bodies.neck.friction=0"),
        (
            "scene.cloths.tie.shape.rows=3",
            "scene.cloths.tie.shape.columns=40",
            "scene.cloths.tie.soft_pins={narrow: {vertices: [0, 40, 80]}, "
            "wide: {vertices: [39, 79, 119]}}",
            "simulation.steps=10",
        ),
    ),
    "cloth_on_cube": Experiment(
        "cloth_on_cube.yaml",
        ("scene.cloths.cloth.material.friction=0", "scene.bodies.cube.friction=0"),
        (
            "scene.cloths.cloth.shape={kind: grid, rows: 9, columns: 9, size: 0.5}",
            "scene.cloths.cloth.soft_pins={corner_0: {vertices: [0]}, corner_1: {vertices: [8]}, "
            "corner_2: {vertices: [72]}, corner_3: {vertices: [80]}}",
            "simulation.dt=0.1",
            "simulation.steps=12",
        ),
    ),
}
"""Name -> what is run."""

METHODS: dict[str, tuple[str, ...]] = {
    "projective": ("simulation.scheme=projective",),
    "split": ("simulation.scheme=split", "simulation.solver.metric=elastic"),
    "coupled, frictionless": (),
    "coupled": (),
}
"""Name -> what it changes in the configuration."""


@dataclass(frozen=True)
class Run:
    """Results of one configuration; the attributes are the columns of the table."""

    states: list[dc.State]
    pairs: list[int]
    stuck: int
    distance: float
    turns: float | None
    stretch: float
    iterations: int
    seconds: float
    error: str | None

    def row(self) -> list[str]:
        return [
            f"{max(self.pairs)}",
            f"{sum(count > 0 for count in self.pairs)} of {len(self.pairs)}",
            f"{self.stuck}",
            f"{1e3 * self.distance:.1f}",
            "-" if self.turns is None else f"{self.turns:.1f}",
            f"{self.stretch:.2f}",
            f"{self.iterations / max(1, len(self.states) - 1):.1f}",
            f"{self.seconds:.0f}",
        ]


COLUMNS = (
    "pairs",
    "states",
    "stuck",
    "distance [mm]",
    "turns",
    "stretch",
    "iterations a step",
    "time [s]",
)


def play(task: ControlPoints) -> Run:
    """Simulate a task to its end, or until a step raises."""
    crossings = Crossings(task.scene)
    with torch.no_grad():
        controller = task.controller(task.actions())
        states = [task.initial_state()]
        pairs, error, seconds = [crossings.count(states[0])], None, 0.0
        for k in tqdm(range(task.steps), disable=None, leave=False):
            start = time.process_time()
            try:
                states.append(task.simulator.step(states[-1], controller(k, states[-1])))
            except dc.SimulationError as failure:
                error = f"step {k}: {failure}"
                break
            finally:
                seconds += time.process_time() - start
            pairs.append(crossings.count(states[-1]))
    reports = [state.report for state in states[1:]]
    unconverged = sum(not report.converged for report in reports)
    return Run(
        states=states,
        pairs=pairs,
        stuck=unconverged + task.steps - len(reports),
        distance=task.distances(states[-1]).max().item(),
        turns=turns(task, states[-1]),
        stretch=max(stretch(task.scene, state) for state in states),
        iterations=sum(report.iterations for report in reports),
        seconds=seconds,
        error=error,
    )


def stretch(scene: dc.Scene, state: dc.State) -> float:
    """Length of the edge that is stretched most, over its length at rest."""
    first, largest = 0, 0.0
    for cloth in scene.cloths:
        ends = cloth.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        lengths = [
            np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1)
            for points in (state.positions.numpy()[first:], cloth.rest_positions)
        ]
        largest = max(largest, float((lengths[0] / lengths[1]).max()))
        first += len(cloth.vertices)
    return largest


def turns(task: ControlPoints, state: dc.State) -> float | None:
    """Turns of the ends of the first cloth around each other; None if the cloth is no strip.

    The strip's middle line is cut at the middle of the bend.
    """
    shape = task.config.scene.cloths[0].shape
    if shape.kind != "strip":
        return None
    points = state.positions.numpy()[: shape.rows * shape.columns]
    line = points.reshape(shape.rows, shape.columns, 3).mean(axis=0)
    middle = round(shape.middle * shape.columns)
    return abs(linking(line[:middle], line[middle:]))


def linking(a: np.ndarray, b: np.ndarray) -> float:
    """The linking integral of Gauss of two polygons, [n, 3] and [m, 3].

    The result is an integer if both are closed, and approximately the number of turns for two ends
    wound around each other. The directions from points of one segment to points of another cover
    the solid angle of a quadrilateral whose corners are the directions between their ends.

    References:
        Klenin and Langowski, Computation of writhe in modeling of supercoiled DNA, 2000, method 1a.
    """
    between = b[None, :] - a[:, None]
    corners = [between[:-1, :-1], between[:-1, 1:], between[1:, 1:], between[1:, :-1]]
    normals = [np.cross(corners[k], corners[(k + 1) % 4]) for k in range(4)]
    normals = [n / np.linalg.norm(n, axis=-1, keepdims=True) for n in normals]
    cosines = [(normals[k] * normals[(k + 1) % 4]).sum(axis=-1) for k in range(4)]
    angle = sum(np.arcsin(np.clip(cosine, -1, 1)) for cosine in cosines)
    across = np.cross(np.diff(b, axis=0)[None, :], np.diff(a, axis=0)[:, None])
    return float((angle * np.sign((across * corners[0]).sum(axis=-1))).sum() / (4 * np.pi))


def draw(experiment: Experiment, states: list[dc.State], path: Path) -> None:
    """Draw states of an experiment side by side."""
    pictures = {"video": "none", "sheet": len(states), "size": "[480, 560]"}
    changes = [f"output.pictures.{key}={value}" for key, value in pictures.items()]
    task = load_task(
        CONFIGS / experiment.config, [*changes, "output.viewers=[record]", "output.every=1"]
    )
    with tempfile.TemporaryDirectory() as folder:
        with open_viewers(task.config, task.scene, Path(folder), task.goals()) as viewers:
            for state in states:
                viewers.show(state)
        shutil.copyfile(Path(folder) / "animation.png", path)


def table(title: str, columns: Sequence[str], rows: Sequence[tuple[str, list[str]]]) -> str:
    """A table in Markdown."""
    lines = ["", f"| {title} | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    lines += [f"| {name} | {' | '.join(cells)} |" for name, cells in rows]
    return "\n".join(lines)


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option("--only", type=click.Choice(list(EXPERIMENTS)), help="One of the experiments.")
@click.option(
    "--method", "methods", multiple=True, type=click.Choice(list(METHODS)), help="By default all."
)
@click.option("--quick", is_flag=True, help="Small meshes and few steps.")
@click.option(
    "--pictures",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder for a picture of each experiment: the start, then the end by each method.",
)
def main(only: str | None, methods: tuple[str, ...], quick: bool, pictures: Path | None) -> None:
    torch.set_num_threads(1)
    for name in [only] if only else EXPERIMENTS:
        experiment = EXPERIMENTS[name]
        rows, ends, errors = [], [], []
        for method in methods or METHODS:
            assignments = [*METHODS[method], "simulation.solver.throw=false"]
            assignments += experiment.frictionless if "frictionless" in method else ()
            assignments += experiment.short if quick else ()
            task = load_task(CONFIGS / experiment.config, assignments)
            run = play(task)
            rows.append((method, run.row()))
            errors += [f"{method}, {run.error}"] if run.error else []
            ends += [run.states[0], run.states[-1]] if not ends else [run.states[-1]]
        click.echo(table(name, COLUMNS, rows))
        click.echo("".join(f"\n{error}" for error in errors), nl=bool(errors))
        if pictures is not None:
            draw(experiment, ends, pictures / f"{name}.png")


if __name__ == "__main__":
    main()
