"""Smoothed Coulomb friction: ipctk, its limits, finite differences by slip and threshold."""

import ipctk
import numpy as np
import pytest

from diffcloth_torch import _kernels as kernels

E = 1e-5
SLIPS = [
    pytest.param(0.0, id="rest"),
    pytest.param(0.01 * E, id="creep"),
    pytest.param(0.7 * E, id="stick"),
    pytest.param(0.999 * E, id="nearly-slip"),
    pytest.param(3.0 * E, id="slip"),
]


@pytest.mark.parametrize("y", SLIPS)
def test_law_agrees_with_ipctk(y):
    f0, f1_over_y, f2, _, _ = kernels.friction_law(y, E)
    np.testing.assert_allclose(f0, ipctk.smooth_friction_f0(y, E), rtol=1e-10)
    np.testing.assert_allclose(f1_over_y, ipctk.smooth_friction_f1_over_x(y, E), rtol=1e-10)
    if y > 0:
        reference = ipctk.smooth_friction_f2_x_minus_f1_over_x3(y, E)
        np.testing.assert_allclose(f2, reference, rtol=1e-10)


@pytest.mark.parametrize("y", SLIPS)
def test_derivatives_match_finite_differences(y):
    step = 1e-6 * E
    _, f1_over_y, f2, f1_over_y_e, f0_e = kernels.friction_law(y, E)
    plus, minus = kernels.friction_law(y, E + step), kernels.friction_law(y, E - step)
    np.testing.assert_allclose((plus[0] - minus[0]) / (2 * step), f0_e, atol=1e-8)
    np.testing.assert_allclose((plus[1] - minus[1]) / (2 * step), f1_over_y_e, atol=1e-8 / E**2)
    if y > 0:
        plus, minus = kernels.friction_law(y + step, E), kernels.friction_law(y - step, E)
        np.testing.assert_allclose((plus[0] - minus[0]) / (2 * step), f1_over_y * y, rtol=1e-4)
        # f2 = (f1/y)' / y
        np.testing.assert_allclose((plus[1] - minus[1]) / (2 * step) / y, f2, rtol=1e-5)


def test_branches_meet_at_the_threshold():
    below, above = kernels.friction_law(E * (1 - 1e-12), E), kernels.friction_law(E, E)
    size = np.array([E, 1 / E, 1 / E**3, 1 / E**2, 1])  # scales of the entries
    np.testing.assert_allclose(below / size, above / size, atol=1e-11)


@pytest.mark.parametrize("y", [0.0, 5e-324, 1e-310, 1e-200, 1e-160])
def test_no_slip_gives_finite_numbers(y):
    law = np.array(kernels.friction_law(y, E))
    assert np.isfinite(law).all()
    assert law[2] * y * y <= 0
    assert law[2] * y * y >= -1e-100
