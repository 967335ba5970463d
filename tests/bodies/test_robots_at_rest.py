"""Robots at rest: the holding forces balance the weight at any time step."""

import math

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

pin = pytest.importorskip("pinocchio", reason="Pinocchio is in the extra `test`")

F64 = torch.float64
G = 9.81
LINK = """
  <link name="{name}">
    <inertial><origin xyz="{center}"/><mass value="{mass}"/>
      <inertia ixx="3e-4" iyy="1e-3" izz="1.2e-3" ixy="1e-4" ixz="0" iyz="0"/></inertial>
    {collision}
  </link>"""
JOINT = """
  <joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
    <origin xyz="{origin}" rpy="{rpy}"/><axis xyz="{axis}"/>
    <limit lower="-2" upper="2" effort="0" velocity="0"/></joint>"""
TIP = '<collision><origin xyz="0.2 0 0"/><geometry><sphere radius="0.01"/></geometry></collision>'


def write(folder, kinds, *, rpy="0 0.2 0.1", tip=""):
    """An arm of links that joints of these kinds connect in a chain."""
    text = ['<robot name="arm"><link name="base"/>']
    for k, kind in enumerate(kinds):
        last = k == len(kinds) - 1
        text.append(
            LINK.format(
                name=f"link{k}",
                center="0.1 0.02 0" if rpy != "0 0 0" else "0.1 0 0",
                mass=0.5 - 0.1 * k,
                collision=tip if last else "",
            )
        )
        text.append(
            JOINT.format(
                name=f"joint{k}",
                kind=kind,
                parent=f"link{k - 1}" if k else "base",
                child=f"link{k}",
                origin="0.2 0 0" if k else "0 0 0.2",
                rpy=rpy,
                axis="0 1 0" if kind == "revolute" else "1 0 0",
            )
        )
    file = folder / "arm.urdf"
    file.write_text("".join([*text, "</robot>"]))
    return file


def rest(sim, control, seconds):
    with torch.no_grad():
        return sim.rollout(
            sim.initial_state(), lambda k, s: control, steps=round(seconds / sim.dt)
        )[-1]


@pytest.mark.quick("*-0.02", "revolute-prismatic-0.005")
@pytest.mark.parametrize("dt", [0.02, 0.005])
@pytest.mark.parametrize(
    "kinds",
    [("revolute", "prismatic"), ("revolute",) * 2, ("revolute", "prismatic", "revolute")],
    ids="-".join,
)
def test_drives_carry_the_weight(tmp_path, kinds, dt):
    """Velocity products of a nonexistent fall once changed efforts by 4 % at 20 ms."""
    file = write(tmp_path, kinds)
    robot = dc.Robot.load(file, stiffness=300.0, damping=20.0, name="arm")
    solver = dc.SolverOptions(tolerance=1e-10)
    contact = dc.ContactOptions(barrier_distance=1e-3)
    sim = dc.Simulator(dc.Scene([], [], [robot]), dt, contact=contact, solver=solver)
    wanted = torch.tensor([0.5, 0.05, -0.7][: len(kinds)], dtype=F64)
    state = rest(sim, sim.control(joint_positions=wanted), 4)
    assert state.joint_velocities.abs().max() < 1e-8
    model = pin.buildModelFromUrdf(str(file))
    q = state.joint_positions.numpy()
    expected = pin.computeGeneralizedGravity(model, model.createData(), q)
    assert np.abs(expected).min() > 0.1
    np.testing.assert_allclose(state.joint_efforts.numpy(), expected, rtol=1e-6)


@pytest.mark.parametrize("dt", [0.02, 0.005])
def test_a_floor_carries_a_limp_arm(tmp_path, dt):
    """By virtual work at the first joint, which has no drive."""
    file = write(tmp_path, ["revolute", "revolute"], rpy="0 0 0", tip=TIP)
    robot = dc.Robot.load(
        file,
        actuation={"joint0": "torque", "joint1": "pd"},
        stiffness=30.0,
        damping=0.5,
        smooth=True,
        friction=0.0,
        joint_positions={"joint0": -0.1, "joint1": 1.0},
        name="arm",
    )
    floor = dc.RigidBody.plane(2.0, friction=0.0, name="floor")
    contact = dc.ContactOptions(barrier_distance=1e-3, barrier_stiffness=1e5)
    solver = dc.SolverOptions(tolerance=1e-9)
    sim = dc.Simulator(dc.Scene([], [floor], [robot]), dt, contact=contact, solver=solver)
    state = rest(sim, sim.control(joint_positions=torch.tensor([0.0, 1.0], dtype=F64)), 6)
    assert state.joint_velocities.abs().max() < 1e-8
    a, b = state.joint_positions.tolist()
    elbow, fore = 0.2 * math.cos(a), math.cos(a + b)
    arm = 0.5 * elbow / 2 + 0.4 * (elbow + 0.1 * fore)
    found = -sim.contact_wrenches(state)["floor"][2].item()
    assert found == pytest.approx(G * arm / (elbow + 0.2 * fore), rel=1e-6)


@pytest.mark.quick("0.02")
@pytest.mark.parametrize("dt", [0.02, 0.005])
def test_drives_on_a_base_that_stands_carry_the_weight(tmp_path, dt):
    """The floating base would fall with the arm; the floor supports the base."""
    file = write(tmp_path, ["revolute", "revolute"], rpy="0 0 0")
    foot = """<link name="base"><inertial><mass value="5"/>
      <inertia ixx="1e-2" iyy="1e-2" izz="1e-2" ixy="0" ixz="0" iyz="0"/></inertial>
      <collision><geometry><box size="0.3 0.2 0.1"/></geometry></collision></link>"""
    file.write_text(file.read_text().replace('<link name="base"/>', foot))
    wanted = {"joint0": 0.3, "joint1": 0.5}
    robot = dc.Robot.load(
        file,
        base="floating",
        pose=[0, 0, 0.0515, 1, 0, 0, 0],
        stiffness=100.0,
        damping=5.0,
        joint_positions=wanted,
        name="arm",
    )
    contact = dc.ContactOptions(barrier_distance=2e-3)
    solver = dc.SolverOptions(tolerance=1e-9)
    floor = dc.RigidBody.plane(2.0)
    sim = dc.Simulator(dc.Scene([], [floor], [robot]), dt, contact=contact, solver=solver)
    state = rest(sim, sim.control(joint_positions=torch.tensor([0.3, 0.5], dtype=F64)), 6)
    assert state.joint_velocities.abs().max() < 1e-8
    real, _, pitch, _ = state.base_poses.reshape(-1)[3:].tolist()
    a = 2 * math.atan2(pitch, real) + state.joint_positions[0].item()
    b = a + state.joint_positions[1].item()
    elbow = -0.4 * G * 0.1 * math.cos(b)
    shoulder = elbow - G * (0.5 * 0.1 + 0.4 * 0.2) * math.cos(a)
    expected = torch.tensor([shoulder, elbow], dtype=F64)
    torch.testing.assert_close(state.joint_efforts, expected, rtol=1e-6, atol=0)


@pytest.mark.parametrize("speed", [0.05, 0.2, 1.0])
def test_an_arm_sags_alike_on_a_base_that_glides(tmp_path, speed):
    """Steady motion has no effect, up to the step's error in velocity products."""
    file, ways = write(tmp_path, ["revolute", "revolute"]), []
    glide = speed * torch.tensor([1.0, 0.0, 0.5], dtype=F64)
    for base in ("fixed", "kinematic"):
        robot = dc.Robot.load(file, base=base, stiffness=30.0, damping=0.5, name="arm")
        contact = dc.ContactOptions(barrier_distance=1e-3)
        sim = dc.Simulator(dc.Scene([], [], [robot]), 0.01, contact=contact)
        start = sim.initial_state()
        if base == "kinematic":
            start.base_velocities[0, :3] = glide

        def moved_on(k, state, base=base):
            step = torch.nn.functional.pad(0.01 * glide * (base == "kinematic"), (0, 4))
            return dc.Control(base_poses=state.base_poses + step)

        ways.append(sim.rollout(start, moved_on, steps=30).joint_positions)
    assert ways[0].abs().max() > 0.06
    torch.testing.assert_close(*ways, rtol=0, atol=1e-4)


@pytest.mark.parametrize("gravity", [(0, 0, 0), (0, 0, -G)], ids=["none", "weight"])
@pytest.mark.parametrize("moving", [False, True], ids=["rests", "moves"])
def test_gradients_are_those_of_differences(tmp_path, gravity, moving):
    """At rest with nothing to fall by, too."""
    file = write(tmp_path, ["revolute", "prismatic", "revolute"])
    robot = dc.Robot.load(file, stiffness=30.0, damping=1.0, name="arm")
    scene = dc.Scene([], [], [robot], gravity=gravity)
    sim = dc.Simulator(scene, 0.01, contact=dc.ContactOptions(barrier_distance=1e-3))
    start = sim.initial_state()
    if moving:
        start = start.replace(joint_velocities=torch.tensor([3.0, 0.2, -5.0], dtype=F64))
    parameters = sim.default_parameters()
    g = torch.Generator().manual_seed(3)
    cotangents = torch.randn(3, 3, dtype=F64, generator=g)

    def loss(velocities, mass, pull, target):
        control = sim.control(joint_positions=target)
        given = parameters.replace(link_mass=mass, gravity=pull)
        end = sim.rollout(
            start.replace(joint_velocities=velocities), [control] * 3, parameters=given
        )[-1]
        values = end.joint_positions, 0.01 * end.joint_velocities, 0.1 * end.joint_efforts
        return sum((c * v).sum() for c, v in zip(cotangents, values, strict=True))

    target = torch.zeros(3, dtype=F64)
    inputs = (start.joint_velocities, parameters.link_mass, parameters.gravity, target)
    leaves = [x.clone().requires_grad_() for x in inputs]
    gradients = torch.autograd.grad(loss(*leaves), leaves)
    for k, (x, gradient) in enumerate(zip(inputs, gradients, strict=True)):
        d = torch.randn(x.shape, dtype=F64, generator=g) * (x.abs() if k == 1 else 1)
        best = np.inf
        for step in (1e-3, 1e-4, 1e-5):
            ends = [
                loss(*inputs[:k], x + s * step * d, *inputs[k + 1 :]).item() for s in (-1.0, 1.0)
            ]
            error = abs((ends[1] - ends[0]) / (2 * step) - float((gradient * d).sum()))
            best = min(best, error / max(float((gradient * d).norm()), 1e-6))
        assert best < 1e-6, (k, best)
