"""Residuals of a fit: what was observed against what is simulated, in units of the noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import FloatArray, float_array, index_array
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.sim.state import State
from diffcloth_torch.transforms import numbers_of

__all__ = ["markers", "point_cloud"]


def markers(
    states: Sequence[State],
    observed: object,
    *,
    vertices: object = None,
    noise: float = 1.0,
    weights: object = None,
) -> Tensor:
    """Positions of marked vertices less those observed, over the noise.

    Args:
        states: T states without a batch axis, one for each observation.
        observed: Positions [m], shape [T, m, 3]; NaN where a marker was not seen.
        vertices: Indices of the m marked vertices; None means all.
        noise: Standard deviation of an observation [m], > 0.
        weights: Weight of each marker, >= 0, shape [m] or [T, m]; 1 by default.

    Returns:
        Residuals [M] of what was seen, without unit; they have derivatives.

    Raises:
        InvalidInput: If a shape or value is not accepted.
    """
    positions = _positions("residuals.markers", states)
    rows = None
    if vertices is not None:
        rows = index_array("residuals.markers: `vertices`", vertices, positions.shape[1])
        positions = positions[:, torch.from_numpy(rows.astype(np.int64))]
    seen = _observed(observed)
    if seen.shape != tuple(positions.shape):
        raise InvalidInput(
            f"residuals.markers: `observed` must have shape {list(positions.shape)}, a row for "
            f"each state and marker, got {list(seen.shape)}"
        )
    difference = (positions - torch.from_numpy(np.nan_to_num(seen))) / _noise(noise)
    if weights is not None:
        given = float_array("residuals.markers: `weights`", weights)
        if given.shape not in (seen.shape[1:2], seen.shape[:2]) or (given < 0).any():
            raise InvalidInput(
                f"residuals.markers: `weights` must be at least 0, of shape {[seen.shape[1]]} or "
                f"{list(seen.shape[:2])}, got shape {list(given.shape)}"
            )
        difference = difference * torch.from_numpy(given)[..., None]
    mask = torch.from_numpy(~np.isnan(seen))
    return difference.flatten()[mask.flatten().nonzero()[:, 0]]


def point_cloud(states: Sequence[State], clouds: Sequence[object], *, noise: float = 1.0) -> Tensor:
    """Each observed point less the vertex of the cloths that is nearest to it, over the noise.

    One-sided, from what was seen to what is simulated: parts that no camera saw do not count. Which
    vertex is nearest is held fixed by derivatives.

    Args:
        states: T states without a batch axis, one for each cloud.
        clouds: Of each state the points [m], shape [n, 3], none of them NaN.
        noise: Standard deviation of a point [m], > 0.

    Returns:
        Residuals [M] without unit, three for each point; they have derivatives.

    Raises:
        InvalidInput: If a shape or value is not accepted.
    """
    from scipy.spatial import cKDTree

    positions = _positions("residuals.point_cloud", states)
    if len(clouds) != len(states):
        raise InvalidInput(
            f"residuals.point_cloud: `clouds` must be one for each of {len(states)} states, "
            f"got {len(clouds)}"
        )
    parts = []
    for k, cloud in enumerate(clouds):
        points = float_array(f"residuals.point_cloud: `clouds`[{k}]", cloud)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InvalidInput(
                f"residuals.point_cloud: `clouds`[{k}] must be finite, of shape [n, 3], "
                f"got shape {list(points.shape)}"
            )
        tree: Any = cKDTree(numbers_of(positions[k]))
        nearest = torch.from_numpy(np.asarray(tree.query(points)[1], dtype=np.int64))
        parts.append((positions[k][nearest] - torch.from_numpy(points)).flatten())
    return torch.cat(parts) / _noise(noise)


def _positions(owner: str, states: Sequence[State]) -> Tensor:
    if not len(states) or any(state.batch_size is not None for state in states):
        raise InvalidInput(f"{owner}: `states` must be one or more, without a batch axis")
    return torch.stack([state.positions for state in states])


def _observed(observed: object) -> FloatArray:
    return float_array("residuals.markers: `observed`", observed)


def _noise(noise: float) -> float:
    if not 0 < noise < np.inf:
        raise InvalidInput(f"residuals: `noise` must be greater than 0, got {noise}")
    return noise
