"""Candidates that are kept between searches miss nothing, and are few near the end of a solve."""

import ipctk
import numpy as np
import pytest
from test_broad_phase import CROWD, crowd, grid, kernels, merged, scene

REACH = [0.01, 0.02, 0.015, 0.005]


def close_pairs(everything, x_t0, x_t1, surface, reach_of=REACH):
    """Pairs within reach at one of five sampled times of the motion."""
    found = set()
    for share in np.linspace(0, 1, 5):
        at = x_t0 + share * (x_t1 - x_t0)
        for kind in (0, 1):
            pairs = everything[everything[:, 0] == kind]
            d_sq = kernels.distance_sq(bool(kind), np.ascontiguousarray(at[pairs[:, 1:5]]))
            reach = np.take(reach_of, surface[pairs[:, 1]]) + np.take(
                reach_of, surface[pairs[:, 4]]
            )
            found |= {tuple(c) for c in pairs[d_sq <= reach**2]}
    return found


@pytest.fixture(scope="module")
def search():
    x, faces, surface = scene()
    mesh = kernels.BroadPhase(faces, surface, 2, True, x)
    return x, mesh, surface, mesh.find(x, x, 100.0)


@pytest.mark.quick("1e-05-still", "0.001-still", "0.01-still", "0.1-still")
@pytest.mark.parametrize("common", [0.0, 5.0], ids=["still", "flying"])
@pytest.mark.parametrize("scale", [1e-5, 1e-3, 1e-2, 1e-1])
def test_no_pair_that_comes_within_reach_is_missed(search, scale, common):
    """A random walk of many motions reuses lists made earlier."""
    x, mesh, surface, everything = search
    rng = np.random.default_rng(int(1e6 * scale))
    cloths = (surface < 2)[:, None]
    at, builds = x + 0.003 * rng.normal(size=x.shape), mesh.builds
    missed, close_count, found_count, swept_count = 0, 0, 0, 0
    for _ in range(6):
        # A body moves rigidly; the cloths also share a motion, which moves them to the bodies.
        step = scale * rng.normal(size=x.shape) * cloths
        step += scale * rng.normal(size=3) * (surface == 2)[:, None]
        step += common * scale * rng.normal(size=3) * cloths
        found = {tuple(c) for c in mesh.find_kept(at, at + step, REACH)}
        close = close_pairs(everything, at, at + step, surface)
        missed += len(close - found)
        close_count += len(close)
        found_count += len(found)
        swept_count += len(mesh.find(at, at + step, REACH))
        assert found <= {tuple(c) for c in everything}
        at = at + step
    assert missed == 0
    assert close_count > 100
    assert found_count <= swept_count
    if scale == 1e-5:
        assert mesh.builds - builds <= 2
        assert found_count < 1.5 * close_count


@pytest.mark.parametrize("common", [0.0, 5.0], ids=["still", "flying"])
@pytest.mark.parametrize("scale", [1e-4, 1e-3, 1e-2, 1e-1])
def test_pairs_stay_as_far_apart_as_they_say(search, scale, common):
    """This holds for lists of any age; ipctk computes the smallest distance of each pair."""
    x, mesh, surface, _ = search
    rng = np.random.default_rng(int(1e6 * scale))
    cloths = (surface < 2)[:, None]
    at, checked = x + 0.003 * rng.normal(size=x.shape), 0
    for _ in range(6):
        step = scale * rng.normal(size=x.shape) * cloths
        step += common * scale * rng.normal(size=3) * cloths
        pairs, apart = mesh.find_kept(at, at + step, REACH), mesh.apart
        for pair, least in zip(pairs[::5], apart[::5], strict=True):
            measure = (ipctk.point_triangle_distance, ipctk.edge_edge_distance)[pair[0]]
            d_sq = [measure(*(at + t * step)[pair[1:5]]) for t in np.linspace(0, 1, 17)]
            # Distances of coordinates around 1 round by 1e-15.
            assert min(d_sq) ** 0.5 >= least - 1e-14
            # No bound is slack by more than the motion of two corners since the list was made.
            assert min(d_sq) ** 0.5 - least < 60 * scale * (1 + common)
            checked += least > 0
        at = at + step
    assert checked > 20 or scale > 1e-3


def test_a_single_moving_vertex_adds_only_its_own_pairs(search):
    """A surface counts as near as its fastest part, but its other pairs do not."""
    x, mesh, surface, _ = search
    mover = 0
    to = x + np.array([0.0, 0.0, 0.11]) * (np.arange(len(x)) == mover)[:, None]
    still = {tuple(c) for c in mesh.find_kept(x, x, REACH)}
    found = {tuple(c) for c in mesh.find_kept(x, to, REACH)}
    assert surface[mover] == 0
    assert found > still
    assert all(mover in pair[1:5] for pair in found - still)


@pytest.mark.parametrize("scale", [1e-4, 1e-2])
def test_no_pair_of_bodies_is_missed(scale):
    x, faces, surface = crowd()
    mesh = kernels.BroadPhase(faces, surface, 1, True, x, **CROWD)
    everything, reach = mesh.find(x, x, 100.0), [0.02, 0.03, 0.03, 0.02, 0.01]
    rng = np.random.default_rng(3)
    at, close_count = x, 0
    for _ in range(8):
        step = scale * rng.normal(size=(5, 3))[surface]
        found = {tuple(c) for c in mesh.find_kept(at, at + step, reach)}
        close = close_pairs(everything, at, at + step, surface, reach)
        assert close <= found
        close_count += sum(surface[c[1]] > 0 for c in close)
        at = at + step
    assert close_count > 100


def test_a_motion_without_contact_costs_no_list():
    """A motion of any length without contact needs no list; a motion through others needs one."""
    x, faces, surface = crowd()
    mesh = kernels.BroadPhase(faces, surface, 1, True, x, ignored_pairs=[[0, 3]])
    mesh.find_kept(x, x, [0.01] * 5)
    away = x + np.array([0, 5.0, 0]) * (surface == 3)[:, None]
    for _ in range(2):
        mesh.find_kept(away, away, [0.01] * 5)
    assert mesh.builds == 1
    stirred = x + np.random.default_rng(0).uniform(-0.2, 0.2, size=x.shape)
    for _ in range(2):
        mesh.find_kept(x, stirred, [0.01] * 5)
    assert mesh.builds == 2


def test_parts_that_fly_side_by_side_add_few_pairs():
    """A curtain swings as a door does: no pair within the curtain comes closer."""
    x, faces, surface = merged([grid(12, np.random.default_rng(2))])
    mesh = kernels.BroadPhase(faces, surface, 1, True, x)
    start = {tuple(c) for c in mesh.find_kept(x, x, [0.01])}
    turn = np.stack([np.zeros(len(x)), np.zeros(len(x)), 0.2 * x[:, 0]], axis=-1)
    found = {tuple(c) for c in mesh.find_kept(x, x + turn, [0.01])}
    assert start <= found
    assert len(found) < 0.2 * len(mesh.find(x, x + turn, [0.01]))


def test_candidates_are_sorted(search):
    x, mesh, _, _ = search
    step = 1e-3 * np.random.default_rng(1).normal(size=x.shape)
    kept = mesh.find_kept(x, x + step, REACH)
    order = np.lexsort((kept[:, 6], kept[:, 5], kept[:, 0]))
    np.testing.assert_array_equal(order, np.arange(len(kept)))
    assert len(kept) > 10


def test_another_reach_makes_another_list(search):
    x, mesh, _, _ = search
    mesh.find_kept(x, x, REACH)
    wide = [10 * r for r in REACH]
    found = mesh.find_kept(x, x, wide)
    assert len(found) > 2 * len(mesh.find_kept(x, x, REACH))
    fresh = mesh.find(x, x, wide)
    d_sq = {
        kind: kernels.distance_sq(
            bool(kind), np.ascontiguousarray(x[fresh[fresh[:, 0] == kind][:, 1:5]])
        )
        for kind in (0, 1)
    }
    surface = search[2]
    for kind in (0, 1):
        pairs = fresh[fresh[:, 0] == kind]
        reach = np.take(wide, surface[pairs[:, 1]]) + np.take(wide, surface[pairs[:, 4]])
        close = {tuple(c) for c in pairs[d_sq[kind] <= reach**2]}
        assert close <= {tuple(c) for c in found}


def test_pairs_near_a_point_do_not_depend_on_the_list(search):
    x, _, surface, everything = search
    _, faces, _ = scene()
    at = x + 0.003 * np.random.default_rng(2).normal(size=x.shape)
    reach, widened, wanted = [0.05, 0.07, 0.015, 0.005], 0.001, [True, True, False, True]
    limit = np.asarray(reach) + widened
    near = close_pairs(everything, at, at, surface, limit)
    near = {c for c in near if 2 not in (surface[c[1]], surface[c[4]])}
    assert 30 < len(near) < 1000
    by = {
        name: kernels.BroadPhase(faces, surface, 2, True, x) for name in ("none", "here", "there")
    }
    by["here"].find_kept(at, at + 1e-3, reach)
    by["there"].find_kept(x, at, reach)
    for mesh in by.values():
        builds = mesh.builds
        found = mesh.find_at(at, reach, widened, wanted)
        assert {tuple(c) for c in found} == near
        np.testing.assert_array_equal(found, found[np.lexsort(found[:, [6, 5, 0]].T)])
        assert mesh.builds == builds


def test_motions_that_are_not_finite_are_searched_as_such(search):
    """A solver may try such motions; a kept list must not answer the search."""
    x, mesh, _, _ = search
    mesh.find_kept(x, x, REACH)
    for value in (np.nan, np.inf):
        to = x.copy()
        to[5, 1] = value
        np.testing.assert_array_equal(mesh.find_kept(x, to, REACH), mesh.find(x, to, REACH))
