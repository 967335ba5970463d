"""Soft pins against their formula and differences."""

import numpy as np
from elastic_meshes import differences

from diffcloth_torch import _kernels

RNG = np.random.default_rng(9)
VERTEX = np.array([4, 1, 1], np.int32)  # two springs on one vertex
STIFFNESS = np.array([2.0, 3.0, 0.5])
TARGET = RNG.normal(size=(3, 3))
X0, X1, Z = RNG.normal(size=(3, 6, 3))


def anchors(x1=X1, stiffness=STIFFNESS, target=TARGET, x0=X0):
    return _kernels.anchors(VERTEX, stiffness, target, x0, x1, Z)


def test_energy_is_that_of_springs():
    expected = 0.5 * (STIFFNESS * ((X1[VERTEX] - TARGET) ** 2).sum(1)).sum()
    assert np.isclose(anchors()["energy"], expected, rtol=1e-14)
    change = anchors()["energy"] - anchors(X0)["energy"]
    assert np.isclose(anchors()["energy_change"], change, rtol=1e-13)


def test_derivatives_match_differences():
    out = anchors()
    # The energy is quadratic: differences are exact to rounding.
    g = differences(lambda x: anchors(x)["energy"], X1, 1e-2).reshape(X1.shape)
    Hz = differences(lambda t: anchors(X1 + t[0] * Z)["gradient"], np.zeros(1), 1e-2)[..., 0]
    np.testing.assert_allclose(out["gradient"], g, atol=1e-11)
    np.testing.assert_allclose(out["hessian_product"], Hz, atol=1e-11)
    dense = np.einsum("ijk,ik->ij", out["hessian_blocks"], Z)
    np.testing.assert_allclose(dense, Hz, atol=1e-11)


def test_mixed_derivatives_match_differences():
    out = anchors()
    k = differences(lambda k: (Z * anchors(stiffness=k)["gradient"]).sum(), STIFFNESS, 1e-2)
    c = differences(lambda c: (Z * anchors(target=c)["gradient"]).sum(), TARGET, 1e-2)
    np.testing.assert_allclose(out["stiffness_bar"], k, atol=1e-11)
    np.testing.assert_allclose(out["target_bar"], c.reshape(TARGET.shape), atol=1e-11)
