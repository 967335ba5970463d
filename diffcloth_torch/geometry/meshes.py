"""Reading and writing of triangle meshes; the order of vertices and faces is kept.

OBJ and PLY have readers of our own: common loaders silently triangulate polygons, reorder faces and
drop unreferenced vertices, so that a pin index refers to another vertex. STL files have no
indices; corners that agree to the last bit are merged.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import INTEGER, NUMBER, as_path, read_regular_file
from diffcloth_torch.geometry.ply import read_ply, write_ply

__all__ = ["MeshPart", "read_mesh", "write_mesh"]

# Far beyond what a step can take; a larger file is a mistake, refused before it fills the memory.
_LARGEST_FILE = 1 << 30

Indices = NDArray[np.int64]
MeshPart = tuple[str, FloatArray, NDArray[np.integer]]
"""Name, vertices [n, 3] in meters and faces [f, 3] of one object of a file."""


def read_mesh(path: str | Path, name: str = "read_mesh: `path`") -> tuple[FloatArray, Indices]:
    """Read vertices [n, 3] and triangles [f, 3] of an .obj, .ply or .stl file.

    Args:
        path: The file.
        name: Opens messages about the path; those about the content of the file open with it.

    Raises:
        InvalidInput: If the file is empty, malformed, of another format, larger than 1 GiB or not a
            regular file, or if it has numbers that are not finite or polygons other than triangles.
            The message names the line, the vertex or the face.
        TypeError: If `path` is not a path.
        OSError: If the file cannot be read.
    """
    path = as_path(name, path)
    readers = {".obj": _read_obj, ".ply": read_ply, ".stl": _read_stl}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InvalidInput(f"{name} must end in {', '.join(readers)}, got {str(path)!r}")
    vertices, faces = reader(path, read_regular_file(path, _LARGEST_FILE))
    if len(vertices) == 0 or len(faces) == 0:
        raise InvalidInput(
            f"{path}: the mesh is empty: {len(vertices)} vertices, {len(faces)} triangles"
        )
    infinite = np.argwhere(~np.isfinite(vertices))
    if infinite.size:
        vertex, axis = (int(i) for i in infinite[0])
        raise InvalidInput(
            f"{path}: coordinates must be finite, got {vertices[vertex, axis]} at vertex {vertex}"
        )
    return vertices, faces


def write_mesh(path: str | Path, parts: Sequence[MeshPart]) -> None:
    """Write named surfaces, in their order, to an .obj or .ply file; numbers survive exactly."""
    path = as_path("export: `path`", path)
    suffix = path.suffix.lower()
    if suffix == ".obj":
        _write_obj(path, parts)
    elif suffix == ".ply":
        write_ply(path, *_joined(parts))
    else:
        raise InvalidInput(f"export: `path` must end in .obj or .ply, got {str(path)!r}")


def _read_obj(path: Path, data: bytes) -> tuple[FloatArray, Indices]:
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for number, line in _obj_lines(data.removeprefix(b"\xef\xbb\xbf")):
        keyword, *words = line.split() or [b""]
        try:
            if b"\0" in line:
                raise ValueError("a text file must not hold the byte 0")
            if keyword == b"v":
                vertices.append(_obj_vertex(words))
            elif keyword == b"f":
                faces.append(_obj_triangle(words, len(vertices)))
        except ValueError as error:
            shown = line.strip()[:80].decode("utf-8", errors="replace")
            raise InvalidInput(f"{path}:{number}: {error}, in {shown!r}") from error
    return (
        np.array(vertices, dtype=np.float64).reshape(-1, 3),
        np.array(faces, dtype=np.int64).reshape(-1, 3),
    )


def _obj_lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Lines without their comments, each with its number; a backslash joins it with the next."""
    parts: list[bytes] = []
    first = 1
    # Not splitlines() of text: it ends lines at other characters too, as in the midst of a comment.
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


def _obj_vertex(words: Sequence[bytes]) -> list[float]:
    # A fourth number is a weight; six or seven numbers carry a color.
    if len(words) < 3:
        raise ValueError(f"a vertex needs 3 coordinates, got {len(words)}")
    for word in words[:3]:
        if not NUMBER.fullmatch(word):
            raise ValueError(f"a coordinate must be a number, got {_shown(word)}")
    return [float(word) for word in words[:3]]


def _obj_triangle(words: Sequence[bytes], vertex_count: int) -> list[int]:
    """Corners of `f a b c`, each `v`, `v/vt`, `v//vn` or `v/vt/vn`; negative: from the end."""
    if len(words) != 3:
        raise ValueError(
            f"a face must be a triangle, got {len(words)} corners; "
            "triangulate the mesh before loading it"
        )
    corners = []
    for word in words:
        text = word.partition(b"/")[0]
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
    return corners


def _shown(word: bytes) -> str:
    return repr(word[:40].decode("utf-8", errors="replace"))


def _read_stl(path: Path, data: bytes) -> tuple[FloatArray, Indices]:
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
    _, first, inverse = np.unique(points, axis=0, return_index=True, return_inverse=True)
    # np.unique sorts; restore the order of first appearance in the file.
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return points[first[order]], rank[inverse.reshape(-1)].reshape(-1, 3)


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
