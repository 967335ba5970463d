"""Limitations of pytorch-kinematics, and the corresponding behavior of `Robot`.

Each test shows the limitation first, and therefore fails if a new version removes it.
"""

import numpy as np
import pytest
import torch
from robot_files import (
    joint,
    link,
    pinocchio_frames,
    random_robot,
    robot,
    save,
    two_links,
    values_of_all_joints,
)

import diffcloth_torch as dc

F64 = torch.float64
ORIGIN = '<origin xyz="0.1 0.2 0.3" rpy="0.1 0.2 0.3"/><axis xyz="{}"/>'
ARM = robot(
    *(link("a"), link("b"), link("c")),
    joint("j", "a", "b", content=ORIGIN.format("0 0 1")),
    joint("k", "b", "c", content=ORIGIN.format("0 1 0")),
)


@pytest.fixture(scope="module")
def pk():
    return pytest.importorskip("pytorch_kinematics")


def chain(pk, text):
    return pk.build_chain_from_urdf(text.encode()).to(dtype=F64)


def test_frames_are_of_single_precision(pk, tmp_path):
    path = save(tmp_path, ARM)
    robot = dc.Robot.load(path)
    q = np.array([0.3, 0.4])
    expected = pinocchio_frames(path, values_of_all_joints(robot, q))[0]["c"]
    theirs = chain(pk, ARM).forward_kinematics(torch.tensor(q))["c"].get_matrix()[0].numpy()
    ours = robot.forward_kinematics(torch.tensor(q))["c"].numpy()
    assert np.abs(theirs - expected).max() > 1e-9
    assert np.abs(ours - expected).max() < 1e-15


def test_second_derivatives_are_wrong(pk, tmp_path):
    robot = dc.Robot.load(save(tmp_path, ARM))
    q = torch.tensor([0.3, 0.4], dtype=F64, requires_grad=True)

    def theirs(q):
        return chain(pk, ARM).forward_kinematics(q[None])["c"].get_matrix()[0]

    def curvature(frame):
        (slope,) = torch.autograd.grad(frame(q)[:3].sum(), q, create_graph=True)
        if not slope.requires_grad:
            return torch.zeros(2, dtype=F64)
        return torch.autograd.grad(slope.sum(), q)[0]

    right = curvature(lambda q: robot.forward_kinematics(q)["c"])
    assert (curvature(theirs) - right).norm() > 0.2 * right.norm()
    assert torch.autograd.gradgradcheck(lambda q: robot.forward_kinematics(q)["c"], q)


def test_masses_shapes_and_mimics_are_dropped(pk, tmp_path):
    shape = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
    mimic = '<mimic joint="j" multiplier="2"/>'
    text = robot(
        *(link("a", shape), link("b"), link("c")),
        *(joint("j", "a", "b"), joint("k", "b", "c", content=mimic)),
    )
    theirs = chain(pk, text)
    assert theirs.get_joint_parameter_names() == ["j", "k"]
    frame = theirs.find_link("b")
    assert not {"mass", "inertial", "collision", "collisions"} & set(vars(frame))
    ours = dc.Robot.load(save(tmp_path, text))
    assert ours.joint_names == ("j",)
    assert ours.mechanism.mass.tolist() == [0, 2, 2]
    assert [surface is None for surface in ours.surfaces] == [False, True, True]


def test_a_chain_needs_a_joint(pk, tmp_path):
    text = robot(link("only"))
    with pytest.raises(UnboundLocalError):
        chain(pk, text)
    assert dc.Robot.load(save(tmp_path, text)).link_names == ("only",)


def test_text_with_a_declaration_is_refused(pk, tmp_path):
    text = '<?xml version="1.0" encoding="utf-8"?>' + ARM
    with pytest.raises(ValueError, match="bytes"):
        pk.build_chain_from_urdf(text)
    assert dc.Robot.load(save(tmp_path, text)).joint_names == ("j", "k")


def test_a_nan_origin_makes_nan_frames(pk, tmp_path):
    text = robot(*two_links('<origin xyz="nan 0 0"/>'))
    theirs = chain(pk, text).forward_kinematics(torch.zeros(1, 1, dtype=F64))
    assert theirs["arm"].get_matrix().isnan().any()
    with pytest.raises(dc.InvalidInput, match="`xyz` must be 3 numbers"):
        dc.Robot.load(save(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        pytest.param(
            robot(*(link(n) for n in "abc"), *(joint(n + m, n, m) for n, m in ("ab", "bc", "cb"))),
            RecursionError,
            "child of one joint",
            id="cycle",
        ),
        pytest.param(
            robot(link("a"), joint("j", "a", "b")), KeyError, "<link> of the file", id="missing"
        ),
        pytest.param(
            robot(*two_links(kind="planar")), KeyError, "must be one of 'fixed'", id="planar"
        ),
    ],
)
def test_bad_files_crash_the_parser(pk, tmp_path, text, error, message):
    with pytest.raises(error):
        chain(pk, text)
    with pytest.raises(dc.InvalidInput, match=message):
        dc.Robot.load(save(tmp_path, text))


def test_frames_agree_to_single_precision(pk, tmp_path):
    """On trees without mimicking joints, as a second opinion."""
    rng = np.random.default_rng(5)
    text = random_robot(rng)
    while "mimic" in text:
        text = random_robot(rng)
    robot = dc.Robot.load(save(tmp_path, text), actuation="position")
    theirs = chain(pk, text)
    q = {name: torch.tensor(0.1 * (i + 1), dtype=F64) for i, name in enumerate(robot.joint_names)}
    frames = theirs.forward_kinematics({name: value[None] for name, value in q.items()})
    ours = robot.forward_kinematics(torch.stack(list(q.values())))
    for name, frame in ours.items():
        torch.testing.assert_close(frames[name].get_matrix()[0], frame, rtol=0, atol=1e-5)
