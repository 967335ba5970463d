"""Fits of parameters to observations: nonlinear least squares with exact Jacobians.

The solver is SciPy's: a trust region within bounds (Branch, Coleman and Li, 1999). The Jacobian of
the residuals comes from tangents of the simulation, one for each number that is fitted.
"""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import (
    POSITIVE,
    FloatArray,
    Range,
    check_choice,
    check_count,
    check_number,
    refuse_threads,
)
from diffcloth_torch.errors import InvalidInput, warn_caller
from diffcloth_torch.extras import from_extra
from diffcloth_torch.files import as_path
from diffcloth_torch.lock import locked
from diffcloth_torch.model.quantities import PARAMETERS
from diffcloth_torch.optimize.fit_page import Page, write_page
from diffcloth_torch.optimize.methods import METHODS, Method, Options
from diffcloth_torch.optimize.problem import FAILURES, Residuals, Trial, parameters_of, trajectories
from diffcloth_torch.optimize.starts import Job, Stage, Start, judge, run_all
from diffcloth_torch.optimize.uncertainty import Direction, noise_of, uncertainty_of
from diffcloth_torch.optimize.variables import Space, Variable
from diffcloth_torch.processes import DEADLINE, LARGEST_WORKERS, LONGEST_DEADLINE
from diffcloth_torch.reprs import dataclass_text
from diffcloth_torch.sim.records.controls import Parameters

__all__ = ["Direction", "Fit", "Stage", "Start", "Trial", "fit"]

_LOSSES = ("linear", "soft_l1", "huber", "cauchy", "arctan")


@dataclass(frozen=True, eq=False)
class Fit:
    """The best of all starts.

    Standard errors follow from J^T J at the solution, with the noise that the residuals show, and
    from the priors. Where there are no more residuals than numbers they show none, and count as
    what they are meant to be: in units of their noise.

    Attributes:
        parameters: Parameters that hold the variables, None elsewhere.
        values: Values of all variables.
        names: Name of each number that was fitted.
        covariance: Of these numbers, [p, p].
        correlation: Likewise.
        intervals: Name of each number -> its interval of 95 %.
        unidentifiable: Directions that the observations do not tell, the worst first.
        residuals: At the solution [M], of the last stage, without priors.
        cost: Half the sum of their squares and of those of the priors.
        success: Whether the solver converged.
        message: How it ended.
        at_bounds: Names of the numbers that ended at a bound, where intervals mean little.
        starts: Where each start ended, and why not at the best place.
        held_out: Root mean square of the residuals of each trajectory that was kept out of the fit:
            about one if the model is right and the noise is known; one infinite number if the
            simulation fails there.
        history: All evaluations, start after start.
        compared: The residuals of the last stage, and those kept out, for the report.
    """

    parameters: Parameters
    values: dict[str, Tensor]
    names: list[str]
    covariance: FloatArray
    correlation: FloatArray
    intervals: dict[str, tuple[float, float]]
    unidentifiable: list[Direction]
    residuals: FloatArray
    cost: float
    success: bool
    message: str
    at_bounds: list[str]
    starts: list[Start]
    held_out: list[float]
    history: list[Trial] = field(repr=False)
    compared: list[Residuals] = field(repr=False)

    __repr__ = dataclass_text

    @property
    def failures(self) -> int:
        """Number of trial steps that were rejected."""
        return sum(bool(trial.failure) for trial in self.history)

    def report(self, path: str | Path) -> None:
        """Write a page that shows the fit: one file, which loads nothing.

        It has the values with their intervals, the correlation, the residuals over time, the worst
        marker, the first and the last values beside what was observed, and the starts. For this,
        the residuals are evaluated at the last values, and at the first ones of the first start
        that could be simulated.

        Args:
            path: File that ends in ".html".

        Raises:
            InvalidInput: If it ends otherwise.
            SimulationError: If the simulation fails.
        """
        file = as_path("Fit.report: `path`", path)
        if file.suffix != ".html":
            raise InvalidInput(f'Fit.report: `path` must end in ".html", got {str(path)!r}')
        write_page(
            file,
            Page(
                names=self.names,
                values=self.values,
                first=next(s.first for s in self.starts if np.isfinite(s.cost)),
                intervals=self.intervals,
                correlation=self.correlation,
                unidentifiable=[str(direction) for direction in self.unidentifiable],
                rms=float(np.sqrt(np.square(self.residuals).mean())),
                message=self.message,
                starts=self.starts,
                history=self.history,
                held_out=self.held_out,
                residuals=self.compared,
            ),
        )


def fit(
    variables: Mapping[str, Variable],
    residuals: Residuals | Sequence[Stage],
    *,
    method: Method = "least_squares",
    starts: int = 1,
    seed: int = 0,
    loss: str = "linear",
    loss_scale: float = 1.0,
    max_evaluations: int = 100,
    tolerance: float = 1e-8,
    hold_out: Residuals | None = None,
    workers: int | Executor = 0,
    deadline: float = DEADLINE,
    resume: str | Path | None = None,
    progress: Callable[[Trial], None] = lambda _: None,
) -> Fit:
    """Fit variables to observations.

    >>> fit = dc.fit({"stretch": dc.Variable(300.0)}, residuals)
    >>> fit.values["stretch"], fit.intervals["stretch"]

    Args:
        variables: Name -> variable. Names of fields of `Parameters` become that; others reach
            `residuals` as a second argument.
        residuals: Function of a `Parameters` that holds the variables, and of name -> value of the
            other variables if there are some; returns a tensor [M], or a list of tensors, one for
            each trajectory: see `dc.residuals`. It is called with tensors that are being
            differentiated, and must return the same values for the same input. Or a list of
            `Stage`, run one after the other; the last one must free all variables.
        method: The solver. "least_squares" is SciPy's trust region, with Jacobians. "L-BFGS-B" is
            SciPy's, with gradients, for many variables. A function that makes an optimizer of
            torch, as `partial(torch.optim.Adam, lr=0.05)`, takes `max_evaluations` steps of
            `dc.descend`.
        starts: Number of starts: the first values, then random ones, see `Variable`.
        seed: Of the random starts.
        loss: Of the squares: "linear", "soft_l1", "huber", "cauchy" or "arctan", as SciPy has them;
            "linear" for other methods than "least_squares".
        loss_scale: Residual from which on the others count less, > 0.
        max_evaluations: Of the residuals, for each stage of each start.
        tolerance: Relative change of the cost or the variables at which a stage ends.
        hold_out: Residuals of trajectories that are kept out of the fit, as `residuals`.
        workers: Number of processes for the starts, 0 for none, or an executor of processes. The
            result has the same bits for any number. `residuals` must then be a function of a module
            or another object that can be pickled, and a script needs
            `if __name__ == "__main__":`.
        deadline: Longest time of an evaluation and its Jacobian in a process of `workers` [s]. A
            process that takes longer, or dies, is replaced, and its start computed again, up to
            three times. An executor has no deadline.
        resume: Folder that keeps all evaluations. A fit that was interrupted takes them from there,
            and ends with the same bits. Residuals that differ where they began are refused, and
            so is a folder that another process uses.
        progress: Called after each evaluation; of starts in processes, when they have ended.

    Returns:
        The best fit, with its uncertainty. A trial step in which the simulation fails, or whose
        numbers belong to no material together, is rejected, and counted.

    Raises:
        InvalidInput: If an argument is not accepted.
        SimulationError: If the simulation fails at the first values of every start.
        TypeError: If `residuals` returns something else than tensors.
        WorkerError: If the processes of a start die, or miss the deadline, again and again.
    """
    from_extra("scipy", "fit", "fit: it needs SciPy")
    check_count("fit: `starts`", starts, 1)
    check_count("fit: `seed`", seed, 0)
    refuse_threads("fit: `workers`", workers)
    if not isinstance(workers, Executor):
        check_count("fit: `workers`", workers, 0, LARGEST_WORKERS)
    check_number("fit: `deadline`", deadline, Range(0.0, LONGEST_DEADLINE))
    for name, function in (("hold_out", hold_out), ("progress", progress)):
        if not callable(function) and not (name == "hold_out" and function is None):
            raise TypeError(f"fit: `{name}` must be a function, got {type(function).__name__}")
    space = Space(variables)
    if hold_out is not None:
        _check_signature(hold_out, space)
        _errors(hold_out, space.values(torch.from_numpy(space.first)))  # refused before the fit
    job = Job(
        space=space,
        stages=_stages(residuals, space),
        options=_options(method, loss, loss_scale, max_evaluations, tolerance),
        folder=_folder(resume),
        threads=torch.get_num_threads(),
    )
    generator = np.random.default_rng(seed)
    firsts = [space.first] + [space.draw(generator) for _ in range(starts - 1)]
    with nullcontext() if job.folder is None else locked("fit: `resume`", job.folder):
        ends = run_all(job, firsts, workers, deadline, progress)
    best = min(ends, key=lambda end: end.cost)
    if best.failure is not None:
        raise next(end.failure for end in reversed(ends) if end.failure is not None)
    noise = noise_of(best.residuals, len(space), loss, job.options.loss_scale)
    found = uncertainty_of(space, best.theta, best.jacobian, noise)
    at_bounds = space.at_bounds(best.theta)
    _warn_of_bounds(variables, space, at_bounds)
    values = space.values(torch.from_numpy(np.array(best.theta)))
    return Fit(
        parameters=parameters_of(values),
        values=values,
        names=list(space.names),
        covariance=found.covariance,
        correlation=found.correlation,
        intervals=found.intervals,
        unidentifiable=found.unidentifiable,
        residuals=best.residuals,
        cost=best.cost,
        success=best.success,
        message=best.message + "".join(f"; {name} is at its bound" for name in at_bounds),
        at_bounds=at_bounds,
        starts=judge(job, ends, best, found.deviations),
        held_out=[] if hold_out is None else _errors(hold_out, values),
        history=[trial for end in ends for trial in end.history],
        compared=[r for r in (job.stages[-1].residuals, hold_out) if r is not None],
    )


def _options(
    method: Method, loss: str, loss_scale: float, max_evaluations: int, tolerance: float
) -> Options:
    given: Any = method
    if not isinstance(given, str) and (
        isinstance(given, torch.optim.Optimizer) or not callable(given)
    ):
        raise TypeError(
            "fit: `method` must be a name or make an optimizer of torch from a list of tensors, "
            f"got {type(method).__name__}"
        )
    if isinstance(method, str):
        check_choice("fit: `method`", method, METHODS)
    check_choice("fit: `loss`", loss, _LOSSES)
    if loss != "linear" and method != "least_squares":
        raise InvalidInput(
            f'fit: `loss` must be "linear" unless `method` is "least_squares", got {loss!r}'
        )
    return Options(
        method=method,
        loss=loss,
        loss_scale=check_number("fit: `loss_scale`", loss_scale, POSITIVE),
        max_evaluations=check_count("fit: `max_evaluations`", max_evaluations, 1),
        tolerance=check_number("fit: `tolerance`", tolerance, POSITIVE),
    )


def _stages(residuals: Residuals | Sequence[Stage], space: Space) -> list[Stage]:
    given: Any = residuals
    stages = [Stage(residuals)] if callable(residuals) else given
    if (
        not isinstance(stages, list | tuple)
        or not stages
        or not all(isinstance(stage, Stage) and callable(stage.residuals) for stage in stages)
    ):
        raise TypeError("fit: `residuals` must be a function, or a list of one or more Stage")
    stages = list(stages)
    for k, stage in enumerate(stages):
        _check_signature(stage.residuals, space)
        if stage.free is None:
            continue
        if isinstance(stage.free, str) or not stage.free:
            raise TypeError(f"fit: `residuals[{k}].free` must be a list of names, got {stage.free}")
        for name in stage.free:
            if name not in space.variables:
                raise InvalidInput(
                    f"fit: `residuals[{k}].free` may name {', '.join(space.variables)}; "
                    f"got {name!r}"
                )
    left = set(space.variables) - set(stages[-1].free or space.variables)
    if left:
        raise InvalidInput(
            "fit: the last stage must free all variables, as standard errors come from it; "
            f"it leaves out {', '.join(sorted(left))}"
        )
    return stages


def _check_signature(residuals: Residuals, space: Space) -> None:
    """Refuse a misspelled parameter, which would reach a function that does not take it."""
    others = [name for name in space.all_variables if name not in PARAMETERS]
    try:
        signature = inspect.signature(residuals)
    except (TypeError, ValueError):  # of some built-in functions nobody knows it
        return
    arguments = ["parameters", "values"] if others else ["parameters"]
    try:
        signature.bind(*arguments)
    except TypeError as error:
        if others:
            close = difflib.get_close_matches(others[0], PARAMETERS, n=1)
            hint = f"; is {close[0]!r} meant?" if close else ""
            raise InvalidInput(
                f"fit: `variables` has {others[0]!r}, which is no field of Parameters, so that "
                f"residuals must take (parameters, values), got {signature}{hint}"
            ) from error
        raise InvalidInput(
            f"fit: residuals must take (parameters), as all variables are fields of Parameters, "
            f"got {signature}"
        ) from error


def _folder(resume: str | Path | None) -> Path | None:
    if resume is None:
        return None
    folder = as_path("fit: `resume`", resume)
    if folder.exists() and not folder.is_dir():
        raise InvalidInput(f"fit: `resume` must be a folder, got {str(folder)!r}")
    return folder


def _errors(residuals: Residuals, values: Mapping[str, Tensor]) -> list[float]:
    try:
        with torch.no_grad():
            parts = trajectories(residuals, values)
    except FAILURES:
        return [math.inf]
    for k, part in enumerate(parts):
        if not part.numel():
            raise InvalidInput(f"fit: `hold_out` must return numbers, trajectory {k} has none")
    return [float(part.square().mean().sqrt()) for part in parts]


def _warn_of_bounds(
    variables: Mapping[str, Variable], space: Space, at_bounds: Sequence[str]
) -> None:
    """Warn of numbers that ended at a bound which nobody gave."""
    for name in space.default_bounds:
        here = [n for n in at_bounds if n.partition("[")[0] == name]
        if here:
            warn_caller(
                f"fit: {', '.join(here)} ended a factor of 1000 from where it began, and goes no "
                "further without `bounds`; give them, or a better first value",
            )
