"""Bodies and robots that forces move never pass through anything, judged on the path by ipctk."""

import itertools

import numpy as np
import pytest
import scenes
import torch
from coupled_scenes import COUPLINGS, DT, F64
from physics.physics_scenes import Judge

import diffcloth_torch as dc

pytestmark = pytest.mark.filterwarnings("ignore::diffcloth_torch.AddedMassWarning")
SLOW = pytest.mark.slow


def judge_of(sim, ignored=()):
    """Judge with all links as free ones; pairs of names in `ignored` do not count."""
    links = sim.surfaces[len(sim.scene.cloths) + len(sim.scene.bodies) :]
    return Judge(sim, free_links=links, passing=ignored)


FIELDS = (
    *("positions", "velocities", "body_poses", "body_velocities", "joint_positions"),
    *("joint_velocities", "base_poses", "base_velocities"),
)


def roll(sim, state, steps, control=None, *, ignored=(), ignored_between=()):
    """Step, judge each path, and stop at a refused step; all states, and True if one was refused.

    Pairs `ignored_between` may meet between two states. A refusal leaves the given state unchanged.
    """
    judge = judge_of(sim, ignored)
    judge_between = judge_of(sim, [*ignored, *ignored_between])
    assert judge.is_free(state)
    states = [state]
    with torch.no_grad():
        for _ in range(steps):
            before = states[-1]
            kept = [getattr(before, name).clone() for name in FIELDS]
            try:
                path = sim.path(before, control).numpy()
                assert judge_between.is_free_path(path)
                after = sim.step(before, control)
            except dc.SimulationError:
                same = [getattr(before, name) for name in FIELDS]
                assert all(map(torch.equal, kept, same))
                return states, True
            assert np.abs(path[0] - judge.points(before)).max() < 1e-12
            assert np.abs(path[-1] - judge.points(after)).max() < 1e-12
            assert judge.is_free(after)
            states.append(after)
    return states, False


def tumbling_boxes(speed, dt=DT):
    """Boxes and a ball that fall, spin and collide above a floor."""
    rng = np.random.default_rng(1)
    things = [dc.RigidBody.plane(4.0)]
    for k, size in enumerate(([0.1, 0.08, 0.06], [0.2, 0.02, 0.05], [0.05, 0.05, 0.05])):
        pose = [0.05 * k, 0.03 * k, 0.12 + 0.16 * k, *rng.normal(size=4)]
        things.append(dc.RigidBody.box(size, motion="dynamic", density=500.0, pose=pose))
    pose = [0.02, 0.0, 0.6, 1, 0, 0, 0]
    things.append(
        dc.RigidBody.sphere(0.05, subdivisions=1, motion="dynamic", density=500.0, pose=pose)
    )
    sim = dc.Simulator(
        dc.Scene([], things),
        dt,
        contact=dc.ContactOptions(barrier_distance=2e-3),
        solver=dc.SolverOptions(max_iterations=2000),
    )
    velocities = torch.from_numpy(rng.normal(size=(5, 6))) * torch.tensor([1.0] * 3 + [10.0] * 3)
    velocities[1:, 2] -= speed
    return sim, sim.initial_state().replace(body_velocities=velocities)


# Impacts at these speeds cause spins that a step of DT does not resolve; hence shorter steps.
@pytest.mark.quick("1.0-*", "10.0-*")
@pytest.mark.parametrize(("speed", "dt"), [(1.0, DT), (10.0, DT / 5), (30.0, DT / 20)])
def test_tumbling_boxes_never_meet(speed, dt):
    sim, state = tumbling_boxes(speed, dt)
    states, refused = roll(sim, state, 40)
    assert not refused
    assert sum(s.report.contact_count > 0 for s in states[1:]) > 10
    assert (states[-1].body_poses[1:, 2] > 0).all()


def curtain(pins):
    """A vertical sheet in the yz-plane, held at its top edge or all around."""
    vertices, faces = scenes.grid(6, 6, edge=0.08, seed=2)
    vertices = scenes.turned(vertices - vertices.mean(axis=0), (0, 1, 0), np.pi / 2)
    z, y = vertices[:, 2], vertices[:, 1]
    held = z > 0.18
    if pins == "rim":
        held |= (np.abs(z) > 0.18) | (np.abs(y) > 0.18)
    material = dc.Material(stretch=100.0, bending=1e-5)
    return dc.Cloth(vertices, faces, material=material, pins={"held": np.flatnonzero(held)})


@pytest.mark.parametrize("speed", [3.0, 30.0, pytest.param(100.0, marks=SLOW)])
@pytest.mark.parametrize("mass", [0.002, 0.5])
@pytest.mark.parametrize("pins", ["top", "rim"])
@pytest.mark.parametrize("coupling", COUPLINGS)
def test_a_box_thrown_at_a_curtain_never_passes_through(coupling, pins, mass, speed):
    box = dc.RigidBody.box(
        [0.1, 0.03, 0.05], motion="dynamic", mass=mass, pose=[-0.12, 0.01, 0.02, 1, 0.1, 0.4, 0.2]
    )
    sim = dc.Simulator(dc.Scene([curtain(pins)], [box]), DT, coupling=coupling)
    velocity = torch.tensor([[speed, 0.1, 0.0, 3.0, -5.0, 2.0]], dtype=F64)
    states, refused = roll(sim, sim.initial_state().replace(body_velocities=velocity), 8)
    if coupling == "monolithic" and mass == 0.002:
        # At 100 m/s the cloth may spin the box by more than a step allows.
        assert not refused or speed == 100.0
        # The cloth is 15 times as heavy and stops the box if the box has reached the cloth.
        came = states[-1].body_poses[0, 0] > states[0].body_poses[0, 0]
        assert came or refused
        assert not came or states[-1].body_velocities[0, 0] < 0.5 * speed


@pytest.mark.quick(
    "monolithic-fixed-2.0",
    "monolithic-floating-50.0",
    "rigid_to_cloth-floating-2.0",
    "cloth_to_rigid-fixed-50.0",
)
@pytest.mark.parametrize("effort", [2.0, 50.0])
@pytest.mark.parametrize("base", ["fixed", "floating"])
@pytest.mark.parametrize("coupling", COUPLINGS)
def test_a_closing_gripper_never_passes_through(coupling, base, effort):
    """The gripper closes on a sheet with a soft ball in front: cloth, body and links all touch."""
    sheet = dc.Cloth(
        *hanging_sheet(),
        material=dc.Material(stretch=200.0, density=0.2),
        soft_pins={"top": range(5)},
    )
    ball = dc.RigidBody.sphere(
        0.012,
        subdivisions=1,
        motion="dynamic",
        mass=0.01,
        pose=[0.0, 0.02, 0.068, 1, 0, 0, 0],
        name="ball",
    )
    hand = dc.Robot.load(
        dc.robots.GRIPPER, base=base, actuation="torque", joint_positions=0.0, name="hand"
    )
    sim = dc.Simulator(dc.Scene([sheet], [ball], [hand], gravity=(0, 0, 0)), DT, coupling=coupling)
    control = sim.control(joint_efforts=[effort, 0.7 * effort])
    fingers = ("hand/left_finger", "hand/right_finger")
    pairs = {"ignored": [("hand/palm", finger) for finger in fingers]}
    if coupling == "rigid_to_cloth":
        # During the cloth solve, bodies move along straight lines to the poses of their own solve.
        # Their own solve followed another path, on which these pairs did not meet.
        pairs["ignored_between"] = list(itertools.combinations(("ball", *fingers), 2))
    states, refused = roll(sim, sim.initial_state(), 15, control, **pairs)
    if coupling == "monolithic":
        assert not refused
        pushed = [sim.contact_wrenches(state) for state in states]
        for name in ("ball", *fingers):
            assert max(wrenches[name][:3].norm() for wrenches in pushed) > 0.1


def hanging_sheet():
    """A sheet in the plane y = 0 above the palm."""
    vertices, faces = scenes.grid(5, 5, edge=0.014, seed=3)
    vertices = scenes.turned(vertices - vertices.mean(axis=0), (1, 0, 0), -np.pi / 2)
    return vertices + np.array([0, 0, 0.068]), faces


def test_a_driven_arm_sweeps_boxes_aside(tmp_path):
    """A position-driven joint turns by up to 120 degrees in a step."""
    (tmp_path / "arm.urdf").write_text(
        """<robot name="arm"><link name="base"/><link name="bar">
        <collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.02 0.02"/></geometry>
        </collision></link><joint name="turn" type="continuous"><parent link="base"/>
        <child link="bar"/><axis xyz="0 0 1"/></joint></robot>"""
    )
    arm = dc.Robot.load(tmp_path / "arm.urdf", actuation="position", name="arm")
    boxes = [
        dc.RigidBody.box(0.05, motion="dynamic", mass=0.1, pose=[x, y, 0.01, 1, 0, 0, 0.2])
        for x, y in ((0.1, 0.25), (-0.2, 0.2))
    ]
    sim = dc.Simulator(
        dc.Scene([], boxes, [arm], gravity=(0, 0, 0)),
        DT,
        contact=dc.ContactOptions(barrier_distance=2e-3),
    )
    # A short rotation per step pushes the boxes. A long rotation may leave the boxes in place,
    # because they can be displaced and return within the step.
    states, refused = [sim.initial_state()], False
    for degrees in (50.0, 54.0, 58.0, 62.0, 66.0, 70.0, 130.0, 250.0):
        control = sim.control(joint_positions=[np.radians(degrees)])
        (_, after), refused = roll(sim, states[-1], 1, control)
        assert not refused
        assert after.joint_positions[0] == np.radians(degrees)
        states.append(after)
    moved = (states[-1].body_poses - states[0].body_poses)[0, :3].norm()
    assert moved > 0.02
