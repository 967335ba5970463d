"""Labels of pictures: the time and a legend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.extras import from_extra
from diffcloth_torch.viewers.floor import BACKGROUND

if TYPE_CHECKING:
    from PIL import ImageDraw

__all__ = ["Entry", "legend_strip", "overview", "write_time"]

Image = NDArray[np.uint8]

_INK = "#2f3640"
_MARGIN = 8  # pixels between the pictures of an overview
# Parts of the height of a picture.
_TIME_SIZE = 1 / 18
_LEGEND_SIZE = 1 / 22
_LARGEST_LEGEND = 0.25
_SMALLEST_LETTERS = 7  # pixels
_LINE = 1.6  # distance of the lines of a legend, in sizes of its letters


@dataclass(frozen=True)
class Entry:
    """A line of the legend.

    Attributes:
        text: Meaning of the colors.
        colors: One color "#rrggbb", or the colors of front and back.
    """

    text: str
    colors: tuple[str, ...]


def write_time(image: Image, time: float, step: float) -> Image:
    """Write the time into the upper left corner.

    Args:
        image: Colors, shape [height, width, 3].
        time: Time [s].
        step: Shortest time between pictures [s], which determines the number of digits.
    """
    decimals = min(max(2, math.ceil(-math.log10(step) - 1e-9)), 6) if step > 0 else 2
    size = image.shape[0] * _TIME_SIZE
    canvas, drawing = _canvas(image)
    place = (0.6 * size, 0.5 * size)
    drawing.text(place, f"t = {time:.{decimals}f} s", fill=_INK, font=_font(size))
    return np.asarray(canvas)


def legend_strip(size: Sequence[int], entries: Sequence[Entry]) -> Image:
    """Draw the legend for the lower end of a picture, in as many lines as it needs.

    Args:
        size: Width and height of the picture with its legend [pixels].
        entries: Entries of the legend; several may share a line.

    Returns:
        Colors, shape [height, width, 3], with an even height.
    """
    width, letters = size[0], size[1] * _LEGEND_SIZE
    # With many or long entries, smaller letters leave space for the scene.
    while True:
        lines = _break(entries, width, letters)
        height = 2 * math.ceil((len(lines) + 0.4) * _LINE * letters / 2)
        if height <= _LARGEST_LEGEND * size[1] or letters < _SMALLEST_LETTERS:
            break
        letters *= 0.9
    strip, drawing = _canvas(_blank(height, width))
    for i, line in enumerate(lines):
        for x, entry in line:
            _draw_entry(drawing, entry, x, (i + 0.4) * _LINE * letters, letters)
    return np.asarray(strip)


def _break(
    entries: Sequence[Entry], width: float, letters: float
) -> list[list[tuple[float, Entry]]]:
    """Entries of each line, and their horizontal positions."""
    lines: list[list[tuple[float, Entry]]] = [[]]
    x = start = 0.6 * letters
    for entry in entries:
        length = _entry_width(entry, letters)
        if lines[-1] and x + length > width:
            lines.append([])
            x = start
        lines[-1].append((x, entry))
        x += length + letters
    return lines


def overview(images: Sequence[Image], entries: Sequence[Entry]) -> Image:
    """Arrange pictures of one size in rows, and the legend in the remaining cells.

    No cell is blank: if the legend would need several cells and the pictures alone fill all rows,
    it is a strip below them; without a legend, an incomplete last row is centered.
    """
    height, width = images[0].shape[:2]
    columns, rows = _grid(len(images), bool(entries))
    strip = None
    if entries and columns * rows > len(images) + 1:
        alone = _grid(len(images), legend=False)
        if alone[0] * alone[1] == len(images):
            columns, rows = alone
            strip = legend_strip((_length(columns, width), height), entries)
    left = columns * rows - len(images)
    cells: list[Image] = list(images)
    if entries and left:
        cells.append(_legend_cell(height, _length(left, width), entries))
    whole = np.full((_length(rows, height), _length(columns, width), 3), 255, dtype=np.uint8)
    last = (rows - 1) * columns
    indent = 0 if entries else left * (width + _MARGIN) // 2
    for k, image in enumerate(cells):
        row, column = divmod(k, columns)
        y = row * (height + _MARGIN)
        x = column * (width + _MARGIN) + (indent if k >= last else 0)
        whole[y : y + height, x : x + image.shape[1]] = image
    return whole if strip is None else np.concatenate([whole, strip])


def _length(count: int, size: int) -> int:
    """Pixels of a number of cells side by side."""
    return count * (size + _MARGIN) - _MARGIN


def _grid(count: int, legend: bool) -> tuple[int, int]:
    """Columns and rows for a number of pictures: nearly square, with few cells for the legend."""
    cells = count + legend
    square = math.ceil(math.sqrt(cells))

    def cost(columns: int) -> tuple[int, int]:
        return -(-cells // columns) * columns - cells, columns

    columns = min(range(square, min(square + 1, cells) + 1), key=cost)
    return columns, -(-cells // columns)


def _legend_cell(height: int, width: int, entries: Sequence[Entry]) -> Image:
    canvas, drawing = _canvas(np.full((height, width, 3), 255, dtype=np.uint8))
    size = height * _TIME_SIZE
    size = min(size, 0.9 * height / (_LINE * max(1, len(entries))))
    widest = max((_entry_width(entry, size) for entry in entries), default=0.0)
    size *= min(1.0, 0.9 * width / max(widest, 1.0))
    left = (width - max((_entry_width(entry, size) for entry in entries), default=0.0)) / 2
    top = (height - _LINE * size * len(entries)) / 2
    for i, entry in enumerate(entries):
        _draw_entry(drawing, entry, left, top + i * _LINE * size, size)
    return np.asarray(canvas)


def _draw_entry(
    drawing: ImageDraw.ImageDraw, entry: Entry, x: float, y: float, size: float
) -> None:
    part = _swatch_width(size) / len(entry.colors)
    for i, color in enumerate(entry.colors):
        left = x + i * part
        drawing.rectangle([left, y + 0.15 * size, left + part, y + 1.05 * size], fill=color)
    text_x = x + _swatch_width(size) + 0.5 * size
    drawing.text((text_x, y), entry.text, fill=_INK, font=_font(size))


def _entry_width(entry: Entry, size: float) -> float:
    return _swatch_width(size) + 0.5 * size + float(_font(size).getlength(entry.text))


def _swatch_width(size: float) -> float:
    return 1.6 * size


def _blank(height: int, width: int) -> Image:
    color = [int(BACKGROUND[i : i + 2], 16) for i in (1, 3, 5)]
    return np.full((height, width, 3), color, dtype=np.uint8)


def _canvas(image: Image) -> tuple[Any, ImageDraw.ImageDraw]:
    from PIL import Image as Pillow
    from PIL import ImageDraw

    canvas = Pillow.fromarray(image)
    return canvas, ImageDraw.Draw(canvas)


def _font(size: float) -> Any:
    return _font_of_size(max(6, round(size)))


@lru_cache(maxsize=16)
def _font_of_size(size: int) -> Any:
    matplotlib = from_extra("matplotlib", "viewer", "labels of pictures need Matplotlib's font")
    from PIL import ImageFont

    file = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    return ImageFont.truetype(str(file), size)
