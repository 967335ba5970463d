"""Arrays from sections: rotations, selected vertices, motion between keyframes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.config.scene_schema import JointKeyframe, Selection
from diffcloth_torch.config.shape_schema import PinKeyframe, RotationSection
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.rotation import interpolate_poses, rotate

__all__ = ["moved", "quaternion", "select_vertices", "values_at"]


def quaternion(section: RotationSection) -> NDArray[np.float64]:
    """Unit quaternion (w, x, y, z) of a rotation."""
    if section.axis is not None and section.degrees is not None:
        half = np.radians(section.degrees) / 2
        axis = np.array(section.axis) / np.linalg.norm(section.axis)
        return np.concatenate([[np.cos(half)], np.sin(half) * axis])
    given = np.array(section.quaternion or [1.0, 0.0, 0.0, 0.0])
    unit: NDArray[np.float64] = given / np.linalg.norm(given)
    return unit


def select_vertices(
    name: str, selection: Selection, vertices: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Indices of selected vertices, in increasing order; a list of indices keeps its order."""
    if selection.vertices is not None:
        return np.array(selection.vertices)
    if selection.nearest is not None:
        points = np.array(selection.nearest)
        distances = np.linalg.norm(vertices[None] - points[:, None], axis=-1)
        return np.unique(distances.argmin(axis=1))
    box = selection.box
    assert box is not None  # the schema requires one of the three
    inside = (vertices >= box.lower) & (vertices <= box.upper)
    chosen = np.flatnonzero(inside.all(axis=1))
    if chosen.size == 0:
        low, high = vertices.min(axis=0).round(4), vertices.max(axis=0).round(4)
        raise InvalidInput(
            f"the box of {name} must hold a vertex; the cloth lies between "
            f"{low.tolist()} and {high.tolist()}"
        )
    return chosen


def moved(start: Tensor, keyframes: Sequence[PinKeyframe], times: Tensor) -> Tensor:
    """Positions [n, p, 3] of points [p, 3] at some times: turned about their mean and displaced."""
    frames = [(0.0, [0.0, 0.0, 0.0], np.array([1.0, 0.0, 0.0, 0.0]))]
    if keyframes[0].time == 0:
        frames = []
    frames += [(frame.time, frame.displacement, quaternion(frame)) for frame in keyframes]
    poses = interpolate_poses(
        cpu.tensor([time for time, _, _ in frames]),
        cpu.tensor(np.array([[*move, *turn] for _, move, turn in frames])),
        times,
    )
    center = start.mean(dim=0)
    turned = rotate(poses[:, None, 3:], (start - center).expand(len(times), -1, 3))
    return turned + center + poses[:, None, :3]


def values_at(keyframes: Sequence[JointKeyframe], start: float, times: Tensor) -> Tensor:
    """Values [n] at some times, linear between keyframes."""
    given = [(frame.time, frame.value) for frame in keyframes]
    given = given if given[0][0] == 0 else [(0.0, start), *given]
    at, values = np.array(given).T
    return torch.from_numpy(np.interp(times.numpy(), at, values))
