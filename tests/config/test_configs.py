"""Configurations: accepted and refused values, and the error messages."""

from __future__ import annotations

import math
import re
import types
from pathlib import Path

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.config.documents import read_document, resolve_path, set_values
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.robots import GRIPPER
from diffcloth_torch.tasks.registry import load_task, read_config
from diffcloth_torch.tasks.simulation import simulate

F64 = torch.float64
CONFIGS = Path(__file__).parents[2] / "configs"

MINIMAL = """
task: drape
simulation: {dt: 1e-2, steps: 3}
scene:
  cloths:
    - {name: sheet, shape: {kind: grid, rows: 3, columns: 3}}
"""


@pytest.fixture
def write(tmp_path):
    def write_config(text: str) -> Path:
        path = tmp_path / "config.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write_config


@pytest.mark.parametrize(
    ("text", "value"),
    [
        pytest.param("1e-3", 1e-3, id="no-dot"),
        pytest.param("1.5e3", 1.5e3, id="unsigned-exponent"),
        pytest.param("-2E+4", -2e4, id="capital"),
        pytest.param(".5e-1", 0.05, id="no-leading-digit"),
        pytest.param("1.", 1.0, id="trailing-dot"),
        pytest.param("7", 7, id="integer"),
        pytest.param("'1e-3'", "1e-3", id="quoted-stays-text"),
        pytest.param("1e", "1e", id="no-number"),
        pytest.param("e3", "e3", id="no-digits"),
    ],
)
def test_scientific_notation_is_a_number(write, text, value):
    read = read_document(write(f"x: {text}"))["x"]
    assert read == value
    assert type(read) is type(value)


def test_a_duplicate_key_is_refused_with_its_line(write):
    with pytest.raises(InvalidInput, match=r"line 2: .*duplicate key \"steps\""):
        read_document(write("a: {steps: 1,\n  steps: 2}"))


def test_a_tag_that_builds_objects_is_refused(write):
    with pytest.raises(InvalidInput, match="not readable as YAML"):
        read_document(write("x: !!python/object/apply:os.getcwd []"))


@pytest.mark.parametrize("text", ["", "[1, 2]", "just text"])
def test_a_file_without_a_mapping_is_refused(write, text):
    with pytest.raises(InvalidInput, match="must be a mapping"):
        read_document(write(text))


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InvalidInput, match=r"nowhere\.yaml: there is no such file"):
        read_document(tmp_path / "nowhere.yaml")


def test_a_minimal_configuration_takes_the_defaults(write):
    config = read_config(write(MINIMAL))
    assert config.simulation.dt == 0.01
    assert config.simulation.scheme == "coupled"
    assert config.scene.cloths[0].material.stretch is None


REFUSED = [
    pytest.param(
        "simulation.stps=3",
        r"`simulation` has no key `stps` \(did you mean `steps`\?\)"
        r"; its keys are dt, steps, scheme",
        id="unknown-key",
    ),
    pytest.param("sceen={}", r"the file has no key `sceen`.*`scene`", id="unknown-top"),
    pytest.param(
        "simulation.dt=0", r"`simulation\.dt` must be greater than 0, got 0", id="zero-dt"
    ),
    pytest.param("simulation.dt=.nan", r"`simulation\.dt` must be a finite number", id="nan"),
    pytest.param(
        "simulation.dt=soon",
        r"`simulation\.dt` must be a valid number, got the text 'soon'",
        id="text-for-number",
    ),
    pytest.param(
        "simulation.steps=1.5", r"`simulation\.steps` must be a valid integer", id="fraction"
    ),
    pytest.param(
        "simulation.steps=true", r"`simulation\.steps` must be a valid integer", id="bool"
    ),
    pytest.param(
        "simulation.scheme=implicit",
        r"`simulation\.scheme` must be 'coupled', 'split' or 'projective', got 'implicit'",
        id="scheme",
    ),
    pytest.param(
        "scene.cloths.sheet.shape.kind=square",
        r"`scene\.cloths\[0\]\.shape` must have as `kind` one of 'grid', 'disk', 'strip', 'load'",
        id="shape",
    ),
    pytest.param(
        "scene.cloths.sheet.shape.rows=1",
        r"`scene\.cloths\[0\]\.shape\.rows` must be greater than or equal to 2, got 1",
        id="rows",
    ),
    pytest.param(
        "scene.cloths.sheet.shape={kind: grid, rows: 3}",
        r"`scene\.cloths\[0\]\.shape\.columns` is missing",
        id="missing",
    ),
    pytest.param(
        "scene.cloths.sheet.material.poisson=0.5",
        r"`scene\.cloths\[0\]\.material\.poisson` must be less than 0\.5",
        id="poisson",
    ),
    pytest.param(
        "scene.cloths.sheet.pose={axis: [0, 0, 1]}",
        r"`scene\.cloths\[0\]\.pose` must give `axis` and `degrees` together",
        id="axis",
    ),
    pytest.param(
        "scene.cloths.sheet.pins={a: {vertices: [0], nearest: [[0, 0, 0]]}}",
        r"pins\.a` must have exactly one of vertices, box, nearest",
        id="two-selections",
    ),
    pytest.param("scene.cloths=[]", r"`scene` must have a cloth in `cloths` unless", id="no-cloth"),
    pytest.param("scene.gravity=[0, 0]", r"`scene\.gravity`.*3", id="short-vector"),
    pytest.param(
        "output.pictures.ground=low",
        r"`output\.pictures\.ground` must be a valid number or must be 'auto'",
        id="union",
    ),
    pytest.param(
        "task=dance",
        r"`task` must be one of drape, hit_cloth, push_cube, grasp_cloth, two_cloths, "
        r"control_points, identify; got 'dance'",
        id="task",
    ),
]


@pytest.mark.parametrize(("assignment", "message"), REFUSED)
def test_a_bad_value_is_refused_by_name(write, assignment, message):
    with pytest.raises(InvalidInput, match=message) as caught:
        read_config(write(MINIMAL), [assignment])
    assert str(caught.value).startswith(str(write(MINIMAL)))
    assert "\n" not in str(caught.value)


def test_a_body_with_a_trajectory_must_be_kinematic(write):
    body = "{name: b, shape: {kind: box, size: 1}, trajectory: [{time: 1}]}"
    with pytest.raises(InvalidInput, match=r"`scene\.bodies\[0\]` has a `trajectory` and must"):
        read_config(write(MINIMAL), [f"scene.bodies=[{body}]"])


def test_nodal_contact_and_its_scheme_are_read(write):
    bodies = (
        "  bodies:\n    - {name: ball, shape: {kind: sphere, radius: 0.1}, nodal_contact: true,"
    )
    text = MINIMAL.replace("steps: 3", "steps: 3, scheme: projective") + bodies
    task = load_task(write(text + " pose: {position: [0, 0, -1]}}\n"))
    assert task.simulator.scheme == "projective"
    assert task.scene.bodies[0].nodal_contact


@pytest.mark.parametrize("shape", ["sphere, radius: 0.1", "capsule, radius: 0.1, length: 0.2"])
def test_smooth_bodies_are_read(write, shape):
    bodies = f"  bodies:\n    - {{name: ball, shape: {{kind: {shape}, smooth: true}},"
    task = load_task(write(MINIMAL + bodies + " pose: {position: [0, 0, -1]}}\n"))
    assert task.scene.bodies[0].smooth


def test_a_cylinder_has_as_many_sides_as_asked_for(write):
    shape = "{kind: cylinder, radius: 0.1, length: 0.2, rings: 8}"
    body = f"  bodies:\n    - {{name: can, shape: {shape}, pose: {{position: [0, 0, -1]}}}}\n"
    (can,) = load_task(write(MINIMAL + body)).scene.bodies
    on_rim = (can.vertices[:, 2] == 0.1) & (np.hypot(*can.vertices.T[:2]) > 0.0999)
    assert on_rim.sum() == 48


def test_a_cylinder_is_not_smooth(write):
    shape = "{kind: cylinder, radius: 0.1, length: 0.2, smooth: true}"
    bodies = f"  bodies:\n    - {{name: ball, shape: {shape}}}\n"
    with pytest.raises(InvalidInput, match="smooth"):
        load_task(write(MINIMAL + bodies))


def test_keyframes_must_come_in_order(write):
    body = (
        "{name: b, shape: {kind: box, size: 1}, motion: kinematic, "
        "trajectory: [{time: 2}, {time: 1}]}"
    )
    with pytest.raises(InvalidInput, match=r"increasing times in `trajectory`, got \[2"):
        read_config(write(MINIMAL), [f"scene.bodies=[{body}]"])


def test_set_changes_values_by_name_and_by_index(write):
    config = read_config(
        write(MINIMAL),
        [
            "simulation.dt=1e-3",
            "scene.cloths.sheet.shape.rows=5",
            "scene.cloths.0.material.stretch=1e3",
            "output.viewers=[meshes]",
        ],
    )
    assert config.simulation.dt == 1e-3
    assert config.scene.cloths[0].shape.rows == 5
    assert config.scene.cloths[0].material.stretch == 1e3
    assert config.output.viewers == ["meshes"]


def test_set_leaves_the_document_alone():
    document = {"a": {"b": [1, 2]}}
    assert set_values(document, ["a.b.1=5", "a.c.d=6"]) == {"a": {"b": [1, 5], "c": {"d": 6}}}
    assert document == {"a": {"b": [1, 2]}}


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        pytest.param("simulation.dt", "must be key=value", id="no-value"),
        pytest.param("=3", "must be key=value", id="no-key"),
        pytest.param("simulation.dt=[", "not YAML", id="broken-yaml"),
        pytest.param(
            "scene.cloths.shirt.name=x",
            "items of the list are 0 .. 0, sheet; got `shirt`",
            id="unknown-item",
        ),
        pytest.param("task.name=x", "below a plain value", id="below-a-value"),
    ],
)
def test_a_bad_assignment_is_refused(write, assignment, message):
    with pytest.raises(InvalidInput, match=message):
        read_config(write(MINIMAL), [assignment])


class TestRoot:
    @pytest.fixture
    def files(self, tmp_path):
        for name in ("project/configs/a.yaml", "project/meshes/m.obj", "secret.obj"):
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("", encoding="utf-8")
        return tmp_path

    def test_a_file_under_the_root_is_found(self, files):
        config = files / "project/configs/a.yaml"
        found = resolve_path(config, "..", "../meshes/m.obj")
        assert found == (files / "project/meshes/m.obj").resolve()

    @pytest.mark.parametrize("given", ["../../secret.obj", "../meshes/../../secret.obj"])
    def test_a_file_elsewhere_is_refused(self, files, given):
        config = files / "project/configs/a.yaml"
        with pytest.raises(InvalidInput, match=r"must lie under the root.*`root`"):
            resolve_path(config, "..", given)

    def test_a_link_does_not_lead_out(self, files):
        link = files / "project/meshes/link.obj"
        link.symlink_to(files / "secret.obj")
        with pytest.raises(InvalidInput, match="must lie under the root"):
            resolve_path(files / "project/configs/a.yaml", "..", "../meshes/link.obj")

    @pytest.mark.parametrize(("root", "given"), [("..", "../meshes/a.obj"), ("a.obj", "m.obj")])
    def test_links_in_a_circle_are_refused(self, files, root, given):
        for folder in (files / "project/meshes", files / "project/configs"):
            (folder / "a.obj").symlink_to(folder / "b.obj")
            (folder / "b.obj").symlink_to(folder / "a.obj")
        with pytest.raises(InvalidInput, match=r"a\.yaml: the path '.*a\.obj' cannot be resolved"):
            resolve_path(files / "project/configs/a.yaml", root, given)

    def test_an_absolute_path_elsewhere_is_refused(self, files):
        with pytest.raises(InvalidInput, match="must lie under the root"):
            resolve_path(files / "project/configs/a.yaml", "..", str(files / "secret.obj"))

    def test_a_missing_file_is_named(self, files):
        with pytest.raises(InvalidInput, match=r"there is no file 'x\.obj'"):
            resolve_path(files / "project/configs/a.yaml", ".", "x.obj")


MOVING = """
task: drape
simulation: {dt: 0.01, steps: 4, coupling: rigid_to_cloth, contact: {barrier_distance: 0.002}}
scene:
  cloths:
    - {name: sheet, shape: {kind: grid, rows: 3, columns: 3, size: 0.2}, pins: {a: {vertices: [0]}}}
  bodies:
    - {name: ball, shape: {kind: cylinder, radius: 0.05, length: 0.1}, motion: dynamic, mass: 0.3,
       pose: {position: [0, 0, 0.5]}}
    - {name: crate, shape: {kind: box, size: 0.1}, motion: dynamic, density: 100,
       pose: {position: [1, 0, 0.5]}, inertia: [[1, 0, 0], [0, 1, 0], [0, 0, 1.5]]}
  robots:
    - {name: left, model: gripper, base: kinematic, pose: {position: [-1, 0, 0]}, stiffness: 100,
       damping: {left_finger_joint: 2}, joint_positions: 0.01, friction: {palm: 0.9},
       effort_limits: 30, velocity_limits: {left_finger_joint: 0.5, right_finger_joint: false},
       joint_friction: false,
       trajectory: [{time: 0.02, position: [-1, 0, 0.01]}],
       joint_trajectories: {left_finger_joint: [{time: 0.02, value: 0.03}]}}
    - {name: right, model: gripper, pose: {position: [2, 0, 0]},
       actuation: {left_finger_joint: velocity, right_finger_joint: torque},
       joint_trajectories: {left_finger_joint: [{time: 0, value: 0.2}],
                            right_finger_joint: [{time: 0.04, value: 4}]}}
  ignore_contact: [[ball, left/palm], [sheet, crate]]
"""


def test_dynamic_bodies_and_robots_are_built(write):
    path = write(MOVING)
    task = load_task(path, [])
    scene = task.scene
    assert [body.motion for body in scene.bodies] == ["dynamic", "dynamic"]
    assert scene.bodies[0].mass == 0.3
    assert scene.bodies[1].inertia[2, 2] == 1.5
    assert scene.bodies[1].mass == pytest.approx(0.1)
    left, right = scene.robots
    assert (left.mechanism.base, right.mechanism.base) == ("kinematic", "fixed")
    assert left.damping.tolist() == [2, 0]
    assert left.joint_positions.tolist() == [0.01, 0.01]
    assert left.friction.tolist() == [0.9, 0.4, 0.4]
    assert left.effort_limits.tolist() == [30, 30]
    assert left.velocity_limits.tolist() == [0.5, float("inf")]
    assert left.joint_friction.tolist() == [0, 0]
    assert right.mechanism.actuation == ("velocity", "torque")
    assert scene.ignore_contact == (("ball", "left/palm"), ("sheet", "crate"))
    assert task.simulator.coupling == "rigid_to_cloth"


def test_bases_and_joints_follow_their_keyframes(write):
    task = load_task(write(MOVING), [])
    controller = task.controller({})
    controls = [controller(k, None) for k in range(4)]
    assert all(control.body_poses is None for control in controls)
    bases = torch.stack([control.base_poses["left"] for control in controls])
    torch.testing.assert_close(bases[:, 2], torch.tensor([0.005, 0.01, 0.01, 0.01], dtype=F64))

    def values(field, name):
        return [float(getattr(control, field)[name]) for control in controls]

    positions = values("joint_positions", "left/left_finger_joint")
    assert positions == pytest.approx([0.02, 0.03, 0.03, 0.03])
    assert values("joint_velocities", "right/left_finger_joint") == [0.2] * 4
    efforts = values("joint_efforts", "right/right_finger_joint")
    assert efforts == pytest.approx([1.0, 2.0, 3.0, 4.0])
    end = list(simulate(task))[-1]
    assert end.base_poses[0, 2] == 0.01
    assert end.joint_positions[2] == pytest.approx(4 * 0.01 * 0.2)


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("scene.bodies.ball.mass=-1", r"`scene\.bodies\[0\]\.mass` must be greater than 0"),
        ("scene.bodies.ball.density=2", "`density` or `mass`, one of them, got both"),
        ("scene.bodies.ball.motion=static", "`mass` needs motion="),
        ("scene.bodies.ball.trajectory=[{time: 1}]", "must have `motion: kinematic` for it"),
        ("scene.robots.left.path=x.urdf", "exactly one of path, model, got path, model"),
        ("scene.robots.left.mesh_root=.", "must have a `path` for it"),
        ("scene.robots.left.base=fixed", "must have `base: kinematic` for it"),
        ("scene.robots.left.actuation=servo", "`scene.robots.0..actuation` must be 'position'"),
        ("scene.robots.left.name=ball", "the name 'ball' must be given once"),
        ("scene.robots.left.stiffness={thumb: 1}", "has the names .*'thumb'"),
        ("scene.robots.left.effort_limits={thumb: false}", "has the names .*'thumb'"),
        ("scene.robots.left.velocity_limits=-1", "`velocity_limits` must be finite and > 0"),
        ("scene.robots.left.joint_friction=true", r"joint_friction\S* must be"),
        (
            "scene.robots.left.joint_trajectories={thumb: [{time: 1, value: 1}]}",
            "may name its joints 'left_finger_joint', 'right_finger_joint'; got 'thumb'",
        ),
        ("scene.ignore_contact=[[ball, moon]]", "`ignore_contact` .*'moon'"),
        ("simulation.coupling=loose", "must be 'monolithic', 'rigid_to_cloth' or 'cloth_to_rigid'"),
    ],
)
def test_bad_bodies_and_robots_are_refused(write, assignment, message):
    with pytest.raises(InvalidInput, match=message):
        load_task(write(MOVING), [assignment])


def test_a_robot_is_read_from_a_file_under_the_root(write, tmp_path):
    (tmp_path / "hand.urdf").write_bytes(GRIPPER.read_bytes())
    changes = ["scene.robots.left.model=null", "scene.robots.left.path=hand.urdf"]
    scene = load_task(write(MOVING), changes).scene
    assert scene.robots[0].link_names == scene.robots[1].link_names
    with pytest.raises(InvalidInput, match="must lie under the root"):
        load_task(write(MOVING), [changes[0], "scene.robots.left.path=../hand.urdf"])
    with pytest.raises(InvalidInput, match=r"the folder '\.\./' must lie under the root"):
        load_task(write(MOVING), [*changes, "scene.robots.left.mesh_root=../"])


def test_meshes_of_a_robot_lie_under_the_root(write, tmp_path):
    mesh = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    text = GRIPPER.read_text()
    changes = ["scene.robots.left.model=null", "scene.robots.left.path=hand.urdf"]
    for folder, name in ((tmp_path, "in.obj"), (tmp_path.parent, "out.obj")):
        (folder / name).write_text(mesh)
        path = f'<mesh filename="{folder / name}"/>'
        (tmp_path / "hand.urdf").write_text(
            re.sub("(<collision>.*?)<box [^>]*>", rf"\1{path}", text, count=1, flags=re.DOTALL)
        )
        if name == "in.obj":
            robot = load_task(write(MOVING), changes).scene.robots[0]
            assert [len(surface.faces) for surface in robot.surfaces] == [1, 12, 12]
    with pytest.raises(InvalidInput, match="must stay inside `mesh_root`"):
        load_task(write(MOVING), changes)


def test_pairs_that_overlap_may_be_ignored_by_a_word(write):
    word = "overlapping"
    changes = [f"scene.ignore_contact={word}", f"scene.robots.left.ignore_contact={word}"]
    scene = load_task(write(MOVING), changes).scene
    assert scene.ignore_contact == scene.robots[0].ignore_contact == word
    with pytest.raises(InvalidInput, match="ignore_contact"):
        load_task(write(MOVING), ["scene.ignore_contact=touching"])


# Configurations of `diffcloth train` have a separate schema.
SHIPPED = [path for path in sorted(CONFIGS.glob("*.yaml")) if not path.stem.startswith("train_")]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_the_shipped_configurations_fit_the_schema(path):
    config = read_config(path)
    assert math.isfinite(config.simulation.dt)


@pytest.mark.filterwarnings("error::diffcloth_torch.BarrierStartWarning")
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_no_shipped_configuration_is_thrown_by_the_barrier(path):
    if "equilibrium: true" in path.read_text():
        pytest.skip("fits take equilibria of it, and no step")
    if path.stem == "panda_pick":
        try:
            dc.robots.panda()
        except ImportError as error:
            pytest.skip(str(error))
    simulator = load_task(path, []).simulator
    assert simulator.step(simulator.initial_state()).report.converged


# --- From Python ---------------------------------------------------------------------------------


def test_a_configuration_gives_scene_simulator_and_task():
    loaded = dc.load_config(CONFIGS / "drape.yaml", ["simulation.steps=2", "simulation.dt=0.005"])
    scene, simulator, task = loaded
    assert (loaded.scene, loaded.simulator, loaded.task) == (scene, simulator, task)
    assert simulator.scene is scene
    assert task.simulator is simulator
    assert (simulator.dt, task.steps, task.config.task) == (0.005, 2, "drape")
    assert scene.cloth_names == ("tablecloth",)
    with torch.no_grad():
        controller = task.controller(task.actions())
        states = simulator.rollout(task.initial_state(), controller, steps=task.steps)
    # The command line simulates the same.
    for state, expected in zip(states, [*simulate(task)][1:], strict=True):
        assert torch.equal(state.positions, expected.positions)
    assert len(repr(loaded)) < 300
    assert "task='drape', 2 steps" in repr(loaded)


def test_a_name_of_a_file_will_do():
    assert dc.load_config(str(CONFIGS / "drape.yaml")).task.steps == 150


def test_a_configuration_may_be_a_dict():
    document = read_document(CONFIGS / "drape.yaml")
    loaded = dc.load_config(document, ["simulation.steps=2"])
    expected = dc.load_config(CONFIGS / "drape.yaml", ["simulation.steps=2"])
    assert loaded.task.config == expected.task.config
    start, expected_start = loaded.task.initial_state(), expected.task.initial_state()
    assert torch.equal(start.positions, expected_start.positions)
    assert document == read_document(CONFIGS / "drape.yaml")
    short = {
        key: v for key, v in read_document(CONFIGS / "hit_cloth.yaml").items() if key != "scene"
    }
    assert dc.load_config(types.MappingProxyType(short)).scene.body_names  # the scene of the task


def test_a_dict_names_files_from_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("sheet.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    cloths = [{"name": "sheet", "shape": {"kind": "load", "path": "sheet.obj", "scale": 0.1}}]
    document = {
        "task": "drape",
        "simulation": {"dt": 0.01, "steps": 1},
        "scene": {"cloths": cloths},
    }
    (sheet,) = dc.load_config(document).scene.cloths
    assert sheet.vertices.max() == 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        pytest.param({"task": "none"}, "dict: `task` must be one of", id="task"),
        pytest.param({"steps": 3}, "dict: the file has no key `steps`", id="key"),
        pytest.param({3: 4}, "load_config: a key must be text, got 3", id="number"),
        pytest.param(
            {"scene": np.eye(3)},
            "load_config: `scene` must hold text or numbers, got a ndarray",
            id="array",
        ),
        pytest.param(
            {"simulation": {"dt": "1e-2", "steps": 3}},
            "`simulation.dt` must be a valid number, got the text '1e-2'",
            id="number as text",
        ),
    ],
)
def test_a_dict_that_is_not_accepted(change, message):
    with pytest.raises(InvalidInput, match=message):
        dc.load_config(read_document(CONFIGS / "drape.yaml") | change)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        pytest.param(("none.yaml",), InvalidInput, "none.yaml: there is no such file", id="file"),
        pytest.param((5,), TypeError, "`path` must be a string or a Path, got int", id="path"),
        pytest.param(
            (CONFIGS / "drape.yaml", "simulation.steps=2"),
            TypeError,
            "`assignments` must be a list of",
            id="text",
        ),
        pytest.param(
            (CONFIGS / "drape.yaml", [3]), TypeError, "`assignments` must be a list of", id="number"
        ),
        pytest.param(
            (CONFIGS / "drape.yaml", ["simulation.dt=-1"]),
            InvalidInput,
            "simulation.dt",
            id="value",
        ),
    ],
)
def test_a_configuration_that_is_not_accepted(arguments, error, message):
    with pytest.raises(error, match=message):
        dc.load_config(*arguments)


ATTACHED = """
task: drape
simulation: {dt: 0.01, steps: 4, contact: {barrier_distance: 0.002}}
scene:
  gravity: [0, 0, 0]
  cloths:
    - {name: sheet, shape: {kind: grid, rows: 3, columns: 3, size: 0.2}}
    - {name: other, shape: {kind: grid, rows: 3, columns: 3, size: 0.2},
       pose: {position: [0, 0, 0.1]}}
  bodies:
    - {name: crate, shape: {kind: box, size: 0.1}, pose: {position: [1, 0, 0.5]}}
  attachments:
    - {name: seam, a: {surface: sheet, vertices: [0, 3]}, b: {surface: other, vertices: [0, 3]},
       stiffness: 5, rest_length: 0.1,
       weight_trajectory: [{time: 0, value: 1}, {time: 0.04, value: 0}]}
    - {name: grasp, a: {surface: sheet, nearest: [[0.1, 0.1, 0]]},
       b: {surface: crate, points: [[0, 0, 0.05]]}, stiffness: 5}
    - {name: picker, a: {surface: other, box: {lower: [0, 0, 0], upper: [1, 1, 1]}}, stiffness: 8,
       target_trajectory: [{time: 0.04, displacement: [0, 0, 0.2]}]}
    - {name: holder, a: {surface: crate, points: [[0, 0, 0.05]]}, stiffness: 8}
"""


def test_attachments_are_built_and_follow_their_keyframes(write):
    task = load_task(write(ATTACHED), [])
    springs = task.scene.springs
    assert list(springs.groups) == ["seam", "grasp", "picker", "holder"]
    assert springs.stiffness.tolist() == [5, 5, 5, 8, 8, 8, 8, 8]
    assert springs.rest_lengths.tolist() == [0.1, 0.1, 0, 0, 0, 0, 0, 0]
    controller = task.controller({})
    controls = [controller(k, None) for k in range(4)]
    heights = [control.attachments["picker"][:, 2].tolist() for control in controls]
    assert [h[0] for h in heights] == pytest.approx([0.15, 0.2, 0.25, 0.3])
    held = controls[2].attachments["holder"]
    torch.testing.assert_close(held, torch.tensor([[1.0, 0.0, 0.55]], dtype=F64))
    weights = [control.attachment_weights["seam"].tolist() for control in controls]
    assert [w[1] for w in weights] == pytest.approx([0.75, 0.5, 0.25, 0.0])
    end = list(simulate(task))[-1]
    assert end.positions[-1, 2] > 0.15  # picked
    assert end.positions[8, 0] > 0.15  # grasped


def test_air_is_built_and_blows_in_every_step(write):
    sheet = "scene.cloths.sheet.material="
    given = ["scene.air={density: 0.9, wind: [0, 3, 0]}", sheet + "{normal_drag: 1.5}"]
    task = load_task(write(ATTACHED), given)
    assert task.scene.air_density == 0.9
    assert task.scene.cloths[0].material.normal_drag == 1.5
    controller = task.controller({})
    assert all(controller(k, None).wind.tolist() == [0, 3, 0] for k in range(4))
    still = load_task(write(ATTACHED), [])
    assert still.scene.air_density == 1.2
    assert still.controller({})(0, None).wind is None


def test_wind_needs_a_cloth(write):
    text = ATTACHED.partition("  cloths:")[0] + "  air: {wind: [1, 0, 0]}\n"
    box = "  bodies:\n    - {name: b, shape: {kind: box, size: 1}, motion: dynamic, mass: 1}\n"
    with pytest.raises(InvalidInput, match=r"has `air\.wind` and must have a cloth"):
        load_task(write(text + box), [])
    with pytest.raises(InvalidInput, match="density` must be"):
        load_task(write(ATTACHED), ["scene.air.density=-1"])


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("scene.attachments.seam.stiffness=0", "stiffness` must be"),
        ("scene.attachments.seam.rest_length=-1", "rest_length` must be"),
        ("scene.attachments.seam.weight_trajectory=[{time: 0, value: 2}]", "value` must be"),
        ("scene.attachments.grasp.a={surface: crate, vertices: [0]}", "must give `points`"),
        ("scene.attachments.grasp.b={surface: moon, points: [[0, 0, 0]]}", "'moon'"),
        ("scene.attachments.seam.target_trajectory=[{time: 0}]", "no `target_trajectory`"),
    ],
)
def test_attachments_of_a_configuration_are_checked(write, assignment, message):
    with pytest.raises(InvalidInput, match=message):
        load_task(write(ATTACHED), [assignment])
