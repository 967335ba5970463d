"""Forward kinematics of a mechanism: frames of links from joint positions, in torch and float64."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import FloatArray
from diffcloth_torch.geometry.products import product
from diffcloth_torch.geometry.rotation import quaternion_matrix
from diffcloth_torch.model.mechanism import Mechanism

__all__ = ["Kinematics", "constant", "joined_frame", "link_frames", "pose_frame"]


class Kinematics:
    """The constants of a mechanism that its links' frames depend on, as tensors.

    A joint turns about a constant axis of unit length. With K the matrix of its cross product,

        R = 1 + sin(a) K + (1 - cos(a)) K^2

    is smooth in a everywhere, unlike the exponential of a rotation vector at zero.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        moving = np.flatnonzero(mechanism.dof >= 0)
        # A first axis for the environments: rounding in one product of all of them would depend on
        # their number.
        leaders = np.zeros((1, mechanism.joint_count, mechanism.link_count))
        leaders[0, mechanism.dof[moving], moving] = mechanism.multiplier[moving]
        turns = np.array([kind == "revolute" for kind in mechanism.kind])[:, None]
        cross, shift = (np.zeros((mechanism.link_count, 4, 4)) for _ in range(2))
        cross[:, :3, :3] = np.cross(np.eye(3), mechanism.axis[:, None, :]) * turns[..., None]
        shift[:, :3, 3] = mechanism.axis * ~turns
        self._leaders = constant(leaders)
        self._constants = constant(mechanism.constant * (mechanism.dof >= 0))
        self._offsets = constant(mechanism.offset)
        self._cross, self._cross_sq, self._shift = map(constant, (cross, cross @ cross, shift))
        self._root = mechanism.root
        self._parents = [(link, int(mechanism.parent[link])) for link in mechanism.order[1:]]

    def frames(self, root: Tensor, joints: Tensor) -> Tensor:
        """Frames of all links; differentiable any number of times.

        Args:
            root: Frames of the root link, shape [..., 4, 4].
            joints: Values of the joints [rad or m], shape [..., J]; the leading axes of both are
                broadcast.

        Returns:
            Frames, shape [..., L, 4, 4].
        """
        shape = np.broadcast_shapes(root.shape[:-2], joints.shape[:-1])
        count = math.prod(shape)
        rows = joints.expand(*shape, joints.shape[-1]).reshape(count, 1, joints.shape[-1])
        values = product(rows, self._leaders)[:, 0]
        values = (values + self._constants)[..., None, None]
        motions = torch.sin(values) * self._cross + (1 - torch.cos(values)) * self._cross_sq
        steps = self._offsets + product(self._offsets, motions + values * self._shift)
        local = steps.unbind(-3)
        placed = {self._root: root.expand(*shape, 4, 4).reshape(count, 4, 4)}
        for link, parent in self._parents:
            placed[link] = product(placed[parent], local[link])
        frames = torch.stack([placed[link] for link in range(len(placed))], dim=1)
        return frames.reshape(*shape, len(placed), 4, 4)


def link_frames(mechanism: Mechanism, root_frame: Tensor, joint_positions: Tensor) -> Tensor:
    """Frames of all links, [..., L, 4, 4]: see `Kinematics.frames`."""
    return Kinematics(mechanism).frames(root_frame, joint_positions)


def pose_frame(pose: Tensor) -> Tensor:
    """Frames [..., 4, 4] of poses [..., 7], whose quaternions are normalized."""
    quaternion = pose[..., 3:] / torch.linalg.vector_norm(pose[..., 3:], dim=-1, keepdim=True)
    return joined_frame(quaternion_matrix(quaternion), pose[..., :3])


def joined_frame(rotation: Tensor, translation: Tensor) -> Tensor:
    """Frames [..., 4, 4] of rotations [..., 3, 3] and translations [..., 3]."""
    top = torch.cat([rotation.expand(*translation.shape, 3), translation[..., None]], dim=-1)
    return torch.cat([top, _LAST_ROW.expand(*top.shape[:-2], 1, 4)], dim=-2)


def constant(array: FloatArray) -> Tensor:
    """Copy an array of any real numbers into a float64 tensor."""
    return torch.from_numpy(np.array(array, dtype=np.float64))


_LAST_ROW = cpu.tensor([[0.0, 0.0, 0.0, 1.0]])
