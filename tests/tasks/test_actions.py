"""Actions of tasks on pins, bodies, robots and forces; gradients of all actions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from short_tasks import CONFIGS, DYNAMIC, GRASP, PUSH, SHORT, TWO, controls_of

import diffcloth_torch as dc
from diffcloth_torch.tasks.optimization import evaluate, optimize
from diffcloth_torch.tasks.registry import load_task


@pytest.fixture
def rng():
    return torch.Generator().manual_seed(0)


def random(rng, *shape):
    return torch.randn(*shape, dtype=torch.float64, generator=rng)


@pytest.mark.parametrize("short", SHORT)
def test_gradients_of_all_actions_are_those_of_finite_differences(short, rng):
    task = short.load("simulation.solver={tolerance: 1e-10}")
    actions = task.actions()
    evaluation = evaluate(task, actions)
    assert evaluation.statistics["largest_contact_count"] > 0
    for name, tensor in actions.items():
        direction = random(rng, *tensor.shape)
        losses = []
        for step in (1e-4, -1e-4):
            moved = {key: value.detach().clone() for key, value in actions.items()}
            moved[name] += step * direction
            with torch.no_grad():
                states = task.simulator.rollout(
                    task.initial_state(), task.controller(moved), steps=task.steps
                )
                losses.append(task.loss(states).item())
        difference = (losses[0] - losses[1]) / 2e-4
        slope = (tensor.grad * direction).sum().item()
        assert difference != 0, name
        # Losses are accurate to about 2e-14, their differences over 2e-4 to 1e-10.
        assert slope == pytest.approx(difference, rel=1e-4, abs=1e-10), name


@pytest.mark.rounding
@pytest.mark.parametrize("short", SHORT)
def test_a_few_iterations_of_each_task_lower_the_loss(short):
    found = optimize(short.load("optimizer.iterations=3"))
    assert found.best.loss < found.first.loss
    metrics = found.metrics()
    assert metrics["converged_steps"] == metrics["steps"]
    assert metrics["minimum_distance"] > 0


def test_the_shipped_gripper_and_cloth_are_those_of_the_paper():
    task = load_task(CONFIGS / "grasp_cloth.yaml")
    (cloth,), (gripper,) = task.scene.cloths, task.scene.robots
    assert cloth.vertices.size == 1728  # degrees of freedom
    assert gripper.mechanism.base == "kinematic"
    actions = task.actions()
    assert sum(rows.shape[1] for rows in actions.values()) == 8
    assert task.config.loss.steps * task.simulator.dt == pytest.approx(1.0)  # held for a second


def test_velocities_become_positions_of_pins():
    task = PUSH.load("actions.pins.left=[[0, 1, 0], [0, 0, 2]]", "actions.pins.right=[[0, 0, 0]]")
    controls = controls_of(task, task.actions())
    start = torch.tensor(task.scene.cloths[0].vertices)
    dt = task.simulator.dt
    moved = torch.tensor([[0.0, 3 * dt, 3 * 2 * dt]], dtype=torch.float64)
    torch.testing.assert_close(controls[-1].pins["sheet/left"].detach(), start[[20]] + moved)
    torch.testing.assert_close(controls[-1].pins["sheet/right"].detach(), start[[24]])


def test_forces_become_wrenches():
    task = DYNAMIC.load("actions.force=[[1, 2, 3], [4, 5, 6]]", "actions.torque=[[7, 8, 9]]")
    controls = controls_of(task, task.actions())
    wrenches = torch.stack([control.body_wrenches["cuboid"] for control in controls]).detach()
    expected = torch.tensor([[1.0, 2, 3, 7, 8, 9]] * 3 + [[4.0, 5, 6, 7, 8, 9]] * 3)
    torch.testing.assert_close(wrenches, expected.double())


def test_rows_of_a_robot_reach_its_base_and_its_joints():
    task = GRASP.load(
        "actions.efforts={left_finger_joint: [1, 2], right_finger_joint: [3, 4]}",
        "actions.linear=[[0, 0, 1], [0, 0, 0]]",
        "actions.angular=[[0, 0, 0]]",
    )
    last = controls_of(task, task.actions())[-1]
    efforts = {name: value.item() for name, value in last.joint_efforts.items()}
    assert efforts == {"gripper/left_finger_joint": 2, "gripper/right_finger_joint": 4}
    pose = torch.tensor(task.scene.robots[0].pose)
    pose[2] += 2 * task.simulator.dt
    torch.testing.assert_close(last.base_poses["gripper"].detach(), pose)


def test_a_floating_gripper_is_driven_by_a_wrench():
    task = GRASP.load(
        "scene.robots.gripper.base=floating",
        "actions={robot: gripper, force: [[0, 0, 4.5]], torque: [[0, 0, 0.1]]}",
        "optimizer.learning_rates={force: 1, torque: 1}",
    )
    wrench = controls_of(task, task.actions())[0].base_wrenches["gripper"].detach()
    expected = torch.tensor([0, 0, 4.5, 0, 0, 0.1], dtype=torch.float64)
    torch.testing.assert_close(wrench, expected)


def test_the_distance_of_a_body_is_that_of_its_center():
    task = PUSH.load("target.position=[0.03, 0.04, 0.053]")
    start = task.initial_state()
    state = start.replace(body_poses=start.body_poses.clone())
    state.body_poses[0, :3] = torch.tensor([0.0, 0.0, 0.053])
    assert task.distance(state, "distance").item() == pytest.approx(0.05)
    assert task.distance(state, "squared").item() == pytest.approx(0.0025)
    (goal,) = task.goals()
    np.testing.assert_allclose(goal.vertices.mean(axis=0), [0.03, 0.04, 0.053], atol=1e-12)


@pytest.mark.parametrize(
    ("short", "assignment", "message"),
    [
        pytest.param(
            DYNAMIC, "actions.torque=null", "either `linear` and `angular` or `force`", id="half"
        ),
        pytest.param(
            DYNAMIC, "scene.bodies.cuboid.motion=kinematic", "`motion: dynamic`", id="forced"
        ),
        pytest.param(PUSH, "actions.pins={top: [[0, 0, 0]]}", "'top' in `actions.pins`", id="pins"),
        pytest.param(
            PUSH,
            "scene.cloths.sheet.pin_trajectories={left: [{time: 1}]}",
            "'left' in `actions.pins`.*without a trajectory: right",
            id="pins-that-follow",
        ),
        pytest.param(PUSH, "scene.bodies.cube.motion=static", "`motion: dynamic`", id="fixed-cube"),
        pytest.param(TWO, "pull.cloth=green", "'green' in `pull.cloth`", id="pulled"),
        pytest.param(TWO, "target.cloth=green", "'green' in `target.cloth`", id="center"),
        pytest.param(
            TWO,
            "actions.at={box: {lower: [5, 5, 5], upper: [6, 6, 6]}}",
            "box of actions.at must hold a vertex",
            id="pulled-nowhere",
        ),
        pytest.param(TWO, "pull.at={vertices: [45]}", r"pull\.at", id="pulled-beyond"),
        pytest.param(PUSH, "target.body=ball", "'ball' in `target.body`", id="target"),
        pytest.param(GRASP, "actions.robot=hand", "'hand' in `actions.robot`", id="robot"),
        pytest.param(GRASP, "scene.robots.gripper.base=fixed", "`base: kinematic`", id="base"),
        pytest.param(
            GRASP, "actions={robot: gripper}", "actions of the base or of joints", id="no"
        ),
        pytest.param(
            GRASP,
            "actions.efforts={left_finger_joint: [1], right_finger_joint: [1, 2]}",
            "equally many rows",
            id="uneven",
        ),
        pytest.param(
            GRASP,
            "actions.velocities={left_finger_joint: [1]}",
            "actuated by velocity: none; got 'left_finger_joint'",
            id="actuation",
        ),
    ],
)
def test_actions_must_fit_the_actuators(short, assignment, message):
    with pytest.raises(dc.InvalidInput, match=message):
        short.load(assignment)
