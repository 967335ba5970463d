"""Simulated and observed points, recorded during an evaluation for the page of a fit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch.autograd.transforms import numbers_of
from diffcloth_torch.checks import (
    POSITIVE,
    FloatArray,
    check_finite,
    check_number,
    check_shape,
    float_array,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.sim.records.state import State, check_state

__all__ = [
    "Comparison",
    "blocks_of",
    "check_count_of",
    "checked_noise",
    "checked_points",
    "note",
    "noting",
    "positions_of",
    "times_of",
]


@dataclass(frozen=True, eq=False)
class Comparison:
    """One trajectory, simulated and observed.

    Attributes:
        kind: "markers", "point_cloud" or "outline".
        times: Times of the frames [s], shape [T].
        simulated: Simulated points of each frame [m], shape [n, 3] or [n, 2].
        observed: Observed points of each frame [m], likewise; NaN for unseen points.
        placed: Observed points in the orientation of the states, for outlines with `turned` too.
        labels: Name of each point of a frame: its vertex, direction or number.
        noise: Standard deviation of an observation [m].
        used: For markers, True for coordinates with a residual, shape [T, n, 3]; else None.
    """

    kind: str
    times: FloatArray
    simulated: list[FloatArray]
    observed: list[FloatArray]
    placed: list[FloatArray]
    labels: list[str]
    noise: float
    used: NDArray[np.bool_] | None = None


_NOTES: ContextVar[list[Comparison] | None] = ContextVar("_NOTES", default=None)


@contextmanager
def noting() -> Iterator[list[Comparison]]:
    """Collect the comparisons noted within this context."""
    notes: list[Comparison] = []
    token = _NOTES.set(notes)
    try:
        yield notes
    finally:
        _NOTES.reset(token)


def note(comparison: Comparison) -> None:
    """Record a comparison if a `noting` context is active."""
    notes = _NOTES.get()
    if notes is not None:
        notes.append(comparison)


def blocks_of(owner: str, found: object) -> dict[str, Tensor]:
    """Blocks that a residual function returned: name -> tensor, whose first axis is time.

    Raises:
        TypeError: If the function returned neither a tensor, a list of tensors, nor a dict of
            name -> tensor.
    """
    if isinstance(found, Tensor):
        return {"residuals": found}
    if isinstance(found, list | tuple):
        found = {f"trajectory {k}": part for k, part in enumerate(found)}
    if not isinstance(found, Mapping) or not all(
        isinstance(name, str) and isinstance(part, Tensor) for name, part in found.items()
    ):
        raise TypeError(
            f"{owner} must return a tensor, a list of tensors, or a dict of name -> tensor"
        )
    return dict(found)


def positions_of(owner: str, states: Sequence[State]) -> Tensor:
    """Positions of states without a batch axis [T, N, 3]; other input is refused."""
    given: Any = states
    if isinstance(given, State):
        raise TypeError(f"{owner}: `states` must be a list of State, got one State")
    if not isinstance(given, Sequence):
        raise TypeError(f"{owner}: `states` must be a list of State, got {type(given).__name__}")
    if not len(given):
        raise InvalidInput(f"{owner}: `states` must be one or more, got none")
    for k, state in enumerate(given):
        check_state(f"{owner}: `states`[{k}]", state)
        if state.batch_size is not None:
            raise InvalidInput(
                f"{owner}: `states`[{k}] must have no batch axis, got {state.batch_size} "
                "environments; state[i] is one of them"
            )
        check_shape(
            f"{owner}: `states`[{k}].positions", state.positions.shape, [given[0].positions.shape]
        )
    positions = torch.stack([state.positions for state in states])
    check_finite(f"{owner}: `states`", numbers_of(positions))
    return positions


def check_count_of(owner: str, name: str, value: object, count: int) -> None:
    """Require a sequence with an entry for each state."""
    if not isinstance(value, Sequence | np.ndarray | Tensor) or isinstance(value, str):
        raise TypeError(f"{owner}: `{name}` must be a list, got {type(value).__name__}")
    if len(value) != count:
        raise InvalidInput(
            f"{owner}: `{name}` must be one for each of {count} states, got {len(value)}"
        )


def times_of(states: Sequence[State]) -> FloatArray:
    """Times of states [s], shape [T]."""
    return np.array([float(numbers_of(state.time)) for state in states])


def checked_points(name: str, value: object) -> FloatArray:
    """Finite points [n, 3], copied into float64."""
    points = float_array(name, value)
    check_shape(name, points.shape, [("n", 3)])
    check_finite(name, points)
    return points


def checked_noise(owner: str, noise: float) -> float:
    """Return a standard deviation; require a positive number."""
    return check_number(f"{owner}: `noise`", noise, POSITIVE)
