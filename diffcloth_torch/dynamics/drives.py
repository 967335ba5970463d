"""The drives of the joints, as terms of the objective that a step minimizes.

A joint under `pd` adds, with q_n its value at the start of the step of length h,

    1/2 kp (q - q_t)^2 + kd/(2h) (q - q_n - h qd_t)^2 + d/(2h) (q - q_n)^2,

so its drive acts at the end of the step, implicitly and without a bound on the gains. Under
`torque` there is only the last term, the joint's own viscosity.

That is a drive that has whatever effort it asks for. Under a limit L, of an effort a it has only

    s(a) = a for |a| <= 0.9 L,    sign(a) (0.9 L + 0.1 L r / sqrt(1 + r^2)) beyond,

with the excess r = (|a| - 0.9 L) / (0.1 L). This has two continuous derivatives, and its slope
never vanishes. What a drive lacks, a - s(a), is part of the term of a joint, which the core
evaluates (see csrc/bodies/joint_term.h), as are a limit of the speed and Coulomb friction.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffcloth_torch.checks import LARGEST
from diffcloth_torch.dynamics.linear import solve

__all__ = ["Bounds", "Drives", "Gains", "fold", "idle_terms", "joint_terms", "limited_effort"]

# A drive has what it asks for up to this share of its limit; the core has the same number.
_LINEAR = 0.9


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


class Bounds(NamedTuple):
    """What each joint can do and what resists it, [B or 1, J].

    Attributes:
        efforts: L [N m or N].
        velocities: Largest speed [rad/s or m/s].
        friction: Coulomb friction [N m or N].
        slip_rates: Speed at which sticking turns into sliding [rad/s or m/s].
    """

    efforts: Tensor
    velocities: Tensor
    friction: Tensor
    slip_rates: Tensor


class Drives(NamedTuple):
    """Gains and targets of each joint, zero if its actuation does not use them; [B or 1, J].

    Attributes:
        stiffness: As in `Gains`.
        damping: Likewise.
        viscosity: Likewise.
        positions: q_t [rad or m].
        velocities: qd_t [rad/s or m/s].
        asked: Constant efforts over the whole step that are asked for [N m or N].
        efforts: Those of them that are within the limit.
        limits: L of pd drives, where there is one; None for no limits at all.
    """

    stiffness: Tensor
    damping: Tensor
    viscosity: Tensor
    positions: Tensor
    velocities: Tensor
    asked: Tensor
    efforts: Tensor
    limits: Tensor | None

    def asked_efforts(self, start: Tensor, end: Tensor, dt: float) -> Tensor:
        """Efforts that drives ask for in a step between joint values `start` and `end` [B, J]."""
        spring = self.stiffness * (self.positions - end)
        return self.asked + spring + self.damping * (self.velocities - (end - start) / dt)

    def applied_efforts(self, start: Tensor, end: Tensor, dt: float) -> Tensor:
        """Efforts that they have."""
        asked = self.asked_efforts(start, end, dt)
        return asked if self.limits is None else limited_effort(asked, self.limits)


def limited_effort(asked: Tensor, limit: Tensor) -> Tensor:
    """The effort s(a) of a drive that asks for a; see the top of this file."""
    excess = (asked.abs() - _LINEAR * limit).clamp(min=0.0) / ((1.0 - _LINEAR) * limit)
    bent = (1.0 - _LINEAR) * limit * excess / torch.sqrt(1.0 + excess * excess)
    return torch.where(excess > 0.0, torch.sign(asked) * (_LINEAR * limit + bent), asked)


def joint_terms(
    drives: Drives,
    bounds: Bounds,
    start: Tensor,
    origins: Tensor,
    dt: float,
) -> Tensor:
    """Rows of the core's joint terms, [B, J, 7]; it ignores those of prescribed joints.

    Args:
        drives: Drives of the joints.
        bounds: Their limits and friction.
        start: q_n, [B, J].
        origins: Values from which friction counts motion, [B, J].
        dt: h [s].
    """
    rows = (
        origins,
        drives.asked_efforts(start, origins, dt),
        drives.stiffness + drives.damping / dt,
        torch.full_like(start, LARGEST) if drives.limits is None else drives.limits,
        bounds.velocities,
        bounds.friction,
        bounds.slip_rates,
    )
    return torch.stack([row.expand_as(start) for row in rows], dim=-1)


def idle_terms(like: Tensor, count: int) -> Tensor:
    """Rows of joint terms that do nothing, [B, count, 7], for coordinates that are no joints."""
    row = like.new_tensor([0.0, 0.0, 0.0, LARGEST, LARGEST, 0.0, 1.0])
    return row.expand(len(like), count, len(row))


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
    if drives.limits is not None:
        pull = pull - (drives.asked - drives.efforts)
    pull = torch.nn.functional.pad(pull, (n - joints, 0))
    if force is not None:
        pull = pull - force
    solved = metric[..., unknown[:, None], unknown]
    return metric, predicted.index_add(-1, unknown, -solve(solved, pull[..., unknown]))
