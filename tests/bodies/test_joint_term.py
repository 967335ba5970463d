"""A joint term's energy against the integral of its force; its curvature against differences."""

import numpy as np
import pytest

kernels = pytest.importorskip("diffcloth_torch._kernels", reason="built with DIFFCLOTH_KERNELS")

# Origin, effort, stiffness, its limit, the limit of the speed, friction, slip rate.
ROWS = {
    "drive": [0.1, 0.3, 40.0, 1.0, 1e30, 0.0, 1.0],
    "friction": [0.1, 0.0, 0.0, 1e30, 1e30, 2.0, 3.0],
    "speed": [0.1, 0.0, 0.0, 1e30, 10.0, 0.0, 1.0],
    "all": [0.1, 0.3, 40.0, 1.0, 10.0, 2.0, 3.0],
}
# Within the limit of the speed, on both sides of all others.
SLIPS = [-0.1005, -0.06, -0.02, 0.001, 0.005, 0.033, 0.1005]
# Slips at which a part of the joint term begins or ends.
KINKS = [-0.1, -0.03, -0.015, 0.0, 0.03, 0.1]


@pytest.mark.parametrize("name", ROWS)
def test_the_energy_is_the_integral_of_the_force(name):
    row = ROWS[name]
    nodes, weights = np.polynomial.legendre.leggauss(8)
    for a in SLIPS:
        for b in SLIPS:
            start, end = row[0] + a, row[0] + b
            inner = [row[0] + kink for kink in KINKS if min(a, b) < kink < max(a, b)]
            corners = np.concatenate([np.linspace(start, end, 101), inner])
            corners = np.sort(corners) if a < b else -np.sort(-corners)
            middle, half = (corners[1:] + corners[:-1]) / 2, np.diff(corners) / 2
            points = (middle[:, None] + half[:, None] * nodes).ravel()
            slopes = np.array([kernels.joint_term(row, q, q)[1] for q in points])
            work = half @ (slopes.reshape(-1, 8) @ weights)
            found = kernels.joint_term(row, start, end)[0]
            assert found == pytest.approx(work, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("name", ROWS)
def test_the_curvature_is_the_derivative_of_the_force(name):
    row = ROWS[name]
    for slip in SLIPS:
        q, step = row[0] + slip, 1e-7
        _, _, curvature = kernels.joint_term(row, q, q)
        above, below = (kernels.joint_term(row, q, q + side * step)[1] for side in (1, -1))
        assert curvature == pytest.approx((above - below) / (2 * step), rel=1e-6, abs=1e-6)
