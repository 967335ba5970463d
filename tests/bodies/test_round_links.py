"""Links with smooth spheres behave as smooth bodies of the same poses."""

import math
import pickle

import core_steps
import numpy as np
import pytest
import torch
from differences import F64, directions, mismatch
from scipy.spatial.transform import Rotation

import diffcloth_torch as dc
from diffcloth_torch.tasks.registry import load_task

G = 9.81
D_HAT = 2e-3
RADIUS = 0.03
BALL = f'<geometry><sphere radius="{RADIUS}"/></geometry>'
TIP = f'<collision><origin xyz="0.3 0 0.01"/>{BALL}</collision>'
ROD = """<collision><origin xyz="0.06 0 0"/><geometry><box size="0.1 0.02 0.02"/></geometry>
  </collision>"""
KNOB = f'<collision><origin xyz="0 0.2 0.3"/>{BALL}</collision>'
MASS = """<inertial><origin xyz="0.15 0 0"/><mass value="0.4"/>
  <inertia ixx="1e-4" iyy="2e-3" izz="2e-3" ixy="0" ixz="0" iyz="0"/></inertial>"""
HINGE = """<joint name="hinge" type="revolute"><parent link="base"/><child link="finger"/>
  <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="0" velocity="0"/></joint>"""


def finger(folder, shapes=ROD + TIP, base="", **keywords):
    """A base, and a finger in the direction of x that turns about y: down, for positive angles."""
    path = folder / "finger.urdf"
    path.write_text(
        f'<robot name="test"><link name="base">{MASS}{base}</link>'
        f'<link name="finger">{MASS}{shapes}</link>{HINGE}</robot>'
    )
    return dc.Robot.load(path, **{"name": "arm", "smooth": True, "stiffness": 20.0, **keywords})


def alone(folder, **keywords):
    """A ball as the only link of a floating base, off the origin of the link's frame."""
    mass = 500 * 4 / 3 * math.pi * RADIUS**3
    moment = 2 / 5 * mass * RADIUS**2
    path = folder / "ball.urdf"
    path.write_text(
        f'<robot name="test"><link name="ball"><inertial><origin xyz="0.1 0 0"/>'
        f'<mass value="{mass!r}"/><inertia ixx="{moment!r}" iyy="{moment!r}" izz="{moment!r}" '
        f'ixy="0" ixz="0" iyz="0"/></inertial><collision><origin xyz="0.1 0 0"/>{BALL}</collision>'
        "</link></robot>"
    )
    return dc.Robot.load(path, base="floating", smooth=True, name="robot", **keywords)


# --- Files and options ----------------------------------------------------------------------------


def test_a_sphere_alone_is_the_link_and_one_beside_others_a_link_of_its_own(tmp_path):
    robot = finger(tmp_path, ROD + TIP + KNOB, base=TIP)
    assert robot.link_names == ("base", "finger", "finger/1", "finger/2")
    assert set(robot.skeletons) == {"base", "finger/1", "finger/2"}
    assert [len(mesh.faces) for mesh in robot.surfaces] == [1280, 12, 1280, 1280]
    assert [surface.radius for surface in robot.contact_surfaces] == [RADIUS, 0, RADIUS, RADIUS]
    centers = [surface.vertices[0] for surface in robot.contact_surfaces]
    np.testing.assert_allclose(centers[2], [0.3, 0, 0.01])
    np.testing.assert_allclose(centers[3], [0, 0.2, 0.3])
    plain = finger(tmp_path, ROD + TIP + KNOB, base=TIP, smooth=False)
    assert plain.link_names == ("base", "finger")
    assert plain.skeletons == {}
    q = torch.tensor([0.7], dtype=F64)
    ours, theirs = robot.forward_kinematics(q), plain.forward_kinematics(q)
    for name in ("finger", "finger/1", "finger/2"):
        torch.testing.assert_close(ours[name], theirs["finger"], rtol=0, atol=1e-16)
    np.testing.assert_array_equal(robot.mechanism.mass, [0.4, 0.4, 0, 0])


def test_the_first_of_several_spheres_is_the_link(tmp_path):
    robot = finger(tmp_path, TIP + KNOB)
    assert robot.link_names == ("base", "finger", "finger/1")
    np.testing.assert_allclose(robot.skeletons["finger"].vertices[0], [0.3, 0, 0.01])
    np.testing.assert_allclose(robot.skeletons["finger/1"].vertices[0], [0, 0.2, 0.3])


def test_names_choose_links(tmp_path):
    robot = finger(tmp_path, base=TIP, smooth={"finger": True, "base": False})
    assert set(robot.skeletons) == {"finger/1"}
    assert finger(tmp_path, smooth={"finger": False}).link_names == ("base", "finger")


def test_options_of_a_link_apply_to_its_spheres(tmp_path):
    robot = finger(
        tmp_path,
        ROD + TIP + KNOB,
        base=ROD,
        friction={"finger": 0.9, "finger/2": 0.1},
        thickness={"finger": 2e-3},
        ignore_contact=[("base", "finger")],
    )
    np.testing.assert_array_equal(robot.friction, [0.4, 0.9, 0.9, 0.1])
    np.testing.assert_array_equal(robot.thickness, [0, 2e-3, 2e-3, 2e-3])
    assert robot.ignore_contact == tuple(("base", f"finger{k}") for k in ("", "/1", "/2"))
    sim = dc.Simulator(dc.Scene([], robots=[robot]), 0.01, contact=BARRIER)
    assert sim.surfaces == ("arm/base", "arm/finger", "arm/finger/1", "arm/finger/2")
    np.testing.assert_array_equal(sim.default_parameters().thickness, [0, 2e-3, 2e-3, 2e-3])


@pytest.mark.parametrize(
    ("shapes", "smooth", "error", "message"),
    [
        (ROD, True, dc.InvalidInput, "must be False where no link has a <sphere> or <cap"),
        (ROD + TIP, {"base": True}, dc.InvalidInput, "which are 'finger'; got True for 'base'"),
        (ROD + TIP, {"hand": True}, dc.InvalidInput, "has the names 'base', 'finger'; got 'hand'"),
        (ROD + TIP, {"finger": 1}, TypeError, r"`smooth`\['finger'\] must be True or False, got i"),
        (ROD + TIP, "finger", TypeError, "`smooth` must be True or False, got str"),
    ],
)
def test_links_that_cannot_be_smooth_are_refused(tmp_path, shapes, smooth, error, message):
    with pytest.raises(error, match=message):
        finger(tmp_path, shapes, smooth=smooth)


def test_a_robot_with_smooth_links_pickles(tmp_path):
    again = pickle.loads(pickle.dumps(finger(tmp_path)))
    np.testing.assert_array_equal(again.contact_surfaces[2].vertices[0], [0.3, 0, 0.01])
    assert again.contact_surfaces[2].radius == RADIUS


# --- Against smooth bodies ------------------------------------------------------------------------

BARRIER = dc.ContactOptions(barrier_distance=D_HAT, barrier_stiffness=2000.0)
TIGHT = dc.SolverOptions(tolerance=1e-10, max_iterations=1000)


def quaternion(rotation):
    return rotation.as_quat()[[3, 0, 1, 2]].tolist()


def test_a_ball_that_is_a_link_rolls_as_one_that_is_a_body(tmp_path):
    slope = Rotation.from_euler("y", 0.3)
    plane = dc.RigidBody.plane(4.0, pose=[0, 0, 0, *quaternion(slope)], friction=0.6)
    at = slope.apply([0, 0, RADIUS + D_HAT / 2])
    body = dc.RigidBody.sphere(
        RADIUS,
        smooth=True,
        motion="dynamic",
        density=500,
        friction=0.6,
        pose=[*at, *quaternion(slope)],
    )
    link = alone(
        tmp_path, friction=0.6, pose=[*(at - slope.apply([0.1, 0, 0])), *quaternion(slope)]
    )
    ends = []
    for scene in (dc.Scene([], [plane, body]), dc.Scene([], [plane], [link])):
        sim = dc.Simulator(scene, 0.005, contact=BARRIER, solver=TIGHT)
        with torch.no_grad():
            end = sim.rollout(sim.initial_state(), steps=40)[-1]
        wrench = sim.contact_wrenches(end)[sim.surfaces[1]]
        ends.append((end, wrench))
    (of_body, wrench_of_body), (of_link, wrench_of_link) = ends
    spin = of_body.body_velocities[1, 3:]
    assert float(spin.norm()) > 0.9 * 0.2 * 5 / 7 * G * math.sin(0.3) / RADIUS
    torch.testing.assert_close(of_link.base_velocities[0, 3:], spin, rtol=1e-6, atol=1e-6)
    turn = Rotation.from_quat(np.roll(of_link.base_poses[0, 3:].numpy(), -1))
    center = of_link.base_poses[0, :3].numpy() + turn.apply([0.1, 0, 0])
    np.testing.assert_allclose(center, of_body.body_poses[1, :3], atol=1e-8)
    torch.testing.assert_close(wrench_of_link[:3], wrench_of_body[:3], rtol=1e-4, atol=1e-6)


def test_a_capsule_that_is_a_link_rolls_as_one_that_is_a_body(tmp_path):
    """Obliquely down a slope; the capsule is displaced and rotated in the link's frame."""
    slope = Rotation.from_euler("y", 0.3)
    plane = dc.RigidBody.plane(4.0, pose=[0, 0, 0, *quaternion(slope)], friction=0.6)
    lies = slope * Rotation.from_euler("z", 0.4) * Rotation.from_euler("x", math.pi / 2)
    at = slope.apply([0, 0, RADIUS + D_HAT / 2])
    body = dc.RigidBody.capsule(
        RADIUS,
        0.1,
        smooth=True,
        motion="dynamic",
        density=500,
        friction=0.6,
        pose=[*at, *quaternion(lies)],
    )
    across, along = float(body.inertia[0, 0]), float(body.inertia[2, 2])
    path = tmp_path / "pill.urdf"
    # In the link's frame the capsule lies along x.
    path.write_text(
        f'<robot name="test"><link name="pill"><inertial><origin xyz="0.1 0 0"/>'
        f'<mass value="{body.mass!r}"/><inertia ixx="{along!r}" iyy="{across!r}" izz="{across!r}" '
        'ixy="0" ixz="0" iyz="0"/></inertial><collision><origin xyz="0.1 0 0" '
        f'rpy="0 {math.pi / 2!r} 0"/><geometry><capsule radius="{RADIUS}" length="0.1"/>'
        "</geometry></collision></link></robot>"
    )
    frame = lies * Rotation.from_euler("y", -math.pi / 2)
    pose = [*(at - frame.apply([0.1, 0, 0])), *quaternion(frame)]
    link = dc.Robot.load(path, base="floating", smooth=True, name="robot", friction=0.6, pose=pose)
    assert link.contact_surfaces[0].radius == RADIUS
    ends = []
    for scene in (dc.Scene([], [plane, body]), dc.Scene([], [plane], [link])):
        sim = dc.Simulator(scene, 0.005, contact=BARRIER, solver=TIGHT)
        with torch.no_grad():
            end = sim.rollout(sim.initial_state(), steps=40)[-1]
        ends.append((end, sim.contact_wrenches(end)[sim.surfaces[1]]))
    (of_body, wrench_of_body), (of_link, wrench_of_link) = ends
    velocity = of_body.body_velocities[1]
    assert float(velocity[3:].norm()) * RADIUS > 0.1
    turn = Rotation.from_quat(np.roll(of_link.base_poses[0, 3:].numpy(), -1))
    center = of_link.base_poses[0, :3].numpy() + turn.apply([0.1, 0, 0])
    np.testing.assert_allclose(center, of_body.body_poses[1, :3], atol=1e-8)
    torch.testing.assert_close(of_link.base_velocities[0], velocity, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(wrench_of_link[:3], wrench_of_body[:3], rtol=1e-4, atol=1e-6)


def sheet(n=9, size=0.3, **keywords):
    """Below the finger, held at two edges."""
    edges = [i for i in range(n * n) if i % n in (0, n - 1)]
    material = dc.Material(stretch=200.0, friction=0.5, thickness=1e-3)
    at = [0.3, 0.0, -RADIUS + 0.01 - 4e-3, 1, 0, 0, 0]
    return dc.Cloth.grid(n, n, size=size, pins={"edges": edges}, material=material, pose=at)


def tip_pose(robot, q):
    """Pose of the tip's sphere at joint position `q`."""
    frame = robot.forward_kinematics(torch.tensor([q], dtype=F64))["finger"]
    turn = Rotation.from_matrix(frame[:3, :3].numpy())
    at = frame[:3, 3].numpy() + turn.apply([0.3, 0, 0.01])
    return torch.tensor([[*at, *quaternion(turn)]], dtype=F64)


@pytest.mark.parametrize("scheme", ["coupled", "split"])
def test_a_fingertip_presses_cloth_as_a_kinematic_ball_does(tmp_path, scheme):
    robot = finger(tmp_path, actuation="position", friction=0.5)
    ball = dc.RigidBody.sphere(
        RADIUS, smooth=True, motion="kinematic", friction=0.5, pose=tip_pose(robot, 0.0)[0].tolist()
    )
    options = {"contact": BARRIER, "solver": TIGHT, "scheme": scheme}
    sim = dc.Simulator(dc.Scene([sheet()], robots=[robot]), 0.01, **options)
    twin = dc.Simulator(dc.Scene([sheet()], [ball]), 0.01, **options)
    ours, theirs = sim.initial_state(), twin.initial_state()
    # The rod beside the sphere could touch the cloth too; these angles keep the rod above.
    with torch.no_grad():
        for k in range(1, 13):
            angle = 0.015 * k
            control = dc.Control(joint_positions=torch.tensor([angle], dtype=F64))
            ours = sim.step(ours, control)
            theirs = twin.step(theirs, dc.Control(body_poses=tip_pose(robot, angle)))
    assert float(theirs.positions[:, 2].min()) < -0.05
    names = {tuple(pair) for pair in ours.report.contacts}
    assert names == {("cloth0", "arm/finger/1")}
    torch.testing.assert_close(ours.positions, theirs.positions, atol=1e-8, rtol=0)
    torch.testing.assert_close(
        sim.contact_wrenches(ours)["arm/finger/1"][:3],
        twin.contact_wrenches(theirs)["body0"][:3],
        rtol=1e-6,
        atol=1e-9,
    )
    contacts = sim.contacts(ours).on("arm/finger/1")
    skin = contacts.points[contacts.mask][:, 1] - tip_pose(robot, angle)[0, :3]
    torch.testing.assert_close(
        skin.norm(dim=1), torch.full((len(skin),), RADIUS, dtype=F64), atol=1e-12, rtol=0
    )


def test_efforts_hold_the_load_of_the_fingertip(tmp_path):
    """The moment of the contact force and of the weight about the hinge, by statics."""
    robot = finger(tmp_path, actuation="position", friction=0.5)
    sim = dc.Simulator(dc.Scene([sheet()], robots=[robot]), 0.01, contact=BARRIER, solver=TIGHT)
    state = sim.initial_state()
    with torch.no_grad():
        for k in range(60):
            angle = min(0.015 * (k + 1), 0.18)
            control = dc.Control(joint_positions=torch.tensor([angle], dtype=F64))
            state = sim.step(state, control)
            state = state.replace(velocities=0.8 * state.velocities)
    wrenches = sim.contact_wrenches(state)
    force, torque = wrenches["arm/finger/1"].split(3)
    assert float(force[2]) > 0.1
    # A wrench is about the origin of the link, which is on the hinge; down is positive.
    weight = 0.4 * G * 0.15 * math.cos(0.18)
    assert float(state.joint_efforts[0]) == pytest.approx(
        -float(torque[1]) - weight, abs=2e-3 * weight
    )


# --- Derivatives ----------------------------------------------------------------------------------

COUPLINGS = ("monolithic", "rigid_to_cloth", "cloth_to_rigid")


def pressed(folder, coupling, shapes=ROD + TIP):
    """A driven finger on a floating base whose tip lies on a sheet, with friction."""
    heavy = 20.0
    robot = finger(
        folder,
        shapes,
        base=KNOB,
        actuation="pd",
        damping=0.5,
        friction=0.5,
        thickness=1e-3,
    )
    contact = dc.ContactOptions(barrier_distance=5e-3, barrier_stiffness=300.0, slip_velocity=0.02)
    solver = dc.SolverOptions(tolerance=1e-12, max_iterations=2000)
    scene = dc.Scene([sheet(6)], robots=[robot], gravity=[0.3, 0.2, -9.81 / heavy])
    sim = dc.Simulator(scene, 0.005, coupling=coupling, contact=contact, solver=solver)
    given = sim.default_parameters()
    given = given.replace(
        link_mass=heavy * given.link_mass, link_inertia=heavy * given.link_inertia
    )
    state = sim.initial_state()
    control = dc.Control(joint_positions=torch.tensor([0.08], dtype=F64))
    with torch.no_grad():
        for _ in range(12):
            state = sim.step(state, control, given)
    assert ("cloth0", "arm/finger/1") in {tuple(pair) for pair in state.report.contacts}
    return sim, state.detach(), control, given


@pytest.fixture(scope="module", params=COUPLINGS)
def pressing(request, tmp_path_factory):
    return pressed(tmp_path_factory.mktemp("robots"), request.param)


INPUTS = {
    "positions": 1e-6,
    "velocities": 1e-4,
    "joint_positions": 1e-6,
    "joint_velocities": 1e-4,
    "friction": 1e-4,
    "thickness": 1e-6,
    "barrier_stiffness": 1e-2,
    "link_mass": 1e-4,
    "joint_stiffness": 1e-3,
}


@pytest.mark.filterwarnings("ignore::diffcloth_torch.AddedMassWarning")
@pytest.mark.parametrize("name", [*INPUTS, "targets"])
def test_gradients_are_central_differences(pressing, name):
    sim, state, control, parameters = pressing
    generator = torch.Generator().manual_seed(4)

    def step(value):
        given, steered, known = state, control, parameters
        if name == "targets":
            steered = dc.Control(joint_positions=value)
        elif hasattr(state, name):
            given = state.replace(**{name: value})
        else:
            known = parameters.replace(**{name: value})
        after = sim.step(given, steered, known)
        assert after.report.converged
        return after

    def noise(like):
        return torch.randn(like.shape, dtype=F64, generator=generator)

    source = {"targets": control.joint_positions}.get(name)
    if source is None:
        source = getattr(state if hasattr(state, name) else parameters, name)
    value = source.detach().clone().requires_grad_()
    end = step(value)
    scales = {
        "positions": 1.0,
        "joint_positions": 1.0,
        "joint_velocities": 0.01,
        "joint_efforts": 0.01,
        "body_forces": 1e-3,
    }
    shares = {field: scale * noise(getattr(end, field)) for field, scale in scales.items()}

    def loss(after):
        return sum((share * getattr(after, field)).sum() for field, share in shares.items())

    (gradient,) = torch.autograd.grad(loss(end), value)
    assert gradient.any()
    size = INPUTS.get(name, 1e-4)
    for d in directions(value.detach(), torch.Generator().manual_seed(5)):
        if name == "link_mass":
            d[2:] = 0  # spheres that are separate links have no mass
        with torch.no_grad():
            error = mismatch(
                lambda x: float(loss(step(x))), value.detach(), gradient, d, size, rtol=1e-5
            )
        assert error < 1e-5


def test_tangents_are_the_transpose_of_gradients(tmp_path):
    sim, state, control, given = pressed(tmp_path, "monolithic")
    core, inputs = core_steps.inputs_of(sim, lambda: sim.step(state, control, given))
    moved = core_steps.check_pairs(core, inputs, core.forward(inputs, True, 1))
    assert {"positions", "coordinates", "body_forces"} <= moved


def test_bits_are_those_of_a_batch(tmp_path):
    sim, state, control, given = pressed(tmp_path, "monolithic")
    faster = state.replace(joint_velocities=state.joint_velocities + 0.1)
    together = sim.step(dc.stack([state, faster]), control, given)
    for k, one in enumerate((state, faster)):
        single = sim.step(one, control, given)
        for name in ("positions", "joint_positions", "body_forces"):
            assert torch.equal(getattr(together, name)[k], getattr(single, name)), name


def test_a_loss_over_joint_angles_has_no_facets(tmp_path):
    """Third differences over a sweep, which triangles of the tip increase."""
    rough = []
    for smooth in (True, False):
        robot = finger(
            tmp_path, actuation="position", friction=0.0, smooth=smooth, edge_length=0.03
        )
        sim = dc.Simulator(dc.Scene([sheet()], robots=[robot]), 0.01, contact=BARRIER, solver=TIGHT)

        def end(last, sim=sim):
            state = sim.initial_state()
            with torch.no_grad():
                for k in range(1, 16):
                    angle = min(last * k / 12, last)
                    control = dc.Control(joint_positions=torch.tensor([angle], dtype=F64))
                    state = sim.step(state, control)
            return float(state.positions[:, 2].sum())

        values = np.array([end(q) for q in 0.18 + 0.002 * np.arange(9)])
        rough.append(np.abs(np.diff(values, 3)).max() / np.abs(np.diff(values)).max())
    assert rough[0] < 0.3 * rough[1], rough


# --- Other users of surfaces ----------------------------------------------------------------------


def test_a_smooth_link_is_drawn_and_exported_as_its_meshes(tmp_path):
    robot = finger(tmp_path, actuation="position")
    sim = dc.Simulator(dc.Scene([sheet(6)], robots=[robot]), 0.01)
    control = dc.Control(joint_positions=torch.tensor([0.1], dtype=F64))
    state = sim.step(sim.initial_state(), control)
    vertices, faces = state.meshes()["arm/finger/1"]
    center = tip_pose(robot, 0.1)[0, :3]
    torch.testing.assert_close(
        (vertices - center).norm(dim=1), torch.full((642,), RADIUS, dtype=F64)
    )
    assert len(faces) == 1280
    assert state.body_forces.shape == (8 + 4, 3)
    state.export(tmp_path / "finger.obj", bodies=True)
    dc.render(sim.scene, state, tmp_path / "finger.png", contact_forces=True)
    torch.save(state.detach(), tmp_path / "state.pt")
    again = torch.load(tmp_path / "state.pt")
    torch.testing.assert_close(again.meshes()["arm/finger/1"][0], vertices)


def test_an_attachment_to_a_smooth_link_holds(tmp_path):
    robot = finger(tmp_path, actuation="position")
    string = dc.Attachment(
        ("cloth0", 20), ("arm/finger/1", [0.3, 0.0, -0.08]), stiffness=50.0, rest_length=0.0
    )
    scene = dc.Scene([sheet(6)], robots=[robot], attachments=[string])
    sim = dc.Simulator(scene, 0.01)
    state = sim.step(sim.initial_state())
    length = (state.positions[20] - torch.tensor([0.3, 0.0, -0.08], dtype=F64)).norm()
    force = sim.contact_wrenches(state)["arm/finger/1"][:3].norm()
    assert float(force) == pytest.approx(50 * float(length), rel=1e-6)


def test_configurations_accept_smooth_links(tmp_path):
    robot = finger(tmp_path)
    assert robot.name == "arm"
    config = tmp_path / "run.yaml"
    for smooth, count in (("true", 3), ("{finger: true}", 3), ("{finger: false}", 2)):
        config.write_text(
            "task: drape\nsimulation: {dt: 0.01, steps: 2}\nscene:\n"
            "  cloths: [{name: c, shape: {kind: grid, rows: 3, columns: 3}}]\n"
            f"  robots: [{{name: arm, path: finger.urdf, smooth: {smooth}, "
            "stiffness: 20, pose: {position: [0, 0, 1]}}]\n"
        )
        task = load_task(config)
        assert len(task.scene.robots[0].link_names) == count
