"""Residuals of a fit: what was observed against what is simulated, in units of the noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.autograd.transforms import numbers_of
from diffcloth_torch.checks import (
    NON_NEGATIVE,
    ArrayLike,
    check_finite,
    check_range,
    check_shape,
    float_array,
    index_array,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.optimize.compared import (
    Comparison,
    check_count_of,
    checked_noise,
    checked_points,
    note,
    positions_of,
    times_of,
)
from diffcloth_torch.optimize.outlines import outline
from diffcloth_torch.sim.records.state import State

__all__ = ["markers", "outline", "point_cloud"]


def markers(
    states: Sequence[State],
    observed: ArrayLike,
    weights: ArrayLike | None = None,
    *,
    vertices: ArrayLike | None = None,
    noise: float = 1.0,
) -> Tensor:
    """Positions of marked vertices less those observed, over the noise.

    Args:
        states: T states without a batch axis, one for each observation.
        observed: Positions [m], shape [T, m, 3]; NaN where a marker was not seen.
        weights: Weight of each marker, >= 0, shape [m] or [T, m]; 1 by default. One of zero was
            not seen.
        vertices: Indices of the m marked vertices; None means all.
        noise: Standard deviation of an observation [m], > 0.

    Returns:
        Residuals [M] of what was seen, without unit; they have derivatives.

    Raises:
        InvalidInput: If a shape or value is not accepted.
    """
    owner = "residuals.markers"
    positions = positions_of(owner, states)
    rows = None
    if vertices is not None:
        rows = index_array(f"{owner}: `vertices`", vertices, positions.shape[1])
        positions = positions[:, torch.from_numpy(rows.astype(np.int64))]
    seen = float_array(f"{owner}: `observed`", observed)
    if seen.shape != tuple(positions.shape):
        raise InvalidInput(
            f"{owner}: `observed` must have shape {list(positions.shape)}, a row for each state "
            f"and marker, got {list(seen.shape)}"
        )
    known = np.where(np.isnan(seen), 0.0, seen)
    check_finite(f"{owner}: `observed`, where it is not NaN,", known)
    difference = (positions - torch.from_numpy(known)) / checked_noise(owner, noise)
    known_rows = ~np.isnan(seen)
    if weights is not None:
        given = float_array(f"{owner}: `weights`", weights)
        check_shape(f"{owner}: `weights`", given.shape, [seen.shape[1:2], seen.shape[:2]])
        check_range(f"{owner}: `weights`", given, NON_NEGATIVE)
        difference = difference * torch.from_numpy(given)[..., None]
        known_rows &= given[..., None] > 0.0
    mask = torch.from_numpy(known_rows)
    marked = range(positions.shape[1]) if rows is None else rows.tolist()
    note(
        Comparison(
            kind="markers",
            times=times_of(states),
            simulated=list(numbers_of(positions)),
            observed=list(seen),
            placed=list(seen),
            labels=[f"vertex {i}" for i in marked],
            noise=noise,
        )
    )
    return difference.flatten()[mask.flatten().nonzero()[:, 0]]


def point_cloud(
    states: Sequence[State], clouds: Sequence[ArrayLike], *, noise: float = 1.0
) -> Tensor:
    """Each observed point less the vertex of the cloths that is nearest to it, over the noise.

    One-sided, from what was seen to what is simulated: parts that no camera saw do not count. Which
    vertex is nearest is held fixed by derivatives.

    Args:
        states: T states without a batch axis, one for each cloud.
        clouds: Of each state the points [m], shape [n, 3], none of them NaN; n = 0 where the camera
            saw nothing.
        noise: Standard deviation of a point [m], > 0.

    Returns:
        Residuals [M] without unit, three for each point; they have derivatives.

    Raises:
        InvalidInput: If a shape or value is not accepted.
    """
    from scipy.spatial import cKDTree

    owner = "residuals.point_cloud"
    positions = positions_of(owner, states)
    scale = checked_noise(owner, noise)
    check_count_of(owner, "clouds", clouds, len(states))
    parts, nearest_points, seen = [], [], []
    for k, cloud in enumerate(clouds):
        points = checked_points(f"{owner}: `clouds`[{k}]", cloud)
        tree: Any = cKDTree(numbers_of(positions[k]))
        nearest = torch.from_numpy(np.asarray(tree.query(points)[1], dtype=np.int64))
        found = positions[k][nearest]
        parts.append((found - torch.from_numpy(points)).flatten())
        nearest_points.append(numbers_of(found))
        seen.append(points)
    most = max(map(len, seen))
    note(
        Comparison(
            kind="point_cloud",
            times=times_of(states),
            simulated=nearest_points,
            observed=seen,
            placed=seen,
            labels=[f"point {i}" for i in range(most)],
            noise=noise,
        )
    )
    return torch.cat(parts) / scale
