"""Newton's method finds a solution of the law in every step of sheets that fall and fold."""

import importlib
from pathlib import Path

import pytest
import torch

import diffcloth_torch as dc

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", ["sphere", "box"])
def test_every_step_of_a_drape_converges(name, monkeypatch):
    # Steps in which cases of the law alternate, and steps past saddles.
    monkeypatch.syspath_prepend(ROOT)
    schemes = importlib.import_module("benchmarks.schemes")
    scene = schemes.SCENES[name]
    solver = dc.SolverOptions(tolerance=1e-9, max_iterations=60)
    sim = dc.Simulator(scene.make(16), schemes.DT, scheme="projective", solver=solver)
    state = sim.initial_state()
    indefinite = 0
    with torch.no_grad():
        for _ in range(scene.steps):
            state = sim.step(state)
            assert state.report.converged
            indefinite += state.report.counts["negative_curvature"]
    assert indefinite > 0
