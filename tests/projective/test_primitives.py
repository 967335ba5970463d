"""Signed distances, normals and their derivatives against a search and against differences."""

import numpy as np
import pytest
from oracles import primitives as oracle

kernels = pytest.importorskip("diffcloth_torch._kernels", reason="built with DIFFCLOTH_KERNELS")

SOLIDS = {
    "sphere": ((0.7, 0.0, 0.0), oracle.sphere(0.7)),
    "capsule": ((0.3, 0.5, 0.0), oracle.capsule(0.3, 0.5)),
    "box": ((0.4, 0.25, 0.6), oracle.box(0.4, 0.25, 0.6)),
}


def nearest(kind, point):
    found = np.array(kernels.nearest(kind, list(SOLIDS.get(kind, ((0.0,) * 3,))[0]), list(point)))
    matrices = found[7:].reshape(2, 3, 3)
    return found[0], found[1:4], found[4:7], matrices[0], matrices[1]


@pytest.mark.parametrize("kind", SOLIDS)
def test_the_nearest_point_is_that_of_a_search(kind):
    charts, inside = SOLIDS[kind][1]
    rng = np.random.default_rng(0)
    # Few random points are inside the solid; the sample must include both signs of each axis.
    within = [y for y in rng.uniform(-0.6, 0.6, (400, 3)) if inside(y)][:15]
    assert (np.sign(within).min(0) < 0).all()
    assert len(within) == 15
    for y in [*rng.uniform(-1.0, 1.0, (25, 3)), *within]:
        distance, normal, point, *_ = nearest(kind, y)
        expected = oracle.nearest_point(charts, y)
        sign = -1.0 if inside(y) else 1.0
        assert distance == pytest.approx(sign * np.linalg.norm(y - expected), abs=1e-7)
        np.testing.assert_allclose(y - distance * normal, expected, atol=1e-5)
        np.testing.assert_allclose(point, y - distance * normal, atol=1e-15)
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-14)


def test_a_plane_is_infinite_and_solid_below():
    for y in ((50.0, -80.0, 0.3), (0.0, 0.0, -2.0)):
        distance, normal, *_ = nearest("plane", y)
        assert distance == y[2]
        np.testing.assert_array_equal(normal, [0.0, 0.0, 1.0])


@pytest.mark.parametrize("kind", [*SOLIDS, "plane"])
def test_derivatives_are_those_of_differences(kind):
    step = 1e-6
    for y in np.random.default_rng(1).uniform(-1.0, 1.0, (25, 3)):
        _, normal, _, by_normal, by_point = nearest(kind, y)
        for k in range(3):
            d = step * np.eye(3)[k]
            above, below = nearest(kind, y + d), nearest(kind, y - d)
            np.testing.assert_allclose((above[0] - below[0]) / (2 * step), normal[k], atol=1e-8)
            np.testing.assert_allclose(
                (above[1] - below[1]) / (2 * step), by_normal[:, k], atol=1e-6
            )
            np.testing.assert_allclose(
                (above[2] - below[2]) / (2 * step), by_point[:, k], atol=1e-6
            )


@pytest.mark.parametrize("kind", SOLIDS)
def test_a_single_normal_is_chosen_among_many_nearest_points(kind):
    distance, normal, *_ = nearest(kind, (0.0, 0.0, 0.0))
    assert distance < 0.0
    assert np.linalg.norm(normal) == 1.0
