"""The baseline against a trajectory of the original DiffCloth, and gradients of a slide."""

import numpy as np
import pytest
import torch
from nodal_scenes import counts
from public_data import public

import diffcloth_torch as dc


@pytest.fixture(scope="module")
def reference():
    return np.load(public("reference/diffcloth_sphere.npz"))


def simulator(reference, tolerance, **options):
    material = dc.Material(
        stretch=150.0, bending=1e-5, density=0.3, damping=0.0, friction=0.3, thickness=0.0
    )
    cloth = dc.Cloth(
        reference["positions"][0], reference["faces"], material=material, bending_model="hinge"
    )
    # A contact band of .1: half of the sum of both thicknesses.
    ball = dc.RigidBody.sphere(2.0, pose=[0.6, -2.1, 0.2, 1, 0, 0, 0], friction=0.3, thickness=0.2)
    return dc.Simulator(
        dc.Scene([cloth], [ball], gravity=(0.0, -9.8, 0.0)),
        1 / 180,
        scheme="projective",
        contact=dc.ContactOptions(self_contact=False),
        solver=dc.SolverOptions(tolerance=tolerance, **options),
    )


@pytest.mark.parametrize("elastic", ["newton", "projective"])
def test_a_trajectory_of_the_original_is_reproduced(reference, elastic):
    sim = simulator(reference, 1e-9, elastic=elastic)
    state = sim.initial_state()
    with torch.no_grad():
        for k in range(30):
            state = sim.step(state)
            assert counts(state) == tuple(reference["contact_types"][k]), k
            if k % 10 == 9:
                expected = torch.from_numpy(reference["positions"][(k + 1) // 10])
                assert (state.positions - expected).abs().max() < 1e-7


@pytest.mark.parametrize("steps", [1, 5, 20])
def test_gradients_of_a_slide_on_a_sphere(reference, steps):
    sim = simulator(reference, 1e-11)
    start = sim.initial_state().replace(
        positions=torch.from_numpy(reference["positions"][4]),
        velocities=torch.from_numpy(reference["velocities"][4]),
    )
    weights = torch.randn(625, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def final(x):
        state, pattern = start.replace(positions=x), []
        for _ in range(steps):
            state = sim.step(state)
            pattern.append(counts(state))
        return (state.positions * weights).sum(), pattern

    x = start.positions.clone().requires_grad_()
    loss, pattern = final(x)
    assert all(slipping > 0 for _, _, slipping in pattern)
    (gradient,) = torch.autograd.grad(loss, x)
    direction = torch.randn(625, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    size = 1e-8  # at 1e-7 m vertices change from one case of the law to another within 20 steps
    with torch.no_grad():
        ends = [final(x + sign * size * direction) for sign in (1, -1)]
    assert ends[0][1] == ends[1][1] == pattern
    difference = (ends[0][0] - ends[1][0]).item() / (2 * size)
    scale = (gradient * direction).norm().item()
    assert abs(difference - (gradient * direction).sum().item()) < 1e-5 * scale
