"""Efforts of prescribed joints against Pinocchio's inverse dynamics of the step's own motion."""

import coupled_scenes
import numpy as np
import pytest
import torch
from coupled_scenes import COUPLINGS
from robot_packages import carrying, inside_its_limits, robot_file

import diffcloth_torch as dc
from diffcloth_torch.robots import GRIPPER

F64 = torch.float64
pin = pytest.importorskip("pinocchio", reason="Pinocchio is in the extra `test`")

pytestmark = pytest.mark.filterwarnings("ignore::diffcloth_torch.AddedMassWarning")

ARM = """<robot name="arm">
<link name="root"><inertial><origin xyz="0.03 0.05 0"/><mass value="0.9"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="upper"><inertial><origin xyz="0.02 0 -0.3" rpy="0.1 0.2 0.3"/><mass value="1.3"/>
<inertia ixx="0.02" iyy="0.03" izz="0.012" ixy="0.001" ixz="0.002" iyz="0"/></inertial></link>
<link name="lower"><inertial><origin xyz="0 0.04 -0.25"/><mass value="0.7"/>
<inertia ixx="0.01" iyy="0.011" izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="tool"><inertial><origin xyz="0 0 0.05"/><mass value="0.4"/>
<inertia ixx="0.002" iyy="0.002" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="continuous"><parent link="root"/><child link="upper"/>
<origin xyz="0.1 0 0.2" rpy="0 0.3 0"/><axis xyz="0 1 0"/></joint>
<joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
<origin xyz="0 0 -0.6" rpy="0.4 0 0"/><axis xyz="0.6 0.8 0"/></joint>
<joint name="slide" type="prismatic"><parent link="lower"/><child link="tool"/>
<origin xyz="0 0 -0.5"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
</joint></robot>"""

FOLLOWS = {"panda_finger_joint2": "panda_finger_joint1"}


class Inverse:
    """Pinocchio's inverse dynamics of a robot whose base may move in any way."""

    def __init__(self, path, joint_names):
        self.model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
        self.data = self.model.createData()
        # Pinocchio's joints behind the base in Pinocchio's order, and our matching joints.
        self.names = list(self.model.names)[2:]
        self.rows = [joint_names.index(FOLLOWS.get(name, name)) for name in self.names]

    def configuration(self, state):
        q = pin.neutral(self.model)
        pose = state.base_poses[0].numpy()
        q[:7] = [*pose[:3], *pose[4:], pose[3]]
        q[3:7] /= np.linalg.norm(q[3:7])
        for name, row in zip(self.names, self.rows, strict=True):
            joint = self.model.joints[self.model.getJointId(name)]
            value = float(state.joint_positions[row])
            own = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
            q[joint.idx_q : joint.idx_q + joint.nq] = own
        return q

    def efforts(self, states, h, gravity, wrenches=()):
        """On our joints, from three states, and (frame, world wrench about the origin) pairs."""
        before, start, end = map(self.configuration, states)
        rates = [pin.difference(self.model, *pair) / h for pair in ((before, start), (start, end))]
        self.model.gravity.linear = np.array(gravity)
        pin.framesForwardKinematics(self.model, self.data, end)
        external = [pin.Force.Zero() for _ in self.model.names]
        for frame, wrench in wrenches:
            joint = self.model.frames[self.model.getFrameId(frame, pin.FrameType.BODY)].parentJoint
            external[joint] += self.data.oMi[joint].actInv(pin.Force(wrench))
        acceleration = (rates[1] - rates[0]) / h
        external = pin.StdVec_Force(external)
        tau = pin.rnea(self.model, self.data, end, rates[1], acceleration, external)
        out = np.zeros(max(self.rows) + 1)
        for name, row in zip(self.names, self.rows, strict=True):
            out[row] += tau[self.model.joints[self.model.getJointId(name)].idx_v]
        return out


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return path


def far_away():
    """A cloth; a scene without force-driven joints requires one."""
    return dc.Cloth.grid(2, 2, 0.1, pose=[9, 9, 9, 1, 0, 0, 0], pins={"all": range(4)})


def error(path, h, *, base, actuation, start, amplitude, seconds=0.24, **options):
    """Largest difference over a swing, and the largest effort, at prescribed joints."""
    robot = dc.Robot.load(
        path,
        base=base,
        actuation=actuation,
        joint_positions=start,
        stiffness=3.0,
        damping=0.5,
        pose=[0.1, 0.2, 0.3, 0.9, 0.1, -0.3, 0.2],
        **options,
    )
    gravity, frequency = (1.0, -2.0, -9.0), 5.0
    sim = dc.Simulator(dc.Scene([far_away()], robots=[robot], gravity=gravity), h)
    held = np.flatnonzero(~robot.mechanism.forced)
    positions, velocities = (
        torch.tensor([mode in names for mode in robot.mechanism.actuation])
        for names in (("position", "pd"), ("velocity", "pd"))
    )
    inverse = Inverse(path, robot.joint_names)
    state = sim.initial_state()
    first, pose = state.joint_positions, state.base_poses
    amplitude = torch.tensor(amplitude, dtype=F64)
    way = torch.tensor([[0.2, -0.1, 0.15, 0.2, 0.3, -0.4, 0.1]], dtype=F64)
    wrench = torch.tensor([[1.0, 2.0, 9.0, 0.1, -0.2, 0.05]], dtype=F64)
    states, worst, largest = [state, state], 0.0, 0.0
    for k in range(1, round(seconds / h) + 1):
        part = 1 - np.cos(frequency * k * h)
        control = dc.Control(
            joint_positions=torch.where(positions, first + amplitude * part, first),
            joint_velocities=velocities * amplitude * frequency * np.sin(frequency * (k - 0.5) * h),
            base_poses=pose + way * part if base == "kinematic" else None,
            base_wrenches=wrench if base == "floating" else None,
        )
        state = sim.step(state, control)
        states = [*states[-2:], state]
        if k * h > seconds / 2:
            expected = inverse.efforts(states, h, gravity)[held]
            got = state.joint_efforts.numpy()[held]
            worst = max(worst, abs(got - expected).max())
            largest = max(largest, abs(expected).max())
    return worst, largest


CASES = [
    ("fixed", "position"),
    ("fixed", ("velocity", "position", "velocity")),
    ("fixed", ("position", "torque", "pd")),
    ("fixed", ("torque", "velocity", "position")),
    ("kinematic", "position"),
    ("kinematic", ("pd", "position", "torque")),
    ("floating", "position"),
    ("floating", ("torque", "velocity", "pd")),
]


@pytest.mark.parametrize(("base", "actuation"), CASES)
def test_efforts_are_those_of_inverse_dynamics(arm, base, actuation):
    """For a swinging arm, the difference falls with the time step."""
    options = {"base": base, "actuation": actuation, "start": [0.7, -0.5, 0.1]}
    coarse, fine = (error(arm, h, **options, amplitude=[0.9, -0.7, 0.2])[0] for h in (0.008, 0.004))
    finest, largest = error(arm, 0.002, **options, amplitude=[0.9, -0.7, 0.2])
    # A falling and tumbling arm has small efforts, which are differences of large forces.
    assert finest < (0.2 if base == "floating" else 0.02) * largest
    assert finest < 0.65 * fine
    assert fine < 0.65 * coarse


@pytest.mark.parametrize("base", ["fixed", "kinematic"])
def test_efforts_of_a_gripper(base):
    options = {"base": base, "actuation": "position", "start": 0.02, "amplitude": [0.01, -0.008]}
    coarse, fine = (error(GRIPPER, h, **options)[0] for h in (0.004, 0.002))
    assert fine < 0.6 * coarse + 1e-12  # fingers that slide on a fixed base: exact
    assert fine < 0.02 * error(GRIPPER, 0.002, **options)[1]


@pytest.mark.parametrize("free", [None, "panda_joint5"])
def test_efforts_of_a_panda(free):
    try:
        path, root = dc.robots.panda()
    except ImportError:
        pytest.skip("the Panda is in the extra `robots`")
    start = {"panda_joint4": -1.5, "panda_joint6": 1.5, "panda_finger_joint1": 0.02}
    names = dc.Robot.load(path, mesh_root=root, joint_positions=start).joint_names
    options = {
        "base": "fixed",
        "actuation": {name: "pd" if name == free else "position" for name in names},
        "start": start,
        "amplitude": [0.3, -0.2, 0.25, 0.2, 0.3, 0.2, -0.4, 0.005],
        "mesh_root": root,
        "seconds": 0.06,
    }
    coarse, fine = (error(path, h, **options) for h in (0.006, 0.003))
    assert fine[0] < 0.6 * coarse[0]
    assert fine[0] < 0.02 * fine[1]


def test_a_held_pendulum_needs_its_weight(arm):
    """Without motion and contact the efforts are the torques of the weights."""
    robot = dc.Robot.load(arm, actuation="position", joint_positions=[0.4, 0.0, 0.0])
    sim = dc.Simulator(dc.Scene([far_away()], robots=[robot]), 0.013)
    state = sim.step(sim.initial_state())
    expected = Inverse(arm, robot.joint_names).efforts([state] * 3, 0.013, (0, 0, -9.81))
    np.testing.assert_allclose(state.joint_efforts, expected, rtol=1e-12)
    assert abs(expected).min() > 0.5


def contact_wrenches(sim, state):
    """Pairs of a link and the wrench of contact on it, about the origin of the world."""
    wrenches = []
    for name, frame in sim.link_poses(state).items():
        rows = sim.slices.get(name)
        if rows is None:
            continue
        forces = state.body_forces[rows]
        points = torch.from_numpy(sim._assembly.body_vertices[rows]) @ frame[:3, :3].T
        torque = torch.linalg.cross(points + frame[:3, 3], forces).sum(0)
        wrenches.append((name.partition("/")[2], torch.cat([forces.sum(0), torque]).numpy()))
    return wrenches


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_efforts_balance_contact(coupling):
    """A gripper on a moving base, one finger of which is prescribed, presses on cloth and box."""
    sim, state = coupled_scenes.in_contact(coupling, "kinematic")
    given = coupled_scenes.controls(sim, coupled_scenes.control(sim), 2, start=3)
    with torch.no_grad():
        states = [state, *sim.rollout(state, given, coupled_scenes.parameters(sim))]
    inverse = Inverse(GRIPPER, sim.scene.robots[0].joint_names)
    heavier = coupled_scenes._HEAVIER[coupling]
    for i, inertia in enumerate(inverse.model.inertias.tolist()):
        inverse.model.inertias[i] = pin.Inertia(
            heavier * inertia.mass, inertia.lever, heavier * inertia.inertia
        )
    end, gravity = states[-1], coupled_scenes.GRAVITY / heavier
    wrenches = contact_wrenches(sim, end)
    alone = inverse.efforts(states, coupled_scenes.DT, gravity)[0]
    expected = inverse.efforts(states, coupled_scenes.DT, gravity, wrenches)[0]
    assert abs(expected - alone) > 0.2
    # Up to errors of the time step, in the other terms and in the motion over which contact acts.
    assert abs(float(end.joint_efforts[0]) - expected) < 0.02 * abs(expected - alone)


@pytest.mark.filterwarnings(
    "ignore:.*dropped .* faces", "ignore::diffcloth_torch.BarrierStartWarning"
)
@pytest.mark.parametrize(
    "name", ["ur5_robot.urdf", "allegro_left_hand.urdf", "talos_left_arm.urdf"]
)
def test_a_public_robot_holds_a_sheet(name):
    """The sheet still falls and the robot is at rest: efforts from weight and contact only."""
    path = robot_file("example-robot-data", name)
    robot, _ = inside_its_limits(path, actuation="position")
    sim = carrying(robot)
    state = sim.initial_state()
    for _ in range(4):
        state = sim.step(state)
    inverse = Inverse(path, robot.joint_names)
    efforts = [
        inverse.efforts([state] * 3, sim.dt, sim.scene.gravity, wrenches)
        for wrenches in ([], contact_wrenches(sim, state))
    ]
    # Contribution of a sheet of one gram, just landed, to efforts that carry kilograms.
    share = abs(efforts[1] - efforts[0]).max()
    assert share > 1e-6
    np.testing.assert_allclose(state.joint_efforts, efforts[1], rtol=0, atol=1e-5 * share)
