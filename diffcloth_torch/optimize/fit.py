"""Fits of parameters to observations: nonlinear least squares with exact Jacobians.

The solver is SciPy's: a trust region within bounds (Branch, Coleman and Li, 1999). The Jacobian of
the residuals comes from tangents of the simulation, one for each number that is fitted.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import FloatArray, check_choice, check_count
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.model.quantities import PARAMETERS
from diffcloth_torch.optimize.variables import Space, Variable
from diffcloth_torch.sim.controls import Parameters

__all__ = ["Direction", "Fit", "Trial", "fit"]

Residuals = Callable[..., Tensor | Sequence[Tensor]]

_METHODS = ("least_squares",)
_LOSSES = ("linear", "soft_l1", "huber", "cauchy", "arctan")
# Standard error of a direction, in sizes of its variables, from which on it is not known at all.
_UNSURE = 1.0
_SHOWN = 0.1  # share of a direction below which a variable is not named
_CONFIDENCE = 0.95
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class Trial:
    """One evaluation of the residuals.

    Attributes:
        start: Index of the start that it belongs to.
        cost: Half the sum of squares; infinite if the simulation failed.
        values: Values of all variables.
        seconds: Time that it took [s].
        failure: What the simulation raised, empty if nothing.
    """

    start: int
    cost: float
    values: dict[str, Tensor]
    seconds: float
    failure: str = ""


@dataclass(frozen=True, eq=False)
class Direction:
    """A combination of variables that the observations do not tell.

    Attributes:
        standard_error: Of the combination, in sizes of its variables: relative on the scale "log".
        shares: Name of a number -> its share in the combination, which has length one.
    """

    standard_error: float
    shares: dict[str, float]

    def __str__(self) -> str:
        """Name the variables and their signs."""
        parts = [f"{share:+.2f} {name}" for name, share in self.shares.items()]
        return f"{' '.join(parts)} (standard error {self.standard_error:.2g})"


@dataclass(frozen=True, eq=False)
class Fit:
    """The best of all starts.

    Standard errors follow from J^T J at the solution, with the noise that the residuals show.

    Attributes:
        parameters: Parameters that hold the variables, None elsewhere.
        values: Values of all variables.
        names: Name of each number that was fitted.
        covariance: Of these numbers, [p, p].
        correlation: Likewise.
        intervals: Name of each number -> its interval of 95 %.
        unidentifiable: Directions that the observations do not tell, the worst first.
        residuals: At the solution [M].
        cost: Half the sum of their squares.
        success: Whether the solver converged.
        message: How it ended.
        starts: Cost at which each start ended; infinite where the simulation failed at the start.
        history: All evaluations, in their order.
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
    starts: list[float]
    history: list[Trial] = field(repr=False)

    @property
    def failures(self) -> int:
        """Number of trial steps in which the simulation failed."""
        return sum(bool(trial.failure) for trial in self.history)


def fit(
    variables: Mapping[str, Variable],
    residuals: Residuals,
    *,
    method: str = "least_squares",
    starts: int = 1,
    seed: int = 0,
    loss: str = "linear",
    loss_scale: float = 1.0,
    max_evaluations: int = 100,
    tolerance: float = 1e-8,
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
            differentiated, and must return the same values for the same input.
        method: The solver; "least_squares".
        starts: Number of starts: the first values, then random ones between the bounds.
        seed: Of the random starts.
        loss: Of the squares: "linear", "soft_l1", "huber", "cauchy" or "arctan", as SciPy has them.
        loss_scale: Residual from which on the others count less, > 0.
        max_evaluations: Of the residuals, for each start.
        tolerance: Relative change of the cost or the variables at which a start ends.

    Returns:
        The best fit, with its uncertainty. A trial step in which the simulation fails is rejected,
        and counted.

    Raises:
        InvalidInput: If an argument is not accepted.
        SimulationError: If the simulation fails at the first values of every start.
        TypeError: If `residuals` returns something else than tensors.
    """
    optimize = _require_scipy()
    check_choice("fit: `method`", method, _METHODS)
    check_choice("fit: `loss`", loss, _LOSSES)
    check_count("fit: `starts`", starts, 1)
    check_count("fit: `max_evaluations`", max_evaluations, 1)
    problem = _Problem(Space(variables), residuals)
    generator = np.random.default_rng(seed)
    space, ends, failure = problem.space, [], None
    costs = []
    for k in range(starts):
        problem.start = k
        first = space.first if k == 0 else space.draw(generator)
        try:
            problem.require(first)
        except SimulationError as error:
            failure = error
            costs.append(np.inf)
            continue
        end = optimize.least_squares(
            problem.residuals,
            first,
            jac=problem.jacobian,
            bounds=(space.low, space.high),
            method="trf",
            x_scale="jac",
            loss=loss,
            f_scale=loss_scale,
            max_nfev=max_evaluations,
            ftol=tolerance,
            xtol=tolerance,
            gtol=tolerance,
        )
        costs.append(float(end.cost))
        ends.append(end)
    if not ends:
        assert failure is not None
        raise failure
    return _summary(problem, min(ends, key=lambda end: end.cost), costs)


class _Problem:
    """The residuals as functions of theta, and what was asked of them."""

    def __init__(self, space: Space, residuals: Residuals) -> None:
        self.space, self._residuals = space, residuals
        self.history: list[Trial] = []
        self.start = 0
        self._count = 0

    def require(self, theta: FloatArray) -> None:
        """Evaluate at a start, where a failure ends it."""
        found = self._trial(theta)
        if isinstance(found, SimulationError):
            raise found
        self._count = len(found)
        if self._count == 0:
            raise InvalidInput("fit: `residuals` must return at least one number")

    def residuals(self, theta: FloatArray) -> FloatArray:
        """Residuals [M]; infinite where the simulation fails: the solver rejects that step."""
        found = self._trial(theta)
        return np.full(self._count, np.inf) if isinstance(found, SimulationError) else found

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Jacobian [M, p]: forward where numbers are fewer than residuals, else backward."""
        few = len(self.space) <= self._count
        transform = torch.func.jacfwd if few else torch.func.jacrev
        found: FloatArray = transform(self._call)(torch.from_numpy(np.array(theta))).numpy()
        return found

    def parameters(self, values: dict[str, Tensor]) -> Parameters:
        """Parameters that hold the variables of their names."""
        return Parameters(**{n: v for n, v in values.items() if n in PARAMETERS})  # type: ignore[arg-type]

    def _trial(self, theta: FloatArray) -> FloatArray | SimulationError:
        begin = time.perf_counter()
        numbers = torch.from_numpy(np.array(theta))
        failure: SimulationError | None = None
        found = np.zeros(0)
        try:
            with torch.no_grad():
                found = self._call(numbers).numpy()
        except SimulationError as error:
            failure = error
        if failure is None and not np.isfinite(found).all():
            raise InvalidInput("fit: `residuals` must return finite numbers")
        self.history.append(
            Trial(
                start=self.start,
                cost=float(np.inf) if failure else 0.5 * float(found @ found),
                values=self.space.values(numbers),
                seconds=time.perf_counter() - begin,
                failure="" if failure is None else str(failure),
            )
        )
        return found if failure is None else failure

    def _call(self, theta: Tensor) -> Tensor:
        values = self.space.values(theta)
        others = {n: v for n, v in values.items() if n not in PARAMETERS}
        parameters = self.parameters(values)
        found = self._residuals(parameters, others) if others else self._residuals(parameters)
        parts = [found] if isinstance(found, Tensor) else found
        if not isinstance(parts, list | tuple) or not all(isinstance(p, Tensor) for p in parts):
            raise TypeError("fit: `residuals` must return a tensor or a list of tensors")
        return torch.cat([part.reshape(-1).to(torch.float64) for part in parts])


def _summary(problem: _Problem, end: Any, costs: list[float]) -> Fit:
    space = problem.space
    theta, J, found = end.x, end.jac, end.fun
    count, p = J.shape
    noise = 2 * float(end.cost) / max(count - p, 1)
    # In sizes of the variables, so that directions compare.
    units = space.units(theta)
    U_s, singular, V = np.linalg.svd(J * units, full_matrices=False)
    del U_s
    errors = np.sqrt(noise) / np.maximum(singular, _TINY)
    spread = V.T * errors  # columns: directions times their standard error
    of_theta = units[:, None] * (spread @ spread.T) * units
    rates = space.rates(theta)
    covariance = rates[:, None] * of_theta * rates
    deviations = np.sqrt(np.diag(covariance))
    correlation = covariance / np.maximum(np.outer(deviations, deviations), _TINY)
    values = space.values(torch.from_numpy(np.array(theta)))
    return Fit(
        parameters=problem.parameters(values),
        values=values,
        names=list(space.names),
        covariance=covariance,
        correlation=correlation,
        intervals=_intervals(space, theta, np.sqrt(np.diag(of_theta)), count - p),
        unidentifiable=_directions(space.names, V, errors),
        residuals=found,
        cost=float(end.cost),
        success=bool(end.success),
        message=str(end.message),
        starts=costs,
        history=problem.history,
    )


def _intervals(
    space: Space, theta: FloatArray, deviations: FloatArray, freedom: int
) -> dict[str, tuple[float, float]]:
    from scipy.stats import t

    reach = float(t.ppf(0.5 + _CONFIDENCE / 2, max(freedom, 1))) * deviations
    with np.errstate(over="ignore"):
        low, high = space.from_theta(theta - reach), space.from_theta(theta + reach)
    return {name: (float(low[i]), float(high[i])) for i, name in enumerate(space.names)}


def _directions(names: list[str], V: FloatArray, errors: FloatArray) -> list[Direction]:
    """The directions whose standard error is as large as the variables themselves."""
    found = []
    for direction, error in zip(V, errors, strict=True):
        if not error < _UNSURE:
            signed = direction * np.sign(direction[np.abs(direction).argmax()])
            shares = {
                name: float(share)
                for name, share in zip(names, signed, strict=True)
                if abs(share) > _SHOWN
            }
            found.append(Direction(float(error), shares))
    return sorted(found, key=lambda direction: -direction.standard_error)


def _require_scipy() -> Any:
    try:
        from scipy import optimize
    except ImportError as error:
        raise InvalidInput(
            f"fit: it needs SciPy: run  pip install 'diffcloth-torch[fit]'  ({error})"
        ) from error
    return optimize
