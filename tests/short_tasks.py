"""Configurations of few vertices and steps: a sheet, and shipped tasks that start at contact."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

import diffcloth_torch as dc
from diffcloth_torch.tasks.registry import load_task

CONFIGS = Path(__file__).parents[1] / "configs"

SHEET = """
task: drape
simulation: {dt: 0.01, steps: 4}
scene:
  cloths:
    - name: sheet
      shape: {kind: grid, rows: 3, columns: 4, size: [3, 2]}
      pose: {position: [0, 0, 1], axis: [1, 0, 0], degrees: 90}
      pins: {top: {box: {lower: [-9, -0.1, 1.9], upper: [9, 0.1, 2.1]}}}
"""


def write_config(folder, text):
    path = folder / "config.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def controls_of(task, actions):
    controller, state = task.controller(actions), task.initial_state()
    return [controller(k, state) for k in range(task.steps)]


SMALL = [
    "scene.cloths.sheet.shape={kind: grid, rows: 5, columns: 5}",
    "simulation.steps=6",
    "actions.interval=3",
    "loss.steps=2",
    # Closer than in the shipped configuration, so that a short push makes contact.
    "scene.bodies.cuboid.pose={position: [0, -0.04, 0.95]}",
]


@dataclass(frozen=True)
class Short:
    """A shipped task of fewer vertices and steps, which starts at contact."""

    config: str
    assignments: tuple[str, ...]

    def load(self, *assignments):
        return load_task(CONFIGS / self.config, [*self.assignments, *assignments])


PUSH = Short(
    "push_cube.yaml",
    (
        "scene.cloths.sheet.shape={kind: grid, rows: 5, columns: 5, size: 0.3}",
        "scene.cloths.sheet.pose.position=[0, -0.056, 0.17]",
        "scene.cloths.sheet.pins={left: {vertices: [20]}, right: {vertices: [24]}}",
        "actions.pins={left: [[0, 0.3, 0]], right: [[0, 0.3, 0]]}",
        "scene.bodies.floor.friction=0",
        "scene.bodies.cube.friction=0",
        "simulation.steps=6",
        "actions.interval=3",
        "loss.steps=2",
    ),
)
DYNAMIC = Short("hit_cloth_dynamic.yaml", tuple(SMALL))
# A stiff cloth, because a soft cloth that is squeezed flat buckles to either side.
SMALL_CLOTH = (
    "scene.cloths.cloth.shape={kind: grid, rows: 6, columns: 6, size: 0.12}",
    "scene.cloths.cloth.material.bending=1e-2",
    "simulation.steps=4",
    "actions.interval=2",
    "loss.steps=1",
)
GRASP = Short(
    "grasp_cloth.yaml",
    (
        *SMALL_CLOTH,
        "scene.robots.gripper.joint_positions=0.037",
        "actions.linear=[[0, 0, 0], [0, 0, 0.2]]",
        "actions.angular=[[0, 0, 0], [0, 1, 0]]",
    ),
)
PANDA = Short(
    "panda_pick.yaml",
    (
        *SMALL_CLOTH,
        "scene.robots.panda.joint_positions.panda_finger_joint1=0.003",
        *(f"actions.velocities.panda_joint{i}=[0, 0.1]" for i in range(1, 8)),
        "actions.efforts.panda_finger_joint1=[-20, -20]",
    ),
)


def has_panda():
    try:
        dc.robots.panda()
    except ImportError:
        return False
    return True


# Two strips that start in contact.
TWO = Short(
    "two_cloths.yaml",
    (
        *(
            f"scene.cloths.{name}.shape={{kind: strip, length: 0.3, width: 0.06, rows: 3, "
            "columns: 15, bend: 180, radius: 0.05}"
            for name in ("blue", "red")
        ),
        "scene.cloths.red.pose.position=[0.06, 0, 0]",
        "scene.cloths.blue.material.bending=1e-3",
        "scene.cloths.red.material.bending=1e-3",
        "pull.at={vertices: [0, 15, 30, 14, 29, 44]}",
        "actions.at={vertices: [0, 15, 30, 14, 29, 44]}",
        "actions.force=[[-0.3, 0.02, 0.04]]",
        "simulation.steps=8",
        "actions.interval=4",
        "loss.steps=2",
    ),
)


needs_panda = pytest.mark.skipif(not has_panda(), reason="the Panda is in the extra `robots`")
SHORT = [
    pytest.param(PUSH, id="push_cube"),
    pytest.param(DYNAMIC, id="hit_cloth_dynamic"),
    pytest.param(GRASP, id="grasp_cloth"),
    pytest.param(PANDA, id="panda_pick", marks=needs_panda),
    pytest.param(TWO, id="two_cloths"),
]
