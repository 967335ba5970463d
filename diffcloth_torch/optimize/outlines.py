"""Outlines of silhouettes seen from above, as of a draped disk, and their residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.autograd.transforms import numbers_of
from diffcloth_torch.checks import (
    ArrayLike,
    FloatArray,
    check_bool,
    check_count,
    check_finite,
    check_shape,
    float_array,
    index_array,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.optimize.compared import (
    Comparison,
    check_count_of,
    checked_noise,
    note,
    positions_of,
    times_of,
)
from diffcloth_torch.sim.records.state import State

__all__ = ["outline", "silhouettes"]

_ROUNDING = 1e-9  # tolerance of the share of an edge at which a ray crosses it
_NOT_CROSSED = 1e-300  # cross product below which an edge lies along a ray
_ROUND = 1e-9  # relative size of a wave below which an outline is a circle without orientation
_PER_WAVE = 4  # smallest number of directions per wave that determines the orientation


def outline(
    states: Sequence[State],
    outlines: Sequence[ArrayLike],
    faces: ArrayLike,
    *,
    center: ArrayLike = (0.0, 0.0),
    directions: int = 72,
    noise: float = 1.0,
    turned: bool = False,
) -> Tensor:
    """Simulated minus observed radii of silhouettes seen from above, divided by the noise.

    A camera above a draped disk, or a photograph of its shadow, shows an outline. Along each of
    some directions from the center, the silhouette ends where the last edge of the cloth crosses
    the ray. Derivatives keep the choice of this edge fixed.

    Around a round pedestal, chance decides the places of a disk's folds. With `turned`, each
    silhouette is rotated about the center until its largest wave (three folds: the third harmonic
    of the radius) has the phase of the observed wave; among the rotations by whole folds, the one
    with the smallest sum of squares is used. Derivatives include the rotation. They have no meaning
    if the number of folds differs: start from a sheet with the observed number of folds.

    Args:
        states: T states without a batch axis, one for each outline.
        outlines: For each state, the corners of the observed outline, x and y [m] in order, shape
            [n, 2], at least three; for a photograph, after correction of scale and perspective.
        faces: Triangles of the cloth, rows of the positions, shape [F, 3].
        center: A point x, y [m] inside the silhouettes, such as the middle of the pedestal.
        directions: Number of directions, >= 3, the first along x, evenly around z; with `turned` at
            least four for each fold.
        noise: Standard deviation of a radius [m], > 0.
        turned: Whether silhouettes may be rotated about the center.

    Returns:
        Differentiable residuals [T * directions], without unit.

    Raises:
        InvalidInput: If a shape or value is not accepted, or a silhouette leaves a direction empty.
    """
    owner = "residuals.outline"
    scale = checked_noise(owner, noise)
    check_count(f"{owner}: `directions`", directions, 3)
    check_bool(f"{owner}: `turned`", turned)
    origin = float_array(f"{owner}: `center`", center)
    check_shape(f"{owner}: `center`", origin.shape, [(2,)])
    check_finite(f"{owner}: `center`", origin)
    flat, edges = _flattened(owner, states, faces, origin)
    check_count_of(owner, "outlines", outlines, len(states))
    rays = _rays(directions)
    radii, seen, turns = [], [], []
    for k, (points, given) in enumerate(zip(flat, outlines, strict=True)):
        observed = _observed(f"{owner}: `outlines`[{k}]", given, origin, rays)
        name = f"{owner}: the silhouette of `states`[{k}]"
        found = _radii(name, points, edges, rays)
        turn = 0.0
        if turned:
            found, turn = _turned(name, points, edges, found, observed)
        radii.append(found)
        seen.append(observed)
        turns.append(turn)
    simulated = torch.stack(radii)
    note(
        Comparison(
            kind="outline",
            times=times_of(states),
            simulated=list(origin + numbers_of(simulated)[..., None] * numbers_of(rays)),
            observed=[origin + numbers_of(radius)[:, None] * numbers_of(rays) for radius in seen],
            placed=[
                origin + numbers_of(radius)[:, None] * numbers_of(_rays(directions, turn))
                for radius, turn in zip(seen, turns, strict=True)
            ],
            labels=[f"{360 * i / directions:.0f} degrees" for i in range(directions)],
            noise=noise,
        )
    )
    return (simulated - torch.stack(seen)).flatten() / scale


def silhouettes(
    owner: str, states: Sequence[State], faces: object, center: FloatArray, directions: int
) -> tuple[Tensor, FloatArray]:
    """Radii of the silhouettes seen from above, [T, D], and the directions [D, 2]."""
    flat, edges = _flattened(owner, states, faces, center)
    rays = _rays(directions)
    radii = [
        _radii(f"{owner}: the silhouette of `states`[{k}]", points, edges, rays)
        for k, points in enumerate(flat)
    ]
    return torch.stack(radii), numbers_of(rays)


def _flattened(
    owner: str, states: Sequence[State], faces: object, center: FloatArray
) -> tuple[Tensor, Any]:
    """Vertices seen from above [T, N, 2], relative to the center, and their edges [E, 2]."""
    positions = positions_of(owner, states)
    triangles = index_array(f"{owner}: `faces`", faces, positions.shape[1])
    if triangles.ndim != 2 or triangles.shape[1] != 3 or not len(triangles):
        raise InvalidInput(
            f"{owner}: `faces` must have shape [F, 3] with F >= 1, got {list(triangles.shape)}"
        )
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges = np.unique(np.sort(pairs.astype(np.int64), axis=1), axis=0)
    return positions[..., :2] - torch.from_numpy(center), edges


def _rays(directions: int, turn: Tensor | float = 0.0) -> Tensor:
    angles = 2 * np.pi / directions * cpu.arange(directions, dtype=torch.float64) + turn
    return torch.stack([angles.cos(), angles.sin()], dim=1)


def _observed(name: str, outline: object, center: FloatArray, rays: Tensor) -> Tensor:
    """Radii of an observed outline, shape [D]."""
    corners = float_array(name, outline)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise InvalidInput(f"{name} must have shape [n, 2] with n >= 3, got {list(corners.shape)}")
    check_finite(name, corners)
    ring = np.stack([np.arange(len(corners)), np.roll(np.arange(len(corners)), -1)], axis=1)
    return _radii(name, torch.from_numpy(corners - center), ring, rays)


def _turned(
    owner: str, points: Tensor, edges: Any, found: Tensor, observed: Tensor
) -> tuple[Tensor, float]:
    """Radii of a silhouette, rotated to the observed orientation, shape [D], and the angle.

    The radius r(a) = sum_k c_k exp(i k a) has waves c_k, and the observed radius has waves d_k. Let
    d_m be the largest observed wave. With the angle b = (arg d_m - arg c_m) / m, the wave m of
    r(a + b) has the phase of d_m, and also with b + 2 pi j / m, for the m folds j.
    """
    count = len(observed)
    waves, seen = _waves(found), _waves(observed)
    largest = int(np.hypot(*numbers_of(seen)[1:].T).argmax()) + 1
    if count < _PER_WAVE * largest:
        raise InvalidInput(
            f"{owner}: `directions` must be at least {_PER_WAVE * largest} for an outline with "
            f"{largest} folds, got {count}"
        )
    if np.hypot(*numbers_of(waves)[largest]) < _ROUND * numbers_of(found).sum():
        return found, 0.0
    angle = (_phase(seen[largest]) - _phase(waves[largest])) / largest
    target, best, smallest = numbers_of(observed), (found, 0.0), np.inf
    for fold in range(largest):
        turn = angle + 2 * np.pi * fold / largest
        radii = _radii(owner, points, edges, _rays(count, turn))
        misfit = float(((numbers_of(radii) - target) ** 2).sum())
        if misfit < smallest:
            best, smallest = (radii, float(numbers_of(turn))), misfit
    return best


def _waves(radii: Tensor) -> Tensor:
    """Real and imaginary parts of the harmonics of radii below the highest, shape [D / 2, 2]."""
    count = len(radii)
    k = cpu.arange((count + 1) // 2, dtype=torch.float64)
    angles = 2 * np.pi / count * k[:, None] * cpu.arange(count, dtype=torch.float64)
    return torch.stack([angles.cos() @ radii, -(angles.sin() @ radii)], dim=1)


def _phase(wave: Tensor) -> Tensor:
    return torch.atan2(wave[1], wave[0])


def _radii(owner: str, points: Tensor, edges: Any, rays: Tensor) -> Tensor:
    """Distance along each ray from the origin to the last edge that crosses the ray, shape [D].

    The point a + s (b - a) lies on the line of the ray d if d x a + s d x (b - a) = 0, with the
    cross product of the plane; the point belongs to the edge if 0 <= s <= 1.
    """
    flat, along = numbers_of(points), numbers_of(rays)
    found, share = _crossings(flat[edges[:, 0]], flat[edges[:, 1]], along)
    # A ray through a corner must not pass between the two edges that meet there.
    crosses = (share >= -_ROUNDING) & (share <= 1 + _ROUNDING) & (found > 0)
    found = np.where(crosses, found, -np.inf)
    last = found.argmax(axis=1)
    empty = np.isneginf(found.max(axis=1)).nonzero()[0]
    if len(empty):
        raise InvalidInput(
            f"{owner} must lie around `center`: no edge crosses the direction {along[empty[0]]}"
        )
    a, b = (points[torch.from_numpy(edges[last, end])] for end in (0, 1))
    across = b - a
    s = -_cross(rays, a) / _cross(rays, across)
    return (rays * (a + s[:, None] * across)).sum(dim=1)


def _crossings(a: FloatArray, b: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance along each ray to each edge, and share of the edge before it, [D, E] each."""
    across = b - a
    above = rays[:, :1] * a[:, 1] - rays[:, 1:] * a[:, 0]
    below = rays[:, :1] * across[:, 1] - rays[:, 1:] * across[:, 0]
    along = np.abs(below) < _NOT_CROSSED
    share = np.where(along, np.nan, -above / np.where(along, 1.0, below))
    distance = rays @ a.T + share * (rays @ across.T)
    return distance, share


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
