"""What becomes of bodies and robots in a step: the fields of the state behind it."""

from __future__ import annotations

import torch

from diffcloth_torch.dynamics.dynamics import Dynamics, Prediction
from diffcloth_torch.geometry.rotation import pose_velocities
from diffcloth_torch.sim.inputs import Fields
from diffcloth_torch.sim.layout import Layout
from diffcloth_torch.sim.step import Outcome

__all__ = ["dynamic_motion", "prescribed_motion"]


def prescribed_motion(layout: Layout, state: Fields, control: Fields, dt: float) -> Fields:
    """Fields of the next state where bodies only move on prescribed poses.

    Args:
        layout: What the rows stand for.
        state: Fields of the state before the step.
        control: Completed fields of the control.
        dt: Time step [s].
    """
    start, end = state["body_poses"], control["body_poses"]
    velocities = torch.zeros(max(len(start), len(end)), start.shape[1], 6, dtype=torch.float64)
    if end is not start:
        moving = layout.kinematic_bodies
        quotients = pose_velocities(start[:, moving], end[:, moving], dt)
        velocities = velocities.index_copy(1, moving, quotients)
    return {"body_poses": end, "body_velocities": velocities}


def dynamic_motion(
    layout: Layout,
    dynamics: Dynamics,
    prediction: Prediction,
    state: Fields,
    control: Fields,
    outcome: Outcome,
    batch: int | None,
) -> Fields:
    """Fields of the next state where forces move something, or there are robots.

    Args:
        layout: What the rows stand for.
        dynamics: Of the bodies and robots.
        prediction: What it said before the step.
        state: Fields of the state before the step.
        control: Completed fields of the control.
        outcome: Of the step.
        batch: Batch size, None without a batch axis.
    """
    coordinates, forces = outcome.coordinates, outcome.body_forces
    if coordinates is None:  # robots whose joints are all fixed
        coordinates = forces.new_zeros((*forces.shape[:-2], 0))
    if batch is None:
        coordinates, forces = coordinates.unsqueeze(0), forces.unsqueeze(0)
    after = dynamics.advance(prediction, coordinates, forces)
    targets = torch.where(layout.driven, control["joint_positions"], state["joint_targets"])
    return {**after, "joint_targets": targets}
