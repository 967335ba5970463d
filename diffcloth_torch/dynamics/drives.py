"""The drives of the joints, as quadratic terms of the objective that a step minimizes.

A joint under `pd` adds, with q_n its value at the start of the step of length h,

    1/2 kp (q - q_t)^2 + kd/(2h) (q - q_n - h qd_t)^2 + d/(2h) (q - q_n)^2,

so its drive acts at the end of the step, implicitly and without a bound on the gains. Under
`torque` there is only the last term, the joint's own viscosity.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffcloth_torch.dynamics.linear import solve

__all__ = ["Drives", "Gains", "fold"]


class Gains(NamedTuple):
    """Gains of each joint, [B or 1, J].

    Attributes:
        stiffness: kp [N m/rad or N/m].
        damping: kd [N m s/rad or N s/m].
        viscosity: d of the joint itself, in the same unit.
    """

    stiffness: Tensor
    damping: Tensor
    viscosity: Tensor


class Drives(NamedTuple):
    """Gains and targets of each joint, zero if its actuation does not use them; [B or 1, J].

    Attributes:
        stiffness: As in `Gains`.
        damping: Likewise.
        viscosity: Likewise.
        positions: q_t [rad or m].
        velocities: qd_t [rad/s or m/s].
        efforts: Constant efforts over the whole step [N m or N].
    """

    stiffness: Tensor
    damping: Tensor
    viscosity: Tensor
    positions: Tensor
    velocities: Tensor
    efforts: Tensor

    def applied_efforts(self, start: Tensor, end: Tensor, dt: float) -> Tensor:
        """Efforts of the drives over a step between joint values `start` and `end` [B, J]."""
        spring = self.stiffness * (self.positions - end)
        return self.efforts + spring + self.damping * (self.velocities - (end - start) / dt)


def fold(
    drives: Drives,
    inertial: Tensor,
    predicted: Tensor,
    start: Tensor,
    dt: float,
    unknown: Tensor,
    force: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Add drives and viscosity to 1/2 (q - q^)^T M/h^2 (q - q^), giving 1/2 (q - t)^T A (q - t).

    Args:
        drives: Drives of the last J of n coordinates.
        inertial: M/h^2, shape [B, n, n].
        predicted: q^, shape [B, n].
        start: q_n of the joints, shape [B, J].
        dt: h [s].
        unknown: Indices of the coordinates that are not prescribed; t equals q^ for the others.
        force: Another constant force, shape [B, n].

    Returns:
        A [B, n, n] and t [B, n].
    """
    n, joints = predicted.shape[-1], start.shape[-1]
    if not (len(unknown) and (joints or force is not None)):
        return inertial, predicted
    moved = predicted[..., n - joints :] - start
    pull = (
        drives.stiffness * (start + moved - drives.positions)
        + drives.damping * (moved / dt - drives.velocities)
        + drives.viscosity * moved / dt
    )
    gains = drives.stiffness + (drives.damping + drives.viscosity) / dt
    metric = inertial + torch.diag_embed(torch.nn.functional.pad(gains, (n - joints, 0)))
    pull = torch.nn.functional.pad(pull, (n - joints, 0))
    if force is not None:
        pull = pull - force
    solved = metric[..., unknown[:, None], unknown]
    return metric, predicted.index_add(-1, unknown, -solve(solved, pull[..., unknown]))
