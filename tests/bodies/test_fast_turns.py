"""Bodies that turn far in a step: by themselves, and in contact."""

import numpy as np
import pytest
import torch
from coupled_scenes import F64

import diffcloth_torch as dc
from diffcloth_torch import _kernels
from diffcloth_torch.geometry.rotation import quaternion_matrix

H = 0.008
SIZES = [(0.06, 0.06, 0.06), (0.05, 0.08, 0.13), (0.01, 0.02, 0.2)]


def thrown(size, turn, seed, height=None):
    """A box above a floor that turns by `turn` rad a step, and reaches the floor soon."""
    rng = np.random.default_rng(seed)
    pose, axis = rng.normal(size=4), rng.normal(size=3)
    reach = np.linalg.norm(size) / 2
    drawn = 0.8 + 0.25 * rng.random()
    height = reach * (drawn if height is None else height)
    box = dc.RigidBody.box(
        size, motion="dynamic", density=400, pose=[0, 0, height, *pose], name="stick",
    )  # fmt: skip
    sim = dc.Simulator(
        dc.Scene([], [dc.RigidBody.plane(3.0), box], gravity=(0, 0, 0)),
        H,
        contact=dc.ContactOptions(barrier_distance=reach / 60),
        # A residual against the slip velocity is a share of friction.
        solver=dc.SolverOptions(tolerance=1e-8),
    )
    speed = turn / H
    velocities = torch.zeros(2, 6, dtype=F64)
    velocities[1, 2] = -0.3 * speed * reach
    velocities[1, 3:] = torch.tensor(axis / np.linalg.norm(axis) * speed)
    return sim, sim.initial_state().replace(body_velocities=velocities)


def contact_steps(size, turn, seed, steps):
    """The simulator, and states before and after each step in which a thrown box touches."""
    try:
        sim, state = thrown(size, turn, seed)
        for _ in range(steps):
            with torch.no_grad():
                after = sim.step(state)
            if after.body_forces.any():
                yield sim, state, after
            state = after
    except (dc.IntersectingState, dc.TurnedTooFar):
        pass  # the throw starts in the floor, or its spin grows beyond the resolution of a step


@pytest.mark.parametrize("size", SIZES)
def test_contact_adds_no_energy_to_bodies_that_turn_a_tenth_of_a_radian(size):
    touched = 0
    for seed in range(6):
        for sim, before, after in contact_steps(size, 0.1, seed, 20):
            assert sim.kinetic_energy(after) + sim.energy(after) < sim.kinetic_energy(
                before
            ) + sim.energy(before)
            touched += 1
    assert touched > 5


def momentum(sim, state):
    """Momentum of the box; the angular part is about its center."""
    linear, angular = sim.momentum(state).split(3)
    return torch.cat([linear, angular - torch.linalg.cross(state.body_poses[1, :3], linear)])


@pytest.mark.parametrize("turn", [0.4, 0.8])
def test_contact_gives_the_momentum_of_its_forces(turn):
    """No part of the momentum is lost, at any angular speed of the box."""
    touched = 0
    for seed in range(6):
        for sim, before, after in contact_steps(SIZES[1], turn, seed, 8):
            gained = momentum(sim, after) - momentum(sim, before)
            wrench = sim.contact_wrenches(after)["stick"]
            assert (gained - H * wrench)[:3].norm() < 1e-4 * gained[:3].norm()
            assert (gained - H * wrench)[3:].norm() < 1e-4 * gained[3:].norm()
            touched += 1
    assert touched > 5


@pytest.mark.parametrize("turn", [0.4, 0.8])
def test_gradients_of_a_step_that_touches_while_it_turns_fast(turn):
    sim, before, _ = next(
        found for seed in range(40) for found in contact_steps(SIZES[1], turn, seed, 8)
    )
    tight = dc.SolverOptions(tolerance=1e-9)
    sim = dc.Simulator(sim.scene, H, contact=sim.contact, solver=tight)
    base = before.body_velocities.detach()
    weights = torch.tensor([0.3, -0.7, 1.1, 0.02, 0.05, -0.03], dtype=F64)

    def loss(velocities):
        return sim.step(before.replace(body_velocities=velocities)).body_velocities[1] @ weights

    given = base.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(given), given)
    for i in range(6):
        change = torch.zeros_like(base)
        change[1, i] = 1e-5 * (1 if i < 3 else 30)
        with torch.no_grad():
            slope = (loss(base + change) - loss(base - change)) / (2 * change[1, i])
        assert gradient[1, i] == pytest.approx(float(slope), rel=1e-3, abs=1e-4)


@pytest.mark.parametrize(
    ("inertia", "spin"),
    [
        ([0.2, 1.0, 1.1], [2.0, 1.5, -1.7]),
        # No real body has this symmetric inertia: all terms of the series count for its momentum.
        ([0.009, 0.057, 1.0], [-2.2, 1.6, -0.54]),
    ],
)
def test_a_body_by_itself_turns_exactly(inertia, spin):
    """A step of 3 rad equals many small steps and conserves energy and momentum."""
    J = torch.diag(torch.tensor(inertia, dtype=F64))[None, None]
    spin = torch.tensor(spin, dtype=F64)
    momentum = (J[0, 0] @ spin).expand(1, 1, 3)

    def turned(momentum, time):
        quaternion, _, _ = _kernels.free_turns(J.numpy(), momentum.numpy(), time)
        return quaternion_matrix(torch.from_numpy(quaternion))[0]

    whole = turned(momentum, 1.0)
    turn = torch.eye(3, dtype=F64)
    for _ in range(50):
        turn = turn @ turned(turn.T @ momentum[0, 0], 0.02)
    torch.testing.assert_close(whole, turn, rtol=0, atol=1e-13)
    local = whole.T @ momentum[0, 0]
    energy = local @ torch.linalg.solve(J[0, 0], local) / 2
    assert float(energy) == pytest.approx(float(spin @ momentum[0, 0] / 2), rel=1e-13)


def test_derivatives_of_a_free_turn():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(2, 3, 3))
    given = np.concatenate(
        [
            (root @ root.transpose(0, 2, 1) + np.eye(3)).reshape(2, 9),
            rng.normal(size=(2, 3)) * 4,
        ],
        axis=1,
    )

    def turns(given):
        parts = np.ascontiguousarray(given[:, :9]), np.ascontiguousarray(given[:, 9:])
        return _kernels.free_turns(*parts, 0.7)

    _, rates, found = turns(given)
    assert found.all()
    for i, unit in enumerate(1e-6 * np.eye(12)):
        expected = (turns(given + unit)[0] - turns(given - unit)[0]) / 2e-6
        np.testing.assert_allclose(rates[:, :, i], expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("turn", [1.8, 4.0])
def test_energy_and_momentum_of_a_state_know_no_speed_limit(turn):
    sim, state = thrown((0.01, 0.02, 0.2), turn, 2, height=1.1)
    still = state.replace(body_velocities=torch.zeros_like(state.body_velocities))
    assert sim.energy(state) == sim.energy(still)
    assert sim.momentum(state).isfinite().all()


def rolling(turn):
    """A ball on a floor, and its state when rolling by `turn` rad per step."""
    ball = dc.RigidBody.sphere(
        0.004, subdivisions=2, motion="dynamic", density=300, pose=[0, 0, 0.00406, 1, 0, 0, 0],
        friction=0.5, name="marble",
    )  # fmt: skip
    sim = dc.Simulator(
        dc.Scene([], [dc.RigidBody.plane(9.0, friction=0.5), ball]),
        H,
        contact=dc.ContactOptions(barrier_distance=1e-4),
    )
    velocities = torch.zeros(2, 6, dtype=F64)
    velocities[1, 0], velocities[1, 4] = turn / H * 0.004, turn / H
    return sim, sim.initial_state().replace(body_velocities=velocities)


@pytest.mark.parametrize("size", SIZES)
def test_contact_seldom_adds_energy_to_bodies_that_turn_less_than_a_radian(size):
    """Counted as in `python -m benchmarks.turns`; sticks once gained eight times their energy."""
    rises = []
    for turn in (0.3, 0.6):
        for seed in range(12):
            for sim, before, after in contact_steps(size, turn, seed, 8):
                kinetic = sim.kinetic_energy(before)
                gained = sim.kinetic_energy(after) + sim.energy(after) - sim.energy(before)
                rises.append(float(gained / kinetic) - 1)
    assert len(rises) > 20
    assert max(rises) < 0.1
    assert sum(rise > 1e-3 for rise in rises) <= len(rises) / 40


def test_a_stick_that_contact_spins_up_fails():
    """The stick turns slowly at the start, and by more than a radian per step at the end."""
    spun = 0
    for seed in range(30):
        try:
            sim, state = thrown(SIZES[2], 0.4, seed)
            for _ in range(8):
                with torch.no_grad():
                    state = sim.step(state)
        except dc.IntersectingState:
            continue
        except dc.TurnedTooFar:
            spun += H * float(state.body_velocities[1, 3:].norm()) < 0.9
    assert spun > 3


def test_a_turn_too_far_is_a_value_of_its_environment():
    sim, slow = rolling(0.1)
    fast = rolling(2.0)[1]
    silent = dc.Simulator(sim.scene, H, contact=sim.contact, solver=dc.SolverOptions(throw=False))
    start = dc.stack([slow, fast, slow])
    velocities = start.body_velocities.clone().requires_grad_()
    after = silent.step(start.replace(body_velocities=velocities))
    assert after.report.status == ("converged", "turned_too_far", "converged")
    assert torch.equal(after.body_poses[0].detach(), sim.step(slow).body_poses)
    (gradient,) = torch.autograd.grad(after.body_poses[[0, 2]].sum(), velocities, retain_graph=True)
    assert gradient[0].any()
    assert not gradient[1].any()
    with pytest.raises(dc.TurnedTooFar, match=r"environments \[1\]"):
        after.body_poses.sum().backward()


def test_a_ball_that_rolls_too_fast_is_refused_by_name():
    sim, state = rolling(2.0)
    with pytest.raises(
        dc.SimulationError, match=r"'marble' turns at 2\d\d rad/s.* time step of at most 0.003\d+ s"
    ) as error:
        sim.step(state)
    assert error.value.environments == (0,)


def test_the_environment_that_turns_too_fast_is_named():
    sim, slow = rolling(0.1)
    fast = rolling(2.0)[1]
    with pytest.raises(dc.SimulationError, match="'marble' turns") as error:
        sim.step(dc.stack([slow, fast]))
    assert error.value.environments == (1,)


def test_environments_of_bodies_that_turn_too_far_are_named():
    """The message names the first such body of the first such environment."""
    boxes = [
        dc.RigidBody.box(0.1, motion="dynamic", mass=1.0, pose=[k, 0, 0, 1, 0, 0, 0], name=name)
        for k, name in enumerate(("one", "other"))
    ]
    contact = dc.ContactOptions(barrier_distance=1e-3)
    sim = dc.Simulator(dc.Scene([], boxes, gravity=(0, 0, 0)), H, contact=contact)
    state = sim.initial_state(4)
    state.body_velocities[..., 5] = (
        torch.tensor([[10, 20], [15000, 16000], [5, 6], [30, 17000]], dtype=F64) / H
    )
    with pytest.raises(dc.TurnedTooFar, match=r"'one' turns at 1.88e\+06 rad/s") as error:
        sim.step(state)
    assert error.value.environments == (1, 3)


ARM = """
<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial><origin xyz="0.1 0 0"/><mass value="0.5"/>
      <inertia ixx="1e-4" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="lower">
    <inertial><origin xyz="0.05 0.02 0"/><mass value="0.2"/>
      <inertia ixx="1e-4" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 1.5"/><axis xyz="0 1 0"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.2 0 0"/><axis xyz="0 1 0.3"/></joint>
</robot>
"""


@pytest.mark.parametrize("elbow", [-0.3, 0.5, 1.0])
@pytest.mark.parametrize("turn", [0.5, 1.0, 1.5])
def test_an_arm_that_spins_freely_keeps_its_energy(tmp_path, turn, elbow):
    file = tmp_path / "arm.urdf"
    file.write_text(ARM)
    arm = dc.Robot.load(file, actuation="torque", name="arm")
    contact = dc.ContactOptions(barrier_distance=1e-3)
    sim = dc.Simulator(dc.Scene([], [], [arm], gravity=(0, 0, 0)), 0.01, contact=contact)
    rates = torch.tensor([turn / sim.dt, elbow * turn / sim.dt], dtype=F64)
    start = sim.initial_state().replace(joint_velocities=rates)
    with torch.no_grad():
        states = sim.rollout(start, steps=40)
    energies = torch.stack([sim.kinetic_energy(state) for state in states])
    assert (energies / sim.kinetic_energy(start) - 1).abs().max() < 0.012


@pytest.mark.parametrize("coupling", ["monolithic", "rigid_to_cloth", "cloth_to_rigid"])
def test_a_robot_that_is_too_fast_by_itself_is_a_value_of_its_environment(tmp_path, coupling):
    """An earlier version raised for the whole batch."""
    file = tmp_path / "arm.urdf"
    file.write_text(ARM)
    arm = dc.Robot.load(file, actuation="torque", name="arm")
    scene = dc.Scene(
        [dc.Cloth.grid(3, 3)], [dc.RigidBody.plane(4, pose=[0, 0, -1, 1, 0, 0, 0])], [arm]
    )
    sim = dc.Simulator(scene, 0.01, coupling=coupling)
    silent = dc.Simulator(scene, 0.01, coupling=coupling, solver=dc.SolverOptions(throw=False))
    one = sim.initial_state()
    slow = one.replace(joint_velocities=torch.tensor([3.0, -1.0], dtype=F64))
    fast = one.replace(joint_velocities=torch.tensor([4000.0, -1200.0], dtype=F64))
    start = dc.stack([slow, fast, slow])
    rates = start.joint_velocities.clone().requires_grad_()
    after = silent.step(start.replace(joint_velocities=rates))
    assert after.report.status == ("converged", "turned_too_far", "converged")
    alone = sim.step(slow)
    for k in (0, 2):
        assert torch.equal(after.joint_positions[k], alone.joint_positions)
        assert torch.equal(after.positions[k], alone.positions)
    assert torch.isfinite(after.joint_positions).all()
    (gradient,) = torch.autograd.grad(after.joint_positions[::2].sum(), rates, retain_graph=True)
    assert gradient[::2].all()
    assert not gradient[1].any()
    with pytest.raises(dc.TurnedTooFar, match=r"environments \[1\]"):
        after.joint_positions.sum().backward()
    with pytest.raises(dc.TurnedTooFar, match="robot 'arm' are too large") as error:
        sim.step(start)
    assert error.value.environments == (1,)
    assert error.value.report.status == after.report.status
    with pytest.raises(dc.TurnedTooFar, match="robot 'arm'"):
        sim.path(fast)


def test_an_error_tells_of_failures_of_every_kind():
    """An earlier version omitted too-fast rotations if another environment failed otherwise."""
    sheet = dc.Cloth.grid(3, 3, size=0.1, pose=[1, 0, 0.1, 1, 0, 0, 0], pins={"all": range(9)})
    sim, rolls = rolling(0.1)
    scene = dc.Scene([sheet], sim.scene.bodies, gravity=sim.scene.gravity)
    sim = dc.Simulator(scene, H, contact=sim.contact)
    start = dc.stack([sim.initial_state()] * 4)
    velocities = rolls.body_velocities.expand(4, -1, -1).clone()
    velocities[1::2] *= 20
    pins = start.positions.clone()
    pins[2:, :, 2] -= 0.2  # through the floor
    with pytest.raises(dc.InfeasibleMotion) as error:
        sim.step(start.replace(body_velocities=velocities), dc.Control(pins=pins))
    assert error.value.environments == (2, 3)
    blocked = ("infeasible_motion",) * 2  # reported first, whatever else fails there
    assert error.value.report.status == ("converged", "turned_too_far", *blocked)
