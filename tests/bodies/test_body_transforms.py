"""What only looks at a state says in a sentence that it does not go with `torch.func`."""

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
@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.jacrev, torch.func.vmap])
def test_functions_of_states_refuse_transforms(sim, name, transform):
    state = sim.initial_state()

    def value(joints):
        found = getattr(sim, name)(state.replace(joint_positions=joints))
        return sum(t.sum() for t in (found.values() if isinstance(found, dict) else [found]))

    given = state.joint_positions
    given = given.expand(2, -1) if transform is torch.func.vmap else given
    with pytest.raises(NotImplementedError, match=rf"^{name}: torch.func transforms .* not supp"):
        transform(value)(given)
    leaf = state.joint_positions.clone().requires_grad_()
    value(leaf)  # as ever without


def test_controls_and_masses_refuse_transforms(sim):
    with pytest.raises(NotImplementedError, match=r"^control: torch.func"):
        torch.func.grad(lambda x: sim.control(joint_efforts=x).joint_efforts.sum())(
            torch.zeros(2, dtype=torch.float64)
        )
    with pytest.raises(NotImplementedError, match=r"^vertex_masses: torch.func"):
        torch.func.grad(lambda x: sim.vertex_masses().sum() + x)(torch.zeros(()))


def test_the_compiler_leaves_a_step_alone(sim):
    """It sees the few lines around it."""

    def run(state):
        return sim.step(state).joint_positions * 2

    state = sim.initial_state()
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    found = torch.compile(run, backend="eager")(state)
    assert torch.equal(found, run(state))
    assert torch._dynamo.utils.counters["frames"]["total"] < 12
    torch._dynamo.reset()
