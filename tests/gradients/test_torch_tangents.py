"""Tangents through torch against backward, <u, J v> = <J^T u, v>, for all inputs at once."""

from __future__ import annotations

import pytest
import scenes
import test_attachment_gradients as attachments
import torch
from bodies import coupled_scenes
from sim import test_equilibrium as resting
from torch.autograd import forward_ad

import diffcloth_torch as dc

F64 = torch.float64
TOLERANCE = 1e-11

FIELDS = (
    *("positions", "velocities", "body_poses", "body_velocities", "soft_pin_targets"),
    *("body_forces", "contact_forces", "pin_forces", "joint_positions", "joint_velocities"),
    *("joint_targets", "joint_efforts", "base_poses", "base_velocities"),
)


def random(tensors, seed):
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(t.shape, generator=generator, dtype=F64) for t in tensors]


def outputs_of(state):
    return [getattr(state, name) for name in FIELDS if getattr(state, name).numel()]


def tangents_of(outputs):
    found = [forward_ad.unpack_dual(t).tangent for t in outputs]
    return [torch.zeros_like(t) if d is None else d for t, d in zip(outputs, found, strict=True)]


def check(function, inputs):
    """<u, J v> = <J^T u, v>, for each output with all inputs, whose tangents are random.

    Args:
        function: Map from a list of tensors to one tensor.
        inputs: The tensors.
    """
    inputs = [t.detach().to(F64) for t in inputs]
    # Tangents have the scale of their inputs: rounding of the largest must not hide the others.
    v = [
        d * max(float(t.abs().max()), 1e-3) for d, t in zip(random(inputs, 1), inputs, strict=True)
    ]
    with forward_ad.dual_level():
        duals = [forward_ad.make_dual(t, d) for t, d in zip(inputs, v, strict=True)]
        forward = tangents_of(function(duals))
    leaves = [t.clone().requires_grad_() for t in inputs]
    outputs = function(leaves)
    moved = 0
    for k, (output, tangent) in enumerate(zip(outputs, forward, strict=True)):
        if not output.requires_grad:
            assert not tangent.any()
            continue
        (u,) = random([output], 100 + k)
        gradients = torch.autograd.grad(output, leaves, u, retain_graph=True, allow_unused=True)
        terms = [(g * d).sum() for g, d in zip(gradients, v, strict=True) if g is not None]
        sizes = [(g * d).abs().sum() for g, d in zip(gradients, v, strict=True) if g is not None]
        error = abs(float((u * tangent).sum() - sum(terms)))
        size = float((u * tangent).abs().sum() + sum(sizes))
        assert error <= TOLERANCE * size, (k, error, size)
        moved += bool(tangent.any())
    assert moved >= 2


def check_case(case):
    names = list(case.inputs())

    def step(values):
        return outputs_of(case.step(dict(zip(names, values, strict=True))))

    check(step, [case.inputs()[name] for name in names])


SPLIT = ("hanging", "sliding", "folded", "pushing")
PROJECTIVE = ("hanging", "pinned")


@pytest.mark.parametrize("name", scenes.REGIMES)
def test_tangents_of_steps_agree_with_gradients(name):
    check_case(scenes.regime(name))


@pytest.mark.parametrize("metric", ["energy", "elastic", "mass", "identity"])
@pytest.mark.parametrize("name", SPLIT)
def test_steps_in_two_stages(name, metric):
    check_case(scenes.regime(name, "split", metric))


@pytest.mark.parametrize("name", PROJECTIVE)
def test_tangents_of_projective_steps_agree_with_gradients(name):
    check_case(scenes.regime(name, "projective"))


@pytest.mark.parametrize("make", [attachments.picked, attachments.sewn, attachments.held])
def test_tangents_by_attachments_agree_with_gradients(make):
    check_case(make(**attachments.SCHEMES["coupled"]))


@pytest.mark.parametrize("make", [attachments.picked, attachments.sewn, attachments.held])
def test_attachments_by_many_tangents_at_once(make):
    """A control that is the same in all directions, as in a fit, and one that is not."""
    case = make(**attachments.SCHEMES["coupled"])
    wanted = ("state.positions", "control.attachment_weights", "control.attachments")
    names = [name for name in wanted if name in case.inputs()]
    inputs = [case.inputs()[name] for name in names]

    def step(positions, scale):
        given = dict(zip(names, [positions, *inputs[1:]], strict=True))
        if wanted[1] in given:
            given[wanted[1]] = given[wanted[1]] * scale
        return case.step(given).positions

    one = torch.ones((), dtype=F64)
    by_position, by_scale = torch.func.jacfwd(step, argnums=(0, 1))(inputs[0], one)
    for seed in range(2):
        v = random([inputs[0], one], seed)
        _, expected = torch.func.jvp(step, (inputs[0], one), tuple(v))
        found = torch.tensordot(by_position, v[0], dims=2) + by_scale * v[1]
        torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-11)


def moving_fields(state):
    names = ("positions", "velocities", "body_poses", "body_velocities", "joint_positions")
    names += ("joint_velocities", "joint_targets", "base_poses", "base_velocities")
    return [n for n in (*names, "soft_pin_targets") if getattr(state, n).numel()]


@pytest.mark.parametrize("base", ["fixed", "floating", "kinematic"])
@pytest.mark.parametrize("coupling", coupled_scenes.COUPLINGS)
def test_bodies_and_robots(coupling, base):
    """Two steps, by all fields of the state, the control and the parameters."""
    sim, start = coupled_scenes.in_contact(coupling, base)
    wanted, parameters = coupled_scenes.control(sim), coupled_scenes.parameters(sim)
    of_state = moving_fields(start)
    of_control = [n for n, t in vars(wanted).items() if isinstance(t, torch.Tensor)]
    if base != "floating":
        of_control.remove("base_wrenches")
    of_parameters = [
        n for n, t in vars(parameters).items() if isinstance(t, torch.Tensor) and t.numel()
    ]

    def steps(values):
        values = iter(values)
        state = start.replace(**{n: next(values) for n in of_state})
        control = wanted.replace(**{n: next(values) for n in of_control})
        given = parameters.replace(**{n: next(values) for n in of_parameters})
        return outputs_of(sim.rollout(state, [control, control], given)[-1])

    tensors = [getattr(start, n) for n in of_state] + [getattr(wanted, n) for n in of_control]
    check(steps, tensors + [getattr(parameters, n) for n in of_parameters])


def test_environments_share_parameters():
    case = scenes.regime("sphere")
    sim = case.sim
    start = dc.stack([case.state, case.state.replace(velocities=1.5 * case.state.velocities)])
    parameters = sim.default_parameters()

    def step(values):
        x, gravity, stretch, forces = values
        after = sim.step(
            start.replace(positions=x),
            dc.Control(forces=forces),
            parameters.replace(gravity=gravity, stretch=stretch),
        )
        return outputs_of(after)

    stretch = torch.stack([parameters.stretch, 1.2 * parameters.stretch])
    check(step, [start.positions, parameters.gravity, stretch, case.control["forces"]])


def test_equilibria():
    sim = resting.drape()
    parameters = sim.default_parameters()
    names = ("bending", "stretch", "friction", "gravity", "rest_positions", "thickness")

    def rest(values):
        given = parameters.replace(**dict(zip(names, values[1:], strict=True)))
        start = sim.initial_state().replace(positions=values[0])
        return outputs_of(sim.equilibrium(start, None, given))

    check(rest, [sim.initial_state().positions, *(getattr(parameters, n) for n in names)])


def test_energies():
    case = scenes.regime("folded")
    sim, parameters = case.sim, case.sim.default_parameters()
    names = ("bending", "stretch", "thickness", "gravity", "rest_positions", "density")

    def energies(values):
        given = parameters.replace(**dict(zip(names, values[1:], strict=True)))
        state = case.state.replace(positions=values[0])
        return list(sim.energy(state, parameters=given, parts=True).values())

    check(energies, [case.state.positions, *(getattr(parameters, n) for n in names)])


@pytest.mark.parametrize("transform", ["jacfwd", "jvp", "dual", "vectorized"])
def test_many_directions_take_one_call(transform, monkeypatch):
    case = scenes.regime("sphere")
    calls = []
    core = case.sim._core

    class Spy:
        def __getattr__(self, name):
            return getattr(core, name)

        def forward(self, *arguments):
            calls.append("forward")
            return core.forward(*arguments)

        def tangent(self, inputs, tape, kept, tangents, directions, threads):
            calls.append(directions)
            return core.tangent(inputs, tape, kept, tangents, directions, threads)

    monkeypatch.setattr(case.sim._engine, "core", Spy())
    parameters = case.sim.default_parameters()

    def step(theta):
        given = parameters.replace(gravity=theta[:3], bending=theta[3], barrier_distance=theta[4])
        return case.sim.step(case.state, None, given).positions

    theta = torch.cat(
        [parameters.gravity, parameters.bending.mean()[None], parameters.barrier_distance[None]]
    )
    directions = torch.eye(5, dtype=F64)
    if transform == "jacfwd":
        found = torch.func.jacfwd(step)(theta).movedim(-1, 0)
        assert calls == ["forward", 5]
    elif transform == "vectorized":
        found = torch.autograd.functional.jacobian(
            step, theta, vectorize=True, strategy="forward-mode"
        ).movedim(-1, 0)
        assert calls[0] == "forward"
        assert calls.count(5) == 1
    elif transform == "jvp":
        found = torch.stack([torch.func.jvp(step, (theta,), (d,))[1] for d in directions])
        assert calls == ["forward", 1] * 5
    else:
        rows = []
        for direction in directions:
            with forward_ad.dual_level():
                after = step(forward_ad.make_dual(theta, direction))
                rows.append(forward_ad.unpack_dual(after).tangent)
        found = torch.stack(rows)
    expected = torch.func.jacrev(step)(theta).movedim(-1, 0)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-11 * expected.abs().max())


def test_a_jacobian_of_a_rollout_against_differences():
    case = scenes.regime("sphere")
    parameters = case.sim.default_parameters()

    def end(theta):
        given = parameters.replace(stretch=theta[0], bending=theta[1], friction=theta[2])
        return case.sim.rollout(case.state, None, given, steps=5)[-1].positions.flatten()

    theta = torch.tensor([300.0, 1e-5, 0.4], dtype=F64)
    found = torch.func.jacfwd(end)(theta)
    for k in range(3):
        step = torch.zeros(3, dtype=F64)
        step[k] = 1e-5 * theta[k]
        difference = (end(theta + step) - end(theta - step)) / (2 * step[k])
        error = (found[:, k] - difference).norm() / difference.norm()
        assert error < 1e-4, (k, error)


def test_jacobians_of_pickers_in_a_batch():
    """Targets and weights of each environment, inside transforms."""
    cloth = dc.Cloth.grid(6, 6, (0.3, 0.3), name="sheet", pins={"edge": range(6)})
    picker = dc.Attachment(("sheet", [30, 35]), stiffness=50.0, name="picker")
    sim = dc.Simulator(dc.Scene([cloth], attachments=[picker]), 0.01)
    start = sim.initial_state(2)
    targets = torch.tensor(cloth.vertices[[30, 35]]) + 0.05

    def end(values):
        weights, shift = values[:4].reshape(2, 2), values[4:].reshape(2, 1, 3)
        control = dc.Control(
            attachments={"picker": targets + shift}, attachment_weights={"picker": weights}
        )
        return sim.rollout(start, [control] * 2)[-1].positions

    values = torch.cat([torch.full((4,), 0.5, dtype=F64), torch.zeros(6, dtype=F64)])
    found, expected = torch.func.jacfwd(end)(values), torch.func.jacrev(end)(values)
    # Both are exact up to the rounding of two solves.
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-11 * float(expected.abs().max()))
    assert found[0, ..., :2].any()
    assert not found[0, ..., 2:4].any()


class TestFailures:
    """With throw=False a failed environment has no tangent, and the others have tangents."""

    def run(self, moved):
        cloth = dc.Cloth.grid(6, 6, (0.3, 0.3), pose=[0, 0, 0.2, 1, 0, 0, 0])
        solver = dc.SolverOptions(throw=False, max_iterations=3)
        sim = dc.Simulator(dc.Scene([cloth], [dc.RigidBody.sphere(0.1)]), 0.01, solver=solver)
        state = sim.initial_state(batch_size=2)
        v = torch.zeros_like(state.velocities)
        v[1] = 60.0 * torch.sin(40 * state.positions[1])
        state = state.replace(velocities=v)
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(state.positions, moved(state.positions))
            after = sim.step(state.replace(positions=dual))
            assert after.report.status == ("converged", "not_converged")
            return forward_ad.unpack_dual(after.positions).tangent

    def test_failed_environments_raise(self):
        with pytest.raises(dc.SimulationError, match=r"step: .*environments \[1\]"):
            self.run(torch.ones_like)

    def test_other_environments_have_tangents(self):
        def first(x):
            direction = torch.zeros_like(x)
            direction[0] = 1.0
            return direction

        tangent = self.run(first)
        assert tangent[0].any()
        assert not tangent[1].any()
