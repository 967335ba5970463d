"""Objects that rotate together do not slide: friction in grips and between spinning sheets."""

import math

import numpy as np
import pytest
import torch
from physics_scenes import F64, matrix, quaternion, tensor

import diffcloth_torch as dc
from diffcloth_torch.geometry.rotation import quaternion_multiply

SLIP = 1e-3  # [m/s]


def creep(share):
    """Creep speed of a sticking load that is this share of the largest friction [m/s]."""
    return SLIP * (1 - math.sqrt(1 - share))


def turned(poses, angle):
    """Poses rotated about the z axis, and the matrix of the rotation."""
    q = quaternion([0, 0, 1], angle)
    R = tensor(matrix(q))
    turns = quaternion_multiply(tensor(q).expand(len(poses), 4), poses[:, 3:])
    return torch.cat([poses[:, :3] @ R.T, turns], 1), R


def plate(x, y, name):
    pose = [x, y, 0, 1, 0, 0, 0]
    return dc.RigidBody.box(
        (0.02, 0.12, 0.11), motion="kinematic", friction=0.5, pose=pose, name=name
    )


@pytest.mark.parametrize("barrier_distance", [5e-4, 4e-3])
def test_a_held_box_creeps_no_more_in_a_turning_grip(barrier_distance):
    """A box between two plates, pulled by a third of the largest friction."""
    side, seconds, dt = 0.05, 1.0, 0.02
    x = side / 2 + 0.01 + 0.6 * barrier_distance
    box = dc.RigidBody.box((side, 0.04, 0.035), motion="dynamic", mass=0.1, friction=0.5)
    sim = dc.Simulator(
        dc.Scene([], [plate(-x, 0, "left"), plate(x, 0, "right"), box], gravity=(0, 0, 0)),
        dt,
        contact=dc.ContactOptions(barrier_distance=barrier_distance, slip_velocity=SLIP),
        solver=dc.SolverOptions(tolerance=1e-9),
    )
    state = sim.step(sim.initial_state())
    load = 2 * 0.5 * sim.contact_wrenches(state)["left"][0].abs() / 3
    wrenches = torch.zeros(3, 6, dtype=F64)
    wrenches[2, 2] = -load
    start = state.body_poses
    for k in range(round(seconds / dt)):
        poses, R = turned(start, 2 * math.pi * (k + 1) * dt / seconds)
        poses = torch.cat([poses[:2], state.body_poses[2:]])
        state = sim.step(state, sim.control(body_poses=poses, body_wrenches=wrenches))
    way = R.T @ state.body_poses[2, :3] - start[2, :3]
    # The plates press a little less than in the first step.
    assert 0.95 < -way[2] / (creep(1 / 3) * seconds) < 1.15
    assert way[:2].abs().max() < 1e-9


def spinning_sheets(share):
    """Distance by which two sheets leave a spinning hand in 40 ms [m].

    The sheets' weight and the hand's spin require the share `share` of the largest friction.
    """
    radius, side, dt, d_hat, mu = 0.1, 0.08, 0.004, 2e-3, 0.4
    material = dc.Material(stretch=500, bending=1e-4, friction=mu, density=0.2, damping=0.01)
    upright = quaternion([0, 1, 0], math.pi / 2)
    gap = 0.6 * d_hat
    sheets = [
        # Different meshes and angles avoid coincident edges.
        dc.Cloth.grid(
            n,
            n,
            size=(side, side),
            material=material,
            pose=[x, radius, 0, *quaternion_of(upright, angle)],
            name=f"sheet{n}",
        )
        for n, x, angle in ((5, -gap / 2, 0.0), (4, gap / 2, 0.1))
    ]
    x = 1.5 * gap + 0.01
    plates = [plate(-x, radius, "left"), plate(x, radius, "right")]
    plates = [
        dc.RigidBody(p.vertices, p.faces, motion="kinematic", friction=mu, pose=p.pose, name=p.name)
        for p in plates
    ]
    sim = dc.Simulator(
        dc.Scene(sheets, plates, gravity=(0, 0, 0)),
        dt,
        contact=dc.ContactOptions(
            barrier_distance=d_hat, barrier_stiffness=50.0, slip_velocity=SLIP
        ),
        solver=dc.SolverOptions(tolerance=1e-8),
    )
    state = sim.initial_state()
    for _ in range(25):
        state = sim.step(state)
    normal = sim.contact_wrenches(state)["left"][0].abs().item()
    mass = 2 * 0.2 * side**2
    speed = math.sqrt(share * 2 * mu * normal / (mass * radius))
    axis = tensor([0, 0, speed]).expand_as(state.positions)
    state = state.replace(velocities=torch.linalg.cross(axis, state.positions))
    start, poses = state.positions, state.body_poses
    for k in range(10):
        target, R = turned(poses, speed * dt * (k + 1))
        state = sim.step(state, sim.control(body_poses=target))
    return (state.positions @ R - start)[:, 1].mean().item(), 10 * dt, speed * dt


def quaternion_of(first, angle):
    """`first`, after a turn about z by an angle."""
    return quaternion_multiply(tensor(first), tensor(quaternion([0, 0, 1], angle))).tolist()


def test_a_spinning_hand_holds_two_sheets_up_to_their_friction():
    out, seconds, angle = spinning_sheets(0.95)
    assert angle > 0.1  # a step
    assert abs(out) < 1.1 * creep(0.95) * seconds
    out, seconds, _ = spinning_sheets(1.05)
    assert out > 10 * SLIP * seconds


@pytest.mark.parametrize("barrier_distance", [1e-3, 4e-3])
def test_two_boxes_that_spin_as_one_keep_their_spin(barrier_distance):
    """Pressed by 30 N, about an axis in their common plane, for a second."""
    side, dt, omega, force = 0.1, 0.01, 3.0, 30.0

    def box(z, name):
        pose = [0, 0, z, 1, 0, 0, 0]
        return dc.RigidBody.box(
            side, motion="dynamic", density=500.0, friction=0.5, pose=pose, name=name
        )

    z = side / 2 + 0.35 * barrier_distance
    sim = dc.Simulator(
        dc.Scene([], [box(z, "up"), box(-z, "down")], gravity=(0, 0, 0)),
        dt,
        contact=dc.ContactOptions(barrier_distance=barrier_distance),
        solver=dc.SolverOptions(tolerance=1e-9),
    )

    def press(state, turn):
        """Press along the line between the centers at the end of the step: nearly no couple."""
        way = state.body_poses[0, :3] - state.body_poses[1, :3]
        R = tensor(matrix(quaternion([1, 0, 0], turn)))
        along = force * R @ (way / way.norm())
        pair = torch.stack([-along, along])
        return sim.control(body_wrenches=torch.cat([pair, torch.zeros(2, 3, dtype=F64)], 1))

    state = sim.initial_state()
    for _ in range(40):
        state = sim.step(state, press(state, 0.0))
        state = state.replace(body_velocities=torch.zeros_like(state.body_velocities))
    axis = tensor([omega, 0, 0]).expand(2, 3)
    spin = torch.cat([torch.linalg.cross(axis, state.body_poses[:, :3]), axis], 1)
    state = state.replace(body_velocities=spin)
    momentum = sim.momentum(state)[3]
    impulse = torch.zeros(3, dtype=F64)
    for _ in range(100):
        state = sim.step(state, press(state, omega * dt))
        for place, wrench in zip(
            state.body_poses[:, :3], sim.contact_wrenches(state).values(), strict=True
        ):
            impulse += dt * (wrench[3:] + torch.linalg.cross(place, wrench[:3]))
    # Angular impulse of contact: only due to the change of the gap in a step.
    assert impulse.norm() < 1e-3 * momentum
    rates = state.body_velocities[:, 3]
    assert rates[0] == pytest.approx(rates[1].item(), abs=1e-3)


@pytest.mark.parametrize("turn", [0.2, 0.8])
def test_gradients_of_a_grip_that_turns_are_those_of_differences(turn):
    """Final pose of a slightly slipping box, by the rotation, the pressing pose and friction."""
    d_hat = 2e-3
    x = 0.025 + 0.01 + 0.5 * d_hat
    box = dc.RigidBody.box((0.05, 0.04, 0.035), motion="dynamic", mass=0.1, friction=0.5)
    other = dc.RigidBody.box(
        (0.03, 0.05, 0.04), motion="dynamic", mass=0.2, friction=0.5, pose=[0.044, 0, 0, 1, 0, 0, 0]
    )
    sim = dc.Simulator(
        dc.Scene([], [plate(-x, 0, "left"), box, other], gravity=(-9.81, 0, 0)),
        0.01,
        contact=dc.ContactOptions(
            barrier_distance=d_hat, barrier_stiffness=5e4, slip_velocity=0.05
        ),
        solver=dc.SolverOptions(tolerance=1e-12, max_iterations=1000),
    )
    start = sim.initial_state()
    for _ in range(3):
        start = sim.step(start)

    def end(theta):
        """Two steps; theta: the turn in each, a shift of the plate [mm] and the friction."""
        state = start.detach()
        pose = start.body_poses[0].detach()
        given = sim.default_parameters()
        given = given.replace(friction=theta[2] * torch.ones_like(given.friction))
        for k in (1, 2):
            half = 0.5 * k * theta[0]
            zero = torch.zeros_like(half)
            q = torch.stack([torch.cos(half), zero, torch.sin(half), zero])
            place = torch.stack([pose[0] + 1e-3 * theta[1], pose[1], pose[2]])
            target = torch.cat([place, quaternion_multiply(q, pose[3:])])
            poses = torch.cat([target[None], state.body_poses[1:]])
            state = sim.step(state, sim.control(body_poses=poses), given)
        return (
            state.body_poses[1:, :3].sum()
            + state.body_poses[1:, 3:].square().sum()
            + (state.body_velocities[1:] * tensor([1, -2, 3, 0.1, 0.2, 0.3])).sum()
        )

    theta = tensor([turn, 0.05, 0.3]).requires_grad_()
    (found,) = torch.autograd.grad(end(theta), theta)
    for i, step in enumerate((1e-6, 1e-5, 1e-5)):
        d = step * np.eye(3)[i]
        with torch.no_grad():
            slope = (end(theta + tensor(d)) - end(theta - tensor(d))) / (2 * step)
        assert slope.item() == pytest.approx(found[i].item(), rel=1e-4)
        assert found[i] != 0


@pytest.mark.parametrize("gap", [0.002, 0.012, 0.028])
def test_a_ball_that_strikes_at_a_slant_turns_by_its_radius(gap):
    """For any gap at the start of the step, with sliding friction."""
    radius, mass, inertia, friction, dt = 0.04, 0.3, 0.5, 0.3, 0.01
    ball = dc.RigidBody.sphere(
        radius,
        smooth=True,
        motion="dynamic",
        mass=mass,
        inertia=inertia * np.eye(3),
        center=[0, 0, 0],
        friction=friction,
        pose=[0.001, 0.002, radius + gap, 1, 0, 0, 0],
    )
    floor = dc.RigidBody.plane(20.0, friction=friction, pose=[0.013, 0.027, 0, 1, 0, 0, 0])
    sim = dc.Simulator(
        dc.Scene([], [ball, floor], gravity=(0, 0, 0)),
        dt,
        contact=dc.ContactOptions(barrier_distance=1e-3),
        solver=dc.SolverOptions(tolerance=1e-9),
    )
    state = sim.initial_state()
    velocities = torch.zeros_like(state.body_velocities)
    velocities[0] = tensor([5.0, 0, -3.0, 0, 0, 0])
    state = sim.step(state.replace(body_velocities=velocities))
    change = state.body_velocities[0] - velocities[0]
    left = state.body_poses[0, 2].item() - radius
    assert change[2] > 0.1  # the ball has struck
    assert -change[0] == pytest.approx(friction * change[2].item(), rel=1e-2)
    lever = inertia * change[4] / (mass * -change[0])
    assert lever == pytest.approx(radius + left, rel=1e-3)


@pytest.mark.parametrize("turn", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("smooth", [True, False])
def test_friction_about_a_body_that_spins_is_that_of_its_radius(smooth, turn):
    """A spinning ball gains the angular momentum that a free plate loses."""
    radius, friction, dt = 0.05, 0.3, 0.01
    ball = dc.RigidBody.sphere(
        radius,
        smooth=smooth,
        motion="dynamic",
        density=500.0,
        friction=friction,
        pose=[0.001, 0.002, radius + 6e-4, 1, 0, 0, 0],
    )
    plate = dc.RigidBody.box(
        (0.5, 0.5, 0.1),
        motion="dynamic",
        density=100.0,
        friction=friction,
        pose=[0.013, 0.027, -0.05, 1, 0, 0, 0],
    )
    sim = dc.Simulator(
        dc.Scene([], [ball, plate], gravity=(0, 0, 0)),
        dt,
        contact=dc.ContactOptions(barrier_distance=1e-3, friction_iterations=8),
        solver=dc.SolverOptions(tolerance=1e-9),
    )
    state = sim.initial_state()
    velocities = torch.zeros_like(state.body_velocities)
    velocities[0] = tensor([0, 0, -0.3, 0, turn / dt, 0])
    state = state.replace(body_velocities=velocities)
    masses = sim.default_parameters().body_mass[:, None]
    created, taken = torch.zeros(3, dtype=F64), 0.0
    for _ in range(4):
        after = sim.step(state)
        # Angular momentum is about final positions, to which the start velocities did not lead.
        drift = (
            dt
            * masses
            * torch.linalg.cross(after.body_velocities[:, :3], state.body_velocities[:, :3])
        )
        created += (sim.momentum(after) - sim.momentum(state))[3:] - drift.sum(0)
        taken += abs((after.body_velocities[1, 0] - state.body_velocities[1, 0]).item())
        state = after
    taken *= masses[1].item() * radius
    assert taken > 1e-4
    assert created.norm() < 1e-6 * taken
