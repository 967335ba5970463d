"""Contact between bodies: smooth separation everywhere, for any triangulation."""

import contact_scenes
import ipctk
import numpy as np
import pytest
import trimesh
from oracles.feature_sum import stack
from test_feature_weights import FLOORS, grid_floor, prism

from diffcloth_torch import _kernels as kernels

D_HAT = 0.1


def turn(x, y, z):
    return trimesh.transformations.euler_matrix(x, y, z)[:3, :3]


def box(size, cuts=0):
    mesh = trimesh.creation.box(size)
    for _ in range(cuts):
        mesh = mesh.subdivide()
    return np.array(mesh.vertices), np.array(mesh.faces)


def placed(body, q, at):
    """A body turned, its lowest point above the origin moved to `at`."""
    x = body[0] @ q.T
    return x - [0, 0, x[:, 2].min()] + np.array(at), body[1]


def below(body):
    return body[0] - [0, 0, body[0][:, 2].max()], body[1]


def pair(above, under, **values):
    return stack([], [above, under], body_dynamic=[True, False], **values)


def wrench(scene):
    """Force on the first body, torque about the origin, and the number of contacts."""
    potential = scene.potential()
    force = -potential.gradient(scene.x)[scene.surface == 0]
    torque = np.cross(scene.x[scene.surface == 0], force).sum(axis=0)
    return np.array([*force.sum(axis=0), *torque]), len(potential.contacts(scene.x)[0])


# --- Areas of a body's corners and ridges ---------------------------------------------------------


def areas_of(body):
    scene = pair(body, (np.array(body[0]) + 100.0, body[1]))
    count = len(body[0])
    potential = scene.potential()
    vertex, _, edge, surface = potential.body_areas()
    edges = [tuple(map(int, e)) for e in potential.edges() if e[0] < count]
    return vertex[:count], dict(zip(edges, edge[: len(edges)], strict=True)), surface[0]


@pytest.mark.parametrize("cuts", range(4))
def test_a_box_has_eight_corners_and_twelve_ridges(cuts):
    """Corners have a quarter of three faces, ridges of two, for any subdivision."""
    size = np.array([0.4, 0.3, 0.2])
    x, faces = box(size, cuts)
    vertex, edge, surface = areas_of((x, faces))
    corner = (np.abs(np.abs(x) - size / 2) < 1e-9).all(axis=1)
    quarters = np.prod(size) / size / 4  # of the faces across x, y, z
    np.testing.assert_allclose(vertex, np.where(corner, quarters.sum(), 0), rtol=1e-12)
    for (i, j), area in edge.items():
        on_faces = np.abs(np.abs(x[[i, j]]) - size / 2) < 1e-9
        sides = on_faces.all(axis=0) & (x[i] * x[j] > 0)
        expected = 0.0
        if sides.sum() == 2:
            (along,) = np.flatnonzero(~sides)
            for k in np.flatnonzero(sides):
                other = 3 - along - k
                expected += 4 * quarters[k] * size[along] / (2 * (size[along] + size[other]))
        assert area == pytest.approx(expected, rel=1e-12, abs=1e-15)
    assert surface == pytest.approx(4 * 2 * quarters.sum(), rel=1e-6)


@pytest.mark.parametrize("name", list(FLOORS))
def test_a_sheet_has_four_corners(name):
    vertex, edge, surface = areas_of(FLOORS[name])
    assert surface == pytest.approx(4.0, rel=1e-6)
    np.testing.assert_allclose(np.sort(vertex)[-4:], 1.0, rtol=1e-9)
    assert np.count_nonzero(vertex) == 4
    assert {round(a, 9) for a in edge.values() if a} == {1.0}


def test_a_smooth_body_gives_its_vertices_their_surroundings():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.4)
    vertex, edge, surface = areas_of((ball.vertices, ball.faces))
    assert vertex.sum() == pytest.approx(ball.area, rel=1e-12)
    assert sum(edge.values()) == pytest.approx(ball.area, rel=1e-12)
    assert surface == pytest.approx(ball.area, rel=1e-6)
    assert vertex.min() > 0.5 * vertex.max()


def test_hollows_stand_for_nothing():
    """On a step, the inner ridge and its ends cannot touch; the corners receive their area."""
    profile = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2.0]])
    caps = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    sides = [
        face
        for i, j in zip(range(6), np.roll(range(6), -1), strict=True)
        for face in ([i, j, j + 6], [i, j + 6, i + 6])
    ]
    x = np.concatenate([np.c_[profile, 0 * profile[:, 0] + z] for z in (0, 1)])
    mesh = trimesh.Trimesh(x, [*caps[:, ::-1], *(caps + 6), *sides], process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(3.0)
    vertex, edge, _ = areas_of((mesh.vertices, mesh.faces))
    inner = np.flatnonzero(np.isclose(mesh.vertices[:, :2], 1).all(axis=1))
    assert len(inner) == 2
    assert (vertex[inner] == 0).all()
    assert edge[tuple(inner)] == 0
    assert vertex.sum() == pytest.approx(mesh.area, rel=1e-9)


# --- Triangles do not matter ---------------------------------------------------------------------


@pytest.mark.parametrize("tilt", [(0, 0, 0.4), (0.02, -0.05, 0.4)], ids=["flat", "tilted"])
def test_a_box_feels_no_triangles_of_a_plane_or_of_its_own(tilt):
    found = []
    for cuts in (0, 1, 3):
        above = placed(box((0.5, 0.4, 0.3), cuts), turn(*tilt), (0.013, 0.007, 0.4 * D_HAT))
        for floor in FLOORS.values():
            found.append(wrench(pair(above, floor))[0])
    assert found[0][2] > 0.5
    np.testing.assert_allclose(found, np.tile(found[0], (len(found), 1)), atol=1e-10)


@pytest.mark.parametrize("cuts", [0, 3])
def test_a_flat_box_stands_on_its_corners(cuts):
    above = placed(box((0.5, 0.4, 0.3), cuts), turn(0, 0, 0.4), (0.013, 0.007, 0.4 * D_HAT))
    force, count = wrench(pair(above, grid_floor(40, 40, 2.0)))
    assert count == 4
    assert np.abs(force[[0, 1, 5]]).max() < 1e-12


def test_a_corner_crosses_a_diagonal_without_a_jump():
    """The diagonal of the floor runs along x = y."""
    tip = placed(box((0.4, 0.4, 0.4)), turn(0.6, 0.7, 0.1), (0, 0, 0.3 * D_HAT))
    lowest = tip[0][np.argmin(tip[0][:, 2])]
    forces = []
    for s in (-0.1, -1e-9, 0.0, 1e-9, 0.1):
        at = tip[0] - lowest * [1, 1, 0] + [s, -s, 0]
        forces.append(wrench(pair((at, tip[1]), FLOORS["two"]))[0][:3])
    assert forces[0][2] > 0.01
    np.testing.assert_allclose(forces, np.tile(forces[0], (5, 1)), atol=1e-12)


def test_ridges_in_pieces_act_as_whole_ones():
    """Crossing at an angle, both cut, into pieces longer and shorter than the reach."""
    across = turn(np.pi, 0.03, 0.9)
    found = []
    for cuts in [(1, 1), (1, 7), (7, 1), (4, 9), (31, 23)]:
        above, under = (prism(n, length=1.5) for n in cuts)
        found.append(wrench(pair(placed(above, across, (0.02, 0.01, 0.05)), below(under)))[0])
    assert found[0][2] > 0.01
    np.testing.assert_allclose(found, np.tile(found[0], (len(found), 1)), rtol=1e-9, atol=1e-11)


# --- Contact forces, not collision detection alone, keep bodies apart ----------------------------


def hull(seed, size):
    rng = np.random.default_rng(seed)
    mesh = trimesh.convex.convex_hull(size * rng.normal(size=(12, 3)) / 3)
    return np.array(mesh.vertices - mesh.center_mass), np.array(mesh.faces)


def distance(scene):
    """Between two bodies, over all their pairs."""
    faces = scene.faces.astype(np.int32)
    search = kernels.BroadPhase(
        faces, scene.surface, 0, False, scene.x, body_dynamic=scene.body_dynamic
    )
    pairs = search.find(scene.x, scene.x, 10.0)
    return min(
        np.sqrt(kernels.distance_sq(bool(k), scene.x[pairs[pairs[:, 0] == k, 1:5]]).min())
        for k in (0, 1)
    )


def at_distance(above, under, direction, gap):
    """Two convex bodies moved together along a direction, up to a gap."""
    far, near = 3.0, 0.0
    for _ in range(60):
        middle = 0.5 * (far + near)
        scene = pair((above[0] + middle * direction, above[1]), under)
        search = kernels.BroadPhase(
            scene.faces.astype(np.int32),
            scene.surface,
            0,
            False,
            scene.x,
            body_dynamic=[True, False],
        )
        apart = search.find_intersection(scene.x) is None
        if apart and distance(scene) > gap:
            far = middle
        else:
            near = middle
    return pair((above[0] + far * direction, above[1]), under)


@pytest.mark.parametrize("seed", range(8))
def test_bodies_push_each_other_apart(seed):
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    above, under = hull(seed, 0.5), hull(seed + 100, 0.5)
    forces = []
    for gap in (0.5 * D_HAT, 0.1 * D_HAT):
        scene = at_distance(above, under, direction, gap)
        assert distance(scene) == pytest.approx(gap, rel=1e-6)
        forces.append(wrench(scene)[0][:3] @ direction)
    assert forces[0] > 1e-3
    assert forces[1] > 2 * forces[0]


@pytest.mark.parametrize("degrees", [0.0, 0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 45.0])
@pytest.mark.parametrize("d_hat", [0.1, 0.01, 0.001])
def test_equal_boxes_are_stacked_at_every_angle(degrees, d_hat):
    """Aligned boxes rest on corners, others on crossing ridges; mollified in between."""
    side = box((0.5, 0.5, 0.3))
    above = placed(side, turn(0, 0, np.radians(degrees)), (0, 0, d_hat / 2))
    force, _ = wrench(pair(above, below(side), d_hat=d_hat))
    # Force between the boxes' faces: kappa A times the barrier's slope at half of its reach.
    slope = -kernels.barrier_derivatives((d_hat / 2) ** 2, 0.0, d_hat)[1] * d_hat
    assert 0.9 < force[2] / (3.0 * 0.25 * slope) < 6
    np.testing.assert_allclose(force[[0, 1, 3, 4]], 0, atol=1e-9)


@pytest.mark.quick("0-lumps", "0-on-relief")
@pytest.mark.parametrize("name", ["stacked", "over-the-rim", "lumps", "on-relief"])
@pytest.mark.parametrize("seed", range(3))
def test_force_and_torque_are_continuous_along_rigid_motions(name, seed):
    """Across faces, ridges, corners and parallel ridges, changes shrink with the step."""
    rng = np.random.default_rng(seed)
    if name == "lumps":
        above, under = contact_scenes.ball(rng, 0.3, 0.1), contact_scenes.ball(rng, 0.25, 0.1)
        under = below(under)
    elif name == "on-relief":
        above, under = box((0.2, 0.2, 0.2)), contact_scenes.relief(6, 0.8, rng, 0.02)
    else:
        above, under = box((0.4, 0.4, 0.2), 1), below(box((0.4, 0.4, 0.2), 2))
    shift = 0.25 if name == "over-the-rim" else 0.02
    start, stop = shift * rng.normal(size=(2, 3)), shift * rng.normal(size=(2, 3))
    swing = 0.05 if name in ("stacked", "over-the-rim") else 0.5

    def scene_at(s):
        angles = swing * ((1 - s) * start[0] + s * stop[0]) / shift
        move = ((1 - s) * start[1] + s * stop[1]) * [1, 1, 0]
        body = placed(above, turn(*angles), move)
        gap = 0.35 * D_HAT
        return pair((body[0] + [0, 0, under[0][:, 2].max() + gap], body[1]), under)

    fine = np.array([wrench(scene_at(s))[0] for s in np.linspace(0, 1, 1601)])
    assert np.abs(fine[:, 2]).max() > 1e-3
    jumps = [np.linalg.norm(np.diff(found, axis=0), axis=1).max() for found in (fine[::4], fine)]
    assert jumps[1] < 0.3 * jumps[0]


@pytest.mark.parametrize("cuts", [0, 3])
@pytest.mark.parametrize("name", list(FLOORS))
def test_a_sliding_box_is_held_back_by_mu_times_its_normal_force(name, cuts):
    above = placed(box((0.5, 0.4, 0.3), cuts), turn(0, 0, 0.4), (0.013, 0.007, 0.4 * D_HAT))
    scene = pair(above, FLOORS[name])
    potential = scene.potential(friction=[0.0, 0.2, 0.4, 0.0])
    normal = -potential.gradient(scene.x)[scene.surface == 0].sum(axis=0)
    slide = 3 * scene.slip * np.array([0.6, 0.8, 0.0])
    x = scene.x + slide * (scene.surface == 0)[:, None]
    force = -potential.friction(scene.x, scene.x).gradient(x)
    on_box = force[scene.surface == 0].sum(axis=0)
    np.testing.assert_allclose(on_box, -0.3 * normal[2] * np.array([0.6, 0.8, 0.0]), atol=1e-12)
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-13)


# --- Excluded pairs, and pairs that must not be missed -------------------------------------------


def resting(**values):
    above = placed(box((0.3, 0.3, 0.3)), turn(0, 0, 0.3), (0, 0, 0.4 * D_HAT))
    scene = stack([], [above, FLOORS["two"]], **values)
    potential = scene.potential()
    return potential.candidate_count(scene.x), len(potential.contacts(scene.x)[0])


def test_ignored_pairs_and_still_bodies_do_not_touch():
    assert resting(body_dynamic=[True, False])[1] == 4
    assert resting(body_dynamic=[False, True])[1] == 4
    assert resting(body_dynamic=[True, True])[1] == 4
    assert resting(body_dynamic=[False, False]) == (0, 0)
    assert resting() == (0, 0)
    assert resting(body_dynamic=[True, False], ignored_pairs=[[0, 1]]) == (0, 0)


def test_a_body_may_ignore_a_cloth():
    rng = np.random.default_rng(0)
    sheet = contact_scenes.cloth(5, 0.6, 0.05, rng, 0.0)
    for ignored, touch in (([], True), ([[0, 1]], False)):
        scene = stack([sheet], [FLOORS["coarse"]], self_contact=False, ignored_pairs=ignored)
        potential = scene.potential()
        assert (len(potential.contacts(scene.x)[0]) > 0) == touch
        assert (potential.candidate_count(scene.x) > 0) == touch


def test_pairs_of_prescribed_vertices_carry_no_energy():
    """This holds also if their pair of surfaces may touch."""
    above = placed(box((0.3, 0.3, 0.3)), turn(0, 0, 0.3), (0, 0, 0.4 * D_HAT))
    scene = stack([], [above, FLOORS["two"]], body_dynamic=[True, False])
    scene.prescribed[:] = True
    assert scene.potential().candidate_count(scene.x) > 0
    assert len(scene.potential().contacts(scene.x)[0]) == 0


@pytest.mark.parametrize("seed", range(12))
def test_no_collision_of_bodies_is_missed(seed):
    """Three bodies thrown at each other; ipctk judges the motion and its certified part."""
    rng = np.random.default_rng(seed)
    at = 0.8 * np.array([[1.0, 0, 0], [-0.5, 0.87, 0], [-0.5, -0.87, 0]])
    hulls = [hull(3 * seed + k, 0.8) for k in range(3)]
    bodies = [(x + p, f) for p, (x, f) in zip(at, hulls, strict=True)]
    scene = stack([], bodies, body_dynamic=[True, True, False])
    faces = scene.faces.astype(np.int32)
    search = kernels.BroadPhase(faces, scene.surface, 0, False, scene.x, [True, True, False])
    assert search.find_intersection(scene.x) is None
    speed = -1.2 * at + 0.4 * rng.normal(size=(3, 3))
    spin = 0.3 * rng.normal(size=(3, 3))
    step = speed[scene.surface] + np.cross(spin[scene.surface], scene.x - at[scene.surface])
    alpha = 1.0
    pairs = search.find(scene.x, scene.x + step, 0.0)
    for kind in (0, 1):
        v = pairs[pairs[:, 0] == kind, 1:5]
        if len(v):
            ends = (np.ascontiguousarray(x[v]) for x in (scene.x, scene.x + step))
            alpha = min(alpha, kernels.safe_step(bool(kind), *ends, 0.0).min())
    judge = ipctk.CollisionMesh(scene.x, ipctk.edges(faces), faces)
    free = ipctk.is_step_collision_free(judge, scene.x, scene.x + step)
    assert (alpha == 1) == free
    assert ipctk.is_step_collision_free(judge, scene.x, scene.x + alpha * step)
    if not free:
        assert 0 < alpha < 1
