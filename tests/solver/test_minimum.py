"""A converged step is a minimum: the whole spectrum of its Hessian, by dense eigenvalues."""

import numpy as np
import pytest

import diffcloth_torch as dc
from diffcloth_torch import _core

STRETCH, BENDING, POISSON, DENSITY = 1e4, 1e-5, 0.3, 0.124


def smallest_eigenvalue(cloth, pins, positions, h):
    """Of M/h^2 + W'' at the free vertices, relative to the mean of M/h^2."""
    X = np.ascontiguousarray(cloth.vertices)
    faces = np.ascontiguousarray(cloth.faces, dtype=np.int32)
    one = np.ones(len(faces))
    elastic = _core.kernels.Elastic(X, faces, "patch")
    elastic.set_parameters(STRETCH * one, BENDING * one, POISSON * one, 0 * one, h, None)
    sides = X[faces[:, 1:]] - X[faces[:, :1]]
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    mass = np.bincount(faces.ravel(), np.repeat(DENSITY * area / 3, 3), minlength=len(X))
    H = elastic.hessian(np.ascontiguousarray(positions), False) + np.diag(np.repeat(mass, 3)) / h**2
    free = np.flatnonzero(np.repeat(~np.isin(np.arange(len(X)), pins), 3))
    return np.linalg.eigvalsh(H[np.ix_(free, free)])[0] * h**2 / mass.mean()


# Hung in its plane by two corners, and standing on them: in the plane both are saddles.
@pytest.mark.parametrize("pins", [[90, 99], [0, 9]], ids=["hung", "standing"])
@pytest.mark.parametrize("scheme", ["coupled", "split"])
def test_a_flat_sheet_never_stops_in_a_saddle(pins, scheme):
    h = 0.05
    material = dc.Material(STRETCH, BENDING, POISSON, DENSITY)
    cloth = dc.Cloth.grid(10, 10, material=material, pins={"corners": pins})
    scene = dc.Scene([cloth], gravity=(0, -9.81, 0))
    contact = dc.ContactOptions(self_contact=False)
    sim = dc.Simulator(scene, h, scheme=scheme, contact=contact)
    state = sim.initial_state()
    for _ in range(3):
        state = sim.step(state)
        assert smallest_eigenvalue(cloth, pins, state.positions.numpy(), h) > 0
    assert state.positions[:, 2].abs().max() > 1e-4
