"""A step begins at the inertial prediction, unless the path to it or its end has contact."""

import numpy as np
import torch

import diffcloth_torch as dc

H = 0.01
D_HAT = 2e-3


def falling(gap, speed):
    """A sheet that falls onto a floor: the path of its step and its inertial prediction."""
    sheet = dc.Cloth.grid(5, 5, size=0.2, pose=[0, 0, gap, 1, 0, 0, 0])
    floor = dc.RigidBody.plane(1.0)
    contact = dc.ContactOptions(barrier_distance=D_HAT)
    sim = dc.Simulator(dc.Scene([sheet], [floor], gravity=(0, 0, 0)), H, contact=contact)
    state = sim.initial_state()
    velocities = torch.zeros_like(state.positions)
    velocities[:, 2] = -speed
    path = sim.path(state.replace(velocities=velocities))[:, :25].numpy()
    predicted = state.positions.numpy() + H * velocities.numpy()
    return path, predicted


def visits(path, predicted):
    return np.abs(path - predicted).max(axis=(1, 2)).min() < 1e-12


def test_a_free_way_is_taken_at_once():
    path, predicted = falling(gap=0.01, speed=0.7)  # ends 3 mm above the floor
    assert visits(path[1:2], predicted)


def test_a_guess_in_contact_is_not_taken():
    # The guess is within the barrier's reach, where a solve would begin at its steepest point.
    path, predicted = falling(gap=0.01, speed=0.9)  # ends 1 mm above the floor
    assert not visits(path, predicted)


def test_a_guess_behind_a_surface_is_not_taken():
    path, predicted = falling(gap=0.01, speed=3.0)
    assert not visits(path, predicted)
    assert path[..., 2].min() > 0


def flights(*, height=0.3, speed=0.0, turn=0.0, attached=False):
    """A cube that flies beside a sheet in contact: its progress along the path of the step.

    Returns:
        Share of its free motion at each point of the path after the start; minimum over its
        vertices.
    """
    floor = dc.RigidBody.plane(4.0)
    pose = [1.0, 0, height, 1, 0, 0, 0]
    cube = dc.RigidBody.box(0.1, motion="dynamic", mass=1.0, pose=pose, name="cube")
    sheet = dc.Cloth.grid(5, 5, size=0.2, pose=[0, 0, 0.5 * D_HAT, 1, 0, 0, 0])
    spring = dc.Attachment(("cube", [0.0, 0.0, 0.0]), stiffness=1e3)
    scene = dc.Scene([sheet], [floor, cube], attachments=[spring] if attached else [])
    contact = dc.ContactOptions(barrier_distance=D_HAT)
    sim = dc.Simulator(scene, H, contact=contact)
    state = sim.initial_state()
    velocities = state.body_velocities.clone()
    velocities[1, 0], velocities[1, 2], velocities[1, 5] = 0.5, -speed, turn / H
    state = state.replace(body_velocities=velocities)
    control = dc.Control(attachments=torch.tensor([pose[:3]])) if attached else None
    path = sim.path(state, control)[:, -8:]

    alone = dc.Scene([], [dc.RigidBody.box(0.1, motion="dynamic", mass=1.0, pose=pose)])
    other = dc.Simulator(alone, H)
    flown = other.path(other.initial_state().replace(body_velocities=velocities[1:]))[-1, -8:]
    assert sim.step(state, control).report.contact_count > 0
    return ((path[1:] - path[0]).norm(dim=-1) / (flown - path[0]).norm(dim=-1)).amin(dim=-1)


def test_a_free_body_that_meets_nothing_flies_at_once():
    assert torch.allclose(flights(), torch.ones(1, dtype=torch.float64), atol=1e-12)
    assert (flights(turn=0.5) - 1).abs().max() < 1e-12


def test_a_free_body_that_would_end_behind_a_surface_does_not_fly_at_once():
    assert flights(height=0.05 + 0.01, speed=3.0)[0] < 0.99


def test_a_body_on_a_spring_does_not_fly_at_once():
    assert flights(attached=True)[0] < 0.99
