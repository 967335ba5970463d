"""Residuals as series over time: blocks, correlation along series, robust covariances."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.optimize.compared import Comparison

__all__ = ["Layout", "autocorrelation", "is_walk", "layout_of", "persistence", "stretches", "walk"]

_UNIT_ROOT = 14.0  # correlation times below which a series is near a unit root
_LAGS = 5  # most lags over which a correlation is summed
_NOTICED = 2.0  # standard deviations below which a correlation is ignored
_FEWEST = 8  # fewest pairs for a correlation
_MOST = 0.9  # share of a direction that one stretch may determine in its prediction


@dataclass(frozen=True, eq=False)
class Layout:
    """Places of the residuals [M] in blocks and series.

    Attributes:
        names: Name of each block.
        block: Block of each residual.
        series: Series of each residual, counted through all blocks.
        time: Index of the moment of each residual in its series.
    """

    names: list[str]
    block: NDArray[np.int64]
    series: NDArray[np.int64]
    time: NDArray[np.int64]

    def part(self, block: int) -> tuple[NDArray[np.int64], Layout]:
        """Indices of the residuals of one block, and their layout."""
        rows = np.flatnonzero(self.block == block)
        names = [self.names[block]]
        return rows, Layout(names, np.zeros_like(rows), self.series[rows], self.time[rows])

    def pairs(self, lag: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Residuals of the same series that are `lag` moments apart: earlier ones, later ones."""
        width = int(self.time.max()) + 1 + lag
        keys = self.series * width + self.time
        order = np.argsort(keys, kind="stable")
        at = np.searchsorted(keys[order], keys + lag)
        inside = at < len(keys)
        later = order[np.where(inside, at, 0)]
        found = inside & (keys[later] == keys + lag)
        return np.flatnonzero(found), later[found]


def layout_of(blocks: Mapping[str, Tensor], compared: Sequence[Comparison]) -> Layout:
    """Find the series: coordinates of markers, else along the first axis of each block.

    Args:
        blocks: Name -> residuals; a vector is one series in its order.
        compared: Comparisons noted while the blocks were computed; markers have a mask `used`.
    """
    used = [comparison.used for comparison in compared]
    matched = len(used) == len(blocks) and all(
        mask is not None and block.dim() == 1 and int(mask.sum()) == block.numel()
        for mask, block in zip(used, blocks.values(), strict=True)
    )
    numbers: list[NDArray[np.int64]] = []
    series: list[NDArray[np.int64]] = []
    times: list[NDArray[np.int64]] = []
    first = 0
    for k, block in enumerate(blocks.values()):
        mask = used[k] if matched else np.ones(tuple(block.shape) or (1,), dtype=np.bool_)
        assert mask is not None
        rows, columns = np.nonzero(mask.reshape(len(mask), -1) if mask.size else mask[:, None])
        times.append(rows)
        series.append(columns + first)
        numbers.append(np.full(len(rows), k))
        first += int(columns.max(initial=-1)) + 1
    empty = np.zeros(0, dtype=np.int64)
    joined = (np.concatenate([empty, *part]) for part in (numbers, series, times))
    return Layout(list(blocks), *joined)


def autocorrelation(residuals: FloatArray, layout: Layout, lag: int = 1) -> tuple[float, int]:
    """Correlation about zero of moments of a series that are `lag` apart; number of pairs."""
    early, late = layout.pairs(lag)
    a, b = residuals[early], residuals[late]
    size = 0.5 * float(a @ a + b @ b)
    return (float(a @ b) / size if size > 0.0 else 0.0), len(a)


def persistence(residuals: FloatArray, layout: Layout) -> float:
    """Correlation along series in its standard deviations under white noise.

    The larger of the correlation at lag one and the sum over several lags; the sum detects slow
    changes beneath much white noise.
    """
    found = [autocorrelation(residuals, layout, lag) for lag in _lags(layout)]
    if found[0][1] < _FEWEST:
        return 0.0
    sizes = [correlation * np.sqrt(pairs) for correlation, pairs in found]
    return float(max(sizes[0], sum(sizes) / np.sqrt(len(sizes))))


def _lags(layout: Layout) -> range:
    return range(1, 1 + int(np.clip(_length(layout) / 4, 1, _LAGS)))


def _decay(residuals: FloatArray, layout: Layout, numbers: int) -> float:
    """Decay of the correlation from one moment to the next, with white noise added.

    The ratio phi of the sums of autocovariances from lag 2 on and from lag 1 on, plus the bias of
    such an estimate for a series of n moments, (1 + 3 phi) / n (Kendall, 1954), and 2 / n for each
    fitted number per series.
    """
    g = []
    for lag in [*_lags(layout), _lags(layout).stop]:
        early, late = layout.pairs(lag)
        g.append(float(residuals[early] @ residuals[late]) / max(len(early), 1))
    if persistence(residuals, layout) < _NOTICED or sum(g[:-1]) <= 0.0:
        return 0.0
    phi = float(np.clip(sum(g[1:]) / sum(g[:-1]), 0.0, 1.0))
    count = len(np.unique(layout.series))
    return min(phi + (1 + 3 * phi + 2 * numbers / count) / max(_length(layout), 1.0), 1.0)


def _length(layout: Layout) -> float:
    """Mean number of moments of a series."""
    return len(layout.series) / max(len(np.unique(layout.series)), 1)


def is_walk(residuals: FloatArray, layout: Layout, numbers: int) -> bool:
    """Return whether series are short enough, relative to their correlation time, for walks.

    Args:
        residuals: Residuals [M].
        layout: Series of the residuals.
        numbers: Number of fitted numbers.
    """
    decay = _decay(residuals, layout, numbers)
    return decay > 1.0 - _UNIT_ROOT / max(_length(layout), 1.0)


def stretches(
    residuals: FloatArray, layout: Layout, numbers: int
) -> tuple[Callable[[FloatArray], FloatArray], float]:
    """Covariance C of residuals from stretches of the series, and the number of stretches.

    A stretch is two correlation times long; stretches are assumed to be independent of each other.
    Each stretch is predicted from all others, as in the jackknife, since a fit reduces its own
    residuals (CR3: Bell and McCaffrey, 2002).

    Returns:
        U^T C U [p, p] as a function of orthonormal directions U [M, p], and the number.
    """
    decay = min(_decay(residuals, layout, numbers), 0.999)
    time = -1.0 / np.log(decay) if decay > 0.0 else 0.0
    length = max(2, int(np.ceil(2 * time)))
    width = int(layout.time.max()) // length + 1
    _, rows = np.unique(layout.series * width + layout.time // length, return_inverse=True)
    count = int(rows.max()) + 1

    def spread(directions: FloatArray) -> FloatArray:
        p = directions.shape[1]
        scores, shares = np.zeros((count, p)), np.zeros((count, p, p))
        np.add.at(scores, rows, directions * residuals[:, None])
        np.add.at(shares, rows, directions[:, :, None] * directions[:, None, :])
        left = (
            np.eye(p)
            - np.minimum(1.0, _MOST / np.linalg.norm(shares, 2, (1, 2)))[:, None, None] * shares
        )
        scores = np.linalg.solve(left, scores[..., None])[..., 0]
        return (count - 1) / count * scores.T @ scores

    return spread, float(count)


def walk(residuals: FloatArray, layout: Layout, directions: FloatArray) -> FloatArray:
    """U^T C U for random walks plus white noise, with variances estimated from the increments.

    Increments of a walk with the variance w a moment, seen with white noise of the variance n,
    have the variance w + 2 n and the covariance -n from one to the next. A walk begins at zero, one
    moment before its first residual.
    """
    m, p = directions.shape
    found = np.zeros((p, p))
    for block in range(len(layout.names)):
        rows, part = layout.part(block)
        if not len(rows):
            continue
        step, noise = _increments(residuals[rows], part)
        factor = m / max(m - p, 1)
        _, series = np.unique(part.series, return_inverse=True)
        placed = np.zeros((int(part.time.max()) + 1, int(series.max()) + 1, p))
        placed[part.time, series] = directions[rows]
        after = placed[::-1].cumsum(axis=0)
        found += factor * step * np.einsum("tsi,tsj->ij", after, after)
        found += factor * noise * directions[rows].T @ directions[rows]
    return found


def _increments(residuals: FloatArray, layout: Layout) -> tuple[float, float]:
    """Variances of the walk's steps and of the white noise; without increments all is noise."""
    early, late = layout.pairs(1)
    if not len(early):
        return 0.0, float(np.square(residuals).mean())
    change = np.full(len(residuals), np.nan)
    change[early] = residuals[late] - residuals[early]
    variance = float(np.nanmean(change**2))
    both = change[early] * change[late]
    covariance = 0.0 if np.isnan(both).all() else float(np.nanmean(both))
    noise = float(np.clip(-covariance, 0.0, 0.5 * variance))
    return variance - 2 * noise, noise
