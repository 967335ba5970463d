"""Kinematics and inertia of trees by Jacobians in torch, as a reference for the core.

A configuration is the center of mass c and the orientation R of the root link, and the values of
the J joints. Its velocities are nu = (dc/dt, omega, dq/dt), 6 + J numbers, omega in world axes.
With the velocities V_l = J_l nu of each link's center and rotation, and its mass and inertia in
world axes W_l = diag(m 1, R I R^T):

    M = sum_l J_l^T W_l J_l,   p = M nu = sum_l J_l^T h_l,   h_l = W_l V_l.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.dynamics.inertia import Inertia
from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.geometry.products import product
from diffcloth_torch.model.kinematics import constant
from diffcloth_torch.model.mechanism import Mechanism


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
        reach: 1 if joint a carries link l, else 0, shape [L, A].
        revolute: 1 if joint a turns, else 0, shape [A, 1].
        leaders: Matrix from J joint values to the values of the A joints, shape [1, A, J].
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


def joined_frame(rotation: Tensor, translation: Tensor) -> Tensor:
    """Frames [..., 4, 4] of rotations [..., 3, 3] and translations [..., 3]."""
    top = torch.cat([rotation.expand(*translation.shape, 3), translation[..., None]], dim=-1)
    return torch.cat([top, _LAST_ROW.expand(*top.shape[:-2], 1, 4)], dim=-2)


class Motion(NamedTuple):
    """Links in a configuration, ready for any velocity.

    Attributes:
        frames: Frames of the links.
        jacobian: J_l, shape [B, L, 6, 6 + J].
        weighted: W_l J_l, likewise.
    """

    frames: Frames
    jacobian: Tensor
    weighted: Tensor

    @staticmethod
    def at(
        kinematics: DifferentialKinematics, inertia: Inertia, root: Tensor, joints: Tensor
    ) -> Motion:
        """Place the links; `root` is the frame [B, 4, 4] of the root link, `joints` [B, J]."""
        frames = kinematics.frames(root, joints, inertia.center)
        jacobian = kinematics.jacobian(frames)
        rotation = frames.poses[..., :3, :3]
        linear = inertia.mass[..., None, None] * jacobian[..., :3, :]
        local = product(inertia.inertia, product(rotation.transpose(-1, -2), jacobian[..., 3:, :]))
        return Motion(frames, jacobian, torch.cat([linear, product(rotation, local)], dim=-2))


def mass_matrix(motion: Motion, inertia: Inertia) -> Tensor:
    """M with the armature on its diagonal, shape [B, 6 + J, 6 + J]."""
    columns = motion.jacobian.flatten(-3, -2)
    matrix = product(columns.transpose(-1, -2), motion.weighted.flatten(-3, -2))
    return matrix + torch.diag_embed(_at_joints(inertia.armature))


def link_momenta(motion: Motion, velocity: Tensor) -> Tensor:
    """h_l of velocities nu [B, 6 + J]: linear, then angular about the centers; [B, L, 6]."""
    return times(motion.weighted, velocity[..., None, :])


def momentum(motion: Motion, inertia: Inertia, velocity: Tensor) -> Tensor:
    """M nu of velocities nu [B, 6 + J], likewise."""
    of_links = link_momenta(motion, velocity)
    return generalized_force(motion, of_links) + _at_joints(inertia.armature) * velocity


def generalized_force(motion: Motion, wrenches: Tensor) -> Tensor:
    """sum_l J_l^T f_l of forces at the links' centers and torques, [B, L, 6] -> [B, 6 + J]."""
    columns = motion.jacobian.flatten(-3, -2)
    return product(wrenches.flatten(-2).unsqueeze(-2), columns).squeeze(-2)


def _at_joints(values: Tensor) -> Tensor:
    """Put zeros for the root before values [B, J] of the joints."""
    return torch.nn.functional.pad(values, (6, 0))


def _rigid(arms: Tensor) -> Tensor:
    """Jacobian of velocities at `arms` [B, L, 3] from a body's center, by its own; [B, L, 6, 6]."""
    cross = times(CROSS, arms).reshape(*arms.shape, 3)  # omega x arm = -arm x omega
    upper = torch.cat([_EYE.expand_as(cross), -cross], dim=-1)
    return torch.cat([upper, _LOWER.expand_as(upper)], dim=-2)


_LAST_ROW = cpu.tensor([[0.0, 0.0, 0.0, 1.0]])
_EYE = cpu.eye(3)
_LOWER = cpu.eye(6)[3:]
# CROSS a is the matrix of the cross product a x, row after row.
CROSS = torch.linalg.cross(_EYE[:, None, :], _EYE[None, :, :]).permute(2, 1, 0).reshape(9, 3)
