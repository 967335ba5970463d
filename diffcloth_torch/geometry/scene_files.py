"""Mesh files read by trimesh: STL, COLLADA and glTF. Vertices at equal positions are merged.

STL files have no indices, and the others have a vertex for each normal and color of a corner.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError, tostring

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.extras import from_extra

__all__ = ["SCENE_READERS", "read_stl"]

Mesh = tuple[FloatArray, NDArray[np.int64]]


def read_stl(path: Path, data: bytes) -> Mesh:
    """Read vertices [n, 3] and triangles [f, 3] of an STL file, binary or of text."""
    from trimesh.exchange.stl import load_stl

    if not data:
        raise InvalidInput(f"{path}: the file is empty")
    try:
        soup = load_stl(io.BytesIO(data))
        if "vertices" not in soup:
            raise ValueError("it has neither the header of a binary file nor a solid of text")
        corners = np.asarray(soup["vertices"], dtype=np.float64)[np.asarray(soup["faces"])]
        points = corners.reshape(-1, 3)
    except MemoryError:
        raise
    except Exception as error:
        raise InvalidInput(f"{path}: not a readable STL file: {error}") from error
    return _merged(points)


def _read_collada(path: Path, data: bytes) -> Mesh:
    """Read all triangles and polygons of a COLLADA file, in meters.

    The unit of the file is applied, its up axis is ignored, as in RViz and Pinocchio.
    """
    from_extra("collada", "robots", f"{path}: COLLADA files need pycollada", _INSTEAD)
    return _read_scene(path, _meshes_alone(path, data), "COLLADA", ignore_broken=False)


# Elements whose errors, such as a missing texture or camera, do not affect the meshes.
_BESIDE_MESHES = (
    *("library_effects", "library_images", "library_materials", "bind_material"),
    *("library_cameras", "instance_camera", "library_lights", "instance_light"),
    *("library_animations", "library_animation_clips"),
)


def _meshes_alone(path: Path, data: bytes) -> bytes:
    import defusedxml.ElementTree

    try:
        document = defusedxml.ElementTree.fromstring(data, forbid_dtd=True)
    except defusedxml.DefusedXmlException as error:
        raise InvalidInput(
            f"{path}: a COLLADA file must have no DOCTYPE and no entities of its own: {error}"
        ) from error
    except (ParseError, ValueError, LookupError) as error:  # a LookupError: encodings
        raise InvalidInput(f"{path}: not well-formed XML: {error}") from error
    for element in list(document.iter()):
        for child in list(element):
            if child.tag.rpartition("}")[2] in _BESIDE_MESHES:
                element.remove(child)
    return tostring(document)


def _read_gltf(path: Path, data: bytes) -> Mesh:
    """Read all triangles of a glTF file in its own axes, for any up axis."""
    return _read_scene(path, data, "glTF", skip_materials=True)


SCENE_READERS: dict[str, Callable[[Path, bytes], Mesh]] = {
    ".dae": _read_collada,
    ".glb": _read_gltf,
    ".gltf": _read_gltf,
}
"""Readers of files that hold a scene, by suffix."""

_INSTEAD = ", or save the mesh as .obj or .stl"


def _read_scene(path: Path, data: bytes, kind: str, **options: Any) -> Mesh:
    """Triangles of all nodes of a scene, placed and scaled."""
    from trimesh import Trimesh, load_scene

    corners = [np.empty((0, 3))]
    suffix = path.suffix.lower().removeprefix(".")
    try:
        scene = load_scene(io.BytesIO(data), file_type=suffix, process=False, **options)
        for node in scene.graph.nodes_geometry:
            frame, name = scene.graph[node]
            mesh = scene.geometry[name]
            if not isinstance(mesh, Trimesh):
                continue  # points and lines
            scale = _meters(mesh.metadata.get("units", "meters"))
            points = np.asarray(mesh.vertices, dtype=np.float64) @ frame[:3, :3].T + frame[:3, 3]
            faces = np.asarray(mesh.faces)
            if np.linalg.det(frame[:3, :3]) < 0:
                faces = faces[:, ::-1]
            corners.append(scale * points[faces].reshape(-1, 3))
    except MemoryError:
        raise
    except Exception as error:
        raise InvalidInput(f"{path}: not a readable {kind} file: {error!r}") from error
    return _merged(np.concatenate(corners))


def _meters(unit: str) -> float:
    """Meters in a unit of trimesh, such as "0.0254 * meters"."""
    number, times, _ = unit.partition(" * ")
    return float(number) if times else 1.0


def _merged(corners: FloatArray) -> Mesh:
    """Vertices and faces from the corners [3 f, 3] of triangles, in the order of appearance."""
    _, first, inverse = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    # np.unique sorts; restore the order of first appearance in the file.
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return corners[first[order]], rank[inverse.reshape(-1)].reshape(-1, 3)
