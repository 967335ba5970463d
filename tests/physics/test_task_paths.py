"""Tasks, robots included, never intersect: every path of a whole attempt is judged."""

from pathlib import Path

import pytest
from physics_scenes import Judge, free_links, judge_attempt

import diffcloth_torch as dc
from diffcloth_torch.tasks.registry import load_task

CONFIGS = Path(__file__).parents[2] / "configs"

FINGERS = ("gripper/left_finger", "gripper/right_finger")

# The whole motion in longer steps, on fewer vertices.
CASES = [
    pytest.param(
        "push_cube.yaml",
        [
            "simulation.dt=0.05",
            "simulation.steps=30",
            "actions.interval=2",
            "loss.steps=6",
            "scene.cloths.sheet.shape={kind: grid, rows: 8, columns: 8, size: 0.3}",
        ],
        id="push_cube",
    ),
    pytest.param(
        "hit_cloth_dynamic.yaml",
        [
            "simulation.dt=0.05",
            "simulation.steps=20",
            "actions.interval=2",
            "scene.cloths.sheet.shape={kind: grid, rows: 10, columns: 10}",
        ],
        id="hit_cloth_dynamic",
    ),
    pytest.param(
        "grasp_cloth.yaml",
        [
            "simulation.dt=0.05",
            "simulation.steps=32",
            "actions.interval=2",
            "loss.steps=20",
            "scene.cloths.cloth.shape={kind: grid, rows: 12, columns: 12, size: 0.12}",
        ],
        id="grasp_cloth",
    ),
    pytest.param(
        "two_cloths.yaml",
        [
            "simulation.dt=0.02",
            "simulation.steps=30",
            "actions.interval=5",
        ],
        id="two_cloths",
    ),
    pytest.param(
        "tie.yaml",
        [
            "simulation.dt=0.05",
            "simulation.steps=60",
            "scene.cloths.tie.shape.rows=3",
            "scene.cloths.tie.shape.columns=50",
            "scene.cloths.tie.soft_pins={narrow: {vertices: [0, 50, 100]}, "
            "wide: {vertices: [49, 99, 149]}}",
            "scene.cloths.tie.pin_stiffness=20",
        ],
        id="tie",
    ),
    pytest.param(
        "cloth_on_cube.yaml",
        [
            "simulation.dt=0.05",
            "simulation.steps=24",
            "scene.cloths.cloth.shape={kind: grid, rows: 13, columns: 13, size: 0.5}",
            "scene.cloths.cloth.soft_pins={corner_0: {vertices: [0]}, corner_1: {vertices: [12]}, "
            "corner_2: {vertices: [156]}, corner_3: {vertices: [168]}}",
        ],
        id="cloth_on_cube",
    ),
    pytest.param(
        "panda_pick.yaml",
        [
            "simulation.dt=0.05",
            "simulation.steps=28",
            "actions.interval=2",
            "scene.cloths.cloth.shape={kind: grid, rows: 10, columns: 10, size: 0.12}",
        ],
        id="panda_pick",
        marks=pytest.mark.slow,
    ),
]


@pytest.mark.quick("push_cube", "hit_cloth_dynamic", "grasp_cloth")
@pytest.mark.parametrize(("config", "assignments"), CASES)
def test_no_attempt_intersects(config, assignments):
    if "panda" in config:
        try:
            dc.robots.panda()
        except ImportError:
            pytest.skip("the Panda is in the extra `robots`")
    task = load_task(CONFIGS / config, assignments)
    wrong, touched = judge_attempt(task, task.actions())
    assert not wrong
    assert touched > task.steps / 4


@pytest.mark.parametrize("finger", FINGERS)
def test_the_judge_sees_a_finger_in_a_cloth(finger):
    task = load_task(CONFIGS / "grasp_cloth.yaml")
    judge = Judge(task.simulator, free_links(task.scene))
    points = judge.points(task.initial_state())
    rows = task.simulator.slices[finger]
    shift = len(task.initial_state().positions)
    height = 0.105 - points[shift + rows.start : shift + rows.stop, 2].mean()
    moved = points.copy()
    moved[shift + rows.start : shift + rows.stop, 2] += height
    assert judge.is_free_path([points, points])
    assert not judge.is_free_path([points, moved])
