"""Scenes of every kind of contact, all in general position."""

import numpy as np
import trimesh
from oracles.feature_sum import stack


def grid(n, size, rng, jitter=0.2):
    """Jittered n x n sheet in the plane z = 0, centered."""
    u, v = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    x = size * (np.stack([u, v, 0 * u], axis=-1).reshape(-1, 3) / (n - 1) - [0.5, 0.5, 0])
    x[:, :2] += jitter * rng.uniform(-0.5, 0.5, (len(x), 2)) * size / n
    corner = (u * n + v)[:-1, :-1].ravel()
    faces = [[corner, corner + n, corner + 1], [corner + 1, corner + n, corner + n + 1]]
    return x, np.concatenate([np.stack(f, axis=-1) for f in faces])


def cloth(n, size, height, rng, noise):
    """Rest shape, position and faces of a crumpled sheet at some height."""
    X, faces = grid(n, size, rng)
    return X, X + [0, 0, height] + noise * rng.normal(size=X.shape), faces


def relief(n, size, rng, height):
    """Open terrain of hills and hollows, finer than the cloth."""
    x, faces = grid(n, size, rng)
    x[:, 2] = rng.uniform(-height, height, len(x))
    return x, faces


def ball(rng, radius, noise, subdivisions=1):
    """Closed body with some hollows."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    scale = 1 + noise * rng.uniform(-1, 1, (len(mesh.vertices), 1))
    return mesh.vertices * scale - [0, 0, radius], mesh.faces


def box(size):
    mesh = trimesh.creation.box((size, size, size))
    return mesh.vertices - [0, 0, size / 2], mesh.faces


def rotated(body, rng):
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    return body[0] @ q.T, body[1]


def on_relief(rng):
    return stack([cloth(5, 0.6, 0.07, rng, 0.02)], [relief(7, 0.7, rng, 0.05)])


def on_a_ball(rng):
    return stack([cloth(6, 0.6, 0.05, rng, 0.01)], [ball(rng, 0.5, 0.0, 2)])


def on_a_lump(rng):
    return stack([cloth(6, 0.6, 0.05, rng, 0.03)], [ball(rng, 0.3, 0.2)])


def on_a_corner(rng):
    """The corner of a box below the middle of the sheet, box edges across the sheet."""
    x, faces = box(0.5)
    turned = trimesh.geometry.align_vectors([-1, -1, 1], [0, 0, 1])[:3, :3]
    x = (x + np.array([0.25, 0.25, 0])) @ turned.T
    return stack([cloth(6, 0.4, 0.04, rng, 0.01)], [(x - [0, 0, x[:, 2].max()], faces)])


def on_a_triangle(rng):
    """An open body: one triangle, from above and below."""
    x = np.array([[0.0, -0.02, 0], [0.21, 0.03, 0.01], [0.05, 0.22, -0.01]])
    sheets = [cloth(6, 0.5, z, rng, 0.01) for z in (0.05, -0.05)]
    return stack(sheets, [(x, np.array([[0, 1, 2]]))])


def on_slivers(rng):
    """A floor with slivers a ten-thousandth as wide as the other triangles."""
    x, faces = grid(5, 0.6, rng, jitter=0.0)
    x = x.reshape(5, 5, 3)
    x[2, :, 0] = x[1, :, 0] + 1.5e-5
    return stack(
        [cloth(6, 0.4, 0.05, rng, 0.01)], [(x.reshape(-1, 3) + np.array([0.01, 0.02, 0]), faces)]
    )


def two_cloths(rng):
    return stack([cloth(5, 0.6, 0.05, rng, 0.01), cloth(4, 0.5, 0.0, rng, 0.01)], [])


def crumpled(rng):
    """Self contact, and two bodies that the sheet is caught between."""
    ground = relief(4, 0.7, rng, 0.02)
    return stack([cloth(6, 0.5, 0.06, rng, 0.03)], [ground, (ground[0] + [0, 0, 0.13], ground[1])])


def pinned(rng):
    """Faces that are pinned as a whole, over a body's corner and in self contact."""
    scene = on_a_corner(rng)
    scene.prescribed[6:24] = True
    return scene


def pinned_under_a_body(rng):
    """The scene `on_a_corner` with a pinned border of the sheet, and a box that moves."""
    scene = on_a_corner(rng)
    scene.prescribed[:] = False
    scene.prescribed[6:24] = True
    scene.body_dynamic = [True]
    return scene


def thick(rng):
    scene = stack(
        [cloth(5, 0.6, 0.1, rng, 0.01), cloth(5, 0.6, 0.2, rng, 0.01)],
        [relief(5, 0.7, rng, 0.02)],
    )
    scene.thickness = [0.05, 0.02, 0.08]
    return scene


def two_lumps(rng):
    """Closed bodies with hollows; both move."""
    above = rotated(ball(rng, 0.3, 0.1), rng)
    below = rotated(ball(rng, 0.25, 0.1), rng)
    above = raised(above, -0.06)
    return stack([], [above, lowered(below)], body_dynamic=[True, True])


def raised(body, height):
    return body[0] - [0, 0, body[0][:, 2].min() - height], body[1]


def lowered(body):
    return body[0] - [0, 0, body[0][:, 2].max()], body[1]


def box_on_relief(rng):
    """A finely meshed box on static terrain."""
    mesh = trimesh.creation.box((0.3, 0.25, 0.2)).subdivide()
    body = rotated((mesh.vertices, mesh.faces), rng)
    ground = relief(6, 0.9, rng, 0.03)
    return stack([], [raised(body, 0.06), ground], body_dynamic=[True, False])


def boxes_aslant(rng):
    """Boxes with nearly parallel, subdivided edges: mollified, also where pieces meet."""
    lower = trimesh.creation.box((0.4, 0.4, 0.2)).subdivide()
    upper = trimesh.creation.box((0.4, 0.4, 0.2)).subdivide()
    q = trimesh.transformations.euler_matrix(0.004, -0.006, 0.013)[:3, :3]
    above = raised((upper.vertices @ q.T + [0.011, 0.007, 0], upper.faces), 0.05)
    return stack([], [above, lowered((lower.vertices, lower.faces))], body_dynamic=[True, True])


def ridges_across(rng):
    """Two crossing ridges, each subdivided into pieces shorter than the reach."""
    pieces = [prism(7, rng), prism(5, rng)]
    q = trimesh.transformations.euler_matrix(np.pi, 0.05, 0.9)[:3, :3]
    above = raised((pieces[0][0] @ q.T, pieces[0][1]), 0.05)
    return stack([], [above, lowered(pieces[1])], body_dynamic=[False, True])


def prism(pieces, rng):
    """Bar along x with its ridge up, bent a little; the ridge is cut into pieces."""
    s = np.linspace(-0.2, 0.2, pieces + 1)
    section = np.array([[0.0, 0.0], [0.2, -0.15], [-0.2, -0.15]])
    x = np.array([[at, *p] for at in s for p in section])
    x[:, 2] -= 0.3 * x[:, 0] ** 2
    faces = [[0, 2, 1], [3 * pieces, 3 * pieces + 1, 3 * pieces + 2]]
    for k in range(pieces):
        for i in range(3):
            a, b = 3 * k + i, 3 * k + (i + 1) % 3
            faces += [[a, b, b + 3], [a, b + 3, a + 3]]
    mesh = trimesh.Trimesh(x, faces, process=False)
    return x + 1e-3 * rng.normal(size=x.shape), mesh.faces * 1 if mesh.volume > 0 else mesh.faces[
        :, ::-1
    ]


def between_bodies(rng):
    """A cloth between two thick bodies that also touch each other; a third is ignored by one."""
    sheet = cloth(5, 0.4, 0.06, rng, 0.01)
    lump = raised(rotated(ball(rng, 0.2, 0.1), rng), 0.14)
    wall = rotated(box(0.3), rng)
    wall = raised((wall[0] - [wall[0][:, 0].min() - 0.27, 0, 0], wall[1]), 0.05)
    scene = stack(
        [sheet],
        [relief(5, 0.7, rng, 0.02), lump, wall],
        body_dynamic=[False, True, True],
        ignored_pairs=[[1, 3]],
    )
    scene.thickness = [0.01, 0.02, 0.03, 0.0]
    return scene


def skeleton(*ends, radius, rng):
    """Skeleton of a smooth sphere or capsule with these ends, randomly rotated about them."""
    ends = np.array(ends, dtype=float)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    carriers = ends[0] + radius * q[: 4 - len(ends)]
    return np.concatenate([ends, carriers]), np.array([[0, 0, 0] if len(ends) == 1 else [0, 1, 1]])


def on_a_round_ball(rng):
    sphere = skeleton([0.02, 0.01, -0.5], radius=0.5, rng=rng)
    scene = stack([cloth(6, 0.6, 0.03, rng, 0.01)], [sphere])
    scene.radius = [0.0, 0.5]
    return scene


def on_a_capsule(rng):
    """A capsule that ends below the sheet: contacts on its side, its end and in between."""
    capsule = skeleton([-0.6, 0.1, -0.24], [0.05, -0.03, -0.2], radius=0.2, rng=rng)
    scene = stack([cloth(6, 0.6, 0.03, rng, 0.01)], [capsule], body_dynamic=[True])
    scene.radius = [0.0, 0.2]
    return scene


def on_a_short_capsule(rng):
    """A thick capsule, so short that edges touch both ends, below a partly pinned sheet."""
    capsule = skeleton([-0.02, 0.03, -0.31], [0.05, 0.01, -0.3], radius=0.3, rng=rng)
    scene = stack([cloth(6, 0.6, 0.06, rng, 0.01)], [capsule])
    scene.radius, scene.thickness = [0.0, 0.3], [0.02, 0.03]
    scene.prescribed[6:24] = True
    return scene


def along_a_capsule(rng):
    """Edges of the sheet nearly parallel to the axis: mollified."""
    x, faces = grid(6, 0.6, rng, jitter=0.0)
    x[:, :2] @= [[1.0, 0.004], [-0.004, 1.0]]
    capsule = skeleton([-0.5, 0.02, -0.2], [0.5, 0.02, -0.2], radius=0.2, rng=rng)
    scene = stack([(x, x + [0, 0, 0.04] + 1e-3 * rng.normal(size=x.shape), faces)], [capsule])
    scene.radius = [0.0, 0.2]
    return scene


def round_on_relief(rng):
    """A sphere and a capsule on terrain, and on each other."""
    bodies = [
        relief(6, 0.9, rng, 0.03),
        skeleton([0.27, 0.05, 0.17], radius=0.1, rng=rng),
        skeleton([-0.25, -0.03, 0.19], [0.03, 0.06, 0.16], radius=0.1, rng=rng),
    ]
    scene = stack([], bodies, body_dynamic=[False, True, True])
    scene.radius, scene.thickness = [0.0, 0.1, 0.1], [0.01, 0.0, 0.02]
    return scene


def round_on_a_box(rng):
    """A capsule across the ridges of a box, with a sphere at its corner."""
    x, faces = box(0.3)
    bodies = [
        skeleton([0.25, -0.1, 0.05], [-0.05, 0.3, 0.06], radius=0.05, rng=rng),
        (x - [0, 0, 0.03], faces),
        skeleton([-0.2, -0.19, 0.02], radius=0.04, rng=rng),
    ]
    scene = stack([], bodies, body_dynamic=[True, True, False])
    scene.radius = [0.05, 0.0, 0.04]
    return scene


def round_heap(rng):
    """Spheres and capsules on each other: across, side by side, and at the ends."""
    bodies = [
        skeleton([0.0, 0.0, 0.0], radius=0.1, rng=rng),
        skeleton([0.25, 0.03, -0.05], radius=0.12, rng=rng),
        skeleton([-0.2, 0.0, 0.24], [0.2, 0.02, 0.23], radius=0.1, rng=rng),
        skeleton([-0.1, -0.2, 0.42], [0.08, 0.25, 0.43], radius=0.06, rng=rng),
        skeleton([-0.22, 0.0017, 0.02], [-0.6, 0.0, 0.01], radius=0.08, rng=rng),
        skeleton([-0.25, 0.203, 0.02], [-0.55, 0.2, 0.012], radius=0.08, rng=rng),
    ]
    scene = stack([], bodies, body_dynamic=[True] * 5 + [False])
    scene.radius = [0.1, 0.12, 0.1, 0.06, 0.08, 0.08]
    return scene


SCENES = {
    f.__name__: f
    for f in (
        on_relief,
        on_a_ball,
        on_a_lump,
        on_a_corner,
        on_a_triangle,
        on_slivers,
        two_cloths,
        crumpled,
        pinned,
        pinned_under_a_body,
        thick,
        two_lumps,
        box_on_relief,
        boxes_aslant,
        ridges_across,
        between_bodies,
        on_a_round_ball,
        on_a_capsule,
        on_a_short_capsule,
        along_a_capsule,
        round_on_relief,
        round_on_a_box,
        round_heap,
    )
}


def make(name, seed=0):
    scene = SCENES[name](np.random.default_rng(seed))
    count = scene.surface_count
    scene.kappa = 2.0 + 3.0 * np.arange(count**2).reshape(count, count) / count**2
    return scene
