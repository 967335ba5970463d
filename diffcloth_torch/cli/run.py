"""The command `diffcloth run`: simulate a configuration without optimizing."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from diffcloth_torch.cli.results import (
    METRICS,
    check_folder,
    clear,
    read_actions,
    results_folder,
    step_records,
    values_used,
    write_metrics,
)
from diffcloth_torch.config.viewers import open_viewers
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.optimize.statistics import rollout_statistics
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.records.trajectory import Trajectory, check_ending
from diffcloth_torch.tasks.registry import load_task
from diffcloth_torch.tasks.simulation import simulate
from diffcloth_torch.tasks.task import Actions, ConfiguredTask

__all__ = ["run"]


def run(
    config: Path,
    assignments: Iterable[str] = (),
    out: Path | None = None,
    *,
    overwrite: bool = False,
    actions: Path | None = None,
    save: Path | None = None,
) -> str:
    """Simulate a configuration without optimizing.

    Args:
        config: YAML file.
        assignments: "key=value" each, see `set_values`.
        out: Folder for the results; by default results/ and the name of `config`.
        overwrite: If true, replace existing results.
        actions: File `actions.npz` of a run with actions to use instead of the initial ones.
        save: File for all states, including the first one; see `Trajectory.save`.

    Raises:
        InvalidInput: If an argument or the configuration is not accepted.
        SimulationError: If a step fails; earlier results are kept.
        KeyboardInterrupt: If the user ends the run; the message lists the results that are kept.
    """
    check_folder(config, out, overwrite)
    if save is not None:
        _check_target(save, overwrite)
    task = load_task(config, assignments)
    start_actions = read_actions(task, actions)
    with results_folder(config, out, overwrite) as folder:
        return _simulate(task, start_actions, config, folder, save)


def _simulate(
    task: ConfiguredTask, actions: Actions, config: Path, out: Path, save: Path | None
) -> str:
    states: list[State] = []
    start = time.perf_counter()
    try:
        clear(out)
        with open_viewers(task.config, task.scene, out, task.goals()) as viewers:
            for state in simulate(task, actions):
                viewers.show(state)
                states.append(state)
            seconds = time.perf_counter() - start
    except SimulationError as error:
        after = _after(states)
        _write_run(task, states[1:], out, time.perf_counter() - start, str(error))
        raise type(error)(f"{config}: {error} ({after})", report=error.report) from error
    except KeyboardInterrupt as error:
        after = _after(states)
        _write_run(task, states[1:], out, time.perf_counter() - start, f"interrupted {after}")
        raise KeyboardInterrupt(
            f"{after} of {task.steps}: {out / METRICS} has the steps so far; the same command "
            "with --overwrite starts again"
        ) from error
    _write_run(task, states[1:], out, seconds)
    if save is not None:
        Trajectory(states).save(save)
    return f"{len(states) - 1} steps in {seconds:.1f} s; results are in {out}"


def _check_target(save: Path, overwrite: bool) -> None:
    """Refuse, before the work, a file that cannot be written."""
    check_ending("--save", save)
    if save.exists() and not overwrite:
        raise InvalidInput(f"--save: {save} exists already: --overwrite replaces it")
    if not save.parent.is_dir():
        raise InvalidInput(f"--save: there is no folder {save.parent}")


def _after(states: Sequence[State]) -> str:
    return f"after step {len(states) - 1}" if states else "after the start"


def _write_run(
    task: ConfiguredTask,
    states: Sequence[State],
    out: Path,
    seconds: float,
    error: str | None = None,
) -> None:
    metrics = {
        "task": task.config.task,
        "seconds": seconds,
        "error": error,
        **rollout_statistics(states),
        "per_step": step_records(states),
        **values_used(task),
    }
    write_metrics(out / METRICS, metrics)
