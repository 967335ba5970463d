"""How sure a fit is: covariances from the Jacobian, intervals, and what cannot be told apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.optimize.variables import Space

__all__ = ["Direction", "Uncertainty", "uncertainty_of"]

# Standard error of a direction, in sizes of its variables, from which on it is not known at all.
_UNSURE = 1.0
_SHOWN = 0.1  # share of a direction below which a variable is not named
_CONFIDENCE = 0.95
_TINY = 1e-300


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


class Uncertainty(NamedTuple):
    """What the Jacobian at a solution says.

    Attributes:
        covariance: Of the numbers, [p, p].
        correlation: Likewise.
        intervals: Name of each number -> its interval of 95 %.
        unidentifiable: Directions that the observations do not tell, the worst first.
        deviations: Standard error of each theta [p].
    """

    covariance: FloatArray
    correlation: FloatArray
    intervals: dict[str, tuple[float, float]]
    unidentifiable: list[Direction]
    deviations: FloatArray


def uncertainty_of(
    space: Space, theta: FloatArray, jacobian: FloatArray, cost: float
) -> Uncertainty:
    """Standard errors from J^T J at the solution, with the noise that the residuals show."""
    count, p = jacobian.shape
    noise = 2 * cost / max(count - p, 1)
    # In sizes of the variables, so that directions compare.
    units = space.units(theta)
    # With zero rows, where residuals are fewer than numbers, no direction is left out.
    rows = np.vstack([jacobian * units, np.zeros((max(p - count, 0), p))])
    _, singular, directions = np.linalg.svd(rows, full_matrices=False)
    errors = np.sqrt(noise) / np.maximum(singular, _TINY)
    spread = directions.T * errors  # columns: directions times their standard error
    with np.errstate(over="ignore", invalid="ignore"):
        of_theta = units[:, None] * (spread @ spread.T) * units
    rates = space.rates(theta)
    covariance = rates[:, None] * of_theta * rates
    deviations = np.sqrt(np.diag(covariance))
    return Uncertainty(
        covariance=covariance,
        correlation=covariance / np.maximum(np.outer(deviations, deviations), _TINY),
        intervals=_intervals(space, theta, np.sqrt(np.diag(of_theta)), count - p),
        unidentifiable=_directions(space.names, directions, errors),
        deviations=np.sqrt(np.diag(of_theta)),
    )


def _intervals(
    space: Space, theta: FloatArray, deviations: FloatArray, freedom: int
) -> dict[str, tuple[float, float]]:
    from scipy.stats import t

    reach = float(t.ppf(0.5 + _CONFIDENCE / 2, max(freedom, 1))) * deviations
    with np.errstate(over="ignore"):
        low, high = space.from_theta(theta - reach), space.from_theta(theta + reach)
    return {name: (float(low[i]), float(high[i])) for i, name in enumerate(space.names)}


def _directions(names: list[str], directions: FloatArray, errors: FloatArray) -> list[Direction]:
    """The directions whose standard error is as large as the variables themselves."""
    found = []
    for direction, error in zip(directions, errors, strict=True):
        if not error < _UNSURE:
            signed = direction * np.sign(direction[np.abs(direction).argmax()])
            shares = {
                name: float(share)
                for name, share in zip(names, signed, strict=True)
                if abs(share) > _SHOWN
            }
            found.append(Direction(float(error), shares))
    return sorted(found, key=lambda direction: -direction.standard_error)
