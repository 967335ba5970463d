"""Forces between cloths, bodies and robots are equal and opposite."""

import coupled_scenes
import numpy as np
import pytest
import scenes
import torch
from coupled_scenes import BASES, COUPLINGS, DT, F64, cloth_masses, matrices
from torch.linalg import cross

import diffcloth_torch as dc

pytestmark = pytest.mark.filterwarnings("ignore::diffcloth_torch.AddedMassWarning")

EXACT = 1e-9  # [N], [N m], [kg m/s], beside forces of up to 1 N


def placed(sim, state):
    """Vertices of all bodies and links, in the order of `body_forces`."""
    parts = [
        torch.tensor(body.vertices) @ frame[:3, :3].T + frame[:3, 3]
        for body, frame in zip(sim.scene.bodies, matrices(state.body_poses), strict=True)
    ]
    poses = sim.link_poses(state)
    for robot, name in zip(sim.scene.robots, sim.joint_slices, strict=True):
        for link, surface in zip(robot.link_names, robot.surfaces, strict=True):
            if surface is not None:
                frame = poses[f"{name}/{link}"]
                parts.append(torch.tensor(surface.vertices) @ frame[:3, :3].T + frame[:3, 3])
    return torch.cat(parts)


def resultant(points, forces):
    """Sum of the forces and sum of their torques about the origin."""
    return torch.cat([forces.sum(0), cross(points, forces).sum(0)])


def on_cloth(sim, before, after, outer):
    """Resultant of contact on the cloth: inertial less external forces; elastic ones cancel.

    `outer` are external forces on the vertices.
    """
    inertia = cloth_masses(sim)[:, None] * (after.velocities - before.velocities) / DT
    return resultant(after.positions, inertia - outer)


@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("coupling", COUPLINGS)
def test_forces_of_cloth_box_and_gripper_cancel(coupling, base, friction):
    sim, state = coupled_scenes.in_contact(coupling, base)
    given = coupled_scenes.parameters(sim).replace(friction=torch.tensor(friction, dtype=F64))
    control = coupled_scenes.control(sim)
    (cloth,) = sim.scene.cloths
    pins = list(cloth.soft_pins["rim"])
    with torch.no_grad():
        for _ in range(5):
            after = sim.step(state, control, given)
            outer = control.forces + cloth_masses(sim)[:, None] * given.gravity
            outer[pins] += given.pin_stiffness * (control.soft_pins - after.positions[pins])
            cloth_side = on_cloth(sim, state, after, outer)
            other_side = resultant(placed(sim, after), after.body_forces)
            assert cloth_side[:3].norm() > 0.01
            assert (cloth_side + other_side)[:3].abs().max() < EXACT
            # In `cloth_to_rigid` the cloth's forces act at the start poses of the bodies.
            if friction == 0.0 and coupling != "cloth_to_rigid":
                assert (cloth_side + other_side)[3:].abs().max() < EXACT
            state = after


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_a_floating_gripper_takes_up_the_impulse_of_contact(coupling):
    """The momentum balance holds to rounding, for any motion of the joints."""
    sim, state = coupled_scenes.in_contact(coupling, "floating")
    given, control = coupled_scenes.parameters(sim), coupled_scenes.control(sim)
    weight = given.link_mass.sum() * given.gravity

    def momentum(state):
        velocities = sim.link_velocities(state, given).values()
        return sum(m * v[:3] for m, v in zip(given.link_mass, velocities, strict=True))

    with torch.no_grad():
        for _ in range(5):
            after = sim.step(state, control, given)
            wrenches = sim.contact_wrenches(after, given)
            pushed = sum(wrench[:3] for name, wrench in wrenches.items() if "hand" in name)
            gained = (momentum(after) - momentum(state)) / DT
            missing = gained - pushed - weight - control.base_wrenches[0, :3]
            assert pushed.norm() > 0.01
            assert missing.norm() < EXACT
            state = after


def spins(sim, state):
    """Angular momentum of each body about its center, [K, 3]."""
    turn, inertia = matrices(state.body_poses)[:, :3, :3], sim.default_parameters().body_inertia
    rates = state.body_velocities[:, 3:, None]
    return (turn @ inertia @ turn.mT @ rates)[..., 0]


def turned_by_contact(sim, after, where):
    """Change of spin in a step, from the contact forces at the poses of `where`."""
    wrenches = sim.contact_wrenches(where.replace(body_forces=after.body_forces))
    return DT * torch.stack([wrenches[name][3:] for name in sim.surfaces if name in wrenches])


def thrown(coupling, friction, mass):
    """A tumbling box that hits a free cloth, without gravity."""
    vertices, faces = scenes.grid(5, 5, edge=0.06, seed=3)
    vertices -= vertices.mean(axis=0)
    density = np.where(np.arange(len(faces)) % 2, 0.2, 0.6)
    material = dc.Material(stretch=100.0, density=density, friction=friction, damping=0.002)
    cloth = dc.Cloth(vertices, faces, material=material)
    box = dc.RigidBody.box(
        [0.07, 0.09, 0.05],
        motion="dynamic",
        mass=mass,
        pose=[0.01, 0.02, 0.06, 1, 0.2, 0.3, 0.1],
        friction=friction,
    )
    sim = dc.Simulator(
        dc.Scene([cloth], [box], gravity=(0, 0, 0)),
        DT,
        coupling=coupling,
        contact=dc.ContactOptions(barrier_distance=0.008),
        solver=dc.SolverOptions(tolerance=1e-12),
    )
    start = torch.tensor([[0.2, 0.1, -0.3, 3.0, -5.0, 2.0]], dtype=F64)
    return sim, sim.initial_state().replace(body_velocities=start)


@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize("coupling", COUPLINGS)
def test_a_free_cloth_and_a_free_box_keep_their_momentum(coupling, friction):
    mass = 0.01 if coupling == "monolithic" else 0.3
    sim, state = thrown(coupling, friction, mass)

    def momentum(state):
        of_cloth = (cloth_masses(sim)[:, None] * state.velocities).sum(0)
        return of_cloth + mass * state.body_velocities[0, :3]

    start, passed = momentum(state), 0.0
    with torch.no_grad():
        for _ in range(20):
            after = sim.step(state)
            assert (momentum(after) - momentum(state)).abs().max() < EXACT
            pushed = on_cloth(sim, state, after, torch.zeros_like(after.positions))
            where = after if coupling != "cloth_to_rigid" else state
            net = pushed + resultant(placed(sim, where), after.body_forces)
            assert net[:3].abs().max() < EXACT
            if friction == 0.0:
                assert net[3:].abs().max() < EXACT
            gained = spins(sim, after) - spins(sim, state)
            assert (gained - turned_by_contact(sim, after, where)).abs().max() < EXACT * DT
            passed += DT * float(pushed[:3].norm())
            state = after
    assert (momentum(state) - start).abs().max() < EXACT
    assert passed > 1e-3


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_boxes_that_collide_keep_their_momentum(friction):
    boxes = [
        dc.RigidBody.box(
            [0.1, 0.15, 0.2], motion="dynamic", mass=mass, pose=pose, friction=friction
        )
        for mass, pose in (
            (0.3, [0, 0, 0, 1, 0.1, 0.2, 0.3]),
            (2.0, [0.03, 0.02, 0.24, 1, -0.2, 0.1, 0]),
        )
    ]
    sim = dc.Simulator(
        dc.Scene([], boxes, gravity=(0, 0, 0)),
        DT,
        # A smaller slip velocity would increase the error in friction that the tolerance allows.
        contact=dc.ContactOptions(barrier_distance=0.004, slip_velocity=1e-4),
        solver=dc.SolverOptions(tolerance=1e-12),
    )
    state = sim.initial_state().replace(
        body_velocities=torch.tensor(
            [[0.2, 0, 1.0, 1, 2, 3], [0, 0.1, -0.5, -2, 1, 1.0]], dtype=F64
        )
    )
    mass = torch.tensor([[0.3], [2.0]], dtype=F64)
    first = (mass * state.body_velocities[:, :3]).sum(0)
    touched = 0
    for _ in range(20):
        before, state = state, sim.step(state)
        gained = spins(sim, state) - spins(sim, before)
        assert (gained - turned_by_contact(sim, state, state)).abs().max() < EXACT * DT
        net = resultant(placed(sim, state), state.body_forces)
        assert net[:3].abs().max() < EXACT
        if friction == 0.0:
            assert net[3:].abs().max() < EXACT
        assert ((mass * state.body_velocities[:, :3]).sum(0) - first).abs().max() < EXACT
        touched += bool(state.body_forces.any())
    assert touched


SWIMMER = """<robot name="swimmer">
<link name="trunk"><inertial><mass value="1"/>
<inertia ixx="1e-3" iyy="2e-3" izz="1.5e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="arm"><inertial><origin xyz=".2 .01 .03"/><mass value=".8"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="fin"><inertial><origin xyz=".1 0 0"/><mass value=".3"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz=".1 0 0"/><geometry><box size=".1 .06 .04"/></geometry></collision></link>
<joint name="shoulder" type="revolute"><parent link="trunk"/><child link="arm"/>
<axis xyz="0 .2 1"/><limit lower="-3" upper="1.2" effort="4" velocity="6"/></joint>
<joint name="wrist" type="revolute"><parent link="arm"/><child link="fin"/>
<origin xyz=".3 0 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="0"/></joint>
</robot>"""


def swimmer(tmp_path, dt, bodies=(), **options):
    path = tmp_path / "swimmer.urdf"
    path.write_text(SWIMMER)
    robot = dc.Robot.load(path, base="floating", stiffness=50.0, damping=1.0, name="r", **options)
    return dc.Simulator(
        dc.Scene([], bodies, [robot], gravity=(0, 0, 0)),
        dt,
        contact=dc.ContactOptions(barrier_distance=2e-3, friction_iterations=8),
        solver=dc.SolverOptions(tolerance=1e-10),
    )


def center_of_mass(sim, state):
    given = sim.default_parameters()
    frames = torch.stack(list(sim.link_poses(state).values()))
    places = (frames[:, :3, :3] @ given.link_center[..., None])[..., 0] + frames[:, :3, 3]
    return (given.link_mass[:, None] * places).sum(0) / given.link_mass.sum()


def stroke(time):
    """Asymmetric strokes that reach the limits of efforts, speeds and joints."""
    turn = torch.tensor([[1.2, 0.6], [-1.0, 0.6], [1.2, -0.4], [0.0, 0.0]][int(time / 0.5)])
    turn = turn.to(F64)
    return dc.Control(joint_positions=turn, joint_velocities=0.2 * turn, joint_efforts=turn)


@pytest.mark.parametrize("actuation", ["pd", ("pd", "position"), ("torque", "velocity")])
@pytest.mark.quick("pd")
def test_a_robot_in_empty_space_keeps_its_momentum(tmp_path, actuation):
    """All six components; the center of mass drifts by the error of the solve's metric."""
    astray = []
    for dt in (0.02, 0.01):
        sim = swimmer(tmp_path, dt, actuation=actuation)
        state = sim.initial_state()
        start, center = sim.momentum(state), center_of_mass(sim, state)
        for k in range(round(2.0 / dt)):
            state = sim.step(state, stroke(k * dt))
            assert (sim.momentum(state) - start).abs().max() < EXACT
        astray.append((center_of_mass(sim, state) - center).norm().item())
    assert astray[0] < 0.025
    assert astray[1] < 0.25 * astray[0]


@pytest.mark.quick("0.5")
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_a_robot_that_strikes_a_box_keeps_their_momentum(tmp_path, friction):
    box = dc.RigidBody.box(
        (0.1, 0.2, 0.1),
        motion="dynamic",
        density=100.0,
        friction=friction,
        pose=[0.4, 0.15, 0.01, 1, 0.1, 0.05, -0.1],
    )
    sim = swimmer(tmp_path, 0.01, [box], friction=friction)
    state = sim.initial_state()
    thrown = torch.tensor([[0.1, -0.5, 0.05, 1.0, 2.0, -3.0]], dtype=F64)
    state = state.replace(body_velocities=thrown)
    mass, touched = sim.default_parameters().body_mass[0], False

    def of_robot(state):
        velocities = sim.link_velocities(state).values()
        masses = sim.default_parameters().link_mass
        return sum(m * v[:3] for m, v in zip(masses, velocities, strict=True))

    for k in range(60):
        after = sim.step(state, stroke(k * 0.01))
        # Forces act at the final poses of the bodies and of the root.
        was, now = state.body_velocities[0, :3], after.body_velocities[0, :3]
        change = sim.momentum(after) - sim.momentum(state)
        change[3:] -= 0.01 * mass * cross(now, was)
        way = after.base_poses[0, :3] - state.base_poses[0, :3]
        change[3:] -= cross(of_robot(after) - of_robot(state), way)
        assert change.abs().max() < 1e-7
        touched = touched or after.report.contact_count > 0
        state = after
    assert touched
    assert (state.body_velocities - thrown).norm() > 0.05
