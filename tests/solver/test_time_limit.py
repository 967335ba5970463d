"""The time limit of a step: a status like others; steps that end in time have equal bits."""

import time

import numpy as np
import pytest
import torch
from test_limits import pushed

import diffcloth_torch as dc

F64 = torch.float64
NO_TIME = 1e-9  # [s] over before the first iteration


def falling(n=5, schemes=None, **solver):
    """A sheet that falls onto a box and overhangs its edges."""
    sheet = dc.Cloth.grid(n, n, 0.2, pose=[0, 0, 0.06, 1, 0.03, 0, 0])
    box = dc.RigidBody.box(0.1)
    options = schemes or {}
    sim = dc.Simulator(
        dc.Scene([sheet], [box]), 0.01, solver=dc.SolverOptions(throw=False, **solver), **options
    )
    state = sim.initial_state()
    down = torch.tensor([0.0, 0.0, -1.0], dtype=F64).expand_as(state.positions)
    return sim, state.replace(velocities=down.clone())


def torn(n, speed, bodies=(), **solver):
    """Three sheets whose vertices fly apart at random."""
    cloths = [
        dc.Cloth.grid(n, n, 0.3, pose=[0, 0, 0.1 * (k + 1), 1, 0, 0, 0], name=f"sheet {k}")
        for k in range(3)
    ]
    sim = dc.Simulator(dc.Scene(cloths, list(bodies)), 0.01, solver=dc.SolverOptions(**solver))
    state = sim.initial_state()
    noise = torch.from_numpy(np.random.default_rng(n).normal(size=state.positions.shape))
    return sim, state.replace(velocities=speed * noise)


SCHEMES = {
    "coupled": {},
    "split": {"scheme": "split"},
    "split, local/global": {"scheme": "split", "elastic": "projective"},
    "projective": {"scheme": "projective"},
    "projective, local/global": {"scheme": "projective", "elastic": "projective"},
}


@pytest.mark.parametrize("name", SCHEMES)
def test_a_step_without_time_fails_as_a_value_in_each_scheme(name):
    options = dict(SCHEMES[name])
    solver = {"elastic": options.pop("elastic", "newton")}
    sim, state = falling(schemes=options, max_seconds=NO_TIME, **solver)
    after = sim.step(state)
    assert after.report.status == "not_converged"
    assert after.report.residual > sim.solver.tolerance
    assert after.positions.isfinite().all()
    throwing = dc.Simulator(
        sim.scene, sim.dt, **options, solver=dc.SolverOptions(max_seconds=NO_TIME, **solver)
    )
    with pytest.raises(dc.NotConverged, match=r"`max_seconds`.*used up"):
        throwing.step(state)


@pytest.mark.parametrize("name", SCHEMES)
def test_a_step_that_ends_in_time_has_the_bits_of_one_without_a_limit(name):
    options = dict(SCHEMES[name])
    solver = {"elastic": options.pop("elastic", "newton")}
    ends = []
    for seconds in (None, 1e4):
        sim, state = falling(schemes=options, max_seconds=seconds, **solver)
        for _ in range(4):
            state = sim.step(state)
            assert state.report.converged
        ends.append(state)
    assert torch.equal(ends[0].positions, ends[1].positions)
    assert torch.equal(ends[0].velocities, ends[1].velocities)


def test_a_motion_without_time_ends_where_everything_prescribed_has_its_place():
    sim, state, control = pushed(max_seconds=NO_TIME)
    with pytest.raises(dc.InfeasibleMotion, match=r"`max_seconds`.*used up") as caught:
        sim.step(state, control)
    assert caught.value.report.motion_fraction == 0
    silent = dc.Simulator(
        sim.scene, sim.dt, solver=dc.SolverOptions(max_seconds=NO_TIME, throw=False)
    )
    after = silent.step(state, control)
    assert after.report.status == "infeasible_motion"
    assert torch.equal(after.body_poses, state.body_poses)
    assert torch.equal(after.positions, state.positions)


@pytest.mark.parametrize("seconds", [0.002, 0.005, 0.01, 0.02, 0.05])
def test_a_motion_that_is_cut_short_anywhere_ends_at_a_fraction_of_it(seconds):
    """The point of interruption depends on the machine; these properties hold at any point."""
    sim, state, control = pushed(max_seconds=seconds, throw=False)
    after = sim.step(state, control)
    fraction = after.report.motion_fraction
    assert after.report.converged or after.report.residual > sim.solver.tolerance or fraction < 1
    turn = 0.3 * fraction
    pose = state.body_poses[0].clone()
    pose[1] += 0.12 * fraction
    pose[3:] = torch.tensor([np.cos(turn), 0.0, 0.0, np.sin(turn)], dtype=F64)
    torch.testing.assert_close(after.body_poses[0], pose, rtol=0, atol=1e-12)
    # The start of another step refuses overlaps.
    again = dc.Simulator(sim.scene, sim.dt, solver=dc.SolverOptions(throw=False))
    assert again.step(after).report.converged


def test_an_environment_whose_time_is_up_changes_no_bit_of_the_others():
    limit = 2.0  # a calm step takes some milliseconds
    sim, state = torn(7, 1.0, max_seconds=limit, throw=False, max_iterations=10**6)
    batch = sim.initial_state(3)
    scale = torch.tensor([0.0, 1e6, 0.3], dtype=F64)[:, None, None]
    batch = batch.replace(velocities=scale * state.velocities)
    after = sim.step(batch)
    assert after.report.status == ("converged", "not_converged", "converged")
    free, _ = torn(7, 1.0)
    for e in (0, 2):
        alone = free.step(free.initial_state().replace(velocities=batch.velocities[e]))
        assert torch.equal(after.positions[e], alone.positions)
    assert after.report.residual[1] > sim.solver.tolerance
    few, _ = torn(7, 1.0, max_seconds=NO_TIME, throw=False)
    start = batch.velocities.clone().requires_grad_()
    loss = few.step(batch.replace(velocities=start)).positions.sum()
    with pytest.raises(dc.NotConverged, match=r"environments \[1, 2\]"):
        loss.backward()


def swarm(count, speed, **solver):
    """Small sheets in a cube; each flies in its own direction through all others."""
    places = np.stack(np.meshgrid(*[np.arange(count)] * 3), axis=-1).reshape(-1, 3)
    cloths = [dc.Cloth.grid(2, 2, 0.05, pose=[*(0.1 * p), 1, 0, 0, 0]) for p in places]
    sim = dc.Simulator(dc.Scene(cloths), 0.01, solver=dc.SolverOptions(throw=False, **solver))
    state = sim.initial_state()
    noise = np.random.default_rng(count).normal(size=(len(cloths), 1, 3)).repeat(4, axis=1)
    return sim, state.replace(velocities=speed * torch.from_numpy(noise.reshape(-1, 3)))


def test_time_is_checked_within_collision_detection():
    """One search and one check of all pairs need seconds; the end checks only near pairs."""
    spent = []
    for limit in (None, 0.1):
        sim, state = swarm(9, 1e4, max_seconds=limit, max_iterations=3)
        begin = time.process_time()
        report = sim.step(state).report
        spent.append(time.process_time() - begin)
        assert report.status == "not_converged"
    assert spent[1] < 0.5 * spent[0]


def test_a_free_body_is_not_searched_along_torn_sheets():
    """An earlier version searched its contacts along the motion of all surfaces: .5 s."""
    ball = dc.RigidBody.sphere(0.05, motion="dynamic", mass=0.1, pose=[0, 0, 0.9, 1, 0, 0, 0])
    sim, state = torn(12, 1e5, [ball], throw=False, max_iterations=2)
    calm = sim.step(state.replace(velocities=1e-5 * state.velocities)).report
    assert sim.step(state).report.cpu_seconds < 20 * calm.cpu_seconds


def test_a_torn_sheet_is_followed_in_parts():
    """An earlier version checked in each iteration all pairs along the full step."""
    sim, state = torn(16, 5e3, throw=False, max_iterations=10)
    report = sim.step(state).report
    assert report.iterations == 10
    calm = sim.step(state.replace(velocities=1e-3 * state.velocities)).report
    per_iteration = report.cpu_seconds / report.iterations
    # An iteration once needed .3 s, 60 times the iteration of a calm step.
    assert per_iteration < 15 * calm.cpu_seconds / calm.iterations


@pytest.mark.parametrize("coupling", ["rigid_to_cloth", "cloth_to_rigid"])
def test_solves_of_a_staggered_coupling_have_the_limit(coupling):
    sheet = dc.Cloth.grid(6, 6, 0.2, pins={"edge": range(6)})
    ball = dc.RigidBody.sphere(0.03, motion="dynamic", mass=0.01, pose=[0, 0, 0.04, 1, 0, 0, 0])
    scene = dc.Scene([sheet], [ball])
    sim = dc.Simulator(
        scene, 0.01, coupling=coupling, solver=dc.SolverOptions(max_seconds=NO_TIME, throw=False)
    )
    after = sim.step(sim.initial_state())
    assert after.report.status in ("not_converged", "infeasible_motion")
    generous = dc.Simulator(
        scene, 0.01, coupling=coupling, solver=dc.SolverOptions(max_seconds=1e4)
    )
    plain = dc.Simulator(scene, 0.01, coupling=coupling)
    ends = [s.step(s.initial_state()).positions for s in (generous, plain)]
    assert torch.equal(*ends)


@pytest.mark.parametrize("seconds", [0.0, -1.0, np.nan, np.inf])
def test_a_limit_that_is_none_is_refused(seconds):
    with pytest.raises(dc.InvalidInput, match="SolverOptions: `max_seconds`"):
        dc.SolverOptions(max_seconds=seconds)


def test_the_search_for_an_equilibrium_has_the_limit():
    sheet = dc.Cloth.grid(5, 5, 0.2, pins={"edge": range(5)})
    sim = dc.Simulator(dc.Scene([sheet]), 0.01, solver=dc.SolverOptions(max_seconds=NO_TIME))
    with pytest.raises(dc.NotConverged, match="`max_seconds`"):
        sim.equilibrium(sim.initial_state())
