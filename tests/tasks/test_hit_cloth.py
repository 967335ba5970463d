"""Hit cloth: a body strikes a sheet into a shape."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from short_tasks import CONFIGS, SMALL, controls_of, write_config

import diffcloth_torch as dc
from diffcloth_torch.tasks.optimization import evaluate, optimize
from diffcloth_torch.tasks.reach import shape_distance
from diffcloth_torch.tasks.registry import load_task

# One action for all intervals.
PUSH_ONCE = ["actions.linear=[[0, 0.75, 0.35]]", "actions.angular=[[0.8, 0, 0]]"]


def small_hit(*assignments):
    return load_task(CONFIGS / "hit_cloth.yaml", [*SMALL, *PUSH_ONCE, *assignments])


def test_the_shipped_task_is_the_one_of_the_paper():
    task = load_task(CONFIGS / "hit_cloth.yaml")
    (sheet,) = task.scene.cloths
    assert sheet.vertices.size == 1728  # degrees of freedom
    assert len(sheet.pins["top"]) == 24
    np.testing.assert_allclose(sheet.vertices[:, 1], 0, atol=1e-15)  # hangs vertically
    (goal,) = task.goals()
    np.testing.assert_allclose(goal.vertices[:, 2], 1.5)  # the goal lies flat
    pinned = sheet.pins["top"]
    np.testing.assert_allclose(goal.vertices[pinned], sheet.vertices[pinned], atol=1e-12)


def test_actions_become_poses_of_the_body():
    task = small_hit("actions.linear=[[0, 1, 0], [0, 0, 2]]", "actions.angular=[[1, 0, 0]]")
    actions = task.actions()
    assert {name: tuple(t.shape) for name, t in actions.items()} == {
        "linear": (2, 3),
        "angular": (2, 3),
    }
    (name,) = task.scene.body_names
    poses = torch.stack([control.body_poses[name] for control in controls_of(task, actions)])
    dt = task.simulator.dt
    expected = torch.tensor([0.0, -0.04 + 3 * dt, 0.95 + 3 * 2 * dt], dtype=torch.float64)
    torch.testing.assert_close(poses[-1, :3].detach(), expected)
    first_interval = torch.tensor([0.0, -0.04 + 3 * dt, 0.95], dtype=torch.float64)
    torch.testing.assert_close(poses[2, :3].detach(), first_interval)
    half = torch.tensor(6 * dt / 2, dtype=torch.float64)
    torch.testing.assert_close(poses[-1, 3].detach(), half.cos())
    torch.testing.assert_close(poses[-1, 4].detach(), half.sin())


def test_the_wrong_number_of_action_rows_is_refused():
    with pytest.raises(dc.InvalidInput, match="must have 1 row or one for each of the 2 control"):
        small_hit("actions.linear=[[0, 1, 0], [0, 1, 0], [0, 1, 0]]").actions()


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        pytest.param("actions.body=tray", "'tray' in `actions.body`", id="body"),
        pytest.param("target.cloth=towel", "'towel' in `target.cloth`", id="cloth"),
        pytest.param("loss.steps=7", "`loss.steps`", id="steps"),
        pytest.param("scene.bodies.cuboid.motion=static", "motion: kinematic", id="static"),
    ],
)
def test_references_must_fit_the_scene(assignment, message):
    with pytest.raises(dc.InvalidInput, match=message):
        small_hit(assignment)


def test_a_target_shape_has_no_seams(tmp_path):
    path = tmp_path / "sewn.obj"
    path.write_text(
        "v -.5 0 0\nv .5 0 0\nv -.5 1 0\nv .5 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvt 3 3\nvt 3 2\n"
        "vt 4 2\nf 1/1 2/2 3/3\nf 2/4 4/5 3/6\n"
    )
    shape = "{kind: load, path: sewn.obj, rest: uv, rest_scale: 1}"
    with pytest.raises(dc.InvalidInput, match=r"target\.cloth must have a rest mesh without seams"):
        load_task(
            write_config(tmp_path, (CONFIGS / "hit_cloth.yaml").read_text(encoding="utf-8")),
            [f"scene.cloths.sheet.shape={shape}", "scene.cloths.sheet.pins={}"],
        )


def test_the_distance_of_shapes_is_the_root_mean_square():
    target = torch.zeros(2, 3, dtype=torch.float64)
    vertices = torch.tensor([[3.0, 4, 0], [0, 0, 0]], dtype=torch.float64)
    assert shape_distance(vertices, target).item() == pytest.approx(math.sqrt(25 / 2))
    assert shape_distance(vertices, target, "squared").item() == pytest.approx(25 / 2)


def test_the_gradient_of_the_actions_is_that_of_finite_differences():
    task = small_hit("simulation.solver={tolerance: 1e-10}", "optimizer.checkpoint_every=2")
    actions = task.actions()
    evaluation = evaluate(task, actions)
    assert evaluation.statistics["largest_contact_count"] > 0
    # One entry that acts through contact: the push of the first interval.
    eps = 1e-5
    losses = []
    for sign in (1, -1):
        moved = {name: tensor.detach().clone() for name, tensor in actions.items()}
        moved["linear"][0, 1] += sign * eps
        with torch.no_grad():
            controller = task.controller(moved)
            states = task.simulator.rollout(task.initial_state(), controller, steps=6)
            losses.append(task.loss(states).item())
    difference = (losses[0] - losses[1]) / (2 * eps)
    assert difference != 0
    assert actions["linear"].grad[0, 1].item() == pytest.approx(difference, rel=1e-3)


@pytest.mark.rounding
def test_a_few_iterations_lower_the_loss():
    found = optimize(small_hit("optimizer.iterations=4"))
    assert found.best.loss < found.first.loss
    metrics = found.metrics()
    assert metrics["iterations"] == 4
    assert metrics["converged_steps"] == metrics["steps"] == 4 * 6
    assert metrics["minimum_distance"] > 0
