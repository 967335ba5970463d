"""Surfaces that overlap at the start: all pairs in one message, and contact that they ignore."""

import pickle
import re

import numpy as np
import pytest

import diffcloth_torch as dc

BOX = '<collision><geometry><box size="{0} {0} {0}"/></geometry></collision>'
INERTIAL = (
    '<inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>'
    "</inertial>"
)


def save_tree(folder, positions, size=0.1):
    """A robot with links that slide along x from a base without shape; boxes at `positions`."""
    parts = ['<robot name="r"><link name="base"/>']
    for i, x in enumerate(positions):
        parts.append(f'<link name="l{i}">{INERTIAL}{BOX.format(size)}</link>')
        parts.append(
            f'<joint name="j{i}" type="prismatic"><parent link="base"/><child link="l{i}"/>'
            f'<origin xyz="{x!r} 0 0"/><limit lower="-1" upper="1"/></joint>'
        )
    path = folder / "tree.urdf"
    path.write_text("".join([*parts, "</robot>"]))
    return path


def load_tree(folder, positions, **keywords):
    options = {"stiffness": 100.0, "damping": 10.0, "name": "r"} | keywords
    return dc.Robot.load(save_tree(folder, positions), **options)


def cloth(z=0.3, **keywords):
    return dc.Cloth.grid(4, 4, 0.2, pose=[0, 0, z, 1, 0, 0, 0], **keywords)


def pairs_of(message):
    """The pairs of the line to paste."""
    (line,) = re.findall(r"^ignore_contact=.*$", message, re.MULTILINE)
    return eval(line.removeprefix("ignore_contact="))


POSITIONS = [0.0, 0.05, 0.09, 0.5, 0.55, 1.0]
OVERLAPS = [("l0", "l1"), ("l0", "l2"), ("l1", "l2"), ("l3", "l4")]


def test_all_pairs_that_overlap_are_in_one_line_to_paste(tmp_path):
    robot = load_tree(tmp_path, POSITIONS)
    block = dc.RigidBody.box(0.1, pose=[1.05, 0, 0, 1, 0, 0, 0], name="block")
    with pytest.raises(dc.IntersectingState) as caught:
        dc.Simulator(dc.Scene([cloth()], [block], [robot]), 0.01)
    found = pairs_of(str(caught.value))
    assert found == [("block", "r/l5"), *((f"r/{a}", f"r/{b}") for a, b in OVERLAPS)]
    assert "all pairs of them (5):" in str(caught.value)
    dc.Simulator(dc.Scene([cloth()], [block], [robot], ignore_contact=found), 0.01)


def test_pairs_with_a_cloth_are_named_but_not_to_be_ignored(tmp_path):
    robot = load_tree(tmp_path, [0.0, 0.3])
    sheets = [cloth(0.0, name="a"), cloth(0.01, name="b")]
    with pytest.raises(dc.IntersectingState) as caught:
        dc.Simulator(dc.Scene(sheets, robots=[robot]), 0.01)
    pairs = "all pairs with a cloth that overlap: [('a', 'r/l0'), ('b', 'r/l0')]"
    assert pairs in str(caught.value)
    assert "ignore_contact" not in str(caught.value)


def test_links_that_overlap_ignore_each_other_and_still_touch_the_rest(tmp_path):
    robot = load_tree(tmp_path, POSITIONS, ignore_contact="overlapping")
    simulator = dc.Simulator(dc.Scene([cloth(0.06)], robots=[robot]), 0.01)
    ignored = simulator._assembly.ignored_pairs.tolist()
    names = simulator.surfaces
    assert [(names[a], names[b]) for a, b in ignored] == [(f"r/{a}", f"r/{b}") for a, b in OVERLAPS]
    state = simulator.initial_state()
    for _ in range(8):
        state = simulator.step(state)
    assert state.report.contact_count > 0
    again = pickle.loads(pickle.dumps(simulator))
    np.testing.assert_array_equal(again._assembly.ignored_pairs, ignored)


def test_a_scene_ignores_bodies_and_a_robot_its_own_links(tmp_path):
    robot = load_tree(tmp_path, [0.0, 0.05], ignore_contact="overlapping")
    block = dc.RigidBody.box(0.1, pose=[0.0, 0, 0.05, 1, 0, 0, 0], name="block")
    with pytest.raises(dc.IntersectingState) as caught:
        dc.Simulator(dc.Scene([cloth()], [block], [robot]), 0.01)
    assert pairs_of(str(caught.value)) == [("block", "r/l0"), ("block", "r/l1")]
    dc.Simulator(dc.Scene([cloth()], [block], [robot], ignore_contact="overlapping"), 0.01)
    scene = dc.Scene([cloth(0.05)], [block], [robot], ignore_contact="overlapping")
    with pytest.raises(dc.IntersectingState, match=r"'cloth0' .* body 'block'"):
        dc.Simulator(scene, 0.01)


@pytest.mark.parametrize("gap", [-1e-3, 0.0, 1e-13, 1e-3, 0.0201])
def test_thickness_and_touching_count_as_overlap(tmp_path, gap):
    """Boxes of which rounding decides whether they touch; 20 mm thick, the last ones are apart."""
    positions = [0.3, 0.4 + gap]
    for thickness in (0.0, 0.02):
        robot = load_tree(tmp_path, positions, thickness=thickness, ignore_contact="overlapping")
        simulator = dc.Simulator(dc.Scene([cloth()], robots=[robot]), 0.01)
        overlap = gap < max(thickness, 1e-12)
        assert len(simulator._assembly.ignored_pairs) == overlap


def test_prescribed_surfaces_may_overlap(tmp_path):
    robot = load_tree(tmp_path, POSITIONS, actuation="position", ignore_contact="overlapping")
    simulator = dc.Simulator(dc.Scene([cloth()], robots=[robot]), 0.01)
    assert len(simulator._assembly.ignored_pairs) == 0


def test_round_bodies_overlap_by_their_radii():
    ball = dc.RigidBody.sphere(0.1, smooth=True, motion="dynamic", mass=1.0, name="ball")
    capsule = dc.RigidBody.capsule(0.05, 0.2, smooth=True, pose=[0.149, 0, 0, 1, 0, 0, 0], name="c")
    with pytest.raises(dc.IntersectingState, match=r"ignore_contact=\[\('ball', 'c'\)\]"):
        dc.Simulator(dc.Scene([cloth()], [ball, capsule]), 0.01)


def test_another_word_than_overlapping_is_refused(tmp_path):
    message = "{}: `ignore_contact` must be one of 'overlapping', got 'all'"
    with pytest.raises(dc.InvalidInput, match=message.format("Scene")):
        dc.Scene([cloth()], ignore_contact="all")
    with pytest.raises(dc.InvalidInput, match=message.format("Robot")):
        load_tree(tmp_path, [0.0], ignore_contact="all")
