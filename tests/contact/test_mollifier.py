"""The edge-edge mollifier: ipctk, its limits, finite differences by corners and threshold."""

import ipctk
import numpy as np
import pytest

from diffcloth_torch import _kernels as kernels


def nearly_parallel(seed):
    """Two edges whose |u x v|^2 is about half the threshold."""
    rng = np.random.default_rng(seed)
    a0, u, b0, across = rng.normal(size=(4, 3))
    x = np.array([a0, a0 + u, b0, b0 + 1.3 * u + 0.01 * across])
    q = np.sum(np.cross(x[1] - x[0], x[3] - x[2]) ** 2)
    return x, q / rng.uniform(0.2, 0.9)


def test_threshold_is_a_thousandth_of_the_squared_rest_lengths():
    rest = np.random.default_rng(0).normal(size=(4, 3))
    lengths_sq = np.sum((rest[1] - rest[0]) ** 2), np.sum((rest[3] - rest[2]) ** 2)
    np.testing.assert_allclose(
        kernels.mollifier_threshold(*lengths_sq), ipctk.edge_edge_mollifier_threshold(*rest)
    )


@pytest.mark.parametrize("seed", range(5))
def test_value_and_derivatives_agree_with_ipctk(seed):
    x, eps = nearly_parallel(seed)
    m, gradient, hessian, _, _ = kernels.mollifier_derivatives(x, eps)
    assert kernels.mollifier(x, eps) == (m, True)
    np.testing.assert_allclose(m, ipctk.edge_edge_mollifier(*x, eps), rtol=1e-12)
    reference = ipctk.edge_edge_mollifier_gradient(*x, eps)
    np.testing.assert_allclose(gradient, reference, atol=1e-10 * abs(reference).max())
    reference = ipctk.edge_edge_mollifier_hessian(*x, eps)
    np.testing.assert_allclose(hessian, reference, atol=1e-10 * abs(reference).max())


@pytest.mark.parametrize("seed", range(5))
def test_derivatives_match_finite_differences(seed):
    x, eps = nearly_parallel(seed)
    _, gradient, hessian, m_eps, gradient_eps = kernels.mollifier_derivatives(x, eps)
    step = 1e-7
    for i in range(12):
        dx = np.zeros(12)
        dx[i] = step
        plus = kernels.mollifier_derivatives(x + dx.reshape(4, 3), eps)
        minus = kernels.mollifier_derivatives(x - dx.reshape(4, 3), eps)
        # Variations have the length of the angle, 0.01: truncation (step / 0.01)^2.
        np.testing.assert_allclose(
            (plus[0] - minus[0]) / (2 * step), gradient[i], atol=1e-6 * abs(gradient).max()
        )
        np.testing.assert_allclose(
            (plus[1] - minus[1]) / (2 * step), hessian[i], atol=1e-6 * abs(hessian).max()
        )
    d_eps = 1e-6 * eps
    plus = kernels.mollifier_derivatives(x, eps + d_eps)
    minus = kernels.mollifier_derivatives(x, eps - d_eps)
    np.testing.assert_allclose((plus[0] - minus[0]) / (2 * d_eps), m_eps, rtol=1e-7)
    np.testing.assert_allclose(
        (plus[1] - minus[1]) / (2 * d_eps), gradient_eps, atol=1e-7 * abs(gradient_eps).max()
    )


def test_the_plateau_has_no_derivatives():
    x, eps = nearly_parallel(0)
    q = np.sum(np.cross(x[1] - x[0], x[3] - x[2]) ** 2)
    m, *derivatives = kernels.mollifier_derivatives(x, 0.9 * q)
    assert m == 1
    assert all(np.all(np.asarray(d) == 0) for d in derivatives)
    assert kernels.mollifier(x, 0.9 * q) == (1, False)
    assert kernels.mollifier(x, eps)[1]


def test_parallel_edges_have_no_weight():
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0.2, 1, 0], [1.2, 1, 0]])
    m, gradient, *_ = kernels.mollifier_derivatives(x, 1e-3)
    assert m == 0
    assert (gradient == 0).all()
