"""Reading and writing of triangle meshes; the order of vertices and faces is kept.

OBJ and PLY have readers of our own: common loaders silently triangulate polygons, reorder faces and
drop unreferenced vertices, so that a pin index refers to another vertex. STL files have no
indices; corners that agree to the last bit are merged. Meshes of rigid bodies may be COLLADA or
glTF files, too.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import INTEGER, NUMBER, as_path, read_regular_file
from diffcloth_torch.geometry.ply import read_ply, write_ply
from diffcloth_torch.geometry.polygons import triangulated
from diffcloth_torch.geometry.scene_files import SCENE_READERS, read_stl

__all__ = [
    "FileMesh",
    "MeshPart",
    "read_body_mesh",
    "read_file_mesh",
    "read_mesh",
    "write_mesh",
]

# Far larger than any mesh that a step can handle; refused before it fills the memory.
_LARGEST_FILE = 1 << 30

Indices = NDArray[np.int64]
MeshPart = tuple[str, FloatArray, NDArray[np.integer]]
"""Name, vertices [n, 3] in meters and faces [f, 3] of one object of a file."""


class FileMesh(NamedTuple):
    """A mesh in the units and order of its file.

    Attributes:
        vertices: Vertices in units of the file, [n, 3].
        faces: Triangles, [f, 3].
        texture: Texture coordinates (u, v) of the corners of the faces, [f, 3, 2]; NaN for corners
            without any, None if the format has none.
    """

    vertices: FloatArray
    faces: Indices
    texture: FloatArray | None = None


Reader = Callable[[Path, bytes, bool], FileMesh]
"""A reader of a path, the content of the file, and whether to cut polygons into triangles."""


def read_mesh(path: str | Path, name: str = "read_mesh: `path`") -> tuple[FloatArray, Indices]:
    """Read vertices [n, 3] and triangles [f, 3] of an .obj, .ply or .stl file.

    Args:
        path: The file.
        name: Prefix of messages about the path; messages about the content begin with the path.

    Raises:
        InvalidInput: If the file is empty, malformed, of another format, larger than 1 GiB or not a
            regular file, or if it has numbers that are not finite or polygons other than triangles.
            The message names the line, the vertex or the face.
        TypeError: If `path` is not a path.
        OSError: If the file cannot be read.
    """
    mesh = read_file_mesh(path, name)
    return mesh.vertices, mesh.faces


def read_file_mesh(path: str | Path, name: str, *, triangulate: bool = False) -> FileMesh:
    """Read a mesh with its texture coordinates; see `read_mesh`.

    Args:
        path: The file.
        name: Prefix of messages about the path.
        triangulate: If true, cut polygons into triangles instead of refusing them.
    """
    return _read(path, name, _readers(), triangulate)


def read_body_mesh(path: str | Path, name: str, *, triangulate: bool = True) -> FileMesh:
    """Read the mesh of a rigid body.

    In addition to the files of `read_mesh`, .dae, .glb and .gltf files are read; all of their parts
    become one mesh.

    Args:
        path: The file.
        name: Prefix of messages about the path.
        triangulate: If true, cut polygons into triangles instead of refusing them.

    Raises:
        InvalidInput: As for `read_mesh`; if a polygon has no area or crosses itself; if a .dae file
            has polygons and `triangulate` is false; or if the file needs a package of the extra
            `robots` that is not installed.
        TypeError: If `path` is not a path.
        OSError: If the file cannot be read.
    """
    readers = _readers() | dict.fromkeys(SCENE_READERS, _read_scene)
    return _read(path, name, readers, triangulate)


def _readers() -> dict[str, Reader]:
    return {".obj": _read_obj, ".ply": _read_ply, ".stl": _read_stl}


def _read(
    path: str | Path, name: str, readers: Mapping[str, Reader], triangulate: bool
) -> FileMesh:
    path = as_path(name, path)
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InvalidInput(f"{name} must end in {', '.join(readers)}, got {str(path)!r}")
    mesh = reader(path, read_regular_file(path, _LARGEST_FILE), triangulate)
    if len(mesh.vertices) == 0 or len(mesh.faces) == 0:
        raise InvalidInput(
            f"{path}: the mesh is empty: {len(mesh.vertices)} vertices, {len(mesh.faces)} triangles"
        )
    infinite = np.argwhere(~np.isfinite(mesh.vertices))
    if infinite.size:
        vertex, axis = (int(i) for i in infinite[0])
        raise InvalidInput(
            f"{path}: coordinates must be finite, got {mesh.vertices[vertex, axis]} at vertex "
            f"{vertex}"
        )
    return mesh


def write_mesh(path: str | Path, parts: Sequence[MeshPart]) -> None:
    """Write named surfaces, in their order, to an .obj or .ply file; numbers are exact."""
    path = as_path("export: `path`", path)
    suffix = path.suffix.lower()
    if suffix == ".obj":
        _write_obj(path, parts)
    elif suffix == ".ply":
        write_ply(path, *_joined(parts))
    else:
        raise InvalidInput(f"export: `path` must end in .obj or .ply, got {str(path)!r}")


def _read_obj(path: Path, data: bytes, triangulate: bool) -> FileMesh:
    vertices: list[list[float]] = []
    textures: list[list[float]] = []
    polygons: list[list[int]] = []
    corners: list[int] = []  # texture coordinates of the corners of all polygons; -1: none
    for number, line in _obj_lines(data.removeprefix(b"\xef\xbb\xbf")):
        keyword, *words = line.split() or [b""]
        try:
            if b"\0" in line:
                raise ValueError("a text file must not hold the byte 0")
            if keyword == b"v":
                vertices.append(_obj_numbers(words, "a vertex", "coordinates", 3))
            elif keyword == b"vt":
                textures.append(_obj_texture(words))
            elif keyword == b"f":
                polygon, places = _obj_face(words, len(vertices), len(textures), triangulate)
                polygons.append(polygon)
                corners += places
        except ValueError as error:
            shown = line.strip()[:80].decode("utf-8", errors="replace")
            raise InvalidInput(f"{path}:{number}: {error}, in {shown!r}") from error
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    faces, at_corners = _cut(path, points, polygons)
    coordinates = np.array([*textures, [np.nan, np.nan]], dtype=np.float64)
    texture = coordinates[np.array(corners, dtype=np.int64)[at_corners]]
    return FileMesh(points, faces, texture)


def _read_ply(path: Path, data: bytes, triangulate: bool) -> FileMesh:
    vertices, polygons = read_ply(path, data, triangulate=triangulate)
    if isinstance(polygons, np.ndarray):
        return FileMesh(vertices, polygons)
    return FileMesh(vertices, _cut(path, vertices, polygons)[0])


def _cut(
    path: Path, vertices: FloatArray, polygons: Sequence[Sequence[int]]
) -> tuple[Indices, Indices]:
    """Triangles [f, 3] of polygons, and the index of their corners in all polygons, [f, 3]."""
    at_corners = triangulated(str(path), vertices, polygons)
    joined = np.array([corner for polygon in polygons for corner in polygon], dtype=np.int64)
    return joined[at_corners], at_corners


def _obj_lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Lines without their comments, each with its number; a backslash joins a line to the next."""
    parts: list[bytes] = []
    first = 1
    # splitlines() of text would also split at other characters, for example inside of a comment.
    for number, line in enumerate(re.split(rb"\r\n|\n|\r", data), start=1):
        text = line.partition(b"#")[0]
        if not parts:
            first = number
        parts.append(text.removesuffix(b"\\"))
        if not text.endswith(b"\\"):
            yield first, b" ".join(parts)
            parts = []
    if parts:
        yield first, b" ".join(parts)


def _obj_numbers(words: Sequence[bytes], what: str, numbers: str, count: int) -> list[float]:
    # A fourth number of a vertex is a weight; six or seven numbers carry a color.
    if len(words) < count:
        raise ValueError(f"{what} needs {count} {numbers}, got {len(words)}")
    for word in words[:count]:
        if not NUMBER.fullmatch(word):
            raise ValueError(f"a coordinate must be a number, got {_shown(word)}")
    return [float(word) for word in words[:count]]


def _obj_texture(words: Sequence[bytes]) -> list[float]:
    """Coordinates u and v; v is 0 by default, and NaN if a file has no numbers."""
    if not words or not all(NUMBER.fullmatch(word) for word in words[:2]):
        return [float("nan"), float("nan")]  # refused only if texture coordinates are needed
    return [float(words[0]), float(words[1]) if len(words) > 1 else 0.0]


def _obj_face(
    words: Sequence[bytes], vertex_count: int, texture_count: int, triangulate: bool
) -> tuple[list[int], list[int]]:
    """Corners of `f a b c`, each `v`, `v/vt`, `v//vn` or `v/vt/vn`; negative: from the end.

    Returns:
        Indices of the vertices, and of the texture coordinates, -1 if there are none.
    """
    if len(words) < 3 or (len(words) > 3 and not triangulate):
        raise ValueError(
            f"a face must be a triangle, got {len(words)} corners; "
            "triangulate the mesh before loading it, or pass triangulate=True"
        )
    corners, texture = [], []
    for word in words:
        text, _, rest = word.partition(b"/")
        if not INTEGER.fullmatch(text):
            raise ValueError(f"a face index must be an integer, got {_shown(text)}")
        index = int(text)
        corner = index - 1 if index > 0 else vertex_count + index
        if index == 0 or not 0 <= corner < vertex_count:
            raise ValueError(
                f"a face index must be in 1 .. {vertex_count} (the vertices read so far) "
                f"or negative, got {text[:40].decode()}"
            )
        corners.append(corner)
        texture.append(_obj_texture_index(rest.partition(b"/")[0], texture_count))
    return corners, texture


def _obj_texture_index(text: bytes, count: int) -> int:
    """Index of texture coordinates; -1 if a corner has none that were read so far."""
    if not INTEGER.fullmatch(text):
        return -1
    index = int(text)
    place = index - 1 if index > 0 else count + index
    return place if index != 0 and 0 <= place < count else -1


def _shown(word: bytes) -> str:
    return repr(word[:40].decode("utf-8", errors="replace"))


def _read_stl(path: Path, data: bytes, triangulate: bool) -> FileMesh:
    return FileMesh(*read_stl(path, data))


def _read_scene(path: Path, data: bytes, triangulate: bool) -> FileMesh:
    suffix = path.suffix.lower()
    if suffix == ".dae" and not triangulate:
        raise InvalidInput(
            f"{path}: polygons of .dae files are always cut into triangles: pass triangulate=True"
        )
    return FileMesh(*SCENE_READERS[suffix](path, data))


def _write_obj(path: Path, parts: Sequence[MeshPart]) -> None:
    lines = []
    start = 1
    for name, vertices, faces in parts:
        lines.append(f"o {name}")
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + start).tolist()]
        start += len(vertices)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _joined(parts: Sequence[MeshPart]) -> tuple[FloatArray, NDArray[np.int32]]:
    starts = np.cumsum([0] + [len(vertices) for _, vertices, _ in parts])
    vertices = np.concatenate([vertices for _, vertices, _ in parts])
    faces = np.concatenate(
        [faces + start for (_, _, faces), start in zip(parts, starts, strict=False)]
    )
    return vertices, faces.astype(np.int32)
