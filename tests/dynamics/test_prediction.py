"""Bodies and robots by themselves: momentum, energy, prescribed motion, drives, gradients."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from mechanisms import (
    F64,
    TREES,
    frame_of,
    inertia_of,
    make,
    pendulum,
    random_configuration,
    tensor,
)
from tree_in_torch import DifferentialKinematics, Motion, mass_matrix, momentum

from diffcloth_torch.dynamics.bodies import BodyInertia, advance_bodies, predict_bodies
from diffcloth_torch.dynamics.robots import Gains, RobotControl, RobotDynamics, RobotState
from diffcloth_torch.errors import SimulationError
from diffcloth_torch.geometry.rotation import quaternion_exp, quaternion_log, quaternion_multiply

H = 0.01
NO_LINKS, NO_POINTS = torch.zeros(0, dtype=torch.long), torch.zeros(0, 3, dtype=F64)
NO_FORCES = torch.zeros(1, 0, 3, dtype=F64)
GRAVITY = tensor([[0.0, 0.0, -9.81]])
AT_ORIGIN = tensor([[0, 0, 0, 1, 0, 0, 0]])


# Free bodies


def box(mass=2.0, center=(0.1, -0.2, 0.05)):
    inertia = np.diag([0.02, 0.05, 0.06])
    return BodyInertia(tensor([[mass]]), tensor([[center]]), tensor(inertia)[None, None])


def fly(poses, velocities, steps, *, inertia=None, wrench=(0,) * 6, gravity=GRAVITY):
    """States and angular momenta of a body without contact."""
    inertia = box() if inertia is None else inertia
    wrenches = tensor(wrench).reshape(1, 1, 6)
    out = []
    for _ in range(steps):
        prediction = predict_bodies(poses, velocities, inertia, wrenches, gravity, H)
        poses, velocities = advance_bodies(prediction, prediction.target, None, H)
        out.append((poses, velocities, prediction.momentum))
    return out


@pytest.mark.parametrize("rate", [3.0, 10.0, 30.0])
def test_a_tumbling_body_keeps_momentum_and_energy(rate):
    spin = rate * tensor([0.02, 1.0, 0.01])  # near the unstable axis, so the body tumbles
    velocities = torch.cat([torch.zeros(3, dtype=F64), spin]).reshape(1, 1, 6)
    with torch.no_grad():
        flight = fly(AT_ORIGIN[None], velocities, 1000)
    L = torch.cat([momentum for _, _, momentum in flight])[:, 0]
    energy = torch.stack([(m * v[..., 3:]).sum() / 2 for _, v, m in flight])
    turned = torch.cat([p[0, :, 3:] for p, _, _ in flight])
    assert turned.std(0).min() > 0.1
    # Rounding of a thousand rotations.
    assert (L - L[0]).norm(dim=-1).max() < 1e-12 * L[0].norm()
    # Second order in h times the rate; 1e-3 at 10 rad/s is required.
    assert (energy / energy[0] - 1).abs().max() < 1e-3 * max(1.0, (rate / 10) ** 2) / 2


def test_a_body_falls_as_implicit_euler():
    flight = fly(AT_ORIGIN[None], tensor([[[0.3, 0, 1.0, 0, 0, 0]]]), 50)
    pose, velocity, _ = flight[-1]
    n = 50
    expected = tensor([0.3 * n * H, 0, 1.0 * n * H - 9.81 * H * H * n * (n + 1) / 2])
    torch.testing.assert_close(pose[0, 0, :3], expected, rtol=0, atol=1e-13)
    torch.testing.assert_close(velocity[0, 0, :3], tensor([0.3, 0, 1 - 9.81 * n * H]))


def test_a_torque_turns_a_body_about_a_principal_axis():
    """omega_n = n h tau / I, with the angle of implicit Euler."""
    flight = fly(AT_ORIGIN[None], torch.zeros(1, 1, 6, dtype=F64), 20, wrench=(0, 0, 0, 0, 0, 0.3))
    pose, velocity, momentum = flight[-1]
    rate = 20 * H * 0.3
    torch.testing.assert_close(momentum[0, 0], tensor([0, 0, rate]), rtol=0, atol=1e-15)
    torch.testing.assert_close(velocity[0, 0, 3:], tensor([0, 0, rate / 0.06]), rtol=0, atol=1e-13)
    angle = 0.3 / 0.06 * H * H * 20 * 21 / 2
    expected = tensor([math.cos(angle / 2), 0, 0, math.sin(angle / 2)])
    torch.testing.assert_close(pose[0, 0, 3:], expected, rtol=0, atol=1e-14)


def test_quaternions_keep_their_sign_and_any_length_is_accepted():
    start = tensor([[[0, 0, 0, -2.0, 0.1, 0, 0]]])
    velocities = tensor([[[0, 0, 0, 20.0, 0, 0]]])
    for pose, _, _ in fly(start, velocities, 300):
        assert (pose[..., 3:] * start[..., 3:]).sum() > 0
        start = pose


def test_more_than_half_a_turn_in_a_step_keeps_the_sign_too():
    start = tensor([[[0, 0, 0, 1.0, 0, 0, 0]]])
    ((pose, _, _),) = fly(start, tensor([[[0, 0, 0, 400.0, 0, 0]]]), 1)
    expected = -tensor([math.cos(2.0), math.sin(2.0), 0, 0])
    torch.testing.assert_close(pose[0, 0, 3:], expected, rtol=0, atol=1e-13)


def test_a_torque_acts_in_world_axes():
    turned = tensor([[[0, 0, 0, 0.5, 0.5, 0.5, 0.5]]])  # x to y to z to x
    ((_, velocity, momentum),) = fly(
        turned, torch.zeros(1, 1, 6, dtype=F64), 1, wrench=(0, 0, 0, 0.2, 0, 0)
    )
    torch.testing.assert_close(momentum[0, 0], tensor([H * 0.2, 0, 0]), rtol=0, atol=1e-17)
    # The body's z axis is along the world's x.
    expected = tensor([H * 0.2 / 0.06, 0, 0])
    torch.testing.assert_close(velocity[0, 0, 3:], expected, rtol=0, atol=1e-15)


def test_contact_gives_the_body_exactly_its_impulse():
    """A (q - t) is the generalized force; h times its torque in world axes is the change of L."""
    prediction = predict_bodies(
        tensor([[[0, 0, 0, 0.8, 0, 0.6, 0]]]),
        tensor([[[0, 0, 0, 4.0, 2.0, -7.0]]]),
        box(),
        torch.zeros(1, 1, 6, dtype=F64),
        GRAVITY,
        H,
    )
    turn = tensor([0.02, -0.1, 0.3])
    solution = prediction.target + torch.cat([torch.zeros(3, dtype=F64), turn])
    pose, velocity = advance_bodies(prediction, solution, None, H)
    _, rotation = frame_of(pose[0])[0].split([0, 4])
    rotation = rotation[:3, :3]
    L = rotation @ box().inertia[0, 0] @ rotation.T @ velocity[0, 0, 3:]
    torque = (L - prediction.momentum[0, 0]) / H

    # Work of the torque along a small further turn, against the change of the potential.
    def potential(w):
        return (w @ prediction.metric[0, 0, 3:, 3:] @ w) / 2

    for direction in torch.eye(3, dtype=F64):
        eps = 1e-6
        ends = [
            quaternion_log(
                quaternion_multiply(quaternion_exp(s * eps * direction), quaternion_exp(turn))
            )
            for s in (1, -1)
        ]
        work = (potential(ends[0]) - potential(ends[1])) / (2 * eps)
        assert abs(work - torque @ direction) < 1e-7 * torque.norm()


def test_kicks_change_velocities_only():
    poses, velocities = AT_ORIGIN[None], tensor([[[0.1, 0, 0, 1, 2, 3]]])
    args = (poses, velocities, box(), torch.zeros(1, 1, 6, dtype=F64), GRAVITY, H)
    prediction = predict_bodies(*args)
    kick = tensor([[[1.0, -2, 3, 0.1, 0.2, -0.3]]])
    pose, velocity = advance_bodies(prediction, prediction.target, None, H)
    kicked_pose, kicked = advance_bodies(prediction, prediction.target, kick, H)
    torch.testing.assert_close(kicked_pose, pose, rtol=0, atol=0)
    change = (kicked - velocity)[0, 0]
    torch.testing.assert_close(change[:3], H * kick[0, 0, :3] / 2.0, rtol=0, atol=1e-15)
    R = frame_of(pose[0])[0, :3, :3]
    expected = torch.linalg.solve(R @ box().inertia[0, 0] @ R.T, H * kick[0, 0, 3:])
    torch.testing.assert_close(change[3:], expected, rtol=0, atol=1e-14)


def test_gradients_of_free_bodies():
    rng = np.random.default_rng(0)
    poses = tensor(rng.normal(size=(2, 1, 7)))
    velocities = tensor(rng.normal(size=(2, 1, 6)) * 5)
    inertia = box()
    wrench = tensor(rng.normal(size=(1, 1, 6)))
    offset = tensor(rng.normal(size=(1, 1, 6)) * 0.01)

    def step(poses, velocities, mass, center, moments, wrench, gravity, offset):
        own = BodyInertia(mass, center, (moments + moments.mT) / 2)
        p = predict_bodies(poses, velocities, own, wrench, gravity, H)
        return (p.metric, p.coordinates, p.frames, *advance_bodies(p, p.target + offset, wrench, H))

    inputs = (poses, velocities, *inertia, wrench, GRAVITY, offset)
    inputs = [t.clone().requires_grad_() for t in inputs]
    # Differences of the metric, of order 1e4, with steps of 1e-6.
    assert torch.autograd.gradcheck(step, inputs, rtol=1e-6, atol=1e-6)


# Robots


def controls(chain, **given):
    J = chain.mechanism.joint_count
    rows = {"pose": AT_ORIGIN, "wrench": torch.zeros(1, 6, dtype=F64)}
    rows |= {name: torch.zeros(1, J, dtype=F64) for name in ("joints", "rates", "efforts")}
    return RobotControl(**(rows | given))


def gains(chain, **given):
    zeros = torch.zeros(1, chain.mechanism.joint_count, dtype=F64)
    return Gains(**({"stiffness": zeros, "damping": zeros, "viscosity": zeros} | given))


def at_rest(chain, joints=None, pose=AT_ORIGIN, velocity=None, rates=None):
    zeros = torch.zeros(1, chain.mechanism.joint_count, dtype=F64)
    return RobotState(
        pose=pose,
        velocity=torch.zeros(1, 6, dtype=F64) if velocity is None else velocity,
        joints=zeros if joints is None else joints,
        rates=zeros if rates is None else rates,
    )


def step(chain, state, *, control=None, drives=None, gravity=GRAVITY, inertia=None):
    """One step with quadratic terms only, for which the core's solution is known."""
    inertia = inertia_of(chain.mechanism) if inertia is None else inertia
    p = chain.predict(state, control or controls(chain), inertia, drives or gains(chain), gravity)
    q = torch.where(chain.prescribed, p.ends, p.target)
    if chain.prescribed.any() and not chain.prescribed.all():
        free = torch.nonzero(~chain.prescribed)[:, 0]
        shift = ((p.ends - p.target) * chain.prescribed)[..., None]
        pull = (p.metric @ shift)[..., free, 0]
        A = p.metric[..., free[:, None], free]
        q = q.index_add(-1, free, -torch.linalg.solve(A, pull[..., None])[..., 0])
    return p, *chain.advance(p, q, NO_FORCES)


def make_chain(mechanism):
    return RobotDynamics(mechanism, H, NO_LINKS, NO_POINTS)


def energies(chain, state, gravity):
    """Kinetic energy, potential energy, and the power of gravity."""
    inertia = inertia_of(chain.mechanism)
    motion = Motion.at(
        DifferentialKinematics(chain.mechanism), inertia, frame_of(state.pose), state.joints
    )
    nu = torch.cat([state.velocity, state.rates], -1)
    speeds = (motion.jacobian[..., :3, :] @ nu[:, None, :, None])[..., 0]
    weights = inertia.mass[..., None] * gravity
    return (
        float((momentum(motion, inertia, nu) * nu).sum() / 2),
        -float((weights * motion.frames.centers).sum()),
        float((weights * speeds).sum()),
    )


@pytest.mark.parametrize(("rate", "tolerance"), [(3.0, 1e-3), (10.0, 2e-3), (30.0, 1e-2)])
@pytest.mark.parametrize("gravity", [0.0, -9.81])
@pytest.mark.slow
def test_a_double_pendulum_keeps_its_energy(rate, tolerance, gravity):
    """Energy is conserved over 10 s, up to a shift.

    Forces act before velocities move positions, as for free bodies, which shifts the energy by
    h/2 times their power.
    """
    chain = make_chain(pendulum())
    g = tensor([[0, 0, gravity]])
    state = at_rest(chain, tensor([[0.5, 1.0]]), rates=tensor([[rate, -rate / 2]]))
    kept = []
    with torch.no_grad():
        for _ in range(1000):
            kinetic, potential, power = energies(chain, state, g)
            kept.append(kinetic + potential + H / 2 * power)
            _, state, _ = step(chain, state, gravity=g)
    lowest = 9.81 * 3 if gravity else 0.0
    kept = np.array(kept) + lowest
    assert abs(kept / kept[0] - 1).max() < tolerance


def test_a_floating_chain_keeps_its_momentum():
    chain = make_chain(make(*TREES["branched"], base="floating", rng=np.random.default_rng(0)))
    pose, joints, nu = random_configuration(chain.mechanism, np.random.default_rng(1))
    state = RobotState(pose, nu[:, :6], joints, nu[:, 6:])
    inertia = inertia_of(chain.mechanism)
    total = inertia.mass.sum()

    def momenta(state):
        motion = Motion.at(
            DifferentialKinematics(chain.mechanism), inertia, frame_of(state.pose), state.joints
        )
        p = momentum(motion, inertia, torch.cat([state.velocity, state.rates], -1))[0]
        center = motion.frames.centers[0, chain.mechanism.root]
        return p[:3], p[3:6] + torch.linalg.cross(center, p[:3])

    linear, angular = momenta(state)
    for n in range(1, 51):
        _, state, _ = step(chain, state)
        now, turning = momenta(state)
        # Remaining error of eight iterations at 3 rad/s.
        expected = linear + n * H * total * GRAVITY[0]
        torch.testing.assert_close(now, expected, rtol=0, atol=1e-10)
    weightless = RobotState(pose, nu[:, :6], joints, nu[:, 6:])
    for _ in range(50):
        _, weightless, _ = step(chain, weightless, gravity=0 * GRAVITY)
    now, turning = momenta(weightless)
    torch.testing.assert_close(now, linear, rtol=0, atol=1e-10)
    torch.testing.assert_close(turning, angular, rtol=0, atol=1e-9)


def test_a_single_link_on_a_floating_base_moves_like_a_body():
    mechanism = make(*TREES["body"], base="floating", rng=np.random.default_rng(3))
    chain = make_chain(mechanism)
    pose, _, nu = random_configuration(mechanism, np.random.default_rng(4))
    as_body = BodyInertia(*(t for t in inertia_of(mechanism)[:3]))
    args = (pose[None], nu[None, :, :6], as_body, torch.zeros(1, 1, 6, dtype=F64), GRAVITY, H)
    body = predict_bodies(*args)
    p, after, _ = step(chain, at_rest(chain, pose=pose, velocity=nu))
    # The robot moves by the midpoint rule, of third order in a step; the body exactly.
    torch.testing.assert_close(p.target, body.target[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(p.metric, body.metric[0], rtol=1e-5, atol=1e-5)
    poses, velocities = advance_bodies(body, body.target, None, H)
    torch.testing.assert_close(after.pose, poses[0], rtol=0, atol=3e-6)
    torch.testing.assert_close(after.velocity, velocities[0], rtol=0, atol=3e-4)


def test_motion_converges_to_that_of_an_accelerated_pivot():
    """A pendulum on a cart that accelerates hangs at the angle of the apparent gravity."""
    mechanism = pendulum(lengths=(1.0,), masses=(1.0,), base="kinematic")
    chain = make_chain(mechanism)
    a, n = 3.0, 60
    angle = -math.atan2(a, 9.81)  # about y, which moves the bob below to -x: the bob lags behind
    state = at_rest(chain, tensor([[-angle]]))
    for k in range(1, n + 1):
        # Positions of the scheme itself for the acceleration a.
        pose = AT_ORIGIN.clone()
        pose[0, 0] = a * H * H * k * (k + 1) / 2
        _, state, _ = step(chain, state, control=controls(chain, pose=pose))
    torch.testing.assert_close(state.joints, tensor([[-angle]]), rtol=0, atol=1e-10)
    torch.testing.assert_close(state.velocity[0, 0], tensor(a * n * H), rtol=0, atol=1e-9)


def test_prescribed_joints_arrive_exactly():
    rng = np.random.default_rng(6)
    mechanism = make(*TREES["chain"], rng=rng, actuation=("position", "torque", "velocity"))
    chain = make_chain(mechanism)
    _, joints, nu = random_configuration(mechanism, rng)
    target = joints + H * nu[:, 6:] + 0.003
    control = controls(chain, joints=target, rates=tensor([[9.0, 9.0, 1.7]]))
    _, after, efforts = step(chain, at_rest(chain, joints, rates=nu[:, 6:]), control=control)
    assert after.joints[0, 0] == target[0, 0]
    torch.testing.assert_close(after.joints[0, 2], joints[0, 2] + H * 1.7, rtol=0, atol=1e-15)
    torch.testing.assert_close(after.rates[0, 2], tensor(1.7), rtol=0, atol=1e-12)
    assert efforts[0, 1] == 0


def test_a_position_target_is_reached_to_the_last_bit():
    """The rounding of the velocity towards the target has no effect."""
    rng = np.random.default_rng(9)
    mechanism = make(*TREES["chain"], rng=rng, actuation=("position", "torque", "position"))
    chain = make_chain(mechanism)
    joints, targets = tensor(rng.uniform(-1.5, 1.5, (2, 40, 3)))
    state = RobotState(AT_ORIGIN.expand(40, 7), torch.zeros(40, 6, dtype=F64), joints, 0 * joints)
    given = (inertia_of(mechanism), gains(chain), GRAVITY)
    p = chain.predict(state, controls(chain, joints=targets), *given)
    held = [0, 2]
    assert torch.equal(p.ends[:, held], targets[:, held])
    assert torch.equal(p.target[:, held], targets[:, held])
    assert not torch.equal(joints + H * ((targets - joints) / H), targets)


def test_efforts_of_prescribed_joints_move_a_free_chain_alike():
    """Up to a part that falls with the time step."""

    def lag(steps):
        mechanism = make(*TREES["chain"], rng=np.random.default_rng(6), actuation="torque")
        h = 0.2 / steps
        led, free = (
            RobotDynamics(replace(mechanism, actuation=modes), h, NO_LINKS, NO_POINTS)
            for modes in (("position", "torque", "velocity"), ("torque",) * 3)
        )
        joints, nu = tensor([[0.3, -0.5, 0.8]]), tensor([[0.0, 2.0, 1.7]])
        one = other = at_rest(led, joints, rates=nu)
        for k in range(1, steps + 1):
            target = joints + 1 - math.cos(4 * k * h)
            control = controls(led, joints=target, rates=nu)
            _, one, efforts = step(led, one, control=control)
            _, other, _ = step(free, other, control=controls(free, efforts=efforts))
        return (other.joints - one.joints).abs().max()

    coarse, fine = lag(20), lag(40)
    assert fine < 0.02
    assert fine < 0.6 * coarse


def test_a_prescribed_joint_balances_the_drive_beside_it():
    rng = np.random.default_rng(8)
    mixed = make_chain(make(*TREES["chain"], rng=rng, actuation=("position", "pd", "position")))
    _, joints, _ = random_configuration(mixed.mechanism, rng)
    drives = gains(mixed, stiffness=tensor([[0, 300.0, 0]]), damping=tensor([[0, 5.0, 0]]))
    control = controls(mixed, joints=joints + tensor([[0, 0.1, 0]]))
    _, after, efforts = step(mixed, at_rest(mixed, joints), control=control, drives=drives)
    assert (after.joints - joints)[0, 1] > 1e-3
    free = make_chain(make_like(mixed.mechanism, actuation=("torque",) * 3))
    pushed = controls(free, efforts=efforts)
    _, again, _ = step(free, at_rest(free, joints), control=pushed)
    # The masses differ: `mixed` uses the end of the motion without drives, `free` its midpoint.
    moved = (after.joints - joints).abs().max()
    assert (again.joints - after.joints).abs().max() < 0.01 * moved


def test_a_joint_at_rest_holds_its_weight():
    chain = make_chain(make_like(pendulum(), actuation=("position", "torque")))
    joints = tensor([[0.7, -0.7]])  # the second bob hangs straight down from the first
    _, after, efforts = step(chain, at_rest(chain, joints), control=controls(chain, joints=joints))
    # The axis +y turns the first bob from below to -x; the weight of both pulls back.
    expected = tensor([[2 * 9.81 * math.sin(0.7), 0.0]])
    torch.testing.assert_close(efforts, expected, rtol=1e-12, atol=0)
    assert after.rates.abs().max() < 1e-15


def make_like(mechanism, **fields):
    return replace(mechanism, **fields)


def test_drives_are_implicit():
    """One joint: (M + h kd + h^2 kp + h d) qd+ = M qd + h (tau + kp (q_t - q)) + h kd qd_t."""
    mechanism = make_like(pendulum(lengths=(1.0,), masses=(2.0,)), actuation=("pd",))
    chain = make_chain(mechanism)
    M = 2.0 + 1e-4
    q, qd, kp, kd, d, target, rate, tau = 0.3, 0.8, 1e5, 300.0, 2.0, 1.0, 0.5, 7.0
    drives = gains(
        chain,
        stiffness=tensor([[kp]]),
        damping=tensor([[kd]]),
        viscosity=tensor([[d]]),
    )
    control = controls(
        chain, joints=tensor([[target]]), rates=tensor([[rate]]), efforts=tensor([[tau]])
    )
    state = at_rest(chain, tensor([[q]]), rates=tensor([[qd]]))
    _, after, efforts = step(chain, state, control=control, drives=drives, gravity=0 * GRAVITY)
    expected = (M * qd + H * (tau + kp * (target - q)) + H * kd * rate) / (
        M + H * kd + H * H * kp + H * d
    )
    torch.testing.assert_close(after.rates, tensor([[expected]]), rtol=1e-12, atol=0)
    torch.testing.assert_close(after.joints, tensor([[q + H * expected]]), rtol=1e-13, atol=0)
    drive = tau + kp * (target - q - H * expected) + kd * (rate - expected)
    torch.testing.assert_close(efforts, tensor([[drive]]), rtol=1e-9, atol=0)


def test_torque_joints_take_no_notice_of_gains_and_targets():
    chain = make_chain(pendulum())
    plain = step(chain, at_rest(chain), control=controls(chain, efforts=tensor([[1.0, 2.0]])))
    more = {name: tensor([[5.0, 6.0]]) for name in ("joints", "rates")}
    other = step(
        chain,
        at_rest(chain),
        control=controls(chain, efforts=tensor([[1.0, 2.0]]), **more),
        drives=gains(chain, stiffness=tensor([[9.0, 9.0]]), damping=tensor([[9.0, 9.0]])),
    )
    for a, b in zip(plain[1], other[1], strict=True):
        assert torch.equal(a, b)
    torch.testing.assert_close(plain[2], tensor([[1.0, 2.0]]))


def test_velocities_beyond_half_a_turn_in_a_step_are_refused():
    mechanism = make(
        *TREES["chain"], base="floating", rng=np.random.default_rng(0), actuation="torque"
    )
    chain = make_chain(mechanism)
    state = at_rest(chain, rates=tensor([[1e200, 0, 0]]))
    p, after, _ = step(chain, state)
    (sentence,) = chain.too_fast(p).values()
    assert "robot 'tree' are too large for a time step of 0.01" in sentence
    assert torch.equal(after.joints, state.joints)
    assert not chain.too_fast(step(chain, at_rest(chain))[0])


def test_a_body_that_turns_too_fast_is_refused():
    """Only the environment of the body fails, and is named."""
    spins = torch.zeros(2, 1, 6, dtype=F64)
    spins[:, 0, 3:] = tensor([[1.0, 2.0, 3.0], [1e200, 0.0, 1e200]])
    inertia = BodyInertia(tensor([[1.0]]), tensor([[[0, 0, 0]]]), tensor([[np.diag([1, 2, 2.5])]]))
    pose = tensor([0, 0, 0, 1, 0, 0, 0]).expand(2, 1, 7)
    none = torch.zeros(2, 1, 6, dtype=F64)
    predict_bodies(pose[:1], spins[:1], inertia, none[:1], GRAVITY, H)
    with pytest.raises(SimulationError, match=r"body 0 turns at .* time step of 0.01") as error:
        predict_bodies(pose, spins, inertia, none, GRAVITY, H)
    assert error.value.environments == (1,)


CASES = [
    ("fixed", "torque"),
    ("fixed", ("pd", "position", "torque")),
    ("kinematic", ("velocity", "torque", "pd")),
    ("floating", ("pd", "position", "torque")),
    ("kinematic", "position"),
]


@pytest.mark.parametrize(("base", "actuation"), CASES)
def test_gradients_of_robots(base, actuation):
    """Gradients by every input, after two steps."""
    rng = np.random.default_rng(7)
    mechanism = make(*TREES["chain"], base=base, rng=rng, actuation=actuation)
    points, links = tensor(rng.normal(size=(3, 3))), torch.tensor([0, 2, 3])
    chain = RobotDynamics(mechanism, H, links, points)
    pose, joints, nu = random_configuration(mechanism, rng)
    forces = tensor(rng.normal(size=(1, 3, 3)))
    offset = tensor(rng.normal(size=(1, chain.coordinate_count)) * 1e-3)
    weights = inertia_of(mechanism, rng.uniform(0.1, 0.2, 3))
    drive = tensor(rng.uniform(1, 50, (3, 1, 3)))
    end = pose + 0.01 * tensor(rng.normal(size=(1, 7)))
    targets = tensor(rng.normal(size=(3, 1, 3)))
    targets[0] = joints + 0.03 * targets[0]
    wrench = tensor(rng.normal(size=(1, 6)))

    def two_steps(
        pose,
        nu,
        joints,
        end,
        wrench,
        targets,
        mass,
        center,
        moments,
        armature,
        drive,
        gravity,
        f,
        o,
    ):
        own = weights._replace(
            mass=mass, center=center, inertia=(moments + moments.mT) / 2, armature=armature
        )
        state = RobotState(pose, nu[:, :6], joints, nu[:, 6:])
        for first in (True, False):
            at = end if first else end + 0.02 * wrench.new_tensor([1, 2, 3, 0.1, 0.2, 0.3, 0.4])
            control = RobotControl(at, wrench, targets[0], targets[1], targets[2])
            p = chain.predict(state, control, own, Gains(*drive), gravity, f if first else None)
            q = torch.where(chain.prescribed, p.ends, p.target + o)
            state, efforts = chain.advance(p, q, f, None if first else 0.5 * f)
        return (*state, efforts, p.root_start, p.root_end, p.coordinates, p.ends, H * H * p.metric)

    inputs = (pose, nu, joints, end, wrench, targets, *weights, drive, GRAVITY, forces, offset)
    inputs = [t.clone().requires_grad_() for t in inputs]
    # Efforts of position joints are of order 1e4; the tolerance is the rounding of differences.
    assert torch.autograd.gradcheck(two_steps, inputs, rtol=1e-5, atol=1e-4, fast_mode=True)


@pytest.mark.parametrize("base", ["fixed", "floating"])
@pytest.mark.parametrize("tree", ["chain", "branched"])
def test_the_same_bits_with_and_without_a_graph_alone_and_in_a_batch(tree, base):
    chain = make_chain(make(*TREES[tree], base=base, rng=np.random.default_rng(0)))
    rng = np.random.default_rng(1)
    states = []
    for _ in range(5):
        pose, joints, nu = random_configuration(chain.mechanism, rng)
        states.append(RobotState(pose, nu[:, :6], joints, nu[:, 6:]))
    batch = RobotState(*(torch.cat(rows) for rows in zip(*states, strict=True)))
    with torch.no_grad():
        p, after, _ = step(chain, batch)
    together = (p.target, p.metric, p.coordinates, *after)
    for i, state in enumerate(states):
        p, after, _ = step(chain, RobotState(*(t.clone().requires_grad_() for t in state)))
        for a, b in zip((p.target, p.metric, p.coordinates, *after), together, strict=True):
            assert torch.equal(a[0], b[i])


def test_bodies_have_the_same_bits_alone_and_in_a_batch():
    rng = np.random.default_rng(2)
    poses, velocities = tensor(rng.normal(size=(5, 3, 7))), tensor(rng.normal(size=(5, 3, 6)) * 9)
    inertia = BodyInertia(*(t.expand(1, 3, *t.shape[2:]) for t in box()))
    wrenches = tensor(rng.normal(size=(1, 3, 6)))
    offset = tensor(rng.normal(size=(5, 3, 6)) * 0.1)

    def go(poses, velocities, offset):
        p = predict_bodies(poses, velocities, inertia, wrenches, GRAVITY, H)
        return (p.metric, p.frames, *advance_bodies(p, p.target + offset, wrenches, H))

    together = go(poses, velocities, offset)
    for i in range(5):
        rows = [t[i : i + 1].clone().requires_grad_() for t in (poses, velocities, offset)]
        for a, b in zip(go(*rows), together, strict=True):
            assert torch.equal(a[0], b[i])


@pytest.mark.parametrize(("turn", "is_lost"), [(3.0, False), (3.3, True)])
@pytest.mark.parametrize("base", ["fixed", "floating"])
def test_half_a_turn_in_a_step_is_the_limit(base, turn, is_lost):
    """The limit holds for a joint, and for a base, which here rotates alone."""
    mechanism = make(*TREES["body" if base == "floating" else "chain"], base=base,
                     rng=np.random.default_rng(0))  # fmt: skip
    if base == "floating":
        mechanism = replace(mechanism, inertia=np.eye(3)[None], center=np.zeros((1, 3)))
        velocity = tensor([[0, 0, 0, turn / H, 0, 0]])
        chain = make_chain(mechanism)
        state = at_rest(chain, velocity=velocity)
    else:  # a single joint, whose speed is constant
        mechanism = pendulum(lengths=(1.0,), masses=(1.0,))
        chain = make_chain(mechanism)
        state = at_rest(chain, rates=tensor([[turn / H]]))
    p, _, _ = step(chain, state, gravity=0 * GRAVITY)
    assert bool(p.lost) == is_lost
    assert p.velocity.any() != is_lost


def test_a_robot_that_is_too_fast_has_a_finite_metric():
    """The environment fails, but the solver still receives finite numbers for it."""
    chain = make_chain(make(*TREES["chain"], rng=np.random.default_rng(0)))
    rates = tensor([[1e200, 0, 0], [1.0, 2.0, 3.0]])
    state = at_rest(chain, joints=tensor([[0.1, 0.2, 0.3]]).expand(2, 3), rates=rates)
    state = state._replace(pose=AT_ORIGIN.expand(2, 7), velocity=torch.zeros(2, 6, dtype=F64))
    joints = state.joints.clone().requires_grad_()
    p, after, _ = step(chain, state._replace(joints=joints))
    assert p.lost.tolist() == [True, False]
    assert p.metric.isfinite().all()
    # A loss of the other environment has a gradient that is finite everywhere.
    (gradient,) = torch.autograd.grad(after.rates[1].sum() + p.metric[1].sum(), joints)
    assert not gradient[0].any()
    assert gradient[1].isfinite().all()
    assert gradient[1].any()


@pytest.mark.parametrize("h", [0.05, 0.2, 0.4])
def test_the_metric_of_a_long_fall_from_rest_is_positive(h):
    """The correction that balances the forces at rest is smaller than the metric."""
    rng = np.random.default_rng(3)
    chain = RobotDynamics(pendulum((1.0, 0.5, 0.5), (1.0, 1.0, 1.0)), h, NO_LINKS, NO_POINTS)
    for _ in range(20):
        joints = tensor(rng.uniform(-1.5, 1.5, (1, 3)))
        p, _, _ = step(chain, at_rest(chain, joints))
        if p.lost:
            continue
        mass = mass_at(chain, joints + h * p.velocity[:, 6:])
        root = torch.linalg.inv(torch.linalg.cholesky(mass))
        shares = torch.linalg.eigvalsh(root @ (h**2 * p.metric[0]) @ root.T)
        assert shares.min() > 0.2


def mass_at(chain, joints):
    """M of the joints of a fixed chain, [J, J]."""
    inertia = inertia_of(chain.mechanism)
    kinematics = DifferentialKinematics(chain.mechanism)
    motion = Motion.at(kinematics, inertia, frame_of(AT_ORIGIN), joints)
    return mass_matrix(motion, inertia)[0, 6:, 6:]
