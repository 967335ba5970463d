"""Elastic models that a simulator caches from one step to the next."""

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

WOVEN = {"stretch_weft": 300.0, "stretch_shear": 100.0, "bending_weft": 2e-4, "bending_twill": 3e-4}


def simulator() -> dc.Simulator:
    """A bent sheet of woven cloth that hangs by a corner."""
    grid = np.array([(i, j) for i in range(5) for j in range(5)], dtype=float) / 10
    flat = np.column_stack([grid, np.zeros(25)])
    faces = [
        corners
        for i in range(4)
        for j in range(4)
        for a in [5 * i + j]
        for corners in ((a, a + 5, a + 6), (a, a + 6, a + 1))
    ]
    bent = flat + np.column_stack([np.zeros((25, 2)), 0.03 * np.sin(20 * grid[:, :1])])
    cloth = dc.Cloth(
        bent,
        faces,
        material=dc.Material(**WOVEN),
        rest_positions=flat,
        directions=(1.0, 0.2, 0.0),
        pins={"corner": [0]},
    )
    return dc.Simulator(dc.Scene(cloths=[cloth]), 0.01)


@pytest.mark.parametrize("name", ["stretch", "bending", "poisson", *WOVEN])
def test_no_step_has_the_numbers_of_another(name):
    """A changed parameter counts, and the former one again: as in a simulator without steps."""
    used = simulator()
    state = used.initial_state()
    given = used.default_parameters()
    changed = given.replace(**{name: 0.5 * getattr(given, name) + 1e-5})
    first, other, again = (used.step(state, None, p) for p in (given, changed, given))
    fresh = simulator().step(state, None, changed)
    assert torch.equal(first.positions, again.positions)
    assert torch.equal(other.positions, fresh.positions)
    assert not torch.equal(first.positions, other.positions)
