"""The gradient by each entry of a barrier stiffness of pairs, against central differences."""

from functools import cache

import numpy as np
import pytest
import scenes
import torch
from differences import mismatch
from test_step_gradients import gradients, make_loss

import diffcloth_torch as dc

F64 = torch.float64
NAME = "parameters.barrier_stiffness"
SURFACES = 4  # two sheets on each other, a box under them, and one beside it
TOUCHING = {(0, 1), (0, 2), (0, 3)}

# Values that differ from pair to pair, and from (i, j) to (j, i).
STIFFNESS = torch.from_numpy(15.0 + 10.0 * np.random.default_rng(3).random((SURFACES, SURFACES)))

SCHEMES = [("coupled", None), ("split", "mass"), ("split", "elastic")]


@cache
def case(scheme, metric, iterations):
    """The lower sheet lies on two boxes and carries the upper sheet, which slides on it."""
    lower, faces = scenes.grid(6, 6, seed=3)
    upper, upper_faces = scenes.grid(4, 4, seed=5)
    lower, upper = lower - lower.mean(axis=0), upper - upper.mean(axis=0)
    cloths = [
        dc.Cloth(
            rest + np.array([0.0, 0.0, height]),
            triangles,
            rest_positions=rest,
            material=scenes.material(triangles, friction=0.4),
            bending_model="patch",
        )
        for rest, triangles, height in ((lower, faces, 0.008), (upper, upper_faces, 0.0165))
    ]
    boxes = [
        dc.RigidBody.box((0.2, 0.5, 0.2), pose=[x, 0.0, -0.1, 1, 0, 0, 0]) for x in (-0.13, 0.131)
    ]
    sim = scenes.simulator(
        cloths, boxes, scheme=scheme, metric=metric, friction_iterations=iterations
    )
    parameters = sim.default_parameters().replace(barrier_stiffness=STIFFNESS)
    with torch.no_grad():
        state = sim.rollout(sim.initial_state(), parameters=parameters, steps=6)[-1].detach()
    velocities = state.velocities.clone()
    velocities[len(lower) :] += torch.tensor([0.5, 0.3, -0.05], dtype=F64)
    return scenes.Case(
        sim, state.replace(velocities=velocities), parameters={"barrier_stiffness": STIFFNESS}
    )


@pytest.mark.parametrize("iterations", [1, 2])
@pytest.mark.parametrize("scheme", SCHEMES, ids=["coupled", "split-mass", "split-elastic"])
def test_every_entry_of_the_stiffness_has_its_gradient(scheme, iterations):
    given = case(*scheme, iterations)
    loss = make_loss(given)
    found = gradients(given, loss)[NAME]
    assert found.shape == STIFFNESS.shape
    assert torch.equal(found, found.T)
    touching = {(i, j) for i, j in found.nonzero().tolist() if i <= j}
    assert touching == TOUCHING

    def value(stiffness):
        with torch.no_grad():
            return loss(given.step({NAME: stiffness})).item()

    for i, j in [*TOUCHING, *((j, i) for i, j in TOUCHING)]:
        d = torch.zeros_like(STIFFNESS)
        d[i, j] = 1.0
        assert mismatch(value, STIFFNESS, found, d, 0.04, 1e-5) < 1e-5, (i, j)


@pytest.mark.parametrize("scheme", SCHEMES[:2], ids=["coupled", "split"])
def test_environments_have_the_gradients_that_they_have_alone(scheme):
    given = case(*scheme, 2)
    sim, loss = given.sim, make_loss(given)
    state = dc.stack([given.state] * 2)
    stiffness = torch.stack([STIFFNESS, 1.3 * STIFFNESS.T]).requires_grad_()
    end = sim.step(state, None, sim.default_parameters().replace(barrier_stiffness=stiffness))
    (found,) = torch.autograd.grad(loss(end[0]) + loss(end[1]), stiffness)
    for k in range(2):
        alone = given.where(parameters={"barrier_stiffness": stiffness[k].detach()})
        assert torch.equal(found[k], gradients(alone, loss)[NAME])

    # A stiffness shared by all environments has the sum of their gradients.
    shared = STIFFNESS.clone().requires_grad_()
    end = sim.step(state, None, sim.default_parameters().replace(barrier_stiffness=shared))
    (together,) = torch.autograd.grad(loss(end[0]) + loss(end[1]), shared)
    torch.testing.assert_close(together, 2.0 * found[0], rtol=1e-12, atol=0)
