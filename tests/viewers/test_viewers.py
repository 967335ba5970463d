"""Viewers: their files, and the content of pictures."""

from __future__ import annotations

import itertools
import sys
import typing
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.config import schema
from diffcloth_torch.config.viewers import VIEWERS, open_viewers
from diffcloth_torch.geometry.meshes import read_mesh
from diffcloth_torch.tasks.registry import load_task
from diffcloth_torch.tasks.simulation import simulate
from diffcloth_torch.viewers.curves import draw_loss_curve
from diffcloth_torch.viewers.floor import BACKGROUND, Shadow
from diffcloth_torch.viewers.look import FORCE_COLOR, GOAL_COLOR, Camera, Goal, Paint, Pictures
from diffcloth_torch.viewers.meshes import MeshSequence
from diffcloth_torch.viewers.record import Record
from diffcloth_torch.viewers.several import Viewers
from diffcloth_torch.viewers.shown import Shown
from diffcloth_torch.viewers.viewer import NullViewer

CONFIG = """
task: drape
simulation: {dt: 0.01, steps: 4}
scene:
  cloths:
    - name: sheet
      shape: {kind: grid, rows: 4, columns: 4}
      pose: {position: [0, 0, 1]}
      color: "#ff0000"
      back_color: "#0000ff"
      pins: {all: {box: {lower: [-9, -9, -9], upper: [9, 9, 9]}}}
  bodies:
    - {name: ball, shape: {kind: sphere, radius: 0.2, subdivisions: 1}, color: "#00ff00"}
output:
  pictures: {size: [160, 120]}
"""


@pytest.fixture
def make_task(tmp_path):
    def make(*assignments):
        path = tmp_path / "config.yaml"
        path.write_text(CONFIG, encoding="utf-8")
        return load_task(path, assignments)

    return make


@pytest.fixture
def pictures():
    pytest.importorskip("pyvista")
    pytest.importorskip("imageio")


class Counter(NullViewer):
    def __init__(self):
        self.times = []

    def show(self, state, gradient=None):
        self.times.append(round(float(state.time), 6))


def test_every_so_many_states_are_shown(make_task):
    counter = Counter()
    with Viewers([counter], every=2) as viewers:
        for state in simulate(make_task()):
            viewers.show(state)
    assert counter.times == [0.0, 0.02, 0.04]


def test_configurations_accept_every_viewer_that_can_be_opened():
    (names,) = typing.get_args(schema.OutputSection.model_fields["viewers"].annotation)
    assert typing.get_args(names) == tuple(name for name, _ in VIEWERS)


def test_options_of_pictures_are_those_of_the_schema():
    for options, section in (
        (Pictures(), schema.PictureSection()),
        (Camera(), schema.CameraSection()),
    ):
        given = section.model_dump(exclude={"camera"})
        for name, value in given.items():
            default = getattr(options, name)
            assert (list(default) if name in ("size", "up") else default) == value
        assert set(section.model_dump()) == set(vars(options))


def test_a_scene_is_drawn_without_a_configuration(tmp_path):
    pytest.importorskip("pyvista")
    sheet = dc.Cloth.grid(4, 4, pose=[0, 0, 1, 1, 0, 0, 0], name="sheet")
    floor = dc.RigidBody.plane(9.0, pose=[0, 0, 0.5, 1, 0, 0, 0])
    simulator = dc.Simulator(dc.Scene([sheet], [floor]), 0.01)
    pictures = Pictures(size=(160, 120), video="none", sheet=1, camera=Camera(elevation=50.0))
    goal = Goal(sheet.vertices + np.array([0, 0, 0.5]), sheet.faces)
    paints = {"sheet": Paint("#ff0000")}
    with Record(
        tmp_path, simulator.scene, fps=10, pictures=pictures, paints=paints, goals=[goal]
    ) as viewer:
        viewer.show(simulator.initial_state())
    image = read_image(tmp_path / "animation.png")
    assert has_hue(image, 0)
    assert (image[..., 1] - image[..., 0] > 20).mean() > 0.01  # the goal, green and translucent


@pytest.mark.parametrize(
    ("body", "floor"),
    [
        pytest.param(dc.RigidBody.plane(2.0, pose=[0, 0, -1, 1, 0, 0, 0]), True, id="level"),
        pytest.param(dc.RigidBody.plane(2.0, pose=[0, 0, -1, 3, 0, 0, 4]), True, id="turned"),
        pytest.param(dc.RigidBody.plane(2.0, pose=[0, 0, -1, 9, 1, 0, 0]), False, id="inclined"),
        pytest.param(
            dc.RigidBody.plane(2.0, pose=[0, 0, -1, 1, 0, 0, 0], motion="kinematic"),
            False,
            id="moving",
        ),
        pytest.param(dc.RigidBody.box(2.0, pose=[0, 0, -2, 1, 0, 0, 0]), False, id="box"),
    ],
)
def test_the_drawn_floor_stands_for_a_static_level_plane(body, floor):
    shown = Shown(dc.Scene([dc.Cloth.grid(3, 3)], [body]), {})
    assert [surface.shown for surface in shown.rigid] == [not floor]


def test_a_mesh_sequence_has_one_file_per_state(make_task, tmp_path):
    task = make_task()
    folder = tmp_path / "meshes"
    folder.mkdir()
    (folder / "frame_0099.obj").write_text("of an earlier run")
    (folder / "notes.txt").write_text("not ours")
    states = list(simulate(task))
    with MeshSequence(folder) as viewer:
        for state in states:
            viewer.show(state)
    names = sorted(path.name for path in folder.iterdir())
    assert names == [f"frame_{k:04d}.obj" for k in range(5)] + ["notes.txt"]
    vertices, faces = read_mesh(folder / "frame_0004.obj")
    np.testing.assert_array_equal(vertices[:16], states[-1].positions.numpy())
    assert len(faces) == 18 + len(task.scene.bodies[0].faces)


def open_task(task, folder):
    return open_viewers(task.config, task.scene, folder, task.goals())


def record(task, folder, states=None):
    alone = task.config.output.model_copy(update={"viewers": ["record"]})
    config = task.config.model_copy(update={"output": alone})
    with open_viewers(config, task.scene, folder) as viewer:
        for state in states or list(simulate(task)):
            viewer.show(state)


def read_image(path):
    from matplotlib.image import imread

    return (imread(path)[..., :3] * 255).astype(int)


def has_hue(image, channel):
    """Return whether many pixels have one channel well above the others."""
    others = [c for c in range(3) if c != channel]
    strong = image[..., channel] > 1.6 * np.maximum(*(image[..., c] for c in others)) + 10
    return strong.mean() > 0.003


@pytest.mark.usefixtures("pictures")
class TestRecord:
    def test_the_files_exist(self, make_task, tmp_path):
        task = make_task("output.pictures.frames=true", "output.pictures.sheet=2")
        record(task, tmp_path)
        assert (tmp_path / "animation.mp4").stat().st_size > 500
        frames = sorted(path.name for path in (tmp_path / "animation_frames").iterdir())
        assert frames == [f"{k:04d}.png" for k in range(5)]
        # Frames contain the legend; the overview has the legend beside two moments.
        frame = read_image(tmp_path / "animation_frames" / "0004.png")
        assert frame.shape == (120, 160, 3)
        overview = read_image(tmp_path / "animation.png")
        assert overview.shape[1] == 3 * 160 + 2 * 8
        legend = frame[overview.shape[0] :]
        assert 0 < len(legend) <= 120 // 4
        assert has_hue(legend, 0)  # the sheet's front

    def test_the_overview_has_five_moments_and_a_legend(self, make_task, tmp_path):
        task = make_task("output.pictures.video=none")
        record(task, tmp_path)
        image = read_image(tmp_path / "animation.png")
        assert image.shape == (2 * 120 + 8, 3 * 160 + 2 * 8, 3)
        cells = [
            image[top : top + 120, left : left + 160] for top in (0, 128) for left in (0, 168, 336)
        ]
        legend = cells.pop()
        for color in 255 * np.eye(3, dtype=int):  # of the sheet's front, the ball, the back
            assert (legend == color).all(axis=-1).sum() > 8
        # The times differ, in the same place of each cell; the scene hardly moves.
        for a, b in itertools.pairwise(cells):
            assert (a[:14, :80] != b[:14, :80]).any()
        assert not (tmp_path / "animation.mp4").exists()

    def test_labels_can_be_left_out(self, make_task, tmp_path):
        images = []
        for labels in ("true", "false"):
            task = make_task(
                "output.pictures.sheet=1",
                "output.pictures.video=none",
                f"output.pictures.labels={labels}",
            )
            record(task, tmp_path, [task.initial_state()])
            images.append(read_image(tmp_path / "animation.png"))
        with_labels, without = images
        assert without.shape == (120, 160, 3)
        assert with_labels.shape == (120, 160, 3)
        assert has_hue(with_labels[-12:], 0)  # the sheet's front, in the legend
        assert not has_hue(without[-12:], 0)
        assert (with_labels[:14, :80] < 100).any()
        assert not (without[:14, :80] < 100).any()

    def test_an_overview_can_be_left_out(self, make_task, tmp_path):
        record(make_task("output.pictures.video=gif", "output.pictures.sheet=0"), tmp_path)
        assert (tmp_path / "animation.gif").exists()
        assert not (tmp_path / "animation.png").exists()

    def test_a_gif_can_be_had(self, make_task, tmp_path):
        record(make_task("output.pictures.video=gif"), tmp_path)
        assert (tmp_path / "animation.gif").read_bytes().startswith(b"GIF89a")
        assert not (tmp_path / "animation.mp4").exists()

    @pytest.mark.parametrize(
        ("elevation", "seen", "hidden"),
        [pytest.param(50, 0, 2, id="from-above"), pytest.param(-50, 2, 0, id="from-below")],
    )
    def test_the_sides_of_the_cloth_have_their_colors(
        self, make_task, tmp_path, elevation, seen, hidden
    ):
        task = make_task(
            f"output.pictures.camera.elevation={elevation}",
            "output.pictures.ground=null",
            "output.pictures.sheet=1",
            "output.pictures.video=none",
        )
        record(task, tmp_path, [task.initial_state()])
        image = read_image(tmp_path / "animation.png")
        assert has_hue(image, seen)
        assert not has_hue(image, hidden)
        assert has_hue(image, 1)  # the ball

    def test_pictures_follow_the_motion(self, make_task, tmp_path):
        task = make_task("output.pictures.sheet=2", "output.pictures.video=none")
        state = task.initial_state()
        moved = state.replace(positions=state.positions + 0.5)
        record(task, tmp_path, [state, moved])
        image = read_image(tmp_path / "animation.png")
        assert np.abs(image[20:120, :160] - image[20:120, -160:]).max() > 50

    def test_a_floor_takes_a_shadow(self, make_task, tmp_path):
        lightness = {}
        for ground in ("null", "-0.5"):
            task = make_task(
                f"output.pictures.ground={ground}",
                "output.pictures.labels=false",
                "output.pictures.sheet=1",
                "output.pictures.video=none",
            )
            record(task, tmp_path, [task.initial_state()])
            image = read_image(tmp_path / "animation.png")
            gray = np.ptp(image, axis=-1) < 16
            lightness[ground] = image[gray].min()
        assert lightness["-0.5"] < lightness["null"] - 40

    @pytest.mark.parametrize(
        ("error", "drawn"),
        [
            pytest.param(dc.InfeasibleMotion("no way"), True, id="failed-step"),
            pytest.param(KeyboardInterrupt(), False, id="interrupt"),
        ],
    )
    def test_states_before_a_failed_step_are_drawn(self, make_task, tmp_path, error, drawn):
        task = make_task("output.pictures.video=none")

        def failing():
            yield task.initial_state()
            raise error

        with pytest.raises(type(error)):
            record(task, tmp_path, failing())
        assert (tmp_path / "animation.png").exists() == drawn


@pytest.mark.parametrize(("height", "shades"), [(-0.1, False), (0.0, False), (0.1, True)])
def test_surfaces_above_a_floor_cast_a_shadow(height, shades):
    """A surface that lies on the floor covers it, and has no shadow around itself."""
    shadows = []
    floor = SimpleNamespace(height=0.0, half_side=1.0, center=np.zeros(2), shade=shadows.append)
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.2 + [0, 0, height]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    Shadow(floor, np.array([0.3, 0.1, 1.0])).cast([(square, faces)])
    assert bool(shadows[0].any()) == shades


# --- without a configuration --------------------------------------------------------------------


@pytest.fixture(scope="module")
def landing():
    """A sheet on a ball above a floor, which is drawn as a floor."""
    sheet = dc.Cloth.grid(7, 7, 0.5, pose=[0, 0, 0.31, 1, 0, 0, 0], name="sheet")
    floor = dc.RigidBody.plane(9.0, name="floor")
    ball = dc.RigidBody.sphere(0.15, subdivisions=1, pose=[0, 0, 0.15, 1, 0, 0, 0], name="ball")
    scene = dc.Scene([sheet], [floor, ball])
    simulator = dc.Simulator(scene, 0.02)
    with torch.no_grad():
        start = simulator.initial_state()
        return scene, [start, *simulator.rollout(start, steps=4)]


@pytest.mark.usefixtures("pictures")
class TestRender:
    def test_the_ending_selects_the_kind_of_picture(self, landing, tmp_path):
        scene, states = landing
        for name in ("a.mp4", "b.gif", "c.png"):
            dc.render(scene, states, tmp_path / name, size=(160, 120))
        assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mp4", "b.gif", "c.png"]
        assert read_image(tmp_path / "c.png").shape == (248, 496, 3)

    def test_an_animation_takes_as_long_as_the_motion(self, landing, tmp_path):
        import imageio.v2 as imageio

        scene, states = landing
        dc.render(scene, states, tmp_path / "a.mp4", size=(160, 120))
        with imageio.get_reader(tmp_path / "a.mp4") as video:
            assert video.get_meta_data()["fps"] == pytest.approx(50)
            assert video.count_frames() == 5

    def test_contact_forces_are_drawn_on_request(self, landing, tmp_path):
        scene, states = landing
        assert states[-1].body_forces.any()
        reds = {}
        for forces in (False, True):
            file = tmp_path / f"{forces}.png"
            dc.render(scene, states[-1], file, size=(320, 240), labels=False, contact_forces=forces)
            image = read_image(file)
            reds[forces] = (image[..., 0] > 2 * image[..., 1:].max(axis=-1)).sum()
        assert reds[False] == 0
        assert reds[True] > 50

    def test_arrows_are_the_forces_on_shown_surfaces(self, landing, tmp_path):
        scene, states = landing
        pictures = Pictures(contact_forces=True, video="none")
        viewer = Record(tmp_path, scene, fps=10, pictures=pictures)
        for state in states:
            viewer.show(state)
        arrows, entries = viewer._arrows(2.0)
        forces = states[-1].body_forces.numpy()[4:]  # without the forces of the floor
        largest = max(
            np.linalg.norm(state.body_forces.numpy()[4:], axis=1).max() for state in states
        )
        np.testing.assert_allclose(arrows[-1], forces * 0.2 * 2.0 / largest)
        assert entries[-1].text == f"contact force, longest {largest:.3g} N"

    @pytest.mark.parametrize(
        ("change", "error", "message"),
        [
            pytest.param({"path": "a.avi"}, dc.InvalidInput, "must end in .mp4", id="ending"),
            pytest.param({"path": "no/a.png"}, dc.InvalidInput, "folder of `path`", id="folder"),
            pytest.param({"states": []}, dc.InvalidInput, "at least one state", id="none"),
            pytest.param({"states": [3]}, TypeError, r"got int at \[0\]", id="type"),
            pytest.param({"size": (64.0, 66.0)}, dc.InvalidInput, "two even numbers", id="float"),
            pytest.param({"size": "ab"}, dc.InvalidInput, "two even numbers", id="words"),
            pytest.param({"states": 3}, TypeError, "`states` must be states", id="no states"),
            pytest.param({"moments": 1.5}, TypeError, "`moments`", id="share of a moment"),
            pytest.param({"size": (64.5, 66)}, dc.InvalidInput, "two even numbers", id="share"),
            pytest.param({"fps": "fast"}, TypeError, "`fps`", id="fps in words"),
            pytest.param({"moments": 0}, dc.InvalidInput, "`moments`", id="moments"),
            pytest.param({"size": (161, 120)}, dc.InvalidInput, "two even numbers", id="size"),
            pytest.param({"size": 160}, dc.InvalidInput, "two even numbers", id="one size"),
            pytest.param({"camera": 3}, TypeError, "`camera` must be a Camera", id="camera"),
            pytest.param({"fps": 0}, dc.InvalidInput, "`fps`", id="fps"),
        ],
    )
    def test_arguments_are_checked(self, landing, tmp_path, change, error, message):
        scene, states = landing
        arguments = {"states": states, "path": "a.png", **change}
        path = tmp_path / arguments.pop("path")
        with pytest.raises(error, match=message):
            dc.render(scene, arguments.pop("states"), path, **arguments)
        assert not list(tmp_path.iterdir())

    def test_states_must_be_of_the_scene(self, landing, tmp_path):
        scene, states = landing
        other = dc.Simulator(dc.Scene([dc.Cloth.grid(3, 3)]), 0.01).initial_state()
        with pytest.raises(dc.InvalidInput, match=r"states\[1\] must be of this scene"):
            dc.render(scene, [states[0], other], tmp_path / "a.png")
        with pytest.raises(dc.InvalidInput, match=r"states\[0\] is a batch"):
            dc.render(scene, dc.stack(states), tmp_path / "a.png")
        with pytest.raises(TypeError, match="`scene` must be a Scene, got Simulator"):
            dc.render(dc.Simulator(scene, 0.01), states, tmp_path / "a.png")
        wrong = states[0].positions.clone()
        wrong[1, 2] = float("nan")
        with pytest.raises(dc.InvalidInput, match=r"states\[0\] must be finite, its `positions`"):
            dc.render(scene, states[0].replace(positions=wrong), tmp_path / "a.png")
        hand = dc.Robot.load(dc.robots.GRIPPER, actuation="position")
        other = dc.Scene(scene.cloths, scene.bodies, [hand])
        with pytest.raises(dc.InvalidInput, match="whose `joint_positions` have shape"):
            dc.render(other, states[0], tmp_path / "a.png")


def test_a_missing_package_is_named_before_anything_runs(make_task, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)  # as if it were not installed
    with pytest.raises(dc.InvalidInput, match=r"pip install 'diffcloth-torch\[viewer\]'"):
        open_task(make_task(), tmp_path)
    open_task(make_task("output.viewers=[meshes]"), tmp_path)


def test_a_loss_curve_is_a_picture(tmp_path):
    draw_loss_curve(tmp_path / "loss.png", [0.5, 0.2, 0.3, 0.1])
    image = read_image(tmp_path / "loss.png")
    assert (image < 128).any()
    assert image.shape == (600, 960, 3)


# --- Scenes without a cloth, and with many bodies -------------------------------------------------

FALLING = {"motion": "dynamic", "mass": 1.0}
BARRIER = dc.ContactOptions(barrier_distance=0.003)


def scenes_without_cloth():
    ball = dc.RigidBody.sphere(0.2, subdivisions=1, pose=[0, 0, 1, 1, 0, 0, 0], **FALLING)
    hand = dc.Robot.load(dc.robots.GRIPPER, base="floating", actuation="position")
    return {
        "body": dc.Scene([], [ball]),
        "body and floor": dc.Scene([], [ball, dc.RigidBody.plane(3.0)]),
        "robot": dc.Scene([], robots=[hand]),
        "both": dc.Scene([], [ball], [hand]),
    }


@pytest.mark.quick(
    "one.png-1-body", "one.png-1-both", "few.png-3-robot", "film.gif-1-body and floor"
)
@pytest.mark.parametrize("name", scenes_without_cloth())
@pytest.mark.parametrize(("file", "moments"), [("one.png", 1), ("few.png", 3), ("film.gif", 1)])
@pytest.mark.usefixtures("pictures")
def test_scenes_without_a_cloth_are_drawn(name, file, moments, tmp_path):
    simulator = dc.Simulator(scenes_without_cloth()[name], 0.01, contact=BARRIER)
    start = simulator.initial_state()
    states = [start, *simulator.rollout(start, steps=2)]
    path = tmp_path / file
    options = {"size": (160, 120), "labels": False, "moments": moments, "contact_forces": True}
    dc.render(simulator.scene, states, path, **options)
    image = read_image(path)
    # Dark pixels show an object; the floor and the background are much lighter.
    assert (image[..., :3].max(axis=-1) < 170).mean() > 0.01


@pytest.mark.usefixtures("pictures")
def test_a_scene_without_any_surface_is_refused(tmp_path):
    file = tmp_path / "bare.urdf"
    file.write_text(
        '<robot name="bare"><link name="stone"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    robot = dc.Robot.load(file, base="floating")
    simulator = dc.Simulator(dc.Scene([], robots=[robot]), 0.01)
    with pytest.raises(dc.InvalidInput, match="the scene must have a surface"):
        dc.render(simulator.scene, simulator.initial_state(), tmp_path / "x.png")


@pytest.mark.parametrize("kind", ["png", "gif", "mp4"])
@pytest.mark.usefixtures("pictures")
def test_a_folder_in_the_place_of_a_picture_is_refused_before_the_work(tmp_path, kind):
    scene = dc.Scene([dc.Cloth.grid(3, 3)])
    state = dc.Simulator(scene, 0.01).initial_state()
    (tmp_path / f"x.{kind}").mkdir()
    with pytest.raises(dc.InvalidInput, match=rf"x\.{kind} must be no folder"):
        dc.render(scene, state, tmp_path / f"x.{kind}")
    other = "gif" if kind == "png" else "png"
    dc.render(scene, state, tmp_path / f"x.{other}", size=(64, 64))


def lab(color):
    """CIELAB of "#rrggbb" in daylight: equal distances look about equally different."""
    srgb = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]] @ linear
    ratio = xyz / [0.9505, 1.0, 1.089]
    f = np.where(ratio > 0.008856, np.cbrt(ratio), 7.787 * ratio + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_the_palette_tells_ten_bodies_apart():
    """A color distance of about 2 is visible side by side, a distance of 10 at a glance."""
    bodies = [Paint().for_body(i).color for i in range(10)]
    cloths = [Paint().for_cloth(i) for i in range(4)]
    others = [color for paint in cloths for color in (paint.color, paint.back_color)]
    others += [GOAL_COLOR, FORCE_COLOR, BACKGROUND]
    for i, color in enumerate(bodies):
        for other in [*bodies[:i], *others]:
            assert np.linalg.norm(lab(color) - lab(other)) > 20, (color, other)


class TestCamera:
    def test_directions_are_a_position(self):
        center, radius = np.array([1.0, 2.0, 3.0]), 2.0
        camera = dc.Camera(azimuth=90.0, elevation=30.0, zoom=2.0, field_of_view=60.0)
        position, target = camera.place(center, radius)
        distance = radius / np.sin(np.radians(30)) / 2
        towards = [np.cos(np.radians(30)), 0.0, np.sin(np.radians(30))]  # 90 looks along -x
        np.testing.assert_allclose(position, center + distance * np.array(towards), atol=1e-14)
        np.testing.assert_array_equal(target, center)

    def test_a_position_is_taken_as_it_is(self):
        camera = dc.Camera(position=[4, 0, 1], target=[0, 0, 1])
        position, target = camera.place(np.zeros(3), 1.0)
        assert (position.tolist(), target.tolist()) == ([4, 0, 1], [0, 0, 1])

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"position": [0, 0, 1]}, "not in the direction of `up`"),
            ({"position": [0, 0, 0]}, "apart from `target`"),
            ({"position": [1, 2]}, r"`position` must have shape \[3\], got \[2\]"),
            ({"up": [0, 0, 0]}, "`up` must be a direction"),
            ({"up": [0, 0, float("nan")]}, "`up` must be finite"),
            ({"field_of_view": 180.0}, "`field_of_view` must be between 0 and 180"),
            ({"zoom": 0.0}, "`zoom` must be finite and > 0"),
            ({"elevation": 90.0}, "`elevation` must be between -90 and 90"),
        ],
    )
    def test_a_wrong_camera_is_refused(self, changes, message):
        with pytest.raises(dc.InvalidInput, match=message):
            dc.Camera(**{"target": [0, 0, 0], **changes})

    def test_a_camera_sees_the_objects_in_front(self, tmp_path):
        """A red sheet to the right of a green one, seen from both sides, and upside down."""
        pytest.importorskip("pyvista")
        up = [0.7071, 0.7071, 0, 0]  # stands upright
        cloths = [
            dc.Cloth.grid(3, 3, 0.5, pose=[x, 0, 0, *up], name=name)
            for name, x in (("left", -0.5), ("right", 0.5))
        ]
        state = dc.Simulator(dc.Scene(cloths), 0.01).initial_state()
        paints = {"left": Paint("#00ff00", "#00ff00"), "right": Paint("#ff0000", "#ff0000")}
        views = {
            "front": ([0, -4, 0.1], (0, 0, 1), 1),
            "back": ([0, 4, 0.1], (0, 0, 1), -1),
            "upside_down": ([0, -4, 0.1], (0, 0, -1), -1),
        }
        for name, (position, top, side) in views.items():
            camera = dc.Camera(position=position, target=[0, 0, 0], up=top, field_of_view=30.0)
            pictures = Pictures(
                size=(160, 120), video="none", sheet=1, labels=False, ground=None, camera=camera
            )
            scene = dc.Scene(cloths)
            with Record(tmp_path, scene, fps=1, pictures=pictures, paints=paints, name=name) as v:
                v.show(state)
            image = read_image(tmp_path / f"{name}.png").astype(float)
            redness = (image[..., 0] - image[..., 1]).sum(0)
            assert side * np.corrcoef(redness, np.arange(len(redness)))[0, 1] > 0.2, name
