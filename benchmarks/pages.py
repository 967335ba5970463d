"""Tables of measurements on pages, as benchmarks write them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from diffcloth_torch.learn.evaluation import wilson

__all__ = ["around", "share", "table"]


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table in Markdown, whose columns after the first one are aligned to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def share(done: int, count: int) -> str:
    """A share with its Wilson interval of 95 %."""
    low, high = wilson(done, count)
    return f"{done / count:.0%} ({low:.0%} to {high:.0%})".replace("%", " %")


def around(text: str, begin: str, end: str) -> tuple[str, str, str]:
    """Split a page into the text before a line, the text between two lines, and the text after.

    Raises:
        ValueError: If the page does not have both lines.
    """
    before, found, rest = text.partition(begin)
    inside, ended, after = rest.partition(end)
    if not (found and ended):
        raise ValueError(f"the page must have lines {begin!r} and {end!r}")
    return before, inside, after
