"""Residuals of a fit: what was observed against what is simulated, in units of the noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import FloatArray, check_count, check_finite, float_array, index_array
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.optimize.compared import Comparison, note
from diffcloth_torch.sim.state import State
from diffcloth_torch.transforms import numbers_of

__all__ = ["markers", "outline", "point_cloud"]

_ROUNDING = 1e-9  # of shares of an edge
_NOT_CROSSED = 1e-300  # cross product below which an edge lies along a ray


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
    marked = range(positions.shape[1]) if rows is None else rows.tolist()
    note(
        Comparison(
            kind="markers",
            times=_times(states),
            simulated=list(numbers_of(positions)),
            observed=list(seen),
            labels=[f"vertex {i}" for i in marked],
            noise=noise,
        )
    )
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
    parts, nearest_points, seen = [], [], []
    for k, cloud in enumerate(clouds):
        points = float_array(f"residuals.point_cloud: `clouds`[{k}]", cloud)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InvalidInput(
                f"residuals.point_cloud: `clouds`[{k}] must be finite, of shape [n, 3], "
                f"got shape {list(points.shape)}"
            )
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
            times=_times(states),
            simulated=nearest_points,
            observed=seen,
            labels=[f"point {i}" for i in range(most)],
            noise=noise,
        )
    )
    return torch.cat(parts) / _noise(noise)


def outline(
    states: Sequence[State],
    outlines: Sequence[object],
    faces: object,
    *,
    center: object = (0.0, 0.0),
    directions: int = 72,
    noise: float = 1.0,
) -> Tensor:
    """Radius of the silhouette seen from above less that observed, over the noise.

    A camera above a draped disk, or a photograph of its shadow, shows an outline. Along each of
    some directions from the center, the silhouette ends where the last edge of the cloth crosses
    the ray. Which edge that is, is held fixed by derivatives.

    Args:
        states: T states without a batch axis, one for each outline.
        outlines: Of each state the corners of the observed outline, x and y [m] in order, shape
            [n, 2], at least three; from a photograph, after its scale and perspective are undone.
        faces: Triangles of the cloth, rows of the positions, shape [F, 3].
        center: A point x, y [m] that the silhouettes contain, as the middle of the pedestal.
        directions: Number of directions, >= 3, the first along x, evenly around z.
        noise: Standard deviation of a radius [m], > 0.

    Returns:
        Residuals [T * directions] without unit; they have derivatives.

    Raises:
        InvalidInput: If a shape or value is not accepted, or a silhouette leaves a direction empty.
    """
    owner = "residuals.outline"
    check_count(f"{owner}: `directions`", directions, 3)
    origin = float_array(f"{owner}: `center`", center)
    if origin.shape != (2,):
        raise InvalidInput(f"{owner}: `center` must have shape [2], got {list(origin.shape)}")
    if len(outlines) != len(states):
        raise InvalidInput(
            f"{owner}: `outlines` must be one for each of {len(states)} states, got {len(outlines)}"
        )
    silhouette, rays = silhouettes(owner, states, faces, origin, directions)
    seen = []
    for k, given in enumerate(outlines):
        corners = float_array(f"{owner}: `outlines`[{k}]", given)
        check_finite(f"{owner}: `outlines`[{k}]", corners)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise InvalidInput(
                f"{owner}: `outlines`[{k}] must have shape [n, 2] with n >= 3, "
                f"got {list(corners.shape)}"
            )
        ring = np.stack([np.arange(len(corners)), np.roll(np.arange(len(corners)), -1)], axis=1)
        polygon = torch.from_numpy(corners - origin)
        seen.append(_radii(f"{owner}: `outlines`[{k}]", polygon, ring, rays))
    observed = torch.stack(seen)
    note(
        Comparison(
            kind="outline",
            times=_times(states),
            simulated=list(origin + numbers_of(silhouette)[..., None] * rays),
            observed=list(origin + numbers_of(observed)[..., None] * rays),
            labels=[f"{360 * i / directions:.0f} degrees" for i in range(directions)],
            noise=noise,
        )
    )
    return (silhouette - observed).flatten() / _noise(noise)


def silhouettes(
    owner: str, states: Sequence[State], faces: object, center: FloatArray, directions: int
) -> tuple[Tensor, FloatArray]:
    """Radii of the silhouettes seen from above, [T, D], and the directions [D, 2]."""
    positions = _positions(owner, states)
    edges = _edges(index_array(f"{owner}: `faces`", faces, positions.shape[1]))
    angles = 2 * np.pi / directions * np.arange(directions)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    flat = positions[..., :2] - torch.from_numpy(center)
    radii = [
        _radii(f"{owner}: the silhouette of `states`[{k}]", points, edges, rays)
        for k, points in enumerate(flat)
    ]
    return torch.stack(radii), rays


def _radii(owner: str, points: Tensor, edges: Any, rays: FloatArray) -> Tensor:
    """Distance along each ray from the origin to the last edge that crosses it, shape [D].

    The point a + s (b - a) of an edge lies on the line of the ray d if
    d x a + s d x (b - a) = 0, with the cross product of the plane; it belongs to the edge if
    0 <= s <= 1.
    """
    flat = numbers_of(points)
    found, share = _crossings(flat[edges[:, 0]], flat[edges[:, 1]], rays)
    # A ray through a corner must not pass between the two edges that meet there.
    crosses = (share >= -_ROUNDING) & (share <= 1 + _ROUNDING) & (found > 0)
    found = np.where(crosses, found, -np.inf)
    last = found.argmax(axis=1)
    empty = np.isneginf(found.max(axis=1)).nonzero()[0]
    if len(empty):
        raise InvalidInput(
            f"{owner} must lie around `center`: no edge crosses the direction {rays[empty[0]]}"
        )
    a, b = (points[torch.from_numpy(edges[last, end])] for end in (0, 1))
    d = torch.from_numpy(rays)
    across = b - a
    s = -_cross(d, a) / _cross(d, across)
    return (d * (a + s[:, None] * across)).sum(dim=1)


def _crossings(a: FloatArray, b: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance along each ray to each edge, and the share of the edge before it, [D, E] each."""
    across = b - a
    above = rays[:, :1] * a[:, 1] - rays[:, 1:] * a[:, 0]
    below = rays[:, :1] * across[:, 1] - rays[:, 1:] * across[:, 0]
    along = np.abs(below) < _NOT_CROSSED
    share = np.where(along, np.nan, -above / np.where(along, 1.0, below))
    distance = rays @ a.T + share * (rays @ across.T)
    return distance, share


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _edges(faces: Any) -> Any:
    """Edges of triangles, each once, shape [E, 2]."""
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise InvalidInput(
            f"residuals.outline: `faces` must have shape [F, 3], got {list(faces.shape)}"
        )
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _times(states: Sequence[State]) -> FloatArray:
    return np.array([float(numbers_of(state.time)) for state in states])


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
