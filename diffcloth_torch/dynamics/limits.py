"""Stiffness of the barriers at the limits of joints."""

from __future__ import annotations

import numpy as np
import torch

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.dynamics.inertia import Inertia, Motion, mass_matrix
from diffcloth_torch.dynamics.jacobians import ROOT, DifferentialKinematics
from diffcloth_torch.model.assembly import Assembly
from diffcloth_torch.model.mechanism import Mechanism

__all__ = ["ZONE", "limit_stiffness"]

ZONE = 0.01
"""Share of its range by which a joint may be beyond a limit."""

# A joint whose whole weight rests on its limit is sqrt(1 / (3 . 30)) = 0.11 of the zone beyond it.
_WEIGHT_MARGIN = 30.0


def limit_stiffness(assembly: Assembly, dt: float, gravity: FloatArray) -> FloatArray:
    """Stiffness of the barrier at the limits of each coordinate.

    Beyond a limit the barrier's force grows from zero to infinity over the zone of width w, as
    3 k w p^2 at a small share p of it. With

        k = M_jj / h^2 + 30 Q_j / w

    a limit is about as stiff as the joint's own inertia, and the joint's weight, a generalized
    force of at most Q_j, pushes it a tenth of the zone beyond the limit. M and Q are those of the
    scene at its start, for any direction of gravity.

    Args:
        assembly: Arrays of the scene.
        dt: h [s].
        gravity: [3] m/s^2.

    Returns:
        k [N m/rad^2 or N/m], shape [n]; zero for coordinates without a limit to keep.
    """
    parts = [np.empty(0)]
    first = 0
    strength = float(np.linalg.norm(gravity))
    for mechanism in assembly.mechanisms:
        joints = slice(first, first := first + mechanism.joint_count)
        if mechanism.base == "floating":
            parts.append(np.zeros(ROOT))
        start, armature = assembly.joint_positions[joints], assembly.joint_armature[joints]
        parts.append(_of_joints(mechanism, start, armature, dt, strength))
    return np.concatenate(parts)


def _of_joints(
    mechanism: Mechanism, start: FloatArray, armature: FloatArray, dt: float, gravity: float
) -> FloatArray:
    width = ZONE * (mechanism.upper - mechanism.lower)
    limited = np.isfinite(width) & mechanism.forced
    if not limited.any():
        return np.zeros(mechanism.joint_count)
    kinematics = DifferentialKinematics(mechanism)
    arrays = (mechanism.mass, mechanism.center, mechanism.inertia, armature)
    inertia = Inertia(*(torch.from_numpy(np.array(a))[None] for a in arrays))
    joints = torch.from_numpy(np.array(start))[None]
    motion = Motion.at(kinematics, inertia, torch.eye(4, dtype=torch.float64)[None], joints)
    mass = mass_matrix(motion, inertia)[0].diagonal()[ROOT:].numpy()
    pull = motion.weighted[0, :, :3, ROOT:].norm(dim=1).sum(0).numpy()  # m |dc/dq| of all links
    stiffness = mass / dt**2
    stiffness[limited] += _WEIGHT_MARGIN * gravity * pull[limited] / width[limited]
    return np.where(limited, stiffness, 0.0)
