"""A large factor is dropped before the next one is made: the solve finds the same minimum."""

from functools import partial

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
def test_it_finds_the_same_minimum(scheme, monkeypatch):
    kept = states(scheme)
    monkeypatch.setattr(cores._core, "Simulator", partial(cores._core.Simulator, large_factor=0))
    dropped = states(scheme)
    for a, b in zip(kept, dropped, strict=True):
        torch.testing.assert_close(a.positions, b.positions, rtol=0.0, atol=1e-5)
    assert any(s.report.counts["negative_curvature"] for s in dropped)  # none of them near
