"""One start of a fit: its stages, one after the other, and its end; several in processes."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.optimize.methods import Options, solve
from diffcloth_torch.optimize.problem import FAILURES, Failure, Memory, Problem, Residuals, Trial
from diffcloth_torch.optimize.series import Layout
from diffcloth_torch.optimize.variables import Space
from diffcloth_torch.processes import Pool
from diffcloth_torch.reprs import dataclass_text
from diffcloth_torch.worker import note_progress

__all__ = ["End", "Job", "Stage", "Start", "judge", "run", "run_all"]

# Two ends are the same minimum if they are closer than this share of a standard error plus this
# share of their size.
_SAME_ERROR, _SAME_SIZE = 0.1, 1e-4


@dataclass(frozen=True, eq=False)
class Stage:
    """A part of a fit, with its own residuals; the next stage begins at its end.

    Attributes:
        residuals: Function of the residuals, as in `fit`.
        free: Names of the variables that the stage changes; None means all free variables.
        tolerance: Relative change of the cost or the variables at which the stage ends, > 0; None
            uses the tolerance of the fit.
    """

    residuals: Residuals
    free: Sequence[str] | None = None
    tolerance: float | None = None


@dataclass(frozen=True, eq=False)
class Start:
    """First values and end of one start of a fit.

    Attributes:
        first: First values of all variables.
        values: Values at the end; the values of `first` if the simulation failed there.
        cost: Half the sum of squares at the end, priors included; infinite if the simulation
            failed.
        evaluations: Number of evaluations of the residuals.
        success: Whether the solver converged in every stage.
        message: Reason of the end.
        apart: Reason why the start did not end at the best minimum; empty if it did.
    """

    first: dict[str, Tensor]
    values: dict[str, Tensor]
    cost: float
    evaluations: int
    success: bool
    message: str
    apart: str

    __repr__ = dataclass_text


@dataclass(frozen=True, eq=False)
class Job:
    """Common data of the starts of a fit; may be sent to another process.

    Attributes:
        space: The searched space.
        stages: One or more stages; the last stage frees all variables.
        options: Options of the solver of each stage.
        folder: Folder of saved evaluations, or None.
        threads: Number of threads of torch, on which rounding in its larger sums depends.
    """

    space: Space
    stages: list[Stage]
    options: Options
    folder: Path | None
    threads: int


@dataclass(frozen=True, eq=False)
class End:
    """The end of a start.

    Attributes:
        start: Index of the start.
        first: First theta.
        theta: Theta at the end.
        cost: Half the sum of squares; infinite if the simulation failed at the first values of a
            stage.
        residuals: Residuals at the end, without priors.
        jacobian: Jacobian of these residuals.
        success: Whether the solver converged in every stage.
        message: Reason of the end.
        history: Evaluations of the start.
        layout: Blocks and series of the residuals.
        failure: The error of a failure.
    """

    start: int
    first: FloatArray
    theta: FloatArray
    cost: float
    residuals: FloatArray
    jacobian: FloatArray
    success: bool
    message: str
    history: list[Trial]
    layout: Layout | None
    failure: Failure | None


def run(job: Job, start: int, first: FloatArray, report: Callable[[Trial], None]) -> End:
    """Run all stages of a start."""
    space, at, history, success = job.space, first, list[Trial](), True
    described = [space.described(), [float(x) for x in first], job.options.described()]
    file = None if job.folder is None else job.folder / f"start_{start}.pt"
    memory = Memory(file, described)
    for k, stage in enumerate(job.stages):
        rows = _rows(space, stage)
        problem = Problem(
            space,
            stage.residuals,
            at=at,
            rows=rows,
            start=start,
            stage=k,
            memory=memory,
            report=report,
        )
        problem.history = history
        tolerance = job.options.tolerance if stage.tolerance is None else stage.tolerance
        options = replace(job.options, tolerance=tolerance)
        try:
            problem.require(at[rows])
            end = solve(problem, at[rows], space.low[rows], space.high[rows], options)
        except FAILURES as error:
            nothing = np.zeros(0)
            return End(
                start, first, at, np.inf, nothing, nothing, False, str(error), history, None, error
            )
        at = at.copy()
        at[rows] = end.theta
        success = success and end.success
    data = len(end.residuals) - problem.prior_count
    return End(
        start=start,
        first=first,
        theta=at,
        cost=end.cost,
        residuals=end.residuals[:data],
        jacobian=end.jacobian[:data],
        success=success,
        message=end.message,
        history=history,
        layout=problem.layout,
        failure=None,
    )


def run_all(
    job: Job,
    firsts: Sequence[FloatArray],
    workers: int | Executor,
    deadline: float,
    report: Callable[[Trial], None],
) -> list[End]:
    """Run all starts, here or in processes; a start has the same result in any process."""
    if workers == 0:
        return [run(job, k, first, report) for k, first in enumerate(firsts)]
    try:
        pickle.dumps(job)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InvalidInput(
            "fit: with `workers`, `residuals` must be a function of a module, or an object that "
            f"can be pickled: {error}"
        ) from error
    ends = []
    with closing(_remote(job, firsts, workers, deadline)) as remote:
        for end in remote:
            for trial in end.history:
                report(trial)
            ends.append(end)
    return ends


def _remote(
    job: Job, firsts: Sequence[FloatArray], workers: int | Executor, deadline: float
) -> Generator[End, None, None]:
    work = partial(_work, job)
    if not isinstance(workers, int):
        yield from workers.map(work, enumerate(firsts))
        return
    pool = Pool("fit: `workers`", workers, deadline)
    try:
        yield from pool.map(work, [*enumerate(firsts)])
    finally:
        pool.close()


def _work(job: Job, start: tuple[int, FloatArray]) -> End:
    before = torch.get_num_threads()
    torch.set_num_threads(job.threads)
    try:
        # The caller reports the trials after the end of the start.
        return run(job, *start, lambda _: note_progress())
    finally:
        torch.set_num_threads(before)


def judge(space: Space, ends: Sequence[End], best: End, deviations: FloatArray) -> list[Start]:
    """Describe each start; `apart` holds the reason why its end differs from the best minimum."""
    return [
        Start(
            first=space.values(torch.from_numpy(end.first.copy())),
            values=space.values(torch.from_numpy(end.theta.copy())),
            cost=end.cost,
            evaluations=len(end.history),
            success=end.success,
            message=end.message,
            apart=_apart(space, end, best, deviations),
        )
        for end in ends
    ]


def _apart(space: Space, end: End, best: End, deviations: FloatArray) -> str:
    if end.failure is not None:
        where = "its first values" if len(end.history) == 1 else "the first values of a stage"
        return f"the simulation failed at {where}: {end.failure}"
    near = _SAME_ERROR * deviations + _SAME_SIZE * space.units(best.theta)
    far = np.abs(end.theta - best.theta) / near
    if (far <= 1.0).all():
        return ""
    name = space.names[int(far.argmax())]
    if not end.success:
        return f"it had not converged after {len(end.history)} evaluations, {name} most of all"
    bounds = space.at_bounds(end.theta)
    at = f", with {bounds[0]} at its bound" if bounds else ""
    return f"another minimum: cost {end.cost:.6g} instead of {best.cost:.6g}, {name} differs{at}"


def _rows(space: Space, stage: Stage) -> NDArray[np.int64]:
    if stage.free is None:
        return np.arange(len(space))
    return np.array([i for name in stage.free for i in space.rows(name)], dtype=np.int64)
