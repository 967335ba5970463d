"""One of eight environments fails: its state and gradient, and the other environments."""

import failing_scenes
import pytest
import torch
from failing_scenes import (
    BLOCKED,
    DT,
    FAILED,
    KINDS,
    SOLVES,
    B,
    control,
    simulator,
    status,
    targets,
)
from physics.physics_scenes import Judge, solver_path

import diffcloth_torch as dc

F64 = torch.float64
OTHERS = [i for i in range(B) if i != FAILED]
FIELDS = (
    "positions",
    "velocities",
    "body_forces",
    "body_poses",
    "body_velocities",
    "joint_positions",
    "joint_velocities",
    "joint_efforts",
    "base_poses",
    "base_velocities",
)
WEIGHTS = dict.fromkeys(FIELDS, 1.0) | {"body_forces": 1e-3, "joint_efforts": 1e-3}

by_block = pytest.mark.parametrize("kind", BLOCKED)
by_kind = pytest.mark.parametrize("kind", KINDS)
by_solve = pytest.mark.parametrize(("scheme", "coupling"), SOLVES)


def step(kind, sim, state, wanted):
    """The step, and its leaves: positions, targets, and gravity, which environments share."""
    x = state.positions.clone().requires_grad_()
    wanted = wanted.clone().requires_grad_()
    gravity = torch.tensor([0.1, 0.2, -0.5], dtype=F64, requires_grad=True)
    parameters = sim.default_parameters().replace(gravity=gravity)
    after = sim.step(state.replace(positions=x), control(kind, wanted), parameters)
    return after, (x, wanted, gravity)


def loss_of(state):
    return sum(w * (getattr(state, name) ** 2).sum() for name, w in WEIGHTS.items())


# Each kind of failure in some schemes and couplings.
MOTIONS = (
    "pins-split-monolithic",
    "pins-split-rigid_to_cloth",
    "pins-coupled-cloth_to_rigid",
    "body-coupled-monolithic",
    "body-coupled-rigid_to_cloth",
    "turning body-split-monolithic",
    "turning body-split-rigid_to_cloth",
    "turning body-coupled-cloth_to_rigid",
    "joint-coupled-monolithic",
    "joint-coupled-rigid_to_cloth",
    "base-split-monolithic",
    "base-split-rigid_to_cloth",
    "base-coupled-cloth_to_rigid",
)


@pytest.mark.quick(*MOTIONS, "forces-coupled-monolithic", "forces-coupled-rigid_to_cloth")
@by_solve
@by_kind
def test_the_others_keep_the_bits_and_gradients_that_they_have_alone(kind, scheme, coupling):
    sim = simulator(kind, scheme, coupling)
    wanted = targets(kind, sim)
    after, leaves = step(kind, sim, sim.initial_state(B), wanted)
    assert after.report.status == status(kind, scheme, coupling)
    assert after.report.converged.tolist() == [i != FAILED for i in range(B)]
    mask = after.report.converged
    new = dc.where(mask, after, sim.initial_state(B))
    assert torch.equal(new[FAILED].positions, sim.initial_state().positions)
    x_bar, wanted_bar, gravity_bar = torch.autograd.grad(loss_of(new), leaves)
    total = torch.zeros(3, dtype=F64)
    for i in OTHERS:
        alone, own = step(kind, sim, sim.initial_state(), wanted[i])
        assert alone.report.status == "converged"
        for name in FIELDS:
            assert torch.equal(getattr(after, name)[i], getattr(alone, name)), name
        bars = torch.autograd.grad(loss_of(alone), own)
        assert torch.equal(x_bar[i], bars[0])
        assert torch.equal(wanted_bar[i], bars[1])
        total += bars[2]
    torch.testing.assert_close(gravity_bar, total, rtol=1e-12, atol=1e-15)
    assert gravity_bar.any()
    assert not wanted_bar[FAILED].any()


@pytest.mark.quick(*MOTIONS)
@by_solve
@by_block
def test_the_state_is_where_the_motion_has_ended_and_can_be_gone_on_from(kind, scheme, coupling):
    sim = simulator(kind, scheme, coupling)
    start, wanted = sim.initial_state(), targets(kind, sim)[FAILED]
    after = sim.step(start, control(kind, wanted))
    fraction = after.report.motion_fraction
    assert after.report.status == "infeasible_motion"
    assert not after.report.converged
    judge = Judge(sim)
    assert judge.is_free(after)
    path = solver_path(sim, start, control(kind, wanted))
    assert judge.is_free_path(path)
    # Velocities are difference quotients of the actual positions.
    torch.testing.assert_close(
        after.velocities, (after.positions - start.positions) / DT, rtol=0, atol=1e-12
    )
    bodies = sim.scene.bodies
    moved = after.body_poses[:, :3] - start.body_poses[:, :3]
    for k, body in enumerate(bodies):
        if body.motion == "kinematic":
            torch.testing.assert_close(after.body_velocities[k, :3], moved[k] / DT)
    if coupling == "monolithic":
        assert abs(path[-1] - judge.points(after)).max() < 1e-12
        assert 0.1 < fraction < 1
    else:
        assert fraction == 0
        assert torch.equal(after.positions, start.positions)
        assert not after.velocities.any()
    field = KINDS[kind]
    if kind == "pins":
        first, last = start.positions[:4], after.positions[:4]
    elif field == "body_poses":
        first, last = start.body_poses[1], after.body_poses[1]
    else:
        first, last = getattr(start, field)[0], getattr(after, field)[0]
        wanted = wanted[0]
    if kind in ("pins", "body", "joint"):
        torch.testing.assert_close(last, torch.lerp(first, wanted, fraction), rtol=0, atol=1e-12)
    if kind == "joint":
        torch.testing.assert_close(after.joint_velocities[0], last / DT)
    if kind in ("turning body", "base"):
        # Translation and rotation end at the same fraction.
        place = torch.lerp(first[:3], wanted[:3], fraction)
        torch.testing.assert_close(last[:3], place, rtol=0, atol=1e-12)
        assert abs(last[3:].norm() - 1) < 1e-12
        angles = [2 * torch.acos(pose[3]) for pose in (last, wanted)]
        torch.testing.assert_close(angles[0], fraction * angles[1], rtol=1e-9, atol=1e-9)
        rates = after.base_velocities[0] if kind == "base" else after.body_velocities[1]
        torch.testing.assert_close(rates[3:].norm(), angles[0] / DT)
    # Holding the controls continues from the state.
    assert sim.step(after.detach()).report.motion_fraction == 1


@by_kind
def test_a_loss_of_a_failed_environment_raises_its_error(kind):
    sim = simulator(kind)
    after, leaves = step(kind, sim, sim.initial_state(B), targets(kind, sim))
    error, how = dc.InfeasibleMotion, "complete"
    if kind == "forces":
        error, how = dc.NotConverged, "converge"
    looked = 0
    for name in (*FIELDS, "joint_targets", "soft_pin_targets"):
        value = getattr(after, name)
        if not value.requires_grad or not value.numel():
            continue
        looked += 1
        cotangent = torch.zeros_like(value)
        cotangent[FAILED].flatten()[-1] = 1e-300
        words = rf"did not {how} .* leave environments \[{FAILED}\] out"
        with pytest.raises(error, match=words) as caught:
            torch.autograd.grad(value, leaves, cotangent, retain_graph=True, allow_unused=True)
        assert caught.value.environments == (FAILED,)
        # Many losses, of which one does.
        several = torch.zeros(3, *value.shape, dtype=F64)
        several[:, OTHERS] = 1.0
        grads = torch.autograd.grad(
            value,
            leaves,
            several,
            retain_graph=True,
            is_grads_batched=True,
            allow_unused=True,
            create_graph=True,
        )
        assert all(g is None or not g[:, FAILED].any() for g in grads[:2])
        several[1, FAILED] = 1.0
        with pytest.raises(error):
            torch.autograd.grad(
                value,
                leaves,
                several,
                retain_graph=True,
                is_grads_batched=True,
                allow_unused=True,
            )
        with pytest.raises(error):
            torch.vmap(
                lambda c, value=value: torch.autograd.grad(
                    value, leaves, c, retain_graph=True, allow_unused=True
                )[0]
            )(several)
    assert looked >= 3


@pytest.mark.quick(
    "pins-split-monolithic",
    "pins-coupled-rigid_to_cloth",
    "body-coupled-monolithic",
    "body-coupled-cloth_to_rigid",
    "joint-split-rigid_to_cloth",
    "forces-split-monolithic",
    "forces-coupled-rigid_to_cloth",
)
@by_solve
@pytest.mark.parametrize("kind", ["pins", "body", "joint", "forces"])
def test_rollouts_with_and_without_checkpoints_agree(kind, scheme, coupling):
    sim = simulator(kind, scheme, coupling)

    def run(every):
        wanted = targets(kind, sim).requires_grad_()
        x = sim.initial_state(B).positions.clone().requires_grad_()
        state, states = sim.initial_state(B).replace(positions=x), []
        after = [None, None] if kind == "pins" else []  # squeezed cloth is slow to solve
        controls = [None, control(kind, wanted), *after]
        states = sim.rollout(state, controls, checkpoint_every=every)
        assert states[1].report.status == status(kind, scheme, coupling)
        healthy = states[1].report.converged
        loss = sum(loss_of(dc.where(healthy, s, sim.initial_state(B))) for s in states)
        bars = torch.autograd.grad(loss, (x, wanted), retain_graph=True)
        with pytest.raises(dc.SimulationError, match="has no gradient"):
            torch.autograd.grad((states[1].positions ** 2).sum(), (x, wanted))
        return bars

    free = run(None)
    for every in (2, 4):
        for a, b in zip(free, run(every), strict=True):
            assert torch.equal(a, b)
    assert not free[1][FAILED].any()
    assert free[1][OTHERS].any()


@by_block
def test_a_failure_raises_by_default(kind):
    sim = simulator(kind, throw=True)
    with pytest.raises(dc.InfeasibleMotion, match=rf"environments \[{FAILED}\]") as caught:
        sim.step(sim.initial_state(B), control(kind, targets(kind, sim)))
    assert caught.value.environments == (FAILED,)
    assert caught.value.report.status == status(kind)
    assert caught.value.report.motion_fraction[FAILED] < 1


def test_iterations_that_end_on_the_way_end_the_motion_there():
    sim = simulator("body", max_iterations=3)
    state, poses = sim.initial_state(), sim.initial_state().body_poses.clone()
    poses[1, 2] -= 0.035  # to 5 mm above the sheet, turned by more than one portion
    angle = torch.tensor(1.2, dtype=F64)
    poses[1, 3], poses[1, 6] = torch.cos(angle / 2), torch.sin(angle / 2)
    after = sim.step(state, dc.Control(body_poses=poses))
    assert after.report.status == "infeasible_motion"
    assert after.report.iterations == 3
    assert 0 < after.report.motion_fraction < 1
    assert Judge(sim).is_free(after)


def test_an_intersecting_state_raises_in_any_case():
    sim = simulator("body")
    state = sim.initial_state(B)
    positions = state.positions.clone()
    positions[2, :8, 2] -= 0.05
    with pytest.raises(dc.IntersectingState, match=r"environments \[2\]") as caught:
        sim.step(state.replace(positions=positions))
    assert caught.value.report.status[2] == "intersecting_state"


def test_environments_have_separate_errors():
    """One environment runs out of iterations, another is squeezed, the others are free."""
    sim = failing_scenes.simulator("body", max_iterations=30)
    state = sim.initial_state(B)
    poses = targets("body", sim)
    velocities = state.velocities.clone()
    noise = torch.randn(velocities[1].shape, generator=torch.Generator().manual_seed(3), dtype=F64)
    velocities[1] += 300.0 * noise
    x = state.positions.clone().requires_grad_()
    after = sim.step(state.replace(positions=x, velocities=velocities), control("body", poses))
    names = list(status("body"))
    names[1] = "not_converged"
    assert after.report.status == tuple(names)
    for i, error in ((1, dc.NotConverged), (FAILED, dc.InfeasibleMotion)):
        with pytest.raises(error, match="has no gradient") as caught:
            torch.autograd.grad(after.positions[i].sum(), x, retain_graph=True)
        assert caught.value.environments == (i,)
    torch.autograd.grad(after.positions[[0, 2, 3]].sum(), x)
