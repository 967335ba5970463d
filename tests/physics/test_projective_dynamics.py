"""Projective Dynamics as the elastic solver of `split`: Newton's positions and gradients."""

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

F64 = torch.float64
DT = 0.01
TOLERANCE = 1e-9  # m/s


def sheet(n=8, size=0.5, height=0.0, material=None, *, curved=False, pins=None, **options):
    flat = dc.Cloth.grid(n, n, (size, size), pose=[0, 0, height, 1, 0, 0, 0])
    vertices = np.array(flat.vertices)
    if curved:
        vertices[:, 2] += 0.1 * np.sin(4 * vertices[:, 0])
    return dc.Cloth(
        vertices,
        flat.faces,
        material=material or dc.Material(),
        pins={"corners": [0, n - 1]} if pins is None else pins,
        **options,
    )


SCENES = {
    "patch": lambda: [sheet()],
    "hinge": lambda: [sheet(bending_model="hinge", material=dc.Material(bending=1e-4))],
    "curved": lambda: [sheet(curved=True, material=dc.Material(bending=1e-4))],
    "damped": lambda: [sheet(material=dc.Material(damping=1e-2, bending=1e-4))],
    "stiff": lambda: [sheet(material=dc.Material(stretch=1e4))],
    "soft pins": lambda: [sheet(pins={}, soft_pins={"a": [0, 7]})],
    "free": lambda: [sheet(pins={})],
    "two": lambda: [
        sheet(5, material=dc.Material(density=0.3)),
        sheet(6, height=0.3, material=dc.Material(stretch=2e3, damping=1e-3), curved=True, pins={}),
    ],
}


def simulator(cloths, elastic, bodies=(), **solver):
    options = {"tolerance": TOLERANCE, "elastic": elastic, **solver}
    scene = dc.Scene(cloths, bodies, gravity=(0.4, -0.3, -9.81))
    return dc.Simulator(scene, DT, scheme="split", solver=dc.SolverOptions(**options))


def shaken(sim):
    """A state with velocities that stretch and bend, and a control that moves the pins."""
    g = torch.Generator().manual_seed(0)
    state = sim.initial_state()
    noise = torch.randn(state.velocities.shape, generator=g, dtype=F64)
    held = {}
    if pins := [
        sim.slices[name].start + i
        for name, cloth in zip(sim.scene.cloth_names, sim.scene.cloths, strict=True)
        for group in cloth.pins.values()
        for i in group
    ]:
        held["pins"] = state.positions[pins] + 0.002
    if len(state.soft_pin_targets):
        held["soft_pins"] = state.soft_pin_targets + 0.002
    return state.replace(velocities=0.1 * noise), sim.control(**held)


@pytest.mark.parametrize("name", SCENES)
def test_projective_dynamics_finds_the_positions_of_newton(name):
    """Over three steps, each from the same state for both."""
    newton, projective = (
        simulator(SCENES[name](), elastic) for elastic in ("newton", "projective")
    )
    state, control = shaken(newton)
    for _ in range(3):
        found = projective.step(state, control)
        state = newton.step(state, control)
        assert found.report.counts["local_global"] > 10
        assert found.report.residual < TOLERANCE
        assert (found.positions - state.positions).abs().max() < 1e-10


def test_projective_dynamics_has_the_contact_and_the_gradient_of_newton():
    """A sheet that slides on a box: both stages, and their adjoint."""
    results = []
    for elastic in ("newton", "projective"):
        box = dc.RigidBody.box(0.6, pose=[0, 0, -0.306, 1, 0, 0, 0])
        cloths = [sheet(6, 0.3, pins={}, material=dc.Material(damping=1e-3))]
        sim = simulator(cloths, elastic, [box], tolerance=1e-10)
        state = sim.initial_state()
        velocities = torch.zeros_like(state.velocities)
        velocities[:, 0], velocities[:, 2] = 0.5, -0.5
        x, v = state.positions.clone().requires_grad_(), velocities.requires_grad_()
        stretch = sim.default_parameters().stretch.clone().requires_grad_()
        density = sim.default_parameters().density.clone().requires_grad_()
        parameters = sim.default_parameters().replace(stretch=stretch, density=density)
        after = state.replace(positions=x, velocities=v)
        for _ in range(3):
            after = sim.step(after, parameters=parameters)
        assert after.report.contact_count > 20
        weights = torch.linspace(-1, 1, after.positions.numel(), dtype=F64).view_as(after.positions)
        (weights * after.positions).sum().backward()
        results.append((after.positions.detach(), x.grad, v.grad, stretch.grad, density.grad))
    for newton, projective in zip(*results, strict=True):
        torch.testing.assert_close(projective, newton, rtol=1e-6, atol=1e-9)


def test_parameters_and_history_leave_no_trace():
    """Equal bits alone, in a batch, and after steps with other parameters and matrices."""
    sim = simulator(SCENES["patch"](), "projective")
    state, control = shaken(sim)
    once = sim.step(state, control).positions
    stiffer = sim.default_parameters().replace(stretch=sim.default_parameters().stretch * 2)
    assert not torch.equal(sim.step(state, control, stiffer).positions, once)
    batch = sim.step(dc.stack([state] * 3), dc.Control(pins=control.pins.expand(3, -1, -1)))
    assert torch.equal(sim.step(state, control).positions, once)
    for positions in batch.positions:
        assert torch.equal(positions, once)


def test_iterations_of_projective_dynamics_are_bounded():
    sim = simulator(SCENES["stiff"](), "projective", max_iterations=1, metric="elastic")
    state, control = shaken(sim)
    with pytest.raises(dc.NotConverged, match=r"iterations of the step .* are used up") as e:
        sim.step(state, control)
    report = e.value.report
    assert report.counts["local_global"] == 50
    assert report.counts["left_to_newton"] == report.iterations == 1


@pytest.mark.parametrize("metric", ["elastic", None])
def test_newtons_method_solves_steps_beyond_the_iterations(metric):
    """Newton also takes over without nodal contact; the iteration limit once ended such steps."""
    solver = {"max_iterations": 30}
    sim = simulator(SCENES["stiff"](), "projective", **solver)
    state, control = shaken(sim)
    after = sim.step(state, control)
    assert after.report.counts["local_global"] == 30 * 50
    assert after.report.counts["left_to_newton"] == 1
    assert after.report.residual <= sim.solver.tolerance


@pytest.mark.parametrize("force", [1e8, 1e30])
def test_forces_beyond_the_resolution_of_float64_are_reported(force):
    sim = simulator(SCENES["free"](), "projective", max_iterations=20)
    forces = torch.zeros_like(sim.initial_state().positions)
    forces[0] = force
    with pytest.raises(dc.NotConverged) as e:
        sim.step(sim.initial_state(), sim.control(forces=forces))
    assert e.value.report.residual > TOLERANCE


def test_a_saddle_stops_projective_dynamics_and_has_no_gradient():
    """The iterations ignore curvature: a planar sheet stays planar, and backward reports it."""
    stiff = dc.Material(stretch=1e4)
    upright = dc.Cloth.grid(
        10,
        10,
        (1.0, 1.0),
        pose=[0, 0, 0, 0.5**0.5, 0.5**0.5, 0, 0],
        material=stiff,
        pins={"a": [0, 9]},
    )
    scene = dc.Scene([upright])
    # The contact stage of the other metrics, here without contact, keeps the saddle.
    solver = dc.SolverOptions(elastic="projective", metric="elastic")
    sim = dc.Simulator(scene, 0.05, scheme="split", solver=solver)
    state = sim.initial_state()
    x = state.positions.clone().requires_grad_()
    after = sim.step(state.replace(positions=x))
    assert after.positions[:, 1].abs().max() < 1e-6
    with pytest.raises(dc.SimulationError, match="not positive definite"):
        after.positions.sum().backward()
