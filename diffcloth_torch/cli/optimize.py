"""The command `diffcloth optimize`: optimize actions, and resume an optimization."""

from __future__ import annotations

from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checkpoint import check_like, check_optimizer, refusing_damage
from diffcloth_torch.cli.results import (
    METRICS,
    RESUME,
    check_folder,
    clear,
    read_actions,
    results_folder,
    resumed_folder,
    step_records,
    values_used,
    write_metrics,
    write_resume,
)
from diffcloth_torch.config.documents import set_values
from diffcloth_torch.config.viewers import open_viewers
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import replace_file
from diffcloth_torch.optimize.descent import Descent
from diffcloth_torch.tasks.optimization import optimize as run_optimization
from diffcloth_torch.tasks.optimization import position_gradients
from diffcloth_torch.tasks.registry import TASKS, check_document, load_task, make_task
from diffcloth_torch.tasks.task import Actions, ConfiguredTask, OptimizableTask
from diffcloth_torch.viewers.curves import draw_loss_curve, require_matplotlib

__all__ = ["optimize", "resume"]

# Sections that may change when an optimization is resumed; others would change earlier results.
_RESUMABLE = ("optimizer", "output")


def optimize(
    config: Path,
    assignments: Iterable[str] = (),
    out: Path | None = None,
    *,
    overwrite: bool = False,
    actions: Path | None = None,
) -> str:
    """Optimize the actions of a configuration, and show the best ones.

    Arguments and errors are as for `run`.
    """
    check_folder(config, out, overwrite, "optimize")
    task = load_task(config, assignments)
    if not isinstance(task, OptimizableTask):
        able = ", ".join(name for name, kind in TASKS.items() if issubclass(kind, OptimizableTask))
        raise InvalidInput(
            f"{config}: the task {task.config.task!r} has nothing to optimize: use "
            f"`diffcloth run`; tasks that have are {able}"
        )
    start = read_actions(task, actions)
    with results_folder(config, out, overwrite, "optimize") as folder:
        clear(folder)
        return _optimize(task, config, folder, start, None)


def resume(folder: Path, assignments: Iterable[str] = ()) -> str:
    """Resume an optimization that was interrupted, or that now has more iterations.

    The result has the same bits as without the interruption on the same build and type of machine.

    Args:
        folder: Folder of its results.
        assignments: "key=value" each, of the sections `optimizer` and `output`.

    Raises:
        InvalidInput: If the folder has no such results, another process uses it, or an assignment
            changes another section.
    """
    with resumed_folder(folder, "optimize") as kept:
        source = kept["source"]
        for assignment in assignments:
            if assignment.partition(".")[0] not in _RESUMABLE:
                raise InvalidInput(
                    f"--set with --resume: the key must be in {' or '.join(_RESUMABLE)}, "
                    f"got {assignment!r}"
                )
        task = make_task(check_document(set_values(kept["config"], assignments), source), source)
        with refusing_damage("--resume", folder / RESUME):
            start, found = _checked(task, kept)
        assert isinstance(task, OptimizableTask)
        return _optimize(task, source, folder, start, found)


def _checked(task: ConfiguredTask, kept: dict[str, Any]) -> tuple[Actions, Descent | None]:
    """Return the first actions and the results so far from a file.

    Raises:
        InvalidInput: If they do not belong to the task.
    """
    example = {name: tensor.detach() for name, tensor in task.actions().items()}
    check_like("the first actions", kept["start"], example)
    start = {name: tensor.requires_grad_() for name, tensor in kept["start"].items()}
    if kept["found"] is None:
        return start, None
    found = Descent.restore(kept["found"])
    check_like("the next actions", found.next_variables, example)
    check_like("the best rows", [found.best_rows, found.best_losses], [{}, cpu.zeros(0)])
    # Independent of the momentum of the file and of the configuration.
    momenta = torch.optim.SGD([t.clone() for t in example.values()], lr=0.0, momentum=0.9)
    groups = momenta.state_dict()["param_groups"]
    state = {
        key: {name: value for name, value in entry.items() if value is not None}
        for key, entry in found.optimizer["state"].items()
    }
    entries = {key: entry for key, entry in state.items() if entry}
    check_optimizer("the optimizer", {"state": entries, "param_groups": groups}, momenta)
    if len(found.best.states) != task.steps:
        raise InvalidInput(f"there must be {task.steps} states, got {len(found.best.states)}")
    for k, state_after in enumerate(found.best.states):
        task.simulator.kinetic_energy(state_after)  # checks the state
        if state_after.report is None or state_after.batch_size is not None:
            raise InvalidInput(f"the state after step {k} must be one of a rollout")
    return start, found


def _optimize(
    task: OptimizableTask, source: Path, out: Path, start: Actions, found: Descent | None
) -> str:
    # Before the long computation, because a package may be missing.
    require_matplotlib()
    viewers = open_viewers(task.config, task.scene, out, task.goals())

    # After each iteration, so that an interruption loses only the current one.
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
    # Only pages show gradients, which cost another rollout.
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
    # torch reports a full disk as a RuntimeError if it writes the file itself.
    archive = BytesIO()
    torch.save({"best": found.best.variables, "initial": found.first.variables}, archive)
    with replace_file(out / "actions.pt") as part:
        part.write_bytes(archive.getbuffer())
    arrays: dict[str, Any] = {name: a.numpy() for name, a in found.best.variables.items()}
    with replace_file(out / "actions.npz") as part, part.open("wb") as file:
        np.savez(file, **arrays)


def _write_resume(
    task: OptimizableTask, source: Path, start: Actions, found: Descent | None, out: Path
) -> None:
    write_resume(
        out,
        "optimize",
        task.config.model_dump(mode="json"),
        source,
        start={name: tensor.detach() for name, tensor in start.items()},
        found=None if found is None else found.record(),
    )
