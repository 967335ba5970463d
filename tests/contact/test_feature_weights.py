"""Contact with a body does not depend on the body's triangulation."""

import contact_scenes
import numpy as np
import pytest
import trimesh
from oracles.feature_sum import edges_of, stack

D_HAT = 0.1


def grid_floor(columns, rows, size, sliver=None):
    """Flat floor of 2 * columns * rows triangles; `sliver` is the width of extra columns."""
    x = np.linspace(-0.5, 0.5, columns + 1)
    if sliver:
        x = np.sort([*x, *(x[1:-1] + sliver)])
    y = np.linspace(-0.5, 0.5, rows + 1)
    u, v = np.meshgrid(x, y, indexing="ij")
    n = rows + 1
    corner = (np.arange(len(x) - 1)[:, None] * n + np.arange(rows)).ravel()
    faces = [[corner, corner + n, corner + n + 1], [corner, corner + n + 1, corner + 1]]
    return (
        size * np.stack([u, v, 0 * u], axis=-1).reshape(-1, 3),
        np.concatenate([np.stack(f, axis=-1) for f in faces]),
    )


FLOORS = {
    "two": grid_floor(1, 1, 2.0),
    "coarse": grid_floor(3, 4, 2.0),
    "like-the-cloth": grid_floor(16, 16, 2.0),
    "fine": grid_floor(60, 60, 2.0),
    "slivers": grid_floor(8, 8, 2.0, sliver=1e-6),
}


def rotation(seed):
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


@pytest.mark.parametrize("turned", [False, True], ids=["level", "turned"])
@pytest.mark.parametrize("aligned", [False, True], ids=["jittered", "aligned"])
@pytest.mark.parametrize("name", list(FLOORS))
def test_a_flat_floor_is_seen_once(name, aligned, turned):
    """Every vertex has contact with its whole area, also right above edges and vertices."""
    rng = np.random.default_rng(0)
    X, faces = contact_scenes.grid(9, 1.0, rng, 0.0 if aligned else 0.3)
    q = rotation(1) if turned else np.eye(3)
    floor, floor_faces = FLOORS[name]
    x = (X + np.array([0, 0, 0.4 * D_HAT])) @ q.T
    scene = stack([(X, x, faces)], [(floor @ q.T, floor_faces)], self_contact=False)
    potential = scene.potential()
    corners, c, weight, distance = potential.contacts(scene.x)
    assert len(corners) == len(X)
    np.testing.assert_array_equal(corners[:, 0], np.arange(len(X)))
    area = np.array(potential.measure("vertex_area"))[: len(X)]
    np.testing.assert_allclose(weight, area / 4, rtol=1e-15)
    np.testing.assert_allclose(distance, 0.4 * D_HAT, rtol=1e-12)
    np.testing.assert_allclose(c.sum(axis=1), 0, atol=1e-12)


def against(body, center):
    """The sheet's contacts of vertices with a body, as (vertex, weight / area)."""
    rng = np.random.default_rng(2)
    X, faces = contact_scenes.grid(12, 0.5, rng)
    x = X + center + 0.02 * rng.normal(size=X.shape)
    scene = stack([(X, x, faces)], [body], self_contact=False)
    potential = scene.potential()
    corners, _, weight, _ = potential.contacts(scene.x)
    of_vertices = (corners[:, 0] < len(X)) & (corners[:, 1] >= len(X))
    area = np.array(potential.measure("vertex_area"))
    vertex = corners[of_vertices, 0]
    return vertex, weight[of_vertices] / area[vertex]


@pytest.mark.parametrize("subdivisions", [1, 2, 3])
def test_a_convex_body_is_seen_once(subdivisions):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.4)
    vertex, share = against((ball.vertices, ball.faces), [0, 0, 0.45])
    assert len(vertex) > 30
    assert len(np.unique(vertex)) == len(vertex)
    np.testing.assert_array_equal(share, 0.25)


def test_a_hollow_body_is_seen_with_all_its_walls():
    """A saddle and a valley have contacts of both signs; the nearest feature counts once."""
    rng = np.random.default_rng(3)
    vertex, share = against(contact_scenes.relief(9, 0.8, rng, 0.06), [0, 0, 0.08])
    assert (share < 0).any()
    assert len(np.unique(vertex)) < len(vertex)
    # Above a surface without holes the shares count as its Euler characteristic does.
    total = np.bincount(vertex, weights=share)
    assert set(np.unique(total)) <= {0.0, 0.25, 0.5}


def prism(pieces, angle=90.0, length=1.0):
    """Bar along x with its ridge up, z = 0 there; the ridge is cut into pieces."""
    half = np.radians(angle) / 2
    down = np.array([0.5 * np.sin(half), -0.5 * np.cos(half)])
    section = np.array([[0.0, 0.0], down, [-down[0], down[1]]])
    s = length * np.linspace(-0.5, 0.5, pieces + 1)
    x = np.array([[at, *p] for at in s for p in section])
    faces = [[0, 2, 1], [3 * pieces, 3 * pieces + 1, 3 * pieces + 2]]
    for k in range(pieces):
        for i in range(3):
            a, b = 3 * k + i, 3 * k + (i + 1) % 3
            faces += [[a, b, b + 3], [a, b + 3, a + 3]]
    mesh = trimesh.Trimesh(x, faces, process=False)
    assert mesh.is_watertight
    return x, np.array(faces if mesh.volume > 0 else [f[::-1] for f in faces])


@pytest.mark.parametrize("turn", [0.3, 0.7])
def test_a_ridge_in_pieces_is_one_ridge(turn):
    """The barrier on a sheet across the ridge is the same for any subdivision."""
    X, faces = contact_scenes.grid(12, 0.8, np.random.default_rng(4))
    q = trimesh.transformations.rotation_matrix(turn, [0, 0, 1])[:3, :3]
    x = X @ q.T + [0.013, 0.007, 0.5 * D_HAT]
    found = []
    for pieces in (1, 2, 7, 32):
        scene = stack([(X, x, faces)], [prism(pieces, length=3.0)], self_contact=False)
        potential = scene.potential()
        found.append(potential.energies(scene.x, scene.x)[0].sum())
    # Approximate: an edge that ends beside the ridge is in contact with the piece on its side.
    assert max(found) / min(found) < 1.02


def along_a_path(body, x, direction, length, steps, up=(0.0, 0.0, 1.0)):
    """Gradients by one vertex along a straight path; the rest of its face is far above."""
    X = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2]])
    found = []
    scene = stack([(X, X, faces)], [body], self_contact=False)
    potential = scene.potential()
    for s in np.linspace(0, length, steps):
        at = scene.x.copy()
        at[0] = x + s * direction
        at[1:3] = at[0] + 100 * np.array(up) + [[0, 1e-3, 0], [1e-3, 0, 0]]
        found.append(potential.gradient(at)[0])
    return np.array(found)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("body", ["relief", "ball", "box", "groove"])
def test_the_force_is_continuous_across_features(body, seed):
    """Over faces, edges, vertices, creases and hollows: jumps shrink with the step."""
    rng = np.random.default_rng(seed)
    if body == "relief":
        shape = contact_scenes.relief(8, 0.6, rng, 0.05)
    elif body == "ball":
        shape = contact_scenes.ball(rng, 0.3, 0.1)
    elif body == "box":
        shape = contact_scenes.box(0.3)
    else:
        shape = groove(100.0)
    direction = np.array([*rng.normal(size=2), 0.0])
    if body == "groove":
        direction = np.array([0.5, 0.03 * (seed - 2.5), 0.0])  # between its walls
    direction /= np.linalg.norm(direction)
    top = 0.0 if body == "groove" else shape[0][:, 2].max()
    start = np.array([0.0, 0.0, top + 0.5 * D_HAT]) - 0.25 * direction
    jumps = []
    for steps in (501, 2001):
        force = along_a_path(shape, start, direction, 0.5, steps)
        assert np.abs(force).max() > 1e-4
        jumps.append(np.linalg.norm(np.diff(force, axis=0), axis=1).max())
    assert jumps[1] < 0.3 * jumps[0]


@pytest.mark.parametrize("seed", range(3))
def test_the_force_pushes_away_from_a_convex_body(seed):
    rng = np.random.default_rng(seed)
    shape = contact_scenes.rotated(contact_scenes.box(0.3), rng)
    mesh = trimesh.convex.convex_hull(shape[0])
    for _ in range(20):
        point, face = trimesh.sample.sample_surface(mesh, 1, seed=rng.integers(1 << 30))
        normal = mesh.face_normals[face[0]]
        start = point[0] + 0.4 * D_HAT * normal
        force = -along_a_path(shape, start, normal, 0, 1, up=normal)[0]
        assert force @ normal > 0


def groove(angle):
    """Solid with a groove along x, its bottom at z = 0, walls at an opening angle."""
    half = np.radians(angle) / 2
    side, up = 10 * np.sin(half), 10 * np.cos(half)
    section = [[0, 0], [side, up], [side + 0.1, -3], [-side - 0.1, -3], [-side, up]]
    x = np.array([[s, *p] for s in (-5, 5) for p in section], float)
    faces = [f for k in (1, 2, 3) for f in ([0, k + 1, k], [5, 5 + k, 6 + k])]
    for a in range(5):
        b = (a + 1) % 5
        faces += [[a, b, b + 5], [a, b + 5, a + 5]]
    mesh = trimesh.Trimesh(x, faces, process=False)
    return x, np.array(faces if mesh.volume > 0 else [f[::-1] for f in faces])


@pytest.mark.parametrize(("angle", "least"), [(150, 0.92), (120, 0.73), (90, 0.48), (45, 0.12)])
def test_the_walls_of_a_groove_push_out(angle, least):
    """Share of the nearest wall's normal force that remains; the walls' forces oppose."""
    half = np.radians(angle) / 2
    along, normal = np.array([[0, np.sin(half), np.cos(half)], [0, -np.cos(half), np.sin(half)]])
    shares = []
    for distance in (0.1, 0.3, 0.5, 0.7, 0.9):
        d = distance * D_HAT
        start = d * normal + d / np.tan(half) * along
        force = -along_a_path(groove(angle), start, along, 2 * D_HAT, 50) @ normal
        assert (force > 0).all()
        shares.append(force.min() / force[-1])  # in the end there is one wall only
    assert least <= min(shares) < least + 0.02


# --- Sharp edges and vertices --------------------------------------------------------------------


def weights_of(body, cloth_edge=0.05):
    X = cloth_edge * np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0.75**0.5, 0]])
    scene = stack([(X, X, np.array([[0, 1, 2]]))], [body], self_contact=False)
    potential = scene.potential()
    edge, vertex = potential.sharpness()
    edges = [tuple(e - 3) for e in potential.edges()[3:]]
    return dict(zip(edges, edge, strict=True)), vertex, potential


def smoothstep(t):
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


def test_a_box_is_sharp_at_its_edges_and_corners():
    x, faces = contact_scenes.box(1.0)
    edge, vertex, potential = weights_of((x, faces))
    for (i, j), s in edge.items():
        is_diagonal = np.sum((x[i] - x[j]) ** 2) > 1.5
        assert s == (0.0 if is_diagonal else 1.0)
    np.testing.assert_array_equal(vertex, 1.0)
    assert (potential.continuation() == 0).all()


def test_inward_faces_are_taken_for_bulging():
    """A room, or a body with inverted faces: no edge may be ignored in either case."""
    x, faces = contact_scenes.box(1.0)
    edge, vertex, _ = weights_of((x, faces[:, ::-1]))
    assert sorted(edge.values()) == [0.0] * 6 + [1.0] * 12
    np.testing.assert_array_equal(vertex, 1.0)
    one_turned = np.array([faces[0][::-1], *faces[1:]])
    assert sorted(weights_of((x, one_turned))[0].values()) == [0.0] * 6 + [1.0] * 12


def test_a_hollow_edge_is_not_sharp():
    x, faces = groove(90.0)
    edge, _, _ = weights_of((x, faces))
    assert edge[(0, 5)] == 0.0
    assert edge[(1, 6)] == 1.0
    # The open groove may be touched from below.
    walls = np.array([f for f in faces if len(set(f) & {0, 1, 5, 6}) == 3])
    other = np.array([f for f in faces if len(set(f) & {0, 4, 5, 9}) == 3])
    assert weights_of((x, np.concatenate([walls, other])))[0][(0, 5)] == 1.0


def test_a_boundary_is_sharp():
    x, faces = grid_floor(2, 2, 1.0)
    edge, vertex, potential = weights_of((x, faces))
    count = {e: sum(set(e) <= set(f) for f in faces) for e in edges_of(faces)}
    assert edge == {e: float(n == 1) for e, n in count.items()}
    corners = (np.abs(x[:, :2]) > 0.4).all(axis=1)
    np.testing.assert_array_equal(vertex, corners.astype(float))
    gamma = dict(zip(edge, potential.continuation(), strict=True))
    for e, ends in gamma.items():
        if count[e] == 1:
            np.testing.assert_array_equal(ends, [float(not corners[v]) for v in e])


@pytest.mark.parametrize("subdivisions", [1, 2, 3])
def test_a_smooth_ball_is_as_sharp_as_its_angles(subdivisions):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    L = 0.2
    edge, vertex, _ = weights_of((ball.vertices, ball.faces), cloth_edge=L)
    for e, theta, (f, g) in zip(
        np.sort(ball.face_adjacency_edges),
        ball.face_adjacency_angles,
        ball.face_adjacency,
        strict=True,
    ):
        length = np.linalg.norm(np.subtract(*ball.vertices[e]))
        width = 2 * (ball.area_faces[f] + ball.area_faces[g]) / 3 / length
        expected = 2 * theta / np.pi * smoothstep(theta * max(1, L / width))
        assert edge[tuple(e)] == pytest.approx(expected, rel=1e-6)  # single precision
    omega = ball.vertex_defects
    area = np.zeros(len(omega))
    np.add.at(area, ball.faces, ball.area_faces[:, None] / 3)
    expected = np.clip(2 * omega / np.pi, 0, 1)
    expected *= smoothstep(np.sqrt(omega) * np.maximum(1, L / np.sqrt(area)))
    np.testing.assert_allclose(vertex, expected, rtol=1e-6)


def test_a_star_is_sharp_at_its_tips_only():
    """Tips between hollow edges have normals too, which no defect of angles shows."""
    tip, notch = 0.6, 0.25
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    radius = np.where(np.arange(12) % 2, notch, tip)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=-1)
    x = np.array([*ring, [0, 0, 1.0], [0, 0, -1.0]])
    faces = [f for k in range(12) for f in ([k, (k + 1) % 12, 12], [(k + 1) % 12, k, 13])]
    mesh = trimesh.Trimesh(x, faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0
    edge, vertex, _ = weights_of((x, np.array(faces)))
    assert (vertex[:12:2] > 0).all()
    assert (vertex[1:12:2] == 0).all()  # the notches
    assert (vertex[12:] > 0).all()
    assert edge[(0, 12)] > 0 == edge[(1, 12)]


def test_pinned_faces_of_a_cloth_bear_only_moving_points():
    scene = contact_scenes.make("pinned")
    _, _, counts = scene.potential().feature_weights(prescribed_point=True)
    expected = [not scene.prescribed[f].all() or scene.surface[f[0]] > 0 for f in scene.faces]
    assert counts == expected
    assert not all(counts)
    _, _, counts = scene.potential().feature_weights(prescribed_point=False)
    assert all(counts)


def test_a_thick_body_costs_as_much_as_a_thin_one():
    """One sheet at one gap has the same number of candidates and contacts, also in the cloth."""
    rng = np.random.default_rng(6)
    X, faces = contact_scenes.grid(20, 1.0, rng)
    found = []
    for thickness in (0.0, 0.2):
        radius = 1.0 - 0.5 * thickness
        ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        x = X.copy()
        x[:, 2] = np.sqrt((1 + 0.4 * 0.05) ** 2 - (X[:, :2] ** 2).sum(axis=1))
        scene = stack([(X, x, faces)], [(ball.vertices, ball.faces)], d_hat=0.05)
        scene.thickness = [0.0, thickness]
        potential = scene.potential()
        found.append((potential.candidate_count(scene.x), len(potential.contacts(scene.x)[0])))
    (thin, thin_contacts), (thick, thick_contacts) = found
    # Boxes grow by the thickness: some more faces of the ball, but no pairs within the cloth.
    assert thick < 3 * thin
    assert thick_contacts < 1.5 * thin_contacts
