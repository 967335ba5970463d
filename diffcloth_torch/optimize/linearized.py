"""The linear model of a fit around its solution: how its numbers follow a change of residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.optimize.variables import Space

__all__ = ["Linearized"]

_UNTOLD = 1e3  # factor, or sizes, to both sides of a number of which nothing is known
_SINGULAR = 1e-12  # singular values below this share of the largest belong to no known direction


@dataclass(frozen=True, eq=False)
class Linearized:
    """Residuals r(theta + d) = r + J d of the last stage, around the solution theta.

    Attributes:
        space: Space of theta.
        theta: The solution [p].
        residuals: There, without those of priors [M].
        jacobian: Their derivative by theta [M, p].
        weights: Weight of each residual in the cost [M]: one unless the loss is robust.
        half_widths: Half widths of the intervals of theta [p].
        covariance: Covariance of theta [p, p].
        precision_root: Rows R with R^T R the inverse of this covariance.
        reach: Half width of an interval of 95 % in standard errors.
    """

    space: Space
    theta: FloatArray
    residuals: FloatArray
    jacobian: FloatArray
    weights: FloatArray
    half_widths: FloatArray
    covariance: FloatArray
    precision_root: FloatArray
    reach: float

    def step(self, at: FloatArray, residuals: FloatArray) -> FloatArray:
        """Step [p] from `at` towards the least squares of other residuals, with this Jacobian.

        The gradient that is left at the solution, where a fit has not converged, is not followed.
        Numbers at a bound of the solution stay there, and no step leaves the bounds.
        """
        space, free = self.space, ~self.held
        units = space.units(self.theta)[free]
        roots = np.sqrt(self.weights)
        rows = np.vstack([roots[:, None] * self.jacobian, space.whitening])[:, free] * units
        change = residuals - self.residuals
        right = np.concatenate([roots * change, space.whitening @ (at - self.theta)])
        step = np.zeros(len(space))
        step[free] = -units * np.linalg.lstsq(rows, right, rcond=_SINGULAR)[0]
        return np.clip(at + step, space.low, space.high) - at

    @property
    def untold(self) -> list[str]:
        """Names of the numbers of which nothing is known: half widths of a thousand sizes."""
        sizes = self.half_widths / self.space.units(self.theta)
        limits = self.space.reach(_UNTOLD)
        return [name for name, far in zip(self.space.names, ~(sizes < limits), strict=True) if far]

    @property
    def held(self) -> NDArray[np.bool_]:
        """Numbers at a bound [p]."""
        at_bounds = self.space.at_bounds(self.theta)
        return np.array([name in at_bounds for name in self.space.names])
