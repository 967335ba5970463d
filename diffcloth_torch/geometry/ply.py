"""PLY files: a reader that keeps every vertex in its place and refuses polygons, and a writer."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput

__all__ = ["read_ply", "write_ply"]

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")


class _Property(NamedTuple):
    name: str
    type: str
    count_type: str | None  # of a list; None for a single number


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


def read_ply(path: Path) -> tuple[FloatArray, NDArray[np.int64]]:
    """Read vertices [n, 3] and triangles [f, 3] of an ASCII or binary PLY file."""
    data = path.read_bytes()
    order, elements, body = _read_header(path, data)
    vertices = np.empty((0, 3))
    faces = np.empty((0, 3), dtype=np.int64)
    cursor = _Ascii(path, body) if order == "=" else _Binary(path, body, order)
    for element in elements:
        columns = cursor.read(element)
        if element.name == "vertex":
            missing = [axis for axis in "xyz" if axis not in columns]
            if missing:
                raise InvalidInput(f"{path}: the vertices have no property {missing[0]!r}")
            vertices = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=-1)
        elif element.name == "face":
            corners = next((columns[name] for name in _CORNERS if name in columns), None)
            if corners is None:
                raise InvalidInput(f"{path}: the faces have no list 'vertex_indices'")
            faces = corners.astype(np.int64).reshape(-1, 3)
        if vertices.size and faces.size:
            break  # what follows (edges, materials) is of no interest and may hold any list
    outside = np.argwhere((faces < 0) | (faces >= len(vertices)))
    if outside.size:
        face, corner = (int(i) for i in outside[0])
        raise InvalidInput(
            f"{path}: face {face} has vertex {faces[face, corner]}, "
            f"but the vertices are 0 .. {len(vertices) - 1}"
        )
    return vertices, faces


def write_ply(path: Path, vertices: FloatArray, faces: NDArray[np.int32]) -> None:
    """Write a binary PLY file with coordinates in double precision."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"] = 3
    rows["corners"] = faces
    path.write_bytes(header.encode("ascii") + vertices.astype("<f8").tobytes() + rows.tobytes())


def _read_header(path: Path, data: bytes) -> tuple[str, list[_Element], bytes]:
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise InvalidInput(f"{path}: not a PLY file: it has no header from 'ply' to 'end_header'")
    body = data[data.index(b"\n", end) + 1 :] if b"\n" in data[end:] else b""
    order = ""
    elements: list[_Element] = []
    for number, line in enumerate(data[:end].decode("ascii", errors="replace").splitlines(), 1):
        try:
            match line.split():
                case ["format", kind, _]:
                    order = _ORDERS[kind]
                case ["element", name, count]:
                    elements.append(_Element(name, int(count), []))
                case ["property", "list", count_type, kind, name]:
                    column = _Property(name, _TYPES[kind], _TYPES[count_type])
                    elements[-1].properties.append(column)
                case ["property", kind, name]:
                    elements[-1].properties.append(_Property(name, _TYPES[kind], None))
        except (KeyError, ValueError, IndexError) as error:
            raise InvalidInput(f"{path}:{number}: malformed header line {line!r}") from error
    # Every element takes at least a byte: a count beyond that is refused before it is allocated.
    for element in elements:
        if not 0 <= element.rows <= len(body):
            raise InvalidInput(
                f"{path}: the header says {element.rows} x {element.name!r}, "
                f"but only {len(body)} bytes follow it"
            )
    if not order:
        raise InvalidInput(f"{path}: the header has no format line; one of {', '.join(_ORDERS)}")
    return order, elements, body


def _check_triangle(path: Path, element: _Element, column: _Property, row: int, count: int) -> None:
    if element.name == "face" and column.name in _CORNERS and count != 3:
        raise InvalidInput(
            f"{path}: face {row} must be a triangle, got {count} corners; "
            "triangulate the mesh before loading it"
        )


class _Ascii:
    """The words of an ASCII body, element by element."""

    def __init__(self, path: Path, body: bytes) -> None:
        self._path = path
        self._words = body.split()
        self._at = 0

    def read(self, element: _Element) -> dict[str, NDArray[np.float64]]:
        columns: dict[str, list[list[float]]] = {p.name: [] for p in element.properties}
        for row in range(element.rows):
            for column in element.properties:
                count = 1
                if column.count_type is not None:
                    count = int(self._take(element, row, 1)[0])
                    _check_triangle(self._path, element, column, row, count)
                columns[column.name].append(self._take(element, row, count))
        return {
            p.name: np.array(columns[p.name]).reshape(element.rows, -1).squeeze(-1)
            if p.count_type is None
            else np.array(columns[p.name] if p.name in _CORNERS else [])
            for p in element.properties
        }

    def _take(self, element: _Element, row: int, count: int) -> list[float]:
        words = self._words[self._at : self._at + count]
        self._at += count
        try:
            numbers = [float(word) for word in words]
        except ValueError as error:
            raise InvalidInput(
                f"{self._path}: {element.name} {row} must hold numbers: {error}"
            ) from error
        if len(numbers) < count:
            raise InvalidInput(f"{self._path}: the file ends within {element.name} {row}")
        return numbers


class _Binary:
    """The bytes of a binary body, element by element."""

    def __init__(self, path: Path, body: bytes, order: str) -> None:
        self._path = path
        self._body = body
        self._order = order
        self._at = 0

    def read(self, element: _Element) -> dict[str, NDArray[np.generic]]:
        """Read rows of equal size, which they are when each list is as long as in the first row."""
        fields: list[tuple[str, str] | tuple[str, str, int]] = []
        lists = [p for p in element.properties if p.count_type is not None]
        offset = self._at
        for column in element.properties:
            kind = np.dtype(self._order + column.type)
            if column.count_type is None:
                fields.append((column.name, kind.str))
                offset += kind.itemsize
                continue
            count_kind = np.dtype(self._order + column.count_type)
            first = self._body[offset : offset + count_kind.itemsize]
            count = int(np.frombuffer(first, count_kind)[0]) if element.rows and first else 0
            if element.rows:
                _check_triangle(self._path, element, column, 0, count)
            fields += [("#" + column.name, count_kind.str), (column.name, kind.str, count)]
            offset += count_kind.itemsize + count * kind.itemsize
        rows = np.dtype(fields)
        if rows.itemsize * element.rows > len(self._body) - self._at:
            raise InvalidInput(f"{self._path}: the file ends within the {element.name} rows")
        table = np.frombuffer(self._body, rows, element.rows, self._at)
        for column in lists:
            counts = table["#" + column.name]
            other = np.flatnonzero(counts != counts[:1]) if len(counts) else counts
            if other.size:
                row = int(other[0])
                _check_triangle(self._path, element, column, row, int(counts[row]))
                raise InvalidInput(
                    f"{self._path}: lists {column.name!r} of different lengths cannot be read"
                )
        self._at += rows.itemsize * element.rows
        return {p.name: table[p.name] for p in element.properties}
