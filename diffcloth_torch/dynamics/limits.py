"""Scales of joints: the stiffness of the barriers at their limits, and their slip rates."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from diffcloth_torch import cpu
from diffcloth_torch.checks import FloatArray
from diffcloth_torch.dynamics.inertia import ROOT, rigid_totals
from diffcloth_torch.model.assembly import Assembly
from diffcloth_torch.model.kinematics import Links, constant
from diffcloth_torch.model.mechanism import Mechanism

__all__ = ["ZONE", "LimitStiffness", "limit_stiffness", "slip_rates"]

ZONE = 0.01
"""Share of its range by which a joint may be beyond a limit, and of a limit of its speed."""

# A joint whose whole weight rests on its limit is beyond it by sqrt(1 / (3 . 30)) = 0.11 of the
# zone.
_WEIGHT_MARGIN = 30.0


class LimitStiffness(NamedTuple):
    """Constants of the barriers at limits, one for each coordinate.

    Attributes:
        positions: k of limits of positions [N m/rad^2 or N/m], zero without one; shape [n].
        velocities: k of limits of speeds; the stiffness of the barrier is k + F / w; shape [n].
        forces: F [N m or N], shape [n].
    """

    positions: FloatArray
    velocities: FloatArray
    forces: FloatArray


def limit_stiffness(assembly: Assembly, dt: float, gravity: FloatArray) -> LimitStiffness:
    """Stiffness of the barriers at the limits of each coordinate.

    Beyond a limit the barrier's force grows from zero to infinity over the zone of width w, as
    3 k w p^2 at a small share p of it. With

        k = M_jj / h^2 + 30 Q_j / w

    a limit is about as stiff as the joint's own inertia, and the joint's weight, a generalized
    force of at most Q_j, pushes the joint a tenth of the zone beyond the limit. M and Q are
    evaluated at the start of the scene, for any direction of gravity. The same holds for a limit of
    speed, with the width of the zone as a distance in a step, which is known once the limit is.

    Args:
        assembly: Arrays of the scene.
        dt: h [s].
        gravity: [3] m/s^2.
    """
    parts = [np.empty((3, 0))]
    strength = float(np.linalg.norm(gravity))
    for mechanism, inertia in _inertias(assembly):
        if mechanism.base == "floating":
            parts.append(np.zeros((3, ROOT)))
        width = ZONE * (mechanism.upper - mechanism.lower)
        limited = np.isfinite(width) & mechanism.forced
        stiffness = inertia.moments / dt**2
        force = _WEIGHT_MARGIN * strength * inertia.pulls
        speed = mechanism.forced * np.stack([stiffness, force])
        stiffness[limited] += force[limited] / width[limited]
        parts.append(np.stack([np.where(limited, stiffness, 0.0), *speed]))
    return LimitStiffness(*np.concatenate(parts, axis=1))


def slip_rates(assembly: Assembly, slip_velocity: float) -> FloatArray:
    """Speeds of the joints that move their loads with a slip velocity.

    The slip velocity is reached at the load's radius of gyration about the joint's axis, sqrt(M_jj
    / m_j), with the mass m_j that the joint carries; prismatic joints without others that mimic
    them have the slip velocity.

    Args:
        assembly: Arrays of the scene.
        slip_velocity: [m/s].

    Returns:
        [rad/s or m/s], shape [J]; the slip velocity itself for joints that no force moves.
    """
    parts = [np.empty(0)]
    for mechanism, inertia in _inertias(assembly):
        forced = mechanism.forced
        masses, moments = (np.where(forced, x, 1.0) for x in (inertia.masses, inertia.moments))
        parts.append(slip_velocity * np.sqrt(masses / moments))
    return np.concatenate(parts)


class _Inertia(NamedTuple):
    """Values of joints at the start: M_jj, m |dc/dq| summed over the links, and their mass; [J]."""

    moments: FloatArray
    pulls: FloatArray
    masses: FloatArray


def _inertias(assembly: Assembly) -> Iterator[tuple[Mechanism, _Inertia]]:
    first = 0
    for mechanism in assembly.mechanisms:
        joints = slice(first, first := first + mechanism.joint_count)
        start, armature = assembly.joint_positions[joints], assembly.joint_armature[joints]
        none = np.zeros(mechanism.joint_count)
        inertia = _Inertia(none, none, none)
        if mechanism.forced.any():
            inertia = _of_joints(mechanism, start, armature)
        yield mechanism, inertia


def _of_joints(mechanism: Mechanism, start: FloatArray, armature: FloatArray) -> _Inertia:
    arrays = (mechanism.mass, mechanism.center, mechanism.inertia)
    mass, center, inertia = (constant(array)[None] for array in arrays)
    # Each joint in turn moves alone, at unit speed.
    count = mechanism.joint_count
    links, joints = Links(mechanism), constant(start).expand(count, -1)
    root, still = cpu.eye(4).expand(count, 4, 4), cpu.zeros(1, ROOT)
    velocities = links.velocities(root, joints, center, still, cpu.eye(count))
    frames = links.frames(root, joints)
    totals = rigid_totals(frames, velocities, mass, center, inertia, cpu.zeros(1, 3))
    moments = 2 * totals.kinetic_energy.numpy() + armature
    pulls = (mass * velocities[..., :3].norm(dim=-1)).sum(-1).numpy()
    return _Inertia(moments, pulls, _carried(mechanism))


def _carried(mechanism: Mechanism) -> FloatArray:
    """Mass of the links that each joint moves [kg], shape [J]."""
    carried = np.zeros(mechanism.joint_count)
    moved: dict[int, set[int]] = {}
    for link in mechanism.order:  # parents first
        above = moved.get(int(mechanism.parent[link]), set())
        own = int(mechanism.dof[link])
        moved[link] = above | ({own} if own >= 0 else set())
        for j in moved[link]:
            carried[j] += mechanism.mass[link]
    return carried
