"""Ends of a step: the limit on iterations, the tolerance, and a blocked motion."""

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

F64 = torch.float64


def pushed(**solver):
    """A box that is pushed and turned far into a hanging sheet within one step, in portions."""
    n = 8
    sheet = dc.Cloth.grid(n, n, size=0.4)
    vertices = np.array(sheet.vertices)
    vertices[:, :2] += np.random.default_rng(0).uniform(-0.005, 0.005, (n * n, 2))
    upright = vertices[:, [0, 2, 1]]
    cloth = dc.Cloth(
        upright, sheet.faces, rest_positions=vertices, pins={"edge": range(n * n - n, n * n)}
    )
    box = dc.RigidBody.box(0.15, motion="kinematic", pose=[0.01, -0.085, 0.02, 1, 0, 0, 0])
    sim = dc.Simulator(dc.Scene([cloth], [box]), 0.01, solver=dc.SolverOptions(**solver))
    state = sim.initial_state()
    poses = state.body_poses.clone()
    poses[0, 1] += 0.12
    poses[0, 3:] = torch.tensor([np.cos(0.3), 0.0, 0.0, np.sin(0.3)], dtype=F64)
    return sim, state, dc.Control(body_poses=poses)


@pytest.mark.parametrize("scheme", ["coupled", "split"])
@pytest.mark.parametrize("limit", [1, 2, 5, 12, 25, 200])
def test_the_limit_on_iterations_holds_for_all_portions_and_solves(limit, scheme):
    sim, state, control = pushed(max_iterations=limit)
    sim = dc.Simulator(sim.scene, sim.dt, scheme=scheme, solver=sim.solver)
    try:
        report = sim.step(state, control).report
    except dc.InfeasibleMotion as error:
        report = error.report
        assert report.motion_fraction < 1
    except dc.NotConverged as error:
        report = error.report
        assert sim.solver.tolerance < report.residual < np.inf
    else:
        assert report.converged
        assert limit > 2  # the motion alone has four portions
    assert 1 <= report.iterations <= limit


@pytest.mark.parametrize("limit", [1, 2, 5, 12, 25])
def test_a_step_that_is_cut_short_has_a_residual_above_the_tolerance(limit):
    sim, state, _ = pushed(max_iterations=limit, throw=False)
    velocities = torch.from_numpy(np.random.default_rng(1).normal(size=state.positions.shape))
    report = sim.step(state.replace(velocities=velocities)).report
    if not report.converged:
        assert sim.solver.tolerance < report.residual < np.inf
    assert report.converged or limit < 25


def test_a_blocked_motion_lets_the_cloth_give_way_before_it_goes_on():
    # With gaps closed by a blocked motion, each further step would advance by nearly nothing.
    sim, state, control = pushed()
    path = sim.path(state, control).numpy()
    cloth, body = path[:, :64], path[:, 64:]
    arrived = np.abs(body - body[-1]).max(axis=(1, 2)) == 0
    stands = np.abs(np.diff(body, axis=0)).max(axis=(1, 2)) == 0
    moves = np.abs(np.diff(cloth, axis=0)).max(axis=(1, 2)) > 0
    assert (stands & moves & ~arrived[:-1]).any()


@pytest.mark.parametrize("tolerance", [1e-9, 1e-7, 1e-5, 1e-3])
def test_a_looser_tolerance_converges_where_a_tighter_one_does(tolerance):
    sim, state, control = pushed(tolerance=tolerance)
    for _ in range(3):
        state = sim.step(state, control)
        assert state.report.converged
        assert state.report.residual <= tolerance


def test_a_sheet_that_whips_converges_by_default():
    """Single steps of this sheet need more than 200 iterations, the limit of earlier versions."""
    n, h = 12, 1 / 60
    grid = dc.Cloth.grid(n, n, size=0.5)
    vertices = np.array(grid.vertices)
    vertices[:, :2] += np.random.default_rng(1).uniform(-0.004, 0.004, (n * n, 2))
    pins = list(range(n))
    material = dc.Material(stretch=5000.0)
    cloth = dc.Cloth(vertices, grid.faces, pins={"edge": pins}, material=material)
    sim = dc.Simulator(dc.Scene([cloth]), h)
    state = sim.initial_state()
    with torch.no_grad():
        for k in range(60):
            held = torch.tensor(vertices[pins])
            held[:, 2] += 0.4 * np.sin(10 * np.pi * (k + 1) * h)
            state = sim.step(state, dc.Control(pins=held))
            assert state.report.converged


def test_a_body_stays_where_its_motion_has_ended():
    sim, state, control = pushed(max_iterations=2, throw=False)
    after = sim.step(state, control)
    fraction = after.report.motion_fraction
    assert 0.2 < fraction < 1
    turn = 0.3 * fraction
    pose = state.body_poses[0].clone()
    pose[1] += 0.12 * fraction
    pose[3:] = torch.tensor([np.cos(turn), 0.0, 0.0, np.sin(turn)], dtype=F64)
    torch.testing.assert_close(after.body_poses[0], pose, rtol=0, atol=1e-12)
