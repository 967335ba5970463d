"""Solvers of one stage of a fit: SciPy's, and the optimizers of torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import SimulationError
from diffcloth_torch.optimize.descent import TrialError, descend
from diffcloth_torch.optimize.problem import Problem

__all__ = ["METHODS", "Method", "Options", "Solution", "solve"]

METHODS = ("least_squares", "L-BFGS-B")
_TINY = 1e-300

Method = str | Callable[[list[Tensor]], torch.optim.Optimizer]
"""Name of a solver of SciPy, or a function that makes an optimizer of torch."""


@dataclass(frozen=True, eq=False)
class Options:
    """Options of the solver of a stage.

    Attributes:
        method: The solver.
        loss: Loss of the squared residuals, for "least_squares" only.
        loss_scale: Residual above which a robust loss reduces the weight.
        max_evaluations: Largest number of evaluations of the residuals.
        tolerance: Relative change of the cost or the variables at which the solver ends.
    """

    method: Method
    loss: str
    loss_scale: float
    max_evaluations: int
    tolerance: float

    def described(self) -> list[Any]:
        """Return an identification of saved evaluations, in types that `torch.load` reads."""
        method = self.method if isinstance(self.method, str) else "torch"
        return [method, self.loss, self.loss_scale, self.max_evaluations, self.tolerance]


@dataclass(frozen=True, eq=False)
class Solution:
    """End point of a solver.

    Attributes:
        theta: The free part of theta.
        cost: Cost at theta.
        residuals: Residuals at theta; residuals of priors are last.
        jacobian: Jacobian at theta.
        success: Whether the solver converged.
        message: Reason of the end.
    """

    theta: FloatArray
    cost: float
    residuals: FloatArray
    jacobian: FloatArray
    success: bool
    message: str


def solve(
    problem: Problem, first: FloatArray, low: FloatArray, high: FloatArray, options: Options
) -> Solution:
    """Minimize half the sum of squares of a problem within bounds."""
    if options.method == "least_squares":
        return _least_squares(problem, first, low, high, options)
    if options.method == "L-BFGS-B":
        theta, success, message = _l_bfgs_b(problem, first, low, high, options)
    else:
        theta, success, message = _by_torch(problem, first, low, high, options)
    found = problem.residuals(theta)
    return Solution(
        theta=theta,
        cost=0.5 * float(found @ found),
        residuals=found,
        jacobian=problem.jacobian(theta),
        success=success,
        message=message,
    )


def _least_squares(
    problem: Problem, first: FloatArray, low: FloatArray, high: FloatArray, options: Options
) -> Solution:
    from scipy.optimize import least_squares

    end = least_squares(
        problem.residuals,
        first,
        jac=problem.jacobian,
        bounds=(low, high),
        method="trf",
        x_scale="jac",
        loss=options.loss,
        f_scale=options.loss_scale,
        max_nfev=options.max_evaluations,
        ftol=options.tolerance,
        xtol=options.tolerance,
        gtol=options.tolerance,
    )
    return Solution(
        theta=end.x,
        cost=float(end.cost),
        residuals=end.fun,
        jacobian=problem.jacobian(end.x),  # end.jac is scaled by the weights of the loss
        success=bool(end.success),
        message=str(end.message),
    )


def _l_bfgs_b(
    problem: Problem, first: FloatArray, low: FloatArray, high: FloatArray, options: Options
) -> tuple[FloatArray, bool, str]:
    from scipy.optimize import minimize

    best, theta = np.inf, first
    highest = 0.0

    def cost(at: FloatArray) -> tuple[float, FloatArray]:
        nonlocal best, theta, highest
        found = problem.cost_and_gradient(at)
        if found is None:
            # The line search interpolates costs and accepts no infinite cost. A failed trial
            # therefore reports a slope that rises from the best point, above all costs so far.
            away = at - theta
            wall = 2 * highest + 1.0
            return wall, wall * away / max(float(away @ away), _TINY)
        highest = max(highest, found[0])
        if found[0] < best:
            best, theta = found[0], at.copy()
        return found

    end = minimize(
        cost,
        first,
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(low, high, strict=True)),
        options={
            "maxfun": options.max_evaluations,
            "ftol": options.tolerance,
            "gtol": options.tolerance,
        },
    )
    return theta, bool(end.success), str(end.message)


def _by_torch(
    problem: Problem, first: FloatArray, low: FloatArray, high: FloatArray, options: Options
) -> tuple[FloatArray, bool, str]:
    method: Any = options.method
    theta = torch.from_numpy(first.copy()).requires_grad_()
    lowest, highest = torch.from_numpy(low), torch.from_numpy(high)
    best: tuple[float, FloatArray] = (np.inf, first)
    costs: list[float] = []

    def loss(_: object) -> Tensor:
        nonlocal best
        inside = theta.clamp(lowest, highest)
        at = inside.detach().numpy().copy()
        found = problem.cost_and_gradient(at)
        if found is None:
            failure = problem.failure(at)
            raise TrialError(str(failure)) from failure
        cost, gradient = found
        costs.append(cost)
        if cost < best[0]:
            best = cost, at
        # A surrogate with this value and gradient, since both may come from an earlier run.
        return cost + (torch.from_numpy(gradient) * (inside - inside.detach())).sum()

    end = ""
    try:
        descend(lambda _: [], loss, {"theta": theta}, method, iterations=options.max_evaluations)
    except SimulationError as error:
        if not costs:
            raise
        end = f"; then {error}"
    change = abs(costs[-1] - costs[-2]) if len(costs) > 1 else np.inf
    name = getattr(getattr(method, "func", method), "__name__", type(method).__name__)
    message = f"{len(costs)} steps of {name}; the last one changed the cost by {change:.3g}{end}"
    return best[1], not end and bool(change <= options.tolerance * best[0]), message
