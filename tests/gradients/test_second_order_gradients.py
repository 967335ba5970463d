"""Every gradient of a step of second order against differences, in each regime of contact."""

import pytest
import scenes
import torch
from differences import directional
from test_step_gradients import FREE, check, gradients, make_loss

import diffcloth_torch as dc

F64 = torch.float64
SECOND = {"integrator": "second_order"}
IN_AIR = ["hanging", "curved", "hinge", "woven", "woven_flat"]
IN_CONTACT = [
    "sticking",
    "sliding",
    "separating",
    "landing",
    "leaving",
    "thick",
    "pushing",
    "pinned",
    "held",
    "folded",
    "folded_thick",
    "stacked",
    "dragged",
    "sphere",
    "poking",
    "woven_pinned",
    "woven_stacked",
]


@pytest.mark.quick("hanging", "woven", "sticking", "sliding", "pinned", "held", "folded")
@pytest.mark.parametrize("name", [*IN_AIR, *IN_CONTACT])
def test_every_gradient_is_that_of_the_step(name):
    case = scenes.regime(name, **SECOND)
    assert case.step().report.converged
    check(case, FREE, zero=None)


def test_tangents_are_backward_transposed():
    case = scenes.regime("pinned", **SECOND)
    loss = make_loss(case)
    found = gradients(case, loss)
    inputs = case.inputs()
    g = torch.Generator().manual_seed(2)
    direction = {n: torch.randn(t.shape, generator=g, dtype=F64) for n, t in inputs.items()}
    skipped = ("state.soft_pin_targets",)  # a control replaces them
    direction = {n: d for n, d in direction.items() if n not in skipped}
    names = list(direction)

    def at(*values):
        return loss(case.step(dict(zip(names, values, strict=True))))

    _, along = torch.func.jvp(
        at, tuple(inputs[n] for n in names), tuple(direction[n] for n in names)
    )
    expected = sum((found[n] * direction[n]).sum() for n in names)
    scale = torch.stack([(found[n] * direction[n]).sum() for n in names]).norm()
    assert ((along - expected).abs() / scale).item() < 1e-9


def test_gradients_along_a_checkpointed_rollout():
    case = scenes.regime("stacked", **SECOND)

    def run(velocities, every):
        start = case.state.replace(velocities=velocities)
        states = case.sim.rollout(start, steps=4, checkpoint_every=every)
        return (states[-1].positions * scenes.tensor_noise(velocities.shape, 1.0, 5)).sum()

    found = []
    for every in (None, 2):
        velocities = case.state.velocities.clone().requires_grad_()
        found.append(torch.autograd.grad(run(velocities, every), velocities)[0])
    assert torch.equal(*found)
    inputs = {"velocities": case.state.velocities}
    assert directional(lambda given: run(given["velocities"], None), inputs, ["velocities"]) < 1e-4


def test_the_conversion_to_the_half_step_has_a_gradient():
    case = scenes.regime("hanging", **SECOND)
    inputs = {"positions": case.state.positions, "velocities": case.state.velocities}
    start = case.sim.initial_state()
    weights = scenes.tensor_noise(start.positions.shape, 1.0, 6)

    def loss(given):
        return (weights * dc.at_half_step(start.replace(**given)).velocities).sum()

    for name in inputs:
        assert directional(loss, inputs, [name]) < 1e-6
