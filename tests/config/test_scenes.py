"""Scenes from configurations, and the motion that they prescribe."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from short_tasks import SHEET, controls_of, write_config

import diffcloth_torch as dc
from diffcloth_torch.tasks.registry import load_task
from diffcloth_torch.tasks.simulation import simulate


def prescribed(task):
    return controls_of(task, task.actions())


def test_a_cloth_is_posed_and_pinned_by_place(tmp_path):
    task = load_task(write_config(tmp_path, SHEET))
    (cloth,) = task.scene.cloths
    np.testing.assert_allclose(cloth.vertices[:, 1], 0, atol=1e-15)
    assert cloth.pins["top"].tolist() == [8, 9, 10, 11]
    np.testing.assert_allclose(cloth.vertices[8:, 2], 2.0)
    np.testing.assert_allclose(cloth.rest_positions[:, 2], 0.0)


def test_nearest_vertices_can_be_pinned(tmp_path):
    pins = "scene.cloths.sheet.pins={ends: {nearest: [[-9, 0, 9], [9, 0, 9]]}}"
    task = load_task(write_config(tmp_path, SHEET), [pins])
    assert task.scene.cloths[0].pins["ends"].tolist() == [8, 11]


def test_an_empty_box_of_pins_is_refused(tmp_path):
    pins = "scene.cloths.sheet.pins={top: {box: {lower: [5, 5, 5], upper: [6, 6, 6]}}}"
    with pytest.raises(dc.InvalidInput, match=r"box of sheet\.pins\.top must hold a vertex"):
        load_task(write_config(tmp_path, SHEET), [pins])


def test_two_surfaces_of_one_name_are_refused(tmp_path):
    body = "scene.bodies=[{name: sheet, shape: {kind: sphere, radius: 0.1}}]"
    with pytest.raises(dc.InvalidInput, match="'sheet' must be given once"):
        load_task(write_config(tmp_path, SHEET), [body])


@pytest.mark.parametrize(
    "shape",
    [
        "{kind: box, size: [1, 2, 3]}",
        "{kind: sphere, radius: 0.5}",
        "{kind: capsule, radius: 0.2, length: 1}",
        "{kind: plane, size: 2}",
        "{kind: chair}",
    ],
)
def test_every_kind_of_body_can_be_made(tmp_path, shape):
    body = f"scene.bodies=[{{name: it, shape: {shape}, pose: {{position: [9, 9, 9]}}}}]"
    task = load_task(write_config(tmp_path, SHEET), [body])
    assert task.scene.body_names == ("it",)
    assert task.scene.bodies[0].pose[:3].tolist() == [9, 9, 9]


def test_own_meshes_keep_their_order_and_scale(tmp_path):
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 3 1 2\nf 2 4 3\n")
    shape = "scene.cloths.sheet.shape={kind: load, path: m.obj, scale: 0.5}"
    task = load_task(
        write_config(tmp_path, SHEET),
        [shape, "scene.cloths.sheet.pins={}", "scene.cloths.sheet.pose={position: [0, 0, 1]}"],
    )
    (cloth,) = task.scene.cloths
    assert cloth.faces.tolist() == [[2, 0, 1], [1, 3, 2]]
    assert cloth.vertices.tolist() == [[0, 0, 1], [0.5, 0, 1], [0, 0.5, 1], [0.5, 0.5, 1]]


UV = """v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0
vt 0 0\nvt 1 0\nvt 0 1\nvt 3 3\nvt 3 2\nvt 4 2
f 1/1 2/2 3/3\nf 2/4 4/5 3/6\n"""
POSED = ["scene.cloths.sheet.pins={}", "scene.cloths.sheet.pose={position: [0, 0, 1]}"]


def test_the_texture_of_a_file_is_a_rest_shape(tmp_path):
    (tmp_path / "m.obj").write_text(UV)
    shape = (
        "scene.cloths.sheet.shape={kind: load, path: m.obj, scale: 0.5, rest: uv, rest_scale: 2}"
    )
    task = load_task(write_config(tmp_path, SHEET), [shape, *POSED])
    (cloth,) = task.scene.cloths
    assert cloth.vertices[3].tolist() == [0.5, 0.5, 1]
    assert len(cloth.rest_positions) == 6
    corners = cloth.rest_positions[cloth.rest_faces[1]]
    np.testing.assert_array_equal(corners, [[6, 6, 0], [6, 4, 0], [8, 4, 0]])
    loaded = dc.Cloth.load(tmp_path / "m.obj", scale=0.5, rest="uv", rest_scale=2.0)
    np.testing.assert_array_equal(cloth.rest_positions, loaded.rest_positions)
    for wrong in ("rest: uv", "rest_scale: 2", "rest: other.obj, rest_scale: 2"):
        given = f"scene.cloths.sheet.shape={{kind: load, path: m.obj, {wrong}}}"
        with pytest.raises(dc.InvalidInput, match="`rest_scale` with `rest: uv`, and only with it"):
            load_task(write_config(tmp_path, SHEET), [given, *POSED])


def test_pins_follow_their_keyframes(tmp_path):
    frames = "{top: [{time: 0.02, displacement: [0, 0.1, 0], axis: [0, 0, 1], degrees: 180}]}"
    task = load_task(
        write_config(tmp_path, SHEET), [f"scene.cloths.sheet.pin_trajectories={frames}"]
    )
    controls = prescribed(task)
    start = torch.tensor(task.scene.cloths[0].vertices[8:])
    # Half a turn about the vertical through the middle of the row swaps its ends.
    end = start.flip(0) + torch.tensor([0.0, 0.1, 0.0])
    for control, expected in ((controls[1], end), (controls[3], end)):
        torch.testing.assert_close(control.pins["sheet/top"], expected.double())
    first = controls[0].pins["sheet/top"]
    torch.testing.assert_close(first.mean(dim=0)[1], torch.tensor(0.05, dtype=torch.float64))


def test_bodies_follow_their_keyframes_and_static_ones_stay(tmp_path):
    bodies = (
        "scene.bodies=[{name: still, shape: {kind: box, size: 1}, "
        "pose: {position: [9, 0, 0], axis: [0, 1, 0], degrees: 33}}, "
        "{name: mover, shape: {kind: box, size: 1}, motion: kinematic, "
        "pose: {position: [-9, 0, 0]}, trajectory: [{time: 0.04, position: [-9, 0, 1]}]}]"
    )
    task = load_task(write_config(tmp_path, SHEET), [bodies])
    controls = list(prescribed(task))
    assert all(set(control.body_poses) == {"mover"} for control in controls)
    poses = torch.stack([control.body_poses["mover"] for control in controls])
    heights = torch.tensor([0.25, 0.5, 0.75, 1.0], dtype=torch.float64)
    torch.testing.assert_close(poses[:, 2], heights)
    states = list(simulate(task))
    still = torch.tensor(task.scene.bodies[0].pose)
    assert all(torch.equal(state.body_poses[0], still) for state in states)
    assert torch.equal(states[-1].body_poses[1], poses[-1])


def test_a_simulated_sheet_hangs_from_its_pins(tmp_path):
    states = list(simulate(load_task(write_config(tmp_path, SHEET))))
    assert len(states) == 5
    moved = states[-1].positions - states[0].positions
    assert moved[8:].abs().max() == 0
    assert (moved[:4, 2] < 0).all()
    assert not states[-1].positions.requires_grad


def test_a_controller_may_close_the_loop(tmp_path):
    """The controller is called before each step, with the state before the step."""
    task = load_task(write_config(tmp_path, SHEET))
    asked = []

    def controller(k, state):
        asked.append((k, round(float(state.time) / 0.01)))
        return dc.Control(pins={"sheet/top": state.positions[8:12] + 1e-3})

    task.controller = lambda actions: controller
    states = list(simulate(task))
    assert asked == [(0, 0), (1, 1), (2, 2), (3, 3)]
    moved = states[-1].positions[8:12] - states[0].positions[8:12]
    torch.testing.assert_close(moved, torch.full_like(moved, 4e-3))
