"""A stiff sheet that rotates far in one step: a long path in a narrow, curved valley."""

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

pytestmark = pytest.mark.rounding


def falling_sheet(velocity: tuple[float, ...]) -> tuple[dc.Simulator, dc.State]:
    """5 mm of a sheet held by a corner, thrown by more than its size in one step.

    Its stretch stiffness is 1.5 million times its inertia M / h^2.
    """
    grid = dc.Cloth.grid(12, 12, (5.2e-3, 5.2e-3))
    flat = np.array(grid.vertices)
    flat[:, :2] += 5e-5 * np.random.default_rng(3).uniform(-1, 1, (144, 2))
    material = dc.Material(stretch=1.4e4, bending=2e-5, density=0.088)
    cloth = dc.Cloth(flat, grid.faces, pins={"corner": [132]}, material=material)
    simulator = dc.Simulator(dc.Scene([cloth]), 0.016)
    start = simulator.initial_state()
    thrown = start.velocities + torch.tensor(velocity, dtype=torch.float64)
    return simulator, start.replace(velocities=thrown)


def test_a_stiff_sheet_that_turns_far_does_not_creep():
    """Medians of 24 throws: 58 iterations, 233 without excursions; single throws take up to 409."""
    random = np.random.default_rng(0)
    iterations = []
    for _ in range(11):
        simulator, start = falling_sheet(tuple(random.uniform(-0.4, 0.4, 3)))
        with torch.no_grad():
            iterations.append(int(simulator.step(start).report.iterations))
    assert np.median(iterations) < 120


@pytest.mark.slow
def test_the_path_omits_undone_iterates():
    """In some of the throws excursions are undone; which ones depends on rounding."""
    random = np.random.default_rng(1)
    shorter = []
    for _ in range(8):
        simulator, start = falling_sheet(tuple(random.uniform(-0.4, 0.4, 3)))
        with torch.no_grad():
            path = simulator.path(start, dc.Control())
            after = simulator.step(start)
        assert torch.equal(path[-1][: len(after.positions)], after.positions)
        shorter.append(len(path) < after.report.iterations)
    assert any(shorter)
