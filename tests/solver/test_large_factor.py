"""A large factor is dropped before the next one is made, and made again with the same bits."""

from functools import partial

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.sim import cores


def states(scheme):
    """A stiff sheet on a floor buckles as its edges are pushed together; its contacts change."""
    edges = {"left": range(8), "right": range(56, 64)}
    cloth = dc.Cloth.grid(
        8,
        8,
        (0.3, 0.3),
        pose=[0, 0, 0.004, 1, 0, 0, 0],
        material=dc.Material(stretch=5000.0),
        pins=edges,
    )
    scene = dc.Scene([cloth], [dc.RigidBody.plane(2.0)])
    simulator = dc.Simulator(scene, 0.01, scheme=scheme)
    state = simulator.initial_state()
    pins = state.positions[[i for edge in edges.values() for i in edge]]
    result = []
    with torch.no_grad():
        for k in range(10):
            pushed = pins.clone()
            pushed[:, :2] *= 1.0 - 0.02 * (k + 1)
            state = simulator.step(state, dc.Control(pins=pushed))
            result.append(state)
    return result


@pytest.mark.parametrize("scheme", ["coupled", "split"])
def test_it_changes_no_bit(scheme, monkeypatch):
    kept = states(scheme)
    monkeypatch.setattr(cores._core, "Simulator", partial(cores._core.Simulator, large_factor=0))
    dropped = states(scheme)
    for a, b in zip(kept, dropped, strict=True):
        assert torch.equal(a.positions, b.positions)
        assert a.report.iterations == b.report.iterations
    counts = np.array([[s.report.counts["factorizations"] for s in x] for x in (kept, dropped)])
    assert (counts[0] <= counts[1]).all()
    assert counts[0].sum() < counts[1].sum()  # some were made again
