"""The motion of a sheet on a body does not depend on the body's triangulation."""

import numpy as np
import pytest
import torch
import trimesh
from physics_scenes import F64, jittered_sheet, matrix, quaternion, settle, strip, tensor

import diffcloth_torch as dc

G = 9.81
D_HAT = 2e-3


def floor_of(columns, rows, size_x, size_y, *, sliver=0.0):
    """Flat floor of 2 * columns * rows triangles, and slivers that wide beside each column."""
    x = np.linspace(-size_x / 2, size_x / 2, columns + 1)
    if sliver:
        x = np.sort([*x, *(x[:-1] + sliver)])
    y = np.linspace(-size_y / 2, size_y / 2, rows + 1)
    u, v = np.meshgrid(x, y, indexing="ij")
    n = rows + 1
    corner = (n * np.arange(len(x) - 1)[:, None] + np.arange(rows)).ravel()
    faces = [[corner, corner + n, corner + n + 1], [corner, corner + n + 1, corner + 1]]
    return (
        np.stack([u, v, 0 * u], axis=-1).reshape(-1, 3),
        np.concatenate([np.stack(f, axis=-1) for f in faces]),
    )


def posed(vertices, turn, shift):
    return vertices @ matrix(quaternion([0, 0, 1], turn)).T + shift


def sheet_on(body, stiffness, *, height=0.0, friction=0.0, stretch=300.0, tolerance=1e-8):
    """A jittered sheet of 20 cm just above a body; its weight is borne in the middle of d_hat."""
    vertices, faces = jittered_sheet(10, 0.2)
    vertices = vertices - [0.1, 0, 0]
    cloth = dc.Cloth(
        posed(vertices, 0.3, [0.003, 0.002, height + 1.5e-3]),
        faces,
        rest_positions=vertices,
        material=dc.Material(stretch=stretch, bending=1e-5, damping=1e-2, friction=friction),
    )
    return dc.Simulator(
        dc.Scene([cloth], [dc.RigidBody(*body, friction=friction)]),
        0.02,
        contact=dc.ContactOptions(
            barrier_distance=D_HAT, barrier_stiffness=stiffness, self_contact=False
        ),
        solver=dc.SolverOptions(tolerance=tolerance),
    )


FLOORS = {
    2: floor_of(1, 1, 0.7, 0.7),
    32: floor_of(4, 4, 0.7, 0.7),
    288: floor_of(12, 12, 0.7, 0.7),
    3200: floor_of(40, 40, 0.7, 0.7),
    51200: floor_of(160, 160, 0.7, 0.7),
    "slivers": floor_of(8, 8, 0.7, 0.7, sliver=1e-5),
}
EVERY_FLOOR = [
    2,
    32,
    288,
    pytest.param(3200, marks=pytest.mark.slow),
    pytest.param(51200, marks=pytest.mark.slow),
    "slivers",
]


def at_rest_on_a_floor(triangles):
    sim = sheet_on(FLOORS[triangles], 2.0)
    return sim, settle(sim, sim.initial_state(), steps=100, speed=1e-9)


@pytest.mark.parametrize("triangles", EVERY_FLOOR)
def test_a_sheet_rests_at_one_gap_above_any_floor(triangles):
    _, reference = at_rest_on_a_floor(2)
    gap = reference.positions[:, 2]
    assert 0.4 * D_HAT < gap.mean() < 0.7 * D_HAT
    _, state = at_rest_on_a_floor(triangles)
    # Every vertex has one contact: not like others, but the same to rounding.
    assert state.report.contact_count == len(state.positions)
    torch.testing.assert_close(state.positions[:, 2], gap, rtol=1e-9, atol=0)


@pytest.mark.parametrize("triangles", EVERY_FLOOR)
def test_a_sheet_glides_over_any_floor_without_hopping(triangles):
    sim, state = at_rest_on_a_floor(triangles)
    throw = tensor([1.0, 0.3, 0.0])
    state = state.replace(velocities=throw.expand_as(state.velocities))
    for _ in range(8):
        state = sim.step(state)
        assert (state.velocities[:, 2]).abs().max() < 1e-7
        assert (state.velocities - throw).abs().max() < 1e-7


def gap_on_a_ball(subdivisions):
    """Mean gap of the vertices in contact with a ball, over d_hat, and their number."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.2)
    body = ball.vertices, ball.faces
    sim = sheet_on(body, 20.0, height=0.2, friction=0.6, tolerance=1e-5)
    state = sim.initial_state()
    for _ in range(60):
        state = sim.step(state)
    points = state.positions.numpy()
    distance = np.array(
        [
            np.linalg.norm(
                trimesh.triangles.closest_point(ball.triangles, [p] * len(ball.faces)) - p, axis=1
            ).min()
            for p in points
        ]
    )
    return distance[distance < D_HAT].mean() / D_HAT


def test_a_sheet_rests_at_one_gap_above_any_ball():
    gaps = [gap_on_a_ball(subdivisions) for subdivisions in (1, 2, 3)]
    assert max(gaps) - min(gaps) < 0.1
    assert max(gaps) < 0.95


@pytest.mark.slow
def test_a_sheet_rests_at_one_gap_above_fine_balls():
    gaps = [gap_on_a_ball(subdivisions) for subdivisions in (1, 4, 5)]
    assert max(gaps) - min(gaps) < 0.1


def slide(body, v_0=10.0, mu=0.5, h=0.01):
    """Stopping distance of a small sheet thrown along a floor, and its derivatives."""
    vertices, faces = strip(2, 3, 0.1, 0.1)
    cloth = dc.Cloth(
        posed(vertices, 0.3, [-5.2, 0.02, 2e-3]),
        faces,
        material=dc.Material(stretch=500.0, bending=1e-3, damping=1e-2, friction=mu),
    )
    sim = dc.Simulator(
        dc.Scene([cloth], [dc.RigidBody(*body, friction=mu)]),
        h,
        solver=dc.SolverOptions(tolerance=1e-8),
    )
    state = settle(sim, sim.initial_state(), steps=200, speed=1e-6)
    start = state.positions[:, 0].mean().item()
    speed = torch.tensor(v_0, dtype=F64, requires_grad=True)
    friction = torch.tensor(mu, dtype=F64, requires_grad=True)
    parameters = sim.default_parameters().replace(friction=friction)
    throw = speed * tensor([1.0, 0.0, 0.0]).expand_as(state.velocities)
    state = state.replace(velocities=throw)
    for _ in range(round(v_0 / (mu * G) / h) + 5):
        state = sim.step(state, None, parameters)
    assert state.velocities.detach().abs().max() < 1e-3
    distance = state.positions[:, 0].mean() - start
    return distance.item(), *(g.item() for g in torch.autograd.grad(distance, (speed, friction)))


def test_stopping_on_any_floor_is_stopping_on_one_triangle():
    """Across the diagonal of two triangles, and across the edges of many."""
    one = np.array([[-40.0, -40, 0], [60, -40, 0], [0, 90, 0]]), np.array([[0, 1, 2]])
    expected = slide(one)
    # d = v0^2 / (2 mu g) - v0 h / 2, and the derivatives of implicit Euler's sum.
    assert expected[0] == pytest.approx(100 / G - 0.05, rel=1e-3)
    assert expected[1] == pytest.approx(20 / G, rel=0.01)
    assert expected[2] == pytest.approx(-200 / G, rel=0.01)
    for columns, rows, sliver in ((1, 1, 0.0), (12, 3, 0.0), (40, 40, 0.0), (12, 3, 1e-5)):
        found = slide(floor_of(columns, rows, 40.0, 9.0, sliver=sliver))
        assert found == pytest.approx(expected, rel=1e-6)


def test_a_moving_floor_drags_alike():
    """Conveyors of many triangles and of two triangles accelerate a sheet equally."""
    speeds = []
    for columns in (1, 30):
        vertices, faces = strip(2, 3, 0.1, 0.1)
        cloth = dc.Cloth(
            posed(vertices, 0.3, [0.03, 0.02, 2e-3]), faces, material=dc.Material(friction=0.5)
        )
        belt = dc.RigidBody(*floor_of(columns, columns, 2.0, 2.0), friction=0.5, motion="kinematic")
        sim = dc.Simulator(dc.Scene([cloth], [belt]), 0.01, solver=dc.SolverOptions(tolerance=1e-8))
        state = settle(sim, sim.initial_state(), steps=200, speed=1e-7)
        pose = state.body_poses.clone()
        for _ in range(5):
            pose = pose + tensor([4e-3, 2e-3, 0, 0, 0, 0, 0])
            state = sim.step(state, dc.Control(body_poses=pose))
        speeds.append(state.velocities)
    assert speeds[0][:, 0].mean() == pytest.approx(5 * 0.5 * G * 0.01 * 2 / 5**0.5, rel=0.01)
    torch.testing.assert_close(speeds[1], speeds[0], rtol=1e-6, atol=1e-9)
