"""Continuous collision detection: exact public queries, sampled motions, the promise at rest."""

import numpy as np
import pytest
from public_data import public

from diffcloth_torch import _kernels as kernels

POINT_TRIANGLE, EDGE_EDGE = False, True
KINDS = [
    pytest.param(POINT_TRIANGLE, id="point-triangle"),
    pytest.param(EDGE_EDGE, id="edge-edge"),
]


def smallest_distance(edge_edge, x_t0, x_t1, until, samples=400):
    """Distance of every pair at its closest, over samples of [0, until]; [Q], [Q, 4, 3] -> [Q]."""
    closest_sq = np.full(len(x_t0), np.inf)
    for share in np.linspace(0, 1, samples):
        t = (share * until)[:, None, None]
        x = np.ascontiguousarray(x_t0 + t * (x_t1 - x_t0))
        closest_sq = np.minimum(closest_sq, kernels.distance_sq(edge_edge, x))
    return np.sqrt(closest_sq)


@pytest.mark.parametrize("edge_edge", KINDS)
def test_no_exact_collision_is_missed(edge_edge):
    name = "edge_edge" if edge_edge else "vertex_face"
    with np.load(public("ccd_queries_unit.npz")) as queries:
        x_t0, x_t1, hit = (queries[f"{name}_{part}"] for part in ("t0", "t1", "hit"))
    t = kernels.safe_step(edge_edge, x_t0, x_t1, 0.0)
    assert hit.sum() > 50
    assert (t[hit.astype(bool)] < 1).all()
    assert (t >= 0).all()


def meeting_motions(edge_edge, count, rng, gap=None):
    """Random motions in which one point of each primitive meet at a known time.

    With `gap` [Q], random points of the primitives are that far apart at the start.
    """

    def between_random_points(x):
        """Vector from a random point of the second primitive to one of the first."""
        if edge_edge:
            s, t = rng.uniform(size=(2, count))
            weights = np.stack([1 - s, s, t - 1, -t], axis=-1)
        else:
            weights = np.column_stack([np.ones(count), -rng.dirichlet([1, 1, 1], size=count)])
        return np.einsum("qi,qik->qk", weights, x)[:, None]

    first = slice(0, 2 if edge_edge else 1)
    x_t0 = rng.normal(size=(count, 4, 3))
    if gap is not None:
        direction = rng.normal(size=(count, 1, 3))
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        x_t0[:, first] += gap[:, None, None] * direction - between_random_points(x_t0)
    motion = 10 ** rng.uniform(-2, 2, size=(count, 1, 1)) * rng.normal(size=(count, 4, 3))
    time = rng.uniform(0.01, 1, size=(count, 1, 1))
    motion[:, first] -= between_random_points(x_t0 + time * motion) / time
    return x_t0, x_t0 + motion, time[:, 0, 0]


@pytest.mark.parametrize("xi", [0.0, 0.02])
@pytest.mark.parametrize("edge_edge", KINDS)
def test_motions_that_meet_are_stopped_before_they_do(edge_edge, xi):
    x_t0, x_t1, meeting = meeting_motions(edge_edge, 3000, np.random.default_rng(5))
    t = kernels.safe_step(edge_edge, x_t0, x_t1, xi)
    start = np.sqrt(kernels.distance_sq(edge_edge, x_t0))
    apart = start > xi + 1e-10
    assert (t < meeting).all()
    assert (t[~apart] == 0).all()
    assert (t[apart] > 0).all()
    assert (smallest_distance(edge_edge, x_t0, x_t1, t)[apart] > xi).all()


@pytest.mark.parametrize("edge_edge", KINDS)
def test_motions_that_meet_after_a_near_miss_are_stopped_before_they_do(edge_edge):
    """Gaps down to the rounding of positions, at which the gap's direction is uncertain."""
    rng = np.random.default_rng(10)
    gap = 10 ** rng.uniform(-11, -3, size=5000)
    x_t0, x_t1, meeting = meeting_motions(edge_edge, 5000, rng, gap)
    t = kernels.safe_step(edge_edge, x_t0, x_t1, 0.0)
    assert (t < meeting).all()
    assert (smallest_distance(edge_edge, x_t0, x_t1, t, samples=100)[t > 0] > 0).all()


@pytest.mark.parametrize("edge_edge", KINDS)
def test_motions_that_clear_each_other_are_not_stopped(edge_edge):
    rng = np.random.default_rng(6)
    x_t0 = rng.normal(size=(1000, 4, 3))
    x_t1 = x_t0 + rng.normal(size=(1000, 4, 3))
    t = kernels.safe_step(edge_edge, x_t0, x_t1, 0.0)
    start = np.sqrt(kernels.distance_sq(edge_edge, x_t0))
    clear = smallest_distance(edge_edge, x_t0, x_t1, np.ones(1000)) > 0.5 * start
    assert clear.sum() > 100
    assert (t[clear] == 1).all()


@pytest.mark.parametrize("d_hat", [np.inf, 0.05])
@pytest.mark.parametrize("xi", [0.0, 0.02])
@pytest.mark.parametrize("edge_edge", KINDS)
def test_motions_are_stopped_where_a_tenth_of_the_gap_is_left(edge_edge, xi, d_hat):
    """The end of an iterative search would jump with the last bits of a motion."""
    x_t0, x_t1, _ = meeting_motions(edge_edge, 3000, np.random.default_rng(7))
    t = kernels.safe_step(edge_edge, x_t0, x_t1, xi, d_hat)
    x = x_t0 + t[:, None, None] * (x_t1 - x_t0)
    gap, left = (np.sqrt(kernels.distance_sq(edge_edge, x_)) - xi for x_ in (x_t0, x))
    apart = gap > 1e-3
    assert (t[apart] < 1).all()
    np.testing.assert_allclose(left[apart], 0.1 * np.minimum(gap, d_hat)[apart], rtol=1e-3)
    until = (1 - 1e-6) * t[apart]
    closest = smallest_distance(edge_edge, x_t0[apart], x_t1[apart], until)
    assert (closest - xi > (1 - 1e-3) * left[apart]).all()  # first time at this gap


def one(edge_edge, x_t0, x_t1, xi=0.0):
    (t,) = kernels.safe_step(edge_edge, np.array([x_t0], float), np.array([x_t1], float), xi)
    return t


TRIANGLE = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize("speed", [2.0, 2e3, 2e6], ids=["slow", "fast", "very-fast"])
@pytest.mark.parametrize("xi", [0.0, 0.3])
def test_a_head_on_motion_stops_short_of_the_impact(speed, xi):
    impact = (1 - xi) / speed
    t = one(POINT_TRIANGLE, [[0.2, 0.2, 1], *TRIANGLE], [[0.2, 0.2, 1 - speed], *TRIANGLE], xi)
    assert 0.89 * impact < t < impact


def test_a_pair_in_contact_cannot_move_even_apart():
    touching = [[0.2, 0.2, 0.1], *TRIANGLE]
    away = [[0.2, 0.2, 1.0], *TRIANGLE]
    assert one(POINT_TRIANGLE, touching, away, xi=0.1) == 0
    assert one(POINT_TRIANGLE, touching, touching, xi=0.1) == 0
    assert one(POINT_TRIANGLE, touching, away, xi=0.099) == 1


def test_a_gap_within_the_rounding_of_the_positions_is_contact():
    x = np.array([[0.2, 0.2, 3e-13], *TRIANGLE])
    away = x + np.array([[0, 0, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    assert one(POINT_TRIANGLE, x, away) == 0
    x[0, 2] = 3e-12
    assert one(POINT_TRIANGLE, x, away) == 1


def test_pairs_that_move_alike_are_free():
    x = np.array([[0.2, 0.2, 1e-6], *TRIANGLE])
    assert one(POINT_TRIANGLE, x, x + 5.0) == 1


def test_parallel_edges_that_pass_through_each_other_are_stopped():
    a, b = [[0, 0, 0], [1, 0, 0]], [[0.3, 0, 0.5], [1.3, 0, 0.5]]
    below = [[0.3, 0, -0.5], [1.3, 0, -0.5]]
    assert 0.4 < one(EDGE_EDGE, a + b, a + below) < 0.5


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_motions_that_are_not_numbers_are_not_certified(broken):
    x = np.array([[0.2, 0.2, 1.0], *TRIANGLE])
    y = x.copy()
    y[2, 1] = broken
    assert one(POINT_TRIANGLE, x, y) == 0
    assert one(POINT_TRIANGLE, y, x) == 0


@pytest.mark.parametrize("share", [0.0, 1.0, 1e3], ids=["thin", "thick", "far"])
def test_a_pair_beyond_the_harmless_distance_is_never_the_first(share):
    """A pair that ends slightly nearer is the first: point and triangle, and crossing edges."""
    d_hat, xi = 1e-3, 1e-3 * min(share, 1.0)
    offset = np.array([0.3, 0.3, 0.4]) * (1.0 if share < 2 else share)
    corners = {
        False: [[0.2, 0.2, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0]],
        True: [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]],
    }
    for edges, x in corners.items():
        moves = np.zeros((4, 3))
        moves[: 2 if edges else 1, 2] = 1.0
        largest = np.abs(x + offset).max()
        harmless = kernels.harmless_distance(xi, d_hat, largest)
        # Positions round by 1e-16 of the largest.
        for end, is_first in ((harmless + 1e-15 * largest, False), (harmless - 0.01 * d_hat, True)):
            x_t0, x_t1 = (np.array(x) + offset + z * moves for z in (xi + 2 * d_hat, end))
            step = kernels.safe_step(edges, x_t0[None], x_t1[None], xi, d_hat)[0]
            assert (step < 1.0) == is_first
