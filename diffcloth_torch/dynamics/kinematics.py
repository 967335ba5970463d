"""Where the links of a mechanism are and how they move, batched over environments.

A configuration is the center of mass c and the orientation R of the root link, and the values of
the J joints. Its velocities are nu = (dc/dt, omega, dq/dt), 6 + J numbers, omega in world axes.
Root links that do not move freely have the same 6 numbers; they are then known.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.model.mechanism import Mechanism

__all__ = ["CROSS", "ROOT", "Frames", "Tree", "root_frame"]

ROOT = 6  # velocities of the root, which come first


class Frames(NamedTuple):
    """Links in the world.

    Attributes:
        poses: Frames of the links, shape [B, L, 4, 4].
        centers: Their centers of mass [m], shape [B, L, 3].
        axes: Axes of the A joints that move, mimicking ones included, shape [B, A, 3].
        pivots: Points on these axes [m], shape [B, A, 3].
    """

    poses: Tensor
    centers: Tensor
    axes: Tensor
    pivots: Tensor


class Tree:
    """The constants of a mechanism, as tensors.

    Matrices have a first axis for the environments: a product of all of them at once would round by
    how many there are.

    Attributes:
        mechanism: What it was made from.
        moving: Links whose joint to the parent moves, length A.
        reach: Whether link l hangs on joint a, as 0 or 1, shape [L, A].
        revolute: Whether joint a turns, as 0 or 1, shape [A, 1].
        hanging: Its transpose, shape [1, A, L].
        leaders: Matrix from the values of the J joints to those of the A joints, shape [1, A, J].
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism
        links = mechanism.link_count
        self.moving = np.flatnonzero(mechanism.dof >= 0).tolist()
        reach = np.eye(links)
        for link in mechanism.order[1:]:
            reach[link] += reach[mechanism.parent[link]]
        leaders = np.zeros((links, mechanism.joint_count))
        leaders[self.moving, mechanism.dof[self.moving]] = mechanism.multiplier[self.moving]
        turns = np.array([kind == "revolute" for kind in mechanism.kind])

        self.reach = _tensor(reach[:, self.moving])
        self.hanging = _tensor(reach[:, self.moving].T)[None]
        self.revolute = _tensor(turns[self.moving, None])
        self.leaders = _tensor(leaders[self.moving])[None]
        # Of all L links, as the frames need them. About a unit axis a turn by u has the matrix
        # I + sin(u) K + (1 - cos(u)) K^2, with K the matrix of the cross product.
        cross = np.zeros((links, 4, 4))
        cross[:, :3, :3] = np.cross(np.eye(3), mechanism.axis[:, None, :]) * turns[:, None, None]
        shift = np.zeros((links, 4, 4))
        shift[:, :3, 3] = mechanism.axis * ~turns[:, None]
        self._values = _tensor(leaders.T)[None]
        self._constants = _tensor(mechanism.constant * (mechanism.dof >= 0))
        self._offsets = _tensor(mechanism.offset)
        self._cross, self._cross_sq, self._shift = map(_tensor, (cross, cross @ cross, shift))
        self._axes = _tensor(mechanism.axis[self.moving])

    def poses(self, root: Tensor, joints: Tensor) -> Tensor:
        """Frames of the links, shape [B, L, 4, 4].

        Args:
            root: Frame of the root link, shape [B or 1, 4, 4].
            joints: Values of the joints [rad or m], shape [B, J].
        """
        values = (joints.unsqueeze(-2) @ self._values)[..., 0, :] + self._constants
        values = values[..., None, None]
        motions = torch.sin(values) * self._cross + (1 - torch.cos(values)) * self._cross_sq
        steps = self._offsets + self._offsets @ (motions + values * self._shift)
        local = steps.unbind(-3)
        placed = {self.mechanism.root: root.expand_as(local[0])}
        for link in self.mechanism.order[1:]:
            placed[link] = placed[int(self.mechanism.parent[link])] @ local[link]
        rows = [placed[link] for link in range(self.mechanism.link_count)]
        return torch.stack(rows, dim=-3)

    def frames(self, root: Tensor, joints: Tensor, centers: Tensor) -> Frames:
        """Where everything is that the dynamics asks for.

        Args:
            root: Frame of the root link, shape [B, 4, 4].
            joints: Values of the joints [rad or m], shape [B, J].
            centers: Centers of mass in the links' frames [m], shape [B or 1, L, 3].
        """
        poses = self.poses(root, joints)
        moving = poses[..., self.moving, :, :]
        return Frames(
            poses=poses,
            centers=(poses[..., :3, :3] @ centers[..., None])[..., 0] + poses[..., :3, 3],
            axes=(moving[..., :3, :3] @ self._axes[..., None])[..., 0],
            pivots=moving[..., :3, 3],
        )

    def jacobian(self, frames: Frames) -> Tensor:
        """Velocities of the centers, then of rotation, of each link by nu; [B, L, 6, 6 + J].

        A joint that turns moves the center by axis x (center - pivot), one that slides by its axis.
        """
        root = frames.centers[..., self.mechanism.root, :]
        arms = frames.centers[..., :, None, :] - frames.pivots[..., None, :, :]  # [B, L, A, 3]
        axes = frames.axes[..., None, :, :].expand_as(arms)
        turned = torch.linalg.cross(axes, arms)
        reach = self.reach[..., None]
        linear = reach * torch.lerp(axes, turned, self.revolute)
        angular = reach * self.revolute * axes
        joints = torch.cat([linear, angular], dim=-1).transpose(-1, -2) @ self.leaders
        return torch.cat([_rigid(frames.centers - root[..., None, :]), joints], dim=-1)


def root_frame(center: Tensor, rotation: Tensor, local_center: Tensor) -> Tensor:
    """Frame [B, 4, 4] of a link at `rotation`, by its center in the world and in itself [B, 3]."""
    position = center - (rotation @ local_center[..., None])[..., 0]
    upper = torch.cat([rotation.expand(*position.shape, 3), position[..., None]], dim=-1)
    return torch.cat([upper, _LAST_ROW.expand(*upper.shape[:-2], 1, 4)], dim=-2)


def _rigid(arms: Tensor) -> Tensor:
    """Velocities of points at `arms` [B, L, 3] from a body's center, by its own; [B, L, 6, 6]."""
    cross = (arms @ CROSS).reshape(*arms.shape, 3)  # omega x arm = -arm x omega
    upper = torch.cat([_EYE.expand_as(cross), -cross], dim=-1)
    return torch.cat([upper, _LOWER.expand_as(upper)], dim=-2)


def _tensor(array: FloatArray) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float64))


_EYE = torch.eye(3, dtype=torch.float64)
_LOWER = torch.eye(6, dtype=torch.float64)[3:]
_LAST_ROW = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
# a @ CROSS is the matrix of the cross product a x, row after row.
CROSS = torch.linalg.cross(_EYE[:, None, :], _EYE[None, :, :]).transpose(1, 2).reshape(1, 3, 9)
