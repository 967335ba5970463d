"""Chains of pytorch-kinematics, of a robot and for one."""

import numpy as np
import pytest
import torch
from robot_files import joint, link, panda, random_robot, robot, save, two_links

import diffcloth_torch as dc

pk = pytest.importorskip("pytorch_kinematics")

F64 = torch.float64
ORIGIN = torch.tensor([0.0, 0, 0, 1, 0, 0, 0], dtype=F64)  # frames of a chain are in its root's


MIMIC = '<mimic joint="j" multiplier="-2" offset="0.5"/>'


def compare(robot, seed=0, batch=3):
    """Frames of a robot and of its chain at random joint positions."""
    rng = np.random.default_rng(seed)
    q = torch.from_numpy(rng.uniform(-1, 1, (batch, len(robot.joint_names))))
    theirs = robot.chain.forward_kinematics(robot.chain_positions(q))
    ours = robot.forward_kinematics(q, ORIGIN)
    assert set(theirs) == set(ours)
    for name, frame in ours.items():
        expected = theirs[name].get_matrix().expand(batch, 4, 4)
        assert expected.dtype == F64
        torch.testing.assert_close(frame, expected, rtol=0, atol=1e-12)


# --- The chain of a robot -------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_frames_of_a_chain_match_the_robot(tmp_path, seed):
    """The robots include mimicking and continuous joints, and links before their parents."""
    path = save(tmp_path, random_robot(np.random.default_rng(seed)))
    compare(dc.Robot.load(path, actuation="position"), seed)


def test_frames_of_a_chain_match_the_gripper_and_the_panda():
    compare(dc.Robot.load(dc.robots.GRIPPER))
    path, root = panda()
    start = {"panda_joint4": -1.5, "panda_joint6": 1.5, "panda_finger_joint1": 0.02}
    compare(dc.Robot.load(path, mesh_root=root, joint_positions=start))


def test_the_jacobian_of_a_chain_matches_its_frames(tmp_path):
    path = save(tmp_path, branch(np.random.default_rng(3)))
    arm = dc.Robot.load(path, actuation="position")
    serials = [pk.SerialChain(arm.chain, name, dtype=F64) for name in arm.link_names]
    serial = max(serials, key=lambda chain: chain.n_joints)
    end, names = serial._serial_frames[-1].name, serial.get_joint_parameter_names()
    q = torch.full((len(arm.joint_names),), 0.3, dtype=F64)
    columns = [arm.joint_names.index(name) for name in names]
    assert len(columns) >= 2
    theirs = serial.jacobian(q[columns])[0, :3]

    def position(q):
        return arm.forward_kinematics(q, ORIGIN)[end][:3, 3]

    ours = torch.autograd.functional.jacobian(position, q)[:, columns]
    torch.testing.assert_close(theirs, ours, rtol=0, atol=1e-12)


def test_a_chain_has_the_limits_of_the_robot(tmp_path):
    parts = [
        *(link(name) for name in "abcd"),
        joint("j", "a", "b", limit='lower="-1" upper="2"'),
        joint(
            "k",
            "b",
            "c",
            content='<mimic joint="j" multiplier="-2" offset="0.5"/>',
            limit="lower='-9' upper='9'",
        ),
        joint("l", "c", "d", "continuous", limit=""),
    ]
    arm = dc.Robot.load(save(tmp_path, robot(*parts)))
    chain = arm.chain
    limits = dict(
        zip(
            chain.get_joint_parameter_names(),
            zip(chain.low.tolist(), chain.high.tolist(), strict=True),
            strict=True,
        )
    )
    assert limits == {"j": (-1, 2), "j/c": (-3.5, 2.5), "l": (-np.inf, np.inf)}


def test_a_chain_is_a_new_one_each_time():
    hand = dc.Robot.load(dc.robots.GRIPPER)
    hand.chain.to(dtype=torch.float32)
    assert hand.chain.dtype == F64
    compare(hand)


# --- A robot of a chain ---------------------------------------------------------------------------


def branch(rng):
    """A random tree without mimicking joints."""
    text = random_robot(rng)
    while "mimic" in text:
        text = random_robot(rng)
    return text


def inertials_of(robot):
    m = robot.mechanism
    rows = zip(m.link_names, m.mass.tolist(), m.center, m.inertia, strict=True)
    return {name: (mass, center, inertia) for name, mass, center, inertia in rows}


def test_a_robot_of_its_own_chain_is_the_same(tmp_path):
    """Up to the order of links, steps are equal if the data that a chain drops is given."""
    arm = dc.Robot.load(save(tmp_path, branch(np.random.default_rng(1))), actuation="torque")
    again = dc.Robot.from_chain(
        arm.chain, surfaces={}, inertials=inertials_of(arm), actuation="torque"
    )
    assert set(again.joint_names) == set(arm.joint_names)
    ends = []
    for each in (arm, again):
        simulator = dc.Simulator(dc.Scene([], robots=[each]), 0.01)
        start = simulator.initial_state()
        end = simulator.rollout(start, [dc.Control()] * 5)[-1]
        ends.append(dict(zip(each.joint_names, end.joint_positions, strict=True)))
    for name, value in ends[0].items():
        torch.testing.assert_close(ends[1][name], value, rtol=0, atol=1e-12)


def test_a_chain_of_a_file_has_its_frames_in_single_precision(tmp_path):
    path = save(tmp_path, branch(np.random.default_rng(2)))
    chain = pk.build_chain_from_urdf(path.read_bytes())
    arm = dc.Robot.load(path, actuation="position")
    ends = dict.fromkeys(arm.joint_names, (-9.0, 9.0))
    own = dc.Robot.from_chain(chain, surfaces={}, actuation="position", limits=ends)
    assert chain.dtype == torch.float32
    q = {name: 0.1 * i for i, name in enumerate(arm.joint_names)}
    frames = [
        each.forward_kinematics(torch.tensor([q[name] for name in each.joint_names], dtype=F64))
        for each in (arm, own)
    ]
    for name, frame in frames[0].items():
        torch.testing.assert_close(frames[1][name], frame, rtol=0, atol=1e-5)
        turn = frames[1][name][:3, :3]
        torch.testing.assert_close(turn @ turn.mT, torch.eye(3, dtype=F64), rtol=0, atol=1e-14)


def test_a_robot_of_a_chain_has_the_given_surfaces(tmp_path):
    chain = pk.build_chain_from_urdf(robot(*two_links()).encode())
    box = dc.RigidBody.box(0.1)
    arm = dc.Robot.from_chain(
        chain, surfaces={"arm": (box.vertices, box.faces)}, actuation="position", name="a"
    )
    assert [surface is None for surface in arm.surfaces] == [True, False]
    simulator = dc.Simulator(
        dc.Scene([dc.Cloth.grid(3, 3, pose=[0, 0, 1, 1, 0, 0, 0])], robots=[arm]), 0.01
    )
    assert "a/arm" in simulator.surfaces


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"actuation": "torque"}, "link name='arm'.*`mass` must be > 0 for a link that moves by"),
        ({"base": "floating"}, "`mass` must be > 0"),
        ({"surfaces": {"hand": ()}}, "`surfaces` has the names 'base', 'arm'; got 'hand'"),
        ({"surfaces": {"arm": ()}}, r"`surfaces\['arm'\]` must be \(vertices, faces\)"),
        ({"inertials": {"hand": ()}}, "`inertials` has the names 'base', 'arm'; got 'hand'"),
        ({"inertials": {"arm": (1.0,)}}, r"must be \(mass, center, inertia\)"),
        (
            {"inertials": {"arm": (1.0, [0, 0], np.eye(3))}},
            r"`inertials\['arm'\]` must have shape \[3\]",
        ),
        ({"inertials": {"arm": (-1.0, [0, 0, 0], np.eye(3))}}, "a mass >= 0, got -1"),
        ({"limits": {"elbow": (0, 1)}}, "`limits` has the names 'hinge'; got 'elbow'"),
        ({"limits": {"hinge": (1, 0)}}, "limits must leave it a range, got 1 and 0"),
        ({"actuation": {"elbow": "pd"}}, "Robot.from_chain: `actuation` has the names 'hinge'"),
        ({"base": "rolling"}, "`base` must be one of"),
    ],
)
def test_missing_data_of_a_chain_are_named(options, message):
    chain = pk.build_chain_from_urdf(robot(*two_links()).encode())
    with pytest.raises(dc.InvalidInput, match=message):
        dc.Robot.from_chain(chain, **{"surfaces": {}, "actuation": "position", **options})


def test_limits_that_stand_for_none_are_refused():
    text = robot(*two_links(kind="continuous", limit='lower="0" upper="0"'))
    chain = pk.build_chain_from_urdf(text.encode())
    with pytest.raises(dc.InvalidInput, match=r"give `limits=\{'hinge': "):
        dc.Robot.from_chain(chain, surfaces={}, actuation="position")
    free = {"hinge": (-np.inf, np.inf)}
    arm = dc.Robot.from_chain(chain, surfaces={}, actuation="position", limits=free)
    assert arm.mechanism.lower.tolist() == [-np.inf]


def test_limits_of_efforts_and_speeds_are_those_of_the_chain():
    text = robot(*two_links()).replace("effort='0'", "effort='5'")
    chain = pk.build_chain_from_urdf(text.encode())
    arm = dc.Robot.from_chain(chain, surfaces={}, actuation="position")
    assert (arm.effort_limits, arm.velocity_limits) == (5.0, np.inf)
    (joint,) = [f.joint for f in chain._root.children]
    joint.velocity_limits = (-1.0, 2.0)
    with pytest.raises(dc.InvalidInput, match=r"`velocity_limits` must be \(-limit, limit\)"):
        dc.Robot.from_chain(chain, surfaces={}, actuation="position")


def test_other_objects_than_chains_are_refused():
    with pytest.raises(TypeError, match=r"must be a pytorch_kinematics\.Chain, got str"):
        dc.Robot.from_chain("arm.urdf", surfaces={})
    chain = pk.build_chain_from_urdf(robot(*two_links()).encode())
    chain.find_frame("arm").joint.offset = pk.Transform3d(matrix=2 * torch.eye(4))
    with pytest.raises(dc.InvalidInput, match="the frame 'arm' must be a rotation"):
        dc.Robot.from_chain(chain, surfaces={}, actuation="position")
    chain = pk.build_chain_from_urdf(robot(*two_links()).encode())
    chain._root.link.offset = pk.Transform3d(pos=[1.0, 0, 0])
    with pytest.raises(dc.InvalidInput, match="the root 'base' must have no offset"):
        dc.Robot.from_chain(chain, surfaces={}, actuation="position")
