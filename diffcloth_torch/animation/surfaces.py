"""Surfaces over time as plain arrays: the input of every writer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput

__all__ = ["Animation", "MovingSurface"]


@dataclass(frozen=True, eq=False)
class MovingSurface:
    """A triangle mesh at T times: a cloth with moving vertices, or a rigid mesh with moving frames.

    Attributes:
        name: Name in the scene; "robot/link" of a link.
        faces: Vertex indices, shape [f, 3].
        vertices: In the world [m], shape [T, v, 3]; or, with `frames`, in the frame of the surface,
            shape [v, 3].
        frames: Frames of a rigid surface, shape [T, 4, 4]; None for a cloth.
        vectors: Name -> vectors at the vertices in SI units, shape [T, v, 3].
    """

    name: str
    faces: NDArray[np.integer]
    vertices: FloatArray
    frames: FloatArray | None = None
    vectors: Mapping[str, FloatArray] = field(default_factory=dict)

    @property
    def is_still(self) -> bool:
        """True if the surface is at one place throughout."""
        moving = self.vertices if self.frames is None else self.frames
        return bool((moving == moving[:1]).all())

    def placed(self, frame: int) -> FloatArray:
        """Vertices in the world at one time [m], shape [v, 3]."""
        if self.frames is not None:
            matrix = self.frames[frame]
            points: FloatArray = self.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        else:
            points = self.vertices[frame]
        return points


@dataclass(frozen=True, eq=False)
class Animation:
    """All surfaces of a scene over time.

    Attributes:
        times: Times [s], shape [T], strictly increasing.
        surfaces: Cloths, bodies, and links that have collision shapes.
    """

    times: FloatArray
    surfaces: Sequence[MovingSurface]

    def check_times(self, owner: str) -> None:
        """Require times that increase, as formats with a time axis do.

        Raises:
            InvalidInput: If a time is not larger than the previous one.
        """
        late = np.flatnonzero(~(np.diff(self.times) > 0.0))
        if late.size:
            k = int(late[0]) + 1
            raise InvalidInput(
                f"{owner}: the times of states must increase in this format, got "
                f"{self.times[k]:g} s after {self.times[k - 1]:g} s at [{k}]"
            )
