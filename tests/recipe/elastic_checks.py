"""A scheme without contact, the example of docs/extending.md; runs in the extended copy."""

import torch
from differences import difference

import diffcloth_torch as dc
from diffcloth_torch import _core


def simulator(scheme, **options):
    cloth = dc.Cloth.grid(5, 6, (0.3, 0.25), pins={"edge": range(6)})
    return dc.Simulator(dc.Scene([cloth], **options), 0.01, scheme=scheme)


def test_the_scheme_has_a_name_and_abilities():
    assert list(_core.schemes)[-1] == "elastic"
    assert _core.schemes["elastic"]["barrier"] is False


def test_the_scheme_equals_the_coupled_scheme_without_contact():
    ends = []
    for scheme in ("coupled", "elastic"):
        sim = simulator(scheme)
        state = sim.initial_state(2)
        for _ in range(5):
            state = sim.step(state)
        assert state.report.converged.all()
        ends.append(state.positions)
    torch.testing.assert_close(*ends, rtol=0, atol=1e-6)


def test_cloth_passes_through_a_body():
    sim = simulator("elastic", bodies=[dc.RigidBody.box(0.1, pose=[0, 0, -0.08, 1, 0, 0, 0])])
    state = sim.initial_state()
    for _ in range(20):
        state = sim.step(state)
    assert state.positions[:, 2].min() < -0.05
    assert state.report.contact_count == 0


def test_gradients_are_those_of_differences():
    sim = simulator("elastic")
    start = sim.step(sim.initial_state())
    weights = torch.linspace(-1.0, 1.0, 90, dtype=torch.float64).reshape(30, 3)

    def loss(stretch):
        state = sim.step(start, None, dc.Parameters(stretch=stretch))
        return (weights * state.velocities).sum()

    stretch = torch.tensor(150.0, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(stretch), stretch)
    one = torch.ones((), dtype=torch.float64)
    expected = difference(lambda value: loss(value).item(), stretch.detach(), one, 0.1)
    assert abs(gradient.item() - expected) < 1e-4 * abs(expected)
    tangent = torch.func.jacfwd(loss)(stretch.detach())
    assert abs(gradient.item() - tangent.item()) < 1e-8 * abs(gradient.item())
