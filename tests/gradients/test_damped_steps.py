"""Cached data of damped cloth, whose damping depends on the start of one step."""

import pytest
import torch

import diffcloth_torch as dc


def simulator(damping):
    material = dc.Material(stretch=400.0, bending=1e-2, damping=damping)
    cloth = dc.Cloth.grid(12, 12, size=(0.4, 0.4), material=material)
    return dc.Simulator(dc.Scene([cloth], gravity=(0, 0, 0)), 0.01)


def bent(sim, radius):
    """A sheet at rest that is rolled up to a cylinder, stretched by 2 %."""
    state = sim.initial_state()
    x, y, _ = state.positions.T
    rolled = [radius * torch.sin(x / radius), 1.02 * y, radius * (1 - torch.cos(x / radius))]
    return state.replace(positions=torch.stack(rolled, dim=-1))


def moved(sim, start, parameters=None):
    with torch.no_grad():
        return (sim.step(start, parameters=parameters).positions - start.positions).norm()


def test_strong_damping_holds_every_shape_that_a_step_starts_from():
    sim, free = simulator(1e5), simulator(0.0)
    for radius in (0.2, -0.3, 0.15, 0.2):
        start = bent(sim, radius)
        assert moved(sim, start) < 1e-3 * moved(free, start)


def test_gradients_of_a_step_do_not_depend_on_other_steps():
    sim = simulator(0.02)

    def gradient(start, end):
        return torch.autograd.grad(end.positions.square().sum(), start.positions)[0]

    def start(radius):
        state = bent(sim, radius)
        return state.replace(positions=state.positions.requires_grad_())

    starts = [start(radius) for radius in (0.2, -0.3, 0.15)]
    alone = [gradient(s, sim.step(s)) for s in starts]
    ends = [sim.step(s) for s in starts]
    for k in (1, 0, 2):
        assert torch.equal(gradient(starts[k], ends[k]), alone[k])


@pytest.mark.parametrize("changed", ["damping", "bending", "stretch"])
def test_other_parameters_at_the_same_start_are_other_steps(changed):
    sim = simulator(0.02)
    start = bent(sim, 0.2)
    parameters = sim.default_parameters()
    other = parameters.replace(**{changed: 3 * getattr(parameters, changed)})
    first = moved(sim, start, parameters)
    assert abs(moved(sim, start, other) / first - 1) > 1e-3
    assert moved(sim, start, parameters) == first
