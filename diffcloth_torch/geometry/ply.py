"""PLY files: a reader that keeps the order of vertices, and a writer.

Existing readers with a compatible license triangulate polygons, round indices that are not
integers, or hang on a header without an end.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import INTEGER, NUMBER

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

Columns = dict[str, NDArray[Any]]
"""Values of an element's properties by name: [rows], or [rows, n] of a list."""


class _Property(NamedTuple):
    name: str
    type: str
    count_type: str | None  # type of the count of a list; None for a single number


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


def read_ply(
    path: Path, data: bytes, *, triangulate: bool = False
) -> tuple[FloatArray, NDArray[np.int64] | list[list[int]]]:
    """Read vertices [n, 3] and triangles [f, 3] of an ASCII or binary PLY file.

    Args:
        path: File, for messages.
        data: Content of the file.
        triangulate: If true, return faces as lists of three or more corners.

    Raises:
        InvalidInput: If the file is malformed, or has polygons other than triangles or an index of
            no vertex.
    """
    order, elements, body = _read_header(path, data)
    vertices = np.empty((0, 3))
    faces: NDArray[np.int64] | list[list[int]] = np.empty((0, 3), dtype=np.int64)
    cursor: _Ascii | _Binary
    if order == "=":
        cursor = _Ascii(path, body, triangulate)
    else:
        cursor = _Binary(path, body, order, triangulate)
    for element in elements:
        columns = cursor.read(element)
        if element.name == "vertex":
            vertices = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=-1)
        elif element.name == "face":
            corners = next(columns[name] for name in _CORNERS if name in columns)
            if triangulate:
                faces = [[int(corner) for corner in polygon] for polygon in corners]
            else:
                faces = corners.astype(np.int64).reshape(-1, 3)
        if vertices.size and len(faces):
            break  # later elements (edges, materials) are not needed and may hold any list
    _check_corners(path, faces, len(vertices))
    return vertices, faces


def _check_corners(
    path: Path, faces: NDArray[np.int64] | list[list[int]], vertex_count: int
) -> None:
    if isinstance(faces, np.ndarray):
        lengths, corners = [3] * len(faces), faces.reshape(-1)
    else:
        lengths = [len(polygon) for polygon in faces]
        corners = np.array([corner for polygon in faces for corner in polygon], dtype=np.int64)
    outside = np.flatnonzero((corners < 0) | (corners >= vertex_count))
    if outside.size:
        face = int(np.searchsorted(np.cumsum(lengths), outside[0], side="right"))
        raise InvalidInput(
            f"{path}: face {face} has vertex {corners[outside[0]]}, "
            f"but the vertices are 0 .. {vertex_count - 1}"
        )


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


# --- The header -----------------------------------------------------------------------------------


def _header_lines(path: Path, data: bytes) -> Iterator[tuple[str, int]]:
    """Lines of the header, each with the offset of the next line."""
    start = 0
    while (end := data.find(b"\n", start)) >= 0:
        yield data[start:end].decode("ascii", errors="replace").rstrip("\r"), end + 1
        start = end + 1
    raise InvalidInput(f"{path}: not a PLY file: it has no header from 'ply' to 'end_header'")


def _read_header(path: Path, data: bytes) -> tuple[str, list[_Element], bytes]:
    if not data.startswith((b"ply\n", b"ply\r\n")):
        raise InvalidInput(f"{path}: not a PLY file: its first line is not 'ply'")
    order = ""
    elements: list[_Element] = []
    body = b""
    for number, (line, behind) in enumerate(_header_lines(path, data), start=1):
        try:
            match line.split():
                case ["end_header"]:
                    body = data[behind:]
                    break
                case ["format", kind, "1.0"]:
                    order = _ORDERS[kind]
                case ["element", name, count]:
                    elements.append(_Element(name, _count(count.encode()), []))
                case ["property", "list", count_type, kind, name]:
                    column = _Property(name, _TYPES[kind], _TYPES[count_type])
                    elements[-1].properties.append(column)
                case ["property", kind, name]:
                    elements[-1].properties.append(_Property(name, _TYPES[kind], None))
                case ["ply"] if number == 1:
                    pass
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError(line)
        except (KeyError, ValueError, IndexError) as error:
            raise InvalidInput(f"{path}:{number}: malformed header line {line[:80]!r}") from error
    if not order:
        raise InvalidInput(f"{path}: the header has no format line; one of {', '.join(_ORDERS)}")
    _check_elements(path, elements, body)
    return order, elements, body


def _count(word: bytes) -> int:
    if not INTEGER.fullmatch(word) or (count := int(word)) < 0:
        raise ValueError(word)
    return count


def _check_elements(path: Path, elements: list[_Element], body: bytes) -> None:
    for element in elements:
        names = [column.name for column in element.properties]
        if [e.name for e in elements].count(element.name) > 1 or len(set(names)) < len(names):
            raise InvalidInput(f"{path}: the header names {element.name!r} or a part of it twice")
        # Every row has at least one byte: an excess of rows is refused before they are allocated.
        if element.rows > len(body):
            raise InvalidInput(
                f"{path}: the header says {element.rows} x {element.name!r}, "
                f"but only {len(body)} bytes follow it"
            )
        for column in element.properties:
            if column.count_type is not None and column.count_type.startswith("f"):
                raise InvalidInput(
                    f"{path}: the list {column.name!r} must have a length that is an integer"
                )
        single = {column.name for column in element.properties if column.count_type is None}
        if element.name == "vertex" and (missing := [a for a in "xyz" if a not in single]):
            raise InvalidInput(f"{path}: the vertices have no property {missing[0]!r}")
        if element.name == "face":
            lists = [c for c in element.properties if c.name in _CORNERS and c.name not in single]
            if not lists:
                raise InvalidInput(f"{path}: the faces have no list 'vertex_indices'")
            if lists[0].type.startswith("f"):
                raise InvalidInput(f"{path}: the list {lists[0].name!r} must hold integers")


# --- The body -------------------------------------------------------------------------------------


def _check_polygon(
    path: Path, element: _Element, column: _Property, row: int, count: int, triangulate: bool
) -> None:
    accepted = count >= 3 if triangulate else count == 3
    if element.name == "face" and column.name in _CORNERS and not accepted:
        raise InvalidInput(
            f"{path}: face {row} must be a triangle, got {count} corners; "
            "triangulate the mesh before loading it, or pass triangulate=True"
        )


class _Ascii:
    """The words of an ASCII body, element by element."""

    def __init__(self, path: Path, body: bytes, triangulate: bool) -> None:
        self._path = path
        self._triangulate = triangulate
        self._words = body.split()
        self._at = 0

    def read(self, element: _Element) -> Columns:
        columns: dict[str, list[Any]] = {column.name: [] for column in element.properties}
        for row in range(element.rows):
            for column in element.properties:
                values = columns[column.name]
                if column.count_type is None:
                    values += self._take(element, row, column.type, 1)
                else:
                    count = int(self._take(element, row, column.count_type, 1)[0])
                    if count < 0:
                        self._refuse(element, row, f"a length of {count}")
                    _check_polygon(self._path, element, column, row, count, self._triangulate)
                    entries = self._take(element, row, column.type, count)
                    if column.name in _CORNERS:  # other lists may be of any length
                        values.append(entries)
        return _columns(columns)

    def _take(self, element: _Element, row: int, kind: str, count: int) -> list[float]:
        words = self._words[self._at : self._at + count]
        self._at += count
        if len(words) < count:
            raise InvalidInput(f"{self._path}: the file ends within {element.name} {row}")
        pattern, read = (NUMBER, float) if kind.startswith("f") else (INTEGER, _index)
        for word in words:
            if not pattern.fullmatch(word):
                self._refuse(element, row, repr(word[:40].decode("ascii", errors="replace")))
        try:
            return [read(word) for word in words]
        except ValueError as error:
            self._refuse(element, row, str(error))

    def _refuse(self, element: _Element, row: int, got: str) -> NoReturn:
        raise InvalidInput(
            f"{self._path}: {element.name} {row} must hold numbers of the types in the header, "
            f"got {got}"
        )


def _columns(columns: dict[str, list[Any]]) -> Columns:
    """Arrays of values; lists if polygons have different numbers of corners."""
    return {
        name: np.array(values, dtype=object if _is_ragged(values) else None)
        for name, values in columns.items()
    }


def _is_ragged(values: list[Any]) -> bool:
    return len({len(entry) for entry in values if isinstance(entry, list)}) > 1


def _index(word: bytes) -> int:
    """An integer that fits the largest type that PLY has."""
    value = int(word)
    if not -(2**31) <= value < 2**32:
        raise ValueError(f"{word[:40].decode()} beyond 32 bits")
    return value


class _Binary:
    """The bytes of a binary body, element by element."""

    def __init__(self, path: Path, body: bytes, order: str, triangulate: bool) -> None:
        self._path = path
        self._triangulate = triangulate
        self._body = body
        self._order = order
        self._at = 0

    def read(self, element: _Element) -> Columns:
        """Read rows; rows of different sizes are allowed only for polygons."""
        if element.name == "face" and self._triangulate:
            return self._read_row_by_row(element)
        return self._read_table(element)

    def _read_row_by_row(self, element: _Element) -> Columns:
        columns: dict[str, list[Any]] = {column.name: [] for column in element.properties}
        for row in range(element.rows):
            for column in element.properties:
                count = 1
                if column.count_type is not None:
                    count = int(self._take(element, column.count_type, 1)[0])
                    if count < 0:
                        raise InvalidInput(f"{self._path}: face {row} has a list of length {count}")
                    _check_polygon(self._path, element, column, row, count, self._triangulate)
                entries = self._take(element, column.type, count)
                if column.name in _CORNERS:
                    columns[column.name].append(entries.tolist())
        return _columns(columns)

    def _take(self, element: _Element, kind: str, count: int) -> NDArray[Any]:
        dtype = np.dtype(self._order + kind)
        self._require(element, self._at + count * dtype.itemsize)
        entries = np.frombuffer(self._body, dtype, count, self._at)
        self._at += count * dtype.itemsize
        return entries

    def _read_table(self, element: _Element) -> Columns:
        """Read rows of equal size, as when each list is as long as in the first row."""
        if element.rows == 0 or not element.properties:
            return {p.name: np.empty(0) for p in element.properties}
        # Fields are addressed by position: a property may have any name.
        fields: list[tuple[str, str] | tuple[str, str, int]] = []
        offset = self._at
        for i, column in enumerate(element.properties):
            kind = np.dtype(self._order + column.type)
            if column.count_type is None:
                fields.append((f"{i}", kind.str))
                offset += kind.itemsize
                continue
            count_kind = np.dtype(self._order + column.count_type)
            self._require(element, offset + count_kind.itemsize)
            count = int(np.frombuffer(self._body, count_kind, 1, offset)[0])
            _check_polygon(self._path, element, column, 0, count, self._triangulate)
            if count < 0:
                raise InvalidInput(f"{self._path}: {element.name} 0 has a list of length {count}")
            offset += count_kind.itemsize + count * kind.itemsize
            self._require(element, offset)
            fields += [(f"#{i}", count_kind.str), (f"{i}", kind.str, count)]
        rows = np.dtype(fields)
        self._require(element, self._at + rows.itemsize * element.rows)
        table = np.frombuffer(self._body, rows, element.rows, self._at)
        for i, column in enumerate(element.properties):
            counts = table[f"#{i}"] if column.count_type is not None else np.empty(0)
            other = np.flatnonzero(counts != counts[:1])
            if other.size:
                row = int(other[0])
                found = int(counts[row])
                _check_polygon(self._path, element, column, row, found, self._triangulate)
                raise InvalidInput(
                    f"{self._path}: lists {column.name!r} of different lengths cannot be read; "
                    "an .obj or an ASCII .ply file may have them"
                )
        self._at += rows.itemsize * element.rows
        return {p.name: table[f"{i}"] for i, p in enumerate(element.properties)}

    def _require(self, element: _Element, end: int) -> None:
        if end > len(self._body):
            raise InvalidInput(f"{self._path}: the file ends within the {element.name} rows")
