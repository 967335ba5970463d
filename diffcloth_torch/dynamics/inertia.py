"""Mass matrix, momentum and forces of a mechanism in its velocities nu = (dc/dt, omega, dq/dt).

With the 6 velocities V_l = J_l nu of each link, those of its center and of rotation, and its mass
and inertia in world axes W_l = diag(m 1, R I R^T):

    M = sum_l J_l^T W_l J_l,   p = M nu = sum_l J_l^T h_l,   h_l = W_l V_l.

This serves energies, momenta and constants. Steps take the same from recursions along the tree in
the core (`csrc/bodies/tree.h`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffcloth_torch.dynamics.jacobians import DifferentialKinematics, Frames
from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.geometry.products import product

__all__ = [
    "Inertia",
    "Motion",
    "generalized_force",
    "link_momenta",
    "mass_matrix",
    "momentum",
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


def generalized_force(motion: Motion, wrenches: Tensor) -> Tensor:
    """sum_l J_l^T f_l of forces at the links' centers and torques, [B, L, 6] -> [B, 6 + J]."""
    columns = motion.jacobian.flatten(-3, -2)
    return product(wrenches.flatten(-2).unsqueeze(-2), columns).squeeze(-2)


def _at_joints(values: Tensor) -> Tensor:
    """Put zeros for the root before values [B, J] of the joints."""
    return torch.nn.functional.pad(values, (6, 0))
