"""Linear model of a fit around its solution: response of its numbers to changed residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.optimize.variables import Space

__all__ = ["Linearized"]

_UNTOLD = 1e3  # half width (factor, or sizes) from which a number counts as unknown
_SINGULAR = 1e-12  # relative singular value below which a direction counts as unknown


@dataclass(frozen=True, eq=False)
class Linearized:
    """Residuals r(theta + d) = r + J d of the last stage, around the solution theta.

    Attributes:
        space: Space of theta.
        theta: The solution [p].
        residuals: Residuals at the solution, without residuals of priors [M].
        jacobian: Derivative of the residuals with respect to theta [M, p].
        weights: Weight of each residual in the cost [M]: one unless the loss is robust.
        half_widths: Half widths of the intervals of theta [p].
        covariance: Covariance of theta [p, p].
        precision_root: Matrix R whose R^T R is the inverse of the covariance.
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
        """Gauss-Newton step [p] from `at` for other residuals, with the Jacobian of this model.

        If the fit has not converged, the remaining gradient at the solution is ignored.
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
        """Names of unknown numbers: half width at least a factor of 1000 ("log") or 1000 sizes."""
        sizes = self.half_widths / self.space.units(self.theta)
        limits = self.space.reach(_UNTOLD)
        return [name for name, far in zip(self.space.names, ~(sizes < limits), strict=True) if far]

    @property
    def held(self) -> NDArray[np.bool_]:
        """Numbers at a bound [p]."""
        at_bounds = self.space.at_bounds(self.theta)
        return np.array([name in at_bounds for name in self.space.names])
