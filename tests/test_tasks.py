"""Tasks: generated meshes, scenes from configurations, prescribed motion, the optimization loop."""

from __future__ import annotations

import itertools
import math
import runpy
import shutil
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.config import shapes
from diffcloth_torch.geometry.poses import transform
from diffcloth_torch.geometry.rotation import (
    integrate_poses,
    interpolate_poses,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
    rotate,
)
from diffcloth_torch.tasks.optimization import OptimizerSection, evaluate, optimize
from diffcloth_torch.tasks.reach import shape_distance
from diffcloth_torch.tasks.registry import load_task
from diffcloth_torch.tasks.simulation import simulate

CONFIGS = Path(__file__).parent.parent / "configs"


@pytest.fixture
def rng():
    return torch.Generator().manual_seed(0)


def random(rng, *shape):
    return torch.randn(*shape, dtype=torch.float64, generator=rng)


# --- rotations ----------------------------------------------------------------------------------


def matrix_of(rotation_vector):
    """Rotation by the exponential of a matrix: a reference without quaternions."""
    x, y, z = rotation_vector.tolist()
    return torch.linalg.matrix_exp(
        torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    )


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-4, 0.0999999, 0.1000001, 1.0, 3.1, 5.0])
def test_the_exponential_is_that_of_the_rotation_matrix(rng, angle):
    axis = torch.nn.functional.normalize(random(rng, 3), dim=0)
    point = random(rng, 3)
    got = rotate(quaternion_exp(angle * axis), point)
    torch.testing.assert_close(got, matrix_of(angle * axis) @ point, rtol=0, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.05, 0.0999, 0.1001, 2.0])
def test_the_exponential_has_the_right_gradient(rng, angle):
    w = angle * torch.nn.functional.normalize(random(rng, 3), dim=0)
    assert torch.autograd.gradcheck(quaternion_exp, w.requires_grad_(), rtol=1e-8, atol=1e-9)


def test_the_exponential_is_smooth_where_its_branches_meet():
    axis = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64)
    below, above = quaternion_exp(axis * torch.tensor([[0.1 - 1e-15], [0.1 + 1e-15]]))
    torch.testing.assert_close(below, above, rtol=0, atol=3e-15)


def test_products_compose_rotations(rng):
    a, b, point = random(rng, 3), random(rng, 3), random(rng, 3)
    product = quaternion_multiply(quaternion_exp(a), quaternion_exp(b))
    expected = matrix_of(a) @ matrix_of(b) @ point
    torch.testing.assert_close(rotate(product, point), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-10, 0.3, 3.0])
def test_the_logarithm_undoes_the_exponential(rng, angle):
    w = angle * torch.nn.functional.normalize(random(rng, 3), dim=0)
    q = quaternion_exp(w)
    for same in (q, -q):
        torch.testing.assert_close(quaternion_log(same), w, rtol=0, atol=1e-14)


def test_a_constant_twist_moves_along_a_screw():
    pose = torch.tensor([1.0, 2, 3, 1, 0, 0, 0], dtype=torch.float64)
    twist = torch.tensor([0.1, -0.2, 0.3, 0, 0, math.pi], dtype=torch.float64)
    poses = integrate_poses(pose, twist.expand(50, 6), dt=0.01)
    # After half a second: half the displacement of a second, and a quarter of a turn about z.
    expected = [1.05, 1.9, 3.15, math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)]
    torch.testing.assert_close(poses[-1], torch.tensor(expected, dtype=torch.float64))
    torch.testing.assert_close(poses[:, 3:].norm(dim=1), torch.ones(50, dtype=torch.float64))


def test_integrated_poses_have_the_right_gradient(rng):
    pose = torch.tensor([0.0, 0, 0, 0.6, 0, 0.8, 0], dtype=torch.float64)
    twists = random(rng, 4, 6).requires_grad_()
    assert torch.autograd.gradcheck(lambda t: integrate_poses(pose, t, 0.1), twists)


def test_keyframes_are_met_and_held_outside():
    identity, turned = [0.0, 0, 0, 1, 0, 0, 0], [1.0, 0, 0, math.sqrt(0.5), 0, 0, math.sqrt(0.5)]
    poses = torch.tensor([identity, turned], dtype=torch.float64)
    times = torch.tensor([1.0, 3.0], dtype=torch.float64)
    got = interpolate_poses(times, poses, torch.tensor([0.0, 1, 2, 3, 9], dtype=torch.float64))
    torch.testing.assert_close(got[[0, 1, 3, 4]], poses[[0, 0, 1, 1]])
    halfway = [0.5, 0, 0, math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]
    torch.testing.assert_close(got[2], torch.tensor(halfway, dtype=torch.float64))


# --- meshes -------------------------------------------------------------------------------------


def edges_of(faces):
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(ends, axis=0, return_counts=True)


def test_a_disk_is_one_sheet_of_good_triangles():
    vertices, faces = shapes.disk(0.6, 0.06)
    edges, counts = edges_of(faces)
    border = edges[counts == 1]
    np.testing.assert_allclose(np.linalg.norm(vertices[border].reshape(-1, 3), axis=1), 0.6)
    assert len(vertices) - len(edges) + len(faces) == 1  # Euler: a disk
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] > 0).all()
    polygon = len(border) / 2 * 0.6**2 * math.sin(2 * math.pi / len(border))
    assert normals[:, 2].sum() / 2 == pytest.approx(polygon)
    longest = np.max([np.linalg.norm(q - p, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    height = normals[:, 2] / longest
    assert (height / longest).min() > 0.3  # 0.87 for equal sides
    degrees = np.bincount(edges[counts == 2].ravel(), minlength=len(vertices))
    assert len(np.unique(degrees)) > 3  # unstructured


def test_a_disk_is_the_same_every_time():
    for a, b in zip(shapes.disk(0.5, 0.08), shapes.disk(0.5, 0.08), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_bent_strip_keeps_its_lengths_and_opens_downwards():
    flat, bent, faces = shapes.strip(1.4, [0.04, 0.09], 4, 60, 180, 0.07, 0.4)
    edges, _ = edges_of(faces)
    assert len(flat) - len(edges) + len(faces) == 1  # Euler: a disk
    along = np.abs(np.diff(edges)[:, 0]) == 1
    lengths = [np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) for x in (flat, bent)]
    np.testing.assert_allclose(lengths[1][along], lengths[0][along], rtol=1e-12)
    # Across, chords of the bend are shorter than the arc, which is straight in the flat strip.
    np.testing.assert_allclose(lengths[1], lengths[0], rtol=2e-2)
    row = bent.reshape(4, 60, 3)[0]
    assert flat.reshape(4, 60, 3)[[0, -1], :, 1].T[[0, -1]] == pytest.approx(
        np.array([[-0.02, 0.02], [-0.045, 0.045]])
    )
    assert row[[0, -1], 0] == pytest.approx([-0.07, 0.07], abs=1e-3)
    assert row[:, 2].max() == pytest.approx(0.07, abs=1e-3)
    sides = (0.4 * 1.4 - np.pi * 0.035, 0.6 * 1.4 - np.pi * 0.035)
    assert row[[0, -1], 2] == pytest.approx([-sides[0], -sides[1]], abs=2e-3)


def test_a_strip_that_is_not_bent_is_flat():
    flat, bent, _ = shapes.strip(1.0, 0.1, 3, 11, 0, 0.1, 0.5)
    np.testing.assert_allclose(bent[:, :2], flat[:, :2], atol=1e-15)
    np.testing.assert_allclose(bent[:, 2], 0.1, atol=1e-15)  # at the top of the bend


def test_a_chair_is_closed_and_has_the_volume_of_its_parts():
    w, d, h, back, t = 0.5, 0.4, 0.45, 0.5, 0.05
    vertices, faces = shapes.chair(w, d, h, back, t, 0.1)
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    forward = {tuple(edge) for edge in directed.tolist()}
    assert len(forward) == len(directed)
    assert forward == {(b, a) for a, b in forward}  # closed, consistently oriented
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert volume == pytest.approx(w * d * t + w * t * back + 4 * t * t * (h - t))
    assert vertices.min(axis=0) == pytest.approx([-w / 2, -d / 2, 0])
    assert vertices.max(axis=0) == pytest.approx([w / 2, d / 2, h + back])


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        pytest.param("{kind: disk, radius: 1, edge_length: 3}", "edge_length", id="coarse"),
        pytest.param("{kind: disk, radius: 1, edge_length: 1e-5}", "edge_length", id="fine"),
        pytest.param(
            "{kind: strip, length: 1, width: 0.1, rows: 3, columns: 9, bend: 180, radius: 0.4}",
            "`bend` and `radius` must fit",
            id="bend",
        ),
    ],
)
def test_a_shape_that_cannot_be_made_is_refused(tmp_path, shape, message):
    config = write_config(tmp_path, SHEET)
    with pytest.raises(dc.InvalidInput, match=message):
        load_task(config, [f"scene.cloths.sheet.shape={shape}"])


# --- scenes -------------------------------------------------------------------------------------

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


def prescribed(task):
    return controls_of(task, task.actions())


def test_a_cloth_is_posed_and_pinned_by_place(tmp_path):
    task = load_task(write_config(tmp_path, SHEET))
    (cloth,) = task.scene.cloths
    np.testing.assert_allclose(cloth.vertices[:, 1], 0, atol=1e-15)
    assert cloth.pins["top"].tolist() == [8, 9, 10, 11]
    np.testing.assert_allclose(cloth.vertices[8:, 2], 2.0)
    np.testing.assert_allclose(cloth.rest_vertices[:, 2], 0.0)


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
    """It is asked before each step, with the state before that step."""
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


# --- hit cloth ----------------------------------------------------------------------------------

SMALL = [
    "scene.cloths.sheet.shape={kind: grid, rows: 5, columns: 5}",
    "simulation.steps=6",
    "actions.interval=3",
    "loss.steps=2",
    # Closer than in the shipped configuration, so that a short push makes contact.
    "scene.bodies.cuboid.pose={position: [0, -0.04, 0.95]}",
]


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
    np.testing.assert_allclose(goal.vertices[:, 2], 1.5)  # and shall lie flat
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
    # One entry with an effect through contact: the push of the first interval.
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


def test_a_few_iterations_lower_the_loss():
    found = optimize(small_hit("optimizer.iterations=4"))
    assert found.best.loss < found.first.loss
    metrics = found.metrics()
    assert metrics["iterations"] == 4
    assert metrics["converged_steps"] == metrics["steps"] == 4 * 6
    assert metrics["minimum_distance"] > 0


# --- push cube, grasp cloth, and forces -----------------------------------------------------------


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
# A stiff cloth: a soft one that is squeezed flat buckles, one way or the other.
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


needs_panda = [
    pytest.mark.skipif(not has_panda(), reason="the Panda is in the extra `robots`"),
    pytest.mark.filterwarnings("ignore::diffcloth_torch.IgnoredLimitsWarning"),
]
SHORT = [
    pytest.param(PUSH, id="push_cube"),
    pytest.param(DYNAMIC, id="hit_cloth_dynamic"),
    pytest.param(GRASP, id="grasp_cloth"),
    pytest.param(PANDA, id="panda_pick", marks=needs_panda),
    pytest.param(TWO, id="two_cloths"),
]


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
        assert slope == pytest.approx(difference, rel=1e-4), name


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
def test_actions_must_fit_what_acts(short, assignment, message):
    with pytest.raises(dc.InvalidInput, match=message):
        short.load(assignment)


# --- two cloths, and control points --------------------------------------------------------------


def test_the_shipped_forces_are_those_on_the_ends_of_two_hooked_cloths():
    task = load_task(CONFIGS / "two_cloths.yaml")
    control = controls_of(task, task.actions())[0]
    forces = control.forces.detach()
    blue, red = (forces[task.simulator.slices[name]] for name in ("blue", "red"))
    torch.testing.assert_close(red.sum(dim=0), torch.tensor([0.3, 0, 0.047], dtype=torch.float64))
    torch.testing.assert_close(blue.sum(dim=0), torch.tensor([-0.3, 0, 0.047], dtype=torch.float64))
    for name, part in (("blue", blue), ("red", red)):
        pulled = part.abs().sum(dim=1) > 0
        ends = task.scene.cloths[task.scene.cloth_names.index(name)].rest_vertices[:, 0]
        np.testing.assert_array_equal(pulled.numpy(), np.isclose(np.abs(ends), 0.2))


def test_the_distance_of_a_cloth_is_that_of_its_center():
    task = TWO.load("target.position=[0.3, 0.4, 0.5]")
    start = task.initial_state()
    rows = task.simulator.slices["blue"]
    moved = start.positions.clone()
    moved[rows] -= moved[rows].mean(dim=0) - torch.tensor([0.0, 0.0, 0.5])
    state = start.replace(positions=moved)
    assert task.distance(state, "distance").item() == pytest.approx(0.5)
    (goal,) = task.goals()
    np.testing.assert_allclose(goal.vertices.mean(axis=0), [0.3, 0.4, 0.5], atol=1e-12)


CUBE = Short(
    "cloth_on_cube.yaml",
    (
        "scene.cloths.cloth.shape={kind: grid, rows: 7, columns: 7, size: 0.5}",
        "scene.cloths.cloth.soft_pins={corner_0: {vertices: [0]}, corner_1: {vertices: [6]}, "
        "corner_2: {vertices: [42, 43]}, corner_3: {vertices: [48]}}",
        "simulation.dt=0.1",
        "simulation.steps=12",
    ),
)


def test_control_points_are_followed_to_their_last_targets():
    task = CUBE.load("scene.cloths.cloth.pin_trajectories.corner_0=[{time: 9}]")
    start = task.initial_state()
    ends = torch.tensor([0.0, 0.5, 0.5, 0.5], dtype=torch.float64)
    torch.testing.assert_close(task.distances(start), ends)
    # A group is where the mean of its vertices is.
    turned = start.positions.clone()
    turned[42] += torch.tensor([0.0, 0.0, 0.1])
    turned[43] -= torch.tensor([0.0, 0.0, 0.1])
    torch.testing.assert_close(task.distances(start.replace(positions=turned)), ends)
    centers = np.array([goal.vertices.mean(axis=0) for goal in task.goals()])
    expected = start.positions.numpy()[[0, 6, 42, 48]]
    expected[2] = start.positions.numpy()[[42, 43]].mean(axis=0)
    expected[1:, 2] -= 0.5
    np.testing.assert_allclose(centers, expected, atol=1e-12)


def test_control_points_reach_their_targets_as_far_as_the_cloth_lets_them():
    task = CUBE.load()
    states = list(simulate(task))
    assert all(state.report.converged for state in states[1:])
    distances = task.distances(states[-1])
    assert 0.01 < distances.max() < 0.1  # from half a meter
    assert max(state.report.contact_count for state in states[1:]) > 0


def test_control_points_are_soft_pins():
    with pytest.raises(dc.InvalidInput, match="must have `soft_pins`"):
        CUBE.load("scene.cloths.cloth.soft_pins={}", "scene.cloths.cloth.pin_trajectories={}")


def test_the_shipped_tie_is_the_one_of_the_paper():
    task = load_task(CONFIGS / "tie.yaml")
    (tie,) = task.scene.cloths
    assert np.ptp(tie.rest_vertices[:, 0]) == pytest.approx(1.4)
    assert {name: len(rows) for name, rows in tie.soft_pins.items()} == {"narrow": 5, "wide": 5}


# --- the loop, on a task without a simulation ---------------------------------------------------


@dataclass
class Bowl:
    """Minimize |a|^2; rollouts of |a| beyond `reach` fail."""

    optimizer: OptimizerSection
    steps: int = 1
    start: float = 1.0
    reach: float = math.inf
    error: type[Exception] = dc.InfeasibleMotion

    def __post_init__(self):
        self.simulator = SimpleNamespace(rollout=self.rollout)

    def initial_state(self):
        return None

    def actions(self):
        return {"a": torch.tensor([self.start], dtype=torch.float64, requires_grad=True)}

    def controller(self, actions):
        return lambda k, state: actions["a"]

    def rollout(self, state, control_at, *, steps, checkpoint_every):
        value = control_at(0, state)
        if value.abs().item() > self.reach:
            raise self.error("too far")
        report = dc.Report(
            converged=True,
            iterations=1,
            residual=0.0,
            minimum_distance=math.inf,
            contact_count=0,
            motion_fraction=1.0,
            seconds={"all": 0.0},
        )
        return [dc.State(*[value] * 6, report=report)]

    def loss(self, states):
        return states[-1].positions.square().sum()


def descend(rate=0.25, **options):
    return OptimizerSection(iterations=5, learning_rates={"a": rate}, **options)


def test_the_loop_is_gradient_descent():
    # a <- a - 0.25 * 2 a halves a each time.
    found = optimize(Bowl(descend()))
    assert found.metrics()["losses"] == pytest.approx([0.25**k for k in range(5)])
    assert found.best.actions["a"].item() == pytest.approx(0.5**4)
    assert found.metrics()["minimum_distance"] is None


def test_momentum_and_clipping_are_those_of_torch():
    losses = optimize(Bowl(descend(momentum=0.5, clip=0.1))).metrics()["losses"]
    a, velocity, expected = 1.0, 0.0, []
    for _ in range(5):
        expected.append(a * a)
        velocity = 0.5 * velocity + math.copysign(min(abs(2 * a), 0.1), a)
        a -= 0.25 * velocity
    assert losses == pytest.approx(expected, rel=1e-5)


def test_momentum_starts_anew_where_the_loss_rises():
    losses = optimize(Bowl(descend(momentum=0.9, restart=True))).metrics()["losses"]
    a, velocity, expected = 1.0, 0.0, []
    for _ in range(5):
        if expected and a * a > expected[-1]:
            velocity = 0.0
        expected.append(a * a)
        velocity = 0.9 * velocity + 2 * a
        a -= 0.25 * velocity
    assert losses == pytest.approx(expected, rel=1e-5)
    assert any(b > a for a, b in itertools.pairwise(losses))


def test_the_loop_stops_below_a_loss():
    assert len(optimize(Bowl(descend(stop_below=0.1))).history) == 3


@pytest.mark.parametrize("error", [dc.InfeasibleMotion, dc.NotConverged])
def test_a_failed_attempt_goes_back_half_way(error):
    # The first step leads from 1 to -9, beyond the reach of 2: -4 fails as well, -1.5 is tried.
    found = optimize(Bowl(descend(rate=5.0), reach=2.0, error=error))
    assert found.metrics()["losses"][:2] == pytest.approx([1.0, 1.5**2])
    assert found.metrics()["failed_attempts"] >= 2
    assert found.failures[0] == {"iteration": 1, "error": f"{error.__name__}: too far"}


def test_the_loop_gives_up_after_too_many_failures():
    with pytest.raises(dc.InfeasibleMotion, match="too far"):
        optimize(Bowl(descend(rate=50.0, failures=2), reach=1.0))


def test_initial_actions_that_fail_end_the_loop():
    with pytest.raises(dc.InfeasibleMotion, match="too far"):
        optimize(Bowl(descend(), start=3.0, reach=2.0))


def test_another_error_is_not_swallowed():
    with pytest.raises(ZeroDivisionError):
        optimize(Bowl(descend(rate=5.0), reach=2.0, error=ZeroDivisionError))


def test_an_infinite_loss_is_an_error():
    with pytest.raises(dc.SimulationError, match="the loss is inf"):
        optimize(Bowl(descend(), start=1e200))


def test_learning_rates_must_name_the_actions():
    options = OptimizerSection(iterations=1, learning_rates={"b": 1.0})
    with pytest.raises(dc.InvalidInput, match="must have the keys a, got b"):
        optimize(Bowl(options))


# --- shipped drapes -----------------------------------------------------------------------------


def test_the_tablecloth_starts_above_the_chair():
    task = load_task(CONFIGS / "drape.yaml")
    chair = task.scene.bodies[0]
    assert task.scene.cloths[0].vertices[:, 2].min() > chair.vertices[:, 2].max()


def test_the_meshes_of_the_configurations_are_what_their_script_makes():
    made = runpy.run_path(str(CONFIGS.parent / "scripts" / "make_meshes.py"))["texts"]()
    files = {path.name: path for path in (CONFIGS / "meshes").iterdir()}
    assert set(files) == set(made)
    for name, path in files.items():
        assert path.read_text() == made[name]


def test_own_meshes_are_draped_by_a_plain_clone(tmp_path):
    """The configurations alone, with nothing beside them: a bell over a skittle that stands."""
    shutil.copytree(CONFIGS, tmp_path / "configs")
    task = load_task(tmp_path / "configs/drape_own.yaml", ["simulation.steps=24"])
    bell, (skittle, _) = task.scene.cloths[0], task.scene.bodies
    placed = transform(skittle.vertices, skittle.pose)
    assert np.ptp(placed[:, 2]) == pytest.approx(0.38)
    assert placed[:, 2].min() == pytest.approx(0, abs=1e-9)
    triangles = skittle.vertices[skittle.faces]
    assert np.linalg.det(triangles).sum() > 0  # it faces outward
    lengths = np.linalg.norm(np.diff(bell.vertices[bell.faces], axis=1), axis=-1)
    assert lengths.max() < 2.5 * lengths.min()
    states = list(simulate(task))
    assert states[-1].report.converged
    assert states[-1].report.contact_count > 0
    # The fall has ended on the skittle's head.
    assert states[-1].positions[:, 2].max() > 0.38
