"""Solves that end without a certificate: the same result, fewer factors, exact gradients."""

from dataclasses import replace

import pytest
import scenes
import torch

import diffcloth_torch as dc

STEPS = 6
REGIMES = ["stacked", "sphere", "folded", "sticking", "sliding"]


def simulators(name, tolerance):
    """The case of a regime, and its simulator with each option of `certify`."""
    case = scenes.regime(name)
    sim = case.sim
    solver = replace(sim.solver, tolerance=tolerance)
    options = {"scheme": sim.scheme, "contact": sim.contact}
    made = {
        certify: dc.Simulator(sim.scene, sim.dt, solver=replace(solver, certify=certify), **options)
        for certify in ("always", "gradients")
    }
    return case, made


def control_of(case):
    return dc.Control(**case.control)


def rolled(sim, case, steps=STEPS):
    states = [sim.initial_state().replace(**fields_of(case.state))]
    for _ in range(steps):
        states.append(sim.step(states[-1], control_of(case)))
    return states[1:]


def fields_of(state):
    names = ("positions", "velocities", "body_poses", "soft_pin_targets")
    return {name: getattr(state, name) for name in names}


@pytest.mark.parametrize("name", REGIMES)
def test_uncertified_states_are_as_near_the_solution(name):
    tolerance = 1e-6
    case, sims = simulators(name, tolerance)
    _, exact = simulators(name, 1e-10)
    with torch.no_grad():
        start = sims["always"].initial_state().replace(**fields_of(case.state))
        ends = {key: sim.step(start, control_of(case)) for key, sim in sims.items()}
        reference = exact["always"].step(start, control_of(case)).positions
    distance = {k: (end.positions - reference).abs().max().item() for k, end in ends.items()}
    assert distance["gradients"] <= max(2 * distance["always"], tolerance * scenes.DT)
    assert ends["always"].report.certified
    assert ends["gradients"].report.converged
    factorizations = {k: end.report.counts["factorizations"] for k, end in ends.items()}
    assert factorizations["gradients"] <= factorizations["always"]


def test_some_solves_are_not_certified_and_the_report_has_it():
    counts = {"always": 0, "gradients": 0}
    for name in REGIMES:
        case, sims = simulators(name, 1e-6)
        with torch.no_grad():
            for certify, sim in sims.items():
                counts[certify] += sum(
                    not state.report.certified for state in rolled(sim, case, steps=2)
                )
    assert counts["always"] == 0
    assert counts["gradients"] > 0


@pytest.mark.parametrize("name", ["stacked", "sliding"])
def test_bits_do_not_depend_on_gradients(name):
    case, sims = simulators(name, 1e-5)
    sim = sims["gradients"]
    with torch.no_grad():
        plain = rolled(sim, case, steps=3)[-1]
    start = sim.initial_state().replace(**fields_of(case.state))
    start = start.replace(velocities=start.velocities.clone().requires_grad_())
    state = start
    for _ in range(3):
        state = sim.step(state, control_of(case))
    assert torch.equal(state.positions, plain.positions)
    assert torch.equal(state.velocities, plain.velocities)
    assert state.report.certified == plain.report.certified


def gradients_by(sim, case):
    start = sim.initial_state().replace(**fields_of(case.state))
    leaves = {
        "positions": start.positions.clone().requires_grad_(),
        "velocities": start.velocities.clone().requires_grad_(),
    }
    parameters = sim.default_parameters()
    friction = parameters.friction.clone().requires_grad_()
    state = sim.step(
        start.replace(**leaves), control_of(case), parameters.replace(friction=friction)
    )
    weights = scenes.tensor_noise(state.positions.shape, 1.0, 7)
    loss = (weights * state.positions).sum() + scenes.DT * (weights * state.velocities).sum()
    found = torch.autograd.grad(loss, [*leaves.values(), friction])
    return torch.cat([g.flatten() for g in found]), state.report


@pytest.mark.parametrize("name", REGIMES)
@pytest.mark.parametrize("tolerance", [1e-6, 1e-4])
def test_gradients_are_those_of_the_solution(name, tolerance):
    """Backward refines the forward solution: a looser tolerance changes only lagged friction."""
    case, sims = simulators(name, tolerance)
    _, exact = simulators(name, 1e-10)
    reference, _ = gradients_by(exact["always"], case)
    errors = {}
    for certify, sim in sims.items():
        found, report = gradients_by(sim, case)
        assert report.converged
        errors[certify] = ((found - reference).norm() / reference.norm()).item()
    assert errors["gradients"] <= max(2 * errors["always"], 1e-4)


def test_tangents_agree_with_backward():
    case, sims = simulators("sliding", 1e-4)
    sim = sims["gradients"]
    start = sim.initial_state().replace(**fields_of(case.state))
    direction = scenes.tensor_noise(start.velocities.shape, 1.0, 8)

    def end(velocities):
        return sim.step(start.replace(velocities=velocities), control_of(case)).positions

    _, tangent = torch.func.jvp(end, (start.velocities,), (direction,))
    velocities = start.velocities.clone().requires_grad_()
    weights = scenes.tensor_noise(tangent.shape, 1.0, 9)
    (gradient,) = torch.autograd.grad((weights * end(velocities)).sum(), velocities)
    torch.testing.assert_close((weights * tangent).sum(), (gradient * direction).sum())


def test_a_batch_has_a_flag_for_each_environment():
    case, sims = simulators("sliding", 1e-4)
    sim = sims["gradients"]
    start = sim.initial_state().replace(**fields_of(case.state))
    with torch.no_grad():
        report = sim.step(dc.stack([start, start]), control_of(case)).report
        alone = sim.step(start, control_of(case)).report
    assert report.certified.tolist() == [alone.certified] * 2


def test_other_schemes_and_values_are_refused():
    scene = dc.Scene([dc.Cloth.grid(3, 3)])
    with pytest.raises(dc.InvalidInput, match=r"`solver.certify` 'gradients' needs scheme"):
        dc.Simulator(scene, 0.01, scheme="split", solver=dc.SolverOptions(certify="gradients"))
    with pytest.raises(dc.InvalidInput, match=r"SolverOptions: `certify`"):
        dc.SolverOptions(certify="never")


def test_an_equilibrium_is_certified():
    sim = dc.Simulator(
        dc.Scene([dc.Cloth.grid(4, 4, pins={"edge": range(4)})]),
        0.01,
        solver=dc.SolverOptions(certify="gradients"),
    )
    assert sim.equilibrium(sim.initial_state()).report.certified
