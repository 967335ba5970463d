"""Frames and velocities of the links of a mechanism, batched over environments.

A configuration is the center of mass c and the orientation R of the root link, and the values of
the J joints. Its velocities are nu = (dc/dt, omega, dq/dt), 6 + J numbers, omega in world axes. A
root link that does not move freely has the same 6 numbers, which are then known.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.geometry.products import product
from diffcloth_torch.model.kinematics import Kinematics, constant, joined_frame
from diffcloth_torch.model.mechanism import Mechanism

__all__ = ["CROSS", "ROOT", "DifferentialKinematics", "Frames", "root_frame"]

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


class DifferentialKinematics:
    """The constants of a mechanism, as tensors.

    Matrices have a first axis for the environments, because rounding in one product of all of them
    would depend on their number.

    Attributes:
        mechanism: The mechanism.
        root: Index of the root link.
        moving: Links whose joint to the parent moves, length A.
        reach: Whether joint a carries link l, as 0 or 1, shape [L, A].
        revolute: Whether joint a turns, as 0 or 1, shape [A, 1].
        leaders: Matrix from the values of the J joints to those of the A joints, shape [1, A, J].
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism, self.root = mechanism, mechanism.root
        links = mechanism.link_count
        self.moving = np.flatnonzero(mechanism.dof >= 0).tolist()
        reach = np.eye(links)
        for link in mechanism.order[1:]:
            reach[link] += reach[mechanism.parent[link]]
        leaders = np.zeros((links, mechanism.joint_count))
        leaders[self.moving, mechanism.dof[self.moving]] = mechanism.multiplier[self.moving]
        turns = np.array([kind == "revolute" for kind in mechanism.kind])

        self.reach = constant(reach[:, self.moving])
        self.revolute = constant(turns[self.moving, None])
        self.leaders = constant(leaders[self.moving])[None]
        self._kinematics = Kinematics(mechanism)
        self._axes = constant(mechanism.axis[self.moving])

    def frames(self, root: Tensor, joints: Tensor, centers: Tensor) -> Frames:
        """Place links, centers of mass, axes and pivots in the world.

        Args:
            root: Frame of the root link, shape [B, 4, 4].
            joints: Values of the joints [rad or m], shape [B, J].
            centers: Centers of mass in the links' frames [m], shape [B or 1, L, 3].
        """
        poses = self._kinematics.frames(root, joints)
        moving = poses[..., self.moving, :, :]
        return Frames(
            poses=poses,
            centers=times(poses[..., :3, :3], centers) + poses[..., :3, 3],
            axes=times(moving[..., :3, :3], self._axes),
            pivots=moving[..., :3, 3],
        )

    def jacobian(self, frames: Frames) -> Tensor:
        """Jacobian by nu of each link's velocities, of center and rotation; [B, L, 6, 6 + J].

        A revolute joint moves the center by axis x (center - pivot), a prismatic one by its axis.
        """
        root = frames.centers[..., self.root, :]
        arms = frames.centers[..., :, None, :] - frames.pivots[..., None, :, :]  # [B, L, A, 3]
        axes = frames.axes[..., None, :, :].expand_as(arms)
        turned = torch.linalg.cross(axes, arms)
        reach = self.reach[..., None]
        linear = reach * torch.lerp(axes, turned, self.revolute)
        angular = reach * self.revolute * axes
        columns = torch.cat([linear, angular], dim=-1).transpose(-1, -2)
        joints = product(columns, self.leaders)
        return torch.cat([_rigid(frames.centers - root[..., None, :]), joints], dim=-1)


def root_frame(center: Tensor, rotation: Tensor, local_center: Tensor) -> Tensor:
    """Frame [B, 4, 4] of a link at `rotation`, from its center in the world and locally [B, 3]."""
    return joined_frame(rotation, center - times(rotation, local_center))


def _rigid(arms: Tensor) -> Tensor:
    """Jacobian of velocities at `arms` [B, L, 3] from a body's center, by its own; [B, L, 6, 6]."""
    cross = times(CROSS, arms).reshape(*arms.shape, 3)  # omega x arm = -arm x omega
    upper = torch.cat([_EYE.expand_as(cross), -cross], dim=-1)
    return torch.cat([upper, _LOWER.expand_as(upper)], dim=-2)


_EYE = cpu.eye(3)
_LOWER = cpu.eye(6)[3:]
# CROSS a is the matrix of the cross product a x, row after row.
CROSS = torch.linalg.cross(_EYE[:, None, :], _EYE[None, :, :]).permute(2, 1, 0).reshape(9, 3)
