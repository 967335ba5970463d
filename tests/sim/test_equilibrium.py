"""Equilibria against closed forms, long rollouts and differences; scenes without equilibrium."""

import dataclasses
import importlib
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import solve_bvp
from scipy.optimize import brentq
from torch.utils.checkpoint import checkpoint

import diffcloth_torch as dc
from diffcloth_torch.sim.statics import equilibrium

F64 = torch.float64
TIGHT = dc.SolverOptions(tolerance=1e-9)
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def cusick(monkeypatch):
    """The benchmark of a disk over a pedestal, with its rollouts."""
    monkeypatch.syspath_prepend(ROOT)
    return importlib.import_module("benchmarks.drape_coefficient")


def strip(count, length, width, *, seed=0, **options):
    """A level strip along x, `count` x 4 vertices, jittered in its plane."""
    x, y = np.meshgrid(np.linspace(0, length, count), np.linspace(0, width, 4), indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1)
    jitter = np.random.default_rng(seed).uniform(-0.1, 0.1, vertices.shape) * length / count
    vertices[2:-2, 1:-1, :2] += jitter[2:-2, 1:-1, :2]
    i = np.arange(count * 4).reshape(count, 4)
    a, b, c, d = i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    return dc.Cloth(vertices.reshape(-1, 3), faces, **options)


def cantilever(count=16, bending=2e-4, directions=None, **options):
    material = dc.Material(stretch=2000.0, bending=bending, poisson=0.0, density=0.15)
    if directions is not None:
        material = dataclasses.replace(
            material,
            stretch_weft=1000.0,
            stretch_shear=100.0,
            bending_weft=4e-4,
            bending_twill=2e-4,
        )
    cloth = strip(
        *(count, 0.2, 0.03),
        material=material,
        pins={"clamp": range(8)},
        name="strip",
        directions=directions,
    )
    return dc.Simulator(dc.Scene([cloth]), 0.01, solver=TIGHT, **options)


def drape(scheme="coupled", bending=1e-4, rows=9, **options):
    """A square sheet over a pedestal with a round rim."""
    grid = dc.Cloth.grid(rows, rows, (0.24, 0.24))
    vertices = np.array(grid.vertices)
    jitter = np.random.default_rng(1).uniform(-0.1, 0.1, (rows * rows, 2)) * 0.24 / (rows - 1)
    vertices[:, :2] += jitter
    vertices[:, 2] = 0.003
    cloth = dc.Cloth(
        vertices,
        grid.faces,
        material=dc.Material(stretch=300.0, bending=bending, friction=0.3, damping=0.01),
        name="sheet",
    )
    ball = dc.RigidBody.sphere(0.07, pose=[0, 0, -0.07, 1, 0, 0, 0], name="pedestal")
    return dc.Simulator(dc.Scene([cloth], [ball]), 0.01, scheme=scheme, solver=TIGHT, **options)


def test_a_hanging_strip_is_a_catenary():
    length, span = 0.4, 0.3
    material = dc.Material(stretch=2e4, bending=1e-9, poisson=0.0, density=0.2)
    cloth = strip(40, length, 0.03, material=material)
    positions = np.array(cloth.vertices)
    # A start with the length of the strip: two straight halves.
    half, drop = span / 2, np.sqrt(length**2 - span**2) / 2
    s = positions[:, 0] / length
    positions[:, 0] = span * s
    positions[:, 2] = -2 * drop * np.minimum(s, 1 - s)
    ends = {"ends": [*range(4), *range(156, 160)]}
    held = dc.Cloth(
        positions, cloth.faces, rest_positions=cloth.vertices, material=material, pins=ends
    )
    sim = dc.Simulator(dc.Scene([held]), 0.01, solver=dc.SolverOptions(max_iterations=3000))
    end = sim.equilibrium(sim.initial_state())
    # A chain of 39 links, each with the weight of its ends: a link carries the weight of the links
    # between itself and the middle, so tan(theta_i) = (i - 19) / pull.
    link, places = length / 39, np.arange(39) - 19

    def angles(pull):
        return np.arctan(places / pull)

    pull = brentq(lambda pull: link * np.cos(angles(pull)).sum() - span, 0.1, 1e3)
    sag = link * np.sin(angles(pull))[20:].sum()
    # Wrinkles shorten the rows along the edges by up to 3e-3 of the inner ones.
    rows = end.positions[:, 2].reshape(40, 4).mean(dim=1)
    assert -float(rows.min()) == pytest.approx(sag, rel=2e-3)
    a = brentq(lambda a: 2 * a * np.sinh(half / a) - length, 0.01, 10.0)
    assert sag == pytest.approx(a * (np.cosh(half / a) - 1), rel=3e-3)
    x = end.positions[:, 0].numpy()
    curve = a * np.cosh((x - half) / a) - a * np.cosh(half / a)
    np.testing.assert_allclose(end.positions[:, 2].numpy(), curve, atol=0.02 * sag)


@pytest.mark.parametrize(
    ("directions", "D"),
    [
        pytest.param(None, 2e-4, id="isotropic"),
        pytest.param([1, 0, 0], 2e-4, id="by the warp"),
        pytest.param([0, 1, 0], 4e-4, id="by the weft"),
    ],
)
def test_a_heavy_cantilever_is_an_elastica(directions, D):
    sim = cantilever(count=30, directions=directions)
    end = sim.equilibrium(sim.initial_state()).positions.numpy()
    clamp = 0.2 / 29  # the second row is held
    L, weight = 0.2 - clamp, 0.15 * 9.81

    def bend(s, y):  # D theta'' = w (L - s) cos(theta): moment of the strip beyond s
        return np.stack([y[1], -weight * (L - s) * np.cos(y[0]) / D])

    s = np.linspace(0, L, 200)
    found = solve_bvp(bend, lambda a, b: np.array([a[0], b[1]]), s, np.zeros((2, 200)), tol=1e-8)
    assert found.success
    drop = np.trapezoid(np.sin(found.sol(s)[0]), s)
    assert -end[-4:, 2].mean() == pytest.approx(abs(drop), rel=0.02)


def test_the_end_of_a_long_rollout_is_an_equilibrium():
    """Sticking contacts hold; the rollout still creeps by .01 mm/s after 6 s."""
    contact = dc.ContactOptions(slip_velocity=1e-5)
    sim = drape(contact=contact)
    with torch.no_grad():
        state = sim.initial_state()
        for _ in range(600):
            state = sim.step(state)
    found = sim.equilibrium(state)
    assert found.time == state.time
    assert not found.velocities.any()
    assert state.velocities.norm(dim=-1).max() < 3e-4
    assert (found.positions - state.positions).norm(dim=-1).max() < 1e-5


@pytest.mark.parametrize(
    ("friction", "seconds"),
    [(0.0, 4.0), pytest.param(0.3, 12.0, marks=pytest.mark.slow)],
    ids=["smooth", "rough"],
)
def test_a_disk_on_a_pedestal_drapes_as_a_long_rollout_does(cusick, friction, seconds):
    """Cusick's test with formed folds; friction is anchored at the end of the rollout."""
    drape = cusick.make(5e-5, friction, 0.02)
    folded, end = cusick.fall(drape, seconds, 0.5)
    start = end if friction else folded
    found = drape.simulator.equilibrium(start)
    assert cusick.distance(found, end) < 1e-6
    assert cusick.distance(folded, end) > 1e-4
    coefficient = drape.coefficient(found)
    assert coefficient == pytest.approx(drape.coefficient(end), abs=1e-6)
    assert 0.80 < coefficient < 0.90  # far from a plate's, 1, and from a hanging cloth's


def test_a_stiffer_disk_drapes_less(cusick):
    coefficients = []
    for bending in (2e-4, 1e-3):
        drape = cusick.make(bending, 0.0, 0.02)
        found = drape.simulator.equilibrium(drape.simulator.initial_state())
        coefficients.append(drape.coefficient(found))
    assert coefficients[0] < coefficients[1] < 1.0


def test_a_rollout_without_friction_ends_at_the_equilibrium():
    cloth = strip(12, 0.2, 0.03, material=dc.Material(bending=1e-4, damping=0.05))
    pins = {"clamp": range(8)}
    cloth = dc.Cloth(cloth.vertices, cloth.faces, material=cloth.material, pins=pins)
    sim = dc.Simulator(dc.Scene([cloth]), 0.02, solver=TIGHT)
    found = sim.equilibrium(sim.initial_state())
    with torch.no_grad():
        state = sim.initial_state()
        for _ in range(500):
            state = sim.step(state)
    assert (state.positions - found.positions).norm(dim=-1).max() < 1e-6


def test_a_sheet_sticks_on_an_incline_and_holds_its_weight():
    angle = 0.3
    turn = [np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]
    floor = dc.RigidBody.plane(1.0, pose=[0, 0, 0, *turn], friction=0.5)
    cloth = dc.Cloth.grid(6, 6, (0.2, 0.2), pose=[0.001, 0, 0.004, *turn])
    sim = dc.Simulator(dc.Scene([cloth], [floor]), 0.01, solver=TIGHT)
    state = sim.initial_state()
    found = sim.equilibrium(state)
    weight = float(sim.vertex_masses().sum()) * 9.81
    force = found.body_forces.sum(dim=0)
    torch.testing.assert_close(
        force, torch.tensor([0, 0, -weight], dtype=F64), rtol=0, atol=1e-6 * weight
    )
    # Motion along the slope is within the yield of regularized friction.
    slope = torch.tensor([np.cos(angle), 0.0, -np.sin(angle)], dtype=F64)
    assert ((found.positions - state.positions) @ slope).abs().max() < 1e-5


def test_a_box_rests_on_a_pinned_sheet():
    cloth = dc.Cloth.grid(7, 7, (0.3, 0.3), pins={"rim": [0, 6, 42, 48, 3, 21, 27, 45]})
    box = dc.RigidBody.box(
        0.08, motion="dynamic", mass=0.02, pose=[0.01, 0.004, 0.045, 1, 0, 0, 0], name="box"
    )
    sim = dc.Simulator(dc.Scene([cloth], [box]), 0.01, solver=dc.SolverOptions(tolerance=1e-8))
    found = sim.equilibrium(sim.initial_state())
    wrench = sim.contact_wrenches(found)["box"]
    torch.testing.assert_close(
        wrench[:3], torch.tensor([0, 0, 0.02 * 9.81], dtype=F64), rtol=0, atol=1e-6
    )
    assert wrench[3:].abs().max() < 1e-7
    assert not found.body_velocities.any()


def directions(sim, names):
    """Parameters, and a random direction of each that keeps its sign."""
    given = sim.default_parameters()
    for k, name in enumerate(names):
        value = getattr(given, name)
        generator = torch.Generator().manual_seed(k)
        factor = torch.rand(value.shape, generator=generator, dtype=F64) + 0.5
        scale = 0.01 if name == "rest_positions" else 1.0
        yield name, value, scale * factor * value


# Steps of the differences: at smaller steps, rounding of the strip's equilibria hides its stretch;
# at larger steps, the friction of the drape settles anew.
@pytest.mark.parametrize(
    ("make", "step", "names"),
    [
        (cantilever, 1e-4, ["stretch", "bending", "density", "gravity", "rest_positions"]),
        (
            drape,
            5e-7,
            [
                *("stretch", "bending", "density", "friction"),
                *("gravity", "thickness", "barrier_stiffness", "barrier_distance"),
            ],
        ),
    ],
    ids=["cantilever", "drape"],
)
def test_gradients_are_those_of_the_equilibrium(make, step, names):
    """By differences of equilibria, searched from the equilibrium found, with its friction."""
    sim = make()
    state = sim.initial_state()
    found = sim.equilibrium(state)
    weights = torch.randn(
        found.positions.shape, generator=torch.Generator().manual_seed(9), dtype=F64
    )

    def loss(start, name, value):
        end = sim.equilibrium(start, None, sim.default_parameters().replace(**{name: value}))
        return (end.positions * weights).sum()

    for name, value, way in directions(sim, names):
        leaf = value.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(loss(found, name, leaf), leaf)
        slope = float((gradient * way).sum())
        with torch.no_grad():
            ends = [loss(found, name, value + sign * step * way) for sign in (1, -1)]
        expected = float(ends[0] - ends[1]) / (2 * step)
        assert slope == pytest.approx(expected, rel=1e-4, abs=1e-7), name


def test_gradients_by_pins_forces_and_the_state():
    sim = cantilever()
    state = sim.initial_state()
    found = sim.equilibrium(state)
    weights = torch.randn(found.positions.shape, generator=torch.Generator().manual_seed(9))
    pins = found.positions[:8].clone()
    inputs = {
        "pins": pins,
        "forces": torch.zeros_like(found.positions),
        "positions": found.positions.clone(),
    }

    def loss(values):
        control = dc.Control(forces=values["forces"])
        if "pins" in values:
            control = dc.Control(forces=values["forces"], pins=values["pins"])
        start = found.replace(positions=values["positions"])
        return (sim.equilibrium(start, control).positions * weights).sum()

    for name, value in inputs.items():
        given = {n: v for n, v in inputs.items() if n != "pins" or name == "pins"}
        leaf = value.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(loss(given | {name: leaf}), leaf)
        way = torch.randn(value.shape, generator=torch.Generator().manual_seed(3), dtype=F64)
        if name == "positions":  # only pins depend on the state: they stay at its positions
            assert gradient[:8].any()
            assert gradient[8:].abs().max() < 1e-6 * gradient[:8].abs().max()
            way[8:] = 0.0
        step = 1e-7 if name == "forces" else 1e-6
        with torch.no_grad():
            ends = [loss(given | {name: value + sign * step * way}) for sign in (1, -1)]
        slope = float((gradient * way).sum())
        assert slope == pytest.approx(float(ends[0] - ends[1]) / (2 * step), rel=1e-4), name


def pulled_box():
    """A box that a spring pulls over a sheet held at its rim.

    Friction is far from settled after the friction iterations of one step.
    """
    n = 7
    rim = [i for i in range(n * n) if i // n in (0, n - 1) or i % n in (0, n - 1)]
    cloth = dc.Cloth.grid(n, n, 0.3, pins={"rim": rim}, material=dc.Material(friction=0.8))
    box = dc.RigidBody.box(
        [0.05, 0.04, 0.03],
        motion="dynamic",
        mass=0.1,
        friction=0.8,
        pose=[0.005, 0.003, 0.0185, 1, 0, 0, 0],
        name="box",
    )
    pull = dc.Attachment(("box", [0, 0, 0]), stiffness=5.0, name="pull")
    scene = dc.Scene([cloth], [box], attachments=[pull])
    simulator = dc.Simulator(scene, 0.01, solver=dc.SolverOptions(tolerance=1e-10))
    control = dc.Control(attachments={"pull": torch.tensor([[0.085, 0.01, 0.1]], dtype=F64)})
    return simulator, simulator.initial_state(), control


@pytest.mark.parametrize("name", ["barrier_distance", "friction", "gravity"])
def test_gradients_count_how_friction_and_normal_forces_settle(name):
    simulator, state, control = pulled_box()
    given = simulator.default_parameters()
    value = getattr(given, name)

    def place(tensor):
        found = simulator.equilibrium(state, control, given.replace(**{name: tensor}))
        return found.body_poses[0, :3].sum()

    leaf = value.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(place(leaf), leaf)
    backward = (gradient * value).sum().item()
    # At some steps one end has another friction, and another equilibrium.
    steps = (3e-5, 1e-5, 3e-6, 1e-6, 3e-7)
    ends = [(place(value * (1 + h)) - place(value * (1 - h))).item() / (2 * h) for h in steps]
    assert backward == pytest.approx(float(np.median(ends)), rel=1e-3)
    tangent = torch.func.jvp(place, (value,), (value,))[1].item()
    assert tangent == pytest.approx(backward, rel=1e-8)
    torch.testing.assert_close(torch.func.jacfwd(place)(value), gradient, rtol=1e-8, atol=1e-12)
    assert torch.equal(torch.func.grad(place)(value), gradient)
    again = value.clone().requires_grad_()
    checkpoint(place, again, use_reentrant=False).backward()
    assert torch.equal(again.grad, gradient)


def test_gradients_in_a_batch_are_those_alone_where_only_some_are_in_contact():
    n = 8
    cloth = dc.Cloth.grid(n, n, 0.3, pins={"edge": range(n)}, pose=[0, 0, 0.032, 1, 0, 0, 0])
    box = dc.RigidBody.box([0.1, 0.5, 0.06], motion="kinematic")
    contact = dc.ContactOptions(barrier_distance=2e-3)
    simulator = dc.Simulator(dc.Scene([cloth], [box]), 0.01, contact=contact, solver=TIGHT)
    touching = simulator.initial_state()
    far = touching.body_poses.clone()
    far[0, 2] = -1.0
    states = [touching, touching.replace(body_poses=far)]

    def gradients(state, batch):
        given = simulator.default_parameters()
        given = given.replace(gravity=given.gravity.expand(*batch, 3).clone().requires_grad_())
        found = simulator.equilibrium(state, None, given)
        both = torch.stack([found.positions.sum(), found.positions[..., -1, :].sum()])
        one = torch.autograd.grad(both.sum(), given.gravity, retain_graph=True)[0]
        several = torch.autograd.grad(
            both, given.gravity, torch.eye(2, dtype=F64), is_grads_batched=True
        )[0]
        torch.testing.assert_close(several.sum(dim=0), one, rtol=1e-9, atol=1e-12)
        return found, one

    together, shared = gradients(dc.stack(states), (2,))
    assert (together.report.contact_count > 0).tolist() == [True, False]
    for k, alone in enumerate(states):
        found, own = gradients(alone, ())
        assert torch.equal(found.positions, together.positions[k])
        assert torch.equal(own, shared[k])
        assert found.report.iterations == together.report.iterations[k]


def test_tangents_in_a_batch_are_those_alone():
    simulator, state, control = pulled_box()
    given = simulator.default_parameters()

    def places(states, friction):
        found = simulator.equilibrium(states, control, given.replace(friction=friction))
        return found.body_poses[..., 0, :]

    at = (given.friction,)
    _, alone = torch.func.jvp(lambda f: places(state, f), at, at)
    _, both = torch.func.jvp(lambda f: places(dc.stack([state, state]), f), at, at)
    assert alone.abs().max() > 1e-4
    assert torch.equal(both, torch.stack([alone, alone]))


def test_slip_velocities_and_failures_of_others_change_no_bit():
    simulator, state, control = pulled_box()
    given = simulator.default_parameters().replace(slip_velocity=torch.tensor(1e-2, dtype=F64))
    alone = simulator.equilibrium(state, control, given)
    finer = given.replace(slip_velocity=torch.tensor([1e-2, 1e-6], dtype=F64))
    beside = simulator.equilibrium(dc.stack([state, state]), control, finer)
    assert torch.equal(beside.positions[0], alone.positions)
    assert beside.report.iterations[0] == alone.report.iterations


def test_environments_of_a_batch_are_those_alone():
    """Friction settles within two steps in the first environment, in eight in the second."""
    sim = drape(rows=7)
    state = sim.initial_state(2)
    parameters = sim.default_parameters()
    bending = parameters.bending * torch.tensor([0.3, 1.0], dtype=F64)
    friction = parameters.friction * torch.tensor([1.0, 5.0], dtype=F64).reshape(2, 1, 1)
    given = parameters.replace(bending=bending, friction=friction)
    batch = sim.equilibrium(state, None, given)
    for k in range(2):
        given = parameters.replace(bending=bending[k], friction=friction[k])
        alone = sim.equilibrium(state[k], None, given)
        assert torch.equal(batch.positions[k], alone.positions)
        assert torch.equal(batch.body_forces[k], alone.body_forces)


def test_damping_and_drag_change_nothing_at_rest():
    """The equilibrium and the search, including all values of the report, are equal."""
    sim = cantilever()
    names, ends = ("damping", "normal_drag", "tangential_drag"), []
    for size in (0.0, 50.0):
        given = {n: torch.tensor(size, dtype=F64, requires_grad=True) for n in names}
        found = sim.equilibrium(
            sim.initial_state(), None, sim.default_parameters().replace(**given)
        )
        gradients = torch.autograd.grad(found.positions.sum(), list(given.values()))
        assert not any(gradient.any() for gradient in gradients)
        ends.append((found.report.iterations, found.positions.tolist()))
    assert ends[0] == ends[1]
    again = sim.equilibrium(found, None, sim.default_parameters())
    assert again.report.iterations < found.report.iterations


def test_split_finds_the_same_equilibrium():
    alike = [s.equilibrium(s.initial_state()).positions for s in (drape(), drape("split"))]
    assert torch.equal(*alike)


@pytest.mark.parametrize("with_cloth", [False, True])
@pytest.mark.parametrize("degrees", [5, 10, 30, 44, 60, 80])
def test_a_box_that_is_tilted_comes_to_lie_on_its_table(degrees, with_cloth):
    """Only friction holds the box along the table, and there is no support beyond the rim."""
    angle = math.radians(degrees)
    height = 0.05 * math.sqrt(2) * math.cos(math.radians(45 - degrees)) + 0.002
    turned = [math.cos(angle / 2), math.sin(angle / 2), 0, 0]
    box = dc.RigidBody.box(
        0.1, motion="dynamic", mass=1.0, pose=[0, 0, height, *turned], friction=0.4
    )
    table = dc.RigidBody.plane(4.0, friction=0.4)
    hangs = dc.Cloth.grid(4, 4, 0.2, pose=[1, 1, 1, 1, 0, 0, 0], pins={"edge": [0, 1, 2, 3]})
    scene = dc.Scene([hangs] if with_cloth else [], [table, box])
    contact = dc.ContactOptions(barrier_distance=0.003)
    sim = dc.Simulator(scene, 0.01, contact=contact)
    end = sim.equilibrium(sim.initial_state()).body_poses[1]
    assert float(end[0].abs()) < 1e-3
    assert float(end[1].abs()) < 0.1
    assert 0.05 < float(end[2]) < 0.053


def test_messages_omit_the_time_step_of_the_search(monkeypatch):
    def turns(self, *arguments):
        raise dc.TurnedTooFar("step: take a time step of at most 0.06 s", environments=[2])

    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(3, 3, pins={"corner": [0]})]), 0.01)
    monkeypatch.setattr(equilibrium.Engine, "step", turns)
    with pytest.raises(dc.TurnedTooFar, match="equilibrium: a body turns further on the") as raised:
        sim.equilibrium(sim.initial_state())
    assert raised.value.environments == (2,)
    assert "time step" not in str(raised.value)


def test_a_falling_object_is_named():
    sheet = dc.Cloth.grid(4, 4, (0.2, 0.2), name="sheet")
    sim = dc.Simulator(dc.Scene([sheet]), 0.01)
    with pytest.raises(dc.SimulationError, match="equilibrium: 'sheet' is free to move"):
        sim.equilibrium(sim.initial_state())


def test_the_environments_in_which_something_falls_are_named():
    """The box falls off a sheet that supports it in other environments."""
    sheet = dc.Cloth.grid(3, 3, (0.2, 0.2), pins={"all": range(9)}, name="sheet")
    box = dc.RigidBody.box(
        0.1, motion="dynamic", mass=0.01, pose=[0, 0, 0.06, 1, 0, 0, 0], name="box"
    )
    sim = dc.Simulator(dc.Scene([sheet], [box]), 0.01)
    state = sim.initial_state(4)
    state.body_poses[1::2, 0, 0] = 1.0
    with pytest.raises(dc.SimulationError, match="'box' is free to move") as error:
        sim.equilibrium(state)
    assert error.value.environments == (1, 3)


def test_a_sheet_that_may_slide_is_named():
    sheet = dc.Cloth.grid(
        4, 4, (0.2, 0.2), pose=[0, 0, 0.002, 1, 0, 0, 0], name="sheet",
        material=dc.Material(friction=0.0),
    )  # fmt: skip
    floor = dc.RigidBody.plane(1.0, friction=0.0)
    sim = dc.Simulator(dc.Scene([sheet], [floor]), 0.01)
    with pytest.raises(dc.SimulationError, match="'sheet' is free to"):
        sim.equilibrium(sim.initial_state())


@pytest.mark.parametrize("size", [(9, 6), (5, 7), (6, 6), (7, 4), (8, 8), (4, 4), (5, 5), (7, 7)])
def test_a_sheet_that_hangs_from_one_vertex_turns(size):
    """The sheet rotates about the vertical; residual forces of a solve affect this mode."""
    cloth = dc.Cloth.grid(*size, 0.2, pins={"a": [0]}, name="flag")
    simulator = dc.Simulator(dc.Scene([cloth]), 0.01)
    with pytest.raises(dc.SimulationError, match="'flag' is free to turn or to change its shape"):
        simulator.equilibrium(simulator.initial_state())


def test_a_body_that_floats_is_named():
    box = dc.RigidBody.box(
        0.1, motion="dynamic", mass=0.1, pose=[0, 0, 0.3, 1, 0, 0, 0], name="box"
    )
    sheet = dc.Cloth.grid(3, 3, (0.2, 0.2), pins={"all": range(9)})
    sim = dc.Simulator(dc.Scene([sheet], [box], gravity=(0, 0, 0)), 0.01)
    with pytest.raises(dc.SimulationError, match="'box' is free to"):
        sim.equilibrium(sim.initial_state())


def test_schemes_without_equilibria_are_refused():
    sim = cantilever()
    box = dc.RigidBody.box(0.1, pose=[0, 0, -1, 1, 0, 0, 0], nodal_contact=True, name="box")
    nodal = dc.Simulator(dc.Scene(sim.scene.cloths, [box]), 0.01, scheme="split")
    with pytest.raises(dc.InvalidInput, match="make 'box' without nodal_contact"):
        nodal.equilibrium(nodal.initial_state())
    projective = dc.Simulator(sim.scene, 0.01, scheme="projective")
    with pytest.raises(dc.InvalidInput, match="use another scheme"):
        projective.equilibrium(projective.initial_state())


def test_too_few_iterations_are_a_failure_or_a_value():
    few = dc.SolverOptions(max_iterations=2)
    sim = dc.Simulator(cantilever().scene, 0.01, solver=few)
    with pytest.raises(dc.NotConverged):
        sim.equilibrium(sim.initial_state())
    silent = dc.SolverOptions(max_iterations=2, throw=False)
    sim = dc.Simulator(cantilever().scene, 0.01, solver=silent)
    assert sim.equilibrium(sim.initial_state()).report.status == "not_converged"


def test_an_unsettled_equilibrium_has_no_gradient(monkeypatch):
    """With `throw=False` the failure is a value, and backward raises."""
    monkeypatch.setattr(equilibrium, "_SETTLED", 0.0)
    monkeypatch.setattr(equilibrium, "_REPEATS", 1)
    silent = dc.SolverOptions(tolerance=1e-12, throw=False)
    sim = dc.Simulator(drape().scene, 0.01, solver=silent)
    bending = sim.default_parameters().bending.clone().requires_grad_()
    parameters = sim.default_parameters().replace(bending=bending)
    found = sim.equilibrium(sim.initial_state(), None, parameters)
    assert found.report.status == "not_converged"
    with pytest.raises(dc.NotConverged, match="no gradient"):
        found.positions.sum().backward()


def test_a_scene_of_bodies_has_the_scale_of_its_bodies():
    """A falling body is also detected in units a thousand times smaller."""
    for unit in (1.0, 1e-3):
        box = dc.RigidBody.box(
            0.1 * unit, motion="dynamic", mass=0.1, pose=[0, 0, unit, 1, 0, 0, 0], name="box"
        )
        contact = dc.ContactOptions(barrier_distance=1e-3 * unit)
        solver = dc.SolverOptions(tolerance=1e-6 * unit)
        gravity = (0, 0, -9.81 * unit)
        sim = dc.Simulator(
            dc.Scene([], [box], gravity=gravity), 0.01, contact=contact, solver=solver
        )
        moved = 0.5 * 9.81 * unit  # in the first long steps, about
        with pytest.raises(
            dc.SimulationError, match=r"'box' is free to move: .* moves by"
        ) as error:
            sim.equilibrium(sim.initial_state())
        assert moved < float(str(error.value).split("moves by ")[1].split(" m")[0]) < 1e3 * moved


WOVEN = {"stretch": 1000.0, "stretch_weft": 200.0, "stretch_shear": 50.0}
SOFT = {"stretch": 100.0, "stretch_weft": 100.0, "stretch_shear": 10.0, "bending": 1e-6}


@pytest.mark.parametrize(
    ("count", "size", "material", "pins", "force"),
    [
        pytest.param(9, 0.3, WOVEN, [0, 8], [0.0, -0.1, 0.0], id="woven"),
        pytest.param(7, 0.2, WOVEN, [42, 48], [0.1, 0.0, 0.0], id="woven, drawn aside"),
        pytest.param(9, 0.3, SOFT, [72, 80], [0.0, 0.0, -0.1], id="soft, woven"),
        pytest.param(6, 0.25, {}, [0, 5], [0.05, -0.1, 0.02], id="isotropic"),
    ],
)
def test_a_search_begins_at_its_state(count, size, material, pins, force):
    """The inertial prediction of the last step is 4e14 m away, with an energy that is NaN."""
    cloth = dc.Cloth.grid(
        count, count, size, pins={"corners": pins}, material=dc.Material(**material)
    )
    contact = dc.ContactOptions(self_contact=False)
    sim = dc.Simulator(dc.Scene([cloth]), 0.01, contact=contact)
    state = sim.initial_state()
    forces = torch.zeros_like(state.positions)
    forces[count // 2 if 0 not in pins else count * count - count // 2 - 1] = torch.tensor(
        force, dtype=F64
    )
    end = sim.equilibrium(state, sim.control(forces=forces))
    assert (end.positions - state.positions).abs().max() < 4 * size
    weight = sim.vertex_masses().sum() * torch.tensor([0.0, 0.0, -9.81], dtype=F64)
    # Forces balance to the solver's tolerance, which leaves 1e-9 of the weight.
    balance = weight + forces.sum(dim=0) + end.pin_forces.sum(dim=0)
    assert balance.abs().max() < 1e-7 * float(weight.norm())
