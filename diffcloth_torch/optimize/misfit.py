"""Sizes of residuals relative to their noise, by block, and the resulting warnings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import (
    CorrelatedResidualsWarning,
    ModelErrorWarning,
    NoiseWarning,
    warn_caller,
)
from diffcloth_torch.optimize.series import Layout, autocorrelation, persistence

__all__ = ["Block", "are_correlated", "blocks_of_fit", "warn_of_blocks"]

_RARE = 1e-3  # probability below which noise alone does not explain the residuals
_NOT_IN_UNITS = 1e-2  # root mean square below which residuals are not in units of their noise
_NOISELESS = 1e-5  # root mean square below which residuals are rounding and tolerances
_CHANCE = 5e-3  # approximate probability that white noise is classified as correlated


@dataclass(frozen=True)
class Block:
    """Residuals of one block relative to their noise.

    Attributes:
        count: Number of residuals.
        rms: Root mean square, about one if the model is right and the noise is known.
        chi2: Sum of squares.
        freedom: Expected value of `chi2`: the count minus the numbers that the block determines.
        p_value: Probability that noise alone makes the sum at least as large. NaN if residuals are
            too few, if the loss is robust, and below a root mean square of 0.01, where the
            residuals are not in units of their noise.
        autocorrelation: Correlation from one moment of a series to the next.
    """

    count: int
    rms: float
    chi2: float
    freedom: float
    p_value: float
    autocorrelation: float


def blocks_of_fit(
    residuals: FloatArray, layout: Layout, leverage: FloatArray, loss: str
) -> dict[str, Block]:
    """Describe each block.

    Args:
        residuals: Residuals at the solution [M].
        layout: Blocks and series of the residuals.
        leverage: Share of each residual that the fitted numbers absorb [M].
        loss: The loss of the fit.
    """
    from scipy.stats import chi2

    found = {}
    for k, name in enumerate(layout.names):
        rows, part = layout.part(k)
        square = float(residuals[rows] @ residuals[rows])
        freedom = len(rows) - float(leverage[rows].sum())
        rms = math.sqrt(square / max(len(rows), 1))
        known = loss == "linear" and freedom >= 1.0 and rms >= _NOT_IN_UNITS
        found[name] = Block(
            count=len(rows),
            rms=rms,
            chi2=square,
            freedom=freedom,
            p_value=float(chi2.sf(square, freedom)) if known else math.nan,
            autocorrelation=autocorrelation(residuals[rows], part)[0] if len(rows) else 0.0,
        )
    return found


def are_correlated(residuals: FloatArray, layout: Layout) -> bool:
    """Return whether residuals along the series of any block are correlated beyond chance."""
    from scipy.stats import norm

    if not len(residuals) or np.sqrt(np.square(residuals).mean()) < _NOISELESS:
        return False
    limit = float(norm.isf(_CHANCE / len(layout.names)))
    for k in range(len(layout.names)):
        rows, part = layout.part(k)
        if not len(rows):
            continue
        if persistence(residuals[rows], part) > limit:
            return True
    return False


def warn_of_blocks(blocks: dict[str, Block], noise_model: str, *, correlated: bool) -> None:
    """Warn of residuals that are too large or too small for their noise, or correlated."""
    limit = _RARE / len(blocks)
    for name, block in blocks.items():
        size = f"the residuals of {name!r} have a root mean square of {block.rms:.3g}"
        if block.p_value < limit:
            warn_caller(
                f"fit: {size}, in units of their noise, which noise alone exceeds with a "
                f"probability of {block.p_value:.2g}: the model is wrong or the noise is larger "
                "than given, and the intervals need not hold the true values",
                ModelErrorWarning,
            )
        elif block.p_value > 1.0 - limit and not correlated:
            warn_caller(
                f"fit: {size}, in units of their noise, which noise alone falls below with a "
                f"probability of {1 - block.p_value:.2g}: the noise is smaller than given",
                NoiseWarning,
            )
    if correlated and noise_model != "white noise":
        largest = max(blocks, key=lambda name: blocks[name].autocorrelation)
        warn_caller(
            "fit: residuals are correlated along their series, those of "
            f"{largest!r} by {blocks[largest].autocorrelation:.2f} from one moment to the next: "
            f"the covariance is that of {noise_model}, not of white noise",
            CorrelatedResidualsWarning,
        )
