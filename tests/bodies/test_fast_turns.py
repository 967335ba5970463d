"""Bodies that turn by up to 1.5 rad in a step: by themselves, and in contact."""

import numpy as np
import pytest
import torch
from coupled_scenes import F64

import diffcloth_torch as dc
from diffcloth_torch.dynamics.free_motion import free_turns
from diffcloth_torch.geometry.rotation import quaternion_matrix

H = 0.008


def thrown(size, turn, seed, height=None):
    """A box above a floor that turns by `turn` rad a step, and reaches the floor soon."""
    rng = np.random.default_rng(seed)
    pose, axis = rng.normal(size=4), rng.normal(size=3)
    reach = np.linalg.norm(size) / 2
    drawn = 0.8 + 0.25 * rng.random()
    height = reach * (drawn if height is None else height)
    box = dc.RigidBody.box(
        size, motion="dynamic", density=400, pose=[0, 0, height, *pose], name="stick",
    )  # fmt: skip
    sim = dc.Simulator(
        dc.Scene([], [dc.RigidBody.plane(3.0), box], gravity=(0, 0, 0)),
        H,
        contact=dc.ContactOptions(barrier_distance=reach / 60),
    )
    speed = turn / H
    velocities = torch.zeros(2, 6, dtype=F64)
    velocities[1, 2] = -0.3 * speed * reach
    velocities[1, 3:] = torch.tensor(axis / np.linalg.norm(axis) * speed)
    return sim, sim.initial_state().replace(body_velocities=velocities)


@pytest.mark.parametrize("turn", [0.15, 0.5, 1.0])
@pytest.mark.parametrize("size", [(0.06, 0.06, 0.06), (0.05, 0.08, 0.13), (0.01, 0.02, 0.2)])
def test_contact_gives_no_energy_to_what_turns_fast(size, turn):
    """At most a thousandth in a step, where a stick was given ten times what it had."""
    touched = 0
    for seed in range(6):
        try:
            sim, state = thrown(size, turn, seed)
        except dc.IntersectingState:
            continue
        for _ in range(8):
            before = sim.kinetic_energy(state)
            total = before + sim.energy(state)
            try:
                with torch.no_grad():
                    state = sim.step(state)
            except dc.SimulationError as error:
                assert "'stick' turns at" in str(error)  # noqa: PT017 - contact may spin it up
                break
            gained = sim.kinetic_energy(state) + sim.energy(state) - total
            assert gained < 1e-3 * before
            touched += bool(state.body_forces.any())
    assert touched > 2


def bounded_step(sim, state):
    """The state before the first step in which the body is not given all of the impulse."""
    mass = float(sim.parameters().body_mass[1])
    for _ in range(8):
        with torch.no_grad():
            after = sim.step(state)
        force = sim.contact_wrenches(after)["stick"][:3]
        push = (after.body_velocities - state.body_velocities)[1, :3] * mass / H
        if (push - force).norm() > 1e-3 * force.norm():
            return state
        state = after
    return None


@pytest.mark.parametrize("turn", [0.4, 1.0])
def test_gradients_through_what_contact_may_not_give(turn):
    """By differences, in a step that is bounded."""
    for seed in range(40):
        try:
            sim, start = thrown((0.05, 0.08, 0.13), turn, seed)
        except dc.IntersectingState:
            continue
        sim = dc.Simulator(
            sim.scene, H, contact=sim.contact, solver=dc.SolverOptions(tolerance=1e-9)
        )
        before = bounded_step(sim, start)
        if before is not None:
            break
    else:
        pytest.fail("no step was bounded")
    base = before.body_velocities.detach()
    weights = torch.tensor([0.3, -0.7, 1.1, 0.02, 0.05, -0.03], dtype=F64)

    def loss(velocities):
        return sim.step(before.replace(body_velocities=velocities)).body_velocities[1] @ weights

    given = base.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(given), given)
    for i in range(6):
        change = torch.zeros_like(base)
        change[1, i] = 1e-5 * (1 if i < 3 else 30)
        with torch.no_grad():
            slope = (loss(base + change) - loss(base - change)) / (2 * change[1, i])
        assert gradient[1, i] == pytest.approx(float(slope), rel=1e-3, abs=1e-4)


def test_a_body_by_itself_turns_exactly():
    """At 3 rad a step as in many small steps; with what it keeps."""
    J = torch.diag(torch.tensor([0.2, 1.0, 1.1], dtype=F64))[None, None]
    spin = torch.tensor([2.0, 1.5, -1.7], dtype=F64)
    momentum = (J[0, 0] @ spin).expand(1, 1, 3)
    once, _ = free_turns(J, momentum, 1.0)
    turn = torch.eye(3, dtype=F64)
    for _ in range(50):
        part, _ = free_turns(J, (turn.T @ momentum[0, 0]).expand(1, 1, 3), 0.02)
        turn = turn @ quaternion_matrix(part)[0, 0]
    whole = quaternion_matrix(once)[0, 0]
    torch.testing.assert_close(whole, turn, rtol=0, atol=1e-13)
    local = whole.T @ momentum[0, 0]
    energy = local @ torch.linalg.solve(J[0, 0], local) / 2
    assert float(energy) == pytest.approx(float(spin @ momentum[0, 0] / 2), rel=1e-13)


def test_derivatives_of_a_free_turn():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(2, 3, 3))
    J = torch.tensor(root @ root.transpose(0, 2, 1) + np.eye(3))[None].requires_grad_()
    momentum = torch.tensor(rng.normal(size=(1, 2, 3)) * 4).requires_grad_()
    assert torch.autograd.gradcheck(lambda *given: free_turns(*given, 0.7)[0], (J, momentum))


@pytest.mark.parametrize("turn", [1.8, 4.0])
def test_energy_and_momentum_of_a_state_know_no_speed_limit(turn):
    sim, state = thrown((0.01, 0.02, 0.2), turn, 2, height=1.1)
    still = state.replace(body_velocities=torch.zeros_like(state.body_velocities))
    assert sim.energy(state) == sim.energy(still)
    assert sim.momentum(state).isfinite().all()


def test_a_ball_that_rolls_too_fast_is_refused_by_name():
    ball = dc.RigidBody.sphere(
        0.004, subdivisions=2, motion="dynamic", density=300, pose=[0, 0, 0.00406, 1, 0, 0, 0],
        friction=0.5, name="marble",
    )  # fmt: skip
    sim = dc.Simulator(
        dc.Scene([], [dc.RigidBody.plane(9.0, friction=0.5), ball]),
        H,
        contact=dc.ContactOptions(barrier_distance=1e-4),
    )
    velocities = torch.zeros(2, 6, dtype=F64)
    velocities[1, 0], velocities[1, 4] = 2 / H * 0.004, 2 / H
    state = sim.initial_state().replace(body_velocities=velocities)
    with pytest.raises(
        dc.SimulationError, match=r"'marble' turns at 250 rad/s.* time step of at most 0.006 s"
    ):
        sim.step(state)
