"""Point clouds in the PCD format: text, bytes and refused files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pcd import read_pcd

import diffcloth_torch as dc

POINTS = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)


def header(data, fields="x y z", sizes="4 4 4", types="F F F", counts="1 1 1", points=5):
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
    ).encode()


def text(points=POINTS):
    return "\n".join(" ".join(f"{float(x)!r}" for x in row) for row in points).encode() + b"\n"


def test_text_and_bytes_have_the_same_points():
    for content in (header("ascii") + text(), header("binary") + POINTS.tobytes()):
        np.testing.assert_array_equal(read_pcd(Path("a.pcd"), content), POINTS)


def test_other_fields_are_left_out_and_points_that_are_not_finite():
    row = np.dtype(
        [("rgb", "<u4"), ("z", "<f8"), ("normal", "<f4", (3,)), ("x", "<f4"), ("y", "<f4")]
    )
    table = np.zeros(5, dtype=row)
    for k, name in enumerate("xyz"):
        table[name] = POINTS[:, k]
    table["y"][2] = np.nan
    described = header("binary", "rgb z normal x y", "4 8 4 4 4", "U F F F F", "1 1 3 1 1")
    found = read_pcd(Path("a.pcd"), described + table.tobytes())
    np.testing.assert_array_equal(found, np.delete(POINTS, 2, axis=0))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "must have a PCD header"),
        (b"\x00\xff" * 100, "must have a PCD header"),
        (header("binary_compressed"), "DATA must be ascii or binary, got 'binary_compressed'"),
        (header("ascii", fields="x y w"), "FIELDS must have x, y and z"),
        (header("ascii", sizes="4 4 3"), "TYPE and SIZE must be"),
        (header("ascii", sizes="4 4"), "SIZE must have 3 numbers"),
        (header("ascii", counts="1 1 -1"), "COUNT must have 3 numbers"),
        (header("ascii", counts="1 1 2"), "COUNT of z must be 1"),
        (header("ascii", points=6) + text(), "must have 6 points, got 5 lines"),
        (header("binary", points=10**12), "must have 1000000000000 points of 12 bytes"),
        (header("ascii", points=1) + b"1 2\n", r"the point \[0\] must be 3 numbers"),
        (header("ascii", points=1) + b"1 2 q\n", r"the point \[0\] must be 3 numbers"),
        (header("ascii").replace(b"TYPE", b"KIND"), "must have the line TYPE"),
    ],
)
def test_bad_files_are_refused(content, message):
    with pytest.raises(dc.InvalidInput, match=message):
        read_pcd(Path("a.pcd"), content)
