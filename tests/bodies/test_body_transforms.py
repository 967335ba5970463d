"""Observables of a state have the same derivatives under `torch.func`."""

import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.robots import GRIPPER

NAMES = ("momentum", "kinetic_energy", "link_poses", "link_velocities", "contact_wrenches")


@pytest.fixture(scope="module")
def sim():
    hand = dc.Robot.load(GRIPPER, base="floating", actuation="torque")
    contact = dc.ContactOptions(barrier_distance=1e-3)
    return dc.Simulator(dc.Scene([], robots=[hand]), 0.01, contact=contact)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.jacrev, torch.func.jacfwd])
def test_functions_of_states(sim, name, transform):
    state = sim.initial_state()
    spinning = torch.full_like(state.base_velocities, 0.3)

    def value(joints):
        moved = state.replace(joint_positions=joints, base_velocities=spinning)
        found = getattr(sim, name)(moved)
        weights = torch.arange(1.0, 17.0, dtype=torch.float64)
        parts = found.values() if isinstance(found, dict) else [found]
        return sum((weights[: t.numel()] * t.flatten()).sum() for t in parts)

    given = torch.full_like(state.joint_positions, 0.01)
    leaf = given.clone().requires_grad_()
    total = value(leaf)
    expected = torch.zeros_like(given)
    if total.requires_grad:
        (expected,) = torch.autograd.grad(total, leaf)
    torch.testing.assert_close(transform(value)(given), expected, rtol=1e-11, atol=1e-12)


def test_different_numbers_in_one_call_are_refused(sim):
    state = sim.initial_state()
    given = torch.stack([state.joint_positions, state.joint_positions + 0.01])
    with pytest.raises(NotImplementedError, match=r"torch.vmap over states, .* not supported"):
        torch.vmap(lambda x: sim.momentum(state.replace(joint_positions=x)))(given)


def test_the_compiler_leaves_a_step_alone(sim):
    """The compiler traces only the lines around the step."""

    def run(state):
        return sim.step(state).joint_positions * 2

    state = sim.initial_state()
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    found = torch.compile(run, backend="eager")(state)
    assert torch.equal(found, run(state))
    assert torch._dynamo.utils.counters["frames"]["total"] < 12
    torch._dynamo.reset()
