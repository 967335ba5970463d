"""Meshes of files in meters: polygons cut, vertices merged, and warnings about their size."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from diffcloth_torch.checks import (
    NON_NEGATIVE,
    POSITIVE,
    FloatArray,
    IndexArray,
    check_bool,
    check_number,
    frozen,
)
from diffcloth_torch.errors import warn_caller
from diffcloth_torch.geometry.meshes import FileMesh, Indices, read_file_mesh
from diffcloth_torch.geometry.polygons import welded

__all__ = ["LoadedMesh", "load_mesh"]

# Usual sizes of cloths and bodies [m]: other sizes are most often in another unit.
_LONGEST, _SHORTEST = 10.0, 1e-3


class _Read(Protocol):
    def __call__(self, path: str | Path, name: str, *, triangulate: bool) -> FileMesh: ...


class LoadedMesh(NamedTuple):
    """A mesh in meters.

    Attributes:
        vertices: Vertices [m], [n, 3].
        faces: Triangles, [f, 3].
        texture: Texture coordinates of the corners of the faces, [f, 3, 2], NaN for corners without
            any; None if the format has none.
        file_vertices: Index of the merged vertex for each vertex of the file, [m].
    """

    vertices: FloatArray
    faces: Indices
    texture: FloatArray | None
    file_vertices: IndexArray


def load_mesh(
    owner: str,
    path: str | Path,
    *,
    scale: object,
    triangulate: object,
    weld: object,
    instead: str,
    read: _Read = read_file_mesh,
) -> LoadedMesh:
    """Read a mesh; warn if it is longer than 10 m or shorter than 1 mm.

    Args:
        owner: Prefix of messages.
        path: Mesh file.
        scale: Meters per unit of the file, > 0.
        triangulate: If true, cut polygons into triangles.
        weld: Distance [m] up to which vertices are merged; None merges none.
        instead: Remedy in the message about a scale that requires a gradient.
        read: Reader of the file: `read_file_mesh` or `read_body_mesh`.
    """
    factor = check_number(f"{owner}: `scale`", scale, POSITIVE, instead=instead)
    cuts = check_bool(f"{owner}: `triangulate`", triangulate)
    mesh = read(path, f"{owner}: `path`", triangulate=cuts)
    vertices, faces = factor * mesh.vertices, mesh.faces
    kept = np.arange(len(vertices))
    if weld is not None:
        vertices, kept = welded(vertices, check_number(f"{owner}: `weld`", weld, NON_NEGATIVE))
        faces = kept[faces]
    size = float(np.ptp(vertices, axis=0).max())
    if not _SHORTEST <= size <= _LONGEST:
        warn_caller(
            f"{owner}: {path} is {size:.3g} m long with scale={factor:g}, which is meters per unit "
            "of the file; for a file in millimeters pass scale=0.001"
        )
    return LoadedMesh(vertices, faces, mesh.texture, frozen(kept.astype(np.int32)))
