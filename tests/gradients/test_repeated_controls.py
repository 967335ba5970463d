"""Controls recomputed by backward behind a checkpoint must equal the rollout's controls."""

import pytest
import scenes
import torch

import diffcloth_torch as dc

F64 = torch.float64
STEPS = 5


@pytest.fixture(scope="module")
def sim():
    vertices, faces = scenes.grid(4, 3)
    cloth = dc.Cloth(vertices, faces, pins={"left": [0, 3], "right": [2]})
    return dc.Simulator(dc.Scene([cloth]), scenes.DT)


def rolled(sim, controls, every=2):
    x = sim.initial_state().positions.clone().requires_grad_()
    states = sim.rollout(
        sim.initial_state().replace(positions=x), controls, steps=STEPS, checkpoint_every=every
    )
    return (states[-1].positions ** 2).sum(), x


def shifted(sim, offset):
    return sim.initial_state().positions[[0, 3, 2]] + offset


@pytest.mark.parametrize("every", [1, 2, 5])
def test_weights_of_a_policy_that_are_edited_before_backward_are_noticed(sim, every):
    weight = torch.tensor(1e-3, dtype=F64, requires_grad=True)

    def policy(k, state):
        return dc.Control(pins=shifted(sim, weight * (k + 1)))

    loss, _ = rolled(sim, policy, every)
    loss.backward()
    assert weight.grad != 0
    loss, _ = rolled(sim, policy, every)
    with torch.no_grad():
        weight += 1e-9
    with pytest.raises(dc.InvalidInput, match=r"another `pins` for the step \[\d\]"):
        loss.backward()


@pytest.mark.parametrize(
    ("first", "again", "field"),
    [
        (lambda p: dc.Control(pins=p), lambda p: dc.Control(pins={"left": p[:2]}), "pins"),
        (lambda p: None, lambda p: dc.Control(pins=p), "pins"),
        (
            lambda p: dc.Control(pins={"left": p[:2]}),
            lambda p: dc.Control(pins={"left": p[:2] + 1e-12}),
            "pins\\['left'\\]",
        ),
        (
            lambda p: dc.Control(forces=[[0.0] * 3] * 12),
            lambda p: dc.Control(forces=[[0.0] * 3] * 11 + [[0.0, 0.0, 1e-9]]),
            "forces",
        ),
    ],
)
def test_any_other_control_is_noticed(sim, first, again, field):
    asked = []

    def controls(k, state):
        make = first if k not in asked or k < 4 else again
        asked.append(k)
        return make(shifted(sim, 0.0))

    loss, x = rolled(sim, controls)
    with pytest.raises(dc.InvalidInput, match=rf"`{field}` for the step \[4\]"):
        torch.autograd.grad(loss, x)


def test_the_same_control_in_other_words_is_the_same(sim):
    asked = []

    def controls(k, state):
        pins = shifted(sim, 1e-3)
        pins = pins.numpy() if k in asked else pins
        asked.append(k)
        return dc.Control(pins=pins)

    loss, x = rolled(sim, controls)
    (gradient,) = torch.autograd.grad(loss, x)
    plain, y = rolled(sim, [dc.Control(pins=shifted(sim, 1e-3))] * STEPS)
    assert torch.equal(gradient, torch.autograd.grad(plain, y)[0])
    assert len(asked) > STEPS


def test_tangents_go_through_functions_and_checkpoints(sim):
    """Forward needs no checkpoint, but a rollout that has some is differentiated all the same."""
    start, at = torch.tensor(0.1, dtype=F64), sim.initial_state()

    def moved(force, every):
        def push(k, state):
            return dc.Control(forces=force * torch.ones_like(at.positions))

        return sim.rollout(at, push, steps=STEPS, checkpoint_every=every)[-1].positions.sum()

    one = torch.ones((), dtype=F64)
    plain = torch.func.jvp(lambda f: moved(f, None), (start,), (one,))[1]
    assert plain != 0
    assert torch.equal(torch.func.jvp(lambda f: moved(f, 2), (start,), (one,))[1], plain)
    assert torch.equal(torch.func.jacfwd(lambda f: moved(f, 2))(start), plain)
    assert torch.func.grad(lambda f: moved(f, None))(start) == pytest.approx(plain.item())
    with pytest.raises(dc.InvalidInput, match="`checkpoint_every` must be None inside"):
        torch.func.grad(lambda f: moved(f, 2))(start)
