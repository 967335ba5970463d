"""The barrier: ipctk's, rescaled; its limits; finite differences by distance and parameters."""

import ipctk
import numpy as np
import pytest

from diffcloth_torch import _kernels as kernels

THICKNESSES = [pytest.param(0.0, id="no-thickness"), pytest.param(3e-3, id="thick")]
D_HAT = 1e-3


def squared_distances(xi):
    """Squared distances for gaps from 0.01 to 0.95 of the activation distance."""
    return (xi + D_HAT * np.array([0.01, 0.1, 0.3, 0.5, 0.7, 0.95])) ** 2


@pytest.mark.parametrize("xi", THICKNESSES)
def test_value_and_derivatives_agree_with_ipctk(xi):
    s = 2 * xi * D_HAT + D_HAT**2
    reference = ipctk.ClampedLogBarrier()
    for D in squared_distances(xi):
        b, b1, b2, *_ = kernels.barrier_derivatives(D, xi, D_HAT)
        sigma = D - xi**2
        scale = D_HAT / s**2  # the physical normalization
        np.testing.assert_allclose(b, scale * reference(sigma, s), rtol=1e-10)
        np.testing.assert_allclose(b1, scale * reference.first_derivative(sigma, s), rtol=1e-10)
        np.testing.assert_allclose(b2, scale * reference.second_derivative(sigma, s), rtol=1e-10)
        assert kernels.barrier(D, xi, D_HAT) == b


@pytest.mark.parametrize("xi", THICKNESSES)
@pytest.mark.parametrize(
    ("argument", "of_value", "of_slope"),
    [
        pytest.param(0, 1, 2, id="distance"),
        pytest.param(1, 5, 6, id="thickness"),
        pytest.param(2, 3, 4, id="activation"),
    ],
)
def test_derivatives_match_finite_differences(xi, argument, of_value, of_slope):
    for D in squared_distances(xi):
        at = np.array([D, xi, D_HAT])
        # Steps are a share of the gap (in each argument's own scale), so that truncation,
        # (step / gap)^2 = 1e-8, and rounding, 1e-16 D / (gap step), both stay below 1e-6.
        gap = np.sqrt(D) - xi
        step = np.zeros(3)
        step[argument] = 1e-4 * gap * (2 * np.sqrt(D) if argument == 0 else 1)
        if argument == 2:
            step[2] = 1e-5 * D_HAT
        plus = kernels.barrier_derivatives(*(at + step))
        minus = kernels.barrier_derivatives(*(at - step))
        exact = kernels.barrier_derivatives(*at)
        width = 2 * step[argument]
        np.testing.assert_allclose((plus[0] - minus[0]) / width, exact[of_value], rtol=2e-6)
        np.testing.assert_allclose((plus[1] - minus[1]) / width, exact[of_slope], rtol=2e-6)


@pytest.mark.parametrize("xi", THICKNESSES)
def test_the_barrier_vanishes_beyond_the_activation_distance(xi):
    for distance in (1 + 1e-12, 1.5, 100.0):
        D = (xi + distance * D_HAT) ** 2
        assert kernels.barrier(D, xi, D_HAT) == 0
        assert kernels.barrier_derivatives(D, xi, D_HAT) == (0,) * 7


@pytest.mark.parametrize("xi", THICKNESSES)
def test_the_barrier_is_infinite_in_contact(xi):
    for D in (xi**2, 0.5 * xi**2):
        assert kernels.barrier(D, xi, D_HAT) == np.inf
        assert kernels.barrier_derivatives(D, xi, D_HAT)[0] == np.inf


@pytest.mark.parametrize(
    ("gap", "pressure"), [(0.95, 0.058), (0.7, 1.76), (0.5, 4.33), (0.3, 8.15), (0.1, 21.4)]
)
def test_resting_pressure_in_units_of_the_stiffness(gap, pressure):
    d = gap * D_HAT
    b1 = kernels.barrier_derivatives(d**2, 0.0, D_HAT)[1]
    # The table's values have three digits.
    np.testing.assert_allclose(-2 * d * b1, pressure, rtol=6e-3)
