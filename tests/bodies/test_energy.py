"""The monolithic coupling creates no energy for any masses; free bodies keep their energy."""

import warnings

import numpy as np
import pytest
import scenes
import torch
from coupled_scenes import DT, F64, cloth_masses, matrices

import diffcloth_torch as dc

SLOW = pytest.mark.slow


def rolled(sim, state, steps, control=None):
    with torch.no_grad():
        return sim.rollout(state, [control] * steps)


def energy(sim, state):
    """Kinetic and gravitational energy, and the energy stored by cloths and contact [J]."""
    given = sim.default_parameters()
    parts = [part for name, part in sim.energy(state, parts=True).items() if name != "gravity"]
    masses = cloth_masses(sim)[:, None]
    parts.append((masses * (0.5 * state.velocities**2 - given.gravity * state.positions)).sum())
    bodies = zip(matrices(state.body_poses), state.body_velocities, strict=True)
    for k, (frame, velocity) in enumerate(bodies):
        if sim.scene.bodies[k].motion == "dynamic":
            mass, center, inertia = (
                getattr(given, f"body_{name}")[k] for name in ("mass", "center", "inertia")
            )
            parts.append(rigid_energy(frame, velocity, mass, center, inertia, given.gravity))
    poses, velocities = sim.link_poses(state), sim.link_velocities(state)
    for i, name in enumerate(poses):
        mass, center, inertia = (
            getattr(given, f"link_{name}")[i] for name in ("mass", "center", "inertia")
        )
        parts.append(
            rigid_energy(poses[name], velocities[name], mass, center, inertia, given.gravity)
        )
    total = float(sum(parts))
    # Rounding of sums of some thousand terms.
    said = float(sim.energy(state) + sim.kinetic_energy(state))
    assert said == pytest.approx(total, rel=1e-11, abs=1e-13)
    return total


def rigid_energy(frame, velocity, mass, center, inertia, gravity):
    rotation, place = frame[:3, :3], frame[:3, :3] @ center + frame[:3, 3]
    spin = rotation.T @ velocity[3:]
    motion = mass * velocity[:3] @ velocity[:3] + spin @ inertia @ spin
    return 0.5 * motion - mass * gravity @ place


# --- Contact -------------------------------------------------------------------------------------


@pytest.mark.quick(
    "0.001-free-0.0",
    "0.001-pinned-0.4",
    "0.01-pinned-0.0",
    "0.1-free-0.4",
    "1.0-free-0.0",
    "1.0-pinned-0.4",
    "10.0-pinned-0.0",
    "100.0-free-0.4",
    "1000.0-free-0.0",
    "1000.0-pinned-0.4",
)
@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize("pinned", [False, True], ids=["free", "pinned"])
@pytest.mark.parametrize("ratio", [1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3])
def test_a_box_that_hits_a_cloth_creates_no_energy(ratio, pinned, friction):
    """This holds for every ratio of the masses, in every step."""
    vertices, faces = scenes.grid(6, 6, edge=0.05, seed=3)
    vertices -= vertices.mean(axis=0)
    rim = np.flatnonzero(np.abs(vertices[:, :2]).max(axis=1) > 0.11)
    cloth = dc.Cloth(
        vertices,
        faces,
        material=dc.Material(stretch=500.0, density=0.3, friction=friction),
        pins={"rim": rim} if pinned else None,
    )
    box = dc.RigidBody.box(
        [0.07, 0.09, 0.05],
        motion="dynamic",
        mass=ratio * 0.3 * 0.25**2,
        pose=[0.01, 0.02, 0.06, 1, 0.2, 0.3, 0.1],
        friction=friction,
    )
    sim = dc.Simulator(dc.Scene([cloth], [box], gravity=(0, 0, 0)), DT)
    velocity = torch.tensor([[0.2, 0.1, -1, 1.0, -2.0, 2.0]], dtype=F64)
    start = sim.initial_state().replace(body_velocities=velocity)
    states = [start, *rolled(sim, start, 40)]
    energies = np.array([energy(sim, state) for state in states])
    assert np.diff(energies).max() < 1e-6 * energies[0]
    assert any(state.report.contact_count for state in states[1:])


@pytest.mark.parametrize("ratio", [1e-3, 1.0, 1e3])
def test_boxes_that_fall_on_each_other_create_no_energy(ratio):
    floor = dc.RigidBody.plane(2.0)
    boxes = [
        dc.RigidBody.box(
            0.1, motion="dynamic", mass=mass, pose=[0.01 * k, 0, 0.075 + 0.14 * k, 1, 0.1, 0.05, 0]
        )
        for k, mass in enumerate((0.2, 0.2 * ratio))
    ]
    sim = dc.Simulator(
        dc.Scene([], [floor, *boxes]), DT, contact=dc.ContactOptions(barrier_distance=2e-3)
    )
    state = sim.initial_state()
    energies = [energy(sim, s) for s in (state, *rolled(sim, state, 60))]
    assert np.diff(energies).max() < 1e-6 * energies[0]


def test_a_light_cube_is_pushed_not_shot():
    """A cloth at speed V hits a cube of 4 g; the added mass is about 30 times the cube's mass.

    An elastic shock with a much heavier object would leave the cube with 2 V.
    """
    speed = 1.0
    vertices, faces = scenes.grid(5, 5, edge=0.05, seed=3)
    vertices -= vertices.mean(axis=0)
    cloth = dc.Cloth(vertices, faces, material=dc.Material(stretch=300.0, density=2.0))
    cube = dc.RigidBody.box(
        0.05, motion="dynamic", mass=0.004, pose=[0.005, 0.003, 0.033, 1, 0.02, 0.01, 0]
    )
    scene = dc.Scene([cloth], [cube], gravity=(0, 0, 0))

    def fastest(coupling):
        sim = dc.Simulator(scene, DT, coupling=coupling)
        state = sim.initial_state()
        moving = state.velocities + torch.tensor([0, 0, speed], dtype=F64)
        states = rolled(sim, state.replace(velocities=moving), 30)
        return max(float(s.body_velocities[0, :3].norm()) for s in states)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert 0.5 * speed < fastest("monolithic") < 2 * speed
    for coupling in ("rigid_to_cloth", "cloth_to_rigid"):
        with pytest.warns(dc.AddedMassWarning, match="monolithic"):
            assert fastest(coupling) > 4 * speed  # the reason for the monolithic coupling


def gripped(coupling, steps):
    """Gaps of two fingers that press 2 N each on a sheet, from 4.5 mm on [m]; and the states."""
    vertices, faces = scenes.grid(7, 7, edge=0.012, seed=3, jitter=0.1)
    vertices = scenes.turned(vertices - vertices.mean(axis=0), (1, 0, 0), np.pi / 2)
    rim = np.flatnonzero(np.abs(vertices).max(axis=1) > 0.0345)
    sheet = dc.Cloth(
        vertices + np.array([0, 0, 0.07]),
        faces,
        material=dc.Material(stretch=300.0, density=0.2, friction=0.4),
        pins={"rim": rim},
    )
    closed = 0.04  # position at which a finger would touch the sheet
    hand = dc.Robot.load(
        dc.robots.GRIPPER, actuation="torque", joint_positions=closed - 4.5e-3, name="hand"
    )
    sim = dc.Simulator(
        dc.Scene([sheet], [], [hand]),
        DT,
        coupling=coupling,
        contact=dc.ContactOptions(barrier_distance=5e-3, barrier_stiffness=1e3, self_contact=False),
    )
    press = sim.control(joint_efforts=[2.0, 2.0])
    states = rolled(sim, sim.initial_state(), steps, press)
    return closed - torch.stack([s.joint_positions for s in states]), states


def test_a_gripper_settles_at_once():
    gaps, states = gripped("monolithic", 20)
    assert gaps[2:].min() > 3.4e-3
    assert gaps[2:].max() < 3.9e-3
    assert states[-1].joint_velocities.abs().max() < 1e-3


@pytest.mark.filterwarnings("ignore::diffcloth_torch.AddedMassWarning")
def test_a_staggered_gripper_is_thrown_open():
    """Why the monolithic coupling is the default."""
    gaps, _ = gripped("cloth_to_rigid", 3)
    assert gaps.max() > 0.01


@pytest.mark.parametrize("driven", [False, True])
def test_the_reaction_of_a_stop_takes_all_of_the_momentum(driven):
    """dr/dv_n = -m/h, less the driving force: the stop is inelastic within a step."""
    mass = 0.3
    box = dc.RigidBody.box(
        0.1, motion="dynamic", mass=mass, pose=[0, 0, 0.0515, 1, 0, 0, 0], name="box"
    )
    sim = dc.Simulator(
        dc.Scene([], [dc.RigidBody.plane(2.0), box], gravity=(0, 0, 0)),
        DT,
        contact=dc.ContactOptions(barrier_distance=1e-3, barrier_stiffness=1e6),
        solver=dc.SolverOptions(tolerance=1e-10),
    )
    velocities = torch.zeros(2, 6, dtype=F64)
    velocities[1, 2] = -1.0
    wrenches = torch.zeros(2, 6, dtype=F64)
    wrenches[1, 2] = -20.0 * driven
    velocities.requires_grad_()
    wrenches.requires_grad_()
    after = sim.step(
        sim.initial_state().replace(body_velocities=velocities),
        dc.Control(body_wrenches=wrenches),
    )
    reaction = sim.contact_wrenches(after)["box"][2]
    by_velocity, by_drive = torch.autograd.grad(reaction, (velocities, wrenches))
    assert by_velocity[1, 2] == pytest.approx(-mass / DT, rel=2e-3)
    assert by_drive[1, 2] == pytest.approx(-1.0, rel=2e-3)


# --- Free motion ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rate", "seconds"),
    [(3.0, 2.0), pytest.param(3.0, 10.0, marks=SLOW), pytest.param(10.0, 10.0, marks=SLOW)],
)
def test_a_tumbling_box_keeps_spin_and_energy(rate, seconds):
    """Angular momentum to rounding, energy to a thousandth."""
    box = dc.RigidBody.box(
        [0.1, 0.2, 0.3], motion="dynamic", mass=0.5, pose=[0.1, 0, 0, 1, 0.2, 0.3, 0.1]
    )
    sim = dc.Simulator(
        dc.Scene([], [box], gravity=(0, 0, 0)), DT, contact=dc.ContactOptions(barrier_distance=1e-3)
    )
    # Close to the middle axis, about which a rotation is unstable.
    spin = rate * torch.tensor([0.02, 1.0, 0.01], dtype=F64)
    turn = matrices(sim.initial_state().body_poses)[0, :3, :3]
    velocity = torch.cat([torch.tensor([0.5, -0.2, 0.1], dtype=F64), turn @ spin])[None]
    state = sim.initial_state().replace(body_velocities=velocity)
    inertia = sim.default_parameters().body_inertia[0]

    def angular_momentum(state):
        turn = matrices(state.body_poses)[0, :3, :3]
        return turn @ inertia @ turn.T @ state.body_velocities[0, 3:]

    start = angular_momentum(state)
    states = rolled(sim, state, round(seconds / DT))
    loss = torch.stack([angular_momentum(s) - start for s in states])
    assert loss.abs().max() < 1e-12 * max(1.0, float(start.norm()))
    energies = np.array([energy(sim, s) for s in (state, *states)])
    assert np.abs(energies / energies[0] - 1).max() < 1e-3
    axes = torch.stack([matrices(s.body_poses)[0, :3, 1] for s in states])
    if seconds == 10.0:
        assert (axes @ turn[:, 1]).min() < 0  # the box has flipped over


PENDULUM = """<robot name="pendulum"><link name="base"/>
  <link name="upper"><inertial><origin xyz="0.01 0 -0.25"/><mass value="1"/>
    <inertia ixx="0.02" iyy="0.021" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0 0.01 -0.25"/><mass value="0.7"/>
    <inertia ixx="0.02" iyy="0.021" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 -0.5"/><axis xyz="0 0.8 0.6"/></joint>
</robot>"""


@pytest.mark.quick("10.0-1.0-0.0")
@pytest.mark.parametrize("gravity", [0.0, -9.81])
@pytest.mark.parametrize(
    ("rate", "seconds"),
    [(10.0, 1.0), *(pytest.param(rate, 10.0, marks=SLOW) for rate in (3.0, 10.0, 30.0))],
)
def test_a_passive_chain_creates_no_energy(rate, seconds, gravity, tmp_path):
    """Within a hundredth of the chain's energy above the energy of hanging at rest."""
    (tmp_path / "pendulum.urdf").write_text(PENDULUM)
    robot = dc.Robot.load(
        tmp_path / "pendulum.urdf", actuation="torque", joint_positions=[0.5, 0.7]
    )
    sim = dc.Simulator(
        dc.Scene([], [], [robot], gravity=(0, 0, gravity)),
        DT,
        contact=dc.ContactOptions(barrier_distance=1e-3),
    )
    lowest = energy(sim, sim.initial_state().replace(joint_positions=torch.zeros(2, dtype=F64)))
    state = sim.initial_state()
    state = state.replace(joint_velocities=torch.tensor([rate, -0.6 * rate], dtype=F64))
    states = [state, *rolled(sim, state, round(seconds / DT))]
    energies = np.array([energy(sim, s) for s in states]) - lowest
    assert energies.max() < 1.01 * energies[0]
    if gravity == 0.0:
        assert energies.min() > 0.99 * energies[0]
    else:
        # Gravity acts before positions move, which shifts the energy to and fro.
        ends = energies[:100].mean(), energies[-100:].mean()
        assert ends[1] == pytest.approx(ends[0], rel=0.01)
