"""Texture coordinates as a flat rest mesh, cut at the seams of the texture."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput

__all__ = ["RestMesh", "flat_rest_mesh"]

Indices = NDArray[np.int64]


class RestMesh(NamedTuple):
    """A rest mesh with vertices of its own.

    Attributes:
        positions: Rest vertices [m], [r, 3].
        faces: Faces of the cloth as indices of rest vertices, [f, 3].
    """

    positions: FloatArray
    faces: Indices


def flat_rest_mesh(
    owner: str, faces: Indices, texture: FloatArray | None, scale: float
) -> RestMesh:
    """Make a rest mesh of the triangles of the texture, in the xy-plane with u along x.

    A vertex has a rest vertex for each of its places in the texture, in the order of the vertices;
    without seams the rest mesh therefore has the indices of the mesh.

    Args:
        owner: Beginning of messages.
        faces: Triangles, [f, 3]; each vertex belongs to one.
        texture: Texture coordinates of the corners of the triangles, [f, 3, 2], NaN for corners
            without coordinates; None if the format has no texture.
        scale: Meters per unit of the texture coordinates.

    Raises:
        InvalidInput: If a corner has no texture coordinates, or the texture is folded at an edge.
    """
    given = np.full((*faces.shape, 2), np.nan) if texture is None else texture
    missing = np.isnan(given).any(axis=(1, 2))
    if missing.any():
        raise InvalidInput(
            f"{owner}: `rest` 'uv' needs an .obj file with texture coordinates at all corners; "
            f"face {int(np.argmax(missing))} has none ({int(missing.sum())} of {len(given)})"
        )
    places = np.column_stack([faces.reshape(-1), given.reshape(-1, 2) + 0.0])  # -0 is 0
    distinct, corners = np.unique(places, axis=0, return_inverse=True)
    flat, rest_faces = distinct[:, 1:], corners.reshape(-1, 3)
    _refuse_folds(owner, flat, rest_faces)
    return RestMesh(scale * np.pad(flat, ((0, 0), (0, 1))), rest_faces)


def _refuse_folds(owner: str, flat: FloatArray, faces: Indices) -> None:
    """Refuse edges without a seam whose two faces lie on the same side of the edge."""
    sides = faces[:, [[0, 1, 2], [1, 2, 0], [2, 0, 1]]].reshape(-1, 3)  # two ends, other corner
    ends = np.sort(sides[:, :2], axis=1)
    (u, v), (x, y) = ((flat[i] - flat[ends[:, 0]]).T for i in (ends[:, 1], sides[:, 2]))
    is_left = u * y - v * x > 0.0
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    first, second = order[:-1], order[1:]
    folded = (ends[first] == ends[second]).all(axis=1) & (is_left[first] == is_left[second])
    if folded.any():
        at = int(np.argmax(folded))
        one, other = sorted((int(first[at]) // 3, int(second[at]) // 3))
        raise InvalidInput(
            f"{owner}: `rest` 'uv' must not be folded, but faces {one} and {other} lie on one side "
            f"of the edge between them ({int(folded.sum())} such edges)"
        )
