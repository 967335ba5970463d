"""Triangles that a pinhole camera sees: the nearest triangle along the ray of each pixel.

Let a, b, c be the corners of a triangle relative to the camera. A ray d meets the plane of the
triangle at barycentric coordinates that are the products of d with b x c, c x a and a x b, divided
by the sum of these products. The depth of the meeting point is a . (b x c) / the sum. This is
homogeneous rasterization after M. Olano and T. Greer, "Triangle scan conversion using 2D
homogeneous coordinates", 1997, which needs no clipping.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray

__all__ = ["Seen", "nearest_triangles"]

Indices = NDArray[np.integer[Any]]

_WIDER = 1e-6  # margin of the bounds of a triangle in the picture [pixels]
_OUTSIDE = 1e-9  # tolerance of barycentric coordinates: no ray passes between neighbors by rounding


@dataclass(frozen=True, eq=False)
class Seen:
    """Meeting points of the rays of all pixels, in H rows from above and W columns.

    Attributes:
        triangles: Index of the nearest triangle, -1 without one, [H, W].
        weights: Barycentric coordinates of the meeting point, 0 without one, [H, W, 3].
        depths: Distance of the meeting point along the axis of the camera, infinite without one,
            [H, W].
    """

    triangles: Indices
    weights: FloatArray
    depths: FloatArray


def nearest_triangles(
    vertices: FloatArray, faces: Indices, focal_length: float, size: tuple[int, int]
) -> Seen:
    """Find the triangle that each pixel sees through its center, from either side.

    Args:
        vertices: Positions in axes of the camera: x to the right, y down, z forward; [n, 3].
        faces: Indices of corners, [f, 3].
        focal_length: Focal length [pixels]; the axis passes through the middle of the picture.
        size: Rows H and columns W.
    """
    height, width = size
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)  # [f, 3, 3]
    volumes = (a * across[:, 0]).sum(axis=1)
    triangles, rows, columns = _pixels_in_bounds(vertices, faces, focal_length, size)
    x = (columns + 0.5 - 0.5 * width) / focal_length
    y = (rows + 0.5 - 0.5 * height) / focal_length
    normals = across[triangles]
    shares = normals[..., 0] * x[:, None] + normals[..., 1] * y[:, None] + normals[..., 2]
    total = shares.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):  # for triangles seen edge on
        weights, depths = shares / total[:, None], volumes[triangles] / total
    meets = (weights >= -_OUTSIDE).all(axis=1) & (depths > 0) & np.isfinite(depths)
    triangles, pixels = triangles[meets], (rows * width + columns)[meets]
    weights, depths = weights[meets], depths[meets]
    # The last of several values assigned to a pixel stays: the nearest triangle is last.
    order = np.lexsort((triangles, depths))[::-1]
    nearest = np.full(height * width, -1)
    nearest[pixels[order]] = order
    met = nearest >= 0
    found = nearest[met]
    seen = Seen(
        np.full(height * width, -1), np.zeros((height * width, 3)), np.full(height * width, np.inf)
    )
    seen.triangles[met] = triangles[found]
    seen.weights[met] = weights[found]
    seen.depths[met] = depths[found]
    return Seen(
        seen.triangles.reshape(size), seen.weights.reshape(*size, 3), seen.depths.reshape(size)
    )


def _pixels_in_bounds(
    vertices: FloatArray, faces: Indices, focal_length: float, size: tuple[int, int]
) -> tuple[Indices, Indices, Indices]:
    """Triangles [n], and rows and columns of the pixels within their bounds in the picture.

    The bounds of a triangle that is partly behind the camera are the whole picture.
    """
    behind = vertices[:, 2] <= 0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        projected = focal_length * vertices[:, 1::-1] / vertices[:, 2:]  # rows, columns
    corners = (projected + 0.5 * np.array(size) - 0.5)[faces]  # [f, 3, 2]
    hidden = behind[faces]
    some, every = hidden.any(axis=1, keepdims=True), hidden.all(axis=1)
    lowest, highest = corners.min(axis=1) - _WIDER, corners.max(axis=1) + _WIDER
    first = np.ceil(np.where(some, 0, np.clip(lowest, 0, size))).astype(np.int64)
    last = np.floor(np.where(some, size, np.clip(highest, -1, np.array(size) - 1) + 1))
    extent = np.maximum(last.astype(np.int64) - first, 0)  # [f, 2]
    counts = extent.prod(axis=1) * ~every
    triangles = np.repeat(np.arange(len(faces)), counts)
    place = np.arange(len(triangles)) - np.repeat(np.cumsum(counts) - counts, counts)
    row, column = np.divmod(place, extent[triangles, 1])
    return triangles, first[triangles, 0] + row, first[triangles, 1] + column
