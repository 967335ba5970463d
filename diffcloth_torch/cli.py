"""The command line: run, optimize, info."""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Callable, Sequence
from functools import wraps
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import click
import numpy as np
import torch

from diffcloth_torch import build_info
from diffcloth_torch.config.viewers import open_viewers
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.sim.state import State
from diffcloth_torch.tasks.optimization import Optimization, optimize
from diffcloth_torch.tasks.registry import TASKS, load_task
from diffcloth_torch.tasks.simulation import simulate
from diffcloth_torch.tasks.statistics import rollout_statistics, step_records, write_metrics
from diffcloth_torch.tasks.task import Optimizable, Task
from diffcloth_torch.viewers.curves import draw_loss_curve

__all__ = ["main"]

_SIMULATION_FAILED, _BAD_INPUT = 1, 2  # exit codes

# What a run or its pictures need beyond Python; `info` says which of them are there.
_PACKAGES = ("torch", "numpy", "trimesh", "matplotlib", "pyvista", "imageio", "imageio-ffmpeg")

C = TypeVar("C", bound=Callable[..., Any])


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="diffcloth-torch", prog_name="diffcloth")
def main() -> None:
    """Differentiable cloth with intersection-free contact."""


def _configured(command: C) -> C:
    """Give a command its configuration and options, and end its errors with one sentence."""

    @wraps(command)
    def guarded(config: Path, assignments: tuple[str, ...], out: Path | None, debug: bool) -> None:
        folder = Path("results") / config.stem if out is None else out
        try:
            command(config, assignments, folder)
        except (InvalidInput, TypeError, OSError) as error:
            _end(error, _BAD_INPUT, debug)
        except SimulationError as error:
            _end(error, _SIMULATION_FAILED, debug)

    options = (
        click.argument("config", type=click.Path(path_type=Path)),
        click.option(
            "--set",
            "assignments",
            metavar="KEY=VALUE",
            multiple=True,
            help="Change a value of the configuration: simulation.steps=50. Repeatable.",
        ),
        click.option(
            "--out",
            type=click.Path(path_type=Path, file_okay=False),
            help="Folder for the results; by default results/ and the name of CONFIG.",
        ),
        click.option("--debug", is_flag=True, help="Show the traceback of an error."),
    )
    for option in reversed(options):
        guarded = option(guarded)
    return guarded  # type: ignore[return-value]


def _end(error: Exception, code: int, debug: bool) -> None:
    if debug:
        raise error
    click.echo(f"Error: {' '.join(str(error).split())}", err=True)
    sys.exit(code)


@main.command()
@_configured
def run(config: Path, assignments: Sequence[str], out: Path) -> None:
    """Simulate CONFIG without optimizing."""
    task = load_task(config, assignments)
    out.mkdir(parents=True, exist_ok=True)
    states: list[State] = []
    start = time.perf_counter()
    try:
        with open_viewers(task.config, task.scene, out, task.goals()) as viewers:
            for state in simulate(task):
                viewers.show(state)
                states.append(state)
            seconds = time.perf_counter() - start
    except SimulationError as error:
        after = f"step {len(states) - 1}" if states else "the start"
        _write_run(task, states[1:], out, time.perf_counter() - start, str(error))
        raise type(error)(f"{config}: {error} (after {after})", report=error.report) from error
    _write_run(task, states[1:], out, seconds)
    click.echo(f"{len(states) - 1} steps in {seconds:.1f} s; results are in {out}")


def _write_run(
    task: Task, states: Sequence[State], out: Path, seconds: float, error: str | None = None
) -> None:
    metrics = {
        "task": task.config.task,
        "seconds": seconds,
        "error": error,
        **rollout_statistics(states),
        "per_step": step_records(states),
        "config": task.config.model_dump(mode="json"),
    }
    write_metrics(out / "metrics.json", metrics)


@main.command("optimize")
@_configured
def optimize_command(config: Path, assignments: Sequence[str], out: Path) -> None:
    """Optimize the actions of CONFIG, and show the best of them."""
    task = load_task(config, assignments)
    if not isinstance(task, Optimizable):
        able = ", ".join(name for name, kind in TASKS.items() if hasattr(kind, "loss"))
        raise InvalidInput(
            f"{config}: the task {task.config.task!r} has nothing to optimize: use "
            f"`diffcloth run`; tasks that have are {able}"
        )
    out.mkdir(parents=True, exist_ok=True)
    # Before the long part: a package may be missing.
    viewers = open_viewers(task.config, task.scene, out, task.goals())
    # After every iteration, so that an interrupted run leaves what it found.
    found = optimize(task, report=lambda sofar: _write_optimization(task, sofar, out))
    draw_loss_curve(out / "loss.png", found.metrics()["losses"])
    with viewers:
        for state in [task.initial_state(), *found.best.states]:
            viewers.show(state)
    click.echo(
        f"loss {found.first.loss:.5f} -> {found.best.loss:.5f} in {len(found.history)} iterations, "
        f"{found.seconds:.1f} s; results are in {out}"
    )


def _write_optimization(task: Task, found: Optimization, out: Path) -> None:
    metrics = {
        "task": task.config.task,
        **found.metrics(),
        "per_step_of_best": step_records(found.best.states),
        "config": task.config.model_dump(mode="json"),
    }
    write_metrics(out / "metrics.json", metrics)
    torch.save({"best": found.best.actions, "initial": found.first.actions}, out / "actions.pt")
    arrays: dict[str, Any] = {name: a.numpy() for name, a in found.best.actions.items()}
    np.savez(out / "actions.npz", **arrays)


@main.command()
def info() -> None:
    """Say what was built in, and which packages are there."""
    rows: dict[str, Any] = {
        "diffcloth-torch": _version("diffcloth-torch"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        **{package: _version(package) for package in _PACKAGES},
        "torch threads": torch.get_num_threads(),
        "tasks": ", ".join(TASKS),
    }
    rows |= {f"core: {name}": value for name, value in build_info().items()}
    width = max(map(len, rows))
    for name, value in rows.items():
        click.echo(f"{name:<{width}}  {value}")


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
