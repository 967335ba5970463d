#!/usr/bin/env python3
"""Write configs/meshes: a bell of cloth (OBJ, meters) and a skittle (PLY, centimeters, y up).

The meshes represent meshes of your own in configs/drape_own.yaml. Both are surfaces of revolution
whose rings have as many vertices as fit, so that triangles have similar sizes.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FOLDER = Path(__file__).resolve().parent.parent / "configs" / "meshes"

Points = NDArray[np.float64]
Faces = list[tuple[int, int, int]]

# Radius and height of points of the profiles, from the top to the bottom.
BELL = [(0.0, 0.30), (0.03, 0.293), (0.052, 0.275), (0.065, 0.25), (0.085, 0.14), (0.125, 0.0)]
BELL_EDGE = 0.016  # [m]
SKITTLE = [
    *((0.0, 38.0), (1.6, 37.5), (2.8, 36.3), (3.2, 34.5), (2.9, 32.5), (2.3, 30.0), (2.2, 27.5)),
    *((2.8, 24.0), (4.4, 19.0), (5.8, 13.5), (6.0, 10.0), (5.2, 5.0), (3.6, 0.0), (0.0, 0.0)),
]
SKITTLE_EDGE = 1.3  # [cm]
FEWEST = 6  # vertices of a ring


def resampled(profile: Sequence[tuple[float, float]], edge: float) -> Points:
    """Points along a profile, including its corners, at most an edge apart."""
    corners = np.array(profile)
    points = [corners[:1]]
    for a, b in pairwise(corners):
        count = int(np.ceil(np.linalg.norm(b - a) / edge))
        points.append(a + (b - a) * np.arange(1, count + 1)[:, None] / count)
    return np.concatenate(points)


def revolve(profile: Sequence[tuple[float, float]], edge: float) -> tuple[Points, Faces]:
    """Surface of revolution of a profile about z; faces point outward for a descending profile."""
    vertices, faces = [], []
    upper: list[int] = []
    for k, (radius, height) in enumerate(resampled(profile, edge)):
        count = 1 if radius == 0 else max(FEWEST, round(2 * np.pi * radius / edge))
        # Every other ring is rotated by half an edge.
        angles = 2 * np.pi * (np.arange(count) + k % 2 / 2) / count
        lower = list(range(len(vertices), len(vertices) + count))
        vertices += [(radius * np.cos(t), radius * np.sin(t), height) for t in angles]
        if upper:
            faces += zipped(upper, lower)
        upper = lower
    return np.array(vertices), faces


def zipped(upper: Sequence[int], lower: Sequence[int]) -> Faces:
    """Triangles between two rings; the nearer of the two next vertices completes a triangle."""
    faces = []
    m, n = len(upper), len(lower)
    i = j = 0
    while i < m or j < n:
        take_upper = j == n or (i < m and (i + 1) / m <= (j + 1) / n)
        if take_upper and m > 1:
            faces.append((upper[i % m], lower[j % n], upper[(i + 1) % m]))
        elif not take_upper and n > 1:
            faces.append((upper[i % m], lower[j % n], lower[(j + 1) % n]))
        i, j = (i + 1, j) if take_upper else (i, j + 1)
    return faces


def obj(vertices: Points, faces: Faces) -> str:
    """Text of an OBJ file."""
    lines = ["# Made by scripts/make_meshes.py."]
    lines += ["v " + " ".join(f"{x:.6f}" for x in v) for v in vertices]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    return "\n".join(lines) + "\n"


def ply(vertices: Points, faces: Faces) -> str:
    """Text of a PLY file."""
    header = [
        *("ply", "format ascii 1.0", "comment Made by scripts/make_meshes.py."),
        *(f"element vertex {len(vertices)}", *(f"property double {axis}" for axis in "xyz")),
        *(f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"),
    ]
    rows = [" ".join(f"{x:.4f}" for x in v) for v in vertices]
    rows += [f"3 {a} {b} {c}" for a, b, c in faces]
    return "\n".join([*header, *rows]) + "\n"


def texts() -> dict[str, str]:
    """Map from the name of a file to its content."""
    skittle, faces = revolve(SKITTLE, SKITTLE_EDGE)
    x, y, z = skittle.T
    return {
        "bell.obj": obj(*revolve(BELL, BELL_EDGE)),
        "skittle.ply": ply(np.stack([x, z, -y], axis=-1), faces),
    }


def main() -> None:
    """Write the files."""
    FOLDER.mkdir(exist_ok=True)
    for name, text in texts().items():
        (FOLDER / name).write_text(text, encoding="ascii")


if __name__ == "__main__":
    main()
