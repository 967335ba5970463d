"""Batches with failed environments: the others keep the bits of their states and gradients."""

import numpy as np
import pytest
import scenes
import torch

import diffcloth_torch as dc

F64 = torch.float64
FAILED = 1  # of three environments


def falling(**solver):
    """A sheet above a floor; one environment lands at once and has too few iterations."""
    vertices, faces = scenes.grid(5, 5)
    cloth = dc.Cloth(vertices + np.array([0.0, 0.0, 0.02]), faces)
    floor = dc.RigidBody.plane(2.0, motion="kinematic")
    return dc.Simulator(
        dc.Scene([cloth], [floor]),
        scenes.DT,
        contact=dc.ContactOptions(barrier_distance=0.01),
        solver=dc.SolverOptions(**{"throw": False, "max_iterations": 2, **solver}),
    )


def velocities(sim):
    v = torch.zeros(3, 25, 3, dtype=F64)
    v[FAILED, :, 2] = -3.0
    v[FAILED] += scenes.tensor_noise((25, 3), 0.5)
    v[2, :, 0] = 0.3
    return v


def step(sim, state, v):
    """The step, and its leaves: one per environment, and one that all share."""
    x = state.positions.clone().requires_grad_()
    v = v.clone().requires_grad_()
    gravity = torch.tensor([0.1, 0.2, -9.81], dtype=F64, requires_grad=True)
    after = sim.step(
        state.replace(positions=x, velocities=v),
        None,
        sim.default_parameters().replace(gravity=gravity),
    )
    return after, (x, v, gravity)


@pytest.fixture(scope="module")
def batch():
    sim = falling()
    after, leaves = step(sim, sim.initial_state(3), velocities(sim))
    assert after.report.converged.tolist() == [True, False, True]
    assert after.report.status == ("converged", "not_converged", "converged")
    return sim, after, leaves


def loss_of(state):
    return (state.positions**2).sum() + 1e-2 * (state.velocities**2).sum()


def expected_alone(sim, i):
    state, v = sim.initial_state(), velocities(sim)[i]
    after, leaves = step(sim, state, v)
    return after, torch.autograd.grad(loss_of(after), leaves)


@pytest.mark.parametrize("how", ["where", "index", "weights"])
def test_the_healthy_environments_keep_the_bits_that_they_have_alone(batch, how):
    sim, after, leaves = batch
    kept = torch.tensor([True, False, True])
    if how == "where":
        loss = loss_of(dc.where(kept, after, sim.initial_state(3)))
        constant = torch.autograd.grad(loss_of(after[0]), leaves, retain_graph=True)
        assert not constant[0][FAILED].any()
    elif how == "index":
        loss = loss_of(after[0]) + loss_of(after[2])
    else:
        each = (after.positions**2).sum((1, 2)) + 1e-2 * (after.velocities**2).sum((1, 2))
        loss = (kept * each).sum()
    x_bar, v_bar, gravity_bar = torch.autograd.grad(loss, leaves, retain_graph=True)
    total = torch.zeros(3, dtype=F64)
    for i in (0, 2):
        alone, (x_alone, v_alone, gravity_alone) = expected_alone(sim, i)
        assert torch.equal(after.positions[i], alone.positions)
        assert torch.equal(x_bar[i], x_alone)
        assert torch.equal(v_bar[i], v_alone)
        total += gravity_alone
    assert torch.equal(gravity_bar, total)
    assert gravity_bar.all()
    assert not x_bar[FAILED].any()
    assert not v_bar[FAILED].any()


@pytest.mark.parametrize("output", ["positions", "velocities", "body_forces"])
def test_the_failed_environment_refuses_once_its_gradient_is_asked_for(batch, output):
    _, after, leaves = batch
    value = getattr(after, output)
    cotangent = torch.zeros_like(value)
    cotangent[FAILED, -1, -1] = 1e-300
    with pytest.raises(dc.NotConverged, match=r"environments \[1\]") as caught:
        torch.autograd.grad(value, leaves, cotangent, retain_graph=True)
    assert caught.value.environments == (FAILED,)


def test_a_nan_that_reaches_a_failed_environment_is_not_taken_for_nothing(batch):
    _, after, leaves = batch
    cotangent = torch.zeros_like(after.positions)
    cotangent[FAILED, 0, 0] = float("nan")
    with pytest.raises(dc.NotConverged):
        torch.autograd.grad(after.positions, leaves, cotangent, retain_graph=True)


def test_a_single_failed_step_has_a_zero_gradient_of_a_loss_without_it():
    sim = falling()
    after, leaves = step(sim, sim.initial_state(), velocities(sim)[FAILED])
    assert not after.report.converged
    gradients = torch.autograd.grad(loss_of(after) * 0.0, leaves, retain_graph=True)
    assert not any(gradient.any() for gradient in gradients)
    with pytest.raises(dc.NotConverged):
        torch.autograd.grad(loss_of(after), leaves)


def test_an_environment_outside_the_loss_is_not_solved_for():
    # A flat sheet, compressed in its plane, and one iteration: a solve would have to factor a
    # Hessian that is indefinite, and raise.
    cloth = dc.Cloth.grid(10, 10, material=dc.Material(1e4, 1e-5))
    sim = dc.Simulator(
        dc.Scene([cloth], gravity=(0, 0, 0)),
        0.05,
        contact=dc.ContactOptions(self_contact=False),
        solver=dc.SolverOptions(throw=False, max_iterations=1),
    )
    x = (0.9 * sim.initial_state(1).positions).requires_grad_()
    after = sim.step(sim.initial_state(1).replace(positions=x))
    assert not after.report.converged
    (gradient,) = torch.autograd.grad(after.positions, x, torch.zeros_like(x))
    assert not gradient.any()


def test_stiffnesses_that_float64_cannot_hold_fail_where_they_are():
    sim = falling(max_iterations=200)
    stretch = sim.default_parameters().stretch.expand(3).clone()
    stretch[FAILED] = 1e22
    v = 1e-3 * velocities(sim)
    state = sim.initial_state(3).replace(velocities=v)
    after = sim.step(state, None, sim.default_parameters().replace(stretch=stretch))
    assert after.report.status == ("converged", "not_converged", "converged")
    assert torch.isinf(after.report.residual[FAILED])  # there is no Newton step
    assert torch.equal(after.positions[0], sim.step(state[0]).positions)
    throwing = falling(max_iterations=200, throw=True)
    message = r"environments \[1\].*not even the projected Hessian has a factor"
    with pytest.raises(dc.NotConverged, match=message):
        throwing.step(state, None, throwing.default_parameters().replace(stretch=stretch))
