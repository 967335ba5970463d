"""A solution of the law is found in every step of sheets that fall and fold."""

import importlib
from pathlib import Path

import pytest
import torch

import diffcloth_torch as dc

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def drape(monkeypatch):
    """Steps of a drape, and its simulator for one of the elastic solvers."""
    monkeypatch.syspath_prepend(ROOT)
    schemes = importlib.import_module("benchmarks.schemes")

    def make(name, elastic):
        scene = schemes.SCENES[name]
        solver = dc.SolverOptions(tolerance=1e-9, max_iterations=60, elastic=elastic)
        made = scene.make(16)
        return scene.steps, dc.Simulator(made, schemes.DT, scheme="projective", solver=solver)

    return make


@pytest.mark.parametrize("name", ["sphere", "box"])
def test_every_step_of_a_drape_converges(name, drape):
    # Steps in which cases of the law alternate, and steps past saddles.
    steps, sim = drape(name, "newton")
    state = sim.initial_state()
    indefinite = 0
    with torch.no_grad():
        for _ in range(steps):
            state = sim.step(state)
            assert state.report.converged
            indefinite += state.report.counts["negative_curvature"]
    assert indefinite > 0


@pytest.mark.quick("sphere")
@pytest.mark.parametrize("name", ["sphere", "box"])
def test_newton_solves_steps_that_local_global_iterations_give_up(name, drape):
    steps, local_global = drape(name, "projective")
    _, newton = drape(name, "newton")
    state = local_global.initial_state()
    left = 0
    for _ in range(steps):
        before, state = state, local_global.step(state)
        assert state.report.converged
        counts = state.report.counts
        assert counts["left_to_newton"] == (counts["exact"] > 0)
        if not counts["left_to_newton"]:
            continue
        left += 1
        # Newton begins at the same start, so solution and gradient are equal to the bit.
        velocities = before.velocities.clone().requires_grad_()
        ends = [s.step(before.replace(velocities=velocities)) for s in (local_global, newton)]
        assert torch.equal(ends[0].positions, ends[1].positions)
        gradients = [torch.autograd.grad(e.positions.square().sum(), velocities)[0] for e in ends]
        assert torch.equal(*gradients)
    assert 0 < left < steps
