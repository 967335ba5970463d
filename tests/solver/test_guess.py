"""A step begins where inertia alone would go, unless that way or its end is not free of contact."""

import numpy as np
import torch

import diffcloth_torch as dc

H = 0.01
D_HAT = 2e-3


def falling(gap, speed):
    """A sheet that falls onto a floor: its path, and where inertia alone would take it."""
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
    # It ends within the barrier's reach: so near a surface a solve would begin at its steepest.
    path, predicted = falling(gap=0.01, speed=0.9)  # ends 1 mm above the floor
    assert not visits(path, predicted)


def test_a_guess_behind_a_surface_is_not_taken():
    path, predicted = falling(gap=0.01, speed=3.0)
    assert not visits(path, predicted)
    assert path[..., 2].min() > 0
