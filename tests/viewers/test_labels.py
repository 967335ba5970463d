"""Legends and overviews: everything lies inside, and no cell is blank."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("PIL")

from diffcloth_torch.viewers.labels import Entry, legend_strip, overview

ENTRIES = [Entry(f"body {i} (front, back)", ("#ff0000", "#0000ff")) for i in range(3)]
MARGIN = 8  # pixels between cells


def pictures(count, height=60, width=80):
    """Pictures of one gray each, which white margins differ from."""
    return [np.full((height, width, 3), 100 + k, dtype=np.uint8) for k in range(count)]


@pytest.mark.parametrize("count", range(2, 18))
def test_an_overview_with_a_legend_has_no_blank_cell(count):
    image = overview(pictures(count), ENTRIES)
    columns = (image.shape[1] + MARGIN) // (80 + MARGIN)
    rows = -(-count // columns)
    for k in range(count):
        row, column = divmod(k, columns)
        y, x = row * (60 + MARGIN), column * (80 + MARGIN)
        assert (image[y : y + 60, x : x + 80] == 100 + k).all(), k
    # The rest has one centered legend: a part of the last row, or a strip below full rows.
    strip = image[rows * (60 + MARGIN) - MARGIN :]
    if strip.size:
        assert count == rows * columns
        assert len(strip) <= 60 // 4
        left = strip
    else:
        first = count % columns
        assert first
        # If the legend covers several cells, pictures alone would leave a cell empty, too.
        assert columns - first == 1 or count == 13
        left = image[-60:, first * (80 + MARGIN) :]
        ink = np.flatnonzero((left < 250).any(axis=-1).any(axis=0))
        assert abs((ink[0] + ink[-1]) / 2 - left.shape[1] / 2) < 5
    for color in ([255, 0, 0], [0, 0, 255]):
        assert (left == color).all(axis=-1).sum() > 10  # letters are small here


@pytest.mark.parametrize("count", range(2, 18))
def test_without_a_legend_the_last_row_is_in_the_middle(count):
    image = overview(pictures(count), [])
    seen = {k: np.argwhere((image == 100 + k).all(axis=-1)) for k in range(count)}
    for k, pixels in seen.items():
        assert len(pixels) == 60 * 80, k
    filled = np.flatnonzero((image[-60:] != 255).any(axis=-1).any(axis=0))
    assert abs(filled[0] - (image.shape[1] - 1 - filled[-1])) <= 1


@pytest.mark.parametrize("count", [1, 4, 14, 40])
def test_a_legend_keeps_to_a_quarter_of_the_picture(count):
    entries = [Entry(f"a body with a long name {i}", ("#ff0000",)) for i in range(count)]
    strip = legend_strip((640, 480), entries)
    assert strip.shape[1] == 640
    assert strip.shape[0] % 2 == 0
    assert 20 < strip.shape[0] <= 480 // 4
    # All entries are present: count the upper left corners of red rectangles.
    red = np.pad((strip == [255, 0, 0]).all(axis=-1), 1)
    corners = red[1:, 1:] & ~red[:-1, 1:] & ~red[1:, :-1]
    assert corners.sum() == count
