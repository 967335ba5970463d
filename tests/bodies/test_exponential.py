"""The rotation by a vector and its derivatives, against matrix exponentials."""

import numpy as np
import pytest
from scipy.linalg import expm

kernels = pytest.importorskip("diffcloth_torch._kernels", reason="built with DIFFCLOTH_KERNELS")

# Zero, small rotations, both sides of the switch from series to closed form, large ones [rad].
TURNS = [0.0, 1e-9, 1e-3, 0.3, 0.4999, 0.5001, 0.9, 1.5, 2.0, 3.1, 5.0]


def cross(w):
    return np.cross(w, np.eye(3)).T


def oracle(w):
    """R and its derivatives: blocks of exponentials of block matrices (Higham 2008, 3.2)."""
    a, e = cross(w), [cross(row) for row in np.eye(3)]
    zero = np.zeros((3, 3))
    out = [expm(a)]
    for i in range(3):
        out.append(expm(np.block([[a, e[i]], [zero, a]]))[:3, 3:])
    for i in range(3):
        for j in range(3):
            rows = [[a, e[i], e[j], zero], [zero, a, zero, e[j]], [zero, zero, a, e[i]]]
            out.append(expm(np.block([*rows, [zero, zero, zero, a]]))[:3, 9:])
    return np.array(out)


@pytest.mark.parametrize("turn", TURNS)
def test_the_exponential_and_its_derivatives_match_matrix_exponentials(turn):
    for axis in np.random.default_rng(0).normal(size=(4, 3)):
        w = turn * axis / np.linalg.norm(axis)
        # Rounding: the oracle's own error is 1e-14 for large rotations.
        np.testing.assert_allclose(kernels.exponential(w), oracle(w), rtol=0, atol=5e-14)
