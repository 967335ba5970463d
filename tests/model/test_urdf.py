"""The URDF reader: refused files with their element; random bytes never crash the reader."""

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from robot_files import data, joint, link, load, robot, save, two_links

import diffcloth_torch as dc
from diffcloth_torch.model import urdf

NESTED = "<a>" * 5000 + "</a>" * 5000
LAUGHS = (
    '<!DOCTYPE robot [<!ENTITY a "lol"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">'
    '<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;">]><robot name="&c;"><link name="a"/></robot>'
)


def refused(tmp_path, text, message):
    path = save(tmp_path, text)
    with pytest.raises(dc.InvalidInput, match=message) as caught:
        dc.Robot.load(path, actuation="position")
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        pytest.param(b"", "not well-formed XML: no element found", id="empty"),
        pytest.param(b"\x00\xff", "not well-formed XML", id="bytes"),
        pytest.param("<robot><link></robot>", "not well-formed XML: mismatched tag", id="tags"),
        pytest.param('<?xml version="1.0" encoding="no"?><a/>', "not well-formed", id="encoding"),
        pytest.param(LAUGHS, "no DOCTYPE and no entities", id="entities"),
        pytest.param(
            '<!DOCTYPE robot SYSTEM "http://localhost/x.dtd"><robot/>', "no DOCTYPE", id="network"
        ),
        pytest.param(
            '<!DOCTYPE r [<!ENTITY f SYSTEM "file:///etc/passwd">]><robot name="r">&f;</robot>',
            "no DOCTYPE",
            id="files",
        ),
        pytest.param("<sdf/>", r"root element must be <robot>, got <sdf>", id="sdf"),
        pytest.param(f"<robot>{NESTED}</robot>", "must have a <link>, got none", id="no links"),
    ],
)
def test_a_file_that_is_no_safe_urdf_is_refused(tmp_path, text, message):
    refused(tmp_path, text, message)


def test_an_endless_file_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(urdf, "_LARGEST_FILE", 2**20)
    refused(tmp_path, robot(link("a"), " " * 2**20), "must be at most 1 MiB")


def test_a_missing_file_is_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        dc.Robot.load(tmp_path / "none.urdf")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "latin-1"])
def test_files_are_read_as_bytes_in_their_encoding(tmp_path, encoding):
    text = f'<?xml version="1.0" encoding="{encoding}"?>' + robot(link("Büchse"))
    loaded = dc.Robot.load(save(tmp_path, text.encode(encoding)))
    assert loaded.link_names == ("Büchse",)


# --- Elements and attributes ----------------------------------------------------------------------

BOX = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
ORIGIN = '<origin xyz="{}" rpy="{}"/>'


def mass(value):
    return f'<inertial><mass value="{value}"/></inertial>'


def shape(content):
    return f"<collision><geometry>{content}</geometry></collision>"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (mass(-1), r"<link name='a'> <inertial> <mass>: `value` must be a number finite and >= 0"),
        (mass("nan"), "`value` must be a number finite"),
        (mass("heavy"), "`value` must be a number .*got 'heavy'"),
        (mass("1e300"), r"at most 1e\+30 in size, got '1e300'"),
        ("<inertial/>", r"<link name='a'> <inertial> must have one <mass>, got 0"),
        ("<inertial><mass/></inertial>", "<mass>: `value` must be given"),
        (mass(1) * 2, r"<link name='a'> must have one <inertial>, got 2"),
        (
            '<inertial><mass value="1"/><inertia ixx="1"/></inertial>',
            "<inertia>: `ixy` must be given",
        ),
        ("<collision/>", r"<collision> must have one <geometry>, got 0"),
        (
            shape(""),
            "must hold one of <box>, <cylinder>, <sphere>, <capsule>, <mesh>, got none",
        ),
        (shape('<cone radius="1" length="1"/>'), "must hold one of .*got <cone>"),
        (shape('<capsule radius="1"/>'), "<capsule>: `length` must be given"),
        (shape('<sphere radius="1"/><sphere radius="1"/>'), "one <sphere>, got 2"),
        (shape('<sphere radius="1"/><box size="1 1 1"/>'), "got <sphere>, <box>"),
        (shape('<sphere radius="0"/>'), "`radius` must be a number finite and > 0"),
        (shape('<box size="1 1"/>'), "`size` must be 3 numbers finite and > 0, got '1 1'"),
        (shape('<cylinder radius="1"/>'), "<cylinder>: `length` must be given"),
        (shape("<mesh/>"), "<mesh>: `filename` must be given"),
        (shape('<mesh filename=""/>'), "`filename` must be printable"),
        (
            BOX.replace("<geo", ORIGIN.format("0 0 nan", "0 0 0") + "<geo"),
            "`xyz` must be 3 numbers",
        ),
    ],
)
def test_a_bad_link_is_refused(tmp_path, content, message):
    refused(tmp_path, robot(link("a", content)), message)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ORIGIN.format("nan 0 0", "0 0 0"), r"<joint name='hinge'> <origin>: `xyz` must be"),
        (ORIGIN.format("0 0 0", "0 inf 0"), "`rpy` must be 3 numbers"),
        ("<origin/><origin/>", "must have one <origin>, got 2"),
        ('<axis xyz="0 0 0"/>', "<axis>: `xyz` must have a length of at least 1e-09, got 0"),
        ('<dynamics damping="-1"/>', "`damping` must be a number finite and >= 0"),
        ("<mimic/>", "<mimic>: `joint` must be given"),
        ('<mimic joint="none"/>', "must lead to a joint of the file that moves, got 'none'"),
        ('<mimic joint="hinge"/>', "a joint that does not mimic, got a cycle through 'hinge'"),
    ],
)
def test_a_bad_joint_is_refused(tmp_path, content, message):
    refused(tmp_path, robot(*two_links(content)), message)


@pytest.mark.parametrize("kind", ["planar", "floating", "ball", "a" * 2000])
def test_a_joint_of_another_type_is_refused(tmp_path, kind):
    accepted = "'fixed', 'revolute', 'continuous', 'prismatic'"
    message = f"'hinge'>: `type` must be one of {accepted}, got '{kind}'"
    refused(tmp_path, robot(*two_links(kind=kind)), message)


def test_limits_must_be_there_and_in_order(tmp_path):
    text = robot(*two_links(limit='lower="1" upper="0"'))
    refused(tmp_path, text, "<limit>: `lower` must not be above `upper`, got 1 and 0")
    refused(tmp_path, robot(*two_links(limit="")), "of type 'revolute' must have a <limit>")
    load(tmp_path, *two_links(limit="", kind="continuous"))


def test_a_chain_of_mimics_must_end(tmp_path):
    def mimic(name):
        return f'<mimic joint="{name}"/>'

    parts = [link(name) for name in "abcd"]
    ring = [
        joint("j", "a", "b", content=mimic("k")),
        joint("k", "b", "c", content=mimic("l")),
        joint("l", "c", "d", content=mimic("k")),
    ]
    refused(tmp_path, robot(*parts, *ring), "'j'> <mimic>: `joint` must lead to .* through 'k'")
    weld = joint("k", "b", "c", "fixed")
    refused(tmp_path, robot(*parts[:3], ring[0], weld), "a joint of the file that moves, got 'k'")


def test_mimics_are_read_as_urdfdom_reads_them(tmp_path):
    """A mimicking joint needs no limit; a fixed joint mimics nothing."""
    parts = [link(name) for name in "abcd"]
    mimic = '<mimic joint="j" multiplier="2"/>'
    joints = [
        joint("j", "a", "b"),
        joint("k", "b", "c", content=mimic, limit=""),
        joint("l", "c", "d", "fixed", '<mimic joint="none"/>'),
    ]
    robot = load(tmp_path, *parts, *joints)
    assert robot.joint_names == ("j",)
    assert robot.mechanism.lower.tolist() == [-2]
    assert robot.mechanism.kind == ("fixed", "revolute", "revolute", "fixed")


def test_undeclared_prefixes_are_parts_of_names(tmp_path):
    extra = '<drake:joint sensor:type="a"><drake:b/></drake:joint><sensor:link name="c"/>'
    text = f'<robot name="r">{extra}{link("a", "<drake:inertial/>" + BOX)}</robot>'
    assert dc.Robot.load(save(tmp_path, text)).link_names == ("a",)
    declared = text.replace("<robot", '<robot xmlns="http://a" xmlns:drake="http://b"')
    assert dc.Robot.load(save(tmp_path, declared)).link_names == ("a",)


def test_names_may_contain_a_slash(tmp_path):
    links = [link("a/b", BOX), link("a"), link("c"), link("d")]
    mimic = joint("j", "a", "c", content='<mimic joint="k"/>')
    joints = [joint("k", "a/b", "a"), mimic, joint("k/c", "a", "d")]
    robot = load(tmp_path, *links, *joints, actuation="position", name="r")
    assert robot.link_names == ("a/b", "a", "c", "d")
    assert robot.joint_names == ("k", "k/c")
    scene = dc.Scene([dc.Cloth.grid(2, 2)], robots=[robot])
    assert scene.surface_names == ("cloth0", "r/a/b")
    # In a chain the joint of c, which mimics k, has a separate name.
    assert len(robot.chain_positions(torch.zeros(2, dtype=torch.float64))) == 3


# --- Every reason at once -------------------------------------------------------------------------


def test_all_elements_and_meshes_are_in_one_message(tmp_path):
    text = robot(
        link("a", mass(-1) + shape('<sphere radius="0"/>') + shape('<cone radius="1"/>')),
        link("b", shape('<mesh filename="none.obj"/>') + shape('<mesh filename="none.dae"/>')),
        joint("j", "a", "b", kind="ball"),
        joint("k", "a", "b", limit=""),
    )
    path = save(tmp_path, text)
    with pytest.raises(dc.InvalidInput) as caught:
        dc.Robot.load(path)
    opening, *reasons = str(caught.value).split("\n")
    expected = [
        "- <link name='a'> <inertial> <mass>: `value` must be",
        "- <link name='a'> <collision> <geometry> <sphere>: `radius` must be",
        "- <link name='a'> <collision> <geometry> must hold one of",
        "- <joint name='j'>: `type` must be one of",
        "- <joint name='k'> of type 'revolute' must have a <limit>",
        "- <link name='b'> <collision>: `filename` must be a file, got 'none.obj'",
        "- <link name='b'> <collision>: `filename` must be a file, got 'none.dae'",
    ]
    assert opening == f"{path}: {len(expected)} reasons:"
    for reason, beginning in zip(reasons, expected, strict=True):
        assert reason.startswith(beginning)


def test_all_faults_of_a_tree_are_in_one_message(tmp_path):
    parts = [link(n) for n in "abc"]
    ends = ["ax", "yb", "ac", "bc"]
    joints = [joint(f"j{i}", *pair) for i, pair in enumerate(ends)]
    message = r"(?s)3 reasons:.*got 'x'.*got 'y'.*got 'j2' and 'j3'"
    refused(tmp_path, robot(*parts, *joints), message)


def test_all_limits_and_masses_are_in_one_message(tmp_path):
    held = joint("j", "a", "b", limit='lower="1" upper="1"')
    parts = [link("a"), link("b", ""), link("c", ""), held, joint("k", "b", "c", "prismatic")]
    message = r"(?s)3 reasons:.*<joint name='j'>.*<link name='b'> <iner.*<link name='c'> <iner"
    with pytest.raises(dc.InvalidInput, match=message):
        load(tmp_path, *parts, actuation="pd")


# --- Trees ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        pytest.param(
            [link("a"), link("a")], "two <link> have the name 'a'; it must be one", id="links"
        ),
        pytest.param(
            [*(link(n) for n in "abc"), joint("j", "a", "b"), joint("j", "b", "c")],
            "two <joint> have the name 'j'",
            id="joints",
        ),
        pytest.param(
            [link("a"), joint("j", "a", "b")],
            "'j'>: its child must be a <link> of the file, got 'b'",
            id="child",
        ),
        pytest.param(
            [link("b"), joint("j", "a", "b")], "its parent must be a <link> .*got 'a'", id="parent"
        ),
        pytest.param(
            [link("a"), link("b")], "no child of a joint, the root; got 'a', 'b'", id="roots"
        ),
        pytest.param(
            [*(link(n) for n in "abc"), joint("j", "a", "c"), joint("k", "b", "c")],
            "'c'> must be the child of one joint, got 'j' and 'k'",
            id="two parents",
        ),
        pytest.param(
            [link("a"), link("b"), joint("j", "a", "b"), joint("k", "b", "a")],
            "must make a tree, got a cycle that <link name='a'>",
            id="cycle",
        ),
        pytest.param(
            [*(link(n) for n in "abc"), joint("j", "b", "c"), joint("k", "c", "b")],
            "must make a tree, got a cycle that <link name='b'>",
            id="cycle apart",
        ),
        pytest.param([link("a"), joint("j", "a", "a")], "got a cycle", id="itself"),
    ],
)
def test_links_that_are_no_tree_are_refused(tmp_path, parts, message):
    refused(tmp_path, robot(*parts), message)


def test_a_long_chain_is_no_problem(tmp_path):
    """The chain is deeper than Python's recursion limit."""
    n = 3000
    links = [link(f"l{i}", "") for i in range(n)]
    joints = [joint(f"j{i}", f"l{i}", f"l{i + 1}", "fixed") for i in range(n - 1)]
    description = urdf.read_urdf(save(tmp_path, robot(*links, *joints)))
    assert len(description.joints) == n - 1


def test_unread_elements_are_ignored_silently(tmp_path, capfd):
    extra = '<material name="m"/><gazebo><a/></gazebo><transmission name="t"/>'
    odd = '<dynamics damping="1" D="2"/><safety_controller k_velocity="1"/><calibration/>'
    visual = "<visual><geometry><teapot/></geometry></visual>"
    text = robot(extra, link("base", visual), link("arm"), joint("j", "base", "arm", content=odd))
    dc.Robot.load(save(tmp_path, text))
    assert capfd.readouterr() == ("", "")  # as everything else is ignored


# --- Any bytes ------------------------------------------------------------------------------------


def judge(folder, content):
    """Anything loads or is refused: no other exception, no warning."""
    path = save(folder, content)
    for keywords in ({"actuation": "position"}, {"base": "floating", "edge_length": 0.05}):
        try:
            loaded = dc.Robot.load(path, **keywords)
        except dc.InvalidInput:
            continue
        assert loaded.link_names


FUZZ = settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
GRIPPER = dc.robots.GRIPPER.read_bytes()


@FUZZ
@given(st.binary(max_size=200))
def test_random_bytes_load_or_are_refused(tmp_path, content):
    judge(tmp_path, content)


@FUZZ
@given(st.integers(0, len(GRIPPER)), st.integers(0, 30), st.binary(max_size=20))
@example(0, 22, b"\xff\xfe")
def test_a_damaged_file_loads_or_is_refused(tmp_path, start, length, splice):
    judge(tmp_path, GRIPPER[:start] + splice + GRIPPER[start + length :])


WORDS = st.sampled_from(
    [
        *("a", "b", "palm", "left_finger", "right_finger_joint", "fixed", "continuous", ""),
        *("-1", "0 0 0", "1 1 1", "1 0 0", "nan nan nan", "1e-300", "1e30", "9" * 30),
        *("1e-310 1 1", "-1e30 1e30 0", "../x.stl", "package://", "file:///etc/passwd"),
        *("a" * 999, "package://a/" + "b" * 900),
    ]
)


@FUZZ
@given(st.data())
def test_a_file_with_other_values_loads_or_is_refused(tmp_path, data):
    document = ET.fromstring(GRIPPER)
    elements = list(document.iter())
    for _ in range(data.draw(st.integers(1, 4))):
        element = data.draw(st.sampled_from(elements))
        if element.attrib and data.draw(st.booleans()):
            element.set(data.draw(st.sampled_from(sorted(element.attrib))), data.draw(WORDS))
        elif data.draw(st.booleans()) and len(element):
            element.remove(element[data.draw(st.integers(0, len(element) - 1))])
        else:
            element.append(data.draw(st.sampled_from(elements[1:])))
        if len(list(_bounded(document))) > 500:  # an element within itself
            return
    judge(tmp_path, ET.tostring(document))


def _bounded(element, depth=0):
    yield element
    if depth < 20:
        for child in element:
            yield from _bounded(child, depth + 1)
    else:
        yield from [element] * 1000


@pytest.mark.parametrize("name", ["joint_limit_robot", "prismatic_robot", "simple_y_arm"])
def test_public_files_are_read(name):
    path = Path(data(f"{name}.urdf"))
    description = urdf.read_urdf(path)
    found = ET.parse(path).getroot()
    assert [entry.name for entry in description.links] == [
        e.get("name") for e in found.iter("link") if e.get("name")
    ]
    moving = [e for e in found.iter("joint") if e.get("type") != "fixed"]
    assert [joint.effort for joint in description.joints if joint.type != "fixed"] == [
        float(e.find("limit").get("effort")) or math.inf for e in moving
    ]
