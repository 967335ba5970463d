"""Motion of bodies and robots in a step: their fields of the state after it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import FloatArray
from diffcloth_torch.geometry.rotation import row_velocities
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.sim.inputs.layout import Layout

__all__ = ["held_targets", "prescribed_motion", "reached_poses", "with_rows"]


def reached_poses(targets: Tensor, ended: Mapping[int, FloatArray], environments: int) -> Tensor:
    """Poses at the end of a step, [B, T, 7], without a graph where the motion stopped early.

    Args:
        targets: Poses at the end of the complete motion, [B or 1, T, 7].
        ended: Environment that stopped early -> its poses there, [T, 7].
        environments: Number of environments, B.
    """
    there = cpu.zeros(environments, *targets.shape[1:])
    for i, poses in ended.items():
        there[i] = torch.from_numpy(poses)
    return with_rows({"": targets}, {"": there}, ended)[""]


def with_rows(fields: Fields, others: Fields, environments: Iterable[int]) -> Fields:
    """Return fields [B or 1, ...] with the rows of some environments taken from `others`.

    `others` must have no graph: all other rows then keep the same gradients, to the bit, as without
    a replacement.
    """
    mixed = {}
    for name, other in others.items():
        mask = cpu.zeros(len(other), *[1] * (other.ndim - 1), dtype=torch.bool)
        mask[list(environments)] = True
        mixed[name] = torch.where(mask, other, fields.get(name, torch.zeros_like(other)))
    return fields | mixed


def prescribed_motion(layout: Layout, state: Fields, control: Fields, dt: float) -> Fields:
    """Fields of the next state if bodies only move on prescribed poses.

    Velocities are left out if nothing moves: a state then has zeros.

    Args:
        layout: Meaning of the rows.
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
    """Targets of the pd drives from now on, [B, J]."""
    return torch.where(
        layout.permissions.driven, control["joint_positions"], state["joint_targets"]
    )
