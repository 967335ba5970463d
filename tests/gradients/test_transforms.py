"""Transforms of torch.func are refused in one sentence, wherever they begin."""

from __future__ import annotations

import pytest
import torch

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
        sim.initial_state(), parameters=sim.parameters().replace(gravity=x[0]), steps=1
    )[-1].positions.sum(),
    "momentum": lambda sim, x: sim.momentum(moving(sim, x)).sum(),
    "kinetic_energy": lambda sim, x: sim.kinetic_energy(moving(sim, x)).sum(),
    "link_poses": lambda sim, x: sim.link_poses(moving(sim, x))["gripper/palm"].sum(),
    "contact_wrenches": lambda sim, x: sim.contact_wrenches(moving(sim, x))["ball"].sum(),
    "vertex_masses": lambda sim, x: sim.vertex_masses(
        sim.parameters().replace(density=x.sum() + 1)
    ).sum(),
}


def moving(sim, x):
    state = sim.initial_state()
    return state.replace(velocities=state.velocities + x.sum())


@pytest.mark.parametrize("name", CALLS)
def test_transforms_end_in_one_sentence(sim, name):
    message = r"^\w+: torch.func transforms and forward-mode derivatives are not supported; use "
    with pytest.raises(NotImplementedError, match=message):
        torch.func.grad(lambda x: CALLS[name](sim, x))(torch.zeros(2, 3, dtype=F64))
    with pytest.raises(NotImplementedError, match=message):
        torch.func.vmap(lambda x: CALLS[name](sim, x))(torch.zeros(5, 2, 3, dtype=F64))


@pytest.mark.parametrize("name", ["control of soft pins", "momentum", "vertex_masses"])
def test_ordinary_gradients_go_through_the_same_calls(sim, name):
    x = torch.zeros(2, 3, dtype=F64, requires_grad=True)
    value = CALLS[name](sim, x + sim.initial_state().positions[:2] if "pins" in name else x)
    (gradient,) = torch.autograd.grad(value, x)
    assert gradient.abs().max() > 0
