"""Mass matrix, momentum and forces of a mechanism in its velocities nu = (dc/dt, omega, dq/dt).

With the 6 velocities V_l = J_l nu of each link, those of its center and of rotation, and its mass
and inertia in world axes W_l = diag(m 1, R I R^T):

    M = sum_l J_l^T W_l J_l,   p = M nu = sum_l J_l^T h_l,   h_l = W_l V_l.

Let joint j turn about the axis z through the point o, and let F and N be the momentum and the
angular momentum about o of all links that it carries. Then p_j = z . N (z . F if it slides). A turn
of the joint moves all links that it carries and no others, so the kinetic energy T = p . nu / 2
grows with its value, at constant rates, by

    dT/dq_j = dz/dt . N + z . (F x do/dt),   dz/dt = omega x z      (dz/dt . F where it slides).

Lagrange's equations are dp/dt = dT/dq + forces. Those of the root's rotation, in world axes, have
the same form if its slope is (P x dc/dt), with the momentum P of all.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffcloth_torch.dynamics.jacobians import DifferentialKinematics, Frames
from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.dynamics.totals import about_origin
from diffcloth_torch.geometry.products import product

__all__ = [
    "Inertia",
    "Motion",
    "generalized_force",
    "link_momenta",
    "mass_matrix",
    "momentum",
    "slope",
    "wrenches_of_forces",
]


class Inertia(NamedTuple):
    """Masses and inertias of links and joints.

    Attributes:
        mass: Masses of the links, [B or 1, L] kg.
        center: Centers of mass in the links' frames, [B or 1, L, 3] m.
        inertia: Inertias about the centers, in the links' axes, [B or 1, L, 3, 3] kg m^2.
        armature: Inertia of the joints' drives, [B or 1, J] kg m^2, or kg for sliding joints.
    """

    mass: Tensor
    center: Tensor
    inertia: Tensor
    armature: Tensor


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


def slope(kinematics: DifferentialKinematics, motion: Motion, velocity: Tensor) -> Tensor:
    """dT/dq of the kinetic energy at constant velocities nu [B, 6 + J], likewise.

    Args:
        kinematics: The mechanism.
        motion: Configuration of its links.
        velocity: nu.
    """
    frames = motion.frames
    twists = times(motion.jacobian, velocity[..., None, :])  # [B, L, 6]
    momenta = link_momenta(motion, velocity)
    linear = momenta[..., :3]
    carried = about_origin(frames.centers, momenta)
    # Of all links that each joint carries, first about the origin, then about the pivot.
    F, N = torch.split(product(kinematics.hanging, carried), 3, dim=-1)
    N = N - torch.linalg.cross(frames.pivots, F)
    rate, omega = torch.split(twists[..., kinematics.moving, :], 3, dim=-1)
    arms = frames.pivots - frames.centers[..., kinematics.moving, :]
    pivot_rate = rate + torch.linalg.cross(omega, arms)
    axis_rate = torch.linalg.cross(omega, frames.axes)
    turning = (axis_rate * N + frames.axes * torch.linalg.cross(F, pivot_rate)).sum(-1)
    sliding = (axis_rate * F).sum(-1)
    rows = torch.lerp(sliding, turning, kinematics.revolute[:, 0]).unsqueeze(-2)
    joints = product(rows, kinematics.leaders)[..., 0, :]
    root_rate = velocity[..., :3]
    root = torch.linalg.cross(linear.sum(-2), root_rate)
    return torch.cat([torch.zeros_like(root_rate), root, joints], dim=-1)


def generalized_force(motion: Motion, wrenches: Tensor) -> Tensor:
    """sum_l J_l^T f_l of forces at the links' centers and torques, [B, L, 6] -> [B, 6 + J]."""
    columns = motion.jacobian.flatten(-3, -2)
    return product(wrenches.flatten(-2).unsqueeze(-2), columns).squeeze(-2)


def wrenches_of_forces(frames: Frames, links: Tensor, points: Tensor, forces: Tensor) -> Tensor:
    """Force and torque about the center of each link, from forces at points on them.

    Args:
        frames: Frames of the links.
        links: Index of each point's link, shape [V].
        points: Points in the frames of their links [m], shape [V, 3].
        forces: Forces in world axes [N], shape [B, V, 3].

    Returns:
        Wrenches in N and N m, shape [B, L, 6].
    """
    poses = frames.poses[..., links, :, :]
    placed = times(poses[..., :3, :3], points) + poses[..., :3, 3]
    arms = placed - frames.centers[..., links, :]
    parts = torch.cat([forces, torch.linalg.cross(arms, forces)], dim=-1)
    zeros = parts.new_zeros(*parts.shape[:-2], frames.centers.shape[-2], 6)
    return zeros.index_add(-2, links, parts)


def _at_joints(values: Tensor) -> Tensor:
    """Put zeros for the root before values [B, J] of the joints."""
    return torch.nn.functional.pad(values, (6, 0))
