"""Scenes of tasks, shared by configurations and environments."""

from __future__ import annotations

import numpy as np
import pytest
from short_tasks import CONFIGS, write_config

import diffcloth_torch as dc
from diffcloth_torch.config.documents import read_document
from diffcloth_torch.tasks.registry import load_task, read_config

PAIRS = [
    ("hit_cloth", "HitCloth", 24),
    ("push_cube", "PushCube", 12),
    ("grasp_cloth", "GraspCloth", 24),
    ("two_cloths", "TwoCloths", 12),
]


@pytest.mark.parametrize(("task", "name", "size"), PAIRS)
def test_an_environment_has_the_scene_of_the_configuration(task, name, size):
    assert "scene" not in read_document(CONFIGS / f"{task}.yaml")
    configured = load_task(CONFIGS / f"{task}.yaml").scene
    scene = dc.envs.TASKS[name](size=size).simulator.scene
    assert scene.cloth_names == configured.cloth_names
    for ours, theirs in zip(scene.cloths, configured.cloths, strict=True):
        for field in ("vertices", "rest_positions", "faces"):
            np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))
        assert repr(ours.material) == repr(theirs.material)
        np.testing.assert_equal(dict(ours.pins), dict(theirs.pins))
    assert scene.body_names == configured.body_names
    assert scene.robot_names == configured.robot_names
    for ours, theirs in zip(
        [*scene.bodies, *scene.robots], [*configured.bodies, *configured.robots], strict=True
    ):
        # The height of the cube follows from `size`, and is rounded.
        np.testing.assert_allclose(ours.pose, theirs.pose, rtol=0, atol=1e-16)


@pytest.mark.parametrize("size", [4, 12, 150])
def test_the_upper_edge_is_pinned_at_any_size(size):
    sheet = dc.envs.TASKS["HitCloth"](size=size).simulator.scene.cloths[0]
    np.testing.assert_array_equal(sheet.pins["top"], range(size * (size - 1), size * size))


def test_sections_of_a_configuration_replace_those_of_the_task(tmp_path):
    text = (CONFIGS / "push_cube.yaml").read_text()
    target = "\ntarget: {body: cube, position: [0, 1, 0]}\n"
    config = read_config(write_config(tmp_path, text + target))
    assert config.target.position == [0, 1, 0]
    assert config.scene.bodies[0].name == "cube"
    changed = ["scene.cloths.sheet.material.stretch=7"]
    assert read_config(CONFIGS / "push_cube.yaml", changed).scene.cloths[0].material.stretch == 7


def test_a_scene_without_a_target_does_not_take_the_target_of_the_task(tmp_path):
    text = (CONFIGS / "hit_cloth_dynamic.yaml").read_text()
    without, _, rest = text.partition("target:\n")
    path = write_config(tmp_path, without + rest.partition("\n\n")[2])
    with pytest.raises(dc.InvalidInput, match="`target` is missing"):
        read_config(path)
