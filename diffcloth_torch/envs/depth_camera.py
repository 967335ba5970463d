"""A depth camera: images and partial point clouds of a scene, computed without graphics hardware.

The rays through the centers of the pixels meet the triangles of all surfaces in the scene, without
noise and to rounding, one environment after the other: its bits are the same in any batch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import (
    POSITIVE,
    FloatArray,
    Range,
    check_count,
    check_finite,
    check_number,
    check_shape,
    float_array,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.pinhole import Seen, nearest_triangles
from diffcloth_torch.geometry.poses import poses_of_frames
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State

__all__ = ["DepthCamera", "Sight"]

_MOST_PIXELS = 4096  # along a side
_MOST_POINTS = 2**16
_ALONG = 1e-9  # sine between the direction of view and `up`, at least
# Fractions of the sequence R2 of M. Roberts: pixels in the order of their parts after the point are
# spread evenly, whichever region of the picture is left out.
_SPREAD = (0.5698402909980532, 0.7548776662466927)


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """A pinhole camera at a fixed place in the world, with square pixels and without distortion.

    Attributes:
        position: Position of the pinhole [m], shape [3].
        target: Point at the center of the image [m], shape [3].
        up: Direction that is up in the image, shape [3].
        field_of_view: Vertical angle of the image in degrees, between 0 and 180.
        width: Columns of the image, W, up to 4096.
        height: Rows of the image, H, up to 4096.
        far: Depth beyond which nothing is seen, and depth of pixels that see nothing [m], > 0.
        points: Number of points of a point cloud, P, up to 65536.
    """

    position: Sequence[float]
    target: Sequence[float]
    up: Sequence[float] = (0.0, 0.0, 1.0)
    field_of_view: float = 40.0
    width: int = 64
    height: int = 64
    far: float = 5.0
    points: int = 128

    def __post_init__(self) -> None:
        for name in ("position", "target", "up"):
            point = float_array(f"DepthCamera: `{name}`", getattr(self, name))
            check_shape(f"DepthCamera: `{name}`", point.shape, [(3,)])
            check_finite(f"DepthCamera: `{name}`", point)
            object.__setattr__(self, name, tuple(point.tolist()))  # a list may change later
        view = np.subtract(self.target, self.position)
        lengths = np.linalg.norm(view) * np.linalg.norm(self.up)
        if not np.linalg.norm(np.cross(view, self.up)) > _ALONG * lengths:
            raise InvalidInput(
                "DepthCamera: `target` must be apart from `position`, and not in the direction of "
                f"`up` from there, got a view along {view.tolist()}"
            )
        angles = Range(0.0, 180.0)
        check_number("DepthCamera: `field_of_view`", self.field_of_view, angles)
        check_number("DepthCamera: `far`", self.far, POSITIVE)
        for name, most in (
            ("width", _MOST_PIXELS),
            ("height", _MOST_PIXELS),
            ("points", _MOST_POINTS),
        ):
            check_count(f"DepthCamera: `{name}`", getattr(self, name), 1, most)

    @cached_property
    def axes(self) -> FloatArray:
        """Axes of the camera in the world, [3, 3]: rows to the right, down, and forward."""
        forward = np.subtract(self.target, self.position)
        right = np.cross(forward, self.up)
        rows = np.stack([right, np.cross(forward, right), forward])
        axes: FloatArray = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        return axes

    @property
    def pose(self) -> FloatArray:
        """Position [m] and quaternion (w, x, y, z) of the axes in the world, [7]."""
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = self.axes.T, self.position
        return poses_of_frames(frame)

    @property
    def focal_length(self) -> float:
        """Distance of the image from the pinhole [pixels]."""
        return 0.5 * self.height / math.tan(math.radians(0.5 * self.field_of_view))

    @property
    def matrix(self) -> FloatArray:
        """Intrinsic matrix K [pixels], [3, 3].

        A point (x, y, z) in the axes of the camera is seen at K (x, y, z) / z, where the pixel of
        column j and row i has its center at (j + 1/2, i + 1/2).
        """
        f = self.focal_length
        return np.array([[f, 0.0, 0.5 * self.width], [0.0, f, 0.5 * self.height], [0.0, 0.0, 1.0]])


class Sight:
    """Views of a scene by a camera: all surfaces hide one another, and points are of cloths."""

    def __init__(self, camera: DepthCamera, scene: Scene) -> None:
        """Prepare.

        Args:
            camera: The camera.
            scene: The scene, whose states are to be seen.
        """
        self.camera = camera
        cloths = scene.cloths[: len(scene.cloths) - len(scene.deforming_bodies)]
        self._cloth_faces = sum(len(cloth.faces) for cloth in cloths)  # the first of all surfaces
        rows, columns = np.indices((camera.height, camera.width))
        spread = (_SPREAD[0] * rows + _SPREAD[1] * columns) % 1
        self._order: NDArray[np.int64] = np.argsort(spread, axis=None, kind="stable")

    def depths(self, state: State) -> Tensor:
        """Depth [m] of each pixel, without a graph, float64 [B, H, W]: `far` where nothing is."""
        far = self.camera.far
        images = [np.minimum(seen.depths, far) for seen, _ in self._views(state)]
        return torch.from_numpy(np.stack(images))

    def points(self, state: State) -> Tensor:
        """Points of cloths that the camera sees, in the world [m], float64 [B, P, 3].

        They are points of material, in a triangle at the coordinates where the ray of a pixel meets
        it, and so differentiable in the positions of its corners. The pixels are those that come
        first in an order that spreads them evenly. Fewer pixels than points that see cloth are
        repeated; without any all points are at the camera, and do not depend on the positions.
        """
        views = zip(self._views(state), state.positions, strict=True)
        return torch.stack([self._points(*view, positions) for view, positions in views])

    def _points(self, seen: Seen, faces: NDArray[np.int64], positions: Tensor) -> Tensor:
        triangles = seen.triangles.ravel()
        is_cloth = (triangles >= 0) & (triangles < self._cloth_faces)
        is_cloth &= seen.depths.ravel() < self.camera.far
        pixels = self._order[is_cloth[self._order]]
        if not len(pixels):
            return cpu.tensor(self.camera.position).expand(self.camera.points, 3)
        chosen = np.resize(pixels, self.camera.points)
        corners = positions[torch.from_numpy(faces[triangles[chosen]])]
        weights = torch.from_numpy(seen.weights.reshape(-1, 3)[chosen])
        return (weights[..., None] * corners).sum(dim=-2)

    def _views(self, state: State) -> Iterator[tuple[Seen, NDArray[np.int64]]]:
        """View of each environment, and the corners of the triangles."""
        meshes = state.detach().meshes().values()
        starts = np.cumsum([0, *(vertices.shape[-2] for vertices, _ in meshes)])
        faces = np.concatenate(
            [f.numpy() + start for (_, f), start in zip(meshes, starts, strict=False)]
        ).astype(np.int64)
        camera = self.camera
        away = torch.cat([vertices for vertices, _ in meshes], dim=-2).numpy() - camera.position
        for each in away:
            # Sums, no matrix product: that would round by the number of vertices.
            turned = np.stack([(each * axis).sum(axis=1) for axis in camera.axes], axis=1)
            yield (
                nearest_triangles(
                    turned, faces, camera.focal_length, (camera.height, camera.width)
                ),
                faces,
            )
