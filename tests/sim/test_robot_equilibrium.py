"""Equilibria of robots, against statics by hand, long rollouts and differences."""

import numpy as np
import pytest
import torch
from scipy.optimize import fsolve

import diffcloth_torch as dc

F64 = torch.float64
TIGHT = dc.SolverOptions(tolerance=1e-9)
MASSES, CENTERS, LENGTH = (0.4, 0.3), (0.15, 0.1), 0.3

LINK = """
<link name="{name}">
  <inertial><origin xyz="{center} 0 0"/><mass value="{mass}"/>
    <inertia ixx="1e-3" iyy="3e-3" izz="3e-3" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="{center} 0 0"/><geometry><box size="{length} .03 .03"/></geometry>
  </collision>
</link>"""
BASE = """
<link name="base"><inertial><mass value="1"/>
  <inertia ixx="1e-2" iyy="1e-2" izz="1e-2" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """
<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{at} 0 0"/><axis xyz="0 1 0"/>
  <limit lower="-6" upper="6" effort="9" velocity="9"/></joint>"""


@pytest.fixture
def arm(tmp_path):
    """Load an arm of two links that turn about y, in the direction of x at first."""
    links = zip(("upper", "lower"), MASSES, CENTERS, (0.26, 0.16), strict=True)
    parts = [LINK.format(name=n, mass=m, center=c, length=size) for n, m, c, size in links]
    parts += [
        JOINT.format(name="shoulder", parent="base", child="upper", at=0),
        JOINT.format(name="elbow", parent="upper", child="lower", at=LENGTH),
    ]
    path = tmp_path / "arm.urdf"
    path.write_text(f'<robot name="arm">{BASE}{"".join(parts)}</robot>')

    def load(**options):
        return dc.Robot.load(path, name="arm", **options)

    return load


def alone(robot, **options):
    contact = dc.ContactOptions(barrier_distance=2e-3)
    floor = dc.RigidBody.plane(3.0, pose=[0, 0, -3, 1, 0, 0, 0], name="floor")
    scene = dc.Scene([], [floor], [robot], **options)
    return dc.Simulator(scene, 0.01, contact=contact, solver=TIGHT)


def moments(joints, gravity=9.81):
    """Moments of the weight about both axes, which point along y."""
    first, second = joints[0], joints[0] + joints[1]
    lower = MASSES[1] * gravity * CENTERS[1] * np.cos(second)
    upper = (MASSES[0] * CENTERS[0] + MASSES[1] * LENGTH) * gravity * np.cos(first)
    return np.array([upper + lower, lower])


@pytest.mark.parametrize("stiffness", [8.0, 2.0])
def test_an_arm_sags_on_its_drives(arm, stiffness):
    sim = alone(arm(stiffness=stiffness, damping=1.0))
    found = sim.equilibrium(sim.initial_state())
    expected = fsolve(lambda q: moments(q) - stiffness * q, [0.3, 0.0], xtol=1e-13)
    np.testing.assert_allclose(found.joint_positions.numpy(), expected, atol=1e-9)
    np.testing.assert_allclose(found.joint_efforts.numpy(), -moments(expected), atol=1e-8)
    assert not found.joint_velocities.any()


def test_damping_and_viscosity_change_nothing_at_rest(arm):
    """The equilibrium and the search are equal for any viscosity."""
    sim = alone(arm(stiffness=8.0, damping=1.0))
    ends = []
    for size in (0.0, 100.0):
        given = {
            name: torch.full((2,), size, dtype=F64, requires_grad=True)
            for name in ("joint_damping", "joint_viscosity")
        }
        found = sim.equilibrium(
            sim.initial_state(), None, sim.default_parameters().replace(**given)
        )
        gradients = torch.autograd.grad(found.joint_positions.sum(), list(given.values()))
        assert not any(gradient.any() for gradient in gradients)
        ends.append((found.report.iterations, *found.joint_positions.tolist()))
    assert ends[0] == ends[1]


def test_an_arm_without_drives_hangs(arm):
    """Also from a start at which the weight has nearly no moment, above the axis."""
    start = {"shoulder": -1.5, "elbow": 0.3}
    sim = alone(arm(actuation="torque", joint_positions=start))
    found = sim.equilibrium(sim.initial_state())
    np.testing.assert_allclose(found.joint_positions.numpy(), [np.pi / 2, 0.0], atol=1e-9)


def test_efforts_of_prescribed_joints_hold_the_weight(arm):
    actuation = {"shoulder": "position", "elbow": "pd"}
    drives = {"elbow": 5.0}
    sim = alone(arm(actuation=actuation, stiffness=drives, damping={"elbow": 1.0}))
    target = torch.tensor([0.4, 0.0], dtype=F64)
    found = sim.equilibrium(sim.initial_state(), sim.control(joint_positions=target))
    joints = found.joint_positions.numpy()
    assert joints[0] == pytest.approx(0.4, abs=1e-12)
    np.testing.assert_allclose(found.joint_efforts.numpy(), -moments(joints), atol=1e-8)


def test_a_joint_that_keeps_a_velocity_stays_with_a_gradient(arm):
    """The joint stays at the start of the search, and its position determines the other joint."""
    actuation = {"shoulder": "velocity", "elbow": "pd"}
    sim = alone(arm(actuation=actuation, stiffness={"elbow": 2.0}, damping={"elbow": 1.0}))

    def elbow(shoulder):
        start = torch.cat([shoulder, torch.zeros(1, dtype=F64)])
        found = sim.equilibrium(sim.initial_state().replace(joint_positions=start))
        assert torch.equal(found.joint_positions[:1], shoulder)
        return found.joint_positions[1]

    given = torch.tensor([0.4], dtype=F64)
    exact, differences = slopes(elbow, given, torch.ones(1, dtype=F64), 1e-5)
    assert abs(exact) > 0.01
    assert exact == pytest.approx(differences, rel=1e-6)


def slopes(loss, value, way, step):
    leaf = value.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(leaf), leaf)
    with torch.no_grad():
        ends = [float(loss(value + sign * step * way)) for sign in (1, -1)]
    return float((gradient * way).sum()), (ends[0] - ends[1]) / (2 * step)


def random_way(value, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(value.shape, generator=generator, dtype=F64) + 0.5) * value


def onto_a_sheet(arm, **options):
    """An arm that presses on a sheet, which is pinned at its corners."""
    robot = arm(stiffness=3.0, damping=1.0, pose=[0, 0, 0.3, 1, 0, 0, 0], **options)
    corners = {"corners": [0, 9, 90, 99]}
    sheet = dc.Cloth.grid(10, 10, (0.5, 0.5), pose=[0.35, 0, 0.15, 1, 0, 0, 0], pins=corners)
    # Contacts that have slid are at the limit of friction: changes of 1e-5 stay within this slip.
    contact = dc.ContactOptions(slip_velocity=1e-3)
    return dc.Simulator(dc.Scene([sheet], [], [robot]), 0.01, contact=contact, solver=TIGHT)


def test_gradients_of_an_arm_that_presses_on_a_sheet(arm):
    sim = onto_a_sheet(arm)
    found = sim.equilibrium(sim.initial_state())
    assert found.report.contacts["cloth0", "arm/lower"].count > 0
    weights = torch.randn(100, 3, generator=torch.Generator().manual_seed(9), dtype=F64)

    def value_of(end):
        return (end.positions * weights).sum() + 3.0 * end.joint_positions[0]

    def by_parameter(name):
        return lambda value: value_of(
            sim.equilibrium(found, None, sim.default_parameters().replace(**{name: value}))
        )

    for name in ("link_mass", "link_center", "joint_stiffness", "stretch", "friction", "gravity"):
        value = getattr(sim.default_parameters(), name)
        exact, differences = slopes(by_parameter(name), value, random_way(value), 1e-5)
        assert exact == pytest.approx(differences, rel=1e-4), name

    def by_control(name):
        return lambda value: value_of(sim.equilibrium(found, sim.control(**{name: value})))

    for name in ("joint_efforts", "joint_positions"):
        value = torch.zeros(2, dtype=F64)
        way = torch.tensor([1.0, 0.6], dtype=F64)
        exact, differences = slopes(by_control(name), value, way, 1e-5)
        assert exact == pytest.approx(differences, rel=1e-4), name

    def by_base(value):
        return value_of(sim.equilibrium(found.replace(base_poses=value)))

    way = torch.tensor([[0.3, 0.2, 1.0, 0, 0.1, 0.2, 0.1]], dtype=F64)
    exact, differences = slopes(by_base, found.base_poses, way, 1e-6)
    assert exact == pytest.approx(differences, rel=1e-4)


def test_a_batch_of_arms_has_the_bits_of_each(arm):
    sim = onto_a_sheet(arm)
    stiffness = torch.tensor([[3.0, 3.0], [5.0, 1.0]], dtype=F64)
    parameters = sim.default_parameters()
    batch = sim.equilibrium(
        sim.initial_state(2), None, parameters.replace(joint_stiffness=stiffness)
    )
    for k in range(2):
        given = parameters.replace(joint_stiffness=stiffness[k])
        single = sim.equilibrium(sim.initial_state(), None, given)
        assert torch.equal(batch.positions[k], single.positions)
        assert torch.equal(batch.joint_positions[k], single.joint_positions)


def test_a_rollout_ends_at_the_equilibrium(arm):
    """For any time step h; velocity products of a fall once shifted the end by O(h^2)."""
    errors = []
    for dt in (0.02, 0.01):
        robot = arm(stiffness=4.0, damping=0.5)
        contact = dc.ContactOptions(barrier_distance=2e-3)
        floor = dc.RigidBody.plane(3.0, pose=[0, 0, -3, 1, 0, 0, 0])
        sim = dc.Simulator(dc.Scene([], [floor], [robot]), dt, contact=contact, solver=TIGHT)
        found = sim.equilibrium(sim.initial_state())
        given = sim.default_parameters().replace(
            joint_viscosity=torch.tensor([0.5, 0.5], dtype=F64)
        )
        with torch.no_grad():
            end = sim.rollout(sim.initial_state(), parameters=given, steps=int(4 / dt))[-1]
        errors.append(float((end.joint_positions - found.joint_positions).abs().max()))
    assert max(errors) < 1e-7


def test_a_hand_rests_on_a_floor():
    hand = dc.Robot.load(
        dc.robots.GRIPPER, base="floating", pose=[0, 0, 0.2, 1, 0, 0, 0], stiffness=50.0,
        damping=1.0, name="hand",
    )  # fmt: skip
    contact = dc.ContactOptions(barrier_distance=2e-3)
    floor = dc.RigidBody.plane(3.0, name="floor")
    sim = dc.Simulator(dc.Scene([], [floor], [hand]), 0.005, contact=contact, solver=TIGHT)
    found = sim.equilibrium(sim.initial_state())
    weight = float(sim.default_parameters().link_mass.sum()) * 9.81
    force = found.body_forces[sim.slices["floor"]].sum(0)
    expected = torch.tensor([0, 0, -weight], dtype=F64)
    torch.testing.assert_close(force, expected, rtol=0, atol=1e-6 * weight)
    with torch.no_grad():
        end = sim.rollout(sim.initial_state(), steps=600)[-1]
    torch.testing.assert_close(found.base_poses, end.base_poses, rtol=0, atol=1e-6)


def test_a_pendulum_without_a_shape_hangs(tmp_path):
    """The scene has no surface at all."""
    link = LINK.format(name="bob", center=CENTERS[0], mass=MASSES[0], length=0.2)
    start, end = link.index("<collision>"), link.index("</link>")
    hinge = JOINT.format(name="hinge", parent="base", child="bob", at=0)
    path = tmp_path / "pendulum.urdf"
    path.write_text(f'<robot name="pendulum">{BASE}{link[:start]}{link[end:]}{hinge}</robot>')
    robot = dc.Robot.load(path, actuation="torque", joint_positions=0.4)
    contact = dc.ContactOptions(barrier_distance=2e-3)
    sim = dc.Simulator(dc.Scene([], [], [robot]), 0.01, contact=contact, solver=TIGHT)
    hanging = sim.equilibrium(sim.initial_state())
    assert hanging.joint_positions.item() == pytest.approx(np.pi / 2, abs=1e-8)


def test_a_drive_at_its_effort_limit_balances_the_weight(tmp_path):
    """The links have no shape and their joint is at their origin: nothing but centers has extent.

    The arm sinks from its target until m g l cos(q) is the limit, with dq/dL = -1 / (m g l sin(q)).
    """
    link = LINK.format(name="bob", center=CENTERS[0], mass=MASSES[0], length=0.2)
    start, end = link.index("<collision>"), link.index("</link>")
    hinge = JOINT.format(name="hinge", parent="base", child="bob", at=0)
    path = tmp_path / "arm.urdf"
    path.write_text(f'<robot name="arm">{BASE}{link[:start]}{link[end:]}{hinge}</robot>')
    moment = MASSES[0] * 9.81 * CENTERS[0]
    limit = torch.tensor([0.6 * moment], dtype=F64, requires_grad=True)
    robot = dc.Robot.load(
        path,
        actuation="pd",
        stiffness=400.0,
        damping=0.1,
        effort_limits=[0.6 * moment],
        joint_positions=0.2,
    )
    contact = dc.ContactOptions(barrier_distance=2e-3)
    sim = dc.Simulator(dc.Scene([], [], [robot]), 0.01, contact=contact, solver=TIGHT)
    parameters = dc.Parameters(joint_effort_limits=limit)
    angle = sim.equilibrium(sim.initial_state(), parameters=parameters).joint_positions[0]
    expected = np.arccos(0.6)
    assert angle.item() == pytest.approx(expected, abs=1e-7)
    (by_limit,) = torch.autograd.grad(angle, limit)
    assert by_limit.item() == pytest.approx(-1 / (moment * np.sin(expected)), rel=1e-6)


@pytest.mark.parametrize("viscosity", [0.0, 0.1])
def test_a_joint_that_nothing_holds_is_named(arm, viscosity):
    """A joint that resists its motion yields to a force without end, too."""
    robot = arm(actuation={"shoulder": "pd", "elbow": "torque"},
                stiffness={"shoulder": 5.0}, damping={"shoulder": 1.0})  # fmt: skip
    sim = alone(robot, gravity=(0, 9.81, 0))  # along the axes
    drag = torch.full((2,), viscosity, dtype=F64)
    with pytest.raises(dc.SimulationError, match="joint 'arm/elbow' is free to move"):
        sim.equilibrium(
            sim.initial_state(), None, sim.default_parameters().replace(joint_viscosity=drag)
        )


def test_the_environment_whose_joint_nothing_holds_is_named(arm):
    """The free joint is named although another joint yields more; a damper alone does not hold."""
    sim = alone(arm(stiffness=5.0, damping=1.0), gravity=(0, 9.81, 0))
    gains = torch.tensor([[2.0, 50.0], [50.0, 0.0], [2.0, 50.0], [50.0, 0.0]], dtype=F64)
    parameters = sim.default_parameters().replace(joint_stiffness=gains)
    with pytest.raises(dc.SimulationError, match="joint 'arm/elbow' is free to move") as error:
        sim.equilibrium(sim.initial_state(4), None, parameters)
    assert error.value.environments == (1, 3)


def test_a_hand_that_floats_is_named():
    hand = dc.Robot.load(
        dc.robots.GRIPPER, base="floating", stiffness=50.0, damping=1.0, name="hand"
    )
    contact = dc.ContactOptions(barrier_distance=2e-3)
    floor = dc.RigidBody.plane(3.0, pose=[0, 0, -1, 1, 0, 0, 0])
    scene = dc.Scene([], [floor], [hand], gravity=(0, 0, 0))
    sim = dc.Simulator(scene, 0.005, contact=contact)
    with pytest.raises(dc.SimulationError, match="'hand' is free to"):
        sim.equilibrium(sim.initial_state())


def test_torques_on_bases_and_velocities_of_joints_are_refused(arm):
    sim = alone(arm(stiffness=8.0, damping=1.0))
    rates = sim.control(joint_velocities=torch.tensor([0.1, 0.0], dtype=F64))
    with pytest.raises(dc.InvalidInput, match="joint_velocities` must have no velocities"):
        sim.equilibrium(sim.initial_state(), rates)
    floating = alone(arm(stiffness=8.0, damping=1.0, base="floating"))
    wrench = torch.tensor([[0, 0, 1.0, 0.1, 0, 0]], dtype=F64)
    with pytest.raises(dc.InvalidInput, match="base_wrenches` must have no torques"):
        floating.equilibrium(floating.initial_state(), floating.control(base_wrenches=wrench))


def turned(pose, angle):
    """The pose after a turn about y."""
    half = torch.tensor([np.cos(angle / 2), 0, np.sin(angle / 2), 0], dtype=F64)
    return torch.cat([pose[:3], half])


@pytest.mark.parametrize("angle", [0.2, 0.8, 1.5])
def test_a_base_that_a_control_turns_is_where_the_weight_counts(arm, angle):
    sim = alone(arm(base="kinematic", actuation="pd", stiffness=5.0, damping=0.1))
    start = sim.initial_state()
    control = sim.control(base_poses={"arm": turned(start.base_poses[0], angle)})
    end = sim.equilibrium(start, control)
    again = sim.equilibrium(end)
    torch.testing.assert_close(again.joint_positions, end.joint_positions, rtol=0, atol=1e-9)
    expected = -5.0 * end.joint_positions
    torch.testing.assert_close(end.joint_efforts, expected, rtol=1e-7, atol=0)
    joints = end.joint_positions.clone()
    joints[0] += angle
    np.testing.assert_allclose(end.joint_efforts, -moments(joints.numpy()), rtol=1e-7)


MIXED = {"shoulder": "pd", "elbow": "position"}, {"shoulder": "position", "elbow": "pd"}


@pytest.mark.quick(
    "actuation0-targets",
    "actuation0-stiffness",
    "actuation0-link_mass",
    "actuation1-targets",
    "actuation1-stiffness",
    "actuation1-link_mass",
    "position-targets",
    "position-stiffness",
    "position-link_mass",
    "actuation3-targets",
    "actuation3-stiffness",
    "actuation3-link_mass",
)
@pytest.mark.parametrize("name", ["targets", "base", "stiffness", "gravity", "link_mass", "held"])
@pytest.mark.parametrize("actuation", [*MIXED, "position", {**MIXED[0], "elbow": "velocity"}])
def test_derivatives_by_prescribed_joints_and_of_their_efforts(arm, actuation, name):
    dynamic = actuation != "position"
    gains = {"stiffness": 5.0, "damping": 0.1} if dynamic else {}
    start = {"shoulder": 0.3, "elbow": 0.2}
    robot = arm(base="kinematic", actuation=actuation, joint_positions=start, **gains)
    # Something that forces move, far away.
    corners = {"corners": [0, 2]}
    sheet = dc.Cloth.grid(3, 3, 0.2, pose=[5, 0, 0, 1, 0, 0, 0], pins=corners)
    sim = dc.Simulator(dc.Scene([sheet], [], [robot]), 0.01, solver=TIGHT)
    state, parameters = sim.initial_state(), sim.default_parameters()
    given = {
        "targets": state.joint_positions,
        "base": turned(state.base_poses[0], 0.4),
        "held": state.joint_positions,
        "gravity": parameters.gravity,
    }
    if dynamic:
        given |= {"stiffness": parameters.joint_stiffness, "link_mass": parameters.link_mass}
    if name not in given or (name == "targets" and "velocity" in str(actuation)):
        pytest.skip("a robot that forces do not move has no such parameter, or no such target")

    def outputs(value):
        new = {**given, name: value}
        fields = {"gravity": new["gravity"]}
        if dynamic:
            fields |= {"joint_stiffness": new["stiffness"], "link_mass": new["link_mass"]}
        options = {"base_poses": {"arm": new["base"]}}
        if name == "targets":
            options["joint_positions"] = new["targets"]
        end = sim.equilibrium(
            state.replace(joint_positions=new["held"]),
            sim.control(**options),
            parameters.replace(**fields),
        )
        weights = torch.tensor([1.0, 2.0], dtype=F64)
        return torch.stack([(weights * t).sum() for t in (end.joint_positions, end.joint_efforts)])

    at = given[name].detach().clone().requires_grad_()
    direction = torch.linspace(0.5, 1.0, at.numel(), dtype=F64).reshape(at.shape)
    if name in ("stiffness", "link_mass"):
        direction = direction * at.detach()
    if name == "base":
        direction = torch.tensor([0, 0, 0, 0, 0.3, 0.5, 0.1], dtype=F64)
    rows = torch.autograd.grad(
        outputs(at), at, torch.eye(2, dtype=F64), is_grads_batched=True, materialize_grads=True
    )[0]
    backward = (rows * direction).reshape(2, -1).sum(dim=1)
    _, forward = torch.func.jvp(outputs, (at.detach(),), (direction,))
    with torch.no_grad():
        high, low = (outputs(at + s * 1e-5 * direction) for s in (1, -1))
    differences = (high - low) / 2e-5
    torch.testing.assert_close(backward, differences, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(forward, backward, rtol=1e-9, atol=1e-12)
    assert differences[1].abs() > 1e-3 or (name == "held" and dynamic)


@pytest.mark.parametrize("table", [None, -1.0])
def test_an_object_held_by_friction_stays_in_the_hand(table):
    """Long steps must not begin at the inertial prediction, which is outside the closing grip."""
    hand = dc.Robot.load(
        dc.robots.GRIPPER,
        pose=[0, 0, 0.5, 0, 1, 0, 0],
        joint_positions=0.0085,
        actuation="pd",
        stiffness=200.0,
        damping=5.0,
        friction=0.8,
        name="hand",
    )
    box = dc.RigidBody.box(
        [0.02, 0.06, 0.04],
        motion="dynamic",
        density=1000,
        pose=[0, 0, 0.43, 1, 0, 0, 0],
        friction=0.8,
    )
    below = [] if table is None else [dc.RigidBody.plane(2.0, pose=[0, 0, table, 1, 0, 0, 0])]
    scene = dc.Scene([], [box, *below], robots=[hand])
    contact = dc.ContactOptions(barrier_distance=1e-3)
    close = dc.Control(joint_positions=torch.full((2,), 0.02, dtype=F64))
    simulator = dc.Simulator(scene, 0.01, contact=contact, solver=TIGHT)
    with torch.no_grad():
        held = simulator.rollout(simulator.initial_state(), [close] * 60)[-1]
        found = simulator.equilibrium(held, close)
        # Without the grip the object would fall by .39 m.
        longer = dc.Simulator(scene, 0.2, contact=contact, solver=TIGHT).step(held, close)
    assert (found.body_poses[0] - held.body_poses[0]).abs().max() < 2e-6
    assert (longer.body_poses[0] - held.body_poses[0]).abs().max() < 5e-6
    for state in (found, longer):
        wrenches = simulator.contact_wrenches(state)
        hold = wrenches["hand/left_finger"][2] + wrenches["hand/right_finger"][2]
        assert hold == pytest.approx(-0.048 * 9.81, rel=1e-4)


@pytest.mark.quick("actuation0")
@pytest.mark.parametrize(
    "actuation", [("pd", "position"), ("position", "pd"), ("position", "position")]
)
def test_efforts_of_an_arm_that_hangs_follow_its_targets(arm, actuation):
    """Only springs hold the floating base: its momentum rows do not determine efforts."""
    points = [
        [0.02, 0.015, 0.015],
        [0.28, 0.015, -0.015],
        [0.15, -0.015, 0.015],
        [0.1, 0.01, -0.01],
    ]
    robot = arm(base="floating", actuation=actuation, stiffness=30.0, damping=1.0)
    springs = dc.Attachment(("arm/upper", points), stiffness=300.0, name="hang")
    sim = dc.Simulator(
        dc.Scene([], [], [robot], attachments=[springs]),
        0.01,
        contact=dc.ContactOptions(barrier_distance=2e-3),
        solver=TIGHT,
    )
    start = sim.initial_state()
    frame = sim.link_poses(start)["arm/upper"]
    held = torch.tensor(points, dtype=F64) @ frame[:3, :3].T + frame[:3, 3]
    held = held + torch.tensor([0, 0, 0.02], dtype=F64)

    def efforts(targets):
        control = dc.Control(joint_positions=targets, attachments={"hang": held})
        return sim.equilibrium(start, control).joint_efforts

    targets, step = torch.tensor([0.3, -0.5], dtype=F64), 1e-4
    found = torch.autograd.functional.jacobian(efforts, targets)
    with torch.no_grad():
        ways = step * torch.eye(2, dtype=F64)
        columns = [(efforts(targets + w) - efforts(targets - w)) / (2 * step) for w in ways]
    expected = torch.stack(columns, 1)
    assert expected.abs().max() > 0.1
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
