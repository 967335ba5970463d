"""Steps with dynamic bodies and robots: fields of the state, gradients, batches, saving."""

import io
import pickle

import coupled_scenes
import numpy as np
import pytest
import torch
from body_scenes import F64, make_scene
from differences import directions, mismatch

import diffcloth_torch as dc

DT = 0.01


@pytest.fixture(scope="module")
def sim(tmp_path_factory):
    scene = make_scene(tmp_path_factory.mktemp("robots"))
    return dc.Simulator(scene, DT, solver=dc.SolverOptions(tolerance=1e-11))


def moving(sim, batch_size=None):
    """A state in motion."""
    g = torch.Generator().manual_seed(1)
    state = sim.initial_state(batch_size)
    noise = {
        name: torch.randn(getattr(state, name).shape, dtype=F64, generator=g)
        for name in ("velocities", "body_velocities", "joint_velocities", "base_velocities")
    }
    positions = state.joint_positions + torch.tensor([0.1, 0.2, 0.3, 0.01, 0.02], dtype=F64)
    return state.replace(
        velocities=0.05 * noise["velocities"],
        body_velocities=noise["body_velocities"],
        joint_velocities=0.5 * noise["joint_velocities"],
        base_velocities=noise["base_velocities"],
        joint_positions=positions,
        joint_targets=positions.clone(),
    )


def acting(sim):
    """A control that sets something of every kind."""
    return sim.control(
        body_poses={"hand": [0.0, 1.0, 1.01, 1.0, 0.01, 0.0, 0.0]},
        body_wrenches={"brick": [1.0, 2.0, 3.0, 0.01, 0.02, 0.03]},
        joint_positions={"slide": 0.12, "turn": 0.4},
        joint_velocities={"turn": 0.5, "left_finger_joint": 0.1},
        joint_efforts={"turn": 0.2, "spin": 0.05},
        base_wrenches={"hold": [0.1, 0.2, 5.0, 0.01, 0.0, 0.02]},
    )


def test_edges_that_are_nearly_parallel_take_few_iterations():
    """A box's ridges lie along the edges of a cloth."""
    sim = coupled_scenes.simulator("monolithic", "fixed")
    given = coupled_scenes.control(sim), coupled_scenes.parameters(sim)
    with torch.no_grad():
        state = sim.step(sim.initial_state(), *given)
    assert state.report.iterations < 60


FIELDS = (
    *("positions", "velocities", "body_poses", "soft_pin_targets", "body_forces", "time"),
    *("body_velocities", "joint_positions", "joint_velocities", "joint_targets"),
    *("joint_efforts", "base_poses", "base_velocities"),
)


def same(a, b):
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in FIELDS)


def test_the_initial_state_is_at_rest(sim):
    state = sim.initial_state()
    assert state.body_velocities.shape == (3, 6)
    assert state.joint_positions.shape == state.joint_targets.shape == (5,)
    assert state.base_poses.shape == (2, 7)
    assert state.base_velocities.shape == (2, 6)
    assert torch.equal(state.joint_targets, state.joint_positions)
    for name in ("body_velocities", "joint_velocities", "joint_efforts", "base_velocities"):
        assert not getattr(state, name).any()
    assert sim.initial_state(2).joint_positions.shape == (2, 5)


def test_names_and_slices(sim):
    links = ("arm/d", "hold/palm", "hold/left_finger", "hold/right_finger")
    assert sim.surfaces == ("cloth0", "floor", "hand", "brick", *links)
    assert sim.slices["cloth0"] == slice(0, 9)
    assert sim.slices["brick"] == slice(12, 20)
    assert sim.slices["hold/right_finger"].stop == len(sim.initial_state().body_forces)
    assert sim.joint_slices == {"arm": slice(0, 3), "hold": slice(3, 5)}


def test_prescribed_things_arrive_and_pd_targets_are_held(sim):
    before = moving(sim)
    after = sim.step(before, acting(sim))
    # position, then velocity joints
    assert after.joint_positions[0] == 0.12
    expected = before.joint_positions[3:] + DT * torch.tensor([0.1, 0.0], dtype=F64)
    torch.testing.assert_close(after.joint_positions[3:], expected, rtol=0, atol=1e-15)
    assert after.joint_targets.tolist()[1] == 0.4
    rows = [0, 2, 3, 4]
    assert torch.equal(after.joint_targets[rows], before.joint_targets[rows])
    assert after.body_poses[1].tolist() == [0.0, 1.0, 1.01, 1.0, 0.01, 0.0, 0.0]
    assert torch.equal(after.body_poses[0], before.body_poses[0])
    assert torch.equal(after.base_poses[0], before.base_poses[0])
    assert sim.step(after).joint_targets[1] == 0.4


def test_velocities_of_bodies_on_poses_are_quotients(sim):
    after = sim.step(moving(sim), acting(sim))
    floor, hand, _ = after.body_velocities
    assert not floor.any()
    turn = 2 * np.arctan(0.01) / DT
    expected = torch.tensor([0.0, 0.0, 0.01 / DT, turn, 0.0, 0.0], dtype=F64)
    torch.testing.assert_close(hand, expected)


def test_velocities_of_bodies_on_poses_are_quotients_without_coordinates():
    """Difference quotients and their gradients in a scene without generalized coordinates."""
    bodies = [
        dc.RigidBody.box(0.1, motion="kinematic", pose=[0, 0, 1, 1, 0, 0, 0]),
        dc.RigidBody.plane(1.0, pose=[0, 0, -1, 1, 0, 0, 0]),
        dc.RigidBody.box(0.1, motion="kinematic", pose=[0, 1, 1, 2, 0.1, 0, 0]),
    ]
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(2, 2, 0.1)], bodies), DT)
    state = sim.initial_state()
    assert not sim.step(state).body_velocities.any()
    poses = state.body_poses.clone()
    poses[0] = torch.tensor([0.01, 0, 1, 1, 0, 0.01, 0], dtype=F64)
    poses[2] *= -1.0  # the quaternion's other sign
    poses[2, :3] *= -1.0
    after = sim.step(state, sim.control(body_poses=poses))
    turn = 2 * np.arctan(0.01) / DT
    expected = torch.zeros(3, 6, dtype=F64)
    expected[0] = torch.tensor([0.01 / DT, 0, 0, 0, turn, 0], dtype=F64)
    torch.testing.assert_close(after.body_velocities, expected)

    def velocities(start, end):
        given = state.replace(body_poses=start)
        kept = torch.cat([end[:1], start[1:2], end[1:]])
        return sim.step(given, dc.Control(body_poses=kept)).body_velocities

    ends = torch.cat([poses[:1], poses[2:]]).requires_grad_()
    assert torch.autograd.gradcheck(velocities, (state.body_poses.requires_grad_(), ends))


def test_a_body_falls_and_is_pushed(sim):
    before = sim.initial_state()
    after = sim.step(before, sim.control(body_wrenches={"brick": [1.0, 0, 0, 0, 0, 0]}))
    v = DT * torch.tensor([1.0 / 0.5, 0.0, -9.81], dtype=F64)
    torch.testing.assert_close(after.body_velocities[2, :3], v, rtol=1e-12, atol=0)
    moved = after.body_poses[2, :3] - before.body_poses[2, :3]
    torch.testing.assert_close(moved, DT * v, rtol=1e-12, atol=1e-17)


def test_links_are_where_the_robot_says(sim):
    state = moving(sim)
    poses = sim.link_poses(state)
    first = 0
    for name, robot, base in zip(("arm", "hold"), sim.scene.robots, state.base_poses, strict=True):
        joints = state.joint_positions[first : first + len(robot.joint_names)]
        first += len(joints)
        for link, pose in robot.forward_kinematics(joints, base).items():
            torch.testing.assert_close(poses[f"{name}/{link}"], pose, rtol=0, atol=1e-14)
    assert sim.link_poses(moving(sim, 2))["arm/d"].shape == (2, 4, 4)


def test_links_move_as_their_poses_change(sim):
    """Velocities of the links' centers against differences of poses along the motion."""
    state = moving(sim)
    state = state.replace(
        base_velocities=torch.cat([torch.zeros(1, 6, dtype=F64), state.base_velocities[1:]])
    )
    velocities = sim.link_velocities(state)
    centers = sim.default_parameters().link_center
    h = 1e-6

    def centers_at(time):
        joints = state.joint_positions + time * state.joint_velocities
        poses = state.base_poses.clone()
        palm, twist = poses[1], state.base_velocities[1]
        turn = torch.linalg.matrix_exp(time * skew(twist[3:]))
        # The base velocity is the velocity of the palm's center of mass.
        palm[:3] += centers[5] + time * twist[:3] - turn @ centers[5]
        palm[3:] = quaternion_of(turn)
        frames = sim.link_poses(state.replace(joint_positions=joints, base_poses=poses))
        return {
            name: frame[:3, :3] @ center + frame[:3, 3]
            for (name, frame), center in zip(frames.items(), centers, strict=True)
        }

    ahead, behind = centers_at(h), centers_at(-h)
    for name, velocity in velocities.items():
        expected = (ahead[name] - behind[name]) / (2 * h)
        torch.testing.assert_close(velocity[:3], expected, rtol=1e-7, atol=1e-8)


def skew(v):
    x, y, z = v.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=F64)


def quaternion_of(rotation):
    w = 0.5 * (1 + rotation.trace()).sqrt()
    axis = torch.stack(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return torch.cat([w[None], axis / (4 * w)])


def test_contact_wrenches_carry_the_weight():
    """A box rests on a plane: its wrench is its weight upward, the plane's the same downward."""
    box = dc.RigidBody.box(0.1, motion="dynamic", mass=0.5, pose=[0.3, 0.2, 0.052, 1, 0, 0, 0])
    scene = dc.Scene([], [dc.RigidBody.plane(2.0, name="floor"), box])
    sim = dc.Simulator(scene, DT, contact=dc.ContactOptions(barrier_distance=0.004))
    with torch.no_grad():
        state = sim.rollout(sim.initial_state(), steps=150)[-1]
    wrenches = sim.contact_wrenches(state)
    weight = torch.tensor([0.0, 0.0, 0.5 * 9.81], dtype=F64)
    torch.testing.assert_close(wrenches["body1"][:3], weight, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(wrenches["floor"][:3], -weight, rtol=1e-4, atol=1e-4)
    # Torques are about the plane's origin and about the box's center.
    torque = torch.linalg.cross(state.body_poses[1, :3], -weight)
    torch.testing.assert_close(wrenches["floor"][3:], torque, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(wrenches["body1"][3:], torch.zeros(3, dtype=F64), atol=1e-4, rtol=0)


def test_a_gripper_holds_a_sheet_with_its_efforts():
    """Two fingers close on a hanging sheet with 2 N each, stop at once and do not rebound."""
    pose = [0, 0.003, 0.09, np.cos(np.pi / 4), np.sin(np.pi / 4), 0, 0]
    sheet = dc.Cloth.grid(9, 9, 0.1, pose=pose, pins={"top": range(72, 81)})
    hand = dc.Robot.load(dc.robots.GRIPPER, actuation="torque", joint_positions=0.03, name="hand")
    sim = dc.Simulator(dc.Scene([sheet], [], [hand]), DT, solver=dc.SolverOptions(tolerance=1e-10))
    with torch.no_grad():
        control = sim.control(joint_efforts=[2.0, 2.0])
        state = sim.rollout(sim.initial_state(), [control] * 8)[-1]
    assert (state.joint_positions > 0.0385).all()
    assert state.joint_velocities.abs().max() < 5e-3
    wrenches = sim.contact_wrenches(state)
    for finger, force in (("hand/left_finger", 2.0), ("hand/right_finger", -2.0)):
        assert wrenches[finger][1] == pytest.approx(force, rel=2e-3)

    g = torch.Generator().manual_seed(0)
    weights = torch.randn(state.positions.shape, dtype=F64, generator=g)

    def loss(efforts):
        end = sim.rollout(state, [dc.Control(joint_efforts=efforts)] * 3)[-1]
        joints = end.joint_positions + 0.1 * end.joint_velocities
        return (weights * end.positions).sum() + joints[0] - 2 * joints[1]

    def value(efforts):
        with torch.no_grad():
            return float(loss(efforts))

    efforts = torch.tensor([2.0, 2.0], dtype=F64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(efforts), efforts)
    for d in directions(efforts, g):
        assert mismatch(value, efforts.detach(), gradient, d, 1e-3, 1e-7) < 1e-6


# --- Batches, purity, saving ---------------------------------------------------------------------


def test_a_batch_has_the_bits_of_its_environments(sim):
    states = [moving(sim), sim.initial_state()]
    batch = sim.step(dc.stack(states), acting(sim))
    for i, state in enumerate(states):
        assert same(batch[i], sim.step(state, acting(sim)))
    again = dc.where(torch.tensor([True, False]), batch, sim.initial_state())
    assert torch.equal(again.joint_positions[0], batch.joint_positions[0])
    assert torch.equal(again.base_poses[1], sim.initial_state().base_poses)


def test_a_saved_simulator_and_state_go_on_with_the_same_bits(sim, tmp_path):
    state = moving(sim)
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    loaded = torch.load(file, weights_only=True)
    assert same(loaded, state)
    copy = pickle.loads(pickle.dumps(sim))
    assert same(copy.step(loaded, acting(copy)), sim.step(state, acting(sim)))
    loaded.export(tmp_path / "all.obj", bodies=True)
    state.export(tmp_path / "same.obj", bodies=True)
    text = (tmp_path / "all.obj").read_text()
    assert text == (tmp_path / "same.obj").read_text()
    assert "o hold/left_finger" in text


def test_exported_links_are_where_they_stand(sim, tmp_path):
    from diffcloth_torch.geometry.meshes import read_mesh

    state = moving(sim)
    state.export(tmp_path / "all.obj", bodies=True)
    vertices, _ = read_mesh(tmp_path / "all.obj")
    rows = sim.slices["hold/left_finger"]
    frame = sim.link_poses(state)["hold/left_finger"].numpy()
    rest = sim.scene.robots[1].surfaces[1].vertices
    placed = rest @ frame[:3, :3].T + frame[:3, 3]
    np.testing.assert_allclose(vertices[9 + rows.start : 9 + rows.stop], placed, atol=1e-15)


def test_a_checkpointed_rollout_has_the_same_gradient(sim):
    gradients = []
    for every in (None, 2):
        efforts = torch.full((5,), 0.01, dtype=F64, requires_grad=True)
        controls = [dc.Control(joint_efforts=efforts)] * 4
        end = sim.rollout(moving(sim), controls, checkpoint_every=every)[-1]
        (end.joint_positions.sum() + end.base_poses.sum()).backward()
        gradients.append(efforts.grad)
    assert torch.equal(*gradients)
    assert gradients[0][2] != 0


def test_outputs_share_no_storage(sim):
    state = moving(sim)
    after = sim.step(state)
    places = [
        getattr(s, name).untyped_storage().data_ptr() for s in (state, after) for name in FIELDS
    ]
    assert len(set(places) - {0}) == len([place for place in places if place])


@pytest.mark.parametrize("batch_size", [None, 2])
@pytest.mark.parametrize(
    "moved", [{}, {"motion": "dynamic", "mass": 1.0}], ids=["static", "dynamic"]
)
def test_a_scene_without_robots_has_no_links(moved, batch_size):
    box = dc.RigidBody.box(0.1, name="box", pose=[0, 0, -1, 1, 0, 0, 0], **moved)
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(3, 3)], [box]), DT)
    state = sim.step(sim.initial_state(batch_size))
    assert sim.link_poses(state) == sim.link_velocities(state) == {}
    assert list(sim.contact_wrenches(state)) == ["box"]


def test_a_failed_step_leaves_the_state_alone(sim):
    state = moving(sim)
    kept = {name: getattr(state, name).clone() for name in FIELDS}
    with pytest.raises(dc.InvalidInput):
        sim.step(state, dc.Control(joint_positions={"slide": 1.0}))
    assert all(torch.equal(getattr(state, name), values) for name, values in kept.items())


# --- Inputs of a simulator -----------------------------------------------------------------------


def box_scene(**options):
    box = dc.RigidBody.box(0.1, motion="dynamic", mass=0.5, pose=[0, 0, 0.2, 1, 0, 0, 0])
    return dc.Scene([dc.Cloth.grid(3, 3)], [box], **options)


def test_split_accepts_dynamic_bodies_only_when_staggered():
    with pytest.raises(dc.InvalidInput, match="'split' takes prescribed bodies and the staggered"):
        dc.Simulator(box_scene(), DT, scheme="split")
    with pytest.raises(dc.InvalidInput, match="'rigid_to_cloth', 'cloth_to_rigid', got 'both'"):
        dc.Simulator(box_scene(), DT, coupling="both")
    cloth = dc.Scene([dc.Cloth.grid(3, 3)])
    assert dc.Simulator(cloth, DT, scheme="split").coupling == "monolithic"


def test_a_scene_without_cloths_needs_a_barrier_distance():
    scene = dc.Scene([], [dc.RigidBody.plane(1.0), *box_scene().bodies])
    with pytest.raises(dc.InvalidInput, match=r"`contact\.barrier_distance` must be given"):
        dc.Simulator(scene, DT)


def test_drives_without_gains_are_refused():
    hand = dc.Robot.load(dc.robots.GRIPPER, name="hand")
    with pytest.raises(dc.InvalidInput, match="pd joint 'hand/left_finger_joint' must have gains"):
        dc.Simulator(dc.Scene([], [], [hand]), DT, contact=dc.ContactOptions(barrier_distance=1e-3))


# --- Gradients -----------------------------------------------------------------------------------

STATE_FIELDS = tuple(
    name
    for name in FIELDS
    if name not in ("soft_pin_targets", "body_forces", "time", "joint_efforts")
)
CONTROL_FIELDS = (
    *("body_poses", "body_wrenches", "joint_positions", "joint_velocities", "joint_efforts"),
    "base_wrenches",
)
PARAMETER_FIELDS = (
    *("gravity", "body_mass", "body_center", "body_inertia", "link_mass", "link_center"),
    *("link_inertia", "joint_stiffness", "joint_damping", "joint_viscosity", "joint_armature"),
    *("joint_effort_limits", "joint_velocity_limits", "joint_friction", "joint_slip_rates"),
)
EVERY = [
    *(("state", name) for name in STATE_FIELDS),
    *(("control", name) for name in CONTROL_FIELDS),
    *(("parameters", name) for name in PARAMETER_FIELDS),
]


def weights_of(state):
    g = torch.Generator().manual_seed(7)
    names = [name for name in FIELDS if name not in ("time", "soft_pin_targets")]
    return {name: torch.randn(getattr(state, name).shape, dtype=F64, generator=g) for name in names}


@pytest.mark.quick(
    "state-positions",
    "state-body_poses",
    "state-joint_positions",
    "state-joint_targets",
    "state-base_velocities",
    "control-body_wrenches",
    "control-joint_velocities",
    "control-base_wrenches",
    "parameters-body_mass",
    "parameters-body_inertia",
    "parameters-link_center",
    "parameters-joint_stiffness",
    "parameters-joint_viscosity",
    "parameters-joint_effort_limits",
    "parameters-joint_friction",
)
@pytest.mark.parametrize(("record", "name"), EVERY)
def test_gradients_of_two_steps_are_those_of_differences(sim, record, name):
    """Every differentiable field, with a loss on every output field."""
    start = moving(sim)
    poses = start.body_poses.clone()
    poses[1, 2] += 0.01
    positions = torch.tensor([0.12, 0.4, 0.0, 0.0, 0.0], dtype=F64)
    control = dc.Control(
        body_poses=poses,
        body_wrenches=torch.cat([torch.zeros(2, 6, dtype=F64), torch.ones(1, 6, dtype=F64) / 10]),
        joint_positions=positions,
        joint_velocities=torch.tensor([0.0, 0.5, 0.0, 0.1, 0.2], dtype=F64),
        joint_efforts=torch.tensor([0.0, 0.2, 0.05, 0.0, 0.0], dtype=F64),
        base_wrenches=torch.cat([torch.zeros(1, 6, dtype=F64), torch.ones(1, 6, dtype=F64) / 10]),
    )
    parameters = sim.default_parameters()
    parameters = parameters.replace(
        joint_damping=parameters.joint_damping + 0.05,
        joint_viscosity=parameters.joint_viscosity + 0.02,
        joint_armature=parameters.joint_armature + 0.001,
        joint_effort_limits=torch.tensor([1.0, 0.3, 0.05, 1.0, 1.0], dtype=F64),
        joint_velocity_limits=torch.tensor([9.0, 9.0, 0.5, 9.0, 9.0], dtype=F64),
        joint_friction=torch.tensor([0.0, 0.02, 0.01, 0.0, 0.0], dtype=F64),
        joint_slip_rates=torch.tensor([0.1, 0.3, 0.4, 0.1, 0.1], dtype=F64),
    )
    records = {"state": start, "control": control, "parameters": parameters}
    weights = weights_of(start)
    free = allowed_directions(record, name, getattr(records[record], name))

    def loss(x):
        given = {**records, record: records[record].replace(**{name: x})}
        if record == "state" and name == "body_poses":
            # A control must keep the rows of bodies that are not kinematic.
            rows = torch.tensor([[0.0], [1.0], [0.0]], dtype=F64)
            kept = rows * control.body_poses + (1 - rows) * x
            given["control"] = control.replace(body_poses=kept)
        end = given["state"]
        for _ in range(2):
            moved = given["control"]
            if end is not given["state"]:
                held = end.body_poses.clone()
                held[1] = moved.body_poses[1]
                moved = moved.replace(body_poses=held)
            end = sim.step(end, moved, given["parameters"])
        return sum((weights[key] * getattr(end, key)).sum() for key in weights)

    x = getattr(records[record], name).clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(x), x)

    def value(y):
        with torch.no_grad():
            return float(loss(y))

    g = torch.Generator().manual_seed(3)
    for d in directions(x, g):
        d = free * d
        if d.any():
            assert mismatch(value, x.detach(), gradient, d, 1e-3, 1e-6) < 1e-5


def allowed_directions(record, name, x):
    """Rows that may change without being refused, and how far masses, inertias and gains may."""
    rows = {
        ("control", "body_poses"): [[0.0], [1.0], [0.0]],
        ("control", "body_wrenches"): [[0.0], [0.0], [1.0]],
        ("control", "base_wrenches"): [[0.0], [1.0]],
    }
    if (record, name) in rows:
        return torch.tensor(rows[record, name], dtype=F64)
    if name in ("body_inertia", "link_inertia"):
        moments = x.diagonal(dim1=-2, dim2=-1)
        return (moments[..., :, None] * moments[..., None, :]).sqrt()
    return (
        x.abs()
        if name.endswith(("mass", "stiffness", "damping", "viscosity", "limits", "friction"))
        else torch.ones(1)
    )
