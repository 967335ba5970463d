"""Tensors of the simulator are on the CPU, whatever the default device of torch is."""

import pytest
import torch

import diffcloth_torch as dc

F64 = torch.float64


@pytest.fixture
def elsewhere():
    """A device that every machine has, and that computes nothing."""
    torch.set_default_device("meta")
    yield
    torch.set_default_device(None)


def simulated():
    hand = dc.Robot.load(
        dc.robots.GRIPPER, pose=[0, 0, 0.5, 0, 1, 0, 0], stiffness=200.0, damping=5.0
    )
    cloth = dc.Cloth.grid(6, 6, 0.3, name="cloth", pose=[0, 0, 0.107, 1, 0, 0, 0])
    box = dc.RigidBody.box(0.05, motion="dynamic", mass=0.1, pose=[0.3, 0, 0.4, 1, 0, 0, 0])
    scene = dc.Scene([cloth], [dc.RigidBody.box(0.2), box], robots=[hand])
    simulator = dc.Simulator(scene, 0.01)
    given = simulator.default_parameters()
    given = given.replace(gravity=given.gravity.clone().requires_grad_())
    states = simulator.rollout(
        simulator.initial_state(2), parameters=given, steps=3, checkpoint_every=2
    )
    (states[-1].positions.sum() + states[-1].joint_positions.sum()).backward()
    one = dc.stack([states[-1][0], states[-2][1]])
    one = dc.where(torch.tensor([True, False], device="cpu"), one, states[0])
    energies = simulator.energy(one), simulator.kinetic_energy(one), simulator.momentum(one)
    wrenches = simulator.contact_wrenches(one)
    return [one.positions, given.gravity.grad, *energies, *wrenches.values()]


def test_steps_gradients_and_observables(elsewhere):
    found = simulated()
    torch.set_default_device(None)
    for here, there in zip(simulated(), found, strict=True):
        assert torch.equal(here, there)


def test_environments(elsewhere):
    env = dc.envs.make("FoldCloth", num_envs=2, size=6)
    observation, _ = env.reset(seed=0)
    actions = env.scripted_actions().requires_grad_()
    _, reward, *_ = env.step(actions)
    reward.sum().backward()
    assert {t.device.type for t in (observation, reward, actions.grad)} == {"cpu"}
