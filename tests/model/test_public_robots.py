"""Public robots as they are: which files load, and that a cloth falls on each that does."""

from collections import defaultdict

import numpy as np
import pytest
from robot_packages import PACKAGES, robot_file, robot_files, under_a_cloth

import diffcloth_torch as dc

# Useless faces of their meshes are dropped, and some links are near each other.
pytestmark = pytest.mark.filterwarnings(
    "ignore:.*dropped .* faces", "ignore::diffcloth_torch.BarrierStartWarning"
)

EXAMPLES = "example-robot-data"
AIRO, STRETCH = "airo-models", "hello-robot-stretch-urdf"

# The ids name the requirement of each file beyond the rules of URDF.
QUICK = [
    pytest.param(AIRO, "robotiq_2f_85.urdf", id="relative paths above the file"),
    pytest.param(AIRO, "wheel_brick.urdf", id="wheels"),
    pytest.param("dexmate-urdf", "dexd_gripper.urdf", id="mimic"),
    pytest.param("differentiable-robot-model", "panda_no_gripper.urdf", id="paths to the package"),
    pytest.param("jvrc-description", "jvrc1.urdf", id="COLLADA"),
    pytest.param(STRETCH, "stretch_description_RE2V0_tool_none.urdf", id="overlaps"),
    pytest.param(STRETCH, "stretch_description_RE2V0_eoa_wrist_dw3_tool_sg3.urdf", id="points"),
    pytest.param(EXAMPLES, "a1.urdf", id="limits without zero"),
    pytest.param(EXAMPLES, "allegro_left_hand.urdf", id="hand"),
    pytest.param(EXAMPLES, "b1.urdf", id="many overlaps"),
    pytest.param(EXAMPLES, "laikago.urdf", id="four legs"),
    pytest.param(EXAMPLES, "double_pendulum.urdf", id="package above the file"),
    pytest.param(EXAMPLES, "iris.urdf", id="slash in names"),
    pytest.param(EXAMPLES, "panda_description/urdf/panda.urdf", id="panda"),
    pytest.param(EXAMPLES, "pr2.urdf", id="one position"),
    pytest.param(EXAMPLES, "quadruped.urdf", id="quadruped"),
    pytest.param(EXAMPLES, "simple_humanoid_classical.urdf", id="no surfaces"),
    pytest.param(EXAMPLES, "talos_left_arm.urdf", id="three slashes"),
    pytest.param(EXAMPLES, "tiago_no_hand.urdf", id="mimic on a fixed joint"),
    pytest.param(EXAMPLES, "ur5_gripper.urdf", id="undeclared prefix"),
]

# Gains that hold arms and hands alike; the steps are about contact.
GAINS = {"stiffness": 100.0, "damping": 10.0}
MODES = {"position": {"actuation": "position"}, "default": GAINS}


def load(path, mode):
    return dc.Robot.load(path, ignore_contact="overlapping", name="robot", **MODES[mode])


def fall_on(robot):
    """Five steps of a sheet that falls on a robot; most contacts of a step."""
    simulator = under_a_cloth(robot)
    state, most = simulator.initial_state(), 0
    for _ in range(5):
        state = simulator.step(state, parameters=simulator.default_parameters())
        most = max(most, state.report.contact_count)
    return most


@pytest.mark.parametrize(("package", "name"), QUICK)
def test_a_cloth_falls_on_a_public_robot(package, name):
    robot = load(robot_file(package, name), "position")
    has_surfaces = any(surface is not None for surface in robot.surfaces)
    assert (fall_on(robot) > 0) == has_surfaces


def test_forces_move_a_public_robot_under_a_cloth():
    robot = load(robot_file(EXAMPLES, "ur5_gripper.urdf"), "default")
    assert robot.mechanism.is_dynamic
    assert fall_on(robot) > 0


@pytest.mark.slow
@pytest.mark.parametrize(("package", "name"), QUICK)
def test_meshes_are_where_pinocchio_places_them(package, name):
    """Files, units, axes, scales and origins of meshes: the bounding boxes of links agree."""
    pin = pytest.importorskip("pinocchio", reason="Pinocchio is in the extra `test`")
    path = robot_file(package, name)
    robot = load(path, "position")
    surfaces = dict(zip(robot.link_names, robot.surfaces, strict=True))
    model = pin.buildModelFromUrdf(str(path))
    folders = [str(folder) for folder in path.parents]
    geometry = pin.buildGeomFromUrdf(model, str(path), pin.GeometryType.COLLISION, None, folders)
    points, others = defaultdict(list), set()
    for shape in geometry.geometryObjects:
        frame = model.frames[shape.parentFrame]
        if not hasattr(shape.geometry, "vertices"):
            others.add(frame.name)  # primitive shapes, which other tests cover
            continue
        in_link = (frame.placement.inverse() * shape.placement).homogeneous
        vertices = np.array(shape.geometry.vertices())
        points[frame.name].append(vertices @ in_link[:3, :3].T + in_link[:3, 3])
    for link in points.keys() - others:
        expected = np.concatenate(points[link])
        found = surfaces[link].vertices[np.unique(surfaces[link].faces)]
        size = np.abs(expected).max()
        for corner in (np.min, np.max):  # Pinocchio may read meshes in single precision
            np.testing.assert_allclose(corner(found, 0), corner(expected, 0), atol=1e-6 * size)


def test_a_file_without_a_robot_is_refused():
    with pytest.raises(dc.InvalidInput, match="a robot must have a <link>, got none"):
        load(robot_file(EXAMPLES, "ur3.urdf"), "position")


@pytest.mark.slow
def test_a_public_file_is_refused_with_every_reason():
    """The file's fingers mimic joints that do not exist."""
    reasons = r"8 reasons:\n- <joint name='Left_index_q2'> <mimic>"
    with pytest.raises(dc.InvalidInput, match=reasons):
        load(robot_file(EXAMPLES, "alex_psyonic_hands.urdf"), "position")


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "least"), [("position", 130), ("default", 110)])
def test_most_public_robots_load_and_step(mode, least):
    """At least `least` of 138 files load, and every robot that loads steps."""
    paths = [path for package in PACKAGES for path in robot_files(package)]
    if len(paths) < 138:
        pytest.skip(f"needs the packages {', '.join(PACKAGES)}")
    loaded, failed = [], []
    for path in paths:
        try:
            robot = load(path, mode)
        except dc.InvalidInput:
            continue
        loaded.append(path)
        try:
            fall_on(robot)
        except dc.SimulationError as error:
            failed.append((path, str(error)))
    assert not failed
    assert len(loaded) >= least
