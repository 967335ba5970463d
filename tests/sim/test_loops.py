"""For loops: contacts by pair, meshes, parts of batches, named parameters, trajectories."""

import numpy as np
import pytest
import torch
from torch.utils.checkpoint import checkpoint

import diffcloth_torch as dc
from diffcloth_torch.robots import GRIPPER

F64 = torch.float64


def box_scene(**keywords):
    """A sheet that falls onto a box, with a box far away and a gripper farther still."""
    sheet = dc.Cloth.grid(5, 5, 0.4, pose=[0.01, 0.02, 0.1285, 1, 0, 0, 0.1], name="sheet")
    other = dc.Cloth.grid(3, 3, 0.2, pose=[0, 2, 1, 1, 0, 0, 0], name="other")
    bodies = [
        dc.RigidBody.box(0.25, name="box", motion="dynamic", mass=0.4, pose=[0, 0, 0, 1, 0, 0, 0]),
        dc.RigidBody.plane(4.0, name="floor", pose=[0, 0, -0.1285, 1, 0, 0, 0]),
    ]
    hand = dc.Robot.load(
        GRIPPER, pose=[5, 0, 1, 1, 0, 0, 0], stiffness=50.0, damping=1.0, name="hand"
    )
    contact = dc.ContactOptions(barrier_distance=0.005)
    scene = dc.Scene([sheet, other], bodies, [hand])
    return dc.Simulator(scene, 0.01, contact=contact, **keywords)


@pytest.fixture(scope="module", params=["monolithic", "rigid_to_cloth", "cloth_to_rigid"])
def landed(request):
    sim = box_scene(coupling=request.param)
    with torch.no_grad():
        return sim, sim.rollout(sim.initial_state(), steps=12)[-1]


@pytest.fixture(scope="module")
def sim():
    return box_scene()


# --- Contacts by pair ----------------------------------------------------------------------------


def test_a_pair_has_the_force_that_its_surfaces_feel(landed):
    sim, state = landed
    contacts = state.report.contacts
    assert set(contacts) == {("sheet", "box"), ("box", "floor")}
    on_sheet = state.contact_forces[sim.slices["sheet"]].sum(0)
    assert on_sheet[2] > 0.1
    torch.testing.assert_close(contacts["box", "sheet"].force, on_sheet, rtol=1e-9, atol=1e-12)
    on_box = state.body_forces[sim.slices["box"]].sum(0)
    both = contacts["sheet", "box"].force + contacts["floor", "box"].force
    torch.testing.assert_close(both, on_box, rtol=1e-9, atol=1e-9)
    assert sum(contacts[pair].count for pair in contacts) == state.report.contact_count


def test_the_order_of_the_names_turns_the_force(landed):
    _, state = landed
    one, other = state.report.contacts["box", "floor"], state.report.contacts["floor", "box"]
    assert one.count == other.count > 0
    assert torch.equal(one.force, -other.force)


def test_pairs_without_contact_have_zeros_and_unknown_names_are_refused(landed):
    _, state = landed
    contacts = state.report.contacts
    apart = contacts["sheet", "other"]
    assert (apart.count, apart.force.tolist()) == (0, [0.0, 0.0, 0.0])
    assert contacts["sheet", "sheet"].count == 0
    with pytest.raises(dc.InvalidInput, match=r"surfaces are 'sheet', 'other', 'box'.*got 'shirt'"):
        contacts["shirt", "box"]
    with pytest.raises(dc.InvalidInput, match="pair of names"):
        contacts["sheet"]


def test_batches_have_the_pairs_of_their_environments(landed):
    sim, state = landed
    apart = sim.initial_state()
    both = sim.step(dc.stack([state.detach(), apart]))
    contacts = both.report.contacts["sheet", "box"]
    assert contacts.force.shape == (2, 3)
    for i, one in enumerate((sim.step(state), sim.step(apart))):
        alone = one.report.contacts["sheet", "box"]
        assert int(contacts.count[i]) == alone.count
        assert torch.equal(contacts.force[i], alone.force)
        assert both[i].report.contacts["sheet", "box"].count == alone.count
        assert torch.equal(both[i].report.contacts["sheet", "box"].force, alone.force)
    again = dc.stack([both[0], both[1]]).report.contacts
    assert torch.equal(again["sheet", "box"].force, contacts.force)
    mixed = dc.where(torch.tensor([False, True]), both, both[0])
    assert torch.equal(mixed.report.contacts["sheet", "box"].force[0], contacts.force[0])
    in_order = [("sheet", "box"), ("box", "floor")]
    assert list(both.report.contacts) == list(again) == list(mixed.report.contacts) == in_order


def test_a_report_with_contacts_is_saved_and_loaded(landed, tmp_path):
    _, state = landed
    torch.save(state, tmp_path / "state.pt")
    again = torch.load(tmp_path / "state.pt")
    assert again.report.contacts == state.report.contacts


# --- Meshes and batches --------------------------------------------------------------------------


def test_meshes_are_differentiable_and_named(sim):
    state = sim.initial_state()
    pose = state.body_poses.clone().requires_grad_()
    meshes = state.replace(body_poses=pose).meshes()
    assert tuple(meshes) == sim.surfaces
    vertices, faces = meshes["box"]
    assert (vertices.shape, faces.shape) == ((8, 3), (12, 3))
    (gradient,) = torch.autograd.grad(vertices.sum(), pose)
    assert gradient[0, :3].tolist() == [8.0, 8.0, 8.0]
    batch = sim.initial_state(2).meshes()
    assert torch.equal(batch["box"][0][1], vertices)
    by_hand = dc.State(
        *(getattr(state, n) for n in ("positions", "velocities", "body_poses")),
        state.soft_pin_targets,
        state.body_forces,
        state.time,
    )
    with pytest.raises(dc.InvalidInput, match="must come from a Simulator"):
        by_hand.meshes()


def test_a_batch_is_taken_by_mask_list_and_slice(sim):
    batch = sim.step(sim.initial_state(4))
    positions = batch.positions + torch.arange(4.0, dtype=F64)[:, None, None]
    batch = batch.replace(positions=positions)
    mask = torch.tensor([True, False, False, True])
    for index, rows in (
        (mask, [0, 3]),
        ([3, 0], [3, 0]),
        (torch.tensor([-1]), [3]),
        (np.array([1, 2]), [1, 2]),
        (slice(1, 3), [1, 2]),
        ([], []),
    ):
        part = batch[index]
        assert part.batch_size == len(rows)
        assert torch.equal(part.positions, positions[rows])
        assert part.report.converged.shape == (len(rows),)
        assert len(part.report.status) == len(rows)
    with pytest.raises(dc.InvalidInput, match=r"mask must have shape \[4\], got \[2\]"):
        batch[torch.tensor([True, False])]
    with pytest.raises(dc.InvalidInput, match=r"in 0 .. 3, got 4 at \[1\]"):
        batch[[0, 4]]
    with pytest.raises(TypeError, match="integers or a mask"):
        batch[torch.tensor([0.5])]


def test_a_clone_shares_nothing_but_gradients(sim):
    state = sim.initial_state()
    x = state.positions.clone().requires_grad_()
    copy = state.replace(positions=x).clone()
    copy.positions.sum().backward()
    assert torch.equal(x.grad, torch.ones_like(x))
    other = state.clone()
    other.positions.zero_()
    assert state.positions.any()


# --- Parameters by name --------------------------------------------------------------------------


def check_same_step(sim, named, explicit):
    """A step with parameters by name has the bits of one with arrays."""
    state = sim.initial_state()
    velocities = state.velocities + torch.tensor([0.3, 0.1, -0.5], dtype=F64)
    state = state.replace(velocities=velocities)
    ends = [sim.step(state, None, sim.default_parameters().replace(**p)) for p in (named, explicit)]
    for name in ("positions", "body_poses", "joint_positions", "joint_velocities"):
        assert torch.equal(*(getattr(end, name) for end in ends))
    return sim.step(state), ends[0]


def changed(sim, name, rows, value):
    tensor = getattr(sim.default_parameters(), name).clone()
    tensor[rows] = torch.as_tensor(value, dtype=F64)
    return tensor


@pytest.mark.parametrize(
    ("name", "key", "value", "rows"),
    [
        ("thickness", "box", 0.002, 2),
        ("stretch", "other", 900.0, 1),
        ("density", "sheet", 0.6, 0),
        ("body_mass", "box", 1.5, 0),
        ("body_center", "box", [0.01, 0.02, 0.0], 0),
        ("link_mass", "hand/left_finger", 0.9, None),
        ("joint_stiffness", "hand/left_finger_joint", 80.0, 0),
        ("joint_damping", "right_finger_joint", 2.5, 1),
        ("joint_damping", "hand", 2.5, slice(None)),
        ("joint_damping", "hand", [2.5, 0.5], slice(None)),
    ],
)
def test_named_values_are_those_of_their_rows(sim, name, key, value, rows):
    if rows is None:
        rows = sim._layout.link_names.index(key)
    explicit = getattr(sim.default_parameters(), name)
    if name in ("stretch", "density"):
        explicit = explicit.expand(2).clone()
        explicit[rows] = value
    else:
        explicit = changed(sim, name, rows, value)
    check_same_step(sim, {name: {key: value}}, {name: explicit})


def test_named_values_of_faces_and_vertices(sim):
    faces = {
        name: len(c.faces) for name, c in zip(("sheet", "other"), sim.scene.cloths, strict=True)
    }
    soft = torch.linspace(300, 900, faces["other"], dtype=F64)
    parameters = sim.default_parameters()
    first = parameters.stretch.expand(2)[0].expand(faces["sheet"])
    plain, other = check_same_step(
        sim, {"stretch": {"other": soft}}, {"stretch": torch.cat([first, soft])}
    )
    rest = 1.1 * parameters.rest_positions[sim.slices["other"]]
    explicit = changed(sim, "rest_positions", sim.slices["other"], rest)
    plain, other = check_same_step(
        sim, {"rest_positions": {"other": rest}}, {"rest_positions": explicit}
    )
    assert not torch.equal(plain.positions, other.positions)


def test_faces_that_are_not_named_keep_the_value_of_their_cloth():
    cloths = [
        dc.Cloth.grid(n, n, material=dc.Material(density=d), pose=[0, 0, n, 1, 0, 0, 0], name=name)
        for n, d, name in ((5, 0.1, "large"), (3, 0.3, "small"))
    ]
    sim = dc.Simulator(dc.Scene(cloths), 0.01)
    given = dc.Parameters(density={"small": torch.linspace(0.5, 1.0, 8, dtype=F64)})
    before, after = sim.vertex_masses(), sim.vertex_masses(given)
    large, small = sim.slices.values()
    torch.testing.assert_close(after[large], before[large], rtol=1e-14, atol=0)
    assert (after[small] > 1.5 * before[small]).all()


def test_gradients_reach_named_values_and_batches_have_their_own(sim):
    mass = torch.tensor([0.5, 2.0], dtype=F64, requires_grad=True)
    given = sim.default_parameters().replace(
        body_mass={"box": mass}, body_inertia=sim.default_parameters().body_inertia
    )
    states = sim.initial_state(2)
    states.body_poses[:, 0, 2] += 3.0  # away from everything
    end = sim.step(states, sim.control(body_wrenches={"box": [1.0, 0, 0, 0, 0, 0]}), given)
    found = torch.autograd.grad(end.body_velocities[:, 0, 0].sum(), mass)[0]
    torch.testing.assert_close(found, -0.01 / mass.detach() ** 2)  # v = h F / m


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"thickness": {"shirt": 0.1}},
            r"^step: `parameters.thickness` has the names 'sheet'.*'shirt' is none",
        ),
        (
            {"thickness": {"box": -0.1}},
            r"^step: `parameters.thickness\['box'\]` must be finite and >= 0",
        ),
        (
            {"thickness": {"box": [0.1, 0.1, 0.1]}},
            r"^step: `parameters.thickness\['box'\]` has a batch axis",
        ),
        (
            {"body_mass": {"sheet": 1.0}},
            r"^step: `parameters.body_mass` has the names 'box', 'floor'",
        ),
        ({"joint_damping": {"hand": 1.0, "left_finger_joint": 2.0}}, "name each row once"),
        (
            {"stretch": {"sheet": torch.ones(5)}},
            r"^step: `parameters.stretch\['sheet'\]` has a batch axis",
        ),
        ({"friction": {("sheet", "shirt"): 0.1}}, "must name pairs"),
        (
            {"body_mass": {"box": 0.0}},
            r"^step: `parameters.body_mass` must be > 0 in the row \[0\]",
        ),
    ],
)
def test_wrong_names_and_values_are_refused(sim, changes, message):
    with pytest.raises(dc.InvalidInput, match=message):
        sim.step(sim.initial_state(), None, sim.default_parameters().replace(**changes))


# --- Rollouts ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hanging():
    cloth = dc.Cloth.grid(4, 4, 0.3, pins={"edge": range(4)})
    return dc.Simulator(dc.Scene([cloth]), 0.01)


def test_parameters_of_each_step_are_those_of_a_loop(hanging):
    sim, base = hanging, hanging.default_parameters()
    scale = torch.tensor(2.0, dtype=F64, requires_grad=True)
    seen = []

    def parameters(k, state):
        seen.append((k, float(state.time)))
        return None if k == 1 else base.replace(stretch=base.stretch * scale ** (k + 1))

    state = sim.initial_state()
    for k in range(3):
        state = sim.step(state, None, parameters(k, state))
    (expected,) = torch.autograd.grad(state.positions.square().sum(), scale)
    asked, end = seen.copy(), state
    for every in (None, 2):
        seen.clear()
        states = sim.rollout(
            sim.initial_state(), parameters=parameters, steps=3, checkpoint_every=every
        )
        assert seen == asked
        assert torch.equal(states[-1].positions, end.positions)
        (found,) = torch.autograd.grad(states[-1].positions.square().sum(), scale)
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)


def test_parameters_that_change_before_backward_are_refused(hanging):
    base, calls = hanging.default_parameters(), []
    gravity = base.gravity.clone().requires_grad_()

    def parameters(k, state):
        calls.append(k)
        return base.replace(gravity=gravity * len(calls))

    end = hanging.rollout(
        hanging.initial_state(), parameters=parameters, steps=2, checkpoint_every=1
    )[-1]
    with pytest.raises(dc.InvalidInput, match="`parameters` must return what it returned before"):
        end.positions.sum().backward()


def test_a_trajectory_is_a_list_with_fields_over_time(hanging, tmp_path):
    states = hanging.rollout(hanging.initial_state(2), steps=3)
    assert isinstance(states, list)
    assert isinstance(states, dc.Trajectory)
    assert [type(state) for state in states] == [dc.State] * 3
    assert states.positions.shape == (3, 2, 16, 3)
    assert torch.equal(states.positions[1], states[1].positions)
    assert states.pin_forces.shape == (3, 2, 4, 3)
    assert states.time[:, 0].tolist() == pytest.approx([0.01, 0.02, 0.03])
    assert isinstance(states[1:], dc.Trajectory)
    assert len(states[1:]) == 2
    assert [*states[:1], states[2]] == [states[0], states[2]]
    with pytest.raises(AttributeError, match="no attribute 'position'"):
        _ = states.position
    states.save(tmp_path / "states.pt")
    again = dc.Trajectory.load(tmp_path / "states.pt")
    assert torch.equal(again.positions, states.positions)
    assert again[1].report.iterations.tolist() == states[1].report.iterations.tolist()
    again[-1][0].export(tmp_path / "end.obj")


def test_a_trajectory_carries_gradients_and_saves_without(hanging, tmp_path):
    start = hanging.initial_state()
    v = start.velocities.clone().requires_grad_()
    states = hanging.rollout(start.replace(velocities=v), steps=2)
    (of_all,) = torch.autograd.grad(states.positions.sum(), v, retain_graph=True)
    (of_each,) = torch.autograd.grad(sum(s.positions.sum() for s in states), v)
    assert torch.equal(of_all, of_each)
    states.save(tmp_path / "states.pt")
    assert not dc.Trajectory.load(tmp_path / "states.pt").positions.requires_grad


def test_wrong_trajectories_are_refused(hanging, tmp_path):
    with pytest.raises(dc.InvalidInput, match="needs at least one state"):
        _ = hanging.rollout(hanging.initial_state(), steps=0).positions
    (tmp_path / "text.pt").write_text("no states")
    torch.save({"a": 1}, tmp_path / "dict.pt")
    torch.save([1], tmp_path / "numbers.pt")
    for name in ("text", "dict", "numbers"):
        with pytest.raises(dc.InvalidInput, match=r"Trajectory\.load"):
            dc.Trajectory.load(tmp_path / f"{name}.pt")
    with pytest.raises(FileNotFoundError):
        dc.Trajectory.load(tmp_path / "none.pt")


def test_checkpoints_of_torch_differentiate_states(hanging):
    """The reentrant form does not look into arguments: docs/failures.md."""
    start = hanging.initial_state()
    v = start.velocities.clone().requires_grad_()
    thrown = start.replace(velocities=v)
    (expected,) = torch.autograd.grad(hanging.step(thrown).positions.sum(), v)
    after = checkpoint(hanging.step, thrown, use_reentrant=False)
    (found,) = torch.autograd.grad(after.positions.sum(), v)
    assert torch.equal(found, expected)
    with pytest.warns(UserWarning, match="None of the inputs have requires_grad=True"):
        lost = checkpoint(hanging.step, thrown, use_reentrant=True)
    assert not lost.positions.requires_grad


@pytest.mark.slow
def test_compiled_rollouts_are_compiled_once(hanging):
    """The compiler sees the lines around rollouts and steps; a policy may be compiled by itself."""
    runs = []

    def backend(graph, _inputs):
        return lambda *inputs: runs.append("graph") or graph(*inputs)

    torch._dynamo.reset()
    policy = torch.compile(lambda positions, k: positions[:4] + 0.001 * k, backend=backend)

    def run(offset):
        start = hanging.initial_state()
        start = start.replace(positions=start.positions + offset)
        controls = [dc.Control(pins=start.positions[:4] + 0.001)] * 2
        states = hanging.rollout(start, controls)
        states += hanging.rollout(
            states[-1],
            lambda k, state: dc.Control(pins=policy(state.positions.detach(), 1.0)),
            steps=3,
            checkpoint_every=2,
        )
        return hanging.step(states[-1]).positions.square().sum()

    offset = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    (expected,) = torch.autograd.grad(run(offset), offset)
    compiled = torch.compile(run, backend="eager")
    runs.clear()
    with torch._dynamo.config.patch(error_on_recompile=True):
        for _ in range(4):
            (found,) = torch.autograd.grad(compiled(offset), offset)
            assert torch.equal(found, expected)
    assert len(runs) == 4 * (3 + 3)  # forward, and repeated in backward
    torch._dynamo.reset()
