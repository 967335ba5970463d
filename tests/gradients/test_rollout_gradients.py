"""Gradients of rollouts through contact and friction, against differences and a closed form."""

import numpy as np
import pytest
import scenes
import torch
from differences import difference

import diffcloth_torch as dc

F64 = torch.float64

# Steps of the differences, as shares of a direction's own size: the best plateau counts.
SWEEP = 10.0 ** -np.arange(1.0, 5.01, 0.5)


def plateau(f, x, d, scale, rtol):
    """The difference that agrees best with the next smaller step's, and the disagreement.

    The sweep ends early on a plateau that is flat to a tenth of rtol.
    """
    best, best_gap, last = np.nan, np.inf, np.inf
    for step in SWEEP:
        found = difference(f, x, d, scale * step)
        gap = abs(found - last)
        if gap < best_gap:
            best, best_gap = found, gap
        if best_gap < 0.1 * rtol * abs(best):
            break
        last = found
    return best, best_gap


def check(loss, leaves, rtol, seed=0, scales=None):
    """Compare the derivative of loss(**leaves) along one random direction of each leaf."""
    variables = {name: t.clone().requires_grad_() for name, t in leaves.items()}
    found = torch.autograd.grad(loss(**variables), list(variables.values()))
    g = torch.Generator().manual_seed(seed)
    problems = []
    for (name, tensor), gradient in zip(leaves.items(), found, strict=True):
        d = torch.randn(tensor.shape, dtype=F64, generator=g)
        expected = float((gradient * d).sum())
        assert expected != 0.0

        def f(value, name=name):
            with torch.no_grad():
                return loss(**{**leaves, name: value}).item()

        value, gap = plateau(f, tensor, d, scales[name], rtol)
        size = max(abs(expected), 0.1 * float((gradient * d).norm()))  # the sum may cancel
        if not (abs(value - expected) <= rtol * size and gap <= rtol * size):
            problems.append(
                f"{name}: gradient {expected:.10g}, difference {value:.10g} (+- {gap:.1g})"
            )
    assert not problems, "\n".join(problems)


SCALES = {
    "positions": 1e-4,
    "velocities": 1e-2,
    "forces": 1e-3,
    "friction": 1e-1,
    "poses": 1e-4,
    "stretch": 30.0,
    "density": 3e-2,
    "rest_positions": 1e-4,
}


def rolled(case, steps):
    """Weighted end state of a rollout with constant forces, as a function of its inputs."""
    g = torch.Generator().manual_seed(4)
    state = case.state
    shape = state.positions.shape
    weights = torch.randn(shape, dtype=F64, generator=g)
    force_weights = 0.1 * torch.randn(state.body_forces.shape, dtype=F64, generator=g)
    with torch.no_grad():
        end = case.sim.rollout(
            state,
            [dc.Control(forces=case.control["forces"])] * steps,
            case.sim.default_parameters(),
        )[-1]

    def loss(positions, velocities, forces, poses=state.body_poses, **parameters):
        start = state.replace(positions=positions, velocities=velocities, body_poses=poses)
        states = case.sim.rollout(
            start,
            [dc.Control(forces=forces)] * steps,
            case.sim.default_parameters().replace(**parameters),
        )
        last = states[-1]
        return (
            ((last.positions - end.positions) * weights).sum()
            + scenes.DT * ((last.velocities - end.velocities) * weights).sum()
            + 0.1 * ((last.body_forces - end.body_forces) * force_weights).sum()
        )

    parameters = case.sim.default_parameters()
    leaves = {
        "positions": state.positions,
        "velocities": state.velocities,
        "forces": case.control["forces"],
        "poses": state.body_poses,
        **{k: getattr(parameters, k) for k in ("friction", "stretch", "density", "rest_positions")},
    }
    return loss, leaves


@pytest.mark.quick("sliding-coupled-1-*")
@pytest.mark.parametrize(
    ("name", "scheme", "steps", "rtol"),
    [
        ("sliding", "coupled", 1, 1e-5),
        ("sliding", "coupled", 10, 1e-5),
        pytest.param("held", "split", 10, 1e-5, marks=pytest.mark.slow),
        pytest.param("folded", "coupled", 10, 1e-5, marks=pytest.mark.slow),
        pytest.param("sphere", "split", 10, 1e-5, marks=pytest.mark.slow),
        pytest.param("sliding", "coupled", 100, 1e-4, marks=pytest.mark.slow),
        pytest.param("held", "coupled", 100, 1e-4, marks=pytest.mark.slow),
        pytest.param("held", "split", 100, 1e-4, marks=pytest.mark.slow),
    ],
)
def test_a_rollout_through_contact_has_the_gradient_of_differences(name, scheme, steps, rtol):
    case = scenes.regime(name, scheme)
    loss, leaves = rolled(case, steps)
    check(loss, {k: t for k, t in leaves.items() if t.numel()}, rtol, scales=SCALES)


# --- The cases on which other engines were measured to be 11 % to 100 % wrong --------------------


def sheet_over(body, height, *, velocity, friction=0.4):
    vertices, faces = scenes.grid(8, 8, edge=0.05, seed=21)
    sheet = dc.Cloth(
        vertices + np.array([0.0, 0.0, height]),
        faces,
        material=dc.Material(stretch=300.0, bending=1e-3, density=0.2, friction=friction),
    )
    sim = dc.Simulator(
        dc.Scene([sheet], [body]),
        1 / 60,
        contact=dc.ContactOptions(barrier_distance=5e-3, barrier_stiffness=50.0),
        solver=dc.SolverOptions(tolerance=1e-10),
    )
    state = sim.initial_state()
    v = torch.zeros_like(state.velocities) + torch.tensor(velocity, dtype=F64)
    return sim, state.replace(velocities=v)


def check_start(sim, state, frames, rtol=1e-3):
    """dL/dx0 and dL/dv0 of the mean squared distance that the sheet has gone."""
    goal = state.positions + torch.tensor([0.3, -0.1, 0.05], dtype=F64)

    def loss(positions, velocities):
        start = state.replace(positions=positions, velocities=velocities)
        last = sim.rollout(start, steps=frames)[-1]
        assert last.report.contact_count > 0
        return ((last.positions - goal) ** 2).mean()

    leaves = {"positions": state.positions, "velocities": state.velocities}
    check(loss, leaves, rtol, scales={"positions": 1e-4, "velocities": 1e-2})


@pytest.mark.slow
@pytest.mark.parametrize("frames", [15, 30, 50])
def test_a_sheet_that_slides_on_a_plane(frames):
    floor = dc.RigidBody.plane(20.0, friction=0.4)
    sim, state = sheet_over(floor, 4e-3, velocity=(2.0, 0.7, 0.0))
    check_start(sim, state, frames)


@pytest.mark.parametrize(
    "frames",
    [5, pytest.param(15, marks=pytest.mark.slow), pytest.param(30, marks=pytest.mark.slow)],
)
def test_a_sheet_on_a_sphere(frames):
    ball = dc.RigidBody.sphere(0.2, friction=0.4, pose=[0.013, 0.017, 0, 1, 0.2, 0.1, 0.3])
    sim, state = sheet_over(ball, 0.203, velocity=(0.0, 0.0, 0.0))
    check_start(sim, state, frames)


# --- Closed form ---------------------------------------------------------------------------------


def test_a_vertex_on_a_soft_pin_is_the_implicit_euler_recursion():
    """A triangle with three equal masses on equal springs only translates, as one vertex does.

    Implicit Euler for m (x'' + g) + k x = 0 with g = -9.81 along x; the numbers are the derivatives
    of x_100 by k, m, x_0 and v_0.
    """
    k, m, x0, v0, h, steps = 50.0, 0.3, 0.1, -0.2, 0.01, 100
    corners = np.array([[0.0, 0.0, 0.0], [0.3, 0.02, 0.0], [0.1, 0.25, 0.0]])
    area = 0.5 * (0.3 * 0.25 - 0.1 * 0.02)
    cloth = dc.Cloth(
        corners,
        [[0, 1, 2]],
        material=dc.Material(stretch=100.0, density=3 * m / area, damping=0.01),
        soft_pins={"all": [0, 1, 2]},
        pin_stiffness=k,
    )
    sim = dc.Simulator(
        dc.Scene([cloth], gravity=(-9.81, 0, 0)),
        h,
        contact=dc.ContactOptions(self_contact=False),
        solver=dc.SolverOptions(tolerance=1e-12),
    )
    start = sim.initial_state()
    stiffness = torch.tensor(k, dtype=F64, requires_grad=True)
    mass = torch.tensor(m, dtype=F64, requires_grad=True)
    offset = torch.tensor(x0, dtype=F64, requires_grad=True)
    speed = torch.tensor(v0, dtype=F64, requires_grad=True)
    along = torch.tensor([1.0, 0.0, 0.0], dtype=F64)
    state = start.replace(
        positions=start.positions + offset * along,
        velocities=start.velocities + speed * along,
    )
    parameters = sim.default_parameters().replace(pin_stiffness=stiffness, density=3 * mass / area)
    last = sim.rollout(state, steps=steps, parameters=parameters)[-1]

    x, v = x0, v0
    for _ in range(steps):
        v = (v - h * (9.81 + k / m * x)) / (1 + h * h * k / m)
        x += h * v
    moved = (last.positions - start.positions).detach()
    np.testing.assert_allclose(moved.numpy(), [[x, 0, 0]] * 3, atol=1e-10)

    expected = (-0.00357366638, 0.595611063648, 0.421439515842, 0.00912471032)
    for vertex in range(3):
        found = torch.autograd.grad(
            last.positions[vertex, 0], (stiffness, mass, offset, speed), retain_graph=True
        )
        np.testing.assert_allclose([float(g) for g in found], expected, rtol=1e-8, atol=5e-12)
