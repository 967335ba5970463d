"""One typed error for each bad argument that once raised another error, or none."""

import io
import os
import pickle
import re
import warnings

import numpy as np
import pytest
import torch
from processes import run_python

import diffcloth_torch as dc
from diffcloth_torch.config import shapes

F64 = torch.float64


@pytest.fixture(scope="module")
def sim():
    return dc.Simulator(dc.Scene([dc.Cloth.grid(3, 3, pins={"a": [0]})]), 0.01)


def grid(**keywords):
    return dc.Simulator(dc.Scene([dc.Cloth.grid(3, 3)]), 0.01, **keywords)


def nested(layout):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they are a prototype in torch
        rows = [torch.zeros(2, 3, dtype=F64), torch.zeros(3, 3, dtype=F64)]
        return torch.nested.nested_tensor(rows, layout=layout)


MASKED = np.ma.masked_array(np.zeros((9, 3)), mask=np.eye(9, 3))


# --- Values of another kind ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda _: dc.SolverOptions(max_iterations=2**40),
            dc.InvalidInput,
            "`max_iterations` must be at most 2147483647, got 1099511627776",
        ),
        (
            lambda _: dc.ContactOptions(friction_iterations=10**5000),
            dc.InvalidInput,
            "`friction_iterations` must be at most 2147483647, got one of 16610 bits",
        ),
        (
            lambda _: grid(scheme=np.array(["coupled", "split"])),
            TypeError,
            "`scheme` must be a string, one of 'coupled', 'split', 'projective', got ndarray",
        ),
        (lambda _: grid(coupling=["a"]), TypeError, "`coupling` must be a string, .* got list"),
        (lambda _: dc.stack([1]), TypeError, r"`states\[0\]` must be a State, got int"),
        (lambda _: dc.stack(1), TypeError, "`states` must be a sequence of states, got int"),
        (
            lambda sim: dc.stack([sim.initial_state(), None]),
            TypeError,
            r"`states\[1\]` must be a State, got NoneType",
        ),
        (
            lambda sim: dc.where(torch.ones(2) > 0, sim.initial_state(), 2),
            TypeError,
            "where: `b` must be a State, got int",
        ),
        (
            lambda sim: dc.where(
                torch.ones(2) > 0,
                sim.initial_state(),
                sim.initial_state().replace(velocities=torch.zeros(8, 3, dtype=F64)),
            ),
            dc.InvalidInput,
            r"`velocities` must have the same shape .* \[9, 3\] in `a` and \[8, 3\] in `b`",
        ),
        (
            lambda sim: sim.initial_state(2).replace(time=torch.zeros((), dtype=F64))[0],
            dc.InvalidInput,
            "`time` must have 2 environments",
        ),
        (
            lambda sim: sim.step(
                sim.initial_state().replace(time=torch.tensor(torch.nan, dtype=F64))
            ),
            dc.InvalidInput,
            "`state.time` must be finite, got nan",
        ),
        (lambda sim: sim.control(forces=MASKED), TypeError, "`forces` must not be a masked array"),
        (
            lambda _: dc.Cloth(dc.Cloth.grid(3, 3).vertices, MASKED.astype(int)),
            TypeError,
            "`faces` must not be a masked array",
        ),
        (
            lambda _: dc.Cloth.grid(3, 3, [torch.ones((), requires_grad=True)] * 2),
            dc.InvalidInput,
            "`size` must be a rectangular array of numbers",
        ),
        (lambda _: dc.Cloth.load(1), TypeError, "`path` must be a string or a Path, got int"),
        (lambda _: dc.Robot.load(None), TypeError, "`path` must be a string or a Path"),
        (lambda sim: sim.initial_state().export(b"a"), TypeError, "export: `path` must be a"),
        (
            lambda _: dc.Scene(torch.zeros(())),
            TypeError,
            "Scene: `cloths` must be a list of Cloth",
        ),
        (
            lambda _: dc.Scene([dc.Cloth.grid(2, 2)], ignore_contact=1),
            TypeError,
            "`ignore_contact` must be a list of pairs of names, got int",
        ),
    ],
)
def test_a_value_of_another_kind_is_one_typed_error(sim, call, error, message):
    with pytest.raises(error, match=message):
        call(sim)


@pytest.mark.parametrize("layout", [torch.strided, torch.jagged])
@pytest.mark.parametrize(
    "call",
    [
        lambda sim, value: sim.step(sim.initial_state().replace(positions=value)),
        lambda sim, value: sim.control(forces=value),
        lambda sim, value: dc.Cloth(value, [[0, 1, 2]]),
        lambda sim, value: dc.Cloth(np.eye(3), value),
        lambda sim, value: dc.stack([sim.initial_state().replace(positions=value)]),
    ],
)
def test_a_nested_tensor_is_a_type_error(sim, call, layout):
    with pytest.raises(TypeError, match="must be a dense"):
        call(sim, nested(layout))


# --- Reports from files --------------------------------------------------------------------------


def broken(report, **changes):
    """A report made without checks, as a file may contain."""
    made = object.__new__(dc.Report)
    made.__dict__.update(vars(report) | changes)
    return made


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"residual": "small"}, "Report: `residual` must be a number or a tensor, got str"),
        ({"seconds": None}, "Report: `seconds` must be a dict of numbers, got NoneType"),
        ({"counts": {"exact": []}}, r"Report: `counts\['exact'\]` must be a number .* got list"),
    ],
)
@pytest.mark.parametrize("way", ["pickle", "torch"])
def test_a_broken_report_is_refused_where_it_is_loaded(sim, changes, message, way):
    state = sim.step(sim.initial_state())
    state = state.replace(report=broken(state.report, **changes))
    file = io.BytesIO()
    if way == "pickle":
        pickle.dump(state, file)
    else:
        torch.save(state, file)
    file.seek(0)
    with pytest.raises(TypeError, match=message):
        pickle.load(file) if way == "pickle" else torch.load(file, weights_only=True)


@pytest.mark.parametrize(
    ("report", "error", "message"),
    [
        (1, TypeError, "`report` must be a Report or None, got int"),
        (
            dc.Report(torch.ones(3) > 0, 1, 0.5, 1.0, 2, 1.0, {}),
            dc.InvalidInput,
            r"`report.converged` must have shape \[\], .* got \[3\]",
        ),
    ],
)
def test_a_report_of_something_else_is_refused_where_it_is_used(sim, report, error, message):
    with pytest.raises(error, match=message):
        dc.stack([sim.initial_state().replace(report=report)])


# --- Sizes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: dc.Cloth.grid(10**9, 2), "`rows` and `columns` must make at most 4000000"),
        (lambda: dc.Cloth.grid(np.int64(2**31 - 1), 2**31 - 1), "at most 4000000 triangles"),
        (lambda: dc.Cloth.grid(2**40, 2), "`rows` must be at most 2147483647"),
        (lambda: dc.RigidBody.sphere(1, subdivisions=30), "`subdivisions` must be at most 8"),
    ],
)
def test_sizes_are_checked_before_memory_is_taken(call, message):
    with pytest.raises(dc.InvalidInput, match=message):
        call()


@pytest.mark.parametrize("edge_length", [1e-6, 1e-300])
def test_short_edges_are_refused_before_memory_is_taken(edge_length):
    with pytest.raises(ValueError, match="`edge_length` must cut the boxes into at most 1000000"):
        shapes.chair(0.44, 0.44, 0.46, 0.42, 0.04, edge_length)
    with pytest.raises(ValueError, match="`edge_length` must be between"):
        shapes.disk(1.0, edge_length)


LITTLE_MEMORY = """
    import resource
    import torch
    import diffcloth_torch as dc

    torch.set_num_threads({threads})
    scene = dc.Scene([dc.Cloth.grid(30, 30)])
    sim = dc.Simulator(scene, 0.01)
    state = sim.initial_state({threads})

    def gradient():
        x = state.positions.clone().requires_grad_()
        sim.step(state.replace(positions=x)).positions.sum().backward()

    calls = [
        lambda: sim.step(state),
        gradient,
        lambda: dc.Simulator(scene, 0.01),
        lambda: sim.initial_state(10_000),
        lambda: dc.Cloth.grid(500, 500),
    ]
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    refused = 0
    for extra in (2**17, 2**20, 2**22, 2**24):
        for call in calls:
            with open("/proc/self/statm") as file:
                used = int(file.read().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (used + extra, hard))
            try:
                call()
            except MemoryError:
                refused += 1
            finally:
                resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
    assert sim.step(state).report is not None
    print("refused", refused)
"""


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="reads /proc")  # noqa: PTH110
@pytest.mark.parametrize("threads", [1, 2])
def test_little_memory_is_a_memory_error_and_no_end(threads):
    printed = run_python(LITTLE_MEMORY.replace("{threads}", str(threads)), timeout=120)
    assert int(re.fullmatch(r"refused (\d+)\n", printed)[1]) > 5


# --- Start positions of surfaces -----------------------------------------------------------------


def two_sheets(*position):
    sheets = [dc.Cloth.grid(3, 3), dc.Cloth.grid(3, 3, pose=[*position, 1, 0, 0, 0])]
    return dc.Simulator(dc.Scene(sheets), 0.01)


@pytest.mark.parametrize("position", [(0, 0, 0), (0.3, 0.1, 0), (1, 0, 0), (0.5, 0.5, 0)])
def test_surfaces_that_touch_name_their_elements(position):
    message = (
        r"overlap: cloth 'cloth0' (vertex|edge) \(.*\) and cloth 'cloth1' (face|edge) \(.*\) touch"
    )
    with pytest.raises(dc.IntersectingState, match=message) as raised:
        two_sheets(*position)
    assert "thickness" not in str(raised.value)


# --- Small scenes --------------------------------------------------------------------------------


def test_a_scene_of_micrometers_is_refused_with_a_tolerance_that_it_works_with():
    def make(**options):
        sheet = dc.Cloth.grid(5, 5, 1e-6, pose=[0, 0, 0.1e-6, 1, 0, 0, 0])
        scene = dc.Scene([sheet], [dc.RigidBody.plane(3e-6)])
        return dc.Simulator(scene, 1e-4, solver=dc.SolverOptions(**options))

    with pytest.raises(dc.InvalidInput, match=r"`solver\.tolerance` must be at most .* got 0\.1"):
        make(tolerance=0.1)
    sim = make(tolerance=1e-9)
    state = sim.initial_state()
    for _ in range(20):
        state = sim.step(state)
        assert state.report.converged
    assert 0 < state.report.minimum_distance <= sim.default_parameters().barrier_distance
    assert (state.positions - sim.initial_state().positions)[..., :2].abs().max() < 1e-8


def test_a_rest_shape_without_area_is_refused_in_every_environment(sim):
    rest = sim.default_parameters().rest_positions.repeat(3, 1, 1)
    rest[2, 0] = rest[2, 1]
    with pytest.raises(dc.InvalidInput, match="rest_positions"):
        sim.step(sim.initial_state(3), None, sim.default_parameters().replace(rest_positions=rest))


def test_a_cloth_may_be_finer_than_a_body_is_thick():
    """Only a cloth's thickness must stay below its own edge lengths."""
    floor = dc.RigidBody.plane(4.0, thickness=0.3, pose=[0, 0, -1, 1, 0, 0, 0], name="floor")
    scene = dc.Scene([dc.Cloth.grid(5, 5, 0.2, name="sheet")], [floor])
    sim = dc.Simulator(scene, 0.01, contact=dc.ContactOptions(barrier_distance=0.005))
    thick = {"floor": torch.tensor(0.4, dtype=F64)}
    sim.step(sim.initial_state(), None, dc.Parameters(thickness=thick))
    with pytest.raises(dc.InvalidInput, match="below half the smallest distance"):
        sim.step(sim.initial_state(), None, dc.Parameters(thickness={"sheet": thick["floor"]}))


def test_the_barrier_leaves_room_for_the_thickest_cloth():
    thin = dc.Cloth.grid(5, 5)
    apart = dc.Simulator(dc.Scene([thin]), 0.01)._core.smallest_nonadjacent_distance()
    thick = dc.Cloth.grid(
        5, 5, material=dc.Material(thickness=0.4 * apart), pose=[0, 0, 5, 1, 0, 0, 0]
    )
    for cloths in ([thin, thick], [thick, thin]):
        distance = dc.Simulator(dc.Scene(cloths), 0.01).default_parameters().barrier_distance
        assert distance.item() == pytest.approx(0.05 * apart, rel=1e-12)
