"""Bias of the time step or the mesh: solution of a fit of extrapolated residuals."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch

from diffcloth_torch.checks import POSITIVE, FloatArray, check_number
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.optimize.compared import noting
from diffcloth_torch.optimize.extrapolation import RATIOS, require_linear
from diffcloth_torch.optimize.linearized import Linearized
from diffcloth_torch.optimize.problem import Residuals, trajectories

__all__ = ["Limit", "factor_of", "limit_of", "moves_of"]

_SMALL = 0.1  # step in half widths below which the iteration ends
_TINY = 1e-300


def factor_of(owner: str, ratio: float, order: float) -> float:
    """Factor from the change of residuals to the whole error: q^n / (q^n - 1)."""
    base = check_number(f"{owner}: `ratio`", ratio, RATIOS)
    power = math.pow(base, check_number(f"{owner}: `order`", order, POSITIVE))
    return power / (power - 1)


class Limit(NamedTuple):
    """Theta without a bias, and the size of the last step in half widths of intervals."""

    theta: FloatArray
    last_step: float


def limit_of(
    owner: str,
    model: Linearized,
    coarse: Residuals | None,
    finer: Residuals,
    factor: float,
    max_evaluations: int,
) -> Limit:
    """Least-squares solution for r + factor (f - r), by Gauss-Newton steps with one Jacobian.

    Args:
        owner: Operation named in messages.
        model: Linear model of the fit.
        coarse: Residuals r of the fit; needed for more than one evaluation.
        finer: Residuals f with a smaller error.
        factor: See `factor_of`.
        max_evaluations: Largest number of evaluations of `finer`.
    """
    if not callable(finer):
        raise TypeError(f"{owner}: `finer` must be a function, got {type(finer).__name__}")
    at, found, last = model.theta, model.residuals, 0.0
    for k in range(max_evaluations):
        if k and coarse is not None:
            found = _evaluate(owner, model, coarse, at)
        fine = _evaluate(owner, model, finer, at)
        step = model.step(at, found + factor * (fine - found))
        at = at + step
        last = float((np.abs(step) / np.maximum(model.half_widths, _TINY)).max())
        if last <= _SMALL:
            break
    return Limit(at, last)


def moves_of(model: Linearized, at: FloatArray) -> str:
    """Describe the numbers whose shift exceeds the half width of their interval."""
    shares = np.abs(at - model.theta) / np.maximum(model.half_widths, _TINY)
    before, after = model.space.from_theta(model.theta), model.space.from_theta(at)
    return ", ".join(
        f"{model.space.names[i]} {after[i]:.4g} instead of {before[i]:.4g}, {shares[i]:.2g} half "
        "widths of its interval away"
        for i in np.flatnonzero(shares > 1.0)
    )


def _evaluate(owner: str, model: Linearized, residuals: Residuals, at: FloatArray) -> FloatArray:
    with torch.no_grad(), noting() as compared:
        parts = trajectories(residuals, model.space.values(torch.from_numpy(at)))
    require_linear(owner, compared)
    found: FloatArray = torch.cat([part.reshape(-1) for part in parts]).to(torch.float64).numpy()
    if len(found) != len(model.residuals):
        raise InvalidInput(
            f"{owner}: `finer` must return {len(model.residuals)} residuals, as in the fit, got "
            f"{len(found)}"
        )
    if not np.isfinite(found).all():
        k = int(np.flatnonzero(~np.isfinite(found))[0])
        raise InvalidInput(f"{owner}: `finer` must return finite numbers, got {found[k]} at [{k}]")
    return found
