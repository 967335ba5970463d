"""The command `diffcloth fit`: fit a configuration to observations, and resume a fit."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from torch import Tensor
from tqdm import tqdm

from diffcloth_torch.cli.results import (
    clear,
    results_folder,
    resumed_folder,
    write_metrics,
    write_resume,
)
from diffcloth_torch.config.viewers import open_fitted
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.extras import from_extra
from diffcloth_torch.optimize.fit import Fit, Trial, fit
from diffcloth_torch.optimize.statistics import finite_or_none
from diffcloth_torch.tasks.identify import Identify
from diffcloth_torch.tasks.registry import check_document, load_task, make_task
from diffcloth_torch.viewers.fitted import FittedPage

__all__ = ["fit_configuration", "resume_fit"]

# Files in a folder of results. Evaluations are in a subfolder, one file for each start.
_RESULT, _PAGE, _EVALUATIONS = "fit.json", "fit.html", "evaluations"


def fit_configuration(
    config: Path,
    assignments: Iterable[str] = (),
    out: Path | None = None,
    *,
    overwrite: bool = False,
) -> str:
    """Fit the variables of a configuration to its observations.

    Arguments and errors are as for `run`.
    """
    task = load_task(config, assignments)
    if not isinstance(task, Identify):
        raise InvalidInput(
            f"{config}: `task` must be identify to fit something, got {task.config.task!r}"
        )
    with results_folder(config, out, overwrite, "fit") as folder:
        clear(folder)
        for file in (folder / _EVALUATIONS).glob("start_*.pt"):
            file.unlink()
        document = task.config.model_dump(mode="json", exclude_unset=True)
        write_resume(folder, "fit", document, config)
        return _run(task, folder)


def resume_fit(folder: Path) -> str:
    """Resume a fit that was interrupted; the result has the same bits.

    Args:
        folder: Folder of its results.

    Raises:
        InvalidInput: If the folder has no such results, or another process uses it.
    """
    with resumed_folder(folder, "fit") as kept:
        task = make_task(check_document(kept["config"], kept["source"]), kept["source"])
        if not isinstance(task, Identify):
            raise InvalidInput(f"--resume: {folder} must hold a fit, got {task.config.task!r}")
        return _run(task, folder)


def _run(task: Identify, out: Path) -> str:
    # Before the long computation, because a package may be missing.
    from_extra("matplotlib", "fit", "the page of a fit needs Matplotlib")
    page = open_fitted(task.config, task.observed.scenes(), out)
    with page or nullcontext(), _Progress(task, page) as bar:
        try:
            found = fit(
                task.variables(),
                task.residuals(),
                hold_out=task.hold_out(),
                resume=out / _EVALUATIONS,
                progress=bar.show,
                **task.options(),
            )
        except KeyboardInterrupt as error:
            raise KeyboardInterrupt(
                f"after {bar.count} evaluations, which are kept: go on with  "
                f"diffcloth fit --resume {out}"
            ) from error
    bias = _step_bias(task, found)
    write_metrics(out / _RESULT, _record(task, found) | {"step_bias": bias})
    found.report(out / _PAGE)
    lines = found.lines()
    lines += [
        f"a time step of zero would move {name} by {', '.join(f'{x:+.3g}' for x in shifts)}"
        for name, shifts in (bias or {}).items()
    ]
    lines += [f"cannot be told apart: {direction}" for direction in found.unidentifiable]
    lines += [f"nearly collinear: {pair}" for pair in found.collinear]
    lines += [f"start {k}: {start.apart}" for k, start in enumerate(found.starts) if start.apart]
    return "\n".join([*lines, f"{len(found.history)} evaluations; results are in {out}"])


def _step_bias(task: Identify, found: Fit) -> dict[str, list[float]] | None:
    """Shifts of each variable in the limit of a time step of zero; None if not estimated."""
    if not task.checks_step:
        return None
    shifts = found.step_bias(task.finer(task.observed), order=task.order)
    return {name: shift.reshape(-1).tolist() for name, shift in shifts.items()}


def _record(task: Identify, found: Fit) -> dict[str, Any]:
    return {
        "config": task.config.model_dump(mode="json"),
        "success": found.success,
        "message": found.message,
        "cost": found.cost,
        "values": {name: value.tolist() for name, value in found.values.items()},
        "names": found.names,
        "intervals": {n: [*map(finite_or_none, ends)] for n, ends in found.intervals.items()},
        "covariance": [[*map(finite_or_none, row)] for row in found.covariance.tolist()],
        "unidentifiable": [str(direction) for direction in found.unidentifiable],
        "collinear": [str(pair) for pair in found.collinear],
        "noise_model": found.noise_model,
        "rms": found.rms,
        "blocks": {
            name: {key: finite_or_none(value) for key, value in vars(block).items()}
            for name, block in found.blocks.items()
        },
        "held_out": found.held_out,
        "starts": [
            {
                "values": {name: value.tolist() for name, value in start.values.items()},
                "cost": finite_or_none(start.cost),
                "evaluations": start.evaluations,
                "apart": start.apart,
            }
            for start in found.starts
        ],
        "history": [
            {"start": t.start, "cost": finite_or_none(t.cost), "failure": t.failure}
            for t in found.history
        ],
    }


def _short(value: Tensor) -> str:
    return ", ".join(f"{x:.4g}" for x in value.flatten().tolist())


class _Progress:
    """A progress bar over evaluations, whose number is unknown; silent without a terminal.

    A page shows the best evaluation so far.
    """

    def __init__(self, task: Identify, page: FittedPage | None) -> None:
        self.count = 0
        self._task, self._page, self._lowest = task, page, float("inf")
        self._bar: tqdm[Any] = tqdm(desc="fit", unit="evaluation", disable=None)

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def show(self, trial: Trial) -> None:
        """Show an evaluation."""
        self.count += 1
        self._bar.set_postfix({"start": trial.start, "cost": f"{trial.cost:.5g}"}, refresh=False)
        self._bar.update()
        if self._page is not None and trial.cost < self._lowest:
            self._lowest = trial.cost
            text = [f"Evaluation {self.count} of the fit: cost {trial.cost:.5g}", ""]
            text += [f"- {name}: {_short(value)}" for name, value in trial.values.items()]
            self._page.show(self._task.observed.tracks(trial.values), "\n".join(text))
