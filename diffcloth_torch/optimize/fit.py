"""Fits of parameters to observations: nonlinear least squares with exact Jacobians.

The solver is SciPy's: a trust region within bounds (Branch, Coleman and Li, 1999). The Jacobian of
the residuals comes from tangents of the simulation, one for each number that is fitted.
"""

from __future__ import annotations

import copy
import difflib
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

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
from diffcloth_torch.errors import InvalidInput, MeshBiasWarning, StepBiasWarning, warn_caller
from diffcloth_torch.extras import from_extra
from diffcloth_torch.files import as_path
from diffcloth_torch.lock import locked
from diffcloth_torch.model.quantities import PARAMETERS
from diffcloth_torch.optimize.bias import factor_of, limit_of, moves_of
from diffcloth_torch.optimize.fit_files import Solved, read_fit, write_fit
from diffcloth_torch.optimize.fit_page import Page, write_page
from diffcloth_torch.optimize.forecast import Prediction, expected_half_widths, predict
from diffcloth_torch.optimize.linearized import Linearized
from diffcloth_torch.optimize.methods import METHODS, Method, Options
from diffcloth_torch.optimize.misfit import Block, are_correlated, blocks_of_fit, warn_of_blocks
from diffcloth_torch.optimize.problem import FAILURES, Residuals, Trial, parameters_of, trajectories
from diffcloth_torch.optimize.profile import Profile, profile_of
from diffcloth_torch.optimize.series import Layout, is_walk, stretches, walk
from diffcloth_torch.optimize.starts import End, Job, Stage, Start, judge, run_all
from diffcloth_torch.optimize.uncertainty import (
    Collinear,
    Direction,
    Noise,
    Spread,
    leverages,
    noise_of,
    uncertainty_of,
    weights_of,
)
from diffcloth_torch.optimize.variables import Prior, Space, Tie, Values, Variable
from diffcloth_torch.processes import DEADLINE, LARGEST_WORKERS, LONGEST_DEADLINE
from diffcloth_torch.sim.records.controls import Parameters

__all__ = [
    "Block",
    "Collinear",
    "Direction",
    "Fit",
    "Prediction",
    "Profile",
    "Stage",
    "Start",
    "Trial",
    "fit",
]

_TINY = 1e-300
_SAME = 1e-6  # relative and absolute tolerance for equal residuals
_SHOWN = 20  # most numbers listed by a repr
_COVARIANCES = ("auto", "white", "robust")
_LOSSES = ("linear", "soft_l1", "huber", "cauchy", "arctan")


@dataclass(frozen=True, eq=False)
class Fit:
    """The best of all starts.

    Standard errors follow from J^T J at the solution, the noise estimated from the residuals, and
    the priors. If there are no more residuals than numbers, the noise cannot be estimated, and the
    residuals are assumed to be in units of their noise.

    Attributes:
        parameters: Parameters that hold the variables, None elsewhere.
        values: Values of all variables.
        names: Name of each fitted number.
        covariance: Covariance of the fitted numbers, [p, p].
        correlation: Correlation of the fitted numbers, [p, p].
        intervals: Name of each number -> its interval of 95 %.
        unidentifiable: Directions that the observations do not determine, the worst first.
        collinear: Numbers whose error would be ten times smaller if the others were known.
        blocks: Name of each block of residuals -> its size relative to the noise.
        noise_model: Noise that the covariance assumes: "white noise", "correlated stretches" or
            "random walks".
        residuals: Residuals of the last stage at the solution [M], without priors.
        cost: Half the sum of squares at the solution, priors included.
        success: Whether the solver converged.
        message: Reason of the end.
        at_bounds: Names of the numbers that ended at a bound, where intervals mean little.
        starts: First values and end of each start, and why it missed the best minimum.
        held_out: Root mean square of the residuals of each trajectory that was kept out of the fit:
            about one if the model is right and the noise is known; one infinite number if the
            simulation fails there.
        history: All evaluations, start after start.
        compared: Residual functions of the last stage and of `hold_out`, for the report.
        linearized: Residuals of the last stage to first order in the fitted numbers.
        solved: Ends of all starts with the options of the fit, the content of `save`.
    """

    parameters: Parameters
    values: dict[str, Tensor]
    names: list[str]
    covariance: FloatArray
    correlation: FloatArray
    intervals: dict[str, tuple[float, float]]
    unidentifiable: list[Direction]
    collinear: list[Collinear]
    blocks: dict[str, Block]
    noise_model: str
    residuals: FloatArray
    cost: float
    success: bool
    message: str
    at_bounds: list[str]
    starts: list[Start]
    held_out: list[float]
    history: list[Trial] = field(repr=False)
    compared: list[Residuals] = field(repr=False)
    linearized: Linearized = field(repr=False)
    solved: Solved = field(repr=False)

    def __repr__(self) -> str:
        """List the numbers with their intervals, and the size of the residuals."""
        lines = [f"Fit: rms {self.rms:.3g}, {self.noise_model}, {self.message}"]
        lines += [f"  {line}" for line in self.lines()[:_SHOWN]]
        if len(self.names) > _SHOWN:
            lines.append(f"  and {len(self.names) - _SHOWN} more")
        return "\n".join(lines)

    def lines(self) -> list[str]:
        """Describe each number in a sentence: its value and interval, or that it is unknown."""
        numbers = self.linearized.space.from_theta(self.linearized.theta)
        return [
            f"{name} {number:.6g}, {self._interval_text(name)}"
            for name, number in zip(self.names, numbers, strict=True)
        ]

    def _interval_text(self, name: str) -> str:
        if name in self.linearized.untold:
            return "which the observations do not tell"
        low, high = self.intervals[name]
        return f"between {low:.4g} and {high:.4g}"

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the functions, as `save` does."""
        kept = {"compared": [], "solved": self.solved.without_functions()}
        return self.__dict__ | kept

    def __copy__(self) -> Fit:
        return replace(self)

    def __deepcopy__(self, memo: dict[int, Any]) -> Fit:
        return replace(self, **{n: copy.deepcopy(v, memo) for n, v in self.__dict__.items()})

    def save(self, path: str | Path) -> None:
        """Write the fit to a file, without the functions that made it.

        Args:
            path: The file, in an existing folder; an existing file is replaced.

        Raises:
            InvalidInput: If a tie is a function.
            OSError: If the file cannot be written.
        """
        write_fit(as_path("Fit.save: `path`", path), self.solved)

    @staticmethod
    def load(
        path: str | Path, residuals: Residuals | None = None, hold_out: Residuals | None = None
    ) -> Fit:
        """Read a fit that `save` has written.

        Args:
            path: The file.
            residuals: Residual function of the last stage, which a file cannot hold. It is
                evaluated once and compared with the residuals of the fit. Without it, `profile`,
                `report` and more than one evaluation of `step_bias` and `mesh_bias` are refused.
            hold_out: Residuals that were kept out, for `report`; needs `residuals`.

        Returns:
            The fit. If an optimizer of torch solved it, `profile` uses "least_squares" instead.

        Raises:
            InvalidInput: If the file holds no fit, or `residuals` differ from the fit's residuals.
            OSError: If the file cannot be read.
            SimulationError: If the simulation of `residuals` fails.
        """
        owner = "Fit.load"
        file = as_path(f"{owner}: `path`", path)
        given: Any = {"residuals": residuals, "hold_out": hold_out}
        for name, function in given.items():
            if function is not None and not callable(function):
                kind = type(function).__name__
                raise TypeError(f"{owner}: `{name}` must be a function, got {kind}")
        if residuals is None and hold_out is not None:
            raise InvalidInput(f"{owner}: `hold_out` needs `residuals`")
        compared = [function for function in given.values() if function is not None]
        found = _assemble(read_fit(owner, file), compared)
        if residuals is not None:
            _check_same(owner, residuals, found)
        return found

    def _functions(self, owner: str) -> list[Residuals]:
        """Return the residual functions; a fit that was loaded without `residuals` has none."""
        if not self.compared:
            raise InvalidInput(
                f"{owner}: a fit from a file has no residuals: give them to Fit.load(path, "
                "residuals)"
            )
        return self.compared

    @property
    def rms(self) -> float:
        """Root mean square of the residuals: about one if the model is right, in known noise."""
        return float(np.sqrt(np.square(self.residuals).mean()))

    @property
    def chi2(self) -> dict[str, float]:
        """Sum of squares of each block of residuals; `blocks` has its expected value."""
        return {name: block.chi2 for name, block in self.blocks.items()}

    @property
    def failures(self) -> int:
        """Number of trial steps that were rejected."""
        return sum(bool(trial.failure) for trial in self.history)

    def profile(self, name: str) -> Profile:
        """Find the interval of a number from the cost itself, if a linear model is too rough.

        At values to both sides, up to six half widths away, the other numbers are fitted again,
        until the cost has risen by as much as a quadratic cost rises at the ends of the interval.
        Each value costs a fit, about six in all.

        Args:
            name: One of `names`.

        Raises:
            InvalidInput: If there is no such number, or the loss is robust.
        """
        if name not in self.names:
            raise InvalidInput(f"Fit.profile: `name` may be {', '.join(self.names)}; got {name!r}")
        options = self.solved.options
        if options.loss != "linear":
            raise InvalidInput(
                f'Fit.profile: the loss of the fit must be "linear", got {options.loss!r}'
            )
        residuals, row = self._functions("Fit.profile")[0], self.names.index(name)
        return profile_of(residuals, options, self.linearized, self.cost, row)

    def predict(self, function: Residuals) -> Prediction:
        """Evaluate a quantity at the fitted numbers, with a band of 95 % to first order.

        Args:
            function: Function of the arguments of `residuals` that returns a tensor, such as the
                positions of a motion that was not recorded.

        Raises:
            InvalidInput: If the observations leave a number unknown.
            TypeError: If `function` is not a function, or does not return a tensor.
            SimulationError: If the simulation fails.
        """
        if not callable(function):
            raise TypeError(
                f"Fit.predict: `function` must be a function, got {type(function).__name__}"
            )
        return predict(self.linearized, function)

    def information(self, candidate: Residuals) -> dict[str, float]:
        """Compute the expected half widths of the intervals if a recording were added.

        The result shows which recording to make next.

        Args:
            candidate: Residuals of the recording in units of its noise, as for `fit`. Only their
                derivatives matter: compare with any observations of the right shape.

        Returns:
            Name of each number -> expected half width, in the unit of the number.

        Raises:
            InvalidInput: If a number would still be unknown.
            TypeError: If `candidate` is not a function.
            SimulationError: If the simulation fails.
        """
        if not callable(candidate):
            raise TypeError(
                f"Fit.information: `candidate` must be a function, got {type(candidate).__name__}"
            )
        return expected_half_widths(self.linearized, candidate)

    def step_bias(
        self,
        finer: Residuals,
        ratio: float = 2.0,
        *,
        order: float = 1.0,
        max_evaluations: int = 4,
    ) -> dict[str, Tensor]:
        """Estimate how far the time step h shifts the fitted numbers.

        With residuals r of the fit and f of the time step h / ratio, residuals in the limit h = 0
        are r + (f - r) q / (q - 1) to the leading order in h, with q = ratio^order. Their
        least-squares solution differs from the solution of the fit by the step
        -(J^T J + P^2)^-1 J^T (f - r) q / (q - 1), with the Jacobian J and the precisions P of the
        priors. If the step is not small relative to the intervals, both residuals are evaluated at
        its end and the next step is made with the same Jacobian. See `residuals.extrapolated` for
        the motions to which this applies.

        Args:
            finer: Residuals of the last stage, from a simulation with the time step h / ratio.
            ratio: Ratio of the two time steps, > 1.
            order: Power of h in the error of positions, > 0: 1 with implicit Euler, 2 with
                `integrator="second_order"`.
            max_evaluations: Largest number of evaluations of `finer`, >= 1; one suffices if the
                bias is small.

        Returns:
            Name of each free variable -> limit minus value: value plus shift is the fit of
            extrapolated residuals. Numbers at a bound do not move.

        Raises:
            InvalidInput: If `finer` returns other residuals, or an argument is not accepted.
            SimulationError: If the simulation fails.

        Warns:
            StepBiasWarning: If a shift exceeds the half width of the interval of its number.
        """
        owner = "Fit.step_bias"
        factor = factor_of(owner, ratio, order)
        return self._bias(owner, finer, factor, max_evaluations, "time step", StepBiasWarning)

    def mesh_bias(
        self,
        finer: Residuals,
        ratio: float = 2.0,
        *,
        order: float = 2.0,
        max_evaluations: int = 4,
    ) -> dict[str, Tensor]:
        """Estimate how far the mesh shifts the fitted numbers, as `step_bias`.

        Args:
            finer: Residuals of the last stage, from a mesh whose edges are shorter by `ratio`;
                its markers are the same material points in the same order.
            ratio: Ratio of the edge lengths, > 1.
            order: Power of the edge length in the error of positions, > 0: about 2 if the cloth is
                resolved; 1 if a boundary moves with the mesh, as beside a clamp.
            max_evaluations: As in `step_bias`.

        Returns:
            Name of each free variable -> limit minus value.

        Raises:
            InvalidInput: If `finer` returns other residuals, or an argument is not accepted.
            SimulationError: If the simulation fails.

        Warns:
            MeshBiasWarning: If a shift exceeds the half width of the interval of its number.
        """
        owner = "Fit.mesh_bias"
        factor = factor_of(owner, ratio, order)
        return self._bias(owner, finer, factor, max_evaluations, "mesh", MeshBiasWarning)

    def _bias(
        self,
        owner: str,
        finer: Residuals,
        factor: float,
        max_evaluations: int,
        source: str,
        category: type[Warning],
    ) -> dict[str, Tensor]:
        check_count(f"{owner}: `max_evaluations`", max_evaluations, 1)
        model = self.linearized
        coarse = self._functions(owner)[0] if max_evaluations > 1 else None
        limit = limit_of(owner, model, coarse, finer, factor, max_evaluations)
        moved = moves_of(model, limit.theta)
        unsettled = max_evaluations > 1 and limit.last_step > 1.0
        if moved or unsettled:
            parts = [
                f"{owner}: without the error of the {source} the fit would find {moved}"
                if moved
                else f"{owner}: the bias of the {source} is not known"
            ]
            if unsettled:
                parts.append(
                    f"the last of {max_evaluations} steps to the limit moved a number by "
                    f"{limit.last_step:.2g} half widths of its interval"
                )
            if self.at_bounds:
                parts.append(f"at bounds, and not moved: {', '.join(self.at_bounds)}")
            parts.append("the intervals do not contain this bias: take a finer simulation")
            warn_caller("; ".join(parts), category)
        values = model.space.values(torch.from_numpy(limit.theta))
        return {name: values[name] - self.values[name] for name in model.space.variables}

    def report(self, path: str | Path) -> None:
        """Write a page about the fit: one file, which loads nothing.

        The page has the values with their intervals, the correlation, the residuals over time, the
        worst marker, the first and last motions beside the observations, and the starts. The
        residuals are evaluated at the last values, and at the first values of the first start that
        could be simulated.

        Args:
            path: File name that ends in ".html".

        Raises:
            InvalidInput: If `path` has another ending.
            SimulationError: If the simulation fails.
        """
        file = as_path("Fit.report: `path`", path)
        if file.suffix != ".html":
            raise InvalidInput(f'Fit.report: `path` must end in ".html", got {str(path)!r}')
        functions = self._functions("Fit.report")
        write_page(
            file,
            Page(
                names=self.names,
                values=self.values,
                first=next(s.first for s in self.starts if np.isfinite(s.cost)),
                intervals={name: self._interval_text(name) for name in self.names},
                correlation=self.correlation,
                unidentifiable=[str(direction) for direction in self.unidentifiable],
                collinear=[str(pair) for pair in self.collinear],
                blocks=self.blocks,
                noise_model=self.noise_model,
                rms=self.rms,
                message=self.message,
                starts=self.starts,
                history=self.history,
                held_out=self.held_out,
                residuals=functions,
            ),
        )


def fit(
    variables: Mapping[str, Variable | Tie],
    residuals: Residuals | Sequence[Stage],
    *,
    method: Method = "least_squares",
    starts: int = 1,
    seed: int = 0,
    loss: str = "linear",
    loss_scale: float = 1.0,
    max_evaluations: int = 100,
    tolerance: float = 1e-8,
    covariance: Literal["auto", "white", "robust"] = "auto",
    priors: Sequence[Prior] = (),
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
        variables: Name -> variable, or a `Tie` to another variable. Variables named like a field of
            `Parameters` become that field; all others reach `residuals` as a second argument.
        residuals: Function of a `Parameters` that holds the variables, and of name -> value of the
            other variables if there are any. It returns a tensor, a list of tensors, one for each
            trajectory, or a dict of name -> tensor: see `dc.residuals`. The function is called with
            tensors that are being differentiated, and must return the same values for the same
            input. Or a list of `Stage`, run one after the other; the last stage must free all
            variables.
        method: The solver. "least_squares" is SciPy's trust region, with Jacobians. "L-BFGS-B" is
            SciPy's, with gradients, for many variables. A function that makes an optimizer of
            torch, as `partial(torch.optim.Adam, lr=0.05)`, takes `max_evaluations` steps of
            `dc.descend`.
        starts: Number of starts: the first values, then random ones, see `Variable`.
        seed: Seed of the random starts.
        loss: Loss of the squared residuals: "linear", "soft_l1", "huber", "cauchy" or "arctan", as
            in SciPy; methods other than "least_squares" accept "linear" only.
        loss_scale: Residual above which a robust loss reduces the weight, > 0.
        max_evaluations: Largest number of evaluations of the residuals in a stage of a start.
        tolerance: Relative change of the cost or the variables at which a stage ends, unless the
            stage has its own.
        covariance: Noise that the intervals assume. "white" assumes independent residuals. "robust"
            accounts for correlation along series, which are the first axis of each tensor, or the
            markers of `residuals.markers`. It uses stretches of the series; if the series are short
            relative to the correlation time, it assumes random walks. "auto" uses "robust" if
            residuals are correlated, and warns.
        priors: Joint priors of several variables.
        hold_out: Residuals of trajectories that are kept out of the fit, as `residuals`.
        workers: Number of processes for the starts, 0 for none, or an executor of processes. The
            result has the same bits for any number. `residuals` must then be a function of a module
            or another object that can be pickled, and a script needs
            `if __name__ == "__main__":`.
        deadline: Longest time of an evaluation and its Jacobian in a process of `workers` [s]. A
            process that exceeds it, or dies, is replaced, and its start is computed again, up to
            three times. An executor has no deadline.
        resume: Folder that stores all evaluations. An interrupted fit reads them, and ends with the
            same bits as without the interruption. Residuals whose values at the first point have
            changed are refused, and so is a folder in use by another process.
        progress: Called after each evaluation; for starts in processes, after the start has ended.

    Returns:
        The best fit, with its uncertainty. A trial step is rejected and counted if the simulation
        fails, or if its numbers together belong to no material.

    Raises:
        InvalidInput: If an argument is not accepted.
        SimulationError: If the simulation fails at the first values of every start.
        TypeError: If `residuals` returns a value of another type.
        WorkerError: If the processes of a start die, or exceed the deadline, repeatedly.

    Warns:
        ModelErrorWarning: If residuals are too large for their noise.
        NoiseWarning: If residuals are too small for their noise.
        CorrelatedResidualsWarning: If residuals are correlated, and the covariance accounts for it.
    """
    from_extra("scipy", "fit", "fit: it needs SciPy")
    check_choice("fit: `covariance`", covariance, _COVARIANCES)
    check_count("fit: `starts`", starts, 1)
    check_count("fit: `seed`", seed, 0)
    refuse_threads("fit: `workers`", workers)
    if not isinstance(workers, Executor):
        check_count("fit: `workers`", workers, 0, LARGEST_WORKERS)
    check_number("fit: `deadline`", deadline, Range(0.0, LONGEST_DEADLINE))
    for name, function in (("hold_out", hold_out), ("progress", progress)):
        if not callable(function) and not (name == "hold_out" and function is None):
            raise TypeError(f"fit: `{name}` must be a function, got {type(function).__name__}")
    if not isinstance(priors, list | tuple):
        raise TypeError(f"fit: `priors` must be a list of Prior, got {type(priors).__name__}")
    space = Space(variables, priors)
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
    best = _best(ends)
    if best.failure is not None:
        raise next(end.failure for end in reversed(ends) if end.failure is not None)
    assert best.layout is not None  # it has residuals
    # If a solver stopped early, residuals show the remaining distance and not the noise.
    correlated = best.success and are_correlated(best.residuals, best.layout)
    values = space.values(torch.from_numpy(np.array(best.theta)))
    solved = Solved(
        space=space,
        options=job.options,
        ends=ends,
        robust=covariance == "robust" or (covariance == "auto" and correlated),
        held_out=[] if hold_out is None else _errors(hold_out, values),
    )
    compared = [r for r in (job.stages[-1].residuals, hold_out) if r is not None]
    found = _assemble(solved, compared)
    if found.success:
        warn_of_blocks(found.blocks, found.noise_model, correlated=correlated)
    _warn_of_bounds(space, found.at_bounds)
    return found


def _best(ends: Sequence[End]) -> End:
    return min(ends, key=lambda end: end.cost)


def _assemble(solved: Solved, compared: list[Residuals]) -> Fit:
    """Compute the fit from the ends of all starts."""
    space, options, best = solved.space, solved.options, _best(solved.ends)
    noise = noise_of(best.residuals, len(space), options.loss, options.loss_scale)
    assert best.layout is not None  # it has residuals
    noise_model, spread = "white noise", None
    if solved.robust:
        influence = _influence(best.residuals, options.loss, options.loss_scale)
        noise_model, spread, noise = _robust(influence, best.layout, noise, len(space))
    found = uncertainty_of(space, best.theta, best.jacobian, noise, spread)
    leverage = leverages(space, best.theta, best.jacobian)
    at_bounds = space.at_bounds(best.theta)
    values = Values(space.values(torch.from_numpy(np.array(best.theta))))
    return Fit(
        parameters=parameters_of(values),
        values=values,
        names=list(space.names),
        covariance=found.covariance,
        correlation=found.correlation,
        intervals=found.intervals,
        unidentifiable=found.unidentifiable,
        collinear=found.collinear,
        blocks=blocks_of_fit(best.residuals, best.layout, leverage, options.loss),
        noise_model=noise_model,
        residuals=best.residuals,
        cost=best.cost,
        success=best.success,
        message=best.message + "".join(f"; {name} is at its bound" for name in at_bounds),
        at_bounds=at_bounds,
        starts=judge(space, solved.ends, best, found.deviations),
        held_out=solved.held_out,
        history=[trial for end in solved.ends for trial in end.history],
        compared=compared,
        linearized=Linearized(
            space=space,
            theta=best.theta,
            residuals=best.residuals,
            jacobian=best.jacobian,
            weights=weights_of(best.residuals, options.loss, options.loss_scale)[0],
            half_widths=found.half_widths,
            covariance=found.of_theta,
            precision_root=found.precision_root,
            reach=found.reach,
        ),
        solved=solved,
    )


def _check_same(owner: str, residuals: Residuals, found: Fit) -> None:
    """Refuse residuals that differ from the residuals of the fit."""
    _check_signature(residuals, found.solved.space)
    with torch.no_grad():
        parts = trajectories(residuals, found.values)
    now = torch.cat([part.reshape(-1) for part in parts]).to(torch.float64).numpy()
    if now.shape != found.residuals.shape or not np.allclose(
        now, found.residuals, rtol=_SAME, atol=_SAME
    ):
        raise InvalidInput(
            f"{owner}: `residuals` must be those of the last stage of the fit, got other numbers"
        )


def _influence(residuals: FloatArray, loss: str, scale: float) -> FloatArray:
    """Influence of each residual on the fit: the residual itself unless the loss is robust."""
    weights, slopes = weights_of(residuals, loss, scale)
    influence: FloatArray = weights * residuals / max(float(slopes.mean()), _TINY)
    return influence


def _robust(
    influence: FloatArray, layout: Layout, noise: Noise, numbers: int
) -> tuple[str, Spread, Noise]:
    """Noise model of correlated residuals: name, spread, and noise with its degrees of freedom."""
    if is_walk(influence, layout, numbers):
        return "random walks", lambda u: walk(influence, layout, u), noise
    spread, count = stretches(influence, layout, numbers)
    return "correlated stretches", spread, noise._replace(freedom=max(count - 1.0, 1.0))


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
        if stage.tolerance is not None:
            check_number(f"fit: `residuals[{k}].tolerance`", stage.tolerance, POSITIVE)
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
    """Refuse a misspelled parameter: the residual function has no argument for it."""
    others = [name for name in space.all_variables if name not in PARAMETERS]
    try:
        signature = inspect.signature(residuals)
    except (TypeError, ValueError):  # unknown for some built-in functions
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


def _warn_of_bounds(space: Space, at_bounds: Sequence[str]) -> None:
    """Warn of numbers that ended at a default bound."""
    for name in space.default_bounds:
        here = [n for n in at_bounds if n.partition("[")[0] == name]
        if here:
            warn_caller(
                f"fit: {', '.join(here)} ended a factor of 1000 from where it began, and goes no "
                "further without `bounds`; give them, or a better first value",
            )
