"""The border to C++: the core reads arrays by expected sizes, and must refuse other sizes."""

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch import _core
from diffcloth_torch.autograd.core_function import as_array
from diffcloth_torch.sim.solve import cores
from diffcloth_torch.sim.solve.step import _OUTPUTS, diagnostics_of

F64 = torch.float64
REFUSED = (ValueError, TypeError, RuntimeError, KeyError)


def make():
    """A scene that has every input and a tape with contacts."""
    cloth = dc.Cloth.grid(
        *(4, 4),
        pins={"a": [0]},
        soft_pins={"b": [15]},
        pose=[0, 0, 0.04, 1, 0, 0, 0],
        material=dc.fabrics.material("denim"),
    )
    box = dc.RigidBody.box(0.2, motion="dynamic", mass=1.0, pose=[0, 0, -0.2, 1, 0, 0, 0])
    hand = dc.Robot.load(dc.robots.GRIPPER, pose=[0, 0, 3, 1, 0, 0, 0], stiffness=1.0, damping=1.0)
    picker = dc.Attachment(("cloth0", 5), stiffness=10.0)
    return dc.Simulator(dc.Scene([cloth], [box], [hand], attachments=[picker]), 0.01)


@pytest.fixture(scope="module")
def sim():
    return make()


@pytest.fixture(scope="module")
def inputs(sim):
    parameters = sim.default_parameters()
    stretched = parameters.replace(rest_positions=1.01 * parameters.rest_positions)
    tensors, _ = sim._inputs(sim.initial_state(), None, stretched)
    tensors["friction_origins"] = sim._engine.surfaces.vertices(vars(sim.initial_state()))[None]
    assert set(tensors) == set(_core.input_names)
    return {name: as_array(tensor) for name, tensor in tensors.items()}


@pytest.fixture(scope="module")
def forward(sim, inputs):
    return sim._core.forward(inputs, True, 1)


def backward(sim, inputs, out, **changes):
    arguments = {
        "inputs": inputs,
        "tape": {name: array for name, array in out.items() if name.startswith("tape_")},
        "kept": out["kept"],
        "cotangents": {name: np.ones_like(out[name]) for name in _OUTPUTS},
        "losses": 1,
        "needs": list(inputs),
    }
    return sim._core.backward(*(arguments | changes).values(), 1)


PARTS = ("stretch", "bending", "attachments", "soft_pins", "contact")


def energy_backward(sim, inputs, **changes):
    arguments = {
        "cotangents": dict.fromkeys(PARTS, np.ones(1)),
        "losses": 1,
        "needs": list(inputs),
    }
    return sim._core.energy_backward(inputs, *(arguments | changes).values(), 1)


def test_the_inputs_are_good_ones(sim, inputs, forward):
    assert diagnostics_of(forward)["status"] == [0]
    gradients = backward(sim, inputs, forward)
    shapes = {name: (1, *a.shape) for name, a in inputs.items()}
    assert {name: a.shape for name, a in gradients.items()} == shapes
    assert {name: a.shape for name, a in energy_backward(sim, inputs).items()} == shapes


def wrong(array):
    """Arrays of wrong sizes: shorter, longer or with other rows."""
    flat = array.reshape(len(array), -1)
    return {
        "a number less": flat[:, :-1].copy(),
        "a number more": np.concatenate([flat, flat[:, :1]], axis=1),
        "twice": np.concatenate([flat, flat], axis=1),
        "no row": array[:0].copy(),
        "three rows": np.concatenate([array] * 3),
        "no axis": np.array(1.0),
    }


KINDS = list(wrong(np.zeros((1, 2))))
OPTIONAL = {
    *("poisson", "rest_positions", "barrier_stiffness", "friction_origins"),
    "joint_terms",
}
WOVEN = {
    "stretch_weft": "stretch_shear",
    "stretch_shear": "stretch_weft",
    "bending_weft": "bending_twill",
    "bending_twill": "bending_weft",
}


@pytest.mark.boundary
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", _core.input_names)
def test_an_input_of_another_size_is_refused(sim, inputs, forward, name, kind):
    bad = inputs | {name: wrong(inputs[name])[kind]}
    # Three rows of positions are a batch of three environments that share the other inputs.
    batch = name == "positions" and kind == "three rows"
    calls = [
        lambda: sim._core.forward(bad, True, 1),
        lambda: sim._core.stored_energy(bad),
        lambda: energy_backward(sim, bad),
        lambda: sim._core.find_overlap(bad),
        lambda: sim._core.find_throws(bad, 1),
        lambda: sim._core.path(bad),
        lambda: sim._core.default_barrier_stiffness(bad, 0.01),
        lambda: sim._core.reference_factorization_seconds(bad, 1),
    ]
    for call in calls if not batch else []:
        with pytest.raises(ValueError, match=f"core: `{name}`"):
            call()
    with pytest.raises(ValueError, match="core: "):
        backward(sim, bad, forward)


@pytest.mark.boundary
@pytest.mark.parametrize("name", WOVEN)
def test_inputs_of_woven_cloth_go_in_pairs_where_there_are_axes(sim, inputs, name):
    pair = {name, WOVEN[name]}
    both = {key: array for key, array in inputs.items() if key not in pair}
    sim._core.forward(both, False, 1)
    alone = both | {name: inputs[name]}
    with pytest.raises(ValueError, match=rf"core: `{name}`|core: .*`{name}` must be given togeth"):
        sim._core.forward(alone, False, 1)
    plain = dc.Simulator(dc.Scene([dc.Cloth.grid(4, 4)]), 0.01)
    tensors, _ = plain._inputs(plain.initial_state(), None, None)
    given = {k: as_array(t) for k, t in tensors.items()} | {k: np.ones((1, 1)) for k in pair}
    with pytest.raises(ValueError, match=r"core: .* need a scene with `material_axes`"):
        plain._core.forward(given, False, 1)


@pytest.mark.boundary
@pytest.mark.parametrize("name", [n for n in _core.input_names if n not in OPTIONAL | set(WOVEN)])
def test_an_input_that_is_not_there_is_refused(sim, inputs, name):
    without = {key: array for key, array in inputs.items() if key != name}
    with pytest.raises(ValueError, match=f"core: `{name}`"):
        sim._core.forward(without, False, 1)


@pytest.mark.boundary
@pytest.mark.parametrize("scheme", ["coupled", "split"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_tape_or_cotangent_of_another_size_is_refused(scheme, kind):
    sim = make()
    if scheme == "split":  # the scheme supports no dynamic bodies
        sim = dc.Simulator(dc.Scene([dc.Cloth.grid(4, 4)]), 0.01, scheme="split")
    tensors, _ = sim._inputs(sim.initial_state(), None, None)
    inputs = {name: as_array(tensor) for name, tensor in tensors.items()}
    out = sim._core.forward(inputs, True, 1)
    names = [n for n in _OUTPUTS if n in out]
    tape = {name: array for name, array in out.items() if name.startswith("tape_")}
    cotangents = {name: np.ones_like(out[name]) for name in names}
    for table, key in ((tape, "tape"), (cotangents, "cotangents")):
        for name, array in table.items():
            bad = wrong(array)[kind]
            if bad.size == array.size:
                continue
            arguments = {"tape": tape, "kept": out["kept"], "cotangents": cotangents}
            arguments |= {key: table | {name: bad}}
            with pytest.raises(ValueError, match=f"core: `{name}` must have"):
                sim._core.backward(inputs, *arguments.values(), 1, list(inputs), 1)
            without = {other: a for other, a in table.items() if other != name}
            with pytest.raises(KeyError):
                sim._core.backward(
                    inputs, *(arguments | {key: without}).values(), 1, list(inputs), 1
                )


@pytest.mark.boundary
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("part", PARTS)
def test_a_cotangent_of_an_energy_of_another_size_is_refused(sim, inputs, part, kind):
    cotangents = dict.fromkeys(PARTS, np.ones(1))
    bad = wrong(np.ones((1, 1)))[kind]
    if bad.size != 1:
        with pytest.raises(ValueError, match=f"core: `{part}` must have"):
            energy_backward(sim, inputs, cotangents=cotangents | {part: bad})
    del cotangents[part]
    with pytest.raises(IndexError, match=f"no array '{part}'"):
        energy_backward(sim, inputs, cotangents=cotangents)
    with pytest.raises(ValueError, match="unknown input"):
        energy_backward(sim, inputs, needs=["nothing"])


@pytest.mark.boundary
@pytest.mark.parametrize("value", [-1.0, 0.0, 0.5, 3.0, 1e300, np.nan, np.inf])
def test_a_tape_of_more_or_fewer_solves_than_there_are_is_refused(sim, inputs, forward, value):
    tape = {name: array for name, array in forward.items() if name.startswith("tape_")}
    tape["tape_solves"] = np.full_like(tape["tape_solves"], value)
    with pytest.raises(ValueError, match="core: the tape must"):
        backward(sim, inputs, forward, tape=tape)


@pytest.mark.boundary
@pytest.mark.parametrize("operation", ["step", "energy"])
@pytest.mark.parametrize("change", ["shape", "dtype", "nan"])
def test_hooks_on_saved_tensors_cannot_reach_the_core_with_something_else(sim, change, operation):
    def unpack(tensor):
        if change == "shape":
            return tensor[..., :1] if tensor.dim() else tensor
        return tensor.float() if change == "dtype" else torch.full_like(tensor, torch.nan)

    state = sim.initial_state()
    x = state.positions.clone().requires_grad_()
    with torch.autograd.graph.saved_tensors_hooks(lambda t: t, unpack):
        moved = state.replace(positions=x)
        loss = sim.step(moved).positions.sum() if operation == "step" else sim.energy(moved)
        error, message = {
            "shape": (dc.InvalidInput, "backward: saved `.*` must come back with shape"),
            "dtype": (TypeError, "backward: saved `.*` must come back as a dense float64 tensor"),
            "nan": (dc.InvalidInput, "backward: core: .* must be finite"),
        }[change]
        with pytest.raises(error, match=message):
            loss.backward()
    assert sim.step(state).report.converged


# --- Checks at the start of each step ------------------------------------------------------------


@pytest.mark.parametrize("at", [0, 3, 10])
@pytest.mark.parametrize(
    ("value", "is_within"),
    [(2.0, True), (-2.0, True), (2.1, False), (-2.1, False)]
    + [(value, False) for value in (np.nan, np.inf, -np.inf)],
)
def test_numbers_are_within_a_size(value, at, is_within):
    numbers = np.ones(11)
    numbers[at] = value
    assert _core.are_within([np.ones(3), numbers], 2.0) is is_within
    assert _core.are_within([np.repeat(numbers, 2)[::2]], 2.0) is is_within
    assert _core.are_within([], 2.0)


@pytest.mark.parametrize("shape", [(7,), (3, 7), (2, 3, 7)])
@pytest.mark.parametrize("entry", range(3, 7))
def test_quaternions_have_a_length(shape, entry):
    poses = np.zeros(shape)
    poses[..., entry] = -0.5
    assert _core.have_quaternions(poses, 0.49)
    assert not _core.have_quaternions(poses, 0.5)
    poses[..., :3] = 1.0  # positions do not count
    poses.reshape(-1, 7)[-1, entry] = 0.4
    assert not _core.have_quaternions(poses, 0.49)


# --- Arguments of a core -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def arguments():
    """Arguments that the package passes to the core for the scene."""
    taken = {}

    class Spy:
        def __init__(self, **keywords):
            taken.update(keywords)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cores._core, "Simulator", Spy)
        with pytest.raises(AttributeError):  # the spy can do nothing else
            make()
    return taken


INDICES = [
    "faces",
    "rest_faces",
    "cloth_vertex_start",
    "cloth_face_start",
    "pins",
    "soft_pins",
    "body_faces",
    "body_vertex_start",
    "link_tree",
    "link_parent",
    "link_kind",
    "link_coordinate",
    "surface_link",
]
ARRAYS = [
    *INDICES,
    "vertices",
    "rest_positions",
    "rest_embedding",
    "body_vertices",
    "coordinate_lower",
    "limit_stiffness",
    "velocity_stiffness",
    "velocity_force",
    "link_offset",
    "link_axis",
    "link_constant",
    "coordinate_prescribed",
    "coordinate_held",
    "tree_free",
]


def test_the_arguments_are_good_ones(arguments):
    assert _core.Simulator(**arguments).smallest_nonadjacent_distance() > 0


@pytest.mark.boundary
@pytest.mark.parametrize("value", [-2, 10**6, 2**31 - 1, -(2**31)])
@pytest.mark.parametrize("name", INDICES)
def test_an_index_out_of_range_is_refused(arguments, name, value):
    for place in (0, -1):
        bad = arguments[name].copy()
        bad.reshape(-1)[place] = value
        with pytest.raises(REFUSED, match=r"core: |trees: |topology: "):
            _core.Simulator(**(arguments | {name: bad}))


@pytest.mark.boundary
@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_of_another_length_is_refused(arguments, name):
    array = arguments[name]
    for bad in (array.reshape(-1)[:-1], np.concatenate([array.reshape(-1)] * 2)):
        rows_of_three = name in ("body_faces", "rest_positions") and len(bad) % 3 == 0
        if name in ("pins", "soft_pins") or rows_of_three:
            continue  # any number is valid; rest vertices may belong to no face
        with pytest.raises(REFUSED, match=r"core: |trees: |topology: "):
            _core.Simulator(**(arguments | {name: bad}))


@pytest.mark.boundary
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("dt", 0.0),
        ("dt", float("nan")),
        ("friction_iterations", 0),
        ("friction_iterations", -1),
        ("max_iterations", 0),
        ("ignored_pairs", np.array([[0, 99]], dtype=np.int32)),
        ("ignored_pairs", np.array([[-1, 0]], dtype=np.int32)),
        ("bending_models", ["patch", "patch"]),
        ("bending_models", []),
        ("surface_names", ["a"] * 99),
        ("surface_names", ["a"]),
        ("pin_names", ["a"] * 2),
        ("scheme", "none"),
        ("metric", "none"),
        ("elastic", "none"),
        ("bending_models", ["none"]),
    ],
)
def test_another_value_out_of_range_is_refused(arguments, name, value):
    with pytest.raises(ValueError, match=r"core: |(scheme|metric|elastic|bending_models) must"):
        _core.Simulator(**(arguments | {name: value}))


@pytest.mark.parametrize("name", ["vertices", "rest_positions", "scheme", "tolerance", "link_axis"])
def test_a_field_that_is_missing_is_named(arguments, name):
    with pytest.raises(ValueError, match=rf"core: `{name}` is missing"):
        _core.Simulator(**{k: v for k, v in arguments.items() if k != name})


@pytest.mark.parametrize("name", ["rest_vertices", "tolerances", "body_face_start"])
def test_a_field_that_is_not_known_is_named(arguments, name):
    with pytest.raises(ValueError, match=rf"core: `{name}` is not known"):
        _core.Simulator(**arguments, **{name: 1})


def test_a_field_of_another_type_is_named(arguments):
    with pytest.raises(TypeError, match="core: `dt` is of a type"):
        _core.Simulator(**(arguments | {"dt": "0.01"}))


@pytest.mark.parametrize("rounded", [torch.tensor(0.01), np.float32(0.02), torch.tensor(1).half()])
def test_a_time_step_in_single_precision_is_refused(rounded):
    """Single precision would silently change 0.01 to 0.009999999776482582."""
    scene = dc.Scene([dc.Cloth.grid(3, 3)])
    message = r"Simulator: `dt` must be a plain number or one in float64, got \S*float\d+, which"
    with pytest.raises(TypeError, match=message):
        dc.Simulator(scene, rounded)


@pytest.mark.parametrize("exact", [torch.tensor(0.01, dtype=torch.float64), np.float64(0.01), 1])
def test_a_time_step_in_double_precision_is_taken_as_it_is(exact):
    assert dc.Simulator(dc.Scene([dc.Cloth.grid(3, 3)]), exact).dt == float(exact)
