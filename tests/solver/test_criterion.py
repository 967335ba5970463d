"""`report.criterion`: the criterion that ended the solve of a step."""

import pickle

import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch import _core
from diffcloth_torch.sim.records.report import Report

CONVERGED = ("tolerance", "rounding")


def sheet():
    return dc.Cloth.grid(4, 4, size=0.3, pins={"edge": range(4)}, pose=[0, 0, 0.02, 1, 0, 0, 0])


def simulator(scheme="coupled", elastic="newton", **options):
    solver = dc.SolverOptions(throw=False, elastic=elastic, **options)
    scene = dc.Scene([sheet()], [dc.RigidBody.plane(2.0)])
    return dc.Simulator(scene, dt=0.01, scheme=scheme, solver=solver)


def pushed_batch():
    """Three environments: the second's pins move through the plane, the third is torn apart.

    The second is blocked after 40 iterations; the third does not converge in 500 either.
    """
    sim = simulator(max_iterations=60)
    start = sim.initial_state(batch_size=3)
    velocities = start.velocities.clone()
    noise = torch.randn(12, 3, generator=torch.Generator().manual_seed(0))
    velocities[2, 4:] = 1e6 * noise.double()
    pins = start.positions[:, :4].clone()
    pins[1, :, 2] -= 0.2
    return sim, start.replace(velocities=velocities), dc.Control(pins=pins)


@pytest.mark.parametrize("scheme", ["coupled", "split", "projective"])
@pytest.mark.parametrize("elastic", ["newton", "projective"])
def test_a_step_that_converges_ends_by_its_tolerance(scheme, elastic):
    sim = simulator(scheme, "newton" if scheme == "coupled" else elastic)
    report = sim.step(sim.initial_state()).report
    assert report.converged
    assert report.criterion in CONVERGED


@pytest.mark.parametrize(
    ("options", "criterion"),
    [
        pytest.param({"max_iterations": 1}, "iteration_limit", id="iterations"),
        pytest.param({"max_seconds": 1e-9}, "time_limit", id="time"),
    ],
)
@pytest.mark.parametrize("scheme", ["coupled", "split", "projective"])
def test_a_limit_of_a_step_is_its_criterion(scheme, options, criterion):
    sim = simulator(scheme, **options)
    start = sim.initial_state()
    noise = torch.randn(start.velocities.shape, generator=torch.Generator().manual_seed(0)).double()
    noise[:4] = 0.0
    report = sim.step(start.replace(velocities=50.0 * noise)).report
    assert report.status == "not_converged"
    assert report.criterion == criterion


def test_environments_of_a_batch_have_separate_criteria():
    sim, start, control = pushed_batch()
    report = sim.step(start, control).report
    assert report.status == ("converged", "infeasible_motion", "not_converged")
    assert report.criterion[0] in CONVERGED
    assert report.criterion[1:] == ("stuck_motion", "iteration_limit")
    assert "criterion={" in repr(report)


def test_a_start_that_intersects_is_not_solved():
    sim = simulator()
    low = sim.initial_state().positions - 0.02
    with pytest.raises(dc.IntersectingState) as caught:
        sim.step(sim.initial_state().replace(positions=low))
    assert caught.value.report.criterion == "no_solve"


def test_the_criterion_is_selected_stacked_chosen_and_saved(tmp_path):
    sim, start, control = pushed_batch()
    state = sim.step(start, control)
    report = state.report
    assert state[1].report.criterion == "stuck_motion"
    assert state[1:3].report.criterion == report.criterion[1:]
    assert state[[2, 0]].report.criterion == report.criterion[2::-2]
    assert dc.stack(list(state)).report.criterion == report.criterion
    mask = torch.tensor([True, False, True])
    chosen = dc.where(mask, state, state[0]).report
    assert chosen.criterion == (report.criterion[0], report.criterion[0], report.criterion[2])
    torch.save(state, tmp_path / "state.pt")
    loaded = torch.load(tmp_path / "state.pt", weights_only=True)
    assert loaded.report.criterion == report.criterion


@pytest.mark.parametrize("batch", [None, 2])
def test_reports_of_earlier_versions_have_none(batch):
    sim = simulator()
    report = sim.step(sim.initial_state(batch)).report
    old = {name: value for name, value in vars(report).items() if name != "criterion"}
    loaded = Report.__new__(Report)
    loaded.__setstate__(old)
    assert loaded.criterion == ("unknown" if batch is None else ("unknown",) * batch)
    assert pickle.loads(pickle.dumps(loaded)).criterion == loaded.criterion


@pytest.mark.parametrize("coupling", ["rigid_to_cloth", "cloth_to_rigid"])
def test_a_staggered_step_has_the_criterion_of_the_solve_that_failed(coupling):
    ball = dc.RigidBody.sphere(0.03, motion="dynamic", mass=0.01, pose=[0, 0, -0.5, 1, 0, 0, 0])
    scene = dc.Scene([sheet()], [ball])
    solver = dc.SolverOptions(throw=False, max_seconds=1e-9)
    sim = dc.Simulator(scene, 0.01, coupling=coupling, solver=solver)
    report = sim.step(sim.initial_state()).report
    assert report.status == "not_converged"
    assert report.criterion == "time_limit"


@pytest.mark.parametrize("criterion", [1, ("tolerance", 2)])
def test_other_values_are_refused(criterion):
    with pytest.raises(TypeError, match=r"`criterion` must be a str or a tuple of them"):
        dc.Report(True, 1, 0.5, 1.0, 2, 1.0, {}, criterion=criterion)


def test_the_docstring_names_every_criterion():
    for name in _core.criteria:
        assert f'"{name}"' in Report.__doc__, name
