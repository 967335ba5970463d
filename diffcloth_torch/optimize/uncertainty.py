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
    space: Space, theta: FloatArray, jacobian: FloatArray, residuals: FloatArray
) -> Uncertainty:
    """Standard errors at the solution, from the noise that the residuals show and from the priors.

    With the variance s^2 of the residuals and the precisions P of the priors, the covariance is
    (J^T J / s^2 + P^2)^-1. Where residuals are too few to show the noise, and priors make up for
    them, s is one: the noise that was given.
    """
    count, p = jacobian.shape
    freedom = count - p
    given = freedom < 1 and bool(space.precisions.any())
    noise = 1.0 if given else np.sqrt(float(residuals @ residuals) / max(freedom, 1))
    # In sizes of the variables, so that directions compare.
    units = space.units(theta)
    priors = np.diag(space.precisions * units)
    _, singular, directions = np.linalg.svd(np.vstack([jacobian * units, priors * noise]))
    spread = directions.T * (noise / np.maximum(singular, _TINY))
    with np.errstate(over="ignore", invalid="ignore"):
        of_theta = units[:, None] * (spread @ spread.T) * units
    rates = space.rates(theta)
    covariance = rates[:, None] * of_theta * rates
    deviations = np.sqrt(np.diag(covariance))
    reach = _reach(np.inf if given else max(freedom, 1))
    return Uncertainty(
        covariance=covariance,
        correlation=_correlation(covariance, deviations),
        intervals=_intervals(space, theta, reach * np.sqrt(np.diag(of_theta))),
        unidentifiable=_directions(space.names, jacobian * units, noise),
        deviations=np.sqrt(np.diag(of_theta)),
    )


def _correlation(covariance: FloatArray, deviations: FloatArray) -> FloatArray:
    """Correlations; zero with a number of which nothing is known, whose variance is infinite."""
    with np.errstate(invalid="ignore"):
        found = covariance / np.maximum(np.outer(deviations, deviations), _TINY)
    found = np.where(np.isfinite(found), found, 0.0)
    np.fill_diagonal(found, 1.0)
    return found


def _reach(freedom: float) -> float:
    """Half of an interval of 95 %, in standard errors, of Student's t or of the normal law."""
    from scipy.stats import norm, t

    share = 0.5 + _CONFIDENCE / 2
    return float(norm.ppf(share) if np.isinf(freedom) else t.ppf(share, freedom))


def _intervals(
    space: Space, theta: FloatArray, reach: FloatArray
) -> dict[str, tuple[float, float]]:
    with np.errstate(over="ignore"):
        low, high = space.from_theta(theta - reach), space.from_theta(theta + reach)
    return {name: (float(low[i]), float(high[i])) for i, name in enumerate(space.names)}


def _directions(names: list[str], jacobian: FloatArray, noise: float) -> list[Direction]:
    """The directions whose standard error, without priors, is as large as the variables."""
    count, p = jacobian.shape
    # With zero rows, where residuals are fewer than numbers, no direction is left out.
    rows = np.vstack([jacobian, np.zeros((max(p - count, 0), p))])
    _, singular, directions = np.linalg.svd(rows, full_matrices=False)
    errors = noise / np.maximum(singular, _TINY)
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
