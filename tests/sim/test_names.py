"""Messages use the names that a user has given to surfaces and pins."""

from __future__ import annotations

import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch import robots

DT = 0.01
F64 = torch.float64


def down(positions, distance):
    return positions - torch.tensor([0, 0, distance], dtype=F64)


def sheet(n, height, **keywords):
    return dc.Cloth.grid(n, n, size=0.5, pose=[0, 0, height, 1, 0.05, 0, 0], **keywords)


def test_pins_on_a_body_are_named_where_all_vertices_are_pinned():
    """Two prescribed surfaces have no contacts; they block each other all the same."""
    pins = {"left": range(10), "right": range(10, 20), "far": range(20, 25)}
    table = dc.RigidBody.box([0.6, 0.3, 0.2], pose=[0, -0.2, 0, 1, 0, 0, 0], name="table")
    far = dc.RigidBody.box(0.1, pose=[3, 0, 0, 1, 0, 0, 0], name="chair")
    simulator = dc.Simulator(dc.Scene([sheet(5, 0.5, pins=pins, name="shirt")], [far, table]), DT)
    state = simulator.initial_state()
    with pytest.raises(dc.InfeasibleMotion) as caught:
        simulator.step(state, dc.Control(pins=down(state.positions, 0.6)))
    text = str(caught.value)
    # Only the blocking pins: the sheet is tilted, and the table lies under its lower half.
    assert "in contact: cloth 'shirt' (pins 'left'), body 'table';" in text


@pytest.mark.parametrize("names", [("upper", "lower"), (None, None)])
def test_pins_of_two_cloths_are_named(names):
    cloths = [
        sheet(4, height, pins={"all": range(16)}, name=name)
        for height, name in zip((0.1, 0.0), names, strict=True)
    ]
    simulator = dc.Simulator(dc.Scene(cloths), DT)
    state = simulator.initial_state()
    first, second = simulator.surfaces
    pins = {f"{first}/all": down(state.positions[simulator.slices[first]], 0.3)}
    expected = rf"cloth '{first}' \(pins 'all'\), cloth '{second}' \(pins 'all'\)"
    with pytest.raises(dc.InfeasibleMotion, match=expected):
        simulator.step(state, dc.Control(pins=pins))


def test_links_are_named():
    hand = dc.Robot.load(
        robots.GRIPPER,
        base="kinematic",
        actuation="position",
        pose=[0, 0, 0.3, 0, 1, 0, 0],
        name="h",
    )
    cloth = sheet(6, 0.0, pins={"rim": range(36)}, name="towel")
    simulator = dc.Simulator(dc.Scene([cloth], robots=[hand]), DT)
    state = simulator.initial_state()
    poses = state.base_poses.clone()
    poses[0, 2] -= 0.5
    with pytest.raises(
        dc.InfeasibleMotion, match=r"cloth 'towel' .*link 'h/left_finger'"
    ) as caught:
        simulator.step(state, dc.Control(base_poses=poses))
    assert "palm" not in str(caught.value)


def test_a_motion_that_is_merely_slow_says_so():
    """A rotation by a right angle is made in portions of one iteration each."""
    box = dc.RigidBody.box(0.2, motion="kinematic")
    simulator = dc.Simulator(
        dc.Scene([sheet(4, 0.5, pins={"all": range(16)})], [box]),
        DT,
        solver=dc.SolverOptions(max_iterations=1),
    )
    turned = torch.tensor([[0, 0, 0, 0.5**0.5, 0, 0, 0.5**0.5]], dtype=torch.float64)
    with pytest.raises(dc.InfeasibleMotion, match=r"the iterations of the step .* are used up; it"):
        simulator.step(simulator.initial_state(), dc.Control(body_poses=turned))


def test_an_overlap_is_named():
    cube = dc.RigidBody.box(0.2, name="cube")
    message = r"cloth 'shirt' edge \(.*\) intersects body 'cube' face \("
    with pytest.raises(dc.IntersectingState, match=message):
        dc.Simulator(dc.Scene([sheet(4, 0.05, name="shirt")], [cube]), DT)
    simulator = dc.Simulator(dc.Scene([sheet(4, 0.5, name="shirt")], [cube]), DT)
    state = simulator.initial_state()
    with pytest.raises(dc.IntersectingState, match=message):
        simulator.step(state.replace(positions=down(state.positions, 0.45)))


@pytest.mark.parametrize("load", [1.0, 1e4])
def test_surfaces_pressed_too_hard_are_named(load):
    mat = dc.Cloth.grid(3, 3, 0.2, pose=[0, 0, 0.003, 1, 0, 0, 0], name="mat")
    floor = dc.RigidBody.plane(2.0, name="floor")
    weak = dc.ContactOptions(barrier_stiffness=1e-16, barrier_distance=0.002)
    simulator = dc.Simulator(dc.Scene([mat], [floor]), DT, contact=weak)
    forces = torch.tensor([0.0, 0.0, -load], dtype=F64).expand(9, 3)
    message = "leaves no way along the last direction: cloth 'mat', body 'floor'"
    with pytest.raises(dc.NotConverged, match=message):
        simulator.step(simulator.initial_state(), dc.Control(forces=forces))


def test_a_motion_to_a_gap_of_zero_is_refused():
    """The motion is never completed; neither the message nor the report claims completion."""
    floor = dc.RigidBody.box([1, 1, 0.1], pose=[0, 0, -0.05, 1, 0, 0, 0])
    lid = dc.RigidBody.box([1, 1, 0.1], pose=[0.01, 0.02, 0.15, 1, 0, 0, 0], motion="kinematic")
    cloth = dc.Cloth.grid(5, 5, size=0.4, pose=[0, 0, 0.05, 1, 0, 0, 0])
    simulator = dc.Simulator(dc.Scene([cloth], [floor, lid]), DT)
    state = simulator.initial_state()
    poses = state.body_poses.clone()
    poses[1, 2] = 0.05
    with pytest.raises(dc.InfeasibleMotion, match=r"motion fraction 1 - \d") as caught:
        simulator.step(state, dc.Control(body_poses=poses))
    assert caught.value.report.motion_fraction < 1
