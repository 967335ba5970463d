"""Candidates, intersections and the smallest distance of a mesh: against brute force and ipctk."""

import itertools

import contact_scenes
import ipctk
import numpy as np
import pytest
import trimesh
from public_data import public

from diffcloth_torch import _kernels as kernels


def grid(n, rng, height=0.0):
    """A jittered n x n sheet of unit size at some height."""
    u, v = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    x = np.stack([u, v, np.zeros_like(u)], axis=-1).reshape(-1, 3) / (n - 1)
    x = x + rng.uniform(-0.2, 0.2, size=x.shape) / n + [0, 0, height]
    corner = (u * n + v)[:-1, :-1].ravel()
    faces = [[corner, corner + n, corner + 1], [corner + 1, corner + n, corner + n + 1]]
    return x, np.concatenate([np.stack(f, axis=-1) for f in faces])


def merged(meshes):
    """Stack meshes into positions, faces and the surface of every vertex."""
    counts = [len(x) for x, _ in meshes]
    starts = np.cumsum([0, *counts[:-1]])
    x = np.concatenate([x for x, _ in meshes]).astype(float)
    faces = np.concatenate([f + start for (_, f), start in zip(meshes, starts, strict=True)])
    return x, faces.astype(np.int32), np.repeat(np.arange(len(meshes), dtype=np.int32), counts)


def plane(size, height):
    x = size * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0.1, 0.2, height]
    return x, np.array([[0, 1, 2], [0, 2, 3]])


def scene(seed=0):
    """Two cloths, a small body between them and a huge plane below."""
    rng = np.random.default_rng(seed)
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.2)
    body = ball.vertices + np.array([0.5, 0.5, 0.25]), ball.faces
    return merged([grid(7, rng), grid(6, rng, 0.12), body, plane(10.0, -0.05)])


def crowd(seed=0):
    """A cloth over three bodies that nearly touch each other, above a plane."""
    rng = np.random.default_rng(seed)
    balls = [trimesh.creation.icosphere(subdivisions=1, radius=0.2) for _ in range(2)]
    block = trimesh.creation.box((0.5, 0.2, 0.2)).subdivide()
    bodies = [
        (mesh.vertices + np.array(at), mesh.faces)
        for mesh, at in [
            (balls[0], [0.2, 0.2, 0.2]),
            (balls[1], [0.62, 0.2, 0.2]),
            (block, [0.41, 0.51, 0.12]),
        ]
    ]
    return merged([grid(7, rng, 0.42), *bodies, plane(10.0, -0.01)])


# Options of the crowd: the plane is static; two bodies ignore each other, as do cloth and block.
CROWD = {"body_dynamic": [True, True, False, False], "ignored_pairs": [[1, 2], [0, 3]]}


def boxes(x_t0, x_t1, elements):
    corners = np.concatenate([x_t0[elements], x_t1[elements]], axis=1)
    return corners.min(axis=1), corners.max(axis=1)


def frame_of(a, b, x_t0, x_t1, surface, cloth_count, reach):
    """Motion of a surface pair's common frame: mean motion of its body, or of its first cloth."""
    of = max(a, b) if max(a, b) >= cloth_count else min(a, b)
    motion = (x_t1 - x_t0)[surface == of].mean(axis=0)
    return motion if np.abs(motion).max() > reach[of] else np.zeros(3)


def may_touch(surface_a, surface_b, cloth_count, self_contact, body_dynamic=(), ignored_pairs=()):
    a, b = sorted((surface_a, surface_b))
    if [a, b] in list(ignored_pairs):
        return False
    if a == b:
        return self_contact and a < cloth_count
    return a < cloth_count or any(body_dynamic[s - cloth_count] for s in (a, b) if body_dynamic)


def brute_force(mesh, x_t0, x_t1, reach, faces, surface, cloth_count, self_contact, **bodies):
    """All candidates (kind, v0..v3, a, b), by comparing every two boxes."""
    vertices = np.arange(len(x_t0))[:, None]
    found = []
    for kind, first, second in [(0, vertices, faces), (1, mesh.edges, mesh.edges)]:
        of_first, of_second = surface[first[:, 0]], surface[second[:, 0]]
        for s, r in itertools.product(range(len(reach)), repeat=2):
            if not may_touch(s, r, cloth_count, self_contact, **bodies):
                continue
            seen_t1 = x_t1 - frame_of(s, r, x_t0, x_t1, surface, cloth_count, reach)
            ids_a, ids_b = np.flatnonzero(of_first == s), np.flatnonzero(of_second == r)
            lo_a, hi_a = boxes(x_t0, seen_t1, first[ids_a])
            lo_b, hi_b = boxes(x_t0, seen_t1, second[ids_b])
            apart = np.maximum(np.maximum(lo_b - hi_a[:, None], lo_a[:, None] - hi_b), 0)
            near = (apart**2).sum(axis=-1) <= (reach[s] + reach[r]) ** 2
            for k, l in np.argwhere(near):
                a, b = ids_a[k], ids_b[l]
                corners = (*first[a], *second[b])
                if len(set(corners)) == 4 and (kind == 0 or a < b):
                    found.append((kind, *corners, a, b))
    return np.array(sorted(found, key=lambda c: (c[0], c[5], c[6])))


@pytest.mark.parametrize("self_contact", [True, False], ids=["self-contact", "no-self-contact"])
@pytest.mark.parametrize("speed", [0.0, 0.05, 0.5], ids=["rest", "slow", "fast"])
def test_candidates_are_those_of_brute_force(self_contact, speed):
    x, faces, surface = scene()
    mesh = kernels.BroadPhase(faces, surface, 2, self_contact, x)
    rng = np.random.default_rng(1)
    x_t0 = x + 0.02 * rng.normal(size=x.shape)
    x_t1 = x_t0 + speed * rng.normal(size=x.shape) + 3 * speed * surface[:, None]
    reach = [0.01, 0.02, 0.04, 0.0]
    found = mesh.find(x_t0, x_t1, reach)
    expected = brute_force(mesh, x_t0, x_t1, reach, faces, surface, 2, self_contact)
    np.testing.assert_array_equal(found, expected)
    assert {0, 1, 2, 3} <= set(surface[found[:, 1:5]].ravel())


def pairs_of_surfaces(found, surface):
    return {tuple(sorted(p)) for p in surface[found[:, [1, 4]]].tolist()}


@pytest.mark.parametrize("speed", [0.0, 0.05], ids=["rest", "slow"])
def test_bodies_that_dynamics_moves_meet_each_other(speed):
    x, faces, surface = crowd()
    mesh = kernels.BroadPhase(faces, surface, 1, True, x, **CROWD)
    rng = np.random.default_rng(1)
    x_t0 = x + 0.01 * rng.normal(size=x.shape)
    x_t1 = x_t0 + speed * rng.normal(size=x.shape) + speed * surface[:, None]
    reach = [0.01, 0.02, 0.04, 0.03, 0.01]
    found = mesh.find(x_t0, x_t1, reach)
    expected = brute_force(mesh, x_t0, x_t1, reach, faces, surface, 1, True, **CROWD)
    np.testing.assert_array_equal(found, expected)
    touching = {(0, 1), (0, 2), (1, 3), (1, 4), (2, 3), (2, 4)}
    assert pairs_of_surfaces(found, surface) - {(0, 0)} == touching
    assert {tuple(p) for p in surface[found[found[:, 0] == 0][:, [1, 4]]].tolist()} >= {
        (1, 3),
        (3, 1),
    }


def test_bodies_that_nothing_moves_do_not_meet():
    x, faces, surface = crowd()
    everything = kernels.BroadPhase(faces, surface, 1, True, x).find(x, x, 100.0)
    assert pairs_of_surfaces(everything, surface) == {(0, s) for s in range(5)}
    still = kernels.BroadPhase(faces, surface, 1, True, x, body_dynamic=[False] * 4)
    np.testing.assert_array_equal(still.find(x, x, 100.0), everything)


@pytest.mark.parametrize("ignored", [[[0, 5]], [[-1, 2]]])
def test_pairs_of_surfaces_that_are_not_there_are_refused(ignored):
    x, faces, surface = crowd()
    with pytest.raises(ValueError, match="ignored_pairs"):
        kernels.BroadPhase(faces, surface, 1, True, x, ignored_pairs=ignored)


def test_pairs_that_come_within_the_radius_during_the_motion_are_candidates():
    x, faces, surface = scene()
    mesh = kernels.BroadPhase(faces, surface, 2, True, x)
    rng = np.random.default_rng(2)
    x_t1 = x + 0.2 * rng.normal(size=x.shape)
    radius = 0.02
    found = {tuple(c) for c in mesh.find(x, x_t1, radius)}
    everything = mesh.find(x, x_t1, 100.0)
    for share in (0.0, 0.3, 0.7, 1.0):
        at = x + share * (x_t1 - x)
        for kind in (0, 1):
            pairs = everything[everything[:, 0] == kind]
            d_sq = kernels.distance_sq(bool(kind), np.ascontiguousarray(at[pairs[:, 1:5]]))
            close = pairs[d_sq <= radius**2]
            assert len(close) > 3
            assert {tuple(c) for c in close} <= found


@pytest.mark.parametrize("away", [0.0, 1e6], ids=["near the origin", "far away"])
def test_elements_within_reach_at_rest_are_candidates(away):
    """All candidates within reach are found, and less than half of the others found by boxes."""
    x, faces, surface = scene()
    mesh = kernels.BroadPhase(faces, surface, 2, True, x)
    at = x + away + 0.003 * np.random.default_rng(12).normal(size=x.shape)
    reach = [0.01, 0.02, 0.04, 0.03]
    everything, found = mesh.find(at, at, reach), mesh.find_at_rest(at, reach)
    by_box = {tuple(c) for c in everything}
    kept = {tuple(c) for c in found}
    assert kept <= by_box
    np.testing.assert_array_equal(found, sorted(found.tolist(), key=lambda c: (c[0], c[5], c[6])))
    close_count = 0
    for kind in (0, 1):
        pairs = everything[everything[:, 0] == kind]
        corners = np.ascontiguousarray(at[pairs[:, 1:5]])
        distance = np.sqrt(kernels.distance_sq(bool(kind), corners))
        within = distance <= np.take(reach, surface[pairs[:, [1, 4]]]).sum(axis=1)
        close = {tuple(c) for c in pairs[within]}
        assert len(close) > 50
        assert close <= kept
        close_count += len(close)
    assert len(kept) - close_count < 0.5 * (len(by_box) - close_count)


def test_a_reach_is_that_of_its_surface():
    """A thick surface adds no candidates between other surfaces."""
    x, faces, surface = scene()
    mesh = kernels.BroadPhase(faces, surface, 2, True, x)
    thin = mesh.find(x, x, [0.01, 0.01, 0.01, 0.01])
    thick = mesh.find(x, x, [0.01, 0.01, 0.01, 0.2])

    def between_others(found):
        return found[(surface[found[:, 1:5]] < 3).all(axis=1)]

    np.testing.assert_array_equal(between_others(thick), between_others(thin))
    assert len(thick) > len(thin)


def test_flying_together_is_like_standing_still():
    """The candidates within a cloth, and between cloths, do not depend on a common motion."""
    x, faces, surface = merged(
        [grid(12, np.random.default_rng(5)), grid(9, np.random.default_rng(6), 0.01)]
    )
    mesh = kernels.BroadPhase(faces, surface, 2, True, x)
    rng = np.random.default_rng(7)
    x_t1 = x + 0.01 * rng.normal(size=x.shape)
    still = mesh.find(x, x_t1, 0.02)
    flying = mesh.find(x, x_t1 + np.array([60.0, -30.0, 15.0]), 0.02)
    # The candidates differ slightly: motion is relative to the first cloth's mean motion.
    assert 0.9 < len(flying) / len(still) < 1.1
    kinds = np.bincount(flying[:, 0])
    assert (kinds > 100).all()


def test_results_do_not_depend_on_earlier_searches():
    x, faces, surface = scene()
    mesh = kernels.BroadPhase(faces, surface, 2, True, x)
    rng = np.random.default_rng(3)
    first = mesh.find(x, x, 0.03)
    mesh.find(x + 5 * rng.normal(size=x.shape), x + rng.normal(size=x.shape), 0.5)
    mesh.find(x + [0, 0, 100.0] * (surface == 1)[:, None], x, 0.01)
    np.testing.assert_array_equal(mesh.find(x, x, 0.03), first)


def test_the_shape_of_the_trees_does_not_matter():
    x, faces, surface = scene()
    shuffled = np.random.default_rng(4).permutation(x)
    found = [kernels.BroadPhase(faces, surface, 2, True, r).find(x, x, 0.05) for r in (x, shuffled)]
    np.testing.assert_array_equal(*found)


def test_a_body_far_away_adds_nothing():
    x, faces, surface = scene()
    near = kernels.BroadPhase(faces, surface, 2, True, x)
    far_x = x + [0, 0, 50.0] * (surface >= 2)[:, None]
    found = near.find(far_x, far_x, 0.03)
    assert len(found) > 100
    assert (surface[found[:, 1:5]] < 2).all()


def test_edges_are_unique_grouped_and_know_their_faces():
    x, faces, surface = scene()
    mesh = kernels.BroadPhase(faces, surface, 2, True, x)
    edges = {(surface[f[0]], *sorted((f[k], f[(k + 1) % 3]))) for f in faces for k in range(3)}
    listed = [(s, *e) for s, e in zip(mesh.edge_surface, mesh.edges, strict=True)]
    assert listed == sorted(edges)
    for edge, of_edge in zip(mesh.edges, mesh.edge_faces, strict=True):
        expected = [f for f in range(len(faces)) if set(edge) <= set(faces[f])]
        assert [f for f in of_edge if f >= 0] == expected
    np.testing.assert_array_equal(mesh.face_surface, surface[faces[:, 0]])
    assert mesh.cloth_counts == ((surface < 2).sum(), (mesh.edge_surface < 2).sum(), 72 + 50)


@pytest.mark.parametrize(
    ("faces", "surface", "message"),
    [
        pytest.param([[0, 1, 3]], [0, 0, 0], "refer to vertices of the mesh", id="range"),
        pytest.param([[0, 1, 1]], [0, 0, 0], "three different corners", id="repeated"),
        pytest.param([[0, 1, 2]], [0, 0, 1], "lie on one surface", id="two-surfaces"),
        pytest.param([[3, 4, 5], [0, 1, 2]], [0, 0, 0, 1, 1, 1], "grouped by surface", id="order"),
        pytest.param([[0, 1, 2]], [0, 1, 0], "must ascend", id="vertices"),
    ],
)
def test_a_mesh_out_of_order_is_refused(faces, surface, message):
    with pytest.raises(ValueError, match=message):
        kernels.BroadPhase(
            np.array(faces, np.int32),
            np.array(surface, np.int32),
            1,
            True,
            np.zeros((len(surface), 3)),
        )


def ipctk_intersects(x, faces):
    mesh = ipctk.CollisionMesh(x, ipctk.edges(faces), faces)
    return ipctk.has_intersections(mesh, x)


def self_intersects(x, faces):
    mesh = kernels.BroadPhase(faces, np.zeros(len(x), np.int32), 1, True, x)
    return mesh.find_intersection(x) is not None


def test_intersections_of_random_cloths_agree_with_ipctk():
    rng = np.random.default_rng(7)
    answers = []
    for k in range(40):
        x, faces = grid(6, rng)
        x = x + (0.02 + 0.005 * k) * rng.normal(size=x.shape)
        faces = faces.astype(np.int32)
        answers.append(self_intersects(x, faces))
        assert answers[-1] == ipctk_intersects(x, faces)
    assert 5 < sum(answers) < 35


def pierces(x, edge, face):
    """Return whether an edge crosses a triangle, in general position."""
    a, b = x[edge]
    t0, t1, t2 = x[face]

    def volume(p, q, r, s):
        return np.linalg.det([q - p, r - p, s - p])

    side = volume(t0, t1, t2, a) * volume(t0, t1, t2, b) < 0
    around = [volume(a, b, *pair) > 0 for pair in ((t0, t1), (t1, t2), (t2, t0))]
    return side and (all(around) or not any(around))


@pytest.mark.parametrize("self_contact", [True, False], ids=["self-contact", "no-self-contact"])
def test_the_lowest_intersection_is_that_of_brute_force(self_contact):
    x, faces, surface = scene()
    mesh = kernels.BroadPhase(faces, surface, 2, self_contact, x)
    rng = np.random.default_rng(8)
    answers = set()
    for k in range(12):
        at = x + (0.003 + 0.01 * k) * rng.normal(size=x.shape)
        lowest = next(
            (
                (e, f)
                for e, f in itertools.product(range(len(mesh.edges)), range(len(faces)))
                if np.all(at[mesh.edges[e]].min(0) <= at[faces[f]].max(0))
                and np.all(at[faces[f]].min(0) <= at[mesh.edges[e]].max(0))
                and not set(mesh.edges[e]) & set(faces[f])
                and may_touch(mesh.edge_surface[e], mesh.face_surface[f], 2, self_contact)
                and pierces(at, mesh.edges[e], faces[f])
            ),
            None,
        )
        assert mesh.find_intersection(at) == lowest
        answers.add(lowest)
    assert len(answers) > 2


def test_intersections_of_bodies_are_found():
    """Intersections are found for bodies that intersect, and for no others."""
    x, faces, surface = crowd()
    mesh = kernels.BroadPhase(faces, surface, 1, True, x, **CROWD)
    assert mesh.find_intersection(x) is None

    def sunk(body, move):
        return x + np.array(move) * (surface == body)[:, None]

    edge, face = mesh.find_intersection(sunk(2, [0, 0, -0.05]))
    assert (mesh.edge_surface[edge], mesh.face_surface[face]) == (2, 4)
    edge, face = mesh.find_intersection(sunk(3, [0, -0.1, 0]))
    assert {mesh.edge_surface[edge], mesh.face_surface[face]} == {1, 3}
    assert mesh.find_intersection(sunk(2, [-0.05, 0, 0])) is None  # 1 and 2 ignore each other
    assert mesh.find_intersection(sunk(3, [0, 0, -0.05])) is None  # neither 3 nor 4 moves


def rotation(seed):
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q


@pytest.mark.parametrize("seed", range(3))
def test_a_flat_sheet_does_not_intersect_itself(seed):
    """Coplanar neighbors are the rest state: rounding must not turn them into intersections."""
    x, faces = grid(12, np.random.default_rng(seed))
    x[:, 2] = 0
    faces = faces.astype(np.int32)
    assert not self_intersects(x, faces)
    assert not self_intersects(np.ascontiguousarray(x @ rotation(seed) + 3.0), faces)


@pytest.mark.parametrize("depth", [1e-3, 1e-9, 1e-15])
def test_an_edge_that_pierces_ever_so_little_is_found(depth):
    """The tip of an edge behind a tilted triangle by less than rounding of the determinant."""
    q = rotation(11)
    cloth = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    spike = np.array([[0.3, 0.3, -depth], [0.3, 0.3, 1], [0.4, 0.3, 1]]), np.array([[0, 1, 2]])
    x, faces, surface = merged([cloth, spike])
    x = np.ascontiguousarray(x @ q)
    # Rounding of the rotated corners, 1e-16, cannot hide a tip at a depth of 1e-15.
    assert kernels.BroadPhase(faces, surface, 2, True, x).find_intersection(x) is not None
    x = np.ascontiguousarray(x + 2 * depth * q[2] * (surface == 1)[:, None])
    assert kernels.BroadPhase(faces, surface, 2, True, x).find_intersection(x) is None


@pytest.mark.parametrize(("height", "expected"), [(-(2.0**-54), True), (2.0**-53, False)])
def test_a_tip_next_to_a_face_is_judged_exactly(height, expected):
    """A tip one unit in the last place above or below a tilted plane, with exact coordinates."""
    cloth = np.array([[0.0, 0, 0], [1, 0, 1], [0, 1, 1]]), np.array([[0, 1, 2]])
    tip = np.array([[0.25, 0.25, 0.5 + height], [0.25, 0.25, 1.5], [0.5, 0.25, 2.5]])
    x, faces, surface = merged([cloth, (tip, np.array([[0, 1, 2]]))])
    mesh = kernels.BroadPhase(faces, surface, 2, True, x)
    assert (mesh.find_intersection(x) is not None) == expected


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        pytest.param("two-cubes-far", False, id="far"),
        pytest.param("two-cubes-close", False, id="close"),
        pytest.param("two-cubes-intersecting", True, id="intersecting"),
        pytest.param("thick-cloth_t0", False, id="thick-cloth"),
    ],
)
def test_public_pairs_are_judged_as_labeled(name, expected):
    mesh = trimesh.load(public(f"pairs/{name}.ply"), process=False)
    x, faces = np.array(mesh.vertices, float), np.array(mesh.faces, np.int32)
    assert self_intersects(x, faces) == expected
    assert ipctk_intersects(x, faces) == expected


def test_a_closing_thick_cloth_must_not_arrive():
    """Two layers that pass through each other: the safe step over the candidates is below one."""
    meshes = [trimesh.load(public(f"pairs/thick-cloth_t{k}.ply"), process=False) for k in (0, 1)]
    x_t0, x_t1 = (np.array(mesh.vertices, float) for mesh in meshes)
    faces = np.array(meshes[0].faces, np.int32)
    mesh = kernels.BroadPhase(faces, np.zeros(len(x_t0), np.int32), 1, True, x_t0)
    candidates = mesh.find(x_t0, x_t1, 0.0)
    alpha = 1.0
    for kind in (0, 1):
        v = candidates[candidates[:, 0] == kind, 1:5]
        t0, t1 = (np.ascontiguousarray(x[v]) for x in (x_t0, x_t1))
        alpha = min(alpha, kernels.safe_step(bool(kind), t0, t1, 0.0).min())
    assert 0 < alpha < 1
    assert not self_intersects(np.ascontiguousarray(x_t0 + alpha * (x_t1 - x_t0)), faces)


def test_the_smallest_distance_is_that_of_brute_force():
    rng = np.random.default_rng(9)
    for noise in (0.0, 0.05, 0.3):
        x, faces, surface = merged([grid(6, rng), grid(5, rng, 0.01), plane(10.0, -0.01)])
        x = x + noise * rng.normal(size=x.shape)
        mesh = kernels.BroadPhase(faces, surface, 2, False, x)
        everything = kernels.BroadPhase(faces, surface, 2, True, x).find(x, x, 100.0)
        same = surface[everything[:, 1]] == surface[everything[:, 4]]
        expected = np.inf
        for kind in (0, 1):
            v = everything[same & (everything[:, 0] == kind), 1:5]
            d_sq = kernels.distance_sq(bool(kind), np.ascontiguousarray(x[v]))
            expected = min(expected, np.sqrt(d_sq.min()))
        assert mesh.smallest_nonadjacent_distance(x) == expected


def test_the_smallest_distance_may_lie_beyond_pairs_whose_boxes_overlap():
    """The search visits two large oblique triangles, 5.7 apart, before two closer small ones."""
    large = np.array([[0.0, 0, 0], [10, 10, 0], [10, 10, 0.1]])
    small = np.array([[100.0, 0, 0], [100.5, 0, 0], [100, 0.5, 0]])
    x = np.concatenate([large, large + np.array([4, -4, 0]), small, small + np.array([3, 0, 0])])
    faces = np.arange(12, dtype=np.int32).reshape(4, 3)
    mesh = kernels.BroadPhase(faces, np.zeros(12, np.int32), 1, True, x)
    assert mesh.smallest_nonadjacent_distance(x) == 2.5


def test_a_single_triangle_has_no_elements_apart():
    x = np.eye(3)
    mesh = kernels.BroadPhase(np.array([[0, 1, 2]], np.int32), np.zeros(3, np.int32), 1, True, x)
    assert mesh.smallest_nonadjacent_distance(x) == np.inf
    assert len(mesh.find(x, x, 1.0)) == 0


@pytest.mark.parametrize("level", kernels.kernel_levels())
def test_near_boxes_are_found_by_their_euclidean_distance(level):
    """Boxes with margins that sum to the range; inner boxes are near by Euclidean distance."""
    rng = np.random.default_rng(5)
    found = 0
    for _ in range(200):
        margin, extent = 0.1, rng.uniform(0.0, 0.2, (8, 3))
        center = rng.uniform(-0.4, 0.4, (8, 3))
        boxes = np.stack([center - extent - margin, center + extent + margin], axis=1)
        boxes[7] = [[np.inf] * 3, [-np.inf] * 3]  # none
        bits = kernels.near_boxes(level, boxes, 2 * margin)
        for p, q in itertools.product(range(4), range(4)):
            a, b = boxes[p], boxes[4 + q]
            apart = np.maximum(a[0] - b[1], b[0] - a[1]) + 2 * margin
            expected = q != 3 and np.linalg.norm(np.maximum(apart, 0.0)) <= 2 * margin
            assert bool(bits >> (4 * p + q) & 1) == expected
            found += expected
    assert 0 < found < 200 * 12


def round_scene(name, seed=0):
    drawn = contact_scenes.make(name, seed)
    return drawn, kernels.BroadPhase(
        drawn.faces.astype(np.int32),
        drawn.surface,
        drawn.cloth_count,
        True,
        drawn.x,
        drawn.body_dynamic,
        drawn.ignored_pairs,
        drawn.radius,
    )


def pairs_within(drawn, mesh, x_t0, x_t1, reach, samples=40):
    """Pairs (edge-edge, a, b) within reach on a sampled motion; skeleton ends meet all elements."""
    surface, is_round = drawn.surface, np.array(drawn.radius) > 0
    used = np.unique(drawn.faces)
    points = [
        (v, f)
        for v, f in itertools.product(used, range(len(drawn.faces)))
        if v not in drawn.faces[f] and (is_round[surface[v]] or not is_round[mesh.face_surface[f]])
    ]
    edges = [
        (e, f)
        for e, f in itertools.combinations(range(len(mesh.edges)), 2)
        if not set(mesh.edges[e]) & set(mesh.edges[f])
    ]
    found = set()
    for kind, ids, corners in (
        (0, points, [[v, *drawn.faces[f]] for v, f in points]),
        (1, edges, [[*mesh.edges[e], *mesh.edges[f]] for e, f in edges]),
    ):
        if not ids:
            continue
        corners = np.array(corners)
        owners = surface[corners[:, [0, 3]]]
        bodies = {"body_dynamic": drawn.body_dynamic, "ignored_pairs": drawn.ignored_pairs}
        touches = [may_touch(a, b, drawn.cloth_count, True, **bodies) for a, b in owners]
        closest = np.full(len(ids), np.inf)
        for share in np.linspace(0, 1, samples):
            x = np.ascontiguousarray((x_t0 + share * (x_t1 - x_t0))[corners])
            closest = np.minimum(closest, np.sqrt(kernels.distance_sq(bool(kind), x)))
        near = np.array(touches) & (closest <= np.array(reach)[owners].sum(axis=1))
        found |= {(kind, *map(int, ids[k])) for k in np.flatnonzero(near)}
    return found


@pytest.mark.parametrize("speed", [0.0, 0.05, 0.4], ids=["rest", "slow", "fast"])
@pytest.mark.parametrize(
    "name", ["on_a_round_ball", "on_a_capsule", "round_on_relief", "round_on_a_box", "round_heap"]
)
def test_nothing_that_comes_within_reach_of_a_skeleton_is_missed(name, speed):
    drawn, mesh = round_scene(name)
    rng = np.random.default_rng(3)
    reach = [0.04 + radius for radius in drawn.radius]
    for _ in range(3):
        x_t0 = drawn.x + 0.01 * speed * rng.normal(size=drawn.x.shape)
        shift = speed * rng.normal(size=(drawn.surface_count, 3))
        x_t1 = x_t0 + shift[drawn.surface] + 0.02 * speed * rng.normal(size=x_t0.shape)
        expected = pairs_within(drawn, mesh, x_t0, x_t1, reach)
        assert len(expected) > 2
        for found in (mesh.find(x_t0, x_t1, reach), mesh.find_kept(x_t0, x_t1, reach)):
            assert expected <= {(kind, a, b) for kind, *_, a, b in found.tolist()}


def test_a_skeleton_is_where_its_end_or_its_segment_is():
    """The nearest of the pairs is as near as the whole segment is to the whole triangle."""
    drawn, mesh = round_scene("on_a_capsule")
    x, faces = drawn.x, drawn.faces[:-1]
    ends = x[drawn.faces[-1][:2]]
    found = mesh.find(x, x, [0.3, 0.5])
    nearest = min(
        np.sqrt(kernels.distance_sq(bool(kind), x[None, corners])[0])
        for kind, *corners, _, _ in found.tolist()
        if (drawn.surface[corners] == 1).any()
    )
    along = ends[0] + np.linspace(0, 1, 4001)[:, None] * (ends[1] - ends[0])
    sampled = np.inf
    for f in faces:
        triangles = np.broadcast_to(x[f], (len(along), 3, 3))
        ways = trimesh.triangles.closest_point(triangles, along) - along
        sampled = min(sampled, np.linalg.norm(ways, axis=1).min())
    assert nearest == pytest.approx(sampled, rel=1e-5)
    assert nearest <= sampled + 1e-12


def test_bad_round_surfaces_are_refused():
    x = np.eye(4, 3)
    surface = np.zeros(4, np.int32)
    for faces, radius, message in (
        ([[0, 1, 2]], [0.1], "be a point or a segment"),
        ([[0, 0, 0], [1, 1, 1]], [0.1], "be one where their surface is round"),
        ([[0, 1, 1]], [0.0], "have three different corners"),
        ([[0, 1, 1]], [-1.0], "at least 0 of bodies"),
        ([[0, 1, 1]], [0.1, 0.1], "one value a surface"),
    ):
        with pytest.raises(ValueError, match=message):
            kernels.BroadPhase(np.array(faces, np.int32), surface, 0, True, x, radius=radius)
