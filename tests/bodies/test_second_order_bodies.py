"""Steps of second order with dynamic bodies and robots."""

import coupled_scenes
import pytest
import scenes
import torch
from differences import directional

import diffcloth_torch as dc


@pytest.mark.parametrize("base", coupled_scenes.BASES)
def test_gradients_with_a_dynamic_body_and_a_robot(base):
    sim = coupled_scenes.simulator("monolithic", base, integrator="second_order")
    state = sim.initial_state()
    with torch.no_grad():
        for _ in range(2):
            state = sim.step(state)
    assert state.report.contact_count > 0
    inputs = {
        "positions": state.positions,
        "velocities": state.velocities,
        "body_velocities": state.body_velocities,
        "joint_velocities": state.joint_velocities,
    }
    weights = scenes.tensor_noise(state.positions.shape, 1.0, 3)
    body_weights = scenes.tensor_noise(state.body_poses.shape, 1.0, 4)

    def loss(given):
        after = sim.step(state.replace(**given))
        change = after.body_poses - state.body_poses
        return (weights * (after.positions - state.positions)).sum() + (body_weights * change).sum()

    for name in inputs:
        assert directional(loss, inputs, [name]) < 1e-6, name


def test_an_attachment_to_a_dynamic_body_is_refused():
    box = dc.RigidBody.box(0.1, motion="dynamic", mass=0.1, pose=[0, 0, -0.2, 1, 0, 0, 0])
    cloth = dc.Cloth.grid(4, 4, 0.3)
    held = dc.Attachment(("cloth0", 5), ("body0", [0, 0, 0.05]), stiffness=10.0)
    scene = dc.Scene([cloth], [box], attachments=[held])
    with pytest.raises(dc.InvalidInput, match=r"which is dynamic"):
        dc.Simulator(scene, 0.01, integrator="second_order")
