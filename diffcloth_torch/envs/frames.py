"""Frames of tasks: axes and origins of observations and actions, fixed at the start of an episode.

A frame is three entries among the quantities of a start: "frame_origin" [B, 3], "frame_turn" [B, 4]
(a quaternion), and "frame_axes" [B, 3, 3], whose rows are its axes in the world. Sums are used
instead of matrix products, whose rounding would depend on the size of the batch. Without these
entries the frame is the world, and functions return their argument.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.geometry.rotation import quaternion_matrix, quaternion_multiply

__all__ = [
    "Frame",
    "level_frame",
    "points_in",
    "pose_frame",
    "poses_in",
    "vectors_in",
    "vectors_out_of",
]

Frame = dict[str, Tensor]


def level_frame(origin: Tensor, direction: Tensor) -> Frame:
    """A frame with z upwards.

    Args:
        origin: Origin of the frame [m], shape [B, 3].
        direction: Direction of the x axis, horizontal unit vectors [B, 2].
    """
    x, y = direction.unbind(dim=-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    rows = torch.stack([x, y, zero, -y, x, zero, zero, zero, one], dim=-1)
    half = torch.stack([1 + x, zero, zero, y], dim=-1)  # quaternion of the rotation, not normalized
    turn = half / torch.linalg.vector_norm(half, dim=-1, keepdim=True)
    return _frame(origin, rows.reshape(-1, 3, 3), turn)


def pose_frame(pose: Tensor) -> Frame:
    """The frame of poses [B, 7]."""
    axes = quaternion_matrix(pose[:, 3:]).transpose(-1, -2).contiguous()
    return _frame(pose[:, :3], axes, pose[:, 3:])


def _frame(origin: Tensor, axes: Tensor, turn: Tensor) -> Frame:
    return {"frame_origin": origin, "frame_axes": axes, "frame_turn": turn}


def points_in(frame: Mapping[str, Tensor], points: Tensor) -> Tensor:
    """Coordinates of points of the world [B, n, 3]."""
    if "frame_axes" not in frame:
        return points
    return vectors_in(frame, points - frame["frame_origin"][:, None])


def vectors_in(frame: Mapping[str, Tensor], vectors: Tensor) -> Tensor:
    """Components of vectors of the world [B, n, 3]."""
    if "frame_axes" not in frame:
        return vectors
    return (frame["frame_axes"][:, None] * vectors[:, :, None]).sum(dim=-1)


def vectors_out_of(frame: Mapping[str, Tensor], vectors: Tensor) -> Tensor:
    """Vectors in the world of components [B, n, 3]."""
    if "frame_axes" not in frame:
        return vectors
    return (frame["frame_axes"][:, None] * vectors[..., None]).sum(dim=-2)


def poses_in(frame: Mapping[str, Tensor], poses: Tensor) -> Tensor:
    """Poses [B, 7] relative to the frame."""
    if "frame_axes" not in frame:
        return poses
    inverse = frame["frame_turn"] * _CONJUGATE
    turn = quaternion_multiply(inverse, poses[:, 3:])
    return torch.cat([points_in(frame, poses[:, None, :3])[:, 0], turn], dim=-1)


_CONJUGATE = cpu.tensor([1.0, -1.0, -1.0, -1.0])
