"""Energy by parts, masses, momentum and kinetic energy: by hand, by differences, and as laws."""

import numpy as np
import pytest
import scenes
import torch
from physics_scenes import F64, WEIGHTLESS, lumped_masses, tensor
from processes import threads

import diffcloth_torch as dc
from diffcloth_torch.dynamics.totals import ordered_sum

G = 9.81
DT = 0.01
PENDULUM = """<robot name="pendulum"><link name="base"/>
  <link name="bob"><inertial><origin xyz="0 0 -0.5"/><mass value="2"/>
    <inertia ixx="0.02" iyy="0.03" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="bob"/>
    <axis xyz="0 1 0"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def sim():
    """Two cloths of two materials, a free box, and a floating gripper."""
    first = dc.Cloth.grid(
        4,
        4,
        size=0.3,
        material=dc.Material(bending=1e-3),
        pins={"corner": [0]},
        soft_pins={"other": [3, 15]},
        pose=[0, 0, 1, 1, 0.1, 0.05, 0],
    )
    second = dc.Cloth.grid(
        3, 3, size=0.2, material=dc.Material(density=0.3), pose=[0, 0, 1.012, 1, 0.1, 0.05, 0]
    )
    bodies = [
        dc.RigidBody.plane(4.0),
        dc.RigidBody.box([0.1, 0.2, 0.3], motion="kinematic", pose=[0, 3, 1, 1, 0, 0, 0]),
        dc.RigidBody.box(
            [0.1, 0.2, 0.3], motion="dynamic", mass=0.5, pose=[2, 0, 1, 1, 0.2, 0.3, 0.1]
        ),
    ]
    hand = dc.Robot.load(
        dc.robots.GRIPPER,
        base="floating",
        pose=[0, -2, 1, 1, 0.3, 0.2, 0],
        joint_positions=0.02,
        actuation=("position", "torque"),
    )
    contact = dc.ContactOptions(barrier_distance=0.02)
    return dc.Simulator(dc.Scene([first, second], bodies, [hand]), DT, contact=contact)


def moved(sim, batch_size=None, seed=0):
    """Everything that may move does, and nothing is at rest length."""
    state = sim.initial_state(batch_size)
    given = {
        name: scenes.tensor_noise(getattr(state, name).shape, scale, seed + i)
        for i, (name, scale) in enumerate(
            {
                "velocities": 0.3,
                "body_velocities": 0.4,
                "base_velocities": 0.5,
                "joint_velocities": 0.2,
            }.items()
        )
    }
    noise = scenes.tensor_noise(state.positions.shape, 2e-3, seed + 9)
    return state.replace(positions=state.positions + noise, **given)


# --- Energy --------------------------------------------------------------------------------------


def test_energy_takes_parameters_in_the_place_that_they_had_in_0_1():
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid((3, 3), 0.1)]), 0.01)
    state, heavy = sim.initial_state(), sim.default_parameters().replace(density=3.0)
    with pytest.warns(FutureWarning, match=r"energy: the order is \(state, control, parameters\)"):
        before = sim.energy(state, heavy)
    assert torch.equal(before, sim.energy(state, None, heavy))


def test_the_parts_of_the_energy_add_up_to_it(sim):
    state = moved(sim)
    parts = sim.energy(state, parts=True)
    assert list(parts) == ["stretch", "bending", "attachments", "soft_pins", "contact", "gravity"]
    assert parts["attachments"] == 0.0
    rest = [part for name, part in parts.items() if name != "attachments"]
    assert all(part.shape == () and part != 0 for part in rest), parts
    assert sim.energy(state) == sum(parts.values())
    batch = dc.stack([state, sim.initial_state()])
    for name, part in sim.energy(batch, parts=True).items():
        assert part.shape == (2,)
        assert torch.equal(part[0], parts[name])


def test_parts_of_the_energy_are_those_of_their_names():
    """A square that is stretched, lies within reach of the floor, and pulls at its soft pins."""
    cloth = dc.Cloth.grid(
        3, 3, size=0.2, material=dc.Material(bending=0.0), soft_pins={"all": range(9)}
    )
    floor = dc.RigidBody.plane(1.0, pose=[0, 0, -0.004, 1, 0, 0, 0])
    sim = dc.Simulator(
        dc.Scene([cloth], [floor]), DT, contact=dc.ContactOptions(barrier_distance=0.005)
    )
    start = sim.initial_state()
    factor = torch.tensor([1.1, 1.0, 1.0], dtype=F64)
    parts = sim.energy(start.replace(positions=factor * start.positions), parts=True)
    given = sim.default_parameters()
    # 1/2 k_s (s - 1)^2 of the area; 1/2 k |x - c|^2 of each pin.
    assert parts["stretch"].item() == pytest.approx(0.5 * 550 * 0.1**2 * 0.2**2, rel=1e-12)
    pulled = ((factor - 1) * start.positions).square().sum().item()
    assert parts["soft_pins"].item() == pytest.approx(0.5 * 1e4 * pulled, rel=1e-12)
    assert parts["bending"] == 0
    assert parts["gravity"] == 0  # at the height of the origin
    higher = sim.energy(start.replace(positions=start.positions + 7.0), parts=True)
    weight = 0.124 * 0.2**2 * G
    assert higher["gravity"].item() == pytest.approx(7 * weight, rel=1e-12)
    assert higher["contact"] == 0
    twice = given.replace(barrier_stiffness=2 * given.barrier_stiffness)
    barrier = sim.energy(start, parts=True)["contact"].item()
    assert barrier > 0
    assert sim.energy(start, parameters=twice, parts=True)["contact"].item() == pytest.approx(
        2 * barrier
    )


def test_a_control_moves_the_soft_pins_and_their_energy():
    cloth = dc.Cloth.grid(3, 3, size=0.2, soft_pins={"all": range(9)}, pin_stiffness=70.0)
    sim = dc.Simulator(dc.Scene([cloth]), DT)
    state = sim.initial_state()
    way = torch.tensor([0.1, -0.2, 0.3], dtype=F64)
    away = sim.control(soft_pins=state.positions + way, forces=torch.ones(9, 3))
    energy = sim.energy(state, control=away, parts=True)["soft_pins"]
    assert energy.item() == pytest.approx(9 * 0.5 * 70 * (way @ way).item(), rel=1e-12)


def test_bending_is_a_part_of_its_own():
    cloth = dc.Cloth.grid(5, 5, size=0.2, material=dc.Material(bending=1e-3))
    sim = dc.Simulator(dc.Scene([cloth], gravity=WEIGHTLESS), DT)
    flat = sim.initial_state().positions
    wave = flat + torch.tensor([0, 0, 1e-4], dtype=F64) * torch.cos(20 * flat[:, :1])
    state = sim.initial_state().replace(positions=wave)
    stiffer = sim.default_parameters().replace(bending=3e-3)
    once, thrice = sim.energy(state, parts=True), sim.energy(state, parameters=stiffer, parts=True)
    assert thrice["bending"].item() == pytest.approx(3 * once["bending"].item(), rel=1e-12)
    assert once["bending"] > 0
    assert thrice["stretch"] == once["stretch"]


def test_gravity_of_the_energy_is_that_of_everything_with_mass(sim):
    """Lifting by a height costs m g times the height, whatever has the mass."""
    state = moved(sim)
    lift = torch.tensor([0, 0, 3.0], dtype=F64)
    up = {
        name: getattr(state, name) + torch.nn.functional.pad(lift, (0, 4))
        for name in ("body_poses", "base_poses")
    }
    for name, mass in (
        ("positions", sim.vertex_masses().sum()),
        ("body_poses", 0.5),
        ("base_poses", sim.default_parameters().link_mass.sum()),
    ):
        higher = state.replace(**{name: up.get(name, state.positions + lift)})
        change = (
            sim.energy(higher, parts=True)["gravity"] - sim.energy(state, parts=True)["gravity"]
        )
        assert change.item() == pytest.approx(3 * G * float(mass), rel=1e-12), name


def test_parts_must_be_true_or_false(sim):
    with pytest.raises(TypeError, match="`parts` must be True or False, got str"):
        sim.energy(sim.initial_state(), parts="stretch")


# --- Masses --------------------------------------------------------------------------------------


def test_vertex_masses_are_a_third_of_those_of_the_faces(sim):
    masses = sim.vertex_masses()
    expected = [
        lumped_masses(cloth.rest_positions, cloth.faces, density)
        for cloth, density in zip(sim.scene.cloths, (0.124, 0.3), strict=True)
    ]
    np.testing.assert_allclose(masses, np.concatenate(expected), rtol=1e-14)
    assert masses.sum().item() == pytest.approx(0.124 * 0.09 + 0.3 * 0.04, rel=1e-12)


def test_vertex_masses_follow_the_parameters(sim):
    rest = sim.default_parameters().rest_positions
    faces = sum(len(cloth.faces) for cloth in sim.scene.cloths)
    density = torch.linspace(0.1, 0.4, faces, dtype=F64)
    wider = sim.default_parameters().replace(density=density, rest_positions=2 * rest)
    heavier = sim.vertex_masses(wider)
    narrow = sim.vertex_masses(sim.default_parameters().replace(density=density))
    torch.testing.assert_close(heavier, 4 * narrow, rtol=1e-13, atol=0)
    both = sim.default_parameters().replace(density=torch.stack([density, 3 * density]))
    masses = sim.vertex_masses(both, batch_size=2)
    torch.testing.assert_close(masses, torch.stack([narrow, 3 * narrow]), rtol=1e-13, atol=0)
    assert sim.vertex_masses(batch_size=3).shape == (3, 25)
    with pytest.raises(dc.InvalidInput, match="batch axis"):
        sim.vertex_masses(both)
    with pytest.raises(dc.InvalidInput, match="`batch_size` must be at least 1, got 0"):
        sim.vertex_masses(batch_size=0)


def test_vertex_masses_are_those_of_a_step():
    """A push changes the velocity of an otherwise free vertex by h f / m."""
    cloth = dc.Cloth.grid(3, 3, material=dc.Material(stretch=1e-9, bending=0.0))
    sim = dc.Simulator(
        dc.Scene([cloth], gravity=WEIGHTLESS),
        DT,
        contact=dc.ContactOptions(self_contact=False),
        solver=dc.SolverOptions(tolerance=1e-14),
    )
    forces = scenes.tensor_noise((9, 3), 1e-4, 0)
    after = sim.step(sim.initial_state(), dc.Control(forces=forces))
    expected = DT * forces / sim.vertex_masses()[:, None]
    torch.testing.assert_close(after.velocities, expected, rtol=1e-6, atol=0)


# --- Momentum and kinetic energy -----------------------------------------------------------------


def test_momentum_by_hand():
    """A cloth that drifts, and a box that does and spins about its center."""
    cloth = dc.Cloth.grid(3, 3, size=1.0, pose=[2, 0, 0, 1, 0, 0, 0])
    box = dc.RigidBody.box(
        [0.1, 0.2, 0.3], motion="dynamic", mass=3.0, pose=[0, 4, 0, 0.5, 0.5, 0.5, 0.5]
    )
    sim = dc.Simulator(dc.Scene([cloth], [box]), DT)
    start = sim.initial_state()
    state = start.replace(
        velocities=tensor([0, 5, 0]).expand(9, 3),
        body_velocities=tensor([[0, 0, 6, 0, 0, 7]]),
    )
    # The pose maps x to y, y to z and z to x: rotation about the world's z is about the box's y.
    moment = 3.0 / 12 * (0.1**2 + 0.3**2)
    expected = [0, 0.124 * 5, 3 * 6, 4 * 3 * 6, 0, 2 * 0.124 * 5 + moment * 7]
    np.testing.assert_allclose(sim.momentum(state), expected, rtol=1e-12, atol=1e-12)
    energy = 0.5 * (0.124 * 25 + 3 * 36 + moment * 49)
    assert sim.kinetic_energy(state).item() == pytest.approx(energy, rel=1e-12)
    assert sim.kinetic_energy(start) == 0
    np.testing.assert_array_equal(sim.momentum(start), np.zeros(6))


def test_a_pendulum_by_hand(tmp_path):
    """A bob of 2 kg, 0.5 m below its hinge at height 1, that turns by 3 rad/s; with its drive."""
    (tmp_path / "pendulum.urdf").write_text(PENDULUM)
    robot = dc.Robot.load(
        tmp_path / "pendulum.urdf", actuation="torque", pose=[0, 0, 1, 1, 0, 0, 0]
    )
    sim = dc.Simulator(
        dc.Scene([], [], [robot]), DT, contact=dc.ContactOptions(barrier_distance=1e-3)
    )
    state = sim.initial_state().replace(joint_velocities=tensor([3.0]))
    speed = 3 * -0.5  # y x (0, 0, -0.5) = (-0.5, 0, 0)
    expected = [2 * speed, 0, 0, 0, 0.5 * 2 * speed + 0.03 * 3, 0]
    np.testing.assert_allclose(sim.momentum(state), expected, rtol=1e-12, atol=1e-14)
    energy = 0.5 * (2 * speed**2 + 0.03 * 9)
    assert sim.kinetic_energy(state).item() == pytest.approx(energy, rel=1e-12)
    geared = sim.default_parameters().replace(joint_armature=tensor([0.1]))
    drive = sim.kinetic_energy(state, geared) - sim.kinetic_energy(state)
    assert drive.item() == pytest.approx(0.5 * 0.1 * 9, rel=1e-12)
    assert torch.equal(sim.momentum(state, geared), sim.momentum(state))
    assert sim.energy(state, parts=True)["gravity"].item() == pytest.approx(2 * G * 0.5, rel=1e-12)


def test_a_base_that_is_fixed_has_no_velocity(tmp_path):
    """Neither the energy nor a step depends on the state's velocity of a fixed base."""
    path = tmp_path / "pendulum.urdf"
    path.write_text(PENDULUM)
    hinge = dc.Robot.load(path, actuation="torque", base="fixed", name="pendulum")
    contact = dc.ContactOptions(barrier_distance=0.01)
    sim = dc.Simulator(dc.Scene([], robots=[hinge]), DT, contact=contact)
    state = sim.initial_state().replace(joint_velocities=torch.tensor([3.0], dtype=F64))
    other = state.replace(base_velocities=torch.ones(1, 6, dtype=F64))
    assert torch.equal(sim.kinetic_energy(state), sim.kinetic_energy(other))
    assert torch.equal(sim.momentum(state), sim.momentum(other))
    after, also = sim.step(state), sim.step(other)
    assert torch.equal(after.joint_velocities, also.joint_velocities)
    assert not also.base_velocities.any()


def test_drives_of_prescribed_joints_have_no_inertia(sim):
    """The first finger's position is prescribed, so its drive has no energy; the second's has."""
    state = moved(sim)
    geared = sim.default_parameters().replace(joint_armature=tensor([0.1, 0.2]))
    drives = sim.kinetic_energy(state, geared) - sim.kinetic_energy(state)
    expected = 0.5 * 0.2 * state.joint_velocities[1] ** 2
    # The difference of two energies, of some ten times its size.
    torch.testing.assert_close(drives, expected, rtol=1e-12, atol=1e-14)


def test_a_sum_has_the_same_bits_in_a_batch_and_on_several_threads():
    values = scenes.tensor_noise((3, 70_000), 1.0, 0)
    sums = []
    for count in (1, 2):
        with threads(count):
            sums += [ordered_sum(values), torch.stack([ordered_sum(row) for row in values])]
    assert all(torch.equal(other, sums[0]) for other in sums[1:])
    torch.testing.assert_close(sums[0], values.sum(-1), rtol=0, atol=1e-9)


@pytest.mark.parametrize("batch_size", [None, 3])
def test_shapes_in_a_batch(sim, batch_size):
    state = moved(sim, batch_size)
    shape = () if batch_size is None else (batch_size,)
    assert sim.momentum(state).shape == (*shape, 6)
    assert sim.kinetic_energy(state).shape == shape


def test_a_batch_has_the_bits_of_each_environment(sim):
    batch = moved(sim, 3)
    for measure in (sim.momentum, sim.kinetic_energy, sim.energy):
        alone = torch.stack([measure(state) for state in batch])
        assert torch.equal(measure(batch), alone), measure.__name__


def test_momentum_is_the_rate_of_the_moments_of_mass(sim):
    """d/dt sum m x of all points, by differences of positions along the velocities."""
    state = moved(sim)
    step = 1e-6

    def first_moment(sign):
        there = advanced(sim, state, sign * step)
        weight = [sim.energy(there, None, heavy(axis), parts=True)["gravity"] for axis in range(3)]
        return -torch.stack(weight)

    def heavy(axis):
        return sim.default_parameters().replace(gravity=torch.eye(3, dtype=F64)[axis])

    rate = (first_moment(1) - first_moment(-1)) / (2 * step)
    # Differences of energies of some 10 J over 2e-6 s.
    torch.testing.assert_close(sim.momentum(state)[:3], rate, rtol=1e-7, atol=1e-8)


def advanced(sim, state, time):
    """The state after a short time at its velocities."""

    def turned(poses, centers, velocities):
        """Bodies at `poses` [n, 7] about their centers of mass, in their frames [n, 3]."""
        q, v = poses[:, 3:] / poses[:, 3:].norm(dim=1, keepdim=True), velocities
        zero = torch.zeros(len(q), 1, dtype=F64)
        moved = q + time / 2 * hamilton(torch.cat([zero, v[:, 3:]], 1), q)
        arms = [rotate(r / r.norm(dim=1, keepdim=True), centers) for r in (q, moved)]
        at = poses[:, :3] + arms[0] + time * v[:, :3] - arms[1]
        return torch.cat([at, moved], 1)

    def hamilton(a, b):
        scalar = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(1, keepdim=True)
        vector = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:]
        return torch.cat([scalar, vector + torch.linalg.cross(a[:, 1:], b[:, 1:])], 1)

    def rotate(q, x):
        turn = 2 * torch.linalg.cross(q[:, 1:], x)
        return x + q[:, :1] * turn + torch.linalg.cross(q[:, 1:], turn)

    given = sim.default_parameters()
    root = sim.scene.robots[0].mechanism.root
    return state.replace(
        positions=state.positions + time * state.velocities,
        body_poses=turned(state.body_poses, given.body_center, state.body_velocities),
        base_poses=turned(
            state.base_poses, given.link_center[root : root + 1], state.base_velocities
        ),
        joint_positions=state.joint_positions + time * state.joint_velocities,
    )


def test_angular_momentum_is_about_the_origin(sim):
    """A shift of all positions adds shift x P."""
    state = moved(sim)
    shift = tensor([1.0, -2.0, 0.5])
    place = torch.nn.functional.pad(shift, (0, 4))
    elsewhere = state.replace(
        positions=state.positions + shift,
        body_poses=state.body_poses + place,
        base_poses=state.base_poses + place,
    )
    before, after = sim.momentum(state), sim.momentum(elsewhere)
    torch.testing.assert_close(after[:3], before[:3], rtol=1e-12, atol=1e-13)
    added = torch.linalg.cross(shift, before[:3])
    torch.testing.assert_close(after[3:] - before[3:], added, rtol=1e-11, atol=1e-12)


def test_a_free_scene_keeps_its_momentum():
    """Two cloths that stick to each other's barrier, in free flight, over a rollout."""
    sheets = [
        dc.Cloth.grid(
            4, 4, size=0.3, material=dc.Material(density=rho), pose=[0, 0, z, 1, 0.02, z, 0.1]
        )
        for rho, z in ((0.1, 0.0), (0.5, 0.02))
    ]
    sim = dc.Simulator(
        dc.Scene(sheets, gravity=WEIGHTLESS),
        DT,
        contact=dc.ContactOptions(barrier_distance=0.01),
        solver=dc.SolverOptions(tolerance=1e-10),
    )
    start = sim.initial_state()
    rush = torch.zeros_like(start.velocities)
    rush[:16, 2] = 1.0
    with torch.no_grad():
        states = sim.rollout(start.replace(velocities=rush), steps=8)
    assert max(state.report.contact_count for state in states) > 0
    before = sim.momentum(start.replace(velocities=rush))
    for state in states:
        # The solver stops at 1e-10 m/s, of 0.05 kg and less.
        assert (sim.momentum(state)[:3] - before[:3]).abs().max() < 1e-10
    assert sim.kinetic_energy(states[-1]) < sim.kinetic_energy(start.replace(velocities=rush))


@pytest.mark.parametrize(
    "name",
    [
        *("positions", "velocities", "body_poses", "body_velocities", "joint_positions"),
        *("joint_velocities", "base_poses", "base_velocities"),
        *("density", "rest_positions", "body_mass", "body_center", "body_inertia"),
        *("link_mass", "link_center", "link_inertia", "joint_armature"),
    ],
)
def test_gradients_are_those_of_differences(sim, name):
    """The loss is a weighted sum of momentum and kinetic energy."""
    state, given = moved(sim), sim.default_parameters().replace(joint_armature=tensor([0.1, 0.2]))
    weights = scenes.tensor_noise((6,), 1.0, 7)
    of_state = hasattr(state, name)
    at = getattr(state if of_state else given, name)

    def value(x):
        where = state.replace(**{name: x}) if of_state else state
        physical = given if of_state else given.replace(**{name: x})
        return weights @ sim.momentum(where, physical) + sim.kinetic_energy(where, physical)

    x = at.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(x), x)
    assert gradient.count_nonzero() > 0
    generator = torch.Generator().manual_seed(3)
    for _ in range(3):
        # Relative perturbation, zero for zero masses, which must not become negative.
        d = torch.randn(x.shape, dtype=F64, generator=generator) * at.abs().max() * (at != 0)
        with torch.no_grad():
            ends = [value(at + sign * 1e-5 * d).item() for sign in (1, -1)]
        # Relative errors: 1e-10 by truncation (second order), 1e-16 / 1e-5 by rounding.
        expected = (gradient * d).sum().item()
        assert (ends[0] - ends[1]) / 2e-5 == pytest.approx(expected, rel=1e-7, abs=1e-10), name
