"""Profiles of a fit: lowest cost at each value of one number, and the resulting interval."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.optimize.linearized import Linearized
from diffcloth_torch.optimize.methods import Options, solve
from diffcloth_torch.optimize.problem import FAILURES, Memory, Problem, Residuals
from diffcloth_torch.optimize.variables import Space

__all__ = ["Profile", "profile_of"]

_STEP = 0.5  # step in half widths
_MOST = 12  # points to each side
_UNKNOWN_STEP = 0.5  # step of theta if the linear model has no half width below 1e3


@dataclass(frozen=True, eq=False)
class Profile:
    """Lowest cost over all other numbers, at values of one number.

    Attributes:
        name: Name of the number.
        values: Values of the number, increasing [K].
        rises: Rise of the cost above the smallest cost at each value, in units of the rise at the
            ends of an interval of 95 % [K].
        interval: Values at which the rise is one. An end whose rise stays below one is the bound if
            the bound was reached, else infinite (zero on the scale "log").
    """

    name: str
    values: FloatArray = field(repr=False)
    rises: FloatArray = field(repr=False)
    interval: tuple[float, float]


def profile_of(
    residuals: Residuals, options: Options, model: Linearized, cost: float, row: int
) -> Profile:
    """Step to both sides of the solution, and fit the other numbers again at each point.

    The rise is scaled so that a quadratic cost has the interval of the linear model.

    Args:
        residuals: Residuals of the last stage of the fit.
        options: Options of the solver for the other numbers.
        model: The linear model at the solution.
        cost: Cost at the solution.
        row: Row of theta.
    """
    space, half = model.space, float(model.half_widths[row])
    rows = np.vstack([model.jacobian, space.whitening])
    others = np.delete(np.arange(len(space), dtype=np.int64), row)
    left = (
        rows[:, row]
        - rows[:, others] @ np.linalg.lstsq(rows[:, others], rows[:, row], rcond=None)[0]
    )
    with np.errstate(over="ignore", under="ignore"):
        unit = 0.5 * float(left @ left) * half**2
    step = _STEP * half if np.isfinite(half) and half < 1e3 else _UNKNOWN_STEP
    points = {float(model.theta[row]): 0.0}
    ends = []
    for sign in (-1.0, 1.0):
        bound = float(space.low[row] if sign < 0 else space.high[row])
        at, before, end = model.theta.copy(), (float(model.theta[row]), 0.0), sign * np.inf
        for _ in range(_MOST):
            value = at[row] + sign * step
            value = max(value, bound) if sign < 0 else min(value, bound)
            found = _lowest(residuals, options, space, at, row, others, value)
            if found is None:
                break
            at, lowest = found
            rise = (lowest - cost) / unit if 0.0 < unit < np.inf else 0.0
            points[value] = rise
            if rise >= 1.0:
                end = _crossing(before, (value, rise))
                break
            if value == bound:
                end = bound
                break
            before = value, rise
        ends.append(end)
    order = np.array(sorted(points))
    interval = [float(space.from_theta(_with(model.theta, row, end))[row]) for end in ends]
    return Profile(
        name=space.names[row],
        values=np.array([space.from_theta(_with(model.theta, row, v))[row] for v in order]),
        rises=np.array([points[v] for v in order]),
        interval=(interval[0], interval[1]),
    )


def _lowest(
    residuals: Residuals,
    options: Options,
    space: Space,
    at: FloatArray,
    row: int,
    others: NDArray[np.int64],
    value: float,
) -> tuple[FloatArray, float] | None:
    """Theta with the lowest cost at a value of one number, and the cost; None on failure."""
    there = _with(at, row, value)
    problem = Problem(
        space,
        residuals,
        at=there,
        rows=others if len(others) else np.array([row], dtype=np.int64),
        start=0,
        stage=0,
        memory=Memory(None, []),
        report=lambda _: None,
    )
    try:
        if not len(others):
            problem.require(there)
            found = problem.residuals(there)
            return there, 0.5 * float(found @ found)
        problem.require(there[others])
        end = solve(problem, there[others], space.low[others], space.high[others], options)
    except FAILURES:
        return None
    there[others] = end.theta
    return there, end.cost


def _crossing(before: tuple[float, float], after: tuple[float, float]) -> float:
    """Value at which the rise is one, by linear interpolation of the root of the rise."""
    low, high = (math.sqrt(max(rise, 0.0)) for _, rise in (before, after))
    return before[0] + (after[0] - before[0]) * (1.0 - low) / (high - low)


def _with(theta: FloatArray, row: int, value: float) -> FloatArray:
    changed = theta.copy()
    changed[row] = value
    return changed
