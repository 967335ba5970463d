"""Forward kinematics of a mechanism: frames of links from joint positions, in torch and float64."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.model.mechanism import Mechanism

__all__ = ["link_frames", "pose_frame"]


def pose_frame(pose: Tensor) -> Tensor:
    """Frames [..., 4, 4] of poses [..., 7], whose quaternions are normalized."""
    quaternion = pose[..., 3:] / torch.linalg.vector_norm(pose[..., 3:], dim=-1, keepdim=True)
    w, v = quaternion[..., :1, None], quaternion[..., 1:]
    # R = (2 w² − 1) 1 + 2 v vᵀ + 2 w hat(v)
    rotation = (
        (2 * w * w - 1) * torch.eye(3, dtype=pose.dtype)
        + 2 * v[..., :, None] * v[..., None, :]
        + 2 * w * _hat(v)
    )
    return _frame(rotation, pose[..., :3])


def link_frames(mechanism: Mechanism, root_frame: Tensor, joint_positions: Tensor) -> Tensor:
    """Frames of all links; differentiable any number of times.

    A joint turns about an axis z of unit length that is a constant, so that

        R = 1 + sin(a) hat(z) + (1 − cos(a)) hat(z)²

    is smooth in a everywhere, unlike the exponential of a rotation vector at zero.

    Args:
        mechanism: The tree.
        root_frame: Frames of the root link, shape [..., 4, 4].
        joint_positions: [rad or m], shape [..., J]; the leading axes of both are broadcast.

    Returns:
        Frames, shape [..., L, 4, 4].
    """
    shape = np.broadcast_shapes(root_frame.shape[:-2], joint_positions.shape[:-1])
    frames: list[Tensor] = [root_frame] * mechanism.link_count
    offset, axis = (torch.from_numpy(np.array(a)) for a in (mechanism.offset, mechanism.axis))
    for link in mechanism.order:
        if link == mechanism.root:
            frames[link] = root_frame.expand(*shape, 4, 4)
            continue
        frame = frames[int(mechanism.parent[link])] @ offset[link]
        if mechanism.kind[link] != "fixed":
            value = joint_positions[..., int(mechanism.dof[link])]
            value = float(mechanism.multiplier[link]) * value + float(mechanism.constant[link])
            frame = frame @ _motion(mechanism.kind[link], axis[link], value)
        frames[link] = frame
    return torch.stack(frames, dim=-3)


def _motion(kind: str, axis: Tensor, value: Tensor) -> Tensor:
    """Frames [..., 4, 4] of a joint moved by values [...]."""
    identity = torch.eye(3, dtype=value.dtype)
    if kind == "prismatic":
        return _frame(identity.expand(*value.shape, 3, 3), value[..., None] * axis)
    z, a = _hat(axis), value[..., None, None]
    rotation = identity + torch.sin(a) * z + (1 - torch.cos(a)) * (z @ z)
    return _frame(rotation, torch.zeros(*value.shape, 3, dtype=value.dtype))


def _frame(rotation: Tensor, translation: Tensor) -> Tensor:
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=top.dtype).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def _hat(v: Tensor) -> Tensor:
    """Matrices of the cross product, v x u = hat(v) u."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).reshape(*v.shape, 3)
