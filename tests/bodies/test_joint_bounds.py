"""Limits of efforts and speeds of joints, and their Coulomb friction, against closed forms."""

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

F64 = torch.float64
TIGHT = dc.SolverOptions(tolerance=1e-10)
H, G = 0.01, 9.81
MASS, CENTER, OWN = 0.5, 0.2, 4e-3
INERTIA = OWN + MASS * CENTER**2
WEIGHT = MASS * G * CENTER  # moment where the arm is level

LINK = """
<link name="{name}"><inertial><origin xyz="{center} 0 0"/><mass value="{mass}"/>
  <inertia ixx="1e-3" iyy="{own}" izz="{own}" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="{center} 0 0"/><geometry><box size="0.2 0.02 0.02"/></geometry>
  </collision></link>"""
BASE = """
<link name="base"><inertial><mass value="1"/>
  <inertia ixx="1e-2" iyy="1e-2" izz="1e-2" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """
<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{at} 0 0"/><axis xyz="0 1 0"/>
  <limit lower="-20" upper="20" effort="{effort}" velocity="{velocity}"/>
  <dynamics damping="0" friction="{friction}"/>{mimic}</joint>"""


def arm_file(folder, links=1, effort=0, velocity=0, friction=0, mimic=()):
    """An arm of links in the direction of x, which turn about y: down, for positive angles."""
    parts = [BASE]
    for k in range(links):
        parts.append(LINK.format(name=f"link{k}", mass=MASS, center=CENTER, own=OWN))
        follow = dict(mimic).get(k)
        parts.append(
            JOINT.format(
                name=f"joint{k}",
                parent=f"link{k - 1}" if k else "base",
                child=f"link{k}",
                at=0.4 if k else 0,
                effort=np.broadcast_to(effort, links)[k],
                velocity=np.broadcast_to(velocity, links)[k],
                friction=np.broadcast_to(friction, links)[k],
                mimic="" if follow is None else f'<mimic joint="joint0" multiplier="{follow}"/>',
            )
        )
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    return path


def simulator(robot, dt=H, **scene):
    scene = dc.Scene([], robots=[robot], **scene)
    return dc.Simulator(scene, dt, contact=dc.ContactOptions(barrier_distance=1e-3), solver=TIGHT)


def rolled(sim, steps, **control):
    states = [sim.initial_state()]
    for _ in range(steps):
        states.append(sim.step(states[-1], sim.control(**control)))
    return states


def tensor(*values):
    return torch.tensor(values, dtype=F64)


# --- Coulomb friction -----------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.2, 0.9, -0.7])
def test_a_joint_sticks_below_its_friction_but_for_the_creep_of_slip(tmp_path, share):
    robot = dc.Robot.load(arm_file(tmp_path, friction=0.6), actuation="torque")
    sim = simulator(robot, gravity=(0, 0, 0))
    end = rolled(sim, 30, joint_efforts=tensor(0.6 * share))[-1]
    rate = float(sim.parameters().joint_slip_rates)
    assert rate == pytest.approx(1e-4 / np.sqrt(INERTIA / MASS), rel=1e-12)
    creep = np.sign(share) * rate * (1.0 - np.sqrt(1.0 - abs(share)))
    assert float(end.joint_velocities) == pytest.approx(creep, rel=1e-6)


@pytest.mark.parametrize("effort", [0.9, -2.0])
def test_a_joint_slips_under_what_is_beyond_its_friction(tmp_path, effort):
    robot = dc.Robot.load(arm_file(tmp_path, friction=0.6), actuation="torque")
    end = rolled(simulator(robot, gravity=(0, 0, 0)), 20, joint_efforts=tensor(effort))[-1]
    speed = 20 * H * (effort - np.sign(effort) * 0.6) / INERTIA
    assert float(end.joint_velocities) == pytest.approx(speed, rel=1e-9)
    # What is applied, without the friction.
    assert float(end.joint_efforts) == effort


def test_friction_stops_a_joint(tmp_path):
    robot = dc.Robot.load(arm_file(tmp_path, friction=0.6), actuation="torque")
    sim = simulator(robot, gravity=(0, 0, 0))
    state = sim.initial_state().replace(joint_velocities=tensor(0.9))
    speeds = []
    for _ in range(12):
        state = sim.step(state)
        speeds.append(float(state.joint_velocities))
    slowing = 0.9 - np.arange(1, 13) * H * 0.6 / INERTIA
    moving = slowing > 0
    np.testing.assert_allclose(np.array(speeds)[moving], slowing[moving], rtol=1e-9)
    assert moving.sum() == 3
    rate = float(sim.parameters().joint_slip_rates)
    assert np.abs(np.array(speeds)[~moving]).max() < rate


# --- limits of efforts ----------------------------------------------------------------------------


def limited(asked, limit):
    """The effort of a drive, by its definition."""
    excess = max(abs(asked) - 0.9 * limit, 0.0) / (0.1 * limit)
    return np.sign(asked) * (
        min(abs(asked), 0.9 * limit) + 0.1 * limit * excess / np.hypot(1, excess)
    )


@pytest.mark.parametrize("asked", [0.5, 0.95, -1.2, 30.0])
def test_an_applied_effort_stays_within_its_limit(tmp_path, asked):
    robot = dc.Robot.load(arm_file(tmp_path, effort=1.0), actuation="torque")
    end = rolled(simulator(robot, gravity=(0, 0, 0)), 5, joint_efforts=tensor(asked))[-1]
    assert float(end.joint_efforts) == pytest.approx(limited(asked, 1.0), rel=1e-14)
    speed = 5 * H * limited(asked, 1.0) / INERTIA
    assert float(end.joint_velocities) == pytest.approx(speed, rel=1e-9)


@pytest.mark.parametrize("stiffness", [3.0, 2e4])
@pytest.mark.parametrize("feed", [0.0, -40.0])
def test_a_drive_that_cannot_lift_rests_where_its_limit_holds_the_weight(tmp_path, stiffness, feed):
    """The balance of the limited drive and the weight; a stiff one ends at its limit."""
    limit = 0.6 * WEIGHT
    robot = dc.Robot.load(
        arm_file(tmp_path, effort=limit), stiffness=stiffness, damping=0.02 * stiffness
    )
    sim = simulator(robot)
    up = sim.control(joint_positions=tensor(-1.5), joint_efforts=tensor(feed))
    state = sim.initial_state()
    viscous = sim.parameters().replace(joint_viscosity=tensor(0.3))
    for _ in range(600):
        state = sim.step(state, up, viscous)
    q, effort = float(state.joint_positions), float(state.joint_efforts)
    assert abs(float(state.joint_velocities)) < 1e-8
    assert -limit < effort < 0
    assert effort == pytest.approx(limited(stiffness * (-1.5 - q) + feed, limit), rel=1e-12)
    assert effort == pytest.approx(-WEIGHT * np.cos(q), rel=1e-6)
    if stiffness > 10:
        assert effort == pytest.approx(-limit, rel=1e-4)
    found = sim.equilibrium(state, up)
    assert float(found.joint_positions) == pytest.approx(q, abs=1e-7)
    assert float(found.joint_efforts) == pytest.approx(effort, rel=1e-7)


def test_a_drive_within_its_limit_has_the_bits_of_one_without(tmp_path):
    ends = []
    for effort in (0, 100):
        robot = dc.Robot.load(arm_file(tmp_path, effort=effort), stiffness=40.0, damping=2.0)
        ends.append(rolled(simulator(robot), 10, joint_positions=tensor(0.2))[-1])
    assert torch.equal(ends[0].joint_positions, ends[1].joint_positions)
    assert torch.equal(ends[0].joint_efforts, ends[1].joint_efforts)


# --- limits of speeds -----------------------------------------------------------------------------


def test_a_falling_arm_reaches_the_limit_of_its_speed_and_not_more(tmp_path):
    robot = dc.Robot.load(arm_file(tmp_path, velocity=1.5), actuation="torque")
    free = dc.Robot.load(arm_file(tmp_path), actuation="torque")
    speeds = [
        np.array([float(s.joint_velocities) for s in rolled(simulator(r), 9)])
        for r in (robot, free)
    ]
    before = speeds[1] < 1.5
    assert 3 < before.sum() < 6
    np.testing.assert_allclose(speeds[0][before], speeds[1][before], rtol=1e-9)
    # The weight still pulls towards the end.
    assert (speeds[0][~before] > 1.5).all()
    assert speeds[0].max() < 1.5 * 1.01


@pytest.mark.parametrize("speed", [2.0, 40.0])
def test_a_joint_beyond_the_limit_of_its_speed_is_slowed_at_once(tmp_path, speed):
    robot = dc.Robot.load(arm_file(tmp_path, velocity=1.5), actuation="torque")
    sim = simulator(robot, gravity=(0, 0, 0))
    state = sim.step(sim.initial_state().replace(joint_velocities=tensor(speed)))
    assert 1.5 <= float(state.joint_velocities) < 1.5 * 1.01
    assert float(sim.step(state).joint_velocities) < 1.5 * 1.01


def test_a_drive_goes_as_fast_as_it_may(tmp_path):
    robot = dc.Robot.load(arm_file(tmp_path, velocity=1.5), stiffness=400.0, damping=4.0)
    states = rolled(simulator(robot, gravity=(0, 0, 0)), 60, joint_positions=tensor(1.2))
    speeds = np.array([float(s.joint_velocities) for s in states])
    assert speeds.max() < 1.5 * 1.01
    assert (speeds > 1.49).sum() == 60
    assert float(states[-1].joint_positions) < 1.2
