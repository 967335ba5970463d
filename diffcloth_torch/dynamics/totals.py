"""Momentum and energy of all moving objects in a scene: sums over points, bodies and links."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffcloth_torch import cpu

__all__ = ["Totals", "about_origin", "ordered_sum"]


class Totals(NamedTuple):
    """Totals of each environment.

    Attributes:
        momentum: Linear momentum, then angular about the world's origin [kg m/s, kg m^2/s], [B, 6].
        kinetic_energy: Kinetic energy, [B] J.
        gravity_energy: Energy of weights, zero at the origin of the world, [B] J.
    """

    momentum: Tensor
    kinetic_energy: Tensor
    gravity_energy: Tensor

    @staticmethod
    def of(
        centers: Tensor, momenta: Tensor, kinetic_energy: Tensor, masses: Tensor, gravity: Tensor
    ) -> Totals:
        """Sum up points, bodies or links.

        Args:
            centers: [B, n, 3] m.
            momenta: Linear, then angular about the centers, [B, n, 6].
            kinetic_energy: Kinetic energy of all, [B] J.
            masses: [B or 1, n] kg.
            gravity: [B or 1, 3] m/s^2.
        """
        weights = masses[..., None] * gravity[:, None]
        return Totals(
            momentum=ordered_sum(about_origin(centers, momenta).transpose(-1, -2)),
            kinetic_energy=kinetic_energy,
            gravity_energy=-ordered_sum((weights * centers).flatten(-2)),
        )

    @staticmethod
    def zero(environments: int) -> Totals:
        """Make the totals of a scene in which nothing moves."""
        zeros = cpu.zeros(environments, 6)
        return Totals(zeros, zeros[:, 0], zeros[:, 0])

    def plus(self, other: Totals) -> Totals:
        """Add other totals."""
        return Totals(*(a + b for a, b in zip(self, other, strict=True)))


def ordered_sum(values: Tensor) -> Tensor:
    """Sum over the last axis, one number after the other.

    With `sum`, rounding would depend on the number of environments and threads.
    """
    return values.cumsum(-1)[..., -1]


def about_origin(centers: Tensor, momenta: Tensor) -> Tensor:
    """Momenta [.., 6] about centers [.., 3], about the origin of the world."""
    linear, angular = torch.split(momenta, 3, dim=-1)
    return torch.cat([linear, angular + torch.linalg.cross(centers, linear)], dim=-1)
