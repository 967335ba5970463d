"""How what is drawn shall look: options of pictures, colors of surfaces, shapes to reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.geometry import shapes

__all__ = ["Camera", "Goal", "Paint", "Pictures", "marker"]

_MARKER_SUBDIVISIONS = 2


@dataclass(frozen=True, eq=False)
class Camera:
    """Where pictures are taken from; None is chosen from the motion.

    Attributes:
        azimuth: Direction of view in degrees: 0 looks along +y, 90 along -x.
        elevation: Height above the horizon in degrees, between -90 and 90.
        zoom: What the distance is divided by, > 0.
        target: Point [m] around which lies what is drawn.
        distance: From the target, before the zoom [m].
    """

    azimuth: float = 35.0
    elevation: float = 18.0
    zoom: float = 1.0
    target: Sequence[float] | None = None
    distance: float | None = None


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures and the animation.

    Attributes:
        size: Width and height [pixels], even numbers.
        fps: Pictures per second; None plays in real time.
        video: Kind of the animation.
        frames: Whether every picture of the animation is kept.
        sheet: Moments in the overview picture, from the first to the last.
        ground: Height of a floor that is only drawn [m]: "auto" takes that of a static level plane
            of the scene, or lies below everything; None leaves it out.
        camera: Where pictures are taken from.
    """

    size: Sequence[int] = (960, 720)
    fps: float | None = None
    video: Literal["mp4", "gif", "none"] = "mp4"
    frames: bool = False
    sheet: int = 3
    ground: float | Literal["auto"] | None = "auto"
    camera: Camera = Camera()


@dataclass(frozen=True, eq=False)
class Paint:
    """Colors of a surface as "#rrggbb"; None takes one of the palette.

    Attributes:
        color: Of the front, or of a body.
        back_color: Of the back of a cloth.
    """

    color: str | None = None
    back_color: str | None = None


@dataclass(frozen=True, eq=False)
class Goal:
    """A shape to reach.

    Attributes:
        vertices: Positions [m], shape [n, 3].
        faces: Vertex indices, shape [f, 3].
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]


def marker(position: NDArray[np.float64], radius: float) -> Goal:
    """Mark a point to reach, of shape [3], by a small sphere [m]."""
    vertices, faces = shapes.sphere(radius, _MARKER_SUBDIVISIONS)
    return Goal(vertices + position, faces.astype(np.int32))
