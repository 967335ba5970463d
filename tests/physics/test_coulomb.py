"""Friction against Coulomb's laws, through the public interface."""

import numpy as np
import pytest
import torch
from physics_scenes import F64, WEIGHTLESS, matrix, quaternion, settle, strip, tensor

import diffcloth_torch as dc

G = 9.81


def patch_on_a_plane(mu, *, incline=0.0, plane=4.0, dt=0.01, slip_velocity=1e-3, scheme="coupled"):
    """A small sheet at rest on a plane that is tilted about y, pressed on by its normal weight.

    Returns the simulator, the state at rest, and the directions along and into the plane.
    """
    vertices, faces = strip(2, 3, 0.1, 0.1)
    # In general position on the plane: no edge of the sheet lines up with one of the plane.
    vertices = vertices @ matrix(quaternion([0, 0, 1], 0.3)).T + [0.03, 0.02, 0]
    R = matrix(quaternion([0, 1, 0], incline))
    along, down = tensor(R @ [1, 0, 0]), tensor(R @ [0, 0, -1])
    material = dc.Material(stretch=500.0, bending=1e-3, damping=1e-2, friction=mu)
    gap = R @ [0, 0, 2e-3]
    cloth = dc.Cloth(vertices @ R.T + gap, faces, material=material)
    floor = dc.RigidBody.plane(plane, friction=mu, pose=[0, 0, 0, *quaternion([0, 1, 0], incline)])
    contact = dc.ContactOptions(slip_velocity=slip_velocity)
    sim = dc.Simulator(
        dc.Scene([cloth], [floor], gravity=(G * np.cos(incline) * down).tolist()),
        dt,
        scheme=scheme,
        contact=contact,
        solver=dc.SolverOptions(tolerance=1e-8),
    )
    return sim, settle(sim, sim.initial_state(), steps=200, speed=1e-6), along, down


@pytest.mark.parametrize("mu", [0.1, 0.3, 0.5, 0.7])
@pytest.mark.parametrize("scheme", ["coupled", "split"])
@pytest.mark.parametrize("degrees", [-1.0, 1.0])
def test_a_sheet_sticks_to_an_incline_up_to_its_friction_angle(mu, scheme, degrees):
    incline = np.arctan(mu) + np.radians(degrees)
    sim, state, along, _ = patch_on_a_plane(mu, incline=incline, dt=0.02, scheme=scheme)
    weight = sim.default_parameters().replace(gravity=torch.tensor([0, 0, -G], dtype=F64))
    for _ in range(15):
        state = sim.step(state, None, weight)
    speed = (state.velocities @ along).mean().item()
    if degrees < 0:
        assert abs(speed) < 1e-3  # mollified friction creeps below the slip velocity
    else:
        acceleration = G * np.cos(incline) * (np.tan(incline) - mu)
        assert speed > 0.9 * acceleration * 0.28


def test_a_sliding_sheet_accelerates_as_coulomb_says():
    # mu 0.49 on tan(theta) = 0.5: a = g (sin - mu cos) = 0.087743 m/s^2.
    sim, state, along, _ = patch_on_a_plane(
        0.49, incline=np.arctan(0.5), dt=0.02, slip_velocity=1e-4
    )
    weight = sim.default_parameters().replace(gravity=torch.tensor([0, 0, -G], dtype=F64))
    speeds = []
    for _ in range(20):
        state = sim.step(state, None, weight)
        speeds.append((state.velocities @ along).mean().item())
    assert (speeds[-1] - speeds[9]) / (10 * sim.dt) == pytest.approx(0.087743, rel=0.01)


def slide_to_rest(sim, state, v_0, mu, steps):
    v = v_0 * tensor([1.0, 0.0, 0.0]).expand_as(state.velocities)
    parameters = sim.default_parameters().replace(friction=mu)
    start = state.positions[:, 0].mean().item()
    state = state.replace(velocities=v)
    for _ in range(steps):
        state = sim.step(state, None, parameters)
    assert state.velocities.detach().abs().max() < 1e-3
    return state.positions[:, 0].mean() - start


@pytest.mark.parametrize(("v_0", "mu"), [(2.0, 0.5), (10.0, 0.8)])
def test_stopping_distance_and_its_gradients(v_0, mu):
    # d = v0^2 / (2 mu g) - v0 h / 2 for implicit Euler; both derivatives.
    h = 0.01
    sim, state, _, _ = patch_on_a_plane(mu, plane=40.0, dt=h)
    speed = torch.tensor(v_0, dtype=F64, requires_grad=True)
    friction = torch.tensor(mu, dtype=F64, requires_grad=True)
    steps = round(v_0 / (mu * G) / h) + 5
    distance = slide_to_rest(sim, state, speed, friction, steps)
    assert distance.item() == pytest.approx(v_0**2 / (2 * mu * G) - v_0 * h / 2, rel=0.01)
    d_speed, d_friction = torch.autograd.grad(distance, (speed, friction))
    tolerance = 1e-3 + h * mu * G / v_0
    assert d_speed.item() == pytest.approx(v_0 / (mu * G), rel=tolerance)
    assert d_friction.item() == pytest.approx(-(v_0**2) / (2 * mu**2 * G), rel=tolerance)


def belt(ratio, mu=0.3, tension=1.0):
    """Speed that a light strip over a quarter of a cylinder gains under two end loads."""
    radius, width, cells, rows = 0.1, 0.02, 26, 2
    length = 0.08 + 0.5 * np.pi * radius + 0.08
    rest, faces = strip(cells, rows, length, width)
    gap = 2e-3
    s = rest[:, 0] - 0.08
    arc = np.clip(s / radius, 0, 0.5 * np.pi)
    # Over the top from -x, around the quarter, down along -z.
    position = (radius + gap) * np.stack([np.sin(arc), 0 * arc, np.cos(arc)], axis=-1)
    position[:, 0] += np.minimum(s, 0)
    position[:, 2] -= np.maximum(s - 0.5 * np.pi * radius, 0)
    position[:, 1] = rest[:, 1] + 0.011
    material = dc.Material(stretch=3e3, bending=1e-6, density=0.2, friction=mu, damping=1e-3)
    cloth = dc.Cloth(position, faces, rest_positions=rest, material=material)
    pulley = dc.RigidBody.capsule(
        radius, 0.2, friction=mu, pose=[0, 0, 0, *quaternion([1, 0, 0], np.pi / 2)]
    )
    contact = dc.ContactOptions(self_contact=False)
    sim = dc.Simulator(
        dc.Scene([cloth], [pulley], gravity=WEIGHTLESS),
        0.01,
        contact=contact,
        solver=dc.SolverOptions(tolerance=1e-5),
    )
    state = sim.initial_state()
    for k in range(40):
        forces = np.zeros_like(position)
        forces[:rows, 0] = -tension / rows
        forces[-rows:, 2] = -tension / rows * (1 + (ratio - 1) * min(k / 20, 1))
        state = sim.step(state, dc.Control(forces=forces))
    return -state.velocities[-rows:, 2].mean().item()


def test_a_belt_slips_beyond_eulers_ratio():
    # Capstan over 90 degrees with mu 0.3: T2 / T1 = exp(mu pi / 2) = 1.60198; the polygon of the
    # capsule, 8 corners of 11.25 degrees, adds 0.2 %.
    corner = 0.3 * np.tan(np.radians(11.25) / 2)
    polygon = ((1 + corner) / (1 - corner)) ** 8
    assert polygon == pytest.approx(1.60198, rel=3e-3)
    assert belt(0.97 * polygon) < 1e-3
    assert belt(1.03 * polygon) > 0.05


def test_a_moving_body_drags_the_cloth_along():
    # A conveyor belt: the sheet accelerates by mu g, then moves with the belt.
    vertices, faces = strip(2, 3, 0.1, 0.1)
    vertices = vertices @ matrix(quaternion([0, 0, 1], 0.3)).T + [0.03, 0.02, 2e-3]
    cloth = dc.Cloth(vertices, faces, material=dc.Material(friction=0.5, bending=1e-3))
    belt = dc.RigidBody.plane(4.0, friction=0.5, motion="kinematic")
    sim = dc.Simulator(dc.Scene([cloth], [belt]), 0.01)
    state = settle(sim, sim.initial_state(), steps=200, speed=1e-5)
    speed, pose = 0.4, state.body_poses.clone()
    speeds = []
    for _ in range(12):
        pose = pose + tensor([speed * sim.dt, 0, 0, 0, 0, 0, 0])
        state = sim.step(state, dc.Control(body_poses=pose))
        speeds.append(state.velocities[:, 0].mean().item())
    assert speeds[4] == pytest.approx(5 * 0.5 * G * sim.dt, rel=0.01)
    assert speeds[-1] == pytest.approx(speed, abs=1e-3)
