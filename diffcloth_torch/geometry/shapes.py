"""Vertices and outward-facing triangles of simple shapes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray

__all__ = ["MOST_FACES", "Mesh", "box", "capsule", "cylinder", "grid", "plane", "sphere", "strip"]

Mesh = tuple[FloatArray, NDArray[np.int64]]

MOST_FACES = 4_000_000
"""Largest number of faces of a generated mesh: more are refused before they fill the memory."""

# Segments around a capsule and rings on each of its caps: at most 5 degrees off a true circle.
_CAPSULE_RINGS = 8

# Rings on an end of a cylinder: 6 vertices on the first, 6 more on each next, 30 on its rim.
_CYLINDER_RINGS = 5
_CYLINDER_ROWS = 32


def grid(rows: int, columns: int, size: FloatArray) -> Mesh:
    """Sheet of rows x columns vertices in the xy-plane, row by row; columns run along x."""
    x = (np.arange(columns) / (columns - 1) - 0.5) * size[0]
    y = (np.arange(rows) / (rows - 1) - 0.5) * size[1]
    xx, yy = np.meshgrid(x, y)
    vertices = np.stack([xx, yy, np.zeros_like(xx)], axis=-1).reshape(-1, 3)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    lower = np.stack([corner, corner + 1, corner + columns + 1], axis=-1)
    upper = np.stack([corner, corner + columns + 1, corner + columns], axis=-1)
    return vertices, np.stack([lower, upper], axis=1).reshape(-1, 3)


def strip(
    length: float,
    width: float | Sequence[float],
    rows: int,
    columns: int,
    bend: float,
    radius: float,
    middle: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Strip along x, bent downwards about an axis along y: up to a U that opens downwards.

    The bend preserves all lengths along and across the strip.

    Args:
        length: Length of the strip [m].
        width: Width of the strip [m]; one number, or one for each end, with straight sides in
            between.
        rows: Number of vertices across.
        columns: Number of vertices along.
        bend: Angle between the directions of its two ends [degrees], 0 to 180.
        radius: Radius of the bend, whose axis passes through the origin [m].
        middle: Position of the middle of the bend, as a fraction of the length.

    Returns:
        Flat vertices [n, 3], bent vertices [n, 3], and faces [f, 3].
    """
    arc = np.radians(bend) * radius
    if not arc / 2 <= min(middle, 1 - middle) * length:
        raise ValueError(
            f"strip: `bend` and `radius` must fit on both sides of `middle`: half of the arc is "
            f"{arc / 2:g} m, the shorter side {min(middle, 1 - middle) * length:g} m"
        )
    flat, faces = grid(rows, columns, np.array([length, 1.0]))
    along = np.linspace(0, length, columns)
    ends = np.broadcast_to(width, 2)
    flat[:, 1] *= np.tile(np.interp(along, [0, length], ends), rows)
    # Each cell has the direction of the middle of its arc, so that its length is preserved.
    cells = (along[1:] + along[:-1]) / 2 - middle * length
    turned = np.clip(cells / radius, -np.radians(bend) / 2, np.radians(bend) / 2)
    steps = np.diff(along) * np.stack([np.cos(turned), -np.sin(turned)])
    curve = np.concatenate([np.zeros((2, 1)), steps.cumsum(axis=1)], axis=1)
    top = [np.interp(middle * length, along, coordinate) for coordinate in curve]
    x, z = curve - np.array([[top[0]], [top[1] - radius]])
    bent = np.stack([np.tile(x, rows), flat[:, 1], np.tile(z, rows)], axis=-1)
    return flat, bent, faces


def plane(size: FloatArray) -> Mesh:
    """Rectangle of two triangles at z = 0 that faces up."""
    return grid(2, 2, size)


def box(size: FloatArray, segments: Sequence[int] = (1, 1, 1)) -> Mesh:
    """Cuboid, its edges along x, y and z cut into segments; 8 vertices and 12 triangles uncut."""
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    quads = [
        (0, 1, 3, 2),  # -x
        (4, 6, 7, 5),  # +x
        (0, 4, 5, 1),  # -y
        (2, 3, 7, 6),  # +y
        (0, 2, 6, 4),  # -z
        (1, 5, 7, 3),  # +z
    ]
    if tuple(segments) != (1, 1, 1):
        return _cut_box(corners, quads, segments, size)
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return corners * size, np.array(faces)


def _cut_box(
    corners: FloatArray,
    quads: Sequence[tuple[int, int, int, int]],
    segments: Sequence[int],
    size: FloatArray,
) -> Mesh:
    counts = np.array(segments)
    nodes: dict[tuple[int, ...], int] = {}  # lattice point on the surface -> vertex
    faces = []
    lattice = np.rint((corners + 0.5) * counts).astype(np.int64)
    for a, b, _, d in quads:
        along, across = np.sign(lattice[b] - lattice[a]), np.sign(lattice[d] - lattice[a])
        for i, j in itertools.product(
            range(int(np.abs(counts @ along))), range(int(np.abs(counts @ across)))
        ):
            start = lattice[a] + i * along + j * across
            quad = [
                nodes.setdefault(tuple(point.tolist()), len(nodes))
                for point in (start, start + along, start + along + across, start + across)
            ]
            faces += [(quad[0], quad[1], quad[2]), (quad[0], quad[2], quad[3])]
    points = np.array(list(nodes)) / counts - 0.5
    return points * size, np.array(faces)


def sphere(radius: float, subdivisions: int) -> Mesh:
    """Icosahedron whose faces are split into four `subdivisions` times; vertices on the sphere."""
    golden = (1 + 5**0.5) / 2
    points = [
        vertex
        for s, g in itertools.product((-1.0, 1.0), (-golden, golden))
        for vertex in ((0.0, s, g), (s, g, 0.0), (g, 0.0, s))
    ]
    vertices = np.array(points)
    faces = _convex_faces(vertices)
    for _ in range(subdivisions):
        vertices, faces = _split_in_four(vertices, faces)
    return radius * vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces


def _convex_faces(vertices: FloatArray) -> NDArray[np.int64]:
    """Triples of vertices at the shortest distance from each other, oriented outward."""
    distance = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1)
    near = np.isclose(distance, distance[distance > 0].min())
    faces = []
    for a, b, c in itertools.combinations(range(len(vertices)), 3):
        if near[a, b] and near[b, c] and near[a, c]:
            outward = np.linalg.det(vertices[[a, b, c]]) > 0
            faces.append((a, b, c) if outward else (a, c, b))
    return np.array(faces)


def _split_in_four(vertices: FloatArray, faces: NDArray[np.int64]) -> Mesh:
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(ends, axis=0, return_inverse=True)
    middle = len(vertices) + inverse.reshape(-1, 3)
    a, b, c = faces.T
    ab, bc, ca = middle.T
    parts = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    split = np.stack([np.stack(part, axis=-1) for part in parts], axis=1).reshape(-1, 3)
    points = np.concatenate([vertices, vertices[edges].mean(axis=1)])
    return points / np.linalg.norm(points, axis=1, keepdims=True), split


def capsule(radius: float, length: float, rings: int = _CAPSULE_RINGS, rows: int = 1) -> Mesh:
    """Cylinder of a length along z between two half spheres around its ends.

    Args:
        radius: Radius [m].
        length: Length of the cylinder alone [m].
        rings: Rings on each half sphere, around its tip; four times as many segments on each.
        rows: Rows of quadrilaterals along the cylinder.
    """
    segments = 4 * rings
    polar = np.linspace(0, np.pi / 2, rings + 1)[1:]
    upper = [(radius * np.sin(t), length / 2 + radius * np.cos(t)) for t in polar]
    side = [(radius, z) for z in np.linspace(length / 2, -length / 2, rows + 1)[1:-1]]
    lower = [(r, -z) for r, z in reversed(upper)]
    around = 2 * np.pi * np.arange(segments) / segments
    circle = np.stack([np.cos(around), np.sin(around)], axis=-1)
    profile = upper + side + lower  # radius and z of each ring
    points = [np.column_stack([r * circle, np.full(segments, z)]) for r, z in profile]
    tip = length / 2 + radius
    vertices = np.concatenate([*points, [[0.0, 0.0, tip], [0.0, 0.0, -tip]]])
    return vertices, _lathe_faces(len(profile), segments)


def cylinder(radius: float, length: float, rings: int = _CYLINDER_RINGS, rows: int = 0) -> Mesh:
    """Closed cylinder along z.

    Args:
        radius: Radius [m].
        length: Length [m].
        rings: Rings on each end, around its center; six times as many segments on its rim.
        rows: Rows of quadrilaterals along its side; 0: rows no longer than the radius, at most 32.
    """
    rows = rows or int(np.ceil(min(length / radius, _CYLINDER_ROWS)))
    disk, disk_faces = _disk(rings)
    disk *= radius
    rim = 6 * rings
    top = np.column_stack([disk, np.full(len(disk), length / 2)])
    bottom = np.column_stack([disk, np.full(len(disk), -length / 2)])
    heights = np.linspace(length / 2, -length / 2, rows + 1)[1:-1]
    side = [np.column_stack([disk[-rim:], np.full(rim, z)]) for z in heights]
    # First vertices of the rings along the side, from the rim of the top to the rim of the bottom.
    n = len(disk)
    starts = [n - rim, *(2 * n + rim * np.arange(rows - 1)).tolist(), 2 * n - rim]
    here = np.arange(rim)
    there = (here + 1) % rim
    faces = [disk_faces, n + disk_faces[:, ::-1]]
    for up, down in itertools.pairwise(starts):
        faces.append(np.stack([down + here, down + there, up + there], axis=-1))
        faces.append(np.stack([down + here, up + there, up + here], axis=-1))
    return np.concatenate([top, bottom, *side]), np.concatenate(faces)


def _disk(rings: int) -> Mesh:
    """Disk of radius 1 in the xy-plane that faces up; ring k > 0 has 6 k vertices, rim last."""
    points = [np.zeros((1, 2))]
    faces = []
    for k in range(1, rings + 1):
        around = 2 * np.pi * np.arange(6 * k) / (6 * k)
        points.append(k / rings * np.stack([np.cos(around), np.sin(around)], axis=-1))
        outer, inner = 1 + 3 * k * (k - 1), 1 + 3 * (k - 1) * (k - 2) if k > 1 else 0
        for sector, i in itertools.product(range(6), range(k)):
            # Vertices i of the sector on both rings; the inner ring has one fewer in each sector.
            a = outer + sector * k + i
            b = outer + (sector * k + i + 1) % (6 * k)
            c = inner + (sector * (k - 1) + i) % max(1, 6 * (k - 1))
            faces.append((a, b, c))
            if i < k - 1:
                d = inner + (sector * (k - 1) + i + 1) % (6 * (k - 1))
                faces.append((c, b, d))
    return np.concatenate(points), np.array(faces)


def _lathe_faces(ring_count: int, segments: int) -> NDArray[np.int64]:
    here = np.arange(segments)
    there = (here + 1) % segments
    top = ring_count * segments
    faces = [np.stack([here, there, np.full_like(here, top)], axis=-1)]
    for ring in range(ring_count - 1):
        up, down = ring * segments, (ring + 1) * segments
        faces.append(np.stack([down + here, down + there, up + there], axis=-1))
        faces.append(np.stack([down + here, up + there, up + here], axis=-1))
    last = top - segments
    faces.append(np.stack([last + there, last + here, np.full_like(here, top + 1)], axis=-1))
    return np.concatenate(faces)
