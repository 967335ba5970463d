"""The public contract of a simulator: names, checks, hold, batches, purity, autograd, saving.

No test here depends on the accuracy of a step; other tests cover the physics and its gradients.
"""

import copy
import gc
import io
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from processes import threads

import diffcloth_torch as dc

F64 = torch.float64
PUBLIC = {
    "AddedMassWarning": "",
    "Attachment": "",
    "BarrierStartWarning": "",
    "Camera": "place azimuth elevation zoom target distance position up field_of_view",
    "Cloth": "load grid",
    "ContactOptions": (
        "barrier_distance barrier_stiffness friction_iterations slip_velocity self_contact"
    ),
    "ContactPoints": "on forces",
    "Control": (
        "pins soft_pins body_poses forces body_wrenches joint_positions joint_velocities "
        "joint_efforts base_poses base_wrenches attachments attachment_weights wind body_vertices "
        "replace"
    ),
    "CorrelatedResidualsWarning": "",
    "DeformingBody": "load",
    "Descent": "record restore metrics",
    "Evaluation": "failed_environments is_better_than record",
    "InfeasibleMotion": "",
    "IntersectingState": "",
    "InvalidInput": "",
    "Material": (
        "stretch bending poisson density damping friction thickness normal_drag tangential_drag "
        "stretch_weft stretch_shear bending_weft bending_twill is_orthotropic per_face"
    ),
    "MeshBiasWarning": "",
    "ModelErrorWarning": "",
    "NoiseWarning": "",
    "NotConverged": "",
    "Prior": "",
    "StepBiasWarning": "",
    "Tie": "",
    "TurnedTooFar": "",
    "Parameters": (
        "stretch bending poisson density damping friction thickness barrier_stiffness "
        "barrier_distance slip_velocity pin_stiffness gravity rest_positions attachment_stiffness "
        "normal_drag tangential_drag air_density body_mass body_center body_inertia link_mass "
        "link_center link_inertia joint_stiffness "
        "joint_damping joint_viscosity joint_armature stretch_weft stretch_shear "
        "bending_weft bending_twill joint_effort_limits joint_velocity_limits joint_friction "
        "joint_slip_rates replace"
    ),
    "Report": "select stack where",
    "RigidBody": "load box sphere capsule cylinder plane",
    "Robot": "load from_chain chain chain_positions forward_kinematics joint_names link_names",
    "Scene": "",
    "SimulationError": "",
    "Simulator": (
        "initial_state control parameters step rollout equilibrium energy kinetic_energy momentum "
        "vertex_masses link_poses link_velocities contact_wrenches contacts"
    ),
    "SolverOptions": "tolerance max_iterations max_seconds throw metric elastic",
    "State": "batch_size replace detach clone to export meshes contact_forces pin_forces",
    "Trajectory": "at save load detach",
    "build_info": "",
    "descend": "",
    "load_config": "",
    "render": "",
    "show": "",
    "Fit": "chi2 information lines load mesh_bias predict profile report rms save step_bias",
    "Stage": "",
    "fit": "",
    "Variable": "",
    "WorkerError": "",
    "at_half_step": "",
    "residuals": "extrapolated markers outline point_cloud",
    "envs": "make TASKS ClothVectorEnv Task",
    "fabrics": "MEASUREMENTS Measurement material",
    "learn": (
        "Episodes Plans Policy PolicySizes Processes Ranks RayActors Trainer TrainerOptions "
        "evaluate imitate load_policy plan record"
    ),
    "robots": "GRIPPER panda",
    "stack": "",
    "where": "",
}


def make_scene():
    """Two cloths above a floor, which they do not reach in a few steps, and a distant box.

    Coordinates are in general position: no gradient vanishes by symmetry.
    """
    sheet = dc.Cloth.grid(
        4,
        4,
        size=0.3,
        pins={"edge": [0, 1], "corner": [15]},
        soft_pins={"middle": [5, 10]},
        pose=[0, 0, 1, 1, 0.1, 0.05, 0],
        name="sheet",
    )
    patch = dc.Cloth.grid(3, 3, size=0.2, pins={"edge": [2]}, pose=[1, 0, 1, 1, 0, 0.1, 0.2])
    bodies = [
        dc.RigidBody.plane(4.0, name="floor"),
        dc.RigidBody.box(0.2, motion="kinematic", pose=[0, 1, 1, 1, 0, 0, 0], name="box"),
    ]
    return dc.Scene([sheet, patch], bodies)


VERTICES = 16 + 9
FACES = 18 + 8
PINS = [0, 1, 15, 16 + 2]
SOFT_PINS = [5, 10]
DT = 0.01


@pytest.fixture(scope="module")
def sim():
    return dc.Simulator(make_scene(), DT)


def moved(sim, seed=0, batch_size=None):
    """A state in motion."""
    g = torch.Generator().manual_seed(seed)
    state = sim.initial_state(batch_size)
    noise = torch.randn(state.velocities.shape, dtype=F64, generator=g)
    return state.replace(velocities=0.05 * noise)


def same(a, b):
    return all(
        torch.equal(getattr(a, name), getattr(b, name))
        for name in ("positions", "velocities", "body_poses", "soft_pin_targets", "body_forces")
    )


def test_the_public_names_are_these():
    assert set(dc.__all__) == set(PUBLIC)
    for name, members in PUBLIC.items():
        for member in members.split():
            assert hasattr(getattr(dc, name), member), f"{name}.{member}"


@pytest.mark.parametrize("module", [dc, dc.robots], ids=lambda module: module.__name__)
def test_a_module_shows_its_public_names_alone(module):
    shown = [name for name in dir(module) if not name.startswith("__")]
    assert shown == sorted(module.__all__)
    assert {"__doc__", "__file__"} < set(dir(module))


def test_build_info_is_a_dict():
    assert isinstance(dc.build_info(), dict)


# --- Attributes of a simulator -------------------------------------------------------------------


def test_initial_state_has_the_shapes_of_the_scene(sim):
    state = sim.initial_state()
    assert state.positions.shape == state.velocities.shape == (VERTICES, 3)
    assert state.body_poses.shape == (2, 7)
    assert torch.equal(state.soft_pin_targets, state.positions[SOFT_PINS])
    assert state.body_forces.shape == (4 + 8, 3)
    assert state.time.shape == ()
    assert state.report is None
    batch = sim.initial_state(batch_size=3)
    assert batch.positions.shape == (3, VERTICES, 3)
    assert batch.time.shape == (3,)
    with pytest.raises(dc.InvalidInput, match="`batch_size` must be at least 1, got 0"):
        sim.initial_state(batch_size=0)


def test_states_and_parameters_are_new_each_time(sim):
    sim.initial_state().positions.add_(1)
    sim.default_parameters().stretch.add_(1)
    np.testing.assert_array_equal(
        sim.initial_state().positions[:16].numpy(), sim.scene.cloths[0].vertices
    )
    assert sim.default_parameters().stretch.item() == dc.Material().stretch


def test_slices_give_the_rows_of_each_surface(sim):
    assert sim.surfaces == ("sheet", "cloth1", "floor", "box")
    assert sim.slices == {
        "sheet": slice(0, 16),
        "cloth1": slice(16, 25),
        "floor": slice(0, 4),  # rows in body_forces
        "box": slice(4, 12),
    }
    assert sim.joint_slices == {}


def test_the_name_of_default_parameters_in_0_1_is_an_alias_that_warns(sim):
    with pytest.warns(FutureWarning, match="its name is `default_parameters` since") as caught:
        given = sim.parameters()
    assert caught[0].filename == __file__
    assert torch.equal(given.stretch, sim.default_parameters().stretch)


def test_parameters_are_as_small_as_the_scene_allows(sim):
    parameters = sim.default_parameters()
    assert parameters.stretch.shape == ()
    assert parameters.thickness.shape == (4,)
    assert parameters.pin_stiffness.item() == 1e4
    assert parameters.gravity.tolist() == [0, 0, -9.81]
    assert parameters.barrier_distance.shape == ()
    assert parameters.barrier_stiffness.shape == (4, 4)  # of two cloths that differ
    alone = dc.Simulator(dc.Scene(sim.scene.cloths[:1]), DT)
    assert alone.default_parameters().barrier_stiffness.shape == ()
    assert parameters.slip_velocity.item() == 1e-5
    mixed = dc.Scene(
        [
            dc.Cloth.grid(2, 2, material=dc.Material(stretch=1.0, bending=[1.0, 2.0])),
            dc.Cloth.grid(2, 2, material=dc.Material(stretch=2.0), pose=[0, 0, 1, 1, 0, 0, 0]),
        ]
    )
    parameters = dc.Simulator(mixed, DT).default_parameters()
    assert parameters.stretch.tolist() == [1, 2]
    assert parameters.bending.tolist() == [1, 2, 1e-5, 1e-5]


def test_friction_of_a_pair_is_the_geometric_mean():
    cloth = dc.Cloth.grid(3, 3, material=dc.Material(friction=0.2), pose=[0, 0, 1, 1, 0, 0, 0])
    scene = dc.Scene([cloth], [dc.RigidBody.plane(1.0, friction=0.8)])
    friction = dc.Simulator(scene, DT).default_parameters().friction
    torch.testing.assert_close(friction, torch.tensor([[0.2, 0.4], [0.4, 0.8]], dtype=F64))


def test_parameters_that_the_scene_lacks_are_none_and_refused():
    cloth = dc.Cloth.grid(3, 3, bending_model="hinge")
    sim = dc.Simulator(dc.Scene([cloth]), DT, contact=dc.ContactOptions(self_contact=False))
    parameters = sim.default_parameters()
    for name in ("friction", "thickness", "barrier_distance", "barrier_stiffness", "slip_velocity"):
        assert getattr(parameters, name) is None
    assert parameters.pin_stiffness is None
    assert parameters.poisson is None
    for name in ("stretch_weft", "stretch_shear", "bending_weft", "bending_twill"):
        assert getattr(parameters, name) is None
        with pytest.raises(dc.InvalidInput, match=f"^step: `parameters.{name}` must be None"):
            sim.step(sim.initial_state(), None, parameters.replace(**{name: 0.1}))
    with pytest.raises(dc.InvalidInput, match=r"^step: `parameters.friction` must be None"):
        sim.step(sim.initial_state(), None, parameters.replace(friction=0.1))


def test_the_default_barrier_follows_from_the_cloths_alone():
    cloth = dc.Cloth.grid(5, 5, pose=[0, 0, 1, 1, 0, 0, 0])
    alone = dc.Simulator(dc.Scene([cloth]), DT).default_parameters()
    floor = dc.Simulator(dc.Scene([cloth], [dc.RigidBody.plane(100.0)]), DT).default_parameters()
    assert torch.equal(alone.barrier_distance, floor.barrier_distance)
    # A tenth of the median edge: 0.25 m along the grid, of 56 edges only 16 are diagonal.
    assert alone.barrier_distance.item() == pytest.approx(0.025)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"dt": 0.0}, dc.InvalidInput, "`dt` must be finite and > 0, got 0"),
        ({"dt": torch.tensor(0.1, requires_grad=True)}, dc.InvalidInput, "no gradient"),
        ({"scheme": "fast"}, dc.InvalidInput, "'coupled', 'split', 'projective', got 'fast'"),
        ({"solver": dc.SolverOptions(metric="identity")}, dc.InvalidInput, "needs scheme 'split'"),
        (
            {"solver": dc.SolverOptions(elastic="projective")},
            dc.InvalidInput,
            "'split' or 'projective'; 'coupled' has none",
        ),
        ({"solver": dc.ContactOptions()}, TypeError, "`solver` must be a SolverOptions"),
        (
            {"contact": dc.ContactOptions(barrier_distance=0.2)},
            dc.InvalidInput,
            "below half the smallest distance .*got 0.2",
        ),
    ],
)
def test_a_bad_simulator_is_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        dc.Simulator(make_scene(), **{"dt": DT, **arguments})


# --- Checks of a step ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "convert"),
    [
        pytest.param("positions", lambda t: t.float(), id="float32"),
        pytest.param("velocities", lambda t: t.to("meta"), id="device"),
        pytest.param("body_poses", lambda t: t.numpy(), id="numpy"),
        pytest.param("soft_pin_targets", lambda t: t.tolist(), id="list"),
        pytest.param("positions", lambda t: t.to_sparse(), id="sparse"),
    ],
)
def test_state_tensors_must_be_float64_on_the_cpu(sim, field, convert):
    state = sim.initial_state()
    with pytest.raises(TypeError, match=rf"`state.{field}` must be a .*float64"):
        sim.step(state.replace(**{field: convert(getattr(state, field))}))


@pytest.mark.parametrize("field", ["positions", "velocities", "body_poses", "soft_pin_targets"])
def test_state_tensors_must_be_finite_and_of_their_shape(sim, field):
    state = sim.initial_state()
    bad = getattr(state, field).clone()
    bad[1, 2] = torch.nan
    with pytest.raises(dc.InvalidInput, match=rf"`state.{field}` .*got nan at \[1, 2\]"):
        sim.step(state.replace(**{field: bad}))
    with pytest.raises(dc.InvalidInput, match=rf"`state.{field}` must have shape"):
        sim.step(state.replace(**{field: bad[:-1]}))
    assert sim.step(state).report.converged  # the next valid call works


POSE = [0, 1, 1, 1, 0, 0, 0]


@pytest.mark.parametrize(
    ("field", "value", "error", "message"),
    [
        (
            "forces",
            torch.zeros(3, 3),
            dc.InvalidInput,
            r"^(step: `control\.|control: `)forces` must have shape \[25, 3\]",
        ),
        ("forces", torch.zeros(25, 3, device="meta"), TypeError, r"on the CPU, got meta"),
        ("forces", np.zeros((25, 3), complex), TypeError, "real numbers"),
        ("forces", [[np.nan] * 3] * 25, dc.InvalidInput, r"nan at \[0, 0\]"),
        (
            "pins",
            torch.zeros(3, 3),
            dc.InvalidInput,
            r"^(step: `control\.|control: `)pins` must have shape \[4, 3\]",
        ),
        ("pins", {"hem": [[0, 0, 0]]}, dc.InvalidInput, "'sheet/edge', .*'hem' is none of them"),
        ("pins", {"edge": [[0, 0, 0]]}, dc.InvalidInput, "'edge' is the name of several"),
        (
            "pins",
            {"corner": [0, 0, 0]},
            dc.InvalidInput,
            r"^(step: `control\.|control: `)pins\['corner'\]` .*\[1, 3\]",
        ),
        ("pins", {"corner": None}, dc.InvalidInput, "leave the name out"),
        (
            "pins",
            {"corner": [[0, 0, 0]], "sheet/corner": [[0, 0, 0]]},
            dc.InvalidInput,
            "once, got it twice",
        ),
        ("soft_pins", {"corner": [[0, 0, 0]]}, dc.InvalidInput, "'sheet/middle'"),
        ("body_poses", [POSE], dc.InvalidInput, r"\[2, 7\]"),
        ("body_poses", [POSE, [0] * 7], dc.InvalidInput, r"quaternion .* at \[1\]"),
    ],
)
def test_a_bad_control_is_refused(sim, field, value, error, message):
    with pytest.raises(error, match=message):
        sim.control(**{field: value})
    with pytest.raises(error, match=message):
        sim.step(sim.initial_state(), dc.Control(**{field: value}))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("stretch", 0.0, "> 0, got 0"),
        ("stretch", [1.0, -1.0], r"> 0, got -1 at \[1\]"),
        ("bending", -1.0, ">= 0"),
        ("poisson", 0.5, "between -1 and 0.5"),
        ("density", 0.0, "> 0"),
        ("damping", -1.0, ">= 0"),
        ("friction", -1.0, ">= 0"),
        ("friction", [0.1] * 4, r"\[\] or \[4, 4\]"),
        ("thickness", 0.0, r"shape \[4\]"),
        ("thickness", [0.0, 0.0, 0.0, -1.0], r">= 0, got -1 at \[3\]"),
        ("barrier_stiffness", 0.0, "> 0"),
        ("barrier_stiffness", [100.0] * 4, r"\[\] or \[4, 4\]"),
        ("barrier_distance", -1.0, "> 0"),
        ("barrier_distance", 1.0, "below half the smallest distance"),
        ("slip_velocity", 0.0, "> 0"),
        ("pin_stiffness", 0.0, "> 0"),
        ("gravity", [0.0, np.inf, 0.0], r"inf at \[1\]"),
        ("gravity", [0.0, 0.0], r"shape \[3\]"),
        ("rest_positions", np.zeros((3, 3)), r"shape \[25, 3\]"),
        ("stretch", [1.0] * 3, r"\[\] or \[2\] or \[25\] or \[26\]"),
    ],
)
def test_a_bad_parameter_is_refused(sim, field, value, message):
    parameters = sim.default_parameters().replace(**{field: value})
    with pytest.raises(dc.InvalidInput, match=message):
        sim.step(sim.initial_state(), None, parameters)


def test_unknown_fields_are_refused(sim):
    with pytest.raises(dc.InvalidInput, match=r"fields are stretch, .*got 'stiffness'"):
        sim.default_parameters().replace(stiffness=1.0)
    with pytest.raises(dc.InvalidInput, match=r"fields are pins, .*got 'force'"):
        sim.control().replace(force=1.0)


@pytest.mark.parametrize("argument", ["state", "control", "parameters"])
def test_arguments_of_another_class_are_refused(sim, argument):
    arguments = {"state": sim.initial_state(), argument: {}}
    with pytest.raises(TypeError, match=f"`{argument}` must be"):
        sim.step(**arguments)


def test_a_static_body_must_stay(sim):
    state = sim.initial_state()
    poses = state.body_poses.clone()
    poses[1, 0] += 1e-3
    assert torch.equal(sim.step(state, sim.control(body_poses=poses)).body_poses, poses)
    poses[0, 0] += 1e-3
    with pytest.raises(dc.InvalidInput, match=r"row \[0\].*static"):
        sim.step(state, sim.control(body_poses=poses))


def test_every_way_to_pass_numbers_gives_the_same_bits(sim):
    state = moved(sim)
    forces = torch.linspace(-1e-3, 1e-3, 3 * VERTICES).reshape(VERTICES, 3)  # float32
    expected = sim.step(state, sim.control(forces=forces.double()))
    noncontiguous = forces.double().t().contiguous().t()
    for value in (forces, forces.numpy(), forces.tolist(), noncontiguous):
        assert same(sim.step(state, dc.Control(forces=value)), expected)


def test_gradients_come_back_in_the_callers_dtype(sim):
    forces = torch.zeros(VERTICES, 3, dtype=torch.float32, requires_grad=True)
    gravity = torch.tensor([0, 0, -9.75], dtype=torch.bfloat16, requires_grad=True)
    parameters = sim.default_parameters().replace(gravity=gravity)
    sim.step(sim.initial_state(), dc.Control(forces=forces), parameters).positions.sum().backward()
    assert forces.grad.dtype == torch.float32
    assert gravity.grad.dtype == torch.bfloat16
    assert forces.grad[3].abs().max() > 0
    assert gravity.grad.abs().max() > 0


# --- Hold ----------------------------------------------------------------------------------------


def test_unset_controls_hold(sim):
    state = moved(sim)
    after = sim.step(state)
    assert torch.equal(after.positions[PINS], state.positions[PINS])
    assert torch.equal(after.body_poses, state.body_poses)
    assert torch.equal(after.soft_pin_targets, state.soft_pin_targets)
    explicit = sim.control(
        pins=state.positions[PINS],
        soft_pins=state.soft_pin_targets,
        body_poses=state.body_poses,
        forces=torch.zeros(VERTICES, 3),
    )
    assert same(sim.step(state, explicit), after)


def test_gradients_flow_to_held_inputs(sim):
    state = moved(sim)
    x = state.positions.clone().requires_grad_()
    q = state.soft_pin_targets.clone().requires_grad_()
    b = state.body_poses.clone().requires_grad_()
    after = sim.step(state.replace(positions=x, soft_pin_targets=q, body_poses=b))
    (pins,) = torch.autograd.grad(after.positions[PINS].sum(), x, retain_graph=True)
    torch.testing.assert_close(pins[PINS], torch.ones(4, 3, dtype=F64))
    (soft,) = torch.autograd.grad(after.positions.sum(), q, retain_graph=True)
    assert soft.abs().min() > 0
    (poses,) = torch.autograd.grad(after.body_poses.sum(), b)
    assert torch.equal(poses, torch.ones_like(b))


def test_named_pins_move_and_the_others_hold(sim):
    state = sim.initial_state()
    targets = state.positions[PINS].clone()
    targets[2] += 1e-3
    targets[3] -= 1e-3
    named = dc.Control(pins={"corner": targets[2:3], "cloth1/edge": targets[3:]})
    after = sim.step(state, named)
    assert torch.equal(after.positions[PINS], targets)
    assert same(after, sim.step(state, dc.Control(pins=targets)))
    soft = state.soft_pin_targets + 1e-3
    after = sim.step(state, dc.Control(soft_pins={"middle": soft}))
    assert torch.equal(after.soft_pin_targets, soft)


def test_time_advances(sim):
    state = sim.step(sim.step(sim.initial_state()))
    assert state.time.item() == pytest.approx(2 * DT)
    assert sim.step(sim.initial_state(2)).time.tolist() == [DT, DT]


# --- Batches -------------------------------------------------------------------------------------


def test_a_batch_gives_the_bits_of_its_environments(sim):
    states = [moved(sim, seed) for seed in range(3)]
    forces = 1e-3 * torch.randn(
        3, VERTICES, 3, dtype=F64, generator=torch.Generator().manual_seed(0)
    )
    stretch = torch.tensor([500.0, 550.0, 600.0], dtype=F64)
    parameters = sim.default_parameters()
    batch = sim.step(
        dc.stack(states), dc.Control(forces=forces), parameters.replace(stretch=stretch)
    )
    for i, state in enumerate(states):
        single = parameters.replace(stretch=stretch[i])
        assert same(batch[i], sim.step(state, dc.Control(forces=forces[i]), single))


def test_the_number_of_threads_changes_no_bit(sim):
    state = dc.stack([moved(sim, seed) for seed in range(3)])
    results = []
    for count in (1, 2, 4):
        with threads(count):
            results.append(sim.step(state))
    assert same(results[0], results[1])
    assert same(results[0], results[2])


def test_shared_inputs_get_the_sum_of_the_gradients(sim):
    states = [moved(sim, seed) for seed in range(2)]

    def gradients(state):
        forces = torch.zeros(VERTICES, 3, dtype=F64, requires_grad=True)
        gravity = torch.tensor([0, 0, -9.81], dtype=F64, requires_grad=True)
        pins = states[0].positions[PINS[2:3]].clone().requires_grad_()
        control = dc.Control(forces=forces, pins={"corner": pins})
        after = sim.step(state, control, sim.default_parameters().replace(gravity=gravity))
        (after.positions**2).sum().backward()
        return forces.grad, gravity.grad, pins.grad

    parts = [gradients(state) for state in states]
    for total, *terms in zip(gradients(dc.stack(states)), *parts, strict=True):
        torch.testing.assert_close(total, sum(terms))


def test_batched_inputs_of_a_single_state_are_refused(sim):
    state = sim.initial_state()
    with pytest.raises(dc.InvalidInput, match=r"batch axis.*batch_size"):
        sim.step(state, dc.Control(forces=torch.zeros(2, VERTICES, 3)))
    with pytest.raises(dc.InvalidInput, match=r"batch.*batch_size"):
        sim.step(state, None, sim.default_parameters().replace(gravity=torch.zeros(2, 3)))
    with pytest.raises(dc.InvalidInput, match="2 environments, as the state, got"):
        sim.step(sim.initial_state(2), dc.Control(forces=torch.zeros(3, VERTICES, 3)))


def test_values_per_environment_or_per_cloth_must_be_distinguishable(sim):
    state, parameters = sim.initial_state(2), sim.default_parameters()
    with pytest.raises(
        dc.InvalidInput, match=r"^step: `parameters\.stretch` of shape \[2\] could .*\[2, 2\]"
    ):
        sim.step(state, None, parameters.replace(stretch=[500.0, 600.0]))
    per_cloth = torch.tensor([500.0, 600.0], dtype=F64)
    sim.step(state, None, parameters.replace(stretch=per_cloth.expand(2, 2)))
    sim.step(sim.initial_state(3), None, parameters.replace(stretch=per_cloth))
    sim.step(sim.initial_state(3), None, parameters.replace(stretch=[1.0, 2.0, 3.0]))
    sim.step(sim.initial_state(FACES), None, parameters.replace(stretch=500.0))


def test_a_value_of_one_environment_and_one_cloth_is_both():
    sheet = dc.Cloth(np.eye(3), [[0, 1, 2]], name="sheet")  # of one face
    sim = dc.Simulator(dc.Scene([sheet]), DT)
    heavy = torch.tensor([0.7], dtype=F64)
    ends = [
        sim.step(sim.initial_state(1), None, dc.Parameters(density=density))
        for density in (0.7, heavy, heavy[None], {"sheet": heavy}, {"sheet": heavy[None]})
    ]
    assert all(same(ends[0], end) for end in ends[1:])


def test_the_simulators_own_parameters_are_never_ambiguous():
    cloths = [
        dc.Cloth.grid(2, 2, material=dc.Material(stretch=s), pose=[0, 0, s, 1, 0, 0, 0])
        for s in (1.0, 2.0)
    ]
    sim = dc.Simulator(dc.Scene(cloths), DT)
    parameters = sim.default_parameters()
    assert parameters.stretch.shape == (2,)
    batch = sim.step(sim.initial_state(2), None, parameters.replace(density=0.2))
    assert same(batch[1], sim.step(sim.initial_state(), None, parameters.replace(density=0.2)))
    with pytest.raises(dc.InvalidInput, match="could mean"):
        sim.step(sim.initial_state(2), None, parameters.replace(stretch=parameters.stretch))


def test_reports_are_numbers_or_tensors(sim):
    single = sim.step(moved(sim)).report
    assert single.converged is True
    assert isinstance(single.iterations, int)
    assert isinstance(single.residual, float)
    assert isinstance(single.contact_count, int)
    assert single.motion_fraction == 1.0
    assert all(isinstance(seconds, float) for seconds in single.seconds.values())
    assert single.status == "converged"
    batch = sim.step(moved(sim, batch_size=2)).report
    assert batch.converged.tolist() == [True, True]
    assert batch.residual.shape == batch.minimum_distance.shape == (2,)
    assert all(seconds.shape == (2,) for seconds in batch.seconds.values())
    assert batch.status == ("converged", "converged")


# --- Purity --------------------------------------------------------------------------------------


def test_a_step_changes_nothing_and_repeats_its_bits(sim):
    state = moved(sim)
    control = sim.control(forces=torch.ones(VERTICES, 3, dtype=F64) * 1e-4)
    before = copy.deepcopy((state, control))
    first = sim.step(state, control)
    sim.step(moved(sim, 7))
    assert same(sim.step(state, control), first)
    assert same(state, before[0])
    assert torch.equal(control.forces, before[1].forces)


def storages(*tensors):
    return {t.untyped_storage().data_ptr() for t in tensors if t.numel()}


@pytest.mark.parametrize("gradient", [False, True])
def test_outputs_share_no_storage_with_inputs_or_each_other(sim, gradient):
    state = moved(sim)
    x = state.positions.clone().requires_grad_(gradient)
    state = state.replace(positions=x)
    poses, pins = state.body_poses.clone(), state.positions[PINS].detach().clone()
    targets = state.soft_pin_targets.clone()
    control = dc.Control(body_poses=poses, pins=pins, soft_pins=targets)
    after = sim.step(state, control)
    names = ("positions", "velocities", "body_poses", "soft_pin_targets", "body_forces", "time")
    outputs = [getattr(after, name) for name in names]
    inputs = [getattr(state, name) for name in names]
    assert len(storages(*outputs)) == len(outputs)
    assert not storages(*outputs) & storages(*inputs, poses, pins, targets)


def test_editing_the_outputs_does_not_change_the_gradient(sim):
    x = moved(sim).positions.requires_grad_()

    def gradient(edit):
        after = sim.step(moved(sim).replace(positions=x))
        loss = (after.positions**2).sum() + (after.velocities**2).sum()
        if edit:
            with torch.no_grad():
                for tensor in (after.body_poses, after.body_forces, after.soft_pin_targets):
                    tensor.zero_()
        return torch.autograd.grad(loss, x)[0]

    assert torch.equal(gradient(True), gradient(False))


@pytest.mark.parametrize("field", ["velocities", "forces", "gravity"])
def test_an_input_edited_in_place_makes_backward_raise(sim, field):
    state = moved(sim)
    velocities = state.velocities.clone()
    forces = torch.zeros(VERTICES, 3, dtype=F64)
    parameters = sim.default_parameters()
    x = state.positions.clone().requires_grad_()
    after = sim.step(
        state.replace(positions=x, velocities=velocities), dc.Control(forces=forces), parameters
    )
    {"velocities": velocities, "forces": forces, "gravity": parameters.gravity}[field].add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        after.positions.sum().backward()


def test_ignored_fields_may_carry_a_graph(sim):
    state = moved(sim)
    graph = torch.ones(12, 3, dtype=F64, requires_grad=True) * 2
    expected = sim.step(state)
    after = sim.step(state.replace(body_forces=graph, report=None))
    assert same(after, expected)
    assert not after.positions.requires_grad


# --- Autograd ------------------------------------------------------------------------------------


def differentiable(sim, batch_size=None):
    """All differentiable inputs, as leaves."""
    state = moved(sim, batch_size=batch_size)
    leaf = {
        name: getattr(state, name).clone().requires_grad_()
        for name in ("positions", "velocities", "body_poses")  # the control sets the soft pins
    }
    control = {
        "pins": state.positions[..., PINS, :].clone().requires_grad_(),
        "soft_pins": state.soft_pin_targets.clone().requires_grad_(),
        "body_poses": state.body_poses.clone().requires_grad_(),
        "forces": torch.zeros_like(state.positions).requires_grad_(),
    }
    parameters = {
        name: tensor.requires_grad_()
        for name, tensor in vars(sim.default_parameters()).items()
        if isinstance(tensor, torch.Tensor)
    }
    return state, leaf, control, parameters


@pytest.mark.parametrize("batch_size", [None, 2])
def test_a_single_leaf_gets_the_gradient_of_all_leaves(sim, batch_size):
    state, leaf, control, parameters = differentiable(sim, batch_size)

    def loss(leaf, control, parameters):
        after = sim.step(
            state.replace(**leaf),
            dc.Control(**control),
            sim.default_parameters().replace(**parameters),
        )
        return (after.positions**2).sum() + (after.velocities**2).sum() + after.body_forces.sum()

    groups = (leaf, control, parameters)
    leaves = [t for group in groups for t in group.values()]
    together = torch.autograd.grad(loss(*groups), leaves)
    k = 0
    for g, group in enumerate(groups):
        for name, tensor in group.items():
            constant = [{n: t.detach() for n, t in other.items()} for other in groups]
            constant[g][name] = tensor
            (alone,) = torch.autograd.grad(loss(*constant), tensor)
            assert alone.shape == tensor.shape
            assert torch.equal(alone, together[k]), name
            k += 1


def test_no_graph_is_made_where_none_is_wanted(sim):
    state = moved(sim)
    assert not sim.step(state).positions.requires_grad
    with torch.no_grad():
        x = state.positions.clone().requires_grad_()
        assert not sim.step(state.replace(positions=x)).positions.requires_grad


def test_the_result_does_not_depend_on_the_tape(sim):
    state = moved(sim)
    x = state.positions.clone().requires_grad_()
    assert same(sim.step(state.replace(positions=x)), sim.step(state))


def test_backward_frees_the_tape_unless_it_is_retained(sim):
    state = moved(sim)
    x = state.positions.clone().requires_grad_()
    total = sim.step(state.replace(positions=x)).positions.sum()
    (first,) = torch.autograd.grad(total, x, retain_graph=True)
    (second,) = torch.autograd.grad(total, x)
    assert torch.equal(first, second)
    with pytest.raises(RuntimeError, match="second time"):
        torch.autograd.grad(total, x)


def tensor_bytes():
    gc.collect()
    pointers = {
        o.untyped_storage().data_ptr(): o.untyped_storage().nbytes()
        for o in gc.get_objects()
        # torch 2.4 leaves tensors about that are not defined.
        if type(o) is torch.Tensor and torch._C._has_storage(o)
    }
    return sum(pointers.values())


def test_steps_with_backward_do_not_grow(sim):
    state = moved(sim)
    x = state.positions.clone().requires_grad_()
    sizes = []
    for _ in range(3):
        sim.step(state.replace(positions=x)).positions.sum().backward()
        sizes.append(tensor_bytes())
    assert sizes[1] == sizes[2]


@pytest.mark.parametrize("function", [torch.sum, lambda x: (x**2).sum()], ids=["sum", "square"])
def test_second_derivatives_are_refused(sim, function):
    """This includes cotangents without a graph, as of a sum."""
    state = moved(sim)
    x = state.positions.clone().requires_grad_()
    total = function(sim.step(state.replace(positions=x)).positions)
    (gradient,) = torch.autograd.grad(total, x, create_graph=True)
    assert gradient.requires_grad
    with pytest.raises(RuntimeError, match=r"second derivatives of \w+ are not available"):
        torch.autograd.grad((gradient**2).sum(), x)


def test_energy_has_a_value_and_a_gradient_per_environment(sim):
    state = moved(sim)
    single = sim.energy(state)
    assert single.shape == ()
    x = state.positions.clone().requires_grad_()
    start = sim.initial_state()
    batch = sim.energy(dc.stack([state.replace(positions=x), start]))
    assert torch.equal(batch[0], single)
    for energy, has_gradient in zip(batch, (True, False), strict=True):
        (gradient,) = torch.autograd.grad(energy, x, retain_graph=True)
        assert bool(gradient.any()) == has_gradient
    with torch.no_grad():
        assert torch.equal(sim.energy(state.replace(positions=x)), single)


# --- Errors --------------------------------------------------------------------------------------


def overlapping_cloth():
    return dc.Cloth.grid(4, 4, size=0.5, pose=[0, 0, 0.05, 1, 0.05, 0, 0])


def test_a_scene_that_overlaps_is_refused():
    box = dc.RigidBody.box(0.2, name="cube")
    with pytest.raises(dc.IntersectingState, match="Simulator: ") as caught:
        dc.Simulator(dc.Scene([overlapping_cloth()], [box]), DT)
    assert caught.value.environments == (0,)
    assert caught.value.report is None


def test_a_state_that_intersects_raises_for_its_environments(sim):
    state = sim.initial_state(3)
    poses = state.body_poses.clone()
    poses[1, 1, :3] = torch.tensor([0.0, 0.0, 1.0])  # the box inside the sheet
    with pytest.raises(dc.IntersectingState, match=r"environments \[1\]") as caught:
        sim.step(state.replace(body_poses=poses))
    assert caught.value.environments == (1,)
    assert caught.value.report.converged.shape == (3,)
    assert pickle.loads(pickle.dumps(caught.value)).environments == (1,)


def pinned_over_a_box(**solver):
    cloth = dc.Cloth.grid(4, 4, size=0.5, pins={"all": range(16)}, pose=[0, 0, 0.5, 1, 0.05, 0, 0])
    scene = dc.Scene([cloth], [dc.RigidBody.box(0.2)])
    return dc.Simulator(scene, DT, solver=dc.SolverOptions(**solver))


def test_a_motion_that_is_blocked_raises_and_can_be_retried():
    sim = pinned_over_a_box()
    state = sim.initial_state()
    down = state.positions - torch.tensor([0, 0, 0.5], dtype=F64)
    with pytest.raises(dc.InfeasibleMotion) as caught:
        sim.step(state, dc.Control(pins=down))
    assert caught.value.report.motion_fraction < 1
    assert torch.equal(state.positions, sim.initial_state().positions)
    nearer = state.positions - torch.tensor([0, 0, 0.01], dtype=F64)
    assert sim.step(state, dc.Control(pins=nearer)).report.converged


def hard_step(throw):
    sim = dc.Simulator(
        make_scene(), DT, solver=dc.SolverOptions(max_iterations=1, tolerance=1e-12, throw=throw)
    )
    state = sim.initial_state()
    noise = torch.randn(
        state.velocities.shape, dtype=F64, generator=torch.Generator().manual_seed(1)
    )
    return sim, state.replace(velocities=noise)


def test_a_step_that_does_not_converge_raises():
    sim, state = hard_step(throw=True)
    with pytest.raises(dc.NotConverged, match="max_iterations") as caught:
        sim.step(state)
    assert caught.value.report.converged is False
    assert isinstance(caught.value, dc.SimulationError)


def test_a_step_that_does_not_converge_may_pass_but_has_no_gradient():
    sim, state = hard_step(throw=False)
    x = state.positions.clone().requires_grad_()
    after = sim.step(state.replace(positions=x))
    assert after.report.converged is False
    with pytest.raises(dc.NotConverged, match="no gradient"):
        after.positions.sum().backward()


# --- Rollouts ------------------------------------------------------------------------------------


def controls_for(sim, count):
    x = sim.initial_state().positions[PINS]
    return [None if k == 1 else dc.Control(pins=x + 1e-3 * k) for k in range(count)]


def test_a_rollout_is_its_steps(sim):
    state = moved(sim)
    controls = controls_for(sim, 3)
    states = sim.rollout(state, controls)
    assert len(states) == 3
    for k, control in enumerate(controls):
        state = sim.step(state, control)
        assert same(state, states[k])
    called = sim.rollout(moved(sim), lambda k, state: controls[k], steps=3)
    assert same(called[-1], states[-1])
    held = sim.rollout(moved(sim), steps=2)
    assert same(held[1], sim.step(sim.step(moved(sim))))


@pytest.mark.parametrize("every", [1, 2, 5])
@pytest.mark.parametrize("callable_controls", [False, True])
def test_checkpoints_change_no_bit(sim, every, callable_controls):
    def run(checkpoint_every):
        state = moved(sim)
        x = state.positions.clone().requires_grad_()
        gravity = torch.tensor([0, 0, -9.81], dtype=F64, requires_grad=True)
        controls = controls_for(sim, 5)
        given = (lambda k, _: controls[k]) if callable_controls else controls
        states = sim.rollout(
            state.replace(positions=x),
            given,
            sim.default_parameters().replace(gravity=gravity),
            steps=5,
            checkpoint_every=checkpoint_every,
        )
        sum((s.positions**2).sum() for s in states).backward()
        return states, x.grad, gravity.grad

    states, x, gravity = run(None)
    again, x_again, gravity_again = run(every)
    assert all(same(a, b) for a, b in zip(states, again, strict=True))
    assert torch.equal(x, x_again)
    assert torch.equal(gravity, gravity_again)


def test_arrays_may_be_used_again_behind_a_checkpoint(sim):
    """A rollout copies inputs that are no tensors: its steps are repeated unchanged."""
    gradients = []
    for edited in (False, True):
        x = moved(sim).positions.requires_grad_()
        forces = np.full((VERTICES, 3), 1e-3)
        states = sim.rollout(
            moved(sim).replace(positions=x), [dc.Control(forces=forces)] * 2, checkpoint_every=1
        )
        if edited:
            forces[:] = 0.1
        states[-1].positions.square().sum().backward()
        gradients.append(x.grad)
    assert torch.equal(*gradients)


def test_an_edit_in_place_is_noticed_behind_a_checkpoint(sim):
    x = moved(sim).positions.requires_grad_()
    gravity = torch.tensor([0, 0, -9.81], dtype=F64)
    parameters = sim.default_parameters().replace(gravity=gravity)
    states = sim.rollout(
        moved(sim).replace(positions=x), None, parameters, steps=2, checkpoint_every=1
    )
    gravity.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        states[-1].positions.sum().backward()


@pytest.mark.parametrize(
    ("keywords", "error", "message"),
    [
        ({}, dc.InvalidInput, "`steps` must be given"),
        ({"controls": [None], "steps": 2}, dc.InvalidInput, "number of controls, 1, got 2"),
        ({"controls": 3, "steps": 2}, TypeError, "got int"),
        ({"steps": -1}, dc.InvalidInput, "at least 0, got -1"),
        ({"steps": 2, "checkpoint_every": 0}, dc.InvalidInput, "at least 1, got 0"),
    ],
)
def test_a_bad_rollout_is_refused(sim, keywords, error, message):
    with pytest.raises(error, match=message):
        sim.rollout(sim.initial_state(), **keywords)


# --- Saving and threads --------------------------------------------------------------------------


def test_a_saved_state_continues_with_the_same_bits(sim):
    state = sim.step(moved(sim))
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    again = torch.load(file, weights_only=True)
    assert again.report.iterations == state.report.iterations
    assert same(sim.step(again), sim.step(state))


def test_a_simulator_pickles_as_its_arguments():
    contact = dc.ContactOptions(friction_iterations=1)
    sim = dc.Simulator(make_scene(), DT, scheme="split", contact=contact)
    again = pickle.loads(pickle.dumps(sim))
    assert (again.dt, again.scheme) == (DT, "split")
    assert again.contact.barrier_distance is None
    assert same(again.step(moved(sim)), sim.step(moved(sim)))


def test_eight_threads_share_a_simulator(sim):
    states = [moved(sim, seed) for seed in range(8)]

    def gradient(state):
        x = state.positions.clone().requires_grad_()
        after = sim.step(state.replace(positions=x))
        return after, torch.autograd.grad((after.positions**2).sum(), x)[0]

    expected = [gradient(state) for state in states]
    with ThreadPoolExecutor(8) as pool:
        results = list(pool.map(gradient, states))
    for (after, x_bar), (after_again, x_bar_again) in zip(expected, results, strict=True):
        assert same(after, after_again)
        assert torch.equal(x_bar, x_bar_again)


def test_parameters_survive_torch_save(tmp_path):
    torch.save(dc.Parameters(stretch=torch.tensor(1.0)), tmp_path / "p.pt")
    assert torch.load(tmp_path / "p.pt").stretch == 1


def test_float32_poses_keep_a_static_body_where_it_is():
    floor = dc.RigidBody.plane(2, pose=[0, 0, -0.1, 1, 0, 0, 0])
    box = dc.RigidBody.box(0.1, motion="kinematic", pose=[0, 0, 1.1, 1, 0, 0, 0])
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(3, 3)], [floor, box]), 0.01)
    state = sim.initial_state()
    after = sim.step(state, sim.control(body_poses=state.body_poses.float()))
    assert torch.equal(after.body_poses[0], state.body_poses[0])
    with pytest.raises(dc.InvalidInput, match="static"):
        sim.step(state, sim.control(body_poses=state.body_poses + 1e-3))


@pytest.mark.parametrize(
    ("time", "error"),
    [
        pytest.param(0.5, TypeError, id="number"),
        pytest.param(torch.tensor(1.0), TypeError, id="float32"),
        pytest.param(torch.zeros(5, dtype=torch.float64), dc.InvalidInput, id="shape"),
    ],
)
def test_the_time_of_a_state_is_checked(time, error):
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(3, 3)]), 0.01)
    with pytest.raises(error, match="time"):
        sim.step(sim.initial_state().replace(time=time))


@pytest.mark.parametrize("content", [b"solid a\nendsolid a\n", bytes(84)], ids=["ascii", "binary"])
def test_an_stl_file_without_triangles_is_refused(content, tmp_path):
    path = tmp_path / "empty.stl"
    path.write_bytes(content)
    with pytest.raises(dc.InvalidInput, match="not a readable STL"):
        dc.RigidBody.load(path)
