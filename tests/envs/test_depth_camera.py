"""Depth images and partial point clouds of environments."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch import envs
from diffcloth_torch.envs.depth_camera import Sight
from diffcloth_torch.envs.frames import points_in
from diffcloth_torch.envs.sheets import HEIGHT
from diffcloth_torch.geometry.poses import transform

SMALL = 6
ABOVE = envs.DepthCamera([0.05, 0.0, 1.0], [0.05, 0.0, 0.0], up=[0, 1, 0], width=40, height=32)


def make(name, num_envs=1, **options):
    return envs.make(name, num_envs, size=SMALL, **options)


def wave(env, steps):
    """Random actions, after which no sheet is flat."""
    noise = torch.Generator().manual_seed(0)
    for _ in range(steps):
        seen = env.step(2 * torch.rand(1, env.task.action_size, generator=noise) - 1)[0]
    return seen


def image(env, observation):
    camera, place = env.task.camera, env.task.observation_slices["depth"]
    return observation[:, place].reshape(-1, camera.height, camera.width).numpy()


def cloud(env, observation):
    return observation[:, env.task.observation_slices["points"]].reshape(env.num_envs, -1, 3)


def rays(camera):
    """Points at depth 1 in the axes of the camera, [H, W, 3]."""
    rows, columns = np.indices((camera.height, camera.width))
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones_like(rows)], axis=-1)
    return pixels @ np.linalg.inv(camera.matrix).T


def in_image(camera, points):
    """Columns and rows, and depths of points [n, 3] in the world."""
    away = (points - np.array(camera.position)) @ camera.axes.T
    return (away @ camera.matrix.T)[:, :2] / away[:, 2:], away[:, 2]


def test_a_flat_sheet_below_a_camera_has_its_distance():
    env = make("FoldCloth", observation="depth", camera=ABOVE)
    observation, _ = env.reset(seed=1)
    seen = image(env, observation)[0]
    assert observation.dtype == torch.float32
    sheet = np.abs(seen - (1 - HEIGHT)) < 1e-6
    assert np.abs(seen[~sheet] - 1.0).max() < 1e-6  # the table
    pixel = 1.0 / ABOVE.focal_length
    assert sheet.sum() * pixel**2 == pytest.approx(0.3**2, rel=0.03)


@pytest.mark.parametrize("frame", ["task", "world"])
def test_an_image_and_the_pose_of_the_camera_are_points_in_the_frame(frame):
    env = make("FoldCloth", observation="depth", frame=frame)
    observation, _ = env.reset(seed=1)
    camera = env.task.camera
    pose = observation[0, env.task.observation_slices["camera"]].double().numpy()
    points = transform((image(env, observation)[0][..., None] * rays(camera)).reshape(-1, 3), pose)
    points = points.reshape(camera.height, camera.width, 3)
    near = (image(env, observation)[0] < camera.far) & (points[..., 2] > HEIGHT / 2)
    assert near.sum() > 100
    assert np.abs(points[near][:, 2] - HEIGHT).max() < 1e-5
    # The sheet is the square around the origin of its own frame, and turned in the world.
    turned = np.abs(points[near][:, :2]).max() - 0.15
    assert turned < 1e-5 if frame == "task" else turned > 1e-3


def test_the_frame_changes_points_and_no_image():
    by_frame = {}
    for frame in ("task", "world"):
        for kind in ("depth", "points"):
            env = make("PushCube", observation=kind, frame=frame)
            by_frame[frame, kind] = env.reset(seed=2)[0][:, env.task.observation_slices[kind]]
        by_frame[frame] = env.env_state.drawn
    assert torch.equal(by_frame["task", "depth"], by_frame["world", "depth"])
    world = by_frame["world", "points"].reshape(1, -1, 3).double()
    expected = points_in(by_frame["task"], world).flatten(1).float()
    torch.testing.assert_close(by_frame["task", "points"], expected, rtol=0, atol=1e-6)
    assert not torch.allclose(expected, by_frame["world", "points"], atol=0.1)


@pytest.mark.parametrize("name", ["SpreadCloth", "GraspCloth"])
def test_points_lie_on_triangles_and_in_the_image(name):
    env = make(name, observation="points", frame="world")
    env.reset(seed=0)
    observation = wave(env, 3)
    points = cloud(env, observation)[0].double().numpy()
    assert points.shape == (env.task.camera.points, 3)
    state = env.env_state.state
    vertices, faces = next(iter(state.meshes().values()))
    a, b, c = (vertices[0].numpy()[faces[:, k].numpy()] for k in range(3))
    # Each point as a + u (b - a) + v (c - a) + w n, with the unit normal n.
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    axes = np.stack([b - a, c - a, normals], axis=-1)
    u, v, w = np.moveaxis(np.linalg.solve(axes, (points[:, None] - a)[..., None])[..., 0], -1, 0)
    inside = (u > -1e-4) & (v > -1e-4) & (u + v < 1 + 1e-4)
    assert (inside & (np.abs(w) < 1e-6)).any(axis=1).all()
    # They are the points that the image of the same camera shows.
    camera = env.task.camera
    depths = Sight(camera, env.task.simulator.scene).depths(state)[0].numpy()
    pixels, away = in_image(camera, points)
    column, row = (pixels - 0.5).round().astype(int).T
    assert np.abs(pixels - 0.5 - np.stack([column, row], axis=1)).max() < 1e-3
    np.testing.assert_allclose(depths[row, column], away, rtol=0, atol=1e-6)


def test_a_cube_hides_the_sheet_behind_it():
    camera = envs.DepthCamera([0.0, 1.0, 0.1], [0.0, 0.0, 0.1])
    env = make("PushCube", observation="depth", camera=camera)
    observation, _ = env.reset(seed=0)
    state = env.env_state.state
    cube = state.body_poses[0, 0, :3].numpy()
    column, row = in_image(camera, cube[None])[0][0].astype(int)
    face = cube[1] + 0.05
    assert image(env, observation)[0][row, column] == pytest.approx(1 - face, abs=1e-6)
    points = Sight(camera, env.task.simulator.scene).points(state)[0].numpy()
    assert np.abs(points[:, 1] + 0.1).max() < 1e-6  # the plane of the sheet
    silhouette = np.abs(points[:, [0, 2]] - cube[[0, 2]]).max(axis=1) < 0.05
    assert not silhouette.any()


def test_a_gripper_hides_the_cloth_between_its_fingers():
    camera = envs.DepthCamera([-0.06, 0.0, 0.5], [-0.06, 0, 0], up=[0, 1, 0], field_of_view=30)
    env = make("GraspCloth", observation="depth", camera=camera)
    seen = image(env, env.reset(seed=0)[0])[0]
    pixels, away = in_image(camera, env.env_state.state.positions[0].numpy())
    inside = ((pixels > 0) & (pixels < 64)).all(axis=1)
    column, row = pixels[inside].astype(int).T
    hidden = seen[row, column] < away[inside] - 0.005
    assert 0 < hidden.sum() < inside.sum()


def test_a_deforming_body_hides_a_cloth_and_has_no_points():
    cloth = dc.Cloth.grid((5, 5), (0.4, 0.4), pose=[0, 0, 0.1, 1, 0, 0, 0])
    corners = [[-0.1, -0.1, 0.3], [0.1, -0.1, 0.3], [0.1, 0.1, 0.3], [-0.1, 0.1, 0.3]]
    lid = dc.DeformingBody(corners, [[0, 1, 2], [0, 2, 3]])
    scene = dc.Scene([cloth], [lid])
    sight = Sight(envs.DepthCamera([0, 0, 1], [0, 0, 0], up=[0, 1, 0]), scene)
    state = dc.Simulator(scene, 0.01).initial_state(1)
    assert float(sight.depths(state)[0, 32, 32]) == pytest.approx(0.7)
    points = sight.points(state)[0]
    torch.testing.assert_close(points[:, 2], torch.full((128,), 0.1, dtype=torch.float64))
    shadow = 0.1 * 0.9 / 0.7
    assert points[:, :2].abs().amax(dim=1).min() > shadow
    assert len(points.unique(dim=0)) == 128


@pytest.mark.parametrize("face", [0, -1])
def test_a_triangle_that_fills_the_image_has_all_points(face):
    """The first and the last triangle of a cloth, with the triangles of a body after them."""
    cloth = dc.Cloth.grid((3, 3), (0.4, 0.4), pose=[0, 0, 0.1, 1, 0, 0, 0])
    scene = dc.Scene([cloth], [dc.RigidBody.plane(4.0)])
    state = dc.Simulator(scene, 0.01).initial_state(1)
    vertices, faces = state.meshes()[scene.cloth_names[0]]
    x, y, _ = vertices[0, faces[face]].mean(dim=0).tolist()
    camera = envs.DepthCamera([x, y, 1.0], [x, y, 0.0], up=[0, 1, 0], field_of_view=4)
    points = Sight(camera, scene).points(state)[0]
    torch.testing.assert_close(points[:, 2], torch.full((128,), 0.1, dtype=torch.float64))
    # Half an image is 0.9 tan 2 deg = .031 m wide; the triangle reaches .067 m from its centroid.
    away = points[:, :2] - torch.tensor([x, y])
    assert 0.02 < float(away.abs().max()) < 0.032


def test_nothing_is_seen_beyond_the_far_plane():
    away = {"position": [0.0, -3.0, 1.0], "target": [0.0, -4.0, 1.0]}  # with the back to the strips
    depth = make("TwoCloths", observation="depth", camera=envs.DepthCamera(**away, far=2.5))
    assert (image(depth, depth.reset(seed=0)[0]) == 2.5).all()
    env = make("TwoCloths", observation="points", camera=envs.DepthCamera(**away))
    observation, _ = env.reset(seed=0)
    expected = torch.tensor([[away["position"]]]).expand(1, 128, 3)
    assert torch.equal(cloud(env, observation), expected)
    near = envs.DepthCamera([0.05, 0, 1.0], [0.05, 0, 0], up=[0, 1, 0], far=0.5)
    short = make("FoldCloth", observation="points", camera=near, frame="world")
    expected = torch.tensor([[near.position]]).expand(1, 128, 3)
    assert torch.equal(cloud(short, short.reset(seed=0)[0]), expected)


@pytest.mark.parametrize("kind", ["depth", "points"])
def test_an_environment_has_the_same_bits_in_any_batch(kind):
    alone, among = (make("GraspCloth", n, observation=kind) for n in (1, 3))
    assert torch.equal(alone.reset(seed=7)[0][0], among.reset(seed=7)[0][0])
    one = alone.step(alone.scripted_actions())[0]
    assert torch.equal(one[0], among.step(among.scripted_actions())[0][0])


def test_points_have_a_gradient_and_images_have_none():
    env = make("FoldCloth", observation="points", frame="world")
    env.reset(seed=0)
    task, state = env.task, env.env_state.state
    positions = state.positions.clone().requires_grad_()
    sight = Sight(task.camera, task.simulator.scene)
    points = sight.points(state.replace(positions=positions))
    (gradient,) = torch.autograd.grad(points.sum(), positions)
    total = torch.full((3,), float(task.camera.points), dtype=torch.float64)
    torch.testing.assert_close(gradient.sum(dim=(0, 1)), total)
    # A point is a weighted mean of the corners of one triangle.
    (single,) = torch.autograd.grad(
        sight.points(state.replace(positions=positions))[0, 0, 2], positions
    )
    corners = single[0, :, 2].nonzero()[:, 0].tolist()
    assert corners in [sorted(f) for f in task.simulator.scene.cloths[0].faces.tolist()]
    place = task.observation_slices["points"]
    actions = torch.zeros(1, 8, requires_grad=True)
    seen = env.step(actions)[0]
    assert seen[:, place].requires_grad
    assert not sight.depths(state.replace(positions=positions)).requires_grad


@pytest.mark.parametrize("name", envs.TASKS)
def test_a_camera_replaces_all_features_of_the_cloth_and_keeps_the_goal(name):
    env = make(name, observation="depth")
    env.reset(seed=0)
    task, start = env.task, env.env_state
    sensed = task.sensed(start)
    assert list(sensed)[:2] == ["depth", "camera"]
    assert {"goal", "to_target", "start"} & set(sensed)
    assert "time" in sensed
    moved = start.state.positions + 0.01 * torch.rand(start.state.positions.shape)
    if name == "PushCube":  # the pins are tools
        moved[:, task._pins] = start.state.positions[:, task._pins]
    state = start.state.replace(
        positions=moved,
        velocities=start.state.velocities + 1,
        contact_forces=start.state.contact_forces + 1,
    )
    other = task.sensed(envs.EnvState(**(vars(start) | {"state": state})))
    changed = {name for name in sensed if not torch.equal(sensed[name], other[name])}
    assert changed == {"depth"}
    camera = task.camera
    assert sensed["depth"].shape == (1, camera.width * camera.height)
    is_cloth = Sight(camera, task.simulator.scene).points(start.state)
    assert len(is_cloth[0].unique(dim=0)) > 50  # pixels that see it


@pytest.mark.filterwarnings("ignore:.*infinity")
@pytest.mark.parametrize("kind", ["depth", "points"])
def test_gymnasium_checks_a_single_environment(kind):
    from gymnasium.utils.env_checker import check_env

    env = envs.make_single("FoldCloth", size=SMALL, horizon=3, observation=kind)
    check_env(env, skip_render_check=True)
    size = {"depth": 64 * 64 + 7, "points": 3 * 128}[kind]
    assert env.observation_space.shape == (8 + 12 + 6 + size + 1,)


def test_no_extra_is_needed(monkeypatch):
    for package in ("pyvista", "vtk", "viser", "matplotlib"):
        monkeypatch.setitem(sys.modules, package, None)
    env = make("DropCloth", observation="depth")
    assert image(env, env.reset(seed=0)[0]).std() > 0.1


def test_a_camera_keeps_its_place():
    position = np.array([0.0, 0.0, 1.0])
    camera = envs.DepthCamera(position, torch.tensor([0.0, 1.0, 0.0]))
    position += 1
    assert camera.position == (0.0, 0.0, 1.0)
    np.testing.assert_allclose(camera.axes[2], np.array([0.0, 1.0, -1.0]) / 2**0.5)
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(camera.axes) == pytest.approx(1.0)
    np.testing.assert_allclose(transform(np.eye(3), camera.pose) - camera.position, camera.axes)


def test_cameras_that_are_refused():
    right = {"position": [0.0, 0.0, 1.0], "target": [0.0, 1.0, 0.0]}
    wrong = [
        ({"position": [0.0, 0.0]}, "`position` must have shape"),
        ({"target": [0.0, float("nan"), 0.0]}, r"`target` must be finite, got nan at \[1\]"),
        ({"target": [0.0, 0.0, 0.5]}, "`target` must be apart from `position`, and not in the"),
        ({"target": [0.0, 0.0, 1.0]}, "`target` must be apart from `position`"),
        ({"field_of_view": 180.0}, "`field_of_view` must be between 0 and 180"),
        ({"far": 0.0}, "`far` must be finite and > 0"),
        ({"width": 0}, "`width` must be at least 1, got 0"),
        ({"height": 5000}, "`height` must be at most 4096, got 5000"),
        ({"points": 0}, "`points` must be at least 1, got 0"),
    ]
    for change, message in wrong:
        with pytest.raises(dc.InvalidInput, match=f"^DepthCamera: {message}"):
            envs.DepthCamera(**right | change)
    with pytest.raises(TypeError, match="DepthCamera: `width` must be an integer, got float"):
        envs.DepthCamera(**right, width=64.0)


def test_options_of_cameras_that_are_refused():
    with pytest.raises(
        dc.InvalidInput, match="make: `camera` must be None with `observation` 'key"
    ):
        make("FoldCloth", camera=ABOVE)
    with pytest.raises(TypeError, match="make: `camera` must be DepthCamera or None, got str"):
        make("FoldCloth", observation="depth", camera="above")
    with pytest.raises(dc.InvalidInput, match="make: `observation` must be one of"):
        make("FoldCloth", observation="pixels")

    class Blind(envs.TASKS["FoldCloth"]):
        name = "Blind"
        view = None

    with pytest.raises(dc.InvalidInput, match="Blind: `camera` must be a DepthCamera"):
        Blind(size=SMALL, observation="points")
