"""Point clouds in the PCD format of the Point Cloud Library, version 0.7: their x, y and z.

The header names fields with a size, a type and a count each; the data are text, or rows of bytes.
Compressed data are refused. `examples/rgbench.py` uses this reader.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput

__all__ = ["read_pcd"]

_REQUIRED = ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA")
_KINDS = {"F": "f", "I": "i", "U": "u"}
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_LONGEST_HEADER = 1 << 16
_MOST_FIELDS = 256


class _Header(NamedTuple):
    """Names, numpy types and counts of the fields, number of points, and the kind of data."""

    names: list[str]
    types: list[str]
    counts: list[int]
    points: int
    data: str


def read_pcd(path: Path, data: bytes) -> FloatArray:
    """Read the points of a PCD file that are finite.

    Args:
        path: The file, for messages.
        data: Its content.

    Returns:
        Points in the unit of the file, shape [n, 3].

    Raises:
        InvalidInput: If the file is no valid PCD file.
    """
    lines, start = _header_lines(path, data)
    header = _header(path, lines)
    rows = _ascii if header.data == "ascii" else _binary
    points = rows(path, header, data[start:])
    return points[np.isfinite(points).all(axis=1)]


def _header_lines(path: Path, data: bytes) -> tuple[dict[str, list[str]], int]:
    lines: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in lines:
        end = data.find(b"\n", start, _LONGEST_HEADER)
        if end < 0:
            raise InvalidInput(f"{path}: must have a PCD header that ends with a line DATA")
        words = data[start:end].decode("ascii", errors="replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            lines[words[0].upper()] = words[1:]
    return lines, start


def _header(path: Path, lines: dict[str, list[str]]) -> _Header:
    missing = [name for name in _REQUIRED if not lines.get(name)]
    if missing:
        raise InvalidInput(f"{path}: its PCD header must have the line {missing[0]}")
    names, data = lines["FIELDS"], lines["DATA"][0].lower()
    if data not in ("ascii", "binary"):
        raise InvalidInput(f"{path}: DATA must be ascii or binary, got {data!r}: save it as that")
    if not {"x", "y", "z"} <= set(names) or len(names) > _MOST_FIELDS:
        raise InvalidInput(f"{path}: FIELDS must have x, y and z, got {' '.join(names)[:80]}")
    sizes = _counts(path, "SIZE", lines["SIZE"], len(names))
    counts = _counts(path, "COUNT", lines.get("COUNT", ["1"] * len(names)), len(names))
    (points,) = _counts(path, "POINTS", lines["POINTS"], 1)
    kinds = lines["TYPE"]
    if len(kinds) != len(names) or any(
        size not in _SIZES.get(kind, ()) for kind, size in zip(kinds, sizes, strict=True)
    ):
        raise InvalidInput(
            f"{path}: TYPE and SIZE must be F of 4 or 8, or I or U of 1, 2, 4 or 8 bytes, for each "
            f"of {len(names)} fields, got {' '.join(kinds)[:80]} and {sizes}"
        )
    for name in "xyz":
        if counts[names.index(name)] != 1:
            raise InvalidInput(f"{path}: COUNT of {name} must be 1")
    types = [f"<{_KINDS[kind]}{size}" for kind, size in zip(kinds, sizes, strict=True)]
    return _Header(names, types, counts, points, data)


def _counts(path: Path, name: str, words: list[str], expected: int) -> list[int]:
    if len(words) != expected or not all(word.isascii() and word.isdigit() for word in words):
        raise InvalidInput(
            f"{path}: {name} must have {expected} numbers, got {' '.join(words)[:80]!r}"
        )
    return [int(word) for word in words]


def _binary(path: Path, header: _Header, body: bytes) -> FloatArray:
    row = np.dtype(
        [
            (f"{k}", kind, (count,))
            for k, (kind, count) in enumerate(zip(header.types, header.counts, strict=True))
        ]
    )
    if len(body) < row.itemsize * header.points:
        raise InvalidInput(
            f"{path}: must have {header.points} points of {row.itemsize} bytes, "
            f"got {len(body)} bytes"
        )
    table = np.frombuffer(body, dtype=row, count=header.points)
    columns = [table[f"{header.names.index(name)}"][:, 0].astype(np.float64) for name in "xyz"]
    return np.stack(columns, axis=1)


def _ascii(path: Path, header: _Header, body: bytes) -> FloatArray:
    firsts = np.cumsum([0, *header.counts])
    wanted = [int(firsts[header.names.index(name)]) for name in "xyz"]
    lines = [line for line in body.split(b"\n") if line.strip()]
    if len(lines) != header.points:
        raise InvalidInput(f"{path}: must have {header.points} points, got {len(lines)} lines")
    points = np.zeros((len(lines), 3))
    for k, line in enumerate(lines):
        words = line.split()
        try:
            if len(words) != firsts[-1]:
                raise ValueError(f"{len(words)} numbers")
            points[k] = [float(words[i]) for i in wanted]
        except ValueError as error:
            raise InvalidInput(
                f"{path}: the point [{k}] must be {firsts[-1]} numbers, got {line[:40]!r}: {error}"
            ) from error
    return points
