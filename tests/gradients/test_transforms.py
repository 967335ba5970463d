"""Transforms of torch.func, entered at any call, agree with backward."""

from __future__ import annotations

import pytest
import torch
from torch.autograd import forward_ad

import diffcloth_torch as dc

F64 = torch.float64


@pytest.fixture(scope="module")
def sim():
    cloth = dc.Cloth.grid(3, 4, 0.3, pins={"edge": [0, 3]}, soft_pins={"tip": [11]})
    ball = dc.RigidBody.sphere(
        0.1, subdivisions=1, motion="dynamic", mass=1.0, pose=[0, 0, -1, 1, 0, 0, 0], name="ball"
    )
    hand = dc.Robot.load(dc.robots.GRIPPER, pose=[2, 0, 0, 1, 0, 0, 0], actuation="position")
    return dc.Simulator(dc.Scene([cloth], [ball], [hand]), 0.01)


def controlled(sim, x, **control):
    return sim.step(sim.initial_state(), sim.control(**control)).positions.sum() + 0 * x.sum()


CALLS = {
    "control": lambda sim, x: controlled(sim, x, pins={"edge": x}),
    "control of soft pins": lambda sim, x: controlled(sim, x, soft_pins={"tip": x[:1]}),
    "control, rows": lambda sim, x: controlled(sim, x, forces=x.sum().expand(12, 3)),
    "rollout": lambda sim, x: sim.rollout(sim.initial_state(), [dc.Control(pins=x)])[
        -1
    ].positions.sum(),
    "parameters of a rollout": lambda sim, x: sim.rollout(
        sim.initial_state(), parameters=sim.default_parameters().replace(gravity=x[0]), steps=1
    )[-1].positions.sum(),
    "momentum": lambda sim, x: sim.momentum(moving(sim, x)).sum(),
    "kinetic_energy": lambda sim, x: sim.kinetic_energy(moving(sim, x)).sum(),
    "link_poses": lambda sim, x: sum(t.sum() for t in sim.link_poses(moving(sim, x)).values()),
    "contact_wrenches": lambda sim, x: sim.contact_wrenches(moving(sim, x))["ball"].sum(),
    "vertex_masses": lambda sim, x: sim.vertex_masses(
        sim.default_parameters().replace(density=x.sum() + 1)
    ).sum(),
}


def moving(sim, x):
    state = sim.initial_state()
    away = torch.zeros_like(state.body_poses)
    away[:, :3] = 1e-3
    return state.replace(
        velocities=state.velocities + x.sum(),
        body_poses=state.body_poses + away * x.sum(),
        joint_positions=state.joint_positions + 1e-3 * x.sum(),
        body_forces=torch.ones_like(state.body_forces),
    )


def start(sim, name):
    """Point of differentiation: pins at their places, zero for all other inputs."""
    places = sim.initial_state().positions[[0, 3]] if "pins" in name or name == "rollout" else 0.0
    if name == "control":
        places = sim.initial_state().positions[[0, 3]]
    return torch.zeros(2, 3, dtype=F64) + places


def expected(sim, name):
    x = start(sim, name).requires_grad_()
    (gradient,) = torch.autograd.grad(CALLS[name](sim, x), x, allow_unused=True)
    return torch.zeros_like(x) if gradient is None else gradient


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.jacrev, torch.func.jacfwd])
def test_transforms_find_the_gradient(sim, name, transform):
    gradient = expected(sim, name)
    found = transform(lambda x: CALLS[name](sim, x))(start(sim, name))
    # Friction that sticks is stiff: solves for tangents and for gradients agree to some 1e-10.
    torch.testing.assert_close(found, gradient, rtol=1e-9, atol=1e-9 * gradient.abs().max())


@pytest.mark.parametrize("name", CALLS)
def test_tangents_of_dual_numbers(sim, name):
    x, v = start(sim, name), torch.linspace(-1, 1, 6, dtype=F64).reshape(2, 3)
    with forward_ad.dual_level():
        value = CALLS[name](sim, forward_ad.make_dual(x, v))
        tangent = forward_ad.unpack_dual(value).tangent
    product = (expected(sim, name) * v).sum()
    torch.testing.assert_close(tangent, product, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("name", CALLS)
def test_different_numbers_in_one_call_are_refused(sim, name):
    x = start(sim, name) + torch.arange(5, dtype=F64)[:, None, None] * 1e-9
    with pytest.raises(NotImplementedError, match=r"torch.vmap over states, .* not supported"):
        torch.vmap(lambda x: CALLS[name](sim, x))(x)


@pytest.mark.parametrize(
    "second",
    [
        lambda f: torch.func.jacfwd(torch.func.grad(f)),
        lambda f: torch.func.grad(lambda x: torch.func.grad(f)(x).sum()),
        lambda f: torch.func.grad(lambda x: torch.func.jacfwd(f)(x).sum()),
        lambda f: torch.func.jacfwd(torch.func.jacfwd(f)),
    ],
    ids=["forward over reverse", "reverse twice", "reverse over forward", "forward twice"],
)
def test_second_derivatives_are_refused(sim, second):
    def f(x):
        return controlled(sim, x, pins={"edge": x})

    with pytest.raises(RuntimeError, match=r"second derivatives of \w+ are not available"):
        second(f)(start(sim, "control"))


@pytest.mark.parametrize("mode", ["forward-mode", "reverse-mode"])
def test_the_older_jacobians(sim, mode):
    def f(x):
        return controlled(sim, x, pins={"edge": x}).reshape(1)

    found = torch.autograd.functional.jacobian(
        f, start(sim, "control"), vectorize=True, strategy=mode
    )
    torch.testing.assert_close(found[0], expected(sim, "control"), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", ["control of soft pins", "momentum", "vertex_masses"])
def test_ordinary_gradients_go_through_the_same_calls(sim, name):
    x = torch.zeros(2, 3, dtype=F64, requires_grad=True)
    value = CALLS[name](sim, x + sim.initial_state().positions[:2] if "pins" in name else x)
    (gradient,) = torch.autograd.grad(value, x)
    assert gradient.abs().max() > 0
