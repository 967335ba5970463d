"""Limits of efforts and speeds of joints, and their Coulomb friction, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.dynamics.limits import ZONE, limit_stiffness, slip_rates
from diffcloth_torch.model.assembly import assemble

F64 = torch.float64
TIGHT = dc.SolverOptions(tolerance=1e-10)
H, G = 0.01, 9.81
MASS, CENTER, OWN = 0.5, 0.2, 4e-3
INERTIA = OWN + MASS * CENTER**2
WEIGHT = MASS * G * CENTER  # moment about the joint when the arm is level

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
    rate = float(sim.default_parameters().joint_slip_rates)
    assert rate == pytest.approx(1e-5 / np.sqrt(INERTIA / MASS), rel=1e-12)
    creep = np.sign(share) * rate * (1.0 - np.sqrt(1.0 - abs(share)))
    assert float(end.joint_velocities) == pytest.approx(creep, rel=1e-5)


@pytest.mark.parametrize("effort", [0.9, -2.0])
def test_a_joint_slips_under_efforts_beyond_its_friction(tmp_path, effort):
    robot = dc.Robot.load(arm_file(tmp_path, friction=0.6), actuation="torque")
    end = rolled(simulator(robot, gravity=(0, 0, 0)), 20, joint_efforts=tensor(effort))[-1]
    speed = 20 * H * (effort - np.sign(effort) * 0.6) / INERTIA
    assert float(end.joint_velocities) == pytest.approx(speed, rel=1e-9)
    # The applied effort, without the friction.
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
    rate = float(sim.default_parameters().joint_slip_rates)
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


@pytest.mark.quick("0.0-3.0", "-40.0-3.0")
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
    viscous = sim.default_parameters().replace(joint_viscosity=tensor(0.3))
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


# --- Scales of limits and slip --------------------------------------------------------------------


def test_limits_and_slip_rates_know_all_that_a_joint_carries_where_it_starts(tmp_path):
    """Expected values by hand for two arms; the elbow of the second arm is bent."""
    bent, inertias = 2.0, np.array([0.01, 0.02, 0.03])
    arms = [
        dc.Robot.load(arm_file(tmp_path, len(q)), actuation="torque", joint_positions=q)
        for q in ([0.3], [0.3, bent])
    ]
    assembly = replace(assemble(dc.Scene([], robots=arms)), joint_armature=inertias)
    far = np.sqrt(0.4**2 + CENTER**2 + 2 * 0.4 * CENTER * np.cos(bent))
    moments = inertias + INERTIA + [0, OWN + MASS * far**2, 0]
    masses, ways = MASS * np.array([1, 2, 1]), MASS * (CENTER + np.array([0, far, 0]))
    rates = slip_rates(assembly, 0.1)
    np.testing.assert_allclose(rates, 0.1 * np.sqrt(masses / moments), rtol=1e-12)
    stiffness = limit_stiffness(assembly, H, np.array([0, 3.0, -4.0]))
    np.testing.assert_allclose(stiffness.velocities, moments / H**2, rtol=1e-12)
    np.testing.assert_allclose(stiffness.forces, 30 * 5.0 * ways, rtol=1e-12)
    width = ZONE * 40
    expected = stiffness.velocities + stiffness.forces / width
    np.testing.assert_allclose(stiffness.positions, expected, rtol=1e-12)


def test_arms_in_one_scene_have_limits_and_friction_of_their_own(tmp_path):
    """Both in steps and in the equilibrium of the scene."""
    arms, moves = [], []
    for k, (links, friction) in enumerate(((1, 0.3), (2, [1.5, 0.8]))):
        path = arm_file(tmp_path, links, effort=1 + k, velocity=1.2 + k, friction=friction)
        pose = [0, 3 * k, 0, 1, 0, 0, 0]
        q = [1.3, -0.1][:links]
        drive = {"stiffness": 4.0, "damping": 0.05, "name": f"arm{k}"}
        arms.append(dc.Robot.load(path, pose=pose, joint_positions=q, **drive))
        moves.append({"joint_efforts": tensor(*[2.0, -0.4][:links])})
    together = dc.Scene([], robots=arms)
    sims = [
        dc.Simulator(scene, H, contact=dc.ContactOptions(barrier_distance=1e-3), solver=TIGHT)
        for scene in (together, *(dc.Scene([], robots=[arm]) for arm in arms))
    ]
    given = [{"joint_efforts": torch.cat([m["joint_efforts"] for m in moves])}, *moves]
    ends = []
    for sim, move in zip(sims, given, strict=True):
        control = sim.control(**move)
        steps = sim.rollout(sim.initial_state(), [control] * 12)[-1]
        rest = sim.equilibrium(sim.initial_state(), control)
        ends.append((steps.joint_positions, steps.joint_velocities, rest.joint_positions))
    for both, *own in zip(*ends, strict=True):
        torch.testing.assert_close(both, torch.cat(own), rtol=0, atol=1e-9)


# --- Joints that mimic ----------------------------------------------------------------------------


def test_a_joint_that_mimics_acts_on_its_leader_by_virtual_work(tmp_path):
    """The second joint turns back twice as far, so its friction and limits count twice."""
    path = arm_file(tmp_path, 2, effort=[1, 2], friction=[0.2, 0.3], mimic={1: -2.0})
    robot = dc.Robot.load(path, actuation="torque")
    sim = simulator(robot, gravity=(0, 0, 0))
    assert robot.effort_limits == 1 + 2 * 2
    assert robot.joint_friction == 0.2 + 2 * 0.3
    held = rolled(sim, 10, joint_efforts=tensor(0.75))[-1]
    assert 0 < float(held.joint_velocities) < float(sim.default_parameters().joint_slip_rates)
    free = simulator(
        dc.Robot.load(path, actuation="torque", joint_friction=False), gravity=(0, 0, 0)
    )
    start = sim.initial_state().replace(joint_velocities=tensor(0.4))
    slips = sim.step(start, sim.control(joint_efforts=tensor(1.3)))
    moved = free.step(start, free.control(joint_efforts=tensor(1.3 - 0.8)))
    assert float(moved.joint_velocities) > 0.41
    assert float(slips.joint_velocities) == pytest.approx(float(moved.joint_velocities), rel=1e-4)


# --- Against Pinocchio ----------------------------------------------------------------------------


def test_accelerations_are_those_of_pinocchio_with_friction_and_limits(tmp_path):
    """Three joints with sliding friction; the first effort exceeds its limit."""
    pin = pytest.importorskip("pinocchio", reason="Pinocchio is in the extra `test`")
    path = arm_file(tmp_path, 3, effort=[2, 9, 9], friction=[0.3, 0.2, 0.1])
    robot = dc.Robot.load(path, actuation="torque", joint_positions=[0.3, -0.5, 0.8])
    dt = 1e-5
    sim = simulator(robot, dt)
    rates, efforts = np.array([0.5, -0.4, 0.7]), np.array([5.0, 0.4, -0.3])
    start = sim.initial_state().replace(joint_velocities=torch.from_numpy(rates))
    end = sim.step(start, sim.control(joint_efforts=torch.from_numpy(efforts)))
    acting = efforts - np.sign(rates) * robot.joint_friction
    acting[0] = limited(5.0, 2.0) - 0.3
    model = pin.buildModelFromUrdf(str(path))
    expected = pin.aba(model, model.createData(), robot.joint_positions, rates, acting)
    found = (end.joint_velocities.numpy() - rates) / dt
    np.testing.assert_allclose(found, expected, rtol=1e-3)


# --- Derivatives ----------------------------------------------------------------------------------

NEW = ("joint_effort_limits", "joint_velocity_limits", "joint_friction", "joint_slip_rates")
REGIMES = {
    # Limits of efforts and speeds, friction, slip rate; the effort or target of the joints.
    "sticking": ([9.0, 9.0], [9.0, 9.0], [3.0, 2.0], [0.1, 0.2], [0.5, -0.3]),
    "slipping": ([9.0, 9.0], [9.0, 9.0], [0.1, 0.05], [0.01, 0.02], [1.5, -1.0]),
    "saturated": ([0.5, 0.3], [9.0, 9.0], [0.0, 0.1], [0.01, 0.02], [3.0, -2.5]),
    "blend": ([1.0, 1.0], [9.0, 9.0], [0.1, 0.0], [0.5, 0.2], [0.95, -1.02]),
    "fast": ([9.0, 9.0], [0.4, 0.3], [0.1, 0.1], [0.05, 0.05], [2.5, -2.0]),
}


def two_joints(folder, mode):
    gains = {} if mode == "torque" else {"stiffness": 4.0, "damping": 0.05}
    return dc.Robot.load(arm_file(folder, 2), actuation=mode, **gains)


def regime_of(sim, name):
    *values, asked = (tensor(*row) for row in REGIMES[name])
    return dict(zip(NEW, values, strict=True)), asked


def loss_of(sim, mode, state, inputs):
    parameters = sim.default_parameters().replace(**{n: inputs[n] for n in NEW})
    names = ("joint_positions", "joint_velocities")
    state = state.replace(**{n: inputs[f"start.{n}"] for n in names})
    efforts = inputs["asked"]
    control = {"joint_efforts": efforts}
    if mode == "pd":
        control = {"joint_positions": 0.2 * efforts, "joint_efforts": 0.3 * efforts}
    for _ in range(3):
        state = sim.step(state, sim.control(**control), parameters)
    weights = tensor(1.0, -0.7)
    return (weights * (state.joint_positions + 0.1 * state.joint_velocities)).sum() + (
        0.01 * weights * state.joint_efforts
    ).sum()


@pytest.mark.parametrize("mode", ["torque", "pd"])
@pytest.mark.parametrize("name", REGIMES)
def test_gradients_in_every_regime_are_central_differences(tmp_path, mode, name):
    sim = simulator(two_joints(tmp_path, mode))
    values, asked = regime_of(sim, name)
    start = sim.initial_state()
    inputs = values | {
        "asked": asked,
        "start.joint_positions": tensor(0.1, 0.05),
        "start.joint_velocities": tensor(0.0, 0.0) if name == "sticking" else tensor(0.3, -0.2),
    }
    leaves = {n: t.clone().requires_grad_() for n, t in inputs.items()}
    gradients = torch.autograd.grad(loss_of(sim, mode, start, leaves), list(leaves.values()))
    active = {
        "sticking": ("joint_friction", "joint_slip_rates"),
        "slipping": ("joint_friction",),
        "saturated": ("joint_effort_limits",),
        "blend": ("joint_effort_limits", "asked"),
        "fast": ("joint_velocity_limits",),
    }[name]
    for gradient, (n, value) in zip(gradients, inputs.items(), strict=True):
        if n in active:
            assert gradient.any()
        for k in range(2):
            step = 1e-6 * torch.nn.functional.one_hot(torch.tensor(k), 2).to(F64)
            if float(value[k]) == 0.0 and n == "joint_friction":
                continue  # zero friction is the end of the range
            with torch.no_grad():
                ends = [
                    loss_of(sim, mode, start, inputs | {n: value + s * step}) for s in (1.0, -1.0)
                ]
            found = float(ends[0] - ends[1]) / 2e-6
            # A step is known to its tolerance times dt, 1e-12.
            assert float(gradient[k]) == pytest.approx(found, rel=1e-5, abs=1e-6), (n, k)


@pytest.mark.parametrize("mode", ["torque", "pd"])
@pytest.mark.parametrize("name", REGIMES)
def test_tangents_are_the_transpose_of_gradients(tmp_path, mode, name):
    sim = simulator(two_joints(tmp_path, mode))
    values, asked = regime_of(sim, name)
    start = sim.initial_state().replace(joint_velocities=tensor(0.3, -0.2))
    inputs = values | {"asked": asked}
    names = ("joint_positions", "joint_velocities")
    inputs |= {f"start.{n}": getattr(start, n) for n in names}

    def loss(*tensors):
        return loss_of(sim, mode, start, dict(zip(inputs, tensors, strict=True)))

    generator = torch.Generator().manual_seed(3)
    ways = [torch.randn(t.shape, generator=generator, dtype=F64) for t in inputs.values()]
    _, tangent = torch.func.jvp(loss, tuple(inputs.values()), tuple(ways))
    gradients = torch.func.grad(loss, tuple(range(len(inputs))))(*inputs.values())
    terms = [(g * w).sum() for g, w in zip(gradients, ways, strict=True)]
    assert abs(float(tangent - sum(terms))) <= 1e-11 * float(sum(abs(t) for t in terms))


def test_environments_have_limits_of_their_own_with_the_bits_that_they_have_alone(tmp_path):
    sim = simulator(two_joints(tmp_path, "pd"))
    rows = [regime_of(sim, name) for name in REGIMES]
    control = {"joint_positions": tensor(0.4, -0.3), "joint_efforts": tensor(0.8, -0.9)}
    batch, together = sim.initial_state(len(rows)), []
    given = {n: torch.stack([values[n] for values, _ in rows]) for n in NEW}
    before = torch.get_num_threads()
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            state = batch
            for _ in range(4):
                parameters = sim.default_parameters().replace(**given)
                state = sim.step(state, sim.control(**control), parameters)
            together.append(state)
    finally:
        torch.set_num_threads(before)
    for k, (values, _) in enumerate(rows):
        alone = sim.initial_state()
        for _ in range(4):
            alone = sim.step(
                alone, sim.control(**control), sim.default_parameters().replace(**values)
            )
        for state in together:
            assert torch.equal(state.joint_positions[k], alone.joint_positions)
            assert torch.equal(state.joint_efforts[k], alone.joint_efforts)
    assert len(together[0].joint_positions.unique(dim=0)) == len(rows)


# --- Equilibria -----------------------------------------------------------------------------------


def test_friction_holds_an_arm_where_the_search_begins(tmp_path):
    """Regularized friction: the joint yields up to the slip that carries the load, and stays."""
    robot = dc.Robot.load(arm_file(tmp_path, friction=1.2 * WEIGHT), actuation="torque")
    sim = simulator(robot)
    found = sim.equilibrium(sim.initial_state())
    slip = float(sim.default_parameters().joint_slip_rates) * H
    share = float(found.joint_positions) / slip
    # The joint yields by 6e-7 rad, which the solver finds up to its tolerance.
    assert share * (2.0 - share) == pytest.approx(1.0 / 1.2, rel=1e-5)
    # With less friction the arm falls until friction balances the moment of the weight.
    robot = dc.Robot.load(arm_file(tmp_path, friction=0.5 * WEIGHT), actuation="torque")
    found = simulator(robot).equilibrium(sim.initial_state())
    assert WEIGHT * np.cos(float(found.joint_positions)) == pytest.approx(0.5 * WEIGHT, rel=1e-6)


@pytest.mark.slow
def test_gradients_of_an_equilibrium_by_limits_friction_and_start(tmp_path):
    robot = dc.Robot.load(arm_file(tmp_path, 2), stiffness=3.0, damping=0.1)
    sim = simulator(robot)
    up = sim.control(joint_positions=tensor(-0.5, -0.4))
    values = {
        "joint_effort_limits": tensor(1.1, 0.7),
        "joint_friction": tensor(0.3, 0.9),
        "joint_slip_rates": tensor(0.3, 0.4),
        "joint_stiffness": tensor(3.0, 2.0),
        "start": tensor(0.1, 0.05),
    }
    start = sim.initial_state()

    def end(inputs):
        given = {n: t for n, t in inputs.items() if n != "start"}
        state = start.replace(joint_positions=inputs["start"])
        found = sim.equilibrium(state, up, sim.default_parameters().replace(**given))
        return (found.joint_positions * tensor(1.0, -0.6)).sum() + 0.1 * found.joint_efforts.sum()

    leaves = {n: t.clone().requires_grad_() for n, t in values.items()}
    gradients = torch.autograd.grad(end(leaves), list(leaves.values()))
    for gradient, (n, value) in zip(gradients, values.items(), strict=True):
        assert gradient.any()
        for k in range(2):
            step = 1e-6 * torch.nn.functional.one_hot(torch.tensor(k), 2).to(F64)
            with torch.no_grad():
                ends = [end(values | {n: value + s * step}) for s in (1.0, -1.0)]
            found = float(ends[0] - ends[1]) / 2e-6
            assert float(gradient[k]) == pytest.approx(found, rel=1e-5, abs=1e-6), (n, k)


def test_an_arm_rests_on_its_limit_where_a_rollout_leaves_it(tmp_path):
    """The barrier uses the simulator's time step, not the long steps of the search."""
    path = arm_file(tmp_path)
    path.write_text(path.read_text().replace('upper="20"', 'upper="0.3"'))
    sim = simulator(dc.Robot.load(path, actuation="torque"))
    slow = sim.default_parameters().replace(joint_viscosity=tensor(0.5))
    with torch.no_grad():
        end = sim.rollout(sim.initial_state(), parameters=slow, steps=150)[-1]
        found = sim.equilibrium(sim.initial_state(), None, slow)
    beyond, expected = (float(state.joint_positions) - 0.3 for state in (found, end))
    assert beyond > 0.01
    assert beyond == pytest.approx(expected, rel=1e-6)


def test_a_limit_of_the_speed_does_not_slow_the_way_to_an_equilibrium(tmp_path):
    ends = []
    for velocity in (0, 0.1):
        robot = dc.Robot.load(arm_file(tmp_path, velocity=velocity), stiffness=5.0, damping=0.1)
        sim = simulator(robot)
        ends.append(sim.equilibrium(sim.initial_state()).joint_positions)
    assert torch.equal(*ends)


# --- Iterations -----------------------------------------------------------------------------------


def test_friction_that_turns_round_takes_few_iterations(tmp_path):
    """Dual variables store the other side of the kink, which plain Newton steps would cross."""
    path = arm_file(tmp_path, 3, friction=[1.0, 0.7, 0.4])
    robot = dc.Robot.load(path, stiffness=40.0, damping=2.0)
    sim = dc.Simulator(
        dc.Scene([], robots=[robot], gravity=(0, 0, 0)),
        H,
        contact=dc.ContactOptions(barrier_distance=1e-3),
    )
    state, counts = sim.initial_state(), []
    for k in range(40):
        target = 0.02 * np.sin(0.3 * k) * tensor(1.0, -1.0, 1.0)
        state = sim.step(state, sim.control(joint_positions=target))
        counts.append(state.report.iterations)
    assert np.mean(counts) < 10
    assert max(counts) < 20
