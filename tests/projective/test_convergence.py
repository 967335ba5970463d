"""Newton's method finds a solution of the law in every step of sheets that fall and fold."""

import pytest
import torch

import diffcloth_torch as dc
from benchmarks.scenes import DT
from benchmarks.schemes import SCENES


@pytest.mark.parametrize("name", ["sphere", "box"])
def test_every_step_of_a_drape_converges(name):
    # Steps in which cases of the law alternate, and steps past saddles.
    scene = SCENES[name]
    solver = dc.SolverOptions(tolerance=1e-9, max_iterations=60)
    sim = dc.Simulator(scene.make(16), DT, scheme="projective", solver=solver)
    state = sim.initial_state()
    indefinite = 0
    with torch.no_grad():
        for _ in range(scene.steps):
            state = sim.step(state)
            assert state.report.converged
            indefinite += state.report.counts["negative_curvature"]
    assert indefinite > 0
