"""A body in free flight without contact changes no bit of all other motion."""

import importlib
from pathlib import Path

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

ROOT = Path(__file__).parents[2]
DT = 0.01
STEPS = 30
SPEEDS = torch.tensor([1.5, -0.4, 2.0, 9.0, 4.0, -7.0], dtype=torch.float64)  # [m/s, rad/s]


def sheet(rows, columns, height, angle, **material):
    turn = [np.cos(angle / 2), 0.2 * np.sin(angle / 2), np.sin(angle / 2), 0]
    return dc.Cloth.grid(
        rows,
        columns,
        size=(0.03 * (columns - 1), 0.03 * (rows - 1)),
        pose=[0.01, 0.02, height, *turn],
        material=dc.Material(**material),
    )


def box(*place, side=0.05, mass=0.1):
    return dc.RigidBody.box(side, motion="dynamic", mass=mass, pose=[*place, 1, 0, 0, 0])


def stiff_sheets(scenes):
    """Two sheets fold over a ball, and a box falls onto the sheets."""
    cloths = [
        sheet(12, 11, 0.08, 0.7, density=0.2, stretch=900, bending=2e-5),
        sheet(9, 8, 0.2, 0.1, density=0.1, stretch=300, bending=2e-5),
    ]
    ball = dc.RigidBody.sphere(0.07, subdivisions=2, pose=[0, 0, -0.08, 1, 0, 0, 0])
    return scenes.Scene(dc.Scene(cloths, [ball, box(0.02, 0, 0.3)]), approach=STEPS)


def sheet_on_moving_box(scenes):
    """A sheet pinned at one side lies on a box that moves away below the sheet."""
    cloth = sheet(13, 13, 0.001, 0.0, stretch=2000, bending=1e-5)
    pinned = dc.Cloth(cloth.vertices, cloth.faces, pins={"side": range(13)})
    body = dc.RigidBody.box(0.2, motion="kinematic", pose=[0, 0, -0.11, 1, 0, 0, 0])
    return scenes.Scene(dc.Scene([pinned], [body]), approach=STEPS, body_speed=(0.2, 0, 0))


OWN = {"stiff-sheets": stiff_sheets, "sheet-on-moving-box": sheet_on_moving_box}
TIMED = (
    "hanging", "stiff", "plane", "sphere", "self-contact", "two-sheets", "moving-body",
    "twist", "crumple", "impact",
    "damped", "damped-sphere", "air", "woven-sphere", "smooth-sphere", "gripper", "limited-gripper",
)  # fmt: skip
FAR = {
    "one": [box(30.0, 3.0, 0.0, side=0.5, mass=95.0)],
    "three": [box(30.0 + k, 3.0, 0.0, side=0.5, mass=10.0**k) for k in range(3)],
}


@pytest.fixture
def scenes(monkeypatch):
    """The scenes of the benchmarks."""
    monkeypatch.syspath_prepend(ROOT)
    return importlib.import_module("benchmarks.scenes")


def timed(scenes):
    return {**scenes.SCENES, **scenes.BUCKLING, **scenes.FURTHER}


def make(scenes, name):
    return OWN[name](scenes) if name in OWN else timed(scenes)[name](14)


def run(given, far, steps, speeds=SPEEDS):
    """States of the scene with the bodies `far` added, at these start velocities."""
    near = len(given.scene.bodies)
    scene = given.scene
    contact = dc.ContactOptions(barrier_distance=2e-3) if not scene.cloths else dc.ContactOptions()
    given_bodies = [*scene.bodies, *far]
    sim = dc.Simulator(dc.Scene(scene.cloths, given_bodies, scene.robots), DT, contact=contact)
    state = sim.initial_state()
    spins = state.body_velocities.clone()
    spins[near:] = speeds
    speeds = torch.zeros_like(state.velocities) + torch.tensor(given.speed, dtype=torch.float64)
    states = [state.replace(velocities=speeds, body_velocities=spins)]
    with torch.no_grad():
        for _ in range(steps):
            control = given.control(states[-1])
            if control.body_poses is not None:
                control.body_poses[near:] = states[-1].body_poses[near:]
            states.append(sim.step(states[-1], control))
    return states[1:]


@pytest.mark.quick(
    "stiff-sheets-one",
    "hanging-one",
    "self-contact-one",
    "crumple-one",
    "air-one",
    "limited-gripper-one",
)
@pytest.mark.parametrize(
    ("name", "far"),
    [*((name, far) for name in OWN for far in FAR), *((name, "one") for name in TIMED)],
)
def test_no_bit_changes(scenes, name, far):
    given = make(scenes, name)
    near = len(given.scene.bodies)
    steps = given.approach + 3
    alone = run(given, [], steps)
    joined = run(given, FAR[far], steps)
    touched = 0
    for a, b in zip(alone, joined, strict=True):
        assert torch.equal(a.positions, b.positions)
        assert torch.equal(a.joint_positions, b.joint_positions)
        assert torch.equal(a.body_poses, b.body_poses[:near])
        assert a.report.iterations == b.report.iterations
        touched += a.report.contact_count > 0
    assert touched > steps // 2 or name not in OWN


def test_every_timed_scene_is_tested(scenes):
    assert set(TIMED) == set(timed(scenes))


def test_far_bodies_fly_as_alone(scenes):
    joined = run(stiff_sheets(scenes), FAR["one"], STEPS)
    alone = run(scenes.Scene(dc.Scene([], [box(0, 0, 9.0)]), approach=0), FAR["one"], STEPS)
    for a, b in zip(alone, joined, strict=True):
        assert torch.equal(a.body_poses[1], b.body_poses[2])


@pytest.mark.parametrize("name", ["stiff-sheets", "impact", "hanging"])
def test_a_body_that_rests_far_away_changes_little(scenes, name):
    """One solve moves both, to a tolerance; end states once differed by 4 and 8 cm."""
    given = make(scenes, name)
    floor = dc.RigidBody.plane(2.0, pose=[30, 0, -3, 1, 0, 0, 0])
    place = [30.0, 0.0, -3 + 0.25 + 0.004]
    resting = dc.RigidBody.box(0.5, motion="dynamic", mass=50.0, pose=[*place, 1, 0, 0, 0])
    steps = given.approach + 3
    alone = run(given, [], steps)
    joined = run(given, [floor, resting], steps, speeds=torch.zeros(6, dtype=torch.float64))
    for a, b in zip(alone, joined, strict=True):
        assert (a.positions - b.positions).abs().max() < 1e-5
    assert (joined[-1].body_poses[-1, :3] - torch.tensor(place)).abs().max() < 0.01
