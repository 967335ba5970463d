"""Distances of point-triangle and edge-edge pairs: exact arithmetic, ipctk, finite differences."""

import itertools
from fractions import Fraction

import ipctk
import numpy as np
import pytest

from diffcloth_torch import _kernels as kernels

POINT_TRIANGLE, EDGE_EDGE = False, True
KINDS = [
    pytest.param(POINT_TRIANGLE, id="point-triangle"),
    pytest.param(EDGE_EDGE, id="edge-edge"),
]

# Offsets that walk a point through the regions of an element and onto their borders.
OFFSETS = (-10.0, -1.0, -1e-12, 0.0, 1e-12, 0.3, 1.0, 10.0)


def rational(x):
    return [[Fraction(float(value)) for value in corner] for corner in x]


def dot(a, b):
    return sum(p * q for p, q in zip(a, b, strict=True))


def sub(a, b):
    return [p - q for p, q in zip(a, b, strict=True)]


def along(a, s, e):
    return [p + s * q for p, q in zip(a, e, strict=True)]


def exact_point_segment(p, a, b):
    e, w = sub(b, a), sub(p, a)
    length_sq = dot(e, e)
    s = min(max(dot(w, e) / length_sq, Fraction(0)), Fraction(1)) if length_sq else Fraction(0)
    r = along(w, -s, e)
    return dot(r, r)


def exact_interior(w, e0, e1):
    """Minimum of |w - b0 e0 - b1 e1|^2, with b0, b1; None if e0 and e1 are parallel."""
    a, b, c = dot(e0, e0), dot(e0, e1), dot(e1, e1)
    det = a * c - b * b
    if det == 0:
        return None
    d0, d1 = dot(w, e0), dot(w, e1)
    b0, b1 = (c * d0 - b * d1) / det, (a * d1 - b * d0) / det
    r = along(along(w, -b0, e0), -b1, e1)
    return dot(r, r), b0, b1


def exact_distance_sq(edge_edge, x):
    """Squared distance in rational arithmetic: the least over all features of the pair."""
    x = rational(x)
    if edge_edge:
        a0, a1, b0, b1 = x
        found = [
            exact_point_segment(a0, b0, b1),
            exact_point_segment(a1, b0, b1),
            exact_point_segment(b0, a0, a1),
            exact_point_segment(b1, a0, a1),
        ]
        interior = exact_interior(sub(b0, a0), sub(a1, a0), sub(b0, b1))
        inside = interior and 0 <= interior[1] <= 1 and 0 <= interior[2] <= 1
    else:
        p, t0, t1, t2 = x
        found = [exact_point_segment(p, a, b) for a, b in ((t0, t1), (t1, t2), (t2, t0))]
        interior = exact_interior(sub(p, t0), sub(t1, t0), sub(t2, t0))
        inside = interior and interior[1] >= 0 and interior[2] >= 0
        inside = inside and interior[1] + interior[2] <= 1
    if inside:
        found.append(interior[0])
    return float(min(found))


def random_pairs(count, seed):
    return np.random.default_rng(seed).normal(size=(count, 4, 3))


def all_regions(edge_edge):
    """Pairs in every region and on the borders between them."""
    for s, t, height in itertools.product(OFFSETS, OFFSETS, (0.0, 1e-6, 0.7)):
        if edge_edge:
            # Edge a along x; its line passes the line of b at parameters (s, t).
            b = np.array([[0.0, -t, height], [0.0, 1 - t, height]])
            yield np.vstack([[[-s, 0.0, 0.0], [1 - s, 0.0, 0.0]], b])
        else:
            triangle = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.2, 1.1, 0.0]])
            yield np.vstack([[[s, t, height]], triangle])


def degenerate_pairs(edge_edge):
    """Edges of no length, triangles of no area, slivers, parallel and collinear edges."""
    rng = np.random.default_rng(3)
    direction = np.array([0.6, -0.3, 0.7])
    for offset in OFFSETS:
        p = rng.normal(size=3)
        if edge_edge:
            a0, shift = np.zeros(3), np.array([0.1, 0.2, -0.1]) * offset
            for twist in (0.0, 1e-16, 1e-12, 1e-8, 1e-5):
                turned = direction + twist * np.array([0.3, 0.6, 0.0])
                yield np.array([a0, direction, shift, shift + turned])
                yield np.array([a0, direction, shift, shift - 2 * turned])
            yield np.array([a0, direction, offset * direction, (offset + 0.5) * direction])
            yield np.array([a0, a0, p, p + direction])
            yield np.array([a0, direction, p, p])
            yield np.array([a0, a0, p, p])
        else:
            t0 = rng.normal(size=3)
            for width in (0.0, 1e-16, 1e-12, 1e-8, 1e-5):
                across = width * np.array([0.3, 0.6, 0.0])
                yield np.array([p, t0, t0 + direction, t0 + offset * direction + across])
                yield np.array(
                    [t0 + 0.5 * direction, t0, t0 + direction, t0 + 0.3 * direction + across]
                )
            yield np.array([p, t0, t0, t0 + direction])
            yield np.array([p, t0, t0, t0])


def scale_sq(x):
    return max(1.0, np.ptp(x, axis=0).max() ** 2)


@pytest.mark.parametrize("edge_edge", KINDS)
@pytest.mark.parametrize("pairs", [all_regions, degenerate_pairs])
def test_distances_are_those_of_exact_arithmetic(edge_edge, pairs):
    for x in pairs(edge_edge):
        exact = exact_distance_sq(edge_edge, x)
        # Rounding of a distance d is 1e-15 L with the size L, hence of its square
        # L 1e-15 (2 d + L 1e-15).
        size_sq = scale_sq(x)
        tolerance = 1e-14 * np.sqrt(size_sq * exact) + 1e-28 * size_sq
        (robust,) = kernels.distance_sq(edge_edge, x[None])
        assert abs(robust - exact) <= tolerance, x
        # The classified distance ignores the interior of pairs parallel to 1.6e-8.
        classified = kernels.closest(edge_edge, x)[6]
        assert abs(classified - exact) <= tolerance + 5e-16 * size_sq, x


@pytest.mark.parametrize("edge_edge", KINDS)
@pytest.mark.parametrize("pairs", [all_regions, degenerate_pairs])
def test_distances_of_many_pairs_are_those_of_each(edge_edge, pairs):
    x = np.array([*pairs(edge_edge), *random_pairs(301, seed=5)])
    alone = kernels.distance_sq(edge_edge, x)
    levels = kernels.kernel_levels()
    many = [kernels.distances_sq(level, edge_edge, x) for level in levels]
    size_sq = np.array([scale_sq(pair) for pair in x])
    assert np.all(np.abs(many[0] - alone) <= 1e-14 * np.sqrt(size_sq * alone) + 1e-28 * size_sq)
    for level, distances in zip(levels, many, strict=True):
        assert distances.tobytes() == many[0].tobytes(), level
        # The bits are independent of neighboring pairs, and of their absence.
        shifted = kernels.distances_sq(level, edge_edge, x[3:])
        assert shifted.tobytes() == distances[3:].tobytes(), level
        one = kernels.distances_sq(level, edge_edge, x[-1:])
        assert one.tobytes() == distances[-1:].tobytes(), level


@pytest.mark.parametrize("edge_edge", KINDS)
def test_distances_agree_with_ipctk(edge_edge):
    reference = ipctk.edge_edge_distance if edge_edge else ipctk.point_triangle_distance
    x = random_pairs(500, seed=0)
    expected = np.array([reference(*pair) for pair in x])
    np.testing.assert_allclose(kernels.distance_sq(edge_edge, x), expected, rtol=1e-10)
    classified = np.array([kernels.closest(edge_edge, pair)[6] for pair in x])
    np.testing.assert_allclose(classified, expected, rtol=1e-10)


@pytest.mark.parametrize("edge_edge", KINDS)
@pytest.mark.parametrize("pairs", [all_regions, degenerate_pairs])
def test_closest_points_have_the_bits_of_the_closest_vector(edge_edge, pairs):
    counts = set()
    for x in [*pairs(edge_edge), *random_pairs(300, seed=5)]:
        c, count, *_, d_sq = kernels.closest(edge_edge, x)
        points = kernels.closest_points(edge_edge, x)
        assert points[0].tobytes() == c.tobytes()
        assert points[1:] == (count, d_sq)
        counts.add(count)
    assert counts == {0, 1, 2}


@pytest.mark.parametrize("edge_edge", KINDS)
def test_derivatives_agree_with_ipctk(edge_edge):
    name = "edge_edge" if edge_edge else "point_triangle"
    gradient_of = getattr(ipctk, f"{name}_distance_gradient")
    hessian_of = getattr(ipctk, f"{name}_distance_hessian")
    for x in random_pairs(500, seed=1):
        _, gradient, hessian, _ = kernels.distance_sq_derivatives(edge_edge, x)
        reference = gradient_of(*x)
        np.testing.assert_allclose(gradient, reference, atol=1e-10 * abs(reference).max())
        reference = hessian_of(*x)
        np.testing.assert_allclose(hessian, reference, atol=1e-9 * abs(reference).max())


def one_pair_per_region(edge_edge):
    """Random pairs until every number of parameters was seen often."""
    rng = np.random.default_rng(2)
    seen = [0, 0, 0]
    while min(seen) < 8:
        x = rng.normal(size=(4, 3))
        count = kernels.closest(edge_edge, x)[1]
        if seen[count] < 8:
            seen[count] += 1
            yield x


@pytest.mark.parametrize("edge_edge", KINDS)
def test_derivatives_match_finite_differences(edge_edge):
    step = 1e-6
    for x in one_pair_per_region(edge_edge):
        _, gradient, hessian, _ = kernels.distance_sq_derivatives(edge_edge, x)
        for i in range(12):
            dx = np.zeros(12)
            dx[i] = step
            plus = kernels.distance_sq_derivatives(edge_edge, x + dx.reshape(4, 3))
            minus = kernels.distance_sq_derivatives(edge_edge, x - dx.reshape(4, 3))
            # Truncation is step^2 = 1e-12 times third derivatives, rounding 1e-16 / step = 1e-10.
            scale = max(1.0, abs(hessian).max()) ** 2
            assert abs((plus[0] - minus[0]) / (2 * step) - gradient[i]) < 1e-8 * scale
            np.testing.assert_allclose(
                (plus[1] - minus[1]) / (2 * step), hessian[i], rtol=0, atol=1e-7 * scale
            )


@pytest.mark.parametrize("edge_edge", KINDS)
def test_closest_vector_is_the_weighted_sum_and_its_parameters_move_as_stated(edge_edge):
    step = 1e-6
    for x in one_pair_per_region(edge_edge):
        c, count, c_beta, s, m_inv, t, d_sq = kernels.closest(edge_edge, x)
        jacobian = kernels.distance_sq_derivatives(edge_edge, x)[3]
        np.testing.assert_allclose(c @ x, t, atol=1e-13)
        np.testing.assert_allclose(t @ t, d_sq, rtol=1e-14)
        assert abs(c.sum()) < 1e-14
        np.testing.assert_allclose(c_beta.T @ x, s.T, atol=1e-13)
        np.testing.assert_allclose(s.T @ t, 0, atol=1e-12)  # free parameters: t is normal to them
        np.testing.assert_allclose((m_inv @ (s.T @ s))[:count, :count], np.eye(count), atol=1e-9)
        assert (c_beta[:, count:] == 0).all()
        assert (s[:, count:] == 0).all()
        assert (jacobian[count:] == 0).all()
        for i in range(12):
            dx = np.zeros(12)
            dx[i] = step
            plus = kernels.closest(edge_edge, x + dx.reshape(4, 3))[0]
            minus = kernels.closest(edge_edge, x - dx.reshape(4, 3))[0]
            scale = max(1.0, abs(jacobian).max()) ** 2
            np.testing.assert_allclose(
                (plus - minus) / (2 * step), c_beta @ jacobian[:, i], rtol=0, atol=1e-8 * scale
            )


def test_parallel_edges_are_never_of_type_line_line():
    rng = np.random.default_rng(4)
    for twist in (0.0, 1e-12, 1e-9):
        a0, u, shift, across = rng.normal(size=(4, 3))
        x = np.array([a0, a0 + u, a0 + shift, a0 + shift + u + twist * across])
        assert kernels.closest(EDGE_EDGE, x)[1] < 2
