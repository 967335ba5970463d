"""After a fit: predictions with bands, and the expected information of a new recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.optimize.linearized import Linearized
from diffcloth_torch.optimize.problem import Memory, Problem, Residuals, blocks_at

__all__ = ["Prediction", "expected_half_widths", "predict"]


@dataclass(frozen=True, eq=False)
class Prediction:
    """A quantity at the fitted numbers, and its band of 95 %.

    Attributes:
        value: The quantity, of any shape.
        half_width: Half width of the interval of 95 %, in the shape of `value`. It includes the
            uncertainty of the fitted numbers and no noise of observations.
    """

    value: Tensor
    half_width: Tensor

    @property
    def low(self) -> Tensor:
        """Lower end of the band."""
        return self.value - self.half_width

    @property
    def high(self) -> Tensor:
        """Upper end of the band."""
        return self.value + self.half_width


def predict(model: Linearized, function: Residuals) -> Prediction:
    """Evaluate a function of the variables and its deviation sqrt(diag(G C G^T)) to first order.

    Args:
        model: Linear model of a fit, with the covariance C of theta.
        function: Function from parameters, and name -> value of other variables, to a tensor.
    """

    def at(theta: Tensor) -> Tensor:
        found = blocks_at(function, model.space.values(theta))
        if list(found) != ["residuals"]:
            raise TypeError("Fit.predict: `function` must return a tensor")
        return found["residuals"]

    theta = torch.from_numpy(np.array(model.theta))
    with torch.no_grad():
        value = at(theta)
    slopes = torch.func.jacfwd(at)(theta).reshape(-1, len(theta))
    root = torch.from_numpy(_root(model.covariance))
    deviations = (slopes @ root).norm(dim=1).reshape(value.shape)
    return Prediction(value, model.reach * deviations)


def expected_half_widths(model: Linearized, candidate: Residuals) -> dict[str, float]:
    """Half width of each number if a recording were added, from its Jacobian K alone.

    The covariance becomes (C^-1 + K^T K)^-1, independently of the recorded values.

    Args:
        model: Linear model of a fit, with the covariance C of theta.
        candidate: Residuals of the recording in units of its noise; only derivatives matter.
    """
    space = model.space
    problem = Problem(
        space,
        candidate,
        at=model.theta,
        rows=np.arange(len(space), dtype=np.int64),
        start=0,
        stage=0,
        memory=Memory(None, []),
        report=lambda _: None,
    )
    problem.require(model.theta)
    jacobian = problem.jacobian(model.theta)
    added = jacobian[: len(jacobian) - problem.prior_count]
    units = space.units(model.theta)
    rows = np.vstack([model.precision_root * units, added * units])
    _, singular, directions = np.linalg.svd(rows, full_matrices=False)
    if singular.min() <= 0.0:
        raise InvalidInput("Fit.information: `candidate` and the fit leave a number unknown")
    errors = units * np.linalg.norm(directions.T / singular, axis=1)
    widths = model.reach * errors * space.rates(model.theta)
    return {name: float(width) for name, width in zip(space.names, widths, strict=True)}


def _root(covariance: FloatArray) -> FloatArray:
    """A matrix R with R R^T = C."""
    if not np.isfinite(covariance).all():
        raise InvalidInput(
            "Fit.predict: the observations must determine every number; see `fit.unidentifiable`"
        )
    size, directions = np.linalg.eigh(covariance)
    root: FloatArray = directions * np.sqrt(np.maximum(size, 0.0))
    return root
