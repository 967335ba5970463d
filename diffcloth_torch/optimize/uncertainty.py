"""Uncertainty of a fit: covariances from the Jacobian, intervals, and unknown directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.optimize.variables import Space

__all__ = [
    "Collinear",
    "Direction",
    "Noise",
    "Spread",
    "Uncertainty",
    "leverages",
    "noise_of",
    "uncertainty_of",
    "weights_of",
]

# Standard error of a direction, in sizes of its variables, from which the direction is unknown.
_UNSURE = 1.0
_NOTHING = 1e6  # standard error of a direction from which its singular value is rounding
_SHOWN = 0.1  # share of a direction below which a variable is not named
_CONFIDENCE = 0.95
_COLLINEAR = 0.1  # ratio of the error with known others to the error, below which a number is named
_KNOWN = 0.01  # standard error, in sizes of a number, below which the number is not named
_SINGULAR = 1e-12  # relative singular value below which a direction counts as unknown
_TINY = 1e-300

Spread = Callable[[FloatArray], FloatArray]
"""Function from directions U [M, p] to U^T C U [p, p], with the covariance C of the residuals."""


@dataclass(frozen=True, eq=False)
class Direction:
    """A combination of variables that the observations do not determine.

    Attributes:
        standard_error: Standard error of the combination, in sizes of its variables: relative on
            the scale "log".
        shares: Name of a number -> its share in the combination, which has length one.
    """

    standard_error: float
    shares: dict[str, float]

    def __str__(self) -> str:
        """Name the variables and their signs."""
        parts = [f"{share:+.2f} {name}" for name, share in self.shares.items()]
        if not self.standard_error < _NOTHING:
            return f"{' '.join(parts)} (not seen in the observations at all)"
        return f"{' '.join(parts)} (standard error {self.standard_error:.2g})"


@dataclass(frozen=True)
class Collinear:
    """A number that the observations determine almost only together with others.

    Attributes:
        name: Name of the number.
        other: Name of the number with the largest correlation.
        correlation: Correlation of both numbers.
        standard_error: Standard error of the number in its size: relative on the scale "log".
        error_if_known: Standard error if all other numbers were known.
    """

    name: str
    other: str
    correlation: float
    standard_error: float
    error_if_known: float

    def __str__(self) -> str:
        """Describe the number and the other one."""
        return (
            f"{self.name} has a standard error of {self.standard_error:.2g}, and would have "
            f"{self.error_if_known:.2g} if all other numbers were known; its largest correlation "
            f"is {self.correlation:+.3f}, with {self.other}"
        )


class Uncertainty(NamedTuple):
    """Uncertainty from the Jacobian at a solution.

    Attributes:
        covariance: Covariance of the numbers, [p, p].
        correlation: Correlation of the numbers, [p, p].
        intervals: Name of each number -> its interval of 95 %.
        unidentifiable: Directions that the observations do not determine, the worst first.
        collinear: Numbers that are known almost only together with another.
        deviations: Standard error of each theta [p].
        half_widths: Half widths of the intervals of theta [p].
        of_theta: Covariance of theta [p, p].
        precision_root: Matrix R whose R^T R is the inverse of the covariance of theta.
        reach: Half width of an interval of 95 % in standard errors.
    """

    covariance: FloatArray
    correlation: FloatArray
    intervals: dict[str, tuple[float, float]]
    unidentifiable: list[Direction]
    collinear: list[Collinear]
    deviations: FloatArray
    half_widths: FloatArray
    of_theta: FloatArray
    precision_root: FloatArray
    reach: float


class Noise(NamedTuple):
    """Standard deviation of the residuals.

    Attributes:
        deviation: The standard deviation.
        freedom: Degrees of freedom of its estimate; infinite if the given noise is assumed.
    """

    deviation: float
    freedom: float


def noise_of(residuals: FloatArray, numbers: int, loss: str, scale: float) -> Noise:
    """Noise estimated from the residuals of a fit; one if there are too few residuals.

    Let psi be half the derivative of the loss with respect to a residual (its influence). The
    numbers spread as with residuals of the variance  sum psi^2 / (M - p) / (mean psi')^2:  Huber,
    Robust Statistics, 1981, chapter 7. With the loss "linear", psi is the residual.
    """
    freedom = len(residuals) - numbers
    if freedom < 1:
        return Noise(1.0, np.inf)
    weights, slope = weights_of(residuals, loss, scale)
    influence = weights * residuals
    deviation = np.sqrt(float(influence @ influence) / freedom) / max(float(slope.mean()), _TINY)
    return Noise(float(deviation), freedom)


def leverages(space: Space, theta: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Share of each residual that the fitted numbers absorb [M]: the diagonal of J H^-1 J^T."""
    units = space.units(theta)
    rows = np.vstack([jacobian * units, space.whitening * units])
    left, singular, _ = np.linalg.svd(rows, full_matrices=False)
    known = singular > _SINGULAR * singular.max()
    shares: FloatArray = np.square(left[: len(jacobian), known]).sum(axis=1)
    return shares


def weights_of(residuals: FloatArray, loss: str, scale: float) -> tuple[FloatArray, FloatArray]:
    """Weights w of residuals r in the gradient of the cost, w r, and the derivatives of w r by r.

    The losses are defined as in SciPy.
    """
    z = np.square(residuals / scale)
    if loss == "linear":
        first, second = np.ones_like(z), np.zeros_like(z)
    elif loss == "soft_l1":
        first, second = (1 + z) ** -0.5, -0.5 * (1 + z) ** -1.5
    elif loss == "huber":
        far = np.maximum(z, 1.0)
        first, second = far**-0.5, np.where(z > 1.0, -0.5 * far**-1.5, 0.0)
    elif loss == "cauchy":
        first, second = 1 / (1 + z), -1 / np.square(1 + z)
    else:
        first, second = 1 / (1 + z * z), -2 * z / np.square(1 + z * z)
    return first, first + 2 * z * second


def uncertainty_of(
    space: Space, theta: FloatArray, jacobian: FloatArray, found: Noise, spread: Spread | None
) -> Uncertainty:
    """Standard errors at the solution, from the noise of the residuals and from the priors.

    With the variance s^2 of white residuals and the precisions P of the priors, the covariance is
    (J^T J / s^2 + P^2)^-1. For a general covariance C of the residuals, the covariance is
    H^-1 (J^T C J + P^2) H^-1 with H = J^T J + P^2, the spread of the least-squares solution.
    """
    noise = found.deviation
    # Scaled by the sizes of the variables, so that directions are comparable.
    units = space.units(theta)
    priors = space.whitening * units
    scale = noise if spread is None else 1.0
    # Zero rows keep all directions if there are fewer residuals than numbers.
    rows = np.vstack([jacobian * units, priors * scale, np.zeros((len(space), len(space)))])
    left, singular, directions = np.linalg.svd(rows, full_matrices=False)
    if spread is None:
        middle = noise**2 * np.eye(len(singular))
    else:
        data, known = left[: len(jacobian)], left[len(jacobian) :]
        middle = spread(data) + known.T @ known
        unknown = singular <= _SINGULAR * singular.max()
        middle[unknown] = middle[:, unknown] = 0.0
        middle[unknown, unknown] = 1.0
    root = directions.T / np.maximum(singular, _TINY)
    with np.errstate(over="ignore", invalid="ignore"):
        of_theta = units[:, None] * (root @ middle @ root.T) * units
    rates = space.rates(theta)
    covariance = rates[:, None] * of_theta * rates
    deviations = np.sqrt(np.diag(covariance))
    errors = np.sqrt(np.diag(of_theta))
    reach = _reach(found.freedom)
    half_widths = reach * errors
    correlation = _correlation(covariance, deviations)
    alone = _alone(jacobian * units, priors * scale, noise, spread)
    return Uncertainty(
        covariance=covariance,
        correlation=correlation,
        intervals=_intervals(space, theta, half_widths),
        unidentifiable=_directions(space.names, jacobian * units, noise),
        collinear=_collinear(space.names, correlation, errors / units, alone),
        deviations=errors,
        half_widths=half_widths,
        of_theta=of_theta,
        precision_root=_inverse_root(middle) @ (singular[:, None] * directions / units),
        reach=reach,
    )


def _inverse_root(middle: FloatArray) -> FloatArray:
    """Matrix R with R^T R = M^-1; huge where M is zero, as for residuals without noise.

    The covariance V S^-1 M S^-1 V^T has the inverse Q^T Q with Q = R S V^T.
    """
    sizes, directions = np.linalg.eigh(middle)
    root: FloatArray = (directions / np.sqrt(np.maximum(sizes, _TINY))).T
    return root


def _alone(
    jacobian: FloatArray, priors: FloatArray, noise: float, spread: Spread | None
) -> FloatArray:
    """Standard error of each number if all others were known [p], with the noise of the fit."""
    sizes = np.linalg.norm(np.vstack([jacobian, priors]), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        if spread is None:
            return np.asarray(noise / sizes)
        columns, known = jacobian / sizes, np.square(priors / sizes).sum(axis=0)
        middle = [spread(columns[:, [i]])[0, 0] + known[i] for i in np.flatnonzero(sizes)]
    errors = np.full(len(sizes), np.inf)
    errors[sizes > 0] = np.sqrt(middle) / sizes[sizes > 0]
    return errors


def _collinear(
    names: list[str], correlation: FloatArray, errors: FloatArray, alone: FloatArray
) -> list[Collinear]:
    """Numbers whose error would be ten times smaller if all others were known."""
    found = []
    for i, name in enumerate(names):
        if not (alone[i] < _COLLINEAR * errors[i] < np.inf and errors[i] > _KNOWN):
            continue
        others = np.abs(correlation[i])
        others[i] = 0.0
        k = int(others.argmax())
        found.append(
            Collinear(name, names[k], float(correlation[i, k]), float(errors[i]), float(alone[i]))
        )
    return sorted(found, key=lambda pair: pair.error_if_known / pair.standard_error)


def _correlation(covariance: FloatArray, deviations: FloatArray) -> FloatArray:
    """Correlations; zero for unknown numbers, whose variance is infinite."""
    with np.errstate(invalid="ignore"):
        found = covariance / np.maximum(np.outer(deviations, deviations), _TINY)
    found = np.where(np.isfinite(found), found, 0.0)
    np.fill_diagonal(found, 1.0)
    return found


def _reach(freedom: float) -> float:
    """Half width of an interval of 95 % in standard errors: Student's t or normal distribution."""
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
    """Directions whose standard error without priors is at least the size of the variables."""
    count, p = jacobian.shape
    # Zero rows keep all directions if there are fewer residuals than numbers.
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
