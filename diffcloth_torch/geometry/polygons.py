"""Polygons cut into triangles, and vertices that coincide merged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput

__all__ = ["triangulated", "welded"]

Indices = NDArray[np.int64]

_CROSSED = "must not cross itself: triangles cannot cover it once"


def triangulated(path: str, vertices: FloatArray, polygons: Sequence[Sequence[int]]) -> Indices:
    """Cut polygons into triangles, with ears of the shortest diagonals first.

    A quad is cut along its shorter diagonal, unless it has a corner that points inwards. Triangles
    have the orientation of their polygon, and stay in its order. A corner at the position of the
    previous one yields a triangle without area.

    Args:
        path: Prefix of messages.
        vertices: Vertices [n, 3].
        polygons: Indices of the corners of each.

    Returns:
        Corners [f, 3] as positions in the list of all corners, one polygon after the other.

    Raises:
        InvalidInput: If a polygon has no area or crosses itself.
    """
    triangles: list[tuple[int, ...]] = []
    first = 0
    for face, polygon in enumerate(polygons):
        try:
            cut = [(0, 1, 2)] if len(polygon) == 3 else _ears(vertices[np.asarray(polygon)])
        except ValueError as error:
            raise InvalidInput(f"{path}: face {face} {error}") from error
        triangles += [tuple(first + corner for corner in triangle) for triangle in cut]
        first += len(polygon)
    return np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _ears(points: FloatArray) -> list[tuple[int, int, int]]:
    """Triangles of a polygon [k, 3], by its corners."""
    flat = _in_plane(points)
    left = list(range(len(points)))
    triangles = []
    for corner in range(len(points)):
        i = left.index(corner)
        if (points[corner] == points[left[i - 1]]).all():
            triangles.append((left[i - 1], corner, left[(i + 1) % len(left)]))
            del left[i]
    while len(left) > 3:
        best: tuple[float, int] | None = None
        for i in range(len(left)):
            a, b, c = left[i - 1], left[i], left[(i + 1) % len(left)]
            if not _is_ear(flat, a, b, c, left):
                continue
            length = float(np.linalg.norm(points[c] - points[a]))
            # The first one among diagonals of equal length up to rounding.
            if best is None or length < best[0] * (1 - 1e-9):
                best = length, i
        if best is None:
            raise ValueError(_CROSSED)
        i = best[1]
        triangles.append((left[i - 1], left[i], left[(i + 1) % len(left)]))
        del left[i]
    a, b, c = left
    if _turn(flat[a], flat[b], flat[c]) <= 0.0:
        raise ValueError(_CROSSED)
    return [*triangles, (a, b, c)]


def _in_plane(points: FloatArray) -> FloatArray:
    """Coordinates [k, 2] in the plane of the mean normal, in which the polygon turns left."""
    center = points - points.mean(axis=0)
    normal = np.cross(center, np.roll(center, -1, axis=0)).sum(axis=0)
    length = np.linalg.norm(normal)
    if not length > 0.0:
        raise ValueError("must have an area > 0")
    normal /= length
    along = np.eye(3)[np.argmin(np.abs(normal))]
    along = along - (along @ normal) * normal
    along /= np.linalg.norm(along)
    return np.stack([center @ along, center @ np.cross(normal, along)], axis=1)


def _is_ear(flat: FloatArray, a: int, b: int, c: int, left: Sequence[int]) -> bool:
    """Report whether the corner b turns left and the triangle holds no other corner."""
    if _turn(flat[a], flat[b], flat[c]) <= 0.0:
        return False
    for other in left:
        if other in (a, b, c):
            continue
        p = flat[other]
        inside = (
            _turn(flat[a], flat[b], p) >= 0.0
            and _turn(flat[b], flat[c], p) >= 0.0
            and _turn(flat[c], flat[a], p) >= 0.0
        )
        if inside:
            return False
    return True


def _turn(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
    """Twice the signed area of a triangle."""
    u, v = b - a, c - a
    return float(u[0] * v[1] - u[1] * v[0])


def welded(vertices: FloatArray, distance: float) -> tuple[FloatArray, Indices]:
    """Merge vertices that are no farther apart than a distance, also through intermediate ones.

    Args:
        vertices: Vertices [n, 3].
        distance: The distance [m], >= 0.

    Returns:
        The remaining vertices, in the order of the given ones, each at the position of the first
        vertex that it replaces; and for each given vertex the index of its replacement, shape [n].
    """
    order = np.argsort(vertices[:, 0], kind="stable")
    x = vertices[order]
    group = np.arange(len(vertices))
    step = 1
    while step < len(x):
        near = np.flatnonzero(x[step:, 0] - x[:-step, 0] <= distance)
        if not near.size:
            break  # sorted: vertices farther apart in the order are no nearer
        apart = np.linalg.norm(x[near + step] - x[near], axis=1)
        for i in near[apart <= distance]:
            _join(group, int(order[i]), int(order[i + step]))
        step += 1
    roots = np.array([_root(group, i) for i in range(len(group))])
    kept, new = np.unique(roots, return_inverse=True)
    return vertices[kept], new.reshape(-1)


def _root(group: Indices, i: int) -> int:
    while group[i] != i:
        group[i] = group[group[i]]
        i = int(group[i])
    return i


def _join(group: Indices, i: int, j: int) -> None:
    a, b = sorted((_root(group, i), _root(group, j)))
    group[b] = a  # the first one replaces all
