"""The command `diffcloth optimize`: optimize actions, and resume an optimization."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.cli.results import (
    METRICS,
    RESUME,
    check_folder,
    check_places,
    clear,
    read_actions,
    replace_file,
    resumed_from,
    step_records,
    values_used,
    write_metrics,
)
from diffcloth_torch.config.documents import set_values
from diffcloth_torch.config.viewers import open_viewers
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.optimize.descent import Descent
from diffcloth_torch.tasks.optimization import optimize as run_optimization
from diffcloth_torch.tasks.optimization import position_gradients
from diffcloth_torch.tasks.registry import TASKS, check_document, load_task, make_task
from diffcloth_torch.tasks.task import Actions, OptimizableTask
from diffcloth_torch.viewers.curves import draw_loss_curve, require_matplotlib

__all__ = ["optimize", "resume"]

# Sections that may change when an optimization continues; others would change earlier results.
_RESUMABLE = ("optimizer", "output")


def optimize(
    config: Path,
    assignments: Iterable[str] = (),
    out: Path | None = None,
    *,
    overwrite: bool = False,
    actions: Path | None = None,
) -> str:
    """Optimize the actions of a configuration, and show the best of them.

    Arguments and errors are those of `run`.
    """
    out = check_folder(config, out, overwrite)
    task = load_task(config, assignments)
    if not isinstance(task, OptimizableTask):
        able = ", ".join(name for name, kind in TASKS.items() if issubclass(kind, OptimizableTask))
        raise InvalidInput(
            f"{config}: the task {task.config.task!r} has nothing to optimize: use "
            f"`diffcloth run`; tasks that have are {able}"
        )
    start = read_actions(task, actions)
    clear(out)
    return _optimize(task, config, out, start, None)


def resume(folder: Path, assignments: Iterable[str] = ()) -> str:
    """Continue an optimization that was interrupted, or now has more iterations.

    The result has the same bits as without the interruption, if the build and the type of machine
    are the same.

    Args:
        folder: Folder of its results.
        assignments: "key=value" each, of the sections `optimizer` and `output`.

    Raises:
        InvalidInput: If the folder has no such results, or an assignment changes another section.
    """
    check_places(folder)
    with resumed_from(folder, RESUME, "optimize") as file:
        saved = torch.load(file, map_location=cpu.DEVICE, weights_only=True)
        document, source = saved["config"], Path(saved["source"])
        start = {name: tensor.requires_grad_() for name, tensor in saved["start"].items()}
        record = saved["found"]
        found = None if record is None else Descent.restore(record)
    for assignment in assignments:
        if assignment.partition(".")[0] not in _RESUMABLE:
            raise InvalidInput(
                f"--set with --resume: the key must be in {' or '.join(_RESUMABLE)}, "
                f"got {assignment!r}"
            )
    task = make_task(check_document(set_values(document, assignments), source), source)
    assert isinstance(task, OptimizableTask)
    return _optimize(task, source, folder, start, found)


def _optimize(
    task: OptimizableTask, source: Path, out: Path, start: Actions, found: Descent | None
) -> str:
    # Before the long computation, because a package may be missing.
    require_matplotlib()
    viewers = open_viewers(task.config, task.scene, out, task.goals())

    # After every iteration, so that an interruption loses only the current one.
    def keep(sofar: Descent) -> None:
        nonlocal found
        found = sofar
        _write_optimization(task, sofar, out)
        _write_resume(task, source, start, sofar, out)

    try:
        _write_resume(task, source, start, found, out)
        found = run_optimization(task, report=keep, start=start, found=found)
    except KeyboardInterrupt as error:
        done = 0 if found is None else len(found.history)
        best = "" if found is None else f", the best with a loss of {found.best.loss:.5f}"
        raise KeyboardInterrupt(
            f"in iteration {done}: {out} has {done} finished iterations{best}; go on with  "
            f"diffcloth optimize --resume {out}"
        ) from error
    draw_loss_curve(out / "loss.png", found.metrics()["losses"])
    # Only pages show them, and they cost another rollout.
    gradients: list[Tensor | None] = [None] * len(found.best.states)
    if "web" in task.config.output.viewers:
        gradients = [*position_gradients(task, found.best.variables)]
    with viewers:
        viewers.show(task.initial_state())
        for state, gradient in zip(found.best.states, gradients, strict=True):
            viewers.show(state, gradient)
    return (
        f"loss {found.first.loss:.5f} -> {found.best.loss:.5f} in {len(found.history)} iterations, "
        f"{found.seconds:.1f} s; results are in {out}"
    )


def _write_optimization(task: OptimizableTask, found: Descent, out: Path) -> None:
    metrics = {
        "task": task.config.task,
        **found.metrics(),
        "per_step_of_best": step_records(found.best.states),
        **values_used(task),
    }
    write_metrics(out / METRICS, metrics)
    torch.save({"best": found.best.variables, "initial": found.first.variables}, out / "actions.pt")
    arrays: dict[str, Any] = {name: a.numpy() for name, a in found.best.variables.items()}
    np.savez(out / "actions.npz", **arrays)


def _write_resume(
    task: OptimizableTask, source: Path, start: Actions, found: Descent | None, out: Path
) -> None:
    saved = {
        "config": task.config.model_dump(mode="json"),
        "source": str(source.resolve()),
        "start": {name: tensor.detach() for name, tensor in start.items()},
        "found": None if found is None else found.record(),
    }
    with replace_file(out / RESUME) as part:
        torch.save(saved, part)
