"""Checks that a triangle mesh must pass to become a cloth or a body."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import (
    SMALLEST,
    FloatArray,
    IndexArray,
    check_finite,
    check_shape,
    float_array,
    frozen,
    index_array,
)
from diffcloth_torch.errors import InvalidInput, warn_caller
from diffcloth_torch.saved import saved

__all__ = [
    "BodySurface",
    "Surface",
    "body_arrays",
    "check_areas",
    "check_manifold",
    "surface_arrays",
    "unique_edges",
    "warn_of_cuts",
]


@saved
class Surface(NamedTuple):
    """Vertices [n, 3] in meters and triangles [f, 3]."""

    vertices: FloatArray
    faces: IndexArray


# Twice the area of a face over its longest edge squared. Below this ratio, rounding determines the
# direction of the normal.
_FLATTEST_FACE = 1e-12


class BodySurface(NamedTuple):
    """Surface of a body, and its faces as a solid.

    Attributes:
        vertices: Positions [m], shape [n, 3].
        faces: Triangles for contact, shape [f, 3].
        solid: Triangles that enclose the body if the mesh is closed, shape [s, 3], including faces
            without area and opposite faces, which close it.
    """

    vertices: FloatArray
    faces: IndexArray
    solid: IndexArray


def surface_arrays(
    owner: str, vertices: object, faces: object, *, instead: str
) -> tuple[FloatArray, IndexArray]:
    """Check vertices [n, 3] and triangles [f, 3]; return read-only copies."""
    points, triangles = _arrays(owner, vertices, faces, instead=instead)
    _check_distinct(owner, triangles)
    check_areas(owner, "vertices", points, triangles)
    return frozen(points), frozen(triangles)


def body_arrays(owner: str, vertices: object, faces: object, *, instead: str) -> BodySurface:
    """Check vertices [n, 3] and triangles [f, 3] of a body; return read-only copies.

    Faces without area, and all but one of the faces with the same vertices, are dropped with a
    warning that counts them: they bear no contact, or duplicate the contact of another face.
    """
    points, triangles = _arrays(owner, vertices, faces, instead=instead)
    _check_sides(owner, "vertices", points, triangles)
    flat = _is_flat(points, triangles)
    ordered = np.sort(triangles, axis=1)
    doubled = _repeats(ordered) & ~flat
    # In the direction of the face, beginning with its smallest vertex.
    turned = np.take_along_axis(
        triangles, (triangles.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1
    )
    is_line = (ordered[:, 0] == ordered[:, 1]) | (ordered[:, 1] == ordered[:, 2])
    solid = triangles[~_repeats(turned) & ~is_line]
    kept = triangles[~flat & ~doubled]
    if len(kept) == 0:
        check_areas(owner, "vertices", points, triangles)
    if len(kept) < len(triangles):
        warn_caller(
            f"{owner}: dropped {len(triangles) - len(kept)} of {len(triangles)} faces: "
            f"{int(flat.sum())} without area, {int(doubled.sum())} with the vertices of another"
        )
    return BodySurface(frozen(points), frozen(kept), frozen(solid))


def _arrays(
    owner: str, vertices: object, faces: object, *, instead: str
) -> tuple[FloatArray, IndexArray]:
    points = float_array(f"{owner}: `vertices`", vertices, instead=instead)
    check_shape(f"{owner}: `vertices`", points.shape, [("n", 3)])
    check_finite(f"{owner}: `vertices`", points)
    triangles = index_array(f"{owner}: `faces`", faces, len(points))
    hint = "; only triangles are supported: triangulate the mesh before"
    check_shape(f"{owner}: `faces`", triangles.shape, [("f", 3)], hint)
    if len(triangles) == 0:
        raise InvalidInput(f"{owner}: `faces` must hold at least one triangle")
    return points, triangles


def _repeats(rows: IndexArray) -> NDArray[np.bool_]:
    """Return whether each row is equal to a previous one, [n]."""
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    repeats: NDArray[np.bool_] = first[inverse.reshape(-1)] != np.arange(len(rows))
    return repeats


def warn_of_cuts(owner: str, vertices: FloatArray, faces: IndexArray) -> None:
    """Warn of an edge whose two faces have separate vertices at equal positions."""
    places, inverse = np.unique(vertices, axis=0, return_inverse=True)
    if len(places) == len(vertices):
        return
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, counts = np.unique(edges, axis=0, return_counts=True)
    rims = edges[counts == 1]
    where = np.sort(inverse.reshape(-1)[rims], axis=1)
    _, first, again = np.unique(where, axis=0, return_index=True, return_inverse=True)
    twins = np.flatnonzero(first[again.reshape(-1)] != np.arange(len(rims)))
    if not twins.size:
        return
    one, other = rims[first[again.reshape(-1)[twins[0]]]].tolist(), rims[twins[0]].tolist()
    warn_caller(
        f"{owner}: the vertices {one} and {other} are at the same places: an edge is cut, contact "
        "takes its two sides for rims, and what slides over it is pushed away; merge vertices that "
        "coincide, as with merge_vertices() of trimesh",
    )


def _check_distinct(owner: str, faces: IndexArray) -> None:
    corners = np.sort(faces, axis=1)
    repeated = np.flatnonzero((corners[:, 0] == corners[:, 1]) | (corners[:, 1] == corners[:, 2]))
    if repeated.size:
        face = int(repeated[0])
        raise InvalidInput(
            f"{owner}: `faces` must have three different vertices each, "
            f"got {faces[face].tolist()} at [{face}]"
        )
    _, first, inverse = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    original = first[inverse.reshape(-1)]
    duplicate = np.flatnonzero(original != np.arange(len(faces)))
    if duplicate.size:
        face = int(duplicate[0])
        raise InvalidInput(
            f"{owner}: `faces` must be different from each other: faces {int(original[face])} "
            f"and {face} have the same vertices {faces[face].tolist()}"
        )


def check_areas(owner: str, field: str, vertices: FloatArray, faces: IndexArray) -> None:
    """Refuse faces of zero area, and faces whose area is lost in the range of float64."""
    _check_sides(owner, field, vertices, faces)
    flat = np.flatnonzero(_is_flat(vertices, faces))
    if flat.size:
        face = int(flat[0])
        raise InvalidInput(
            f"{owner}: `faces` must have an area > 0 in `{field}`, got a face without area "
            f"at [{face}], vertices {faces[face].tolist()}"
        )


def _check_sides(owner: str, field: str, vertices: FloatArray, faces: IndexArray) -> None:
    longest_sq = _longest_sq(vertices, faces)
    tiny = np.flatnonzero((longest_sq > 0.0) & (longest_sq < SMALLEST**2))
    if tiny.size:
        face = int(tiny[0])
        raise InvalidInput(
            f"{owner}: `faces` must have sides of at least {SMALLEST:g} m in `{field}`, as powers "
            f"of them would vanish, got {np.sqrt(longest_sq[face]):g} at [{face}]"
        )


def _longest_sq(vertices: FloatArray, faces: IndexArray) -> FloatArray:
    corners = vertices[faces]
    longest: FloatArray = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=-1).max(axis=1)
    return longest


def _is_flat(vertices: FloatArray, faces: IndexArray) -> NDArray[np.bool_]:
    """Return a mask of faces without area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    double_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    is_flat: NDArray[np.bool_] = double_area <= _FLATTEST_FACE * _longest_sq(vertices, faces)
    return is_flat


def check_manifold(owner: str, vertex_count: int, faces: IndexArray) -> None:
    """Require that every vertex belongs to a face and every edge to at most two faces."""
    used = np.zeros(vertex_count, dtype=bool)
    used[faces] = True
    if not used.all():
        unused = int(np.flatnonzero(~used)[0])
        raise InvalidInput(
            f"{owner}: `vertices` must each belong to a face, or they have no mass: vertex "
            f"{unused} does not ({int((~used).sum())} in all); remove them from the mesh"
        )
    edges, counts = unique_edges(faces)
    crowded = np.flatnonzero(counts > 2)
    if crowded.size:
        edge = int(crowded[0])
        raise InvalidInput(
            f"{owner}: `faces` must share an edge between at most two of them, "
            f"got {int(counts[edge])} on the edge of vertices {edges[edge].tolist()}"
        )


def unique_edges(faces: IndexArray) -> tuple[IndexArray, IndexArray]:
    """Edges [e, 2] of a mesh, smaller index first, and the number of faces on each [e]."""
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, counts = np.unique(ends, axis=0, return_counts=True)
    return edges, counts.astype(np.int32)
