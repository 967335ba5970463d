"""Coulomb's law at many contacts whose velocities depend on all impulses."""

import numpy as np
import pytest

from diffcloth_torch import _kernels


def contacts(m, seed, condition):
    """A response of velocities to impulses, velocities without impulses, and normals."""
    rng = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(rng.normal(size=(3 * m, 3 * m)))
    W = basis @ np.diag(np.geomspace(1.0, condition, 3 * m)) @ basis.T
    normals = rng.normal(size=(m, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    q = rng.normal(size=(m, 3)) - 0.5 * normals
    return (W + W.T) / 2, q, normals


@pytest.mark.parametrize("condition", [5.0, 30.0])
@pytest.mark.parametrize("friction", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("m", [1, 2, 12, 40])
def test_impulses_and_velocities_obey_the_law(m, friction, condition):
    cases = np.zeros(3, int)
    for seed in range(5):
        W, q, normals = contacts(m, seed, condition)
        found = _kernels.solve_coulomb(
            W.ravel().tolist(), q.ravel().tolist(), normals.ravel().tolist(), friction, 1e-12, 5000
        )
        r = np.array(found).reshape(m, 3)
        u = q + (W @ r.ravel()).reshape(m, 3)
        small = 1e-9 * np.abs(q).max()  # of velocities; W is no smaller than 1
        r_n, u_n = (r * normals).sum(1), (u * normals).sum(1)
        r_t, u_t = r - r_n[:, None] * normals, u - u_n[:, None] * normals
        limit, pull, slip = friction * r_n, np.linalg.norm(r_t, axis=1), np.linalg.norm(u_t, axis=1)
        # Signorini: no pull, no approach, and never force and separation at once.
        assert (r_n >= -small).all()
        assert (u_n >= -small).all()
        assert (np.minimum(r_n, u_n) <= small).all()
        # Coulomb: impulses are within the cone; at slip, on its border and opposed to the slip.
        assert (pull <= limit + small).all()
        slips = (r_n > small) & (slip > small)
        assert (np.abs(pull - limit)[slips] <= small).all()
        assert ((r_t * u_t).sum(1)[slips] <= -(pull * slip)[slips] + small).all()
        cases += [(r_n <= small).sum(), (slip <= small).sum(), slips.sum()]
    if m > 2:
        assert cases[0] > 0
        assert cases[2] > 0
        assert (cases[1] > 0) == (friction > 0.0)


@pytest.mark.parametrize("friction", [0.3, 1.0])
def test_newtons_method_completes_twenty_sweeps(friction):
    """Sweeps alone need up to eighty; the last sweep only confirms the law."""
    for seed in range(5):
        W, q, normals = contacts(40, seed, 30.0)
        _kernels.solve_coulomb(
            W.ravel().tolist(), q.ravel().tolist(), normals.ravel().tolist(), friction, 1e-12, 21
        )
