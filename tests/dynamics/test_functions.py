"""The core's functions of bodies and robots: against Jacobians in torch, and their derivatives."""

import math
import re

import numpy as np
import pytest
import torch
from mechanisms import F64, TREES, frame_of, inertia_of, make, random_configuration, tensor
from reference import slope, wrenches_of_forces
from tree_in_torch import (
    DifferentialKinematics,
    Motion,
    generalized_force,
    mass_matrix,
    momentum,
    root_frame,
)

from diffcloth_torch import _core, _kernels
from diffcloth_torch.dynamics.bodies import BodyInertia, predict_bodies
from diffcloth_torch.dynamics.robots import Gains, RobotControl, RobotDynamics, RobotState
from diffcloth_torch.geometry.rotation import (
    quaternion_exp,
    quaternion_matrix,
    quaternion_multiply,
    rotation_exp,
)

H = 0.01
GRAVITY = tensor([[0.4, -0.3, -9.81]])
CASES = [
    (name, base)
    for name in TREES
    for base in ("fixed", "kinematic", "floating")
    if name != "body" or base == "floating"
]


class Robot:
    """A random robot in three environments, with its state, control and forces."""

    def __init__(self, name, base, speed=1.0, prescribed=False):
        kinds, parents = TREES[name]
        mimic = {5: (4, -0.7, 0.3)} if name == "branched" else None
        rng = np.random.default_rng(list(TREES).index(name))
        self.mechanism = make(kinds, parents, base=base, rng=rng, mimic=mimic)
        J = self.mechanism.joint_count
        if prescribed:  # every other joint
            modes = tuple("velocity" if j % 2 else "torque" for j in range(J))
            self.mechanism = make(
                kinds,
                parents,
                base=base,
                rng=np.random.default_rng(list(TREES).index(name)),
                mimic=mimic,
                actuation=modes,
            )
        links = torch.from_numpy(np.repeat(np.arange(self.mechanism.link_count), 2))
        points = tensor(rng.normal(size=(len(links), 3)))
        self.links, self.points = links, points
        self.dynamics = RobotDynamics(self.mechanism, H, links, points)
        drawn = [random_configuration(self.mechanism, np.random.default_rng(s)) for s in range(3)]
        pose, joints, nu = (torch.cat(parts) for parts in zip(*drawn, strict=True))
        # The velocity of a fixed base is ignored.
        velocity = tensor(rng.normal(size=(3, 6))) if base == "fixed" else speed * nu[:, :6]
        self.state = RobotState(pose, velocity, joints, speed * nu[:, 6:])
        self.inertia = inertia_of(self.mechanism, rng.uniform(0.1, 0.2, J))
        end = pose.clone()
        if base == "kinematic":
            end[:, :3] += H * speed * tensor(rng.normal(size=(3, 3)))
            turn = quaternion_exp(H * speed * tensor(rng.normal(size=(3, 3))))
            end[:, 3:] = quaternion_multiply(turn, pose[:, 3:])
        self.control = RobotControl(
            pose=end,
            wrench=tensor(rng.normal(size=(1, 6))),
            joints=torch.zeros(1, J, dtype=F64),
            rates=speed * tensor(rng.normal(size=(1, J))),
            efforts=tensor(rng.normal(size=(3, J))),
        )
        self.gains = Gains(*torch.zeros(3, 1, J, dtype=F64))
        self.forces = tensor(rng.normal(size=(3, len(links), 3)))
        self.kinematics = DifferentialKinematics(self.mechanism)
        self.first = 0 if base == "floating" else 6
        free = ~self.dynamics.prescribed[len(self.dynamics.prescribed) - J :]
        self.solved = [i for i in range(self.first, 6 + J) if i < 6 or free[i - 6]]

    def predict(self):
        return self.dynamics.predict(
            self.state, self.control, self.inertia, self.gains, GRAVITY, self.forces
        )

    def motion(self, pose, joints):
        return Motion.at(self.kinematics, self.acting, frame_of(pose), joints)

    @property
    def acting(self):
        moved = self.mechanism.forced if self.mechanism.joint_count else np.zeros(0)
        inertia = self.inertia
        if not self.mechanism.is_dynamic:
            inertia = inertia_of(self.mechanism)
        return inertia._replace(armature=inertia.armature * tensor(moved))

    def after(self, velocity, time):
        """The links after a time at constant velocities."""
        pose, joints = self.state.pose, self.state.joints
        local = self.inertia.center[:, self.mechanism.root]
        rotation = quaternion_matrix(pose[:, 3:])
        center = pose[:, :3] + (rotation @ local[..., None])[..., 0]
        if self.mechanism.base != "fixed":
            rotation = rotation_exp(time * velocity[:, 3:6]) @ rotation
            center = center + time * velocity[:, :3]
        root = root_frame(center, rotation, local)
        return Motion.at(self.kinematics, self.acting, root, joints + time * velocity[:, 6:])


@pytest.mark.parametrize("prescribed", [False, True])
@pytest.mark.parametrize(("name", "base"), CASES)
def test_the_impulse_that_is_given(name, base, prescribed):
    """Momentum, weight, wrench, efforts and forces on vertices."""
    robot = Robot(name, base, prescribed=prescribed)
    found = robot.predict().given
    here = robot.motion(robot.state.pose, robot.state.joints)
    root = robot.state.velocity * (base != "fixed")
    nu = torch.cat([root, robot.state.rates], -1)
    forced = tensor(robot.mechanism.forced)
    acting = torch.cat([robot.control.wrench.expand(3, 6), forced * robot.control.efforts], -1)
    weights = robot.inertia.mass[..., None] * torch.nn.functional.pad(GRAVITY, (0, 3))
    acting = acting + generalized_force(here, weights.expand(3, -1, 6))
    of_points = wrenches_of_forces(here.frames, robot.links, robot.points, robot.forces)
    acting = acting + generalized_force(here, of_points)
    expected = momentum(here, robot.acting, nu) + H * acting
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("speed", [1.0, 20.0])  # [rad/s], of each joint
@pytest.mark.parametrize("prescribed", [False, True])
@pytest.mark.parametrize(("name", "base"), CASES)
def test_the_velocities_solve_the_equation(name, base, prescribed, speed):
    robot = Robot(name, base, speed, prescribed)
    prediction = robot.predict()
    assert not prediction.lost.any()
    nu, solved = prediction.velocity, robot.solved
    middle = robot.after(nu, H / 2)
    left = momentum(middle, robot.acting, nu) - H / 2 * slope(robot.kinematics, middle, nu)
    assert nu[:, solved].abs().min() > 1e-3  # every solved row has an impulse
    known = [i for i in range(nu.shape[1]) if i not in solved]
    assert torch.equal(nu[:, known], prediction.known[:, known])
    scale = float(prediction.given.abs().max())
    torch.testing.assert_close(
        left[:, solved], prediction.given[:, solved], rtol=0, atol=1e-10 * scale
    )


@pytest.mark.parametrize(("name", "base"), [c for c in CASES if c[1] == "floating"])
def test_the_metric_is_the_mass_matrix_at_the_end(name, base):
    robot = Robot(name, base)
    prediction = robot.predict()
    expected = mass_matrix(robot.after(prediction.velocity, H), robot.acting)
    torch.testing.assert_close(H * H * prediction.metric, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("prescribed", [False, True])
@pytest.mark.parametrize(("name", "base"), CASES)
def test_velocities_and_efforts_at_the_end(name, base, prescribed):
    """The velocities satisfy M nu' = p + h/2 s + h kick, and efforts are the residual.

    The rows of a floating root have the whole change of momentum; efforts act at prescribed
    joints. The coordinates are the predicted ones.
    """
    robot = Robot(name, base, prescribed=prescribed)
    p = robot.predict()
    kick = 0.5 * robot.forces.flip(0)
    q = torch.where(robot.dynamics.prescribed, p.ends, p.target)
    state, efforts = robot.dynamics.advance(p, q, robot.forces, kick)
    over = p.known.clone()
    solved = robot.solved
    over[:, 6:] = (state.joints - robot.state.joints) / H
    if base == "floating":
        over[:, :6] = p.velocity[:, :6]  # to rounding: the target is the prediction
    middle, end = robot.after(over, H / 2), robot.after(over, H)
    rate = slope(robot.kinematics, middle, over)
    impulse = H * generalized_force(
        end, wrenches_of_forces(end.frames, robot.links, robot.points, kick)
    )
    nu = torch.cat([state.velocity, state.rates], -1)
    left = momentum(end, robot.acting, nu)
    right = momentum(middle, robot.acting, over) + H / 2 * rate + impulse
    if base == "floating":
        right[:, :6] = (p.given + impulse)[:, :6]
        right[:, 3:6] += H * torch.linalg.cross(p.given[:, :3], over[:, :3])
    torch.testing.assert_close(left[:, solved], right[:, solved], rtol=1e-10, atol=1e-10)
    held = (left - p.given - impulse) / H - rate
    held = held - generalized_force(
        end, wrenches_of_forces(end.frames, robot.links, robot.points, robot.forces)
    )
    expected = torch.where(tensor(robot.mechanism.forced) > 0, robot.control.efforts, held[:, 6:])
    torch.testing.assert_close(efforts, expected, rtol=1e-8, atol=1e-8)


def robot_functions(**changes):
    options = {
        "parent": [-1, 0],
        "order": [0, 1],
        "kind": [0, 1],
        "offset": np.stack([np.eye(4)] * 2),
        "axis": np.array([[0.0, 0, 0], [0, 0, 1]]),
        "dof": [-1, 0],
        "multiplier": np.ones(2),
        "constant": np.zeros(2),
        "joint_count": 1,
        "base": 2,
        "actuation": [3],
        "vertex_link": [1, 0],
        "points": np.ones((2, 3)),
        "dt": H,
        "largest": 1e30,
        "is_at_rest": False,
        "bounds_weight": False,
    }
    options |= changes
    tree = {name: options.pop(name) for name in list(options)[:9]}
    return _core.robot_functions(tree=_core.tree(**tree), **options)


SIZES = {
    "mass": (2,), "center": (2, 3), "inertia": (2, 3, 3), "armature": (1,), "stiffness": (1,),
    "damping": (1,), "viscosity": (1,), "targets": (1,), "target_rates": (1,), "efforts": (1,),
    "effort_limits": (1,), "pose": (7,), "joints": (1,), "velocity": (6,), "rates": (1,),
    "end_pose": (7,), "wrench": (6,), "gravity": (3,), "contact": (2, 3), "velocity_limits": (1,),
    "friction": (1,), "slip_rates": (1,), "origins": (1,),
}  # fmt: skip
ONE_FOR_ALL = {"mass", "inertia", "gravity", "stiffness"}


def arrays(environments=3):
    rng = np.random.default_rng(0)
    given = {
        name: rng.uniform(0.5, 1.5, (1 if name in ONE_FOR_ALL else environments, *size))
        for name, size in SIZES.items()
    }
    given["inertia"] = given["inertia"] / 9 + np.eye(3)
    return given


def outputs(function, given, threads=1):
    return function.values(given, threads)


def test_derivatives_are_those_by_differences_and_adjoint_to_each_other():
    """<u, J v> = <J^T u, v> for each input, some of which several environments share."""
    function, _ = robot_functions()
    given = arrays()
    rng = np.random.default_rng(1)
    values = outputs(function, given)
    losses = 2
    cotangents = {name: rng.normal(size=(losses, *value.shape)) for name, value in values.items()}
    gradients = function.gradients(given, cotangents, losses, list(given), 1)
    for name, value in given.items():
        direction = rng.normal(size=(1, *value.shape))
        tangents = function.tangents(given, {name: direction}, 1, 1)
        changed = [{**given, name: value + s * 1e-6 * direction[0]} for s in (1, -1)]
        ends = [outputs(function, there) for there in changed]
        for output, tangent in tangents.items():
            slopes = (ends[0][output] - ends[1][output]) / 2e-6
            # Differences round by 1e-16 of the values over their step.
            room = 1e-7 * max(1.0, abs(slopes).max()) + 1e-9 * abs(values[output]).max()
            np.testing.assert_allclose(tangent[0], slopes, rtol=0, atol=room)
        for loss in range(losses):
            forth = sum((cotangents[o][loss] * t[0]).sum() for o, t in tangents.items())
            back = (gradients[name][loss].ravel() * direction.ravel()).sum()
            assert back == pytest.approx(forth, rel=1e-11, abs=1e-11)


def test_the_same_bits_on_several_threads():
    function, _ = robot_functions()
    given = arrays(40)
    rng = np.random.default_rng(1)
    values = outputs(function, given)
    cotangents = {name: rng.normal(size=(1, *value.shape)) for name, value in values.items()}
    alone = function.gradients(given, cotangents, 1, list(given), 1)
    for _ in range(10):
        for name, value in outputs(function, given, 3).items():
            assert np.array_equal(value, values[name])
        for name, value in function.gradients(given, cotangents, 1, list(given), 3).items():
            assert np.array_equal(value, alone[name])


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0999999, 0.1000001, 1.0, 3.0, math.pi - 1e-6])
def test_rotations_agree_with_torch(angle):
    """Against torch, and the work of a moment against the derivative of the rotation."""
    axis, moment = tensor([2.0, -1.0, 2.0]) / 3, tensor([0.3, 1.0, -0.5])
    w = angle * axis
    numbers, rates = map(torch.from_numpy, _kernels.rotations(w.numpy(), moment.numpy()))
    quaternion, log, R, torque = numbers.split([4, 3, 9, 3])
    close = {"rtol": 0, "atol": 1e-15}
    torch.testing.assert_close(quaternion, quaternion_exp(w), **close)
    torch.testing.assert_close(R.reshape(3, 3), rotation_exp(w), **close)
    torch.testing.assert_close(log, w, rtol=1e-14, atol=1e-15)
    jacobian = torch.autograd.functional.jacobian
    torch.testing.assert_close(rates[:4, :3], jacobian(quaternion_exp, w), rtol=0, atol=1e-14)
    derivative = jacobian(rotation_exp, w)  # [3, 3, dw]
    torch.testing.assert_close(rates[7:16, :3].reshape(3, 3, 3), derivative, rtol=0, atol=1e-14)
    torch.testing.assert_close(rates[4:7, :3], torch.eye(3, dtype=F64), rtol=0, atol=1e-9)
    # exp(w + dw) = exp(J dw) exp(w), with the left Jacobian J.
    turns = torch.einsum("ijk,lj->ilk", derivative, rotation_exp(w))
    J = torch.stack([turns[2, 1], turns[0, 2], turns[1, 0]])
    torch.testing.assert_close(J.T @ torque, moment, rtol=0, atol=1e-13)
    for i, unit in enumerate(1e-6 * np.eye(6)):
        ends = [
            _kernels.rotations(w.numpy() + s * unit[:3], moment.numpy() + s * unit[3:])[0]
            for s in (1, -1)
        ]
        slopes = (ends[0] - ends[1])[16:] / 2e-6
        np.testing.assert_allclose(rates[16:, i], slopes, rtol=0, atol=1e-8)


@pytest.mark.boundary
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axis": np.zeros(3)}, "one entry a link"),
        ({"order": [1, 0]}, "parents before their children"),
        ({"order": [0, 0]}, "every link once"),
        ({"parent": [-1, 7]}, "parents before their children"),
        ({"kind": [0, 3]}, "in range"),
        ({"dof": [-1, 1]}, "in range"),
        ({"dof": [-1, -1]}, "in range"),
        ({"base": 3}, "`base` is out of range"),
        ({"actuation": [4]}, "`actuation` is out of range"),
        ({"actuation": [3, 3]}, "`actuation` must have one entry a joint"),
        ({"vertex_link": [0, 2]}, "`vertex_link` is out of range"),
        ({"points": np.ones((3, 3))}, "`points` must be [V, 3]"),
    ],
)
def test_the_core_refuses_trees_that_it_would_read_beyond(changes, message):
    robot_functions()
    with pytest.raises(ValueError, match=re.escape(message)):
        robot_functions(**changes)


@pytest.mark.boundary
def test_the_core_refuses_arrays_of_other_sizes():
    function, _ = robot_functions()
    given = arrays()
    outputs(function, given)
    for name, size in SIZES.items():
        wrong = np.ones((3, math.prod(size) + 1))
        with pytest.raises(ValueError, match=f"`{name}` must have {math.prod(size)} numbers"):
            outputs(function, {**given, name: wrong})
    with pytest.raises(ValueError, match="`joints` must have 1 or 3 environments"):
        outputs(function, {**given, "joints": np.ones((2, 1))})
    with pytest.raises(ValueError, match="unknown array `toints`"):
        outputs(function, {**given, "toints": np.ones((1, 1))})
    with pytest.raises(ValueError, match="`rates` is missing"):
        outputs(function, {n: a for n, a in given.items() if n != "rates"})
    with pytest.raises(ValueError, match="no input `origins`"):
        function.gradients(
            {n: a for n, a in given.items() if n != "origins"}, {}, 1, ["origins"], 1
        )


def test_wrong_sizes_of_bodies_are_refused_by_name():
    inertia = BodyInertia(torch.ones(1, 2), torch.zeros(1, 2, 3), torch.eye(3).expand(1, 1, 3, 3))
    given = (t.double() for t in inertia)
    poses, none = torch.ones(1, 2, 7, dtype=F64), torch.zeros(1, 2, 6, dtype=F64)
    with pytest.raises(ValueError, match="`inertia` must have 18 numbers an environment"):
        predict_bodies(poses, none, BodyInertia(*given), none, GRAVITY, H)
