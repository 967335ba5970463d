"""Masses and inertias of links, and the momentum and energy of rigid bodies and links."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.dynamics.totals import Totals, ordered_sum

__all__ = ["ROOT", "Inertia", "rigid_totals"]

ROOT = 6
"""Number of velocities of a root, before the joint velocities: linear at its center, angular."""


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


def rigid_totals(
    frames: Tensor,
    velocities: Tensor,
    mass: Tensor,
    center: Tensor,
    inertia: Tensor,
    gravity: Tensor,
) -> Totals:
    """Momentum and energy of rigid bodies, or of links without their drives.

    Args:
        frames: Their frames, [B, n, 4, 4].
        velocities: Velocities of the centers, then angular ones, in world axes; [B, n, 6].
        mass: [B or 1, n] kg.
        center: Centers of mass in the frames, [B or 1, n, 3] m.
        inertia: Inertias about the centers, in the axes of the frames, [B or 1, n, 3, 3] kg m^2.
        gravity: [B or 1, 3] m/s^2.
    """
    rotation = frames[..., :3, :3]
    centers = frames[..., :3, 3] + times(rotation, center)
    spin = times(rotation.transpose(-1, -2), velocities[..., 3:])
    angular = times(rotation, times(inertia, spin))
    momenta = torch.cat([mass[..., None] * velocities[..., :3], angular], dim=-1)
    kinetic = ordered_sum((momenta * velocities).flatten(-2)) / 2
    return Totals.of(centers, momenta, kinetic, mass, gravity)
