"""A floor that is only drawn: it fades into the background and receives a soft shadow.

The shadow is a texture. Points on the surfaces are projected to the floor along the light and
counted on a grid, which is blurred. Layers of cloth therefore have one common shadow, unlike
translucent projections, and the result does not depend on the shadow maps of a driver.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["BACKGROUND", "Floor", "Shadow"]

Points = NDArray[np.float64]
Triangles = NDArray[np.integer[Any]]

BACKGROUND = "#eef1f5"
_FLOOR_COLOR = (221, 225, 231)
_SHADOW_STRENGTH = 0.42  # of the light that a full shadow takes away

_TEXELS = 512  # along each side of the texture
_REACH = 2.2  # half the side of the floor over the size of the scene
# Radii of the three box filters that blur the shadow, in texels; together nearly a Gaussian.
_BLUR = (3, 4, 5)


class Floor:
    """A square at a given height, with a texture that can be shaded."""

    def __init__(
        self, pyvista: Any, plotter: Any, bounds: tuple[Points, Points], height: float
    ) -> None:
        """Add the floor to a plotter.

        Args:
            pyvista: The module.
            plotter: Plotter that shows it.
            bounds: Lowest and highest coordinates of the objects above it [m].
            height: Height of the floor [m].
        """
        low, high = bounds
        self.height = height
        self.half_side = _REACH * float(np.linalg.norm(high - low))
        self.center = (low[:2] + high[:2]) / 2
        side = 2 * self.half_side
        plane = pyvista.Plane(
            center=(*self.center, height), i_size=side, j_size=side, i_resolution=1, j_resolution=1
        )
        self._pyvista = pyvista
        self._actor = plotter.add_mesh(plane, texture=self._texture(1.0), lighting=False)

    def shade(self, shadow: Points) -> None:
        """Darken the floor by `shadow`, [texels along y, along x] from 0 to 1."""
        self._actor.texture = self._texture(1 - _SHADOW_STRENGTH * shadow)

    def _texture(self, light: Points | float) -> Any:
        axis = (np.arange(_TEXELS) + 0.5) / _TEXELS * 2 - 1
        radius = np.hypot(*np.meshgrid(axis, axis))
        fade = np.clip((radius - 0.25) / 0.7, 0, 1)
        fade = (fade * fade * (3 - 2 * fade))[..., None]
        background = np.array([int(BACKGROUND[i : i + 2], 16) for i in (1, 3, 5)])
        lit = np.array(_FLOOR_COLOR) * np.broadcast_to(np.asarray(light), radius.shape)[..., None]
        colors = (1 - fade) * lit + fade * background
        # Rows of a texture go from top to bottom, y from bottom to top.
        texture = self._pyvista.Texture(np.ascontiguousarray(colors[::-1].round().astype(np.uint8)))
        texture.interpolate = True
        return texture


class Shadow:
    """The shadow of moving surfaces on a floor."""

    def __init__(self, floor: Floor, towards_light: Points) -> None:
        """Store the floor.

        Args:
            floor: Floor of the shadow.
            towards_light: Direction to a light that is far away, shape [3].
        """
        self._floor = floor
        self._shift = towards_light[:2] / towards_light[2]
        self._texel = 2 * floor.half_side / _TEXELS
        self._samples: list[tuple[NDArray[np.intp], Points]] = []

    def cast(self, surfaces: Sequence[tuple[Points, Triangles]]) -> None:
        """Shade the floor by surfaces, each of vertices [n, 3] and faces [f, 3]."""
        if not self._samples:
            self._samples = [self._choose_samples(*surface) for surface in surfaces]
        counts = np.zeros((_TEXELS, _TEXELS))
        for (vertices, faces), (chosen, weights) in zip(surfaces, self._samples, strict=True):
            points = np.einsum("nk,nkd->nd", weights, vertices[faces[chosen]])
            drop = points[:, 2:] - self._floor.height
            # Points below the floor cast no shadow.
            on_floor = (points[:, :2] - drop * self._shift)[drop[:, 0] > 0]
            place = (on_floor - self._floor.center + self._floor.half_side) / self._texel
            index = np.floor(place).astype(int)
            index = index[((index >= 0) & (index < _TEXELS)).all(axis=1)]
            np.add.at(counts, (index[:, 1], index[:, 0]), 1)
        shadow = (counts > 0).astype(np.float64)
        for radius in _BLUR:
            shadow = _box_filter(_box_filter(shadow, radius).T, radius).T
        self._floor.shade(shadow)

    def _choose_samples(
        self, vertices: Points, faces: Triangles
    ) -> tuple[NDArray[np.intp], Points]:
        """Faces [n] and weights of their corners [n, 3], several samples in each texel."""
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        counts = np.ceil(8 * area / self._texel**2).astype(int) + 1
        chosen = np.repeat(np.arange(len(faces)), counts)
        u, v = np.random.default_rng(0).random((2, len(chosen)))
        root = np.sqrt(u)  # uniform over a triangle
        return chosen, np.stack([1 - root, root * (1 - v), root * v], axis=-1)


def _box_filter(image: Points, radius: int) -> Points:
    """Mean over 2 radius + 1 rows around each row."""
    width = 2 * radius + 1
    padded = np.pad(image, ((radius + 1, radius), (0, 0)), mode="edge")
    sums = padded.cumsum(axis=0)
    means: Points = (sums[width:] - sums[:-width]) / width
    return means
