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

from diffcloth_torch.viewers.floor import BACKGROUND

if TYPE_CHECKING:
    from PIL import ImageDraw

__all__ = ["Entry", "legend_below", "overview", "write_time"]

Image = NDArray[np.uint8]

_INK = "#2f3640"
_MARGIN = 8  # pixels between the pictures of an overview
# Parts of the height of a picture.
_TIME_SIZE = 1 / 18
_LEGEND_SIZE = 1 / 22
_LINE = 1.6  # from one line of a legend to the next, in sizes of its letters


@dataclass(frozen=True)
class Entry:
    """A line of the legend.

    Attributes:
        text: What the colors stand for.
        colors: One color "#rrggbb", or those of the front and the back.
    """

    text: str
    colors: tuple[str, ...]


def write_time(image: Image, time: float, step: float) -> Image:
    """Write the time into the upper left corner.

    Args:
        image: Colors, shape [height, width, 3].
        time: What is written [s].
        step: Shortest time from one picture to the next [s]: so many digits are written.
    """
    decimals = min(max(2, math.ceil(-math.log10(step) - 1e-9)), 6) if step > 0 else 2
    size = image.shape[0] * _TIME_SIZE
    canvas, drawing = _canvas(image)
    place = (0.6 * size, 0.5 * size)
    drawing.text(place, f"t = {time:.{decimals}f} s", fill=_INK, font=_font(size))
    return np.asarray(canvas)


def legend_below(image: Image, entries: Sequence[Entry]) -> Image:
    """Put the legend below a picture, in as many lines as it needs; the height stays even."""
    height, width = image.shape[:2]
    size = height * _LEGEND_SIZE
    lines: list[list[tuple[float, Entry]]] = [[]]
    x = start = 0.6 * size
    for entry in entries:
        length = _entry_width(entry, size)
        if lines[-1] and x + length > width:
            lines.append([])
            x = start
        lines[-1].append((x, entry))
        x += length + size
    strip_height = 2 * math.ceil((len(lines) + 0.4) * _LINE * size / 2)
    strip, drawing = _canvas(_blank(strip_height, width))
    for i, line in enumerate(lines):
        for x, entry in line:
            _draw_entry(drawing, entry, x, (i + 0.4) * _LINE * size, size)
    return np.concatenate([image, np.asarray(strip)])


def overview(images: Sequence[Image], entries: Sequence[Entry]) -> Image:
    """Arrange pictures of one size in rows, and the legend in the cell after the last."""
    height, width = images[0].shape[:2]
    columns = math.ceil(math.sqrt(len(images) + 1))
    rows = math.ceil((len(images) + 1) / columns)
    whole = np.full(
        (rows * (height + _MARGIN) - _MARGIN, columns * (width + _MARGIN) - _MARGIN, 3),
        255,
        dtype=np.uint8,
    )
    for k, image in enumerate([*images, _legend_cell(height, width, entries)]):
        row, column = divmod(k, columns)
        top, left = row * (height + _MARGIN), column * (width + _MARGIN)
        whole[top : top + height, left : left + width] = image
    return whole


def _legend_cell(height: int, width: int, entries: Sequence[Entry]) -> Image:
    canvas, drawing = _canvas(np.full((height, width, 3), 255, dtype=np.uint8))
    size = height * _TIME_SIZE
    size = min(size, 0.9 * height / (_LINE * max(1, len(entries))))
    widest = max((_entry_width(entry, size) for entry in entries), default=0.0)
    size *= min(1.0, 0.9 * width / max(widest, 1.0))
    top = (height - _LINE * size * len(entries)) / 2
    for i, entry in enumerate(entries):
        _draw_entry(drawing, entry, 0.05 * width, top + i * _LINE * size, size)
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
    import matplotlib
    from PIL import ImageFont

    file = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    return ImageFont.truetype(str(file), size)
