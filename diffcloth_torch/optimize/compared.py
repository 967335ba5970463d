"""What residuals compare: noted while they are evaluated, for the page of a fit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from diffcloth_torch.checks import FloatArray

__all__ = ["Comparison", "note", "noting"]


@dataclass(frozen=True, eq=False)
class Comparison:
    """One trajectory, simulated and observed.

    Attributes:
        kind: "markers", "point_cloud" or "outline".
        times: Of the frames [s], shape [T].
        simulated: Of each frame the simulated points [m], shape [n, 3] or [n, 2].
        observed: The observed ones, likewise; NaN where one was not seen.
        labels: Name of each point of a frame: its vertex, direction or number.
        noise: Standard deviation of an observation [m].
    """

    kind: str
    times: FloatArray
    simulated: list[FloatArray]
    observed: list[FloatArray]
    labels: list[str]
    noise: float


_NOTES: ContextVar[list[Comparison] | None] = ContextVar("_NOTES", default=None)


@contextmanager
def noting() -> Iterator[list[Comparison]]:
    """Collect what is compared inside."""
    notes: list[Comparison] = []
    token = _NOTES.set(notes)
    try:
        yield notes
    finally:
        _NOTES.reset(token)


def note(comparison: Comparison) -> None:
    """Keep a comparison, if somebody collects."""
    notes = _NOTES.get()
    if notes is not None:
        notes.append(comparison)
