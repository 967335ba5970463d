"""Several losses in one backward: the gradients of a loop over them, to the bit.

Seven losses exceed one pass over a factor, so backward processes a step in portions.
"""

import numpy as np
import pytest
import scenes
import torch

import diffcloth_torch as dc

F64 = torch.float64
LOSSES = 7
SCHEMES = ["coupled", "split", "projective"]


def random_cotangents(outputs, count=LOSSES, seed=0):
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(count, *y.shape, generator=g, dtype=F64) for y in outputs]


def in_a_loop(outputs, leaves, cotangents):
    rows = [
        torch.autograd.grad(outputs, leaves, [c[k] for c in cotangents], retain_graph=True)
        for k in range(len(cotangents[0]))
    ]
    return [torch.stack(column) for column in zip(*rows, strict=True)]


def at_once(outputs, leaves, cotangents, **options):
    return torch.autograd.grad(
        outputs, leaves, cotangents, retain_graph=True, is_grads_batched=True, **options
    )


def assert_same(found, expected, names):
    for name, a, b in zip(names, found, expected, strict=True):
        assert torch.equal(a, b), f"{name}: off by {(a - b).abs().max():.2g} of {b.abs().max():.2g}"


def taken(case):
    """Outputs of a step, and its leaves: all inputs that the control does not replace."""
    replaced = {"state.soft_pin_targets"} if "soft_pins" in case.control else set()
    values = {name: t for name, t in case.inputs().items() if name not in replaced}
    leaves = {name: t.clone().requires_grad_() for name, t in values.items()}
    after = case.step(leaves)
    return [after.positions, after.velocities, after.body_forces], leaves


@pytest.mark.parametrize("scheme", ["coupled", "split"])
@pytest.mark.parametrize("name", list(scenes.REGIMES))
def test_every_input_gets_the_gradients_of_a_loop(name, scheme):
    outputs, leaves = taken(scenes.regime(name, scheme))
    cotangents = random_cotangents(outputs)
    for cotangent in cotangents:
        cotangent[2] = 0.0  # a loss that does not depend on the step
    values = list(leaves.values())
    found = at_once(outputs, values, cotangents)
    assert_same(found, in_a_loop(outputs, values, cotangents), leaves)
    assert all(f[2].count_nonzero() == 0 for f in found)


@pytest.mark.parametrize("names", [["state.velocities"], ["parameters.friction"]])
def test_a_single_input_gets_the_gradients_of_a_loop(names):
    outputs, leaves = taken(scenes.regime("pinned"))
    cotangents = random_cotangents(outputs)
    values = [leaves[name] for name in names]
    expected = in_a_loop(outputs, values, cotangents)
    assert_same(at_once(outputs, values, cotangents), expected, names)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_batch_gets_the_gradients_of_a_loop(scheme):
    """Environments share parameters, and two losses depend on a single environment."""
    vertices, faces = scenes.grid(5, 5)
    ball = dc.RigidBody.sphere(0.05, pose=[0, 0, -0.053, 1, 0, 0, 0])
    scene = dc.Scene([dc.Cloth(vertices, faces, pins={"a": [0]})], [ball])
    contact = dc.ContactOptions(barrier_distance=0.01)
    sim = dc.Simulator(scene, scenes.DT, scheme=scheme, contact=contact)
    state = sim.initial_state(3)
    x = state.positions.clone().requires_grad_()
    v = scenes.tensor_noise((3, 25, 3), 0.05) - torch.tensor([0.0, 0.0, 0.4], dtype=F64)
    v.requires_grad_()
    shared = sim.default_parameters()
    names = ("stretch", "density", "friction", "rest_positions")
    parameters = {n: getattr(shared, n).clone().requires_grad_() for n in names}
    after = sim.step(state.replace(positions=x, velocities=v), None, shared.replace(**parameters))
    assert (after.report.contact_count > 0).all()
    outputs = [after.positions, after.velocities, after.body_forces]
    cotangents = random_cotangents(outputs)
    for cotangent in cotangents:
        cotangent[0, 1:] = 0.0
        cotangent[3, [0, 2]] = 0.0
    leaves = {"positions": x, "velocities": v, **parameters}
    values = list(leaves.values())
    found = at_once(outputs, values, cotangents)
    assert_same(found, in_a_loop(outputs, values, cotangents), leaves)
    assert found[0][0, 1:].count_nonzero() == 0
    assert found[0][0, 0].count_nonzero() > 0


def bodies_and_a_robot(coupling):
    vertices, faces = scenes.grid(5, 5)
    cloth = dc.Cloth(vertices, faces, pins={"corner": [0]})
    box = dc.RigidBody.box(0.06, motion="dynamic", mass=0.05, pose=[0, 0, 0.035, 1, 0, 0, 0])
    hand = dc.Robot.load(dc.robots.GRIPPER, pose=[0, 0, 3, 1, 0, 0, 0], stiffness=1.0, damping=1.0)
    scene = dc.Scene([cloth], [box], [hand])
    contact = dc.ContactOptions(barrier_distance=0.01)
    return dc.Simulator(scene, scenes.DT, coupling=coupling, contact=contact)


@pytest.mark.filterwarnings("ignore::diffcloth_torch.AddedMassWarning")
@pytest.mark.parametrize("checkpoint_every", [None, 2])
@pytest.mark.parametrize("coupling", ["monolithic", "rigid_to_cloth", "cloth_to_rigid"])
def test_rollouts_with_bodies_and_robots_get_the_gradients_of_a_loop(coupling, checkpoint_every):
    sim = bodies_and_a_robot(coupling)
    state = sim.initial_state()
    leaves = {
        "velocities": torch.zeros_like(state.velocities),
        "body_velocities": torch.tensor([[0.1, 0.0, -0.5, 0.2, 0.3, 0.0]], dtype=F64),
        "joint_velocities": scenes.tensor_noise(state.joint_velocities.shape, 0.1),
    }
    leaves = {name: t.requires_grad_() for name, t in leaves.items()}
    mass = sim.default_parameters().body_mass.clone().requires_grad_()
    end = sim.rollout(
        state.replace(**leaves),
        None,
        sim.default_parameters().replace(body_mass=mass),
        steps=3,
        checkpoint_every=checkpoint_every,
    )[-1]
    assert end.report.contact_count > 0
    outputs = [end.positions, end.body_poses, end.joint_positions, end.body_forces]
    cotangents = random_cotangents(outputs)
    leaves["body_mass"] = mass
    values = list(leaves.values())
    found = at_once(outputs, values, cotangents)
    for name, a, b in zip(leaves, found, in_a_loop(outputs, values, cotangents), strict=True):
        # Torch operations around a step sum matrix products in another order.
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12 * float(b.abs().max()), msg=name)


def test_the_jacobian_of_a_sliding_sheet_is_that_of_a_loop_and_of_differences():
    case = scenes.regime("sliding")
    v = case.inputs()["state.velocities"]

    def positions(velocities):
        return case.step({"state.velocities": velocities}).positions

    jacobian = torch.autograd.functional.jacobian(positions, v, vectorize=True)
    assert torch.equal(jacobian, torch.autograd.functional.jacobian(positions, v))
    for seed in range(3):
        d = scenes.tensor_noise(v.shape, 1.0, seed)
        with torch.no_grad():
            step = 2e-3
            change = (positions(v + step * d) - positions(v - step * d)) / (2 * step)
        product = torch.tensordot(jacobian, d, 2)
        # Second order in a step that moves contacts by a small part of the barrier.
        torch.testing.assert_close(product, change, rtol=0, atol=1e-4 * float(change.abs().max()))


def test_vmap_over_backward_is_the_loop():
    outputs, leaves = taken(scenes.regime("pinned"))
    cotangents = random_cotangents(outputs, 6)
    values = list(leaves.values())
    expected = in_a_loop(outputs, values, cotangents)

    def pull_back(*cotangent):
        return torch.autograd.grad(outputs, values, cotangent, retain_graph=True)

    assert_same(torch.vmap(pull_back)(*cotangents), expected, leaves)
    last = [c.movedim(0, -1) for c in cotangents]
    assert_same(torch.vmap(pull_back, in_dims=-1)(*last), expected, leaves)
    folded = [c.reshape(2, 3, *c.shape[1:]) for c in cotangents]
    nested = torch.vmap(torch.vmap(pull_back))(*folded)
    assert_same([t.flatten(0, 1) for t in nested], expected, leaves)
    # All losses share one cotangent.
    shared = [cotangents[0][0], *cotangents[1:]]
    found = torch.vmap(pull_back, in_dims=(None, 0, 0))(*shared)
    spread = [shared[0].expand_as(cotangents[0]), *cotangents[1:]]
    assert_same(found, in_a_loop(outputs, values, spread), leaves)


def test_all_losses_go_through_one_call_of_the_core(monkeypatch):
    case = scenes.regime("pinned")
    core, asked = case.sim._core, []

    class Spy:
        def __getattr__(self, name):
            return getattr(core, name)

        def backward(self, inputs, tape, kept, cotangents, losses, *rest):
            asked.append(losses)
            return core.backward(inputs, tape, kept, cotangents, losses, *rest)

    monkeypatch.setattr(case.sim._engine, "core", Spy())
    outputs, leaves = taken(case)
    at_once(outputs, list(leaves.values()), random_cotangents(outputs))
    assert asked == [LOSSES]


def test_second_derivatives_of_several_losses_are_refused():
    outputs, leaves = taken(scenes.regime("pinned"))
    gradients = at_once(
        outputs, list(leaves.values()), random_cotangents(outputs), create_graph=True
    )
    for gradient in gradients:
        with pytest.raises(RuntimeError, match=r"second derivatives of \w+ are not available"):
            gradient.sum().backward(retain_graph=True)


def test_any_loss_that_needs_an_unconverged_environment_raises():
    vertices, faces = scenes.grid(5, 5)
    cloth = dc.Cloth(vertices + np.array([0.0, 0.0, 0.02]), faces)
    sim = dc.Simulator(
        dc.Scene([cloth], [dc.RigidBody.plane(2.0)]),
        scenes.DT,
        contact=dc.ContactOptions(barrier_distance=0.01),
        solver=dc.SolverOptions(throw=False, max_iterations=2),
    )
    v = torch.zeros(2, 25, 3, dtype=F64)
    v[1, :, 2] = -3.0
    v[1] += scenes.tensor_noise((25, 3), 0.5)
    v.requires_grad_()
    after = sim.step(sim.initial_state(2).replace(velocities=v))
    assert after.report.converged.tolist() == [True, False]
    cotangents = random_cotangents([after.positions], 3)
    cotangents[0][:, 1] = 0.0
    (found,) = at_once([after.positions], [v], cotangents)
    assert_same([found], in_a_loop([after.positions], [v], cotangents), ["velocities"])
    cotangents[0][2, 1, 0, 0] = 1.0
    with pytest.raises(dc.NotConverged, match="a step that did not converge has no gradient"):
        at_once([after.positions], [v], cotangents)
