"""What becomes of bodies and robots in a step: the fields of the state behind it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.geometry.rotation import row_velocities
from diffcloth_torch.sim.inputs import Fields
from diffcloth_torch.sim.layout import Layout

__all__ = ["ended_poses", "held_targets", "prescribed_motion", "with_rows"]


def ended_poses(targets: Tensor, ended: Mapping[int, FloatArray], environments: int) -> Tensor:
    """Poses at the end of a step, where the motion of some environments has ended early.

    Args:
        targets: Where it should have led, [B or 1, T, 7].
        ended: Environment -> poses there, [T, 7].
        environments: B.
    """
    poses = targets.detach().expand(environments, *targets.shape[1:]).clone()
    for i, there in ended.items():
        poses[i] = torch.from_numpy(there)
    return poses


def with_rows(fields: Fields, others: Fields, environments: Iterable[int]) -> Fields:
    """Fields [B or 1, ...] that have the rows of other ones in some environments.

    The others are to have no graph: the rest then keeps the gradients, to the bit, that it has
    where there is nothing to replace.
    """
    mixed = {}
    for name, other in others.items():
        mask = torch.zeros(len(other), *[1] * (other.ndim - 1), dtype=torch.bool)
        mask[list(environments)] = True
        mixed[name] = torch.where(mask, other, fields.get(name, torch.zeros_like(other)))
    return fields | mixed


def prescribed_motion(layout: Layout, state: Fields, control: Fields, dt: float) -> Fields:
    """Fields of the next state where bodies only move on prescribed poses.

    Velocities are left out where nothing moves: a state has zeros then.

    Args:
        layout: What the rows stand for.
        state: Fields of the state before the step.
        control: Completed fields of the control.
        dt: Time step [s].
    """
    start, end = state["body_poses"], control["body_poses"]
    moving = layout.kinematic_bodies
    if end is start or not moving.numel():  # unset targets hold
        return {"body_poses": end}
    return {"body_poses": end, "body_velocities": row_velocities(start, end, moving, dt)}


def held_targets(layout: Layout, state: Fields, control: Fields) -> Tensor:
    """What pd drives pull to from now on, [B, J]."""
    return torch.where(layout.driven, control["joint_positions"], state["joint_targets"])
