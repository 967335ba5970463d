"""Robots: forward kinematics against Pinocchio, mimicking joints, limits, drives, names, scenes."""

import pickle
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
from robot_files import (
    INERTIAL,
    data,
    joint,
    link,
    load,
    panda,
    pinocchio_frames,
    random_robot,
    save,
    two_links,
    values_of_all_joints,
)

import diffcloth_torch as dc
from diffcloth_torch.geometry.poses import rotation_matrix
from diffcloth_torch.model.assembly import assemble
from diffcloth_torch.model.defaults import has_contact, scene_parameters

ROOT = Path(__file__).resolve().parents[2]
F64 = torch.float64

# Both sides multiply up to ten rotations and offsets below 3 m.
FRAMES = {"rtol": 0, "atol": 1e-12}


def compare_with_pinocchio(path, robot, seed=0):
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1, 1, len(robot.joint_names))
    frames = robot.forward_kinematics(torch.from_numpy(q))
    expected, _, _ = pinocchio_frames(path, values_of_all_joints(robot, q))
    assert set(frames) == set(robot.link_names) == set(expected)
    for name, frame in frames.items():
        np.testing.assert_allclose(frame.numpy(), expected[name], **FRAMES)


# --- Forward kinematics ---------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_frames_of_random_trees_are_those_of_pinocchio(tmp_path, seed):
    path = save(tmp_path, random_robot(np.random.default_rng(seed)))
    compare_with_pinocchio(path, dc.Robot.load(path, actuation="position"), seed)


BOX = INERTIAL + (
    '<collision><origin xyz="0.1 0 0.2" rpy="0.3 0.2 0.1"/><geometry><box size="0.1 0.2 0.3"/>'
    "</geometry></collision>"
)


def compare_with_core(robot, seed):
    """Vertices of links at both ends of a step in the core, and by forward kinematics."""
    rng = np.random.default_rng(seed)
    cloth = dc.Cloth.grid(2, 2, pose=[0, 0, 100, 1, 0, 0, 0])  # a scene needs something to move
    sim = dc.Simulator(dc.Scene([cloth], [], [robot]), 0.01)
    m = robot.mechanism
    q = torch.from_numpy(rng.uniform(-1, 1, (2, m.joint_count)).clip(m.lower, m.upper))
    pose = torch.from_numpy(rng.normal(size=(2, 7)))
    pose = torch.cat([pose[:, :3], torch.nn.functional.normalize(pose[:, 3:], dim=1)], dim=1)
    start = sim.initial_state().replace(joint_positions=q[0], base_poses=pose[:1])
    joints = dict(zip(robot.joint_names, q[1], strict=True))
    control = dc.Control(joint_positions=joints, base_poses={robot.name: pose[1]})
    path = sim.path(start, control)
    for at, row in enumerate((0, -1)):
        frames = robot.forward_kinematics(q[at], pose[at])
        expected = [
            torch.tensor(mesh.vertices) @ frames[name][:3, :3].T + frames[name][:3, 3]
            for name, mesh in zip(robot.link_names, robot.surfaces, strict=True)
            if mesh is not None
        ]
        got = path[row, len(cloth.vertices) :]
        torch.testing.assert_close(got, torch.cat(expected), **FRAMES)


@pytest.mark.parametrize("seed", range(6))
def test_the_core_places_random_trees_as_forward_kinematics_does(tmp_path, seed):
    path = save(tmp_path, random_robot(np.random.default_rng(seed), content=BOX))
    robot = dc.Robot.load(path, base="kinematic", actuation="position", name="tree")
    compare_with_core(robot, seed)


def test_the_core_places_the_panda_as_forward_kinematics_does():
    path, root = panda()
    start = {"panda_joint4": -1.0}
    options = {"base": "kinematic", "actuation": "position", "joint_positions": start}
    compare_with_core(dc.Robot.load(path, mesh_root=root, name="panda", **options), seed=0)


@pytest.mark.parametrize("name", ["joint_limit_robot", "prismatic_robot", "simple_y_arm"])
def test_frames_of_public_robots_are_those_of_pinocchio(name):
    path = data(f"{name}.urdf")
    start = {"joint1": 9, "joint2": 10, "joint3": 11, "joint4": 12} if "limit" in name else None
    robot = dc.Robot.load(path, actuation="position", joint_positions=start)
    compare_with_pinocchio(path, robot)


def test_frames_of_the_panda_are_those_of_pinocchio():
    path, root = panda()
    robot = dc.Robot.load(path, mesh_root=root, joint_positions={"panda_joint4": -1.0})
    assert len(robot.joint_names) == 8
    compare_with_pinocchio(path, robot)


def test_the_center_of_mass_is_that_of_pinocchio(tmp_path):
    rng = np.random.default_rng(3)
    path = save(tmp_path, random_robot(rng))
    robot = dc.Robot.load(path, actuation="position")
    q = rng.uniform(-1, 1, len(robot.joint_names))
    frames = torch.stack(list(robot.forward_kinematics(torch.from_numpy(q)).values())).numpy()
    m = robot.mechanism
    centers = np.einsum("lij,lj->li", frames[:, :3, :3], m.center) + frames[:, :3, 3]
    # Pinocchio leaves out the root link, which is fixed to the world.
    moving = np.arange(m.link_count)
    _, expected, model = pinocchio_frames(path, values_of_all_joints(robot, q))
    fixed = [i for i in moving if is_fixed_to_the_world(m, i)]
    mass = np.where(np.isin(moving, fixed), 0.0, m.mass)
    assert mass.sum() == pytest.approx(sum(i.mass for i in list(model.inertias)[1:]))
    np.testing.assert_allclose(mass @ centers / mass.sum(), expected, rtol=0, atol=1e-12)


def is_fixed_to_the_world(mechanism, link):
    group = mechanism.rigid_group
    return group[link] == group[mechanism.root]


def test_inertias_are_turned_into_the_links_axes(tmp_path):
    pin = pytest.importorskip("pinocchio")
    path = save(tmp_path, f"<robot name='r'>{''.join(two_links())}</robot>")
    mechanism = dc.Robot.load(path).mechanism
    inertia = pin.buildModelFromUrdf(str(path)).inertias[1]
    np.testing.assert_allclose(mechanism.inertia[1], inertia.inertia, rtol=1e-14, atol=1e-17)
    np.testing.assert_allclose(mechanism.center[1], inertia.lever)
    assert mechanism.mass[1] == inertia.mass


def test_frames_have_exact_first_and_second_derivatives(tmp_path):
    robot = dc.Robot.load(save(tmp_path, random_robot(np.random.default_rng(1))), actuation="pd")
    rng = torch.Generator().manual_seed(0)
    q = torch.randn(len(robot.joint_names), dtype=F64, generator=rng)
    q[0] = 0.0  # an exponential computed by a division is not smooth at zero
    pose = torch.tensor([0.1, 0.2, 0.3, 1.1, 0.2, -0.4, 0.3], dtype=F64)
    inputs = (q.requires_grad_(), pose.requires_grad_())

    def frames(q, pose):
        return torch.stack(list(robot.forward_kinematics(q, pose).values()))

    assert torch.autograd.gradcheck(frames, inputs)
    assert torch.autograd.gradgradcheck(frames, inputs)


def test_frames_are_batched(tmp_path):
    robot = dc.Robot.load(save(tmp_path, random_robot(np.random.default_rng(2))), pose=[1] * 7)
    q = torch.rand(3, 2, len(robot.joint_names), dtype=F64)
    poses = torch.rand(2, 7, dtype=F64)
    batch = robot.forward_kinematics(q, poses)
    for i, j in np.ndindex(3, 2):
        single = robot.forward_kinematics(q[i, j], poses[j])
        for name, frame in batch.items():
            assert frame.shape == (3, 2, 4, 4)
            torch.testing.assert_close(frame[i, j], single[name], rtol=0, atol=1e-15)
    default = robot.forward_kinematics(q[0, 0])
    given = robot.forward_kinematics(q[0, 0], torch.from_numpy(robot.pose.copy()))
    assert all(torch.equal(default[name], given[name]) for name in default)


def test_the_base_pose_moves_all_links(tmp_path):
    robot = load(tmp_path, *two_links(), base="floating")
    pose = np.array([0.3, -0.2, 0.5, 0.8, 0.4, 0.2, 0.1])
    q = torch.tensor([0.7], dtype=F64)
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = rotation_matrix(pose[3:]), pose[:3]
    at_origin = robot.forward_kinematics(q)
    for name, frame in robot.forward_kinematics(q, torch.from_numpy(pose)).items():
        np.testing.assert_allclose(frame.numpy(), world @ at_origin[name].numpy(), **FRAMES)


@pytest.mark.parametrize(
    ("q", "pose", "error", "message"),
    [
        ([0.0, 1.0], None, dc.InvalidInput, r"`joint_positions` must have shape \[.., 1\], got"),
        ([0.0], [0.0] * 6, dc.InvalidInput, r"`base_pose` must have shape \[.., 7\], got \[6\]"),
        ([0.0], [0.0] * 7, dc.InvalidInput, "quaternion"),
        ([[0.0]] * 2, [[1.0] * 7] * 3, dc.InvalidInput, "leading axes that broadcast"),
        (torch.zeros(1, dtype=torch.bool), None, TypeError, "real numbers"),
    ],
)
def test_forward_kinematics_refuses(tmp_path, q, pose, error, message):
    robot = load(tmp_path, *two_links())
    with pytest.raises(error, match=message):
        robot.forward_kinematics(q, pose)


# --- The mechanism --------------------------------------------------------------------------------


def test_joints_and_links_keep_the_order_of_the_file(tmp_path):
    robot = load(
        tmp_path,
        *(link("c"), link("a"), link("b")),
        *(joint("z", "b", "c"), joint("y", "a", "b")),
    )
    assert robot.link_names == ("c", "a", "b")
    assert robot.joint_names == ("z", "y")
    mechanism = robot.mechanism
    assert mechanism.parent.tolist() == [2, -1, 1]
    assert mechanism.order == (1, 2, 0)
    assert mechanism.dof.tolist() == [0, -1, 1]


def test_a_robot_of_one_link_loads(tmp_path):
    robot = load(tmp_path, link("only"), base="floating")
    assert robot.joint_names == ()
    pose = torch.tensor([1.0, 2, 3, 1, 0, 0, 0], dtype=F64)
    frames = robot.forward_kinematics(torch.zeros(0, dtype=F64), pose)
    assert frames["only"][:3, 3].tolist() == [1, 2, 3]


def test_mimics_of_mimics_follow_one_joint(tmp_path):
    robot = load(
        tmp_path,
        *(link(name) for name in "abcd"),
        joint("first", "a", "b"),
        joint("last", "c", "d", "prismatic", '<mimic joint="middle" multiplier="3" offset="0.5"/>'),
        joint("middle", "b", "c", content='<mimic joint="first" multiplier="-2" offset="0.25"/>'),
    )
    assert robot.joint_names == ("first",)
    mechanism = robot.mechanism
    assert mechanism.dof.tolist() == [-1, 0, 0, 0]
    assert mechanism.multiplier.tolist() == [1, 1, -2, -6]
    assert mechanism.constant.tolist() == [0, 0, 0.25, 3 * 0.25 + 0.5]


def test_limits_of_a_mimic_bind_its_leader(tmp_path):
    mimic = '<mimic joint="j" multiplier="-0.5" offset="0.1"/>'
    parts = [link("a"), link("b"), link("c"), joint("j", "a", "b")]
    robot = load(tmp_path, *parts, joint("k", "b", "c", content=mimic, limit='lower="0" upper="1"'))
    # -0.5 q + 0.1 >= 0 from q = 0.2 downward; <= 1 from -1.8 upward, within -2 .. 2.
    np.testing.assert_allclose(robot.mechanism.lower, [-1.8])
    np.testing.assert_allclose(robot.mechanism.upper, [0.2])
    with pytest.raises(dc.InvalidInput, match=r"'j'>: its limits and those of .* mimic it"):
        load(tmp_path, *parts, joint("k", "b", "c", content=mimic, limit='lower="5" upper="6"'))


def test_continuous_joints_have_no_limits(tmp_path):
    robot = load(tmp_path, *two_links(kind="continuous"), joint_positions=100.0)
    assert robot.mechanism.lower.tolist() == [-np.inf]
    assert robot.mechanism.upper.tolist() == [np.inf]
    assert robot.mechanism.kind == ("fixed", "revolute")


def test_links_that_touch_by_construction_are_ignored(tmp_path):
    """Links joined by one moving joint, if links with fixed joints between them count as one."""
    box = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
    names = ["base", "flange", "bare", "arm", "tool", "hand"]
    robot = load(
        tmp_path,
        *(link(name, "" if name == "bare" else box) for name in names),
        joint("weld", "base", "flange", "fixed"),
        joint("weld2", "flange", "bare", "fixed"),
        joint("elbow", "bare", "arm"),
        joint("weld3", "arm", "tool", "fixed"),
        joint("wrist", "tool", "hand"),
        actuation="position",
    )
    assert set(robot.mechanism.adjacent_links) == {
        *(("base", "flange"), ("base", "bare"), ("flange", "bare"), ("arm", "tool")),
        *((a, b) for a in ("base", "flange", "bare") for b in ("arm", "tool")),
        *(("arm", "hand"), ("tool", "hand")),
    }
    scene = dc.Scene(
        [dc.Cloth.grid(2, 2)], robots=[robot], ignore_contact=[("robot0/hand", "cloth0")]
    )
    assembly = assemble(scene)
    left = {
        (assembly.surface_names[a], assembly.surface_names[b])
        for a, b in np.ndindex(6, 6)
        if a < b and [a, b] not in assembly.ignored_pairs.tolist()
    }
    assert left == {
        *(("cloth0", f"robot0/{name}") for name in names if name not in ("bare", "hand")),
        *((f"robot0/{name}", "robot0/hand") for name in ("base", "flange")),
    }


# --- Links that forces move -----------------------------------------------------------------------

NO_MASS = '<inertial><mass value="0"/></inertial>'


def inertial(ixx, iyy, izz, ixy=0.0, mass=1.0):
    moments = f'ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="{ixy}" ixz="0" iyz="0"'
    return f'<inertial><mass value="{mass}"/><inertia {moments}/></inertial>'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        pytest.param("", "`mass` must be > 0 for a link that moves", id="no inertial"),
        pytest.param(NO_MASS, "`mass` must be > 0", id="no mass"),
        pytest.param('<inertial><mass value="1"/></inertial>', "positive definite", id="a point"),
        pytest.param(inertial(1, 1, 1, ixy=2), "positive definite, got principal", id="indefinite"),
        pytest.param(inertial(1, 1, 3), "above the sum of the other two", id="triangle"),
    ],
)
def test_links_that_forces_move_need_an_inertia(tmp_path, content, message):
    parts = [link("base", ""), link("arm", content), joint("hinge", "base", "arm")]
    with pytest.raises(dc.InvalidInput, match=rf"'arm'> <inertial>: .*{message}"):
        load(tmp_path, *parts, actuation="torque")
    load(tmp_path, *parts, actuation="position")
    floating = [link("base"), *parts[1:]]
    with pytest.raises(dc.InvalidInput, match=message):
        load(tmp_path, *floating, base="floating", actuation="velocity")


def test_a_tool_frame_needs_no_mass_but_a_virtual_link_does(tmp_path):
    parts = [link("base", ""), link("arm"), joint("hinge", "base", "arm")]
    load(tmp_path, *parts, link("tool", NO_MASS), joint("weld", "arm", "tool", "fixed"))
    with pytest.raises(dc.InvalidInput, match="'tool'> <inertial>: `mass` must be > 0"):
        load(tmp_path, *parts, link("tool", NO_MASS), joint("slide", "arm", "tool", "prismatic"))


def test_a_joint_under_force_needs_a_range(tmp_path):
    parts = two_links(limit='lower="0.5" upper="0.5"')
    for actuation in ("pd", "torque", {"hinge": "pd"}):
        with pytest.raises(dc.InvalidInput, match="must leave it a range"):
            load(tmp_path, *parts, actuation=actuation)
    load(tmp_path, *parts, actuation="position")


def test_a_joint_with_one_position_is_prescribed_unless_told(tmp_path):
    held = joint("held", "arm", "tip", limit='lower="0.5" upper="0.5"')
    for actuation in (None, {}, {"hinge": "pd"}):
        robot = load(tmp_path, *two_links(), link("tip"), held, actuation=actuation)
        assert robot.mechanism.actuation == ("pd", "position")
        assert robot.joint_positions.tolist() == [0, 0.5]


def test_links_that_fixed_joints_join_have_one_inertia(tmp_path):
    """A point mass alone is no body, but may be a part of a body."""
    parts = [link("base", ""), joint("hinge", "base", "arm")]
    point = '<inertial><mass value="1"/></inertial>'
    weld = joint("weld", "arm", "tip", "fixed", '<origin xyz="0 0 1"/>')
    load(tmp_path, *parts, link("arm"), link("tip", point), weld)
    with pytest.raises(
        dc.InvalidInput, match=r"'arm'> <inertial>: `inertia` with that of the links"
    ):
        load(tmp_path, *parts, link("arm", point), link("tip", point), weld)
    beside = joint("weld2", "arm", "side", "fixed", '<origin xyz="1 0 0"/>')
    points = [link(name, point) for name in ("arm", "tip", "side")]
    load(tmp_path, *parts, *points, weld, beside)  # a triangle
    rod = inertial(0.0, 1.0, 1.0)
    # Two rods along x are a rod, unless the second one is turned.
    turned = joint("weld", "arm", "tip", "fixed", '<origin xyz="0 0 0" rpy="0 0 1.5"/>')
    load(tmp_path, *parts, link("arm", rod), link("tip", rod), turned)
    straight = joint("weld", "arm", "tip", "fixed")
    with pytest.raises(dc.InvalidInput, match="positive definite, got principal moments 0, 2, 2"):
        load(tmp_path, *parts, link("arm", rod), link("tip", rod), straight)


def test_a_robot_is_dynamic_if_forces_move_it(tmp_path):
    assert load(tmp_path, *two_links(), actuation="torque").mechanism.is_dynamic
    assert load(tmp_path, *two_links(), base="floating", actuation="position").mechanism.is_dynamic
    assert not load(
        tmp_path, *two_links(), base="kinematic", actuation="velocity"
    ).mechanism.is_dynamic


# --- Arguments ------------------------------------------------------------------------------------


def three_joints(tmp_path, **keywords):
    return load(
        tmp_path,
        *(link(name) for name in "abcd"),
        *(joint(f"j{i}", *pair) for i, pair in enumerate(["ab", "bc", "cd"])),
        **keywords,
    )


def test_values_are_one_for_all_by_name_or_in_order(tmp_path):
    robot = three_joints(
        tmp_path,
        joint_positions=[0.1, 0.2, 0.3],
        actuation={"j1": "torque"},
        stiffness=50.0,
        damping={"j0": 2},
        friction={"c": 0.7},
        thickness=torch.tensor(1e-3),
    )
    assert robot.joint_positions.tolist() == [0.1, 0.2, 0.3]
    assert robot.mechanism.actuation == ("pd", "torque", "pd")
    assert robot.stiffness.tolist() == [50, 0, 50]  # torque joints have no drive
    assert robot.damping.tolist() == [2, 0, 0]
    assert robot.friction.tolist() == [0.4, 0.4, 0.7, 0.4]
    np.testing.assert_allclose(robot.thickness, 1e-3)
    modes = ["position", "velocity", "torque"]
    assert three_joints(tmp_path, actuation=modes).mechanism.actuation == tuple(modes)


@pytest.mark.parametrize(
    ("keywords", "error", "message"),
    [
        (
            {"base": "free"},
            dc.InvalidInput,
            "`base` must be one of 'fixed', 'kinematic', 'floating'",
        ),
        ({"pose": [0] * 7}, dc.InvalidInput, "`pose` must hold a quaternion"),
        (
            {"joint_positions": 3},
            dc.InvalidInput,
            r"'j0' must be between its limits -2 and 2, got 3",
        ),
        ({"joint_positions": [0, 0]}, dc.InvalidInput, r"\[\] or \[3\], got \[2\]"),
        ({"joint_positions": {"x": 0}}, dc.InvalidInput, "has the names 'j0', 'j1', 'j2'; got 'x'"),
        ({"joint_positions": np.nan}, dc.InvalidInput, "must be finite, got nan"),
        ({"actuation": "servo"}, dc.InvalidInput, "'j0' must be one of .*'pd', got 'servo'"),
        ({"actuation": {"x": "pd"}}, dc.InvalidInput, "has the names .*; got 'x'"),
        ({"actuation": ["pd"]}, dc.InvalidInput, r"shape \[3\], got \[1\]"),
        ({"actuation": 3}, TypeError, "a word, a dict or a list of words, got int"),
        ({"stiffness": -1}, dc.InvalidInput, "`stiffness` must be finite and >= 0, got -1"),
        (
            {"damping": torch.ones(3, requires_grad=True)},
            dc.InvalidInput,
            "differentiate with respect to Parameters.joint_damping",
        ),
        ({"friction": {"e": 1}}, dc.InvalidInput, "has the names 'a', 'b', 'c', 'd'; got 'e'"),
        ({"thickness": "1"}, TypeError, "`thickness` must hold real numbers"),
        ({"edge_length": 0}, dc.InvalidInput, "`edge_length` must be finite and > 0"),
        ({"ignore_contact": [("a", "e")]}, dc.InvalidInput, r"; got 'e' at \[0\]"),
        ({"ignore_contact": [("a", "b"), ("a", "a")]}, dc.InvalidInput, r"pairs .* at \[1\]"),
        ({"ignore_contact": ["ab"]}, dc.InvalidInput, r"pairs of two names, got 'ab' at \[0\]"),
        ({"name": "a/b"}, dc.InvalidInput, "`name` must be non-empty, printable"),
    ],
)
def test_a_bad_argument_is_refused(tmp_path, keywords, error, message):
    with pytest.raises(error, match=message):
        three_joints(tmp_path, **keywords)


@pytest.mark.parametrize(
    ("limits", "start"), [((1, 2), 1), ((-2, -1), -1), ((-1, 2), 0), ((0, 1), 0)]
)
def test_a_start_that_is_not_given_is_the_one_nearest_to_zero(tmp_path, limits, start):
    parts = two_links(limit='lower="{}" upper="{}"'.format(*limits))
    for given in (None, {}):
        assert load(tmp_path, *parts, joint_positions=given).joint_positions.tolist() == [start]
    assert load(tmp_path, *parts, joint_positions={"hinge": limits[1]}).joint_positions == limits[1]
    beyond = limits[1] + 1
    message = f"'hinge' must be between its limits {limits[0]} and {limits[1]}, got {beyond}"
    with pytest.raises(dc.InvalidInput, match=message):
        load(tmp_path, *parts, joint_positions=beyond)


BOUNDS = ("effort_limits", "velocity_limits", "joint_friction")
BOUNDED = '<limit lower="-1" upper="1" effort="10" velocity="2"/><dynamics friction="0.5"/>'


def bounds(robot):
    return [getattr(robot, field).tolist() for field in BOUNDS]


def test_limits_and_friction_are_those_of_the_file_unless_others_are_given(tmp_path):
    parts = [
        *(link(name) for name in ("base", "arm", "hand")),
        joint("hinge", "base", "arm", content=BOUNDED, limit=""),
        joint("wrist", "arm", "hand", content=BOUNDED, limit=""),
    ]

    def given(value):
        return bounds(load(tmp_path, *parts, **dict.fromkeys(BOUNDS, value)))

    assert given(None) == [[10.0, 10.0], [2.0, 2.0], [0.5, 0.5]]
    assert given(False) == [[np.inf, np.inf], [np.inf, np.inf], [0.0, 0.0]]
    assert given(3.0) == [[3.0, 3.0]] * 3
    assert given([3.0, 4.0]) == [[3.0, 4.0]] * 3
    assert given({"wrist": 3.0}) == [[10.0, 3.0], [2.0, 3.0], [0.5, 3.0]]
    assert given({"hinge": False}) == [[np.inf, 10.0], [np.inf, 2.0], [0.0, 0.5]]
    with pytest.raises(dc.InvalidInput, match=r"`effort_limits` must be False .* got True"):
        given(True)
    with pytest.raises(dc.InvalidInput, match="`effort_limits` has the names 'hinge', 'wrist'"):
        given({"elbow": False})
    with pytest.raises(dc.InvalidInput, match=r"`effort_limits` must be finite and > 0, got 0"):
        given([1.0, 0.0])


def test_zero_in_a_file_is_no_limit(tmp_path):
    none = '<limit lower="-1" upper="1" effort="0" velocity="0"/>'
    assert bounds(load(tmp_path, *two_links(none, limit=""))) == [[np.inf], [np.inf], [0.0]]
    assert bounds(load(tmp_path, *two_links(kind="continuous", limit=""))) == [
        [np.inf],
        [np.inf],
        [0.0],
    ]
    with pytest.raises(dc.InvalidInput, match="`effort` must be a number finite and >= 0"):
        load(tmp_path, *two_links(none.replace('effort="0"', 'effort="-1"'), limit=""))


def test_joints_that_mimic_count_by_virtual_work(tmp_path):
    """Mimics move m times as far: efforts count |m| times, and speed limits 1/|m| times."""
    parts = [
        *(link(name) for name in ("base", "arm", "hand", "tip", "nail")),
        joint("hinge", "base", "arm", content=BOUNDED, limit=""),
        joint(
            "wrist",
            "arm",
            "hand",
            content='<mimic joint="hinge" multiplier="-4"/>' + BOUNDED,
            limit="",
        ),
        joint(
            "knuckle",
            "hand",
            "tip",
            "continuous",
            '<mimic joint="wrist" multiplier="0.5"/><dynamics friction="3"/>',
            limit="",
        ),
        joint(
            "none",
            "hand",
            "nail",
            content='<mimic joint="wrist" multiplier="0"/>' + BOUNDED,
            limit="",
        ),
    ]
    robot = load(tmp_path, *parts)
    assert bounds(robot) == [[10 + 4 * 10], [2 / 4], [0.5 + 4 * 0.5 + 2 * 3]]


def test_the_damping_of_a_joint_is_its_viscosity(tmp_path):
    robot = load(tmp_path, *two_links('<dynamics damping="0.25" friction="0"/>'))
    assert robot.viscosity.tolist() == [0.25]


# --- Scenes ---------------------------------------------------------------------------------------


def gripper(**keywords):
    return dc.Robot.load(dc.robots.GRIPPER, **keywords)


def test_a_scene_joins_bodies_and_robots(tmp_path):
    ball = dc.RigidBody.sphere(0.1, motion="dynamic", mass=2.0, friction=0.9, name="ball")
    floor = dc.RigidBody.plane(2.0, pose=[0, 0, -1, 1, 0, 0, 0], thickness=0.01)
    hand = gripper(base="floating", stiffness=10, pose=[0, 0, 1, 1, 0, 0, 0], name="hand")
    other = three_joints(tmp_path, actuation="position", joint_positions=0.1)
    scene = dc.Scene([dc.Cloth.grid(2, 3)], [ball, floor], [hand, other])
    a = assemble(scene)
    sizes = {"C": 1, "K": 2, "S": 6, "J": 5, "L": 7, "R": 2, "V": 642 + 4 + 24}
    assert {key: a.sizes[key] for key in sizes} == sizes
    assert a.surface_names == (
        *("cloth0", "ball", "body1"),
        *("hand/palm", "hand/left_finger", "hand/right_finger"),
    )
    assert [m.name for m in a.mechanisms] == ["ball", "body1", "hand", "robot1"]
    assert [m.base for m in a.mechanisms] == ["floating", "fixed", "floating", "fixed"]
    assert a.surface_mechanism.tolist() == [0, 1, 2, 2, 2]
    assert a.surface_link.tolist() == [0, 0, 0, 1, 2]
    assert a.joint_slices == {"hand": slice(0, 2), "robot1": slice(2, 5)}
    assert a.link_slices == {"hand": slice(0, 3), "robot1": slice(3, 7)}
    assert a.joint_positions.tolist() == [0, 0, 0.1, 0.1, 0.1]
    assert a.stiffness.tolist() == [10, 10, 0, 0, 0]
    np.testing.assert_array_equal(a.base_poses[:, :3], [[0, 0, 1], [0, 0, 0]])
    start, stop = a.body_vertex_start[4:6]
    np.testing.assert_array_equal(a.body_vertices[start:stop], hand.surfaces[2].vertices)
    assert a.body_faces[a.body_face_start[4] :].min() == start
    assert a.ignored_pairs.tolist() == [[3, 4], [3, 5]]
    values = scene_parameters(scene, a, contact=True)
    assert values["body_mass"].tolist() == [2, 0]
    torch.testing.assert_close(
        values["link_mass"], torch.tensor([0.4, 0.03, 0.03] + [0.0] * 4, dtype=F64)
    )
    assert values["link_inertia"].shape == (7, 3, 3)
    assert values["joint_stiffness"].tolist() == [10, 10, 0, 0, 0]
    assert values["thickness"].tolist() == [1e-3 * 0 + dc.Material().thickness, 0, 0.01, 0, 0, 0]
    assert values["friction"][1, 3].item() == pytest.approx((0.9 * 0.4) ** 0.5)


def test_parameters_of_prescribed_bodies_are_absent(tmp_path):
    box = dc.RigidBody.box(0.1, motion="kinematic")
    scene = dc.Scene([dc.Cloth.grid(2, 2)], [box], [three_joints(tmp_path, actuation="position")])
    values = scene_parameters(scene, assemble(scene), contact=True)
    assert not {name for name in values if name.split("_")[0] in ("body", "link", "joint")}


def test_a_scene_without_cloths_needs_something_dynamic(tmp_path):
    still = [dc.RigidBody.box(0.1)], [three_joints(tmp_path, actuation="position")]
    with pytest.raises(dc.InvalidInput, match="at least one Cloth where no body is dynamic"):
        dc.Scene([], *still)
    scene = dc.Scene([], [dc.RigidBody.box(0.1, motion="dynamic", density=500)])
    values = scene_parameters(scene, assemble(scene), contact=False)
    assert set(values) == {"gravity", "body_mass", "body_center", "body_inertia"}
    assert not has_contact(scene, dc.ContactOptions())
    assert has_contact(dc.Scene([], robots=[gripper()]), dc.ContactOptions(self_contact=False))


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([("cloth0", "robot0")], "got 'robot0'"),
        ([("cloth0", "cloth0")], "pairs of two names"),
        ([("robot0/palm", "robot0/thumb")], r"'robot0/palm', .*; got 'robot0/thumb' at \[0\]"),
    ],
)
def test_ignored_pairs_name_two_surfaces(pairs, message):
    with pytest.raises(dc.InvalidInput, match=message):
        dc.Scene([dc.Cloth.grid(2, 2)], robots=[gripper()], ignore_contact=pairs)


def test_names_of_robots_differ_from_all_others():
    with pytest.raises(dc.InvalidInput, match="'a' twice"):
        dc.Scene([dc.Cloth.grid(2, 2, name="a")], robots=[gripper(name="a")])
    with pytest.raises(TypeError, match=r"Robot objects, got RigidBody at \[0\]"):
        dc.Scene([dc.Cloth.grid(2, 2)], robots=[dc.RigidBody.box(1.0)])


def test_a_robot_pickles():
    robot = gripper(base="floating", stiffness=3)
    again = pickle.loads(pickle.dumps(robot))
    assert again.joint_names == robot.joint_names
    np.testing.assert_array_equal(again.surfaces[0].vertices, robot.surfaces[0].vertices)
    np.testing.assert_array_equal(again.stiffness, robot.stiffness)


# --- Robots of the package ------------------------------------------------------------------------


def test_the_gripper_is_the_output_of_its_script():
    made = runpy.run_path(str(ROOT / "scripts" / "make_gripper.py"))
    assert dc.robots.GRIPPER.read_text() == made["gripper"]()


def test_the_gripper_closes_without_crossing():
    robot = gripper(base="floating")
    assert len(robot.joint_names) + 6 == 8
    closed = robot.forward_kinematics(torch.from_numpy(robot.mechanism.upper.copy()))
    open_ = robot.forward_kinematics(torch.zeros(2, dtype=F64))

    def gap(frames):
        left, right = (frames[f"{side}_finger"].numpy() for side in ("left", "right"))
        lowest = (robot.surfaces[1].vertices @ left[:3, :3].T + left[:3, 3])[:, 1].min()
        return lowest - (robot.surfaces[2].vertices @ right[:3, :3].T + right[:3, 3])[:, 1].max()

    assert gap(closed) == pytest.approx(1e-3)
    assert gap(open_) == pytest.approx(0.08)


def test_the_masses_of_the_gripper_are_those_of_its_boxes():
    robot = gripper()
    for i, surface in enumerate(robot.surfaces):
        mass = robot.mechanism.mass[i]
        body = dc.RigidBody(*surface, motion="dynamic", mass=mass)
        np.testing.assert_allclose(robot.mechanism.center[i], body.center, atol=1e-15)
        np.testing.assert_allclose(robot.mechanism.inertia[i], body.inertia, rtol=1e-11, atol=1e-15)


def test_the_panda_loads_from_its_wheel():
    path, root = panda()
    start = {"panda_joint4": -1.5, "panda_joint6": 1.5, "panda_finger_joint1": 0.02}
    robot = dc.Robot.load(path, mesh_root=root, joint_positions=start, base="floating")
    assert sum(surface is not None for surface in robot.surfaces) == 11
    assert robot.mechanism.dof.tolist()[-2:] == [7, 7]  # the right finger mimics the left
    assert len(robot.surfaces[0].faces) == 200


def test_the_extra_is_named_where_the_panda_is_missing(monkeypatch):
    monkeypatch.setattr(dc.robots, "files", lambda name: [])
    with pytest.raises(ImportError, match=r"extra `robots`: pip install"):
        dc.robots.panda()


def test_the_examples_of_the_docs_run(tmp_path, monkeypatch):
    panda()
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "robots.md").read_text()
    names = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, names)
    assert len(names["scene"].robots) == 1
    assert names["frames"]["left_finger"].shape == (4, 4)
