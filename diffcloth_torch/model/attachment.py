"""Attachments: springs between points of cloths, bodies and links, or to targets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import (
    NON_NEGATIVE,
    UNIT_INTERVAL,
    ArrayLike,
    FloatArray,
    Range,
    check_finite,
    check_name,
    check_range,
    check_shape,
    float_array,
    frozen,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.quantities import PARAMETERS
from diffcloth_torch.saved import saved

__all__ = ["Attachment", "Points"]

_DETACHED = "pass a detached tensor"
_STIFFNESS = "differentiate with respect to Parameters.attachment_stiffness"
_SUM = 1e-6  # tolerance of the sum of the weights of corners, which is 1


@saved
class Points(NamedTuple):
    """Points of one surface, as passed by the caller; the scene knows the kind of the surface.

    Attributes:
        surface: Name of a cloth or body, or "robot/link".
        where: Vertices of a cloth, or points in the frame of a body or link [m].
        weights: Weights of the vertices [-]; None if each vertex is a point by itself, and for
            points of bodies and links.
    """

    surface: str
    where: NDArray[Any]
    weights: FloatArray | None


@saved
class Attachment:
    """Springs between points of a scene, or between points and targets; immutable.

    A spring of length l has the energy w k / 2 (l - L)^2 with the stiffness k, the rest length L
    and a weight w between 0 (released) and 1, which a control sets. Attachments sew cloths, hold
    them at bodies and links and, if the second end is a target that a control moves, model pickers
    or suction cups. The force acts on both ends.

    >>> dc.Attachment(("left", [0, 1, 2]), ("right", [9, 10, 11]), stiffness=500.0, name="seam")
    >>> dc.Attachment(("shirt", [3, 8, 9], [0.2, 0.3, 0.5]), ("hand/palm", [0, 0, 0.02]),
    ...               stiffness=100.0)
    >>> dc.Attachment(("sheet", 0), stiffness=200.0, name="picker")

    Attributes:
        a: First end of the springs.
        b: Second end, likewise; None for targets.
        stiffness: k [N/m], shape [] or [n].
        rest_length: L [m], shape [] or [n].
        name: Name, or None.
    """

    a: Points
    b: Points | None
    stiffness: FloatArray
    rest_length: FloatArray
    name: str | None

    def __init__(
        self,
        a: Sequence[Any],
        b: Sequence[Any] | None = None,
        *,
        stiffness: ArrayLike,
        rest_length: ArrayLike = 0.0,
        name: str | None = None,
    ) -> None:
        """Check the arguments.

        An end is

        - `(cloth, vertex)` or `(cloth, [vertex, ..])`: vertices, one a spring;
        - `(cloth, corners, weights)`: sums of vertices, corners and weights [m] or [n, m] with
          weights between 0 and 1 that add to one;
        - `(body, point)` or `("robot/link", point)`: points in the frame of the body or link [m],
          [3] or [n, 3];
        - None, for the second end only: targets in space, which controls set.

        An end of one point is connected to every point of the other end.

        Args:
            a: First end.
            b: Second end.
            stiffness: k [N/m], > 0, of all springs or of each, shape [] or [n].
            rest_length: L [m], >= 0, of all springs or of each, shape [] or [n].
            name: Name in controls and parameters.

        Raises:
            InvalidInput: If a value, shape or name is not accepted. The scene checks the names of
                surfaces and the numbers of vertices.
            TypeError: If something is of the wrong type.
        """
        self.name = check_name("Attachment: `name`", name)
        self.a = _points("a", a)
        self.b = None if b is None else _points("b", b)
        accepted = PARAMETERS["attachment_stiffness"].accepted
        self.stiffness = _values("stiffness", stiffness, accepted, _STIFFNESS)
        self.rest_length = _values("rest_length", rest_length, NON_NEGATIVE, _DETACHED)

    def __repr__(self) -> str:
        name = f", name={self.name!r}" if self.name else ""
        other = "targets" if self.b is None else repr(self.b.surface)
        return f"Attachment({self.a.surface!r} to {other}{name})"


def _values(field: str, value: object, accepted: Range, instead: str) -> FloatArray:
    label = f"Attachment: `{field}`"
    values = float_array(label, value, instead=instead)
    check_shape(label, values.shape, [(), ("n",)])
    check_range(label, values, accepted)
    return frozen(values)


def _points(end: str, given: Any) -> Points:
    """Check the description of an end, as far as possible without a scene."""
    label = f"Attachment: `{end}`"
    forms = "(surface, points) or (cloth, corners, weights)"
    if not isinstance(given, tuple | list):
        raise TypeError(f"{label} must be {forms}, got {type(given).__name__}")
    if len(given) not in (2, 3) or not isinstance(given[0], str):
        raise InvalidInput(f"{label} must be {forms}, got {given!r}")
    where = float_array(f"{label}, points of {given[0]!r},", given[1])
    whole = np.asarray(given[1]).dtype.kind in "iu" or isinstance(given[1], range)
    if not where.size or where.ndim > 2:
        raise InvalidInput(
            f"{label} must hold one point or more of {given[0]!r}, got shape {list(where.shape)}"
        )
    check_finite(f"{label}, points of {given[0]!r},", where)
    array = where.astype(np.int64) if whole else where
    if len(given) == 2:
        return Points(given[0], frozen(array), None)
    return Points(given[0], frozen(array), _corner_weights(label, given[2], where.shape))


def _corner_weights(label: str, given: object, shape: tuple[int, ...]) -> FloatArray:
    """Weights of corners, normalized in float64 such that their sum is 1."""
    label = f"{label}, weights of corners,"
    weights = float_array(label, given)
    if len(shape) == 0:
        raise InvalidInput(f"{label} need corners of shape [m] or [n, m], got one vertex")
    check_shape(label, weights.shape, [shape])
    check_range(label, weights, UNIT_INTERVAL)
    sums = weights.sum(axis=-1, keepdims=True)
    if (np.abs(sums - 1.0) > _SUM).any():
        raise InvalidInput(
            f"{label} must add to one, got {float(sums.flat[np.abs(sums - 1.0).argmax()]):g}"
        )
    return frozen(weights / sums)
