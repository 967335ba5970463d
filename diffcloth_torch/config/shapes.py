"""Meshes that the tasks generate: a round sheet and a chair."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.extras import from_extra

__all__ = ["chair", "disk"]

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]

# Edges across a disk: fewer do not form a round sheet, more are too many to simulate.
_FEWEST_EDGES = 2
_MOST_EDGES = 100

# Cells between the planes of boxes, filled or not.
_MOST_CELLS = 1_000_000

# Rounds of smoothing, in which each point moves to the mean of its neighbors. After ten the
# smallest angle no longer grows; the mesh stays irregular.
_SMOOTHING_ROUNDS = 10

# Largest random displacement of points from a regular lattice, in edge lengths, and the seed.
_JITTER = 0.25
_SEED = 0


def disk(
    radius: float, edge_length: float, folds: int = 0, fold_height: float = 0.01
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Round sheet in the xy-plane that faces up, on an unstructured mesh.

    A Delaunay triangulation joins the points of a disturbed lattice inside a ring of evenly spaced
    points, and is smoothed. Equal arguments yield equal meshes.

    Folds are waves along the rim, upwards from the plane. They grow with the fourth power of the
    distance from the middle, which stays flat.

    Args:
        radius: Radius of the ring [m].
        edge_length: Approximate length of the edges [m].
        folds: Number of folds.
        fold_height: Height of their crests on the ring [m].

    Returns:
        Flat vertices [n, 3], the ring first, folded vertices [n, 3], and faces [f, 3].
    """
    if not _FEWEST_EDGES <= radius / edge_length <= _MOST_EDGES:
        raise ValueError(
            f"disk: `edge_length` must be between {radius / _MOST_EDGES:g} and "
            f"{radius / _FEWEST_EDGES:g} for the radius {radius:g}, got {edge_length:g}"
        )
    count = round(2 * np.pi * radius / edge_length)
    angles = 2 * np.pi * np.arange(count) / count
    ring = radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    points = np.concatenate([ring, _disturbed_lattice(radius - 0.7 * edge_length, edge_length)])
    for _ in range(_SMOOTHING_ROUNDS):
        points[count:] = _neighbor_means(points, _triangulate(points))[count:]
    flat = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    folded = flat.copy()
    if folds:
        waves = 1 + np.cos(folds * np.arctan2(points[:, 1], points[:, 0]))
        folded[:, 2] = fold_height / 2 * (np.hypot(*points.T) / radius) ** 4 * waves
    return flat, folded, _triangulate(points)


def _disturbed_lattice(radius: float, edge_length: float) -> NDArray[np.float64]:
    """Points of a triangular lattice, each moved at random, within a radius of the origin."""
    reach = int(np.ceil(2 * radius / edge_length)) + 1
    i, j = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    lattice = np.stack([i + j / 2, j * np.sqrt(3) / 2], axis=-1).reshape(-1, 2)
    generator = np.random.default_rng(_SEED)
    lattice += _JITTER * generator.uniform(-1, 1, lattice.shape)
    points: NDArray[np.float64] = edge_length * lattice
    inside: NDArray[np.float64] = points[np.linalg.norm(points, axis=1) < radius]
    return inside


def _triangulate(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Delaunay triangulation, counterclockwise."""
    tri = from_extra("matplotlib.tri", "viewer", "disk: its triangulation needs Matplotlib")
    faces = np.array(tri.Triangulation(points[:, 0], points[:, 1]).triangles, dtype=np.int64)
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    faces[area < 0] = faces[area < 0][:, ::-1]
    return faces


def _neighbor_means(points: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges = np.unique(ends, axis=0)
    sums = np.zeros_like(points)
    counts = np.zeros((len(points), 1))
    for a, b in ((0, 1), (1, 0)):
        np.add.at(sums, edges[:, a], points[edges[:, b]])
        np.add.at(counts, edges[:, a], 1)
    means: NDArray[np.float64] = sums / counts
    return means


def chair(
    width: float,
    depth: float,
    height: float,
    back_height: float,
    thickness: float,
    edge_length: float,
) -> Mesh:
    """Chair: one closed surface around a seat, a back and four legs.

    It stands on z = 0, centered in x and y, with its back at +y.

    Args:
        width: Width along x [m].
        depth: Depth along y [m].
        height: Height of the top of the seat [m].
        back_height: Height of the back above the seat [m].
        thickness: Thickness of the seat, the back and the legs [m].
        edge_length: Longest side of the rectangles that are split into two triangles [m].

    Returns:
        Vertices [n, 3] and outward-facing faces [f, 3].
    """
    if 3 * thickness > min(width, depth, height, back_height):
        raise ValueError(
            "chair: `thickness` must be at most a third of the width, depth, height and back "
            f"height, got {thickness:g}"
        )
    x, y, t = width / 2, depth / 2, thickness
    seat = ((-x, x), (-y, y), (height - t, height))
    back = ((-x, x), (y - t, y), (height, height + back_height))
    corners = itertools.product(((-x, -x + t), (x - t, x)), ((-y, -y + t), (y - t, y)))
    legs = [(across, along, (0.0, height - t)) for across, along in corners]
    return union_of_boxes([seat, back, *legs], edge_length)


Interval = tuple[float, float]


def union_of_boxes(boxes: list[tuple[Interval, Interval, Interval]], edge_length: float) -> Mesh:
    """Surface of a union of boxes: of all cells inside boxes, between the planes of their sides.

    No face lies inside or occurs twice, so boxes may touch and overlap.

    Args:
        boxes: Intervals along x, y and z of each box [m].
        edge_length: Longest side of a cell [m].

    Raises:
        ValueError: If there would be more than a million cells.
    """
    spans = [np.diff(sorted({end for box in boxes for end in box[k]})) for k in range(3)]
    with np.errstate(over="ignore"):
        cells = np.prod([np.ceil(span / edge_length).sum() for span in spans])
    if not cells <= _MOST_CELLS:
        raise ValueError(
            f"`edge_length` must cut the boxes into at most {_MOST_CELLS} cells, got "
            f"{edge_length:g} m, which makes {cells:.3g}"
        )
    planes = [_subdivided({end for box in boxes for end in box[k]}, edge_length) for k in range(3)]
    centers = np.meshgrid(*[(p[1:] + p[:-1]) / 2 for p in planes], indexing="ij")
    filled = np.zeros(centers[0].shape, dtype=bool)
    for box in boxes:
        inside = [(c > low) & (c < high) for c, (low, high) in zip(centers, box, strict=True)]
        filled |= np.logical_and.reduce(inside)
    padded = np.pad(filled, 1)
    quads = [
        _side_corners(cell, axis, side)
        for cell in np.argwhere(filled)
        for axis, side in itertools.product(range(3), (0, 1))
        if not padded[tuple(cell + 1 + (2 * side - 1) * np.eye(3, dtype=int)[axis])]
    ]
    corners, index = np.unique(np.array(quads).reshape(-1, 3), axis=0, return_inverse=True)
    vertices = np.stack([planes[k][corners[:, k]] for k in range(3)], axis=-1)
    quad = index.reshape(-1, 4)
    return vertices, np.stack([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]], axis=1).reshape(-1, 3)


def _subdivided(ends: set[float], longest: float) -> NDArray[np.float64]:
    """Sorted coordinates, with additional ones where the distance exceeds `longest`."""
    coordinates = sorted(ends)
    parts = [
        np.linspace(a, b, int(np.ceil((b - a) / longest)) + 1)[:-1]
        for a, b in itertools.pairwise(coordinates)
    ]
    return np.concatenate([*parts, [coordinates[-1]]])


def _side_corners(cell: NDArray[np.int64], axis: int, side: int) -> list[NDArray[np.int64]]:
    """Corners of one side of a cell, counterclockwise seen from outside."""
    unit = np.eye(3, dtype=np.int64)
    u, v = unit[(axis + 1) % 3], unit[(axis + 2) % 3]
    base = cell + side * unit[axis]
    loop = [base, base + u, base + u + v, base + v]
    return loop if side == 1 else loop[::-1]
