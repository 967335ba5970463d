"""Scalars that color the cloths: strain, and contact forces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.extras import from_extra
from diffcloth_torch.model.cloth import Cloth

__all__ = ["colors", "strain"]

_COLOR_MAP = "viridis"


def strain(cloths: Sequence[Cloth], positions: FloatArray) -> FloatArray:
    """Strain at the vertices: the largest |s - 1| of the singular values s of dx/dX.

    A face has one strain; a vertex has the mean of its faces, weighted by their areas at rest.

    Args:
        cloths: Cloths of the scene.
        positions: Vertices of all cloths [m], shape [N, 3].

    Returns:
        Array [N], without unit.
    """
    found, first = [], 0
    for cloth in cloths:
        rows = slice(first, first := first + len(cloth.vertices))
        X, x = cloth.rest_positions[cloth.rest_faces], positions[rows][cloth.faces]
        rest, now = np.diff(X, axis=1), np.diff(x, axis=1)  # two edges of each face, [f, 2, 3]
        # With the edges of the rest shape as columns Q R, the deformed edges are F Q R, and F Q is
        # of shape 3 x 2.
        triangular = np.linalg.qr(rest.transpose(0, 2, 1)).R
        stretch = np.linalg.solve(triangular.transpose(0, 2, 1), now)
        of_faces = np.abs(np.linalg.svd(stretch, compute_uv=False) - 1).max(axis=-1)
        areas = np.linalg.norm(np.cross(rest[:, 0], rest[:, 1]), axis=-1)
        sums, weights = np.zeros(len(cloth.vertices)), np.zeros(len(cloth.vertices))
        np.add.at(sums, cloth.faces, (areas * of_faces)[:, None])
        np.add.at(weights, cloth.faces, areas[:, None])
        found.append(sums / weights)
    return np.concatenate(found) if found else np.zeros(0)


def colors(values: FloatArray, largest: float) -> NDArray[np.uint8]:
    """Linear colors [..., 4] of numbers from zero to `largest`; if that is zero, the color of zero.

    Colors of vertices in glTF files are linear, colors of a color map are for the screen (sRGB).
    """
    matplotlib = from_extra("matplotlib", "viewer", "colors of a page need Matplotlib")
    scaled = values / largest if largest > 0 else np.zeros_like(values)
    on_screen = matplotlib.colormaps[_COLOR_MAP](scaled)
    linear = np.where(on_screen <= 0.04045, on_screen / 12.92, ((on_screen + 0.055) / 1.055) ** 2.4)
    bytes_of: NDArray[np.uint8] = np.round(255 * linear).astype(np.uint8)
    return bytes_of
