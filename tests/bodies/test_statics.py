"""Bodies at rest stay, stick and slide by the friction law, and contact carries their weight."""

import math

import numpy as np
import pytest
import scenes
import torch
from body_scenes import load_arm

import diffcloth_torch as dc
from diffcloth_torch.robots import GRIPPER

F64 = torch.float64
DT = 0.01
G = 9.81
FLOOR = dc.RigidBody.plane(2.0, name="floor")


def rolled(sim, seconds, state=None):
    """States of every step."""
    with torch.no_grad():
        start = sim.initial_state() if state is None else state
        return sim.rollout(start, steps=round(seconds / sim.dt))


@pytest.mark.parametrize("count", [1, 3])
def test_a_cube_and_a_stack_of_cubes_stay(count):
    """Cubes that have come to rest on each other have not moved 5 s later."""
    gap = 7e-4
    cubes = [
        dc.RigidBody.box(
            0.1,
            motion="dynamic",
            density=500.0,
            pose=[0.0, 0.0, 0.05 + gap + k * (0.1 + gap), 1, 0, 0, 0],
        )
        for k in range(count)
    ]
    sim = dc.Simulator(
        dc.Scene([], [FLOOR, *cubes]), DT, contact=dc.ContactOptions(barrier_distance=1e-3)
    )
    rest = rolled(sim, 0.5)[-1]
    poses = torch.stack([state.body_poses for state in rolled(sim, 5.0, rest)])
    drift = poses - rest.body_poses
    assert drift[..., :3].norm(dim=-1).max() < 1e-4
    assert 0.05 * drift[..., 3:].norm(dim=-1).max() < 1e-4
    wrenches = sim.contact_wrenches(rolled(sim, DT, rest)[-1])
    for name in sim.surfaces[1:]:  # each wrench balances the cube's own weight
        assert wrenches[name][2] == pytest.approx(500 * 1e-3 * G, rel=1e-4)
    assert wrenches["floor"][2] == pytest.approx(-count * 500 * 1e-3 * G, rel=1e-4)


@pytest.mark.parametrize("off", [-0.9, 0.9], ids=["sticks", "slides"])
@pytest.mark.parametrize("friction", [0.2, 0.4, 0.7])
def test_a_cube_on_an_incline_slides_from_the_friction_angle_on(friction, off):
    """Off the friction angle by less than one degree, on a tilted plane."""
    angle = math.atan(friction) + math.radians(off)
    slope = np.array([0, math.sin(angle / 2), 0, math.cos(angle / 2)])[[3, 0, 1, 2]]
    normal = np.array([math.sin(angle), 0, math.cos(angle)])
    downhill = torch.tensor([math.cos(angle), 0, -math.sin(angle)], dtype=F64)
    plane = dc.RigidBody.plane(4.0, pose=[0, 0, 0, *slope], friction=friction)
    place = 0.0507 * normal + [0.0, 0.013, 0.0]
    cube = dc.RigidBody.box(
        0.1, motion="dynamic", density=300.0, pose=[*place, *slope], friction=friction
    )
    sim = dc.Simulator(
        dc.Scene([], [plane, cube]), DT, contact=dc.ContactOptions(barrier_distance=1e-3)
    )
    settled, *_, last = rolled(sim, 1.0)[20:]
    way = ((last.body_poses - settled.body_poses)[1, :3] * downhill).sum()
    speed = (last.body_velocities[1, :3] * downhill).sum()
    if off < 0:
        # Sticking is creeping below the slip velocity.
        assert abs(speed) < 1e-3
        assert way < 1e-3
    else:
        acceleration = G * (math.sin(angle) - friction * math.cos(angle))
        gained = speed - (settled.body_velocities[1, :3] * downhill).sum()
        seconds = float(last.time - settled.time)
        assert gained == pytest.approx(acceleration * seconds, rel=0.02)


def test_a_box_dropped_into_a_pinned_cloth_settles_on_it():
    vertices, faces = scenes.grid(7, 7, edge=0.06, seed=4)
    vertices -= vertices.mean(axis=0)
    rim = np.flatnonzero(np.abs(vertices[:, :2]).max(axis=1) > 0.15)
    cloth = dc.Cloth(
        vertices,
        faces,
        material=dc.Material(stretch=400.0, density=0.2, damping=0.05),
        pins={"rim": rim},
    )
    box = dc.RigidBody.box(
        [0.1, 0.12, 0.06], motion="dynamic", mass=0.2, pose=[0.01, 0.005, 0.12, 1, 0.1, 0.2, 0.3]
    )
    sim = dc.Simulator(dc.Scene([cloth], [box]), DT)
    state = rolled(sim, 4.0)[-1]
    assert state.body_velocities.abs().max() < 1e-3
    assert state.body_poses[0, 2] < 0.05  # in the hollow under the box
    force = sim.contact_wrenches(state)["body0"]
    weight = 0.2 * G
    assert force[2] == pytest.approx(weight, rel=1e-5)
    assert force[:2].abs().max() < 1e-5 * weight
    assert force[3:].abs().max() < 1e-5 * weight * 0.1


def laid(pins, *bodies):
    """Bodies on a level sheet of 11 x 11 vertices, pinned where `pins(x, y)` is true."""
    cloth = dc.Cloth.grid(
        11,
        11,
        size=(0.5, 0.5),
        material=dc.Material(stretch=300.0, bending=1e-4, damping=0.05),
        name="sheet",
    )
    x, y, _ = cloth.vertices.T
    pinned = np.flatnonzero(pins(x - x.mean(), y - y.mean()))
    cloth = dc.Cloth(
        cloth.vertices - cloth.vertices.mean(axis=0),
        cloth.faces,
        material=cloth.material,
        pins={"held": pinned},
        name="sheet",
    )
    return dc.Simulator(
        dc.Scene([cloth], bodies), DT, solver=dc.SolverOptions(tolerance=1e-9, max_iterations=500)
    )


def on_sheet(shape, **keywords):
    lying = [math.sqrt(0.5), 0, math.sqrt(0.5), 0]
    turn = [1, 0, 0, 0] if shape == "box" else lying
    given = {"motion": "dynamic", "mass": 0.2, "pose": [0.013, 0.007, 0.053, *turn], **keywords}
    if shape == "box":
        return dc.RigidBody.box(0.1, **given)
    return dc.RigidBody.capsule(0.05, 0.1, **given)


WAYS_TO_PIN = {
    "all over": lambda x, y: np.full(x.shape, fill_value=True),
    "along a border": lambda x, y: np.abs(x) < 0.08,
    "in spots": lambda x, y: (np.abs(x) > 0.2) | (np.hypot(x, y) < 0.06),
}


@pytest.mark.parametrize("pins", WAYS_TO_PIN)
@pytest.mark.parametrize("shape", ["box", "capsule"])
def test_pinned_cloth_bears_a_body(shape, pins):
    """Some triangles have three pinned corners; the pins are also moved up."""
    sim = laid(WAYS_TO_PIN[pins], on_sheet(shape))
    state = sim.initial_state()
    with torch.no_grad():
        for _ in range(100):
            state = sim.step(state)
            # Damp the oscillation.
            state = state.replace(
                velocities=0.7 * state.velocities, body_velocities=0.7 * state.body_velocities
            )
        assert state.report.contact_count > 0
        still = sim.step(state.replace(velocities=0 * state.velocities))
        weight = 0.2 * G
        # A partly free sheet still oscillates slightly, and the capsule rolls.
        rel = (1e-6 if shape == "box" else 1e-3) if pins == "all over" else 1e-2
        assert still.body_forces[:, 2].sum() == pytest.approx(weight, rel=rel)
        height = still.body_poses[0, 2]
        rows = torch.tensor(sim.scene.cloths[0].pins["held"])
        for _ in range(5):
            target = still.positions[rows] + torch.tensor([0, 0, 1e-3], dtype=F64)
            still = sim.step(still, sim.control(pins=target))
        assert still.body_poses[0, 2] - height == pytest.approx(5e-3, abs=1e-3)


def test_fingers_grip_cloth_that_is_pinned_all_over():
    """The contact force on both sides equals the drives' force."""
    sheet = dc.Cloth.grid(9, 9, size=(0.2, 0.2), name="sheet")
    cloth = dc.Cloth(sheet.vertices, sheet.faces, pins={"all": range(81)}, name="sheet")
    edge = cloth.vertices[:, 0].max()
    hand = dc.Robot.load(
        GRIPPER,
        pose=[edge + 0.061, cloth.vertices[:, 1].mean(), 0, 0.5, -0.5, -0.5, 0.5],
        joint_positions=0.035,
        actuation="pd",
        stiffness=400.0,
        damping=30.0,
        name="hand",
    )
    sim = dc.Simulator(dc.Scene([cloth], [], [hand], gravity=(0, 0, 0)), DT)
    state = sim.initial_state()
    closed = torch.full_like(state.joint_positions, 0.0394)
    with torch.no_grad():
        for _ in range(60):
            state = sim.step(state, sim.control(joint_positions=closed))
    presses = 400.0 * (closed - state.joint_positions)
    assert (presses > 0.05).all()
    forces = [w[2] for w in sim.contact_wrenches(state).values() if w[2] != 0]
    assert len(forces) == 2
    for force, press in zip(forces, presses, strict=True):
        assert abs(force) == pytest.approx(press.item(), rel=1e-4)


def test_gradients_of_a_body_on_pinned_cloth_are_those_of_differences():
    """A loss on two steps, differentiated by the pins' targets, the body's mass and thickness."""
    sim = laid(lambda x, y: np.abs(x) < 0.25, on_sheet("box"))
    with torch.no_grad():
        start = sim.rollout(sim.initial_state(), steps=20)[-1]
    rows = torch.tensor(np.asarray(sim.scene.cloths[0].pins["held"], dtype=np.int64))
    shape = torch.linspace(0, 1, 3 * len(rows), dtype=F64).reshape(-1, 3)

    def end(theta):
        given = sim.default_parameters()
        thickness = torch.stack([1e-3 * theta[2], 0 * theta[2]])
        given = given.replace(body_mass=theta[1:2], thickness=thickness)
        pins = start.positions[rows] + 1e-4 * theta[0] * shape
        states = sim.rollout(start, [sim.control(pins=pins)] * 2, given)
        after = states[-1]
        return (
            after.body_poses[0, :3].sum()
            + after.body_velocities.sum()
            + after.body_forces[:, 2].sum()
        )

    theta = torch.tensor([0.3, 0.2, 0.02], dtype=F64, requires_grad=True)
    (found,) = torch.autograd.grad(end(theta), theta)
    for i, step in enumerate((1e-4, 1e-5, 1e-4)):
        d = torch.zeros(3, dtype=F64)
        d[i] = step
        with torch.no_grad():
            slope = (end(theta + d) - end(theta - d)) / (2 * step)
        assert slope.item() == pytest.approx(found[i].item(), rel=1e-4)
        assert found[i] != 0


# --- Robots --------------------------------------------------------------------------------------


def weightless(robot, *bodies):
    options = dc.ContactOptions(barrier_distance=2e-3, barrier_stiffness=1e4)
    return dc.Simulator(dc.Scene([], bodies, [robot], gravity=(0, 0, 0)), DT, contact=options)


@pytest.mark.parametrize(
    ("joint", "side", "limit", "span"),
    [
        ("slide", 1, 0.3, 0.5),
        ("slide", -1, -0.2, 0.5),
        # The mimic joint is at its own limit there: 0.5 turn + 0.1 = 1.
        ("turn", 1, 1.8, 2.8),
        ("turn", -1, -1.0, 2.8),
    ],
)
@pytest.mark.parametrize("effort", [0.5, 5.0])
def test_a_joint_driven_at_its_limit_stops_within_a_hundredth_of_its_range(
    joint, side, limit, span, effort, tmp_path
):
    near = limit - side * 0.05 * span
    arm = load_arm(tmp_path, actuation="torque", joint_positions={joint: near}, name="arm")
    sim = weightless(arm)
    given = sim.default_parameters()
    # Viscosity damps the rebound from the limit.
    given = given.replace(joint_viscosity=torch.full((3,), 1.0, dtype=F64))
    control = sim.control(joint_efforts={joint: side * effort})
    row = arm.joint_names.index(joint)
    state = sim.initial_state()
    with torch.no_grad():
        for _ in range(200):
            state = sim.step(state, control, given)
            beyond = side * (float(state.joint_positions[row]) - limit)
            assert beyond < 0.01 * span
    assert beyond > 0  # the barrier begins at the limit
    assert state.joint_velocities[row].abs() < 1e-3


def driven_arm(folder):
    """An arm with compliant drives that yield to a push on its tip."""
    return load_arm(
        folder,
        stiffness={"slide": 300.0, "turn": 3.0, "spin": 2.0},
        damping={"slide": 60.0, "turn": 0.6, "spin": 0.4},
        joint_positions=[0.0, 0.4, 0.2],
        name="arm",
    )


def test_a_joint_that_follows_another_pushes_its_leader(tmp_path):
    """At rest drives balance contact forces f: effort = -sum f . dx/dq, of all points x."""
    robot = driven_arm(tmp_path)
    (surface,) = (s for s in robot.surfaces if s is not None)

    def points(q):
        frame = robot.forward_kinematics(q)["d"]
        return torch.tensor(surface.vertices) @ frame[:3, :3].T + frame[:3, 3]

    start = torch.tensor(robot.joint_positions)
    tip = points(start).numpy()
    # A wall beside the tip, which then moves 1 cm towards the tip.
    wall = dc.RigidBody.box(
        [0.1, 0.2, 0.2],
        motion="kinematic",
        pose=[tip[:, 0].max() + 0.053, *tip[:, 1:].mean(axis=0), 1, 0, 0.05, 0],
        friction=0.0,
        name="wall",
    )
    sim = weightless(robot, wall)
    state = sim.initial_state()
    with torch.no_grad():
        for k in range(400):
            pose = state.body_poses.clone()
            pose[0, 0] -= 1e-3 * (k < 10)
            state = sim.step(state, dc.Control(body_poses=pose))
    assert state.joint_velocities.abs().max() < 1e-5
    frames = sim.link_poses(state)
    follow = frames["arm/c"][:3, :3].T @ frames["arm/d"][:3, :3]
    angle = float(torch.atan2(follow[0, 2], follow[0, 0]))
    assert angle == pytest.approx(0.5 * float(state.joint_positions[1]) + 0.1, abs=1e-12)

    forces = state.body_forces[sim.slices["arm/d"]]
    assert forces.sum(0).norm() > 0.1
    jacobian = torch.autograd.functional.jacobian(points, state.joint_positions)
    balance = state.joint_efforts + torch.einsum("vi,vij->j", forces, jacobian)
    assert state.joint_efforts.abs().min() > 1e-3
    assert balance.abs().max() < 1e-4 * state.joint_efforts.abs().max()


def test_a_wall_pushes_an_arm_that_is_alone_with_it(tmp_path):
    """Without a cloth or a free body the barrier's default stiffness comes from the joints."""
    robot = driven_arm(tmp_path)
    (surface,) = (surface for surface in robot.surfaces if surface is not None)
    frame = robot.forward_kinematics(torch.tensor(robot.joint_positions))["d"].numpy()
    tip = surface.vertices @ frame[:3, :3].T + frame[:3, 3]
    pose = [tip[:, 0].max() + 0.053, *tip[:, 1:].mean(axis=0), 1, 0, 0.05, 0]
    wall = dc.RigidBody.box([0.1, 0.2, 0.2], motion="kinematic", pose=pose, name="wall")
    sim = dc.Simulator(
        dc.Scene([], [wall], [robot], gravity=(0, 0, 0)),
        DT,
        contact=dc.ContactOptions(barrier_distance=2e-3),
    )
    assert sim.default_parameters().barrier_stiffness > 0
    state = sim.initial_state()
    with torch.no_grad():
        for _ in range(8):
            poses = state.body_poses.clone()
            poses[0, 0] -= 0.1 * DT
            state = sim.step(state, dc.Control(body_poses=poses))
    force = state.body_forces[sim.slices["arm/d"]].sum(0)
    assert force[0] < -0.1
    # The drives resist the wall.
    assert state.joint_efforts.abs().max() > 0.01
    assert sim.initial_state().joint_positions[1] - state.joint_positions[1] > 0.01
