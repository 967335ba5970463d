"""How what is drawn shall look: options of pictures, colors of surfaces, shapes to reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.geometry import shapes

__all__ = ["FORCE_COLOR", "GOAL_COLOR", "Camera", "Goal", "Paint", "Pictures", "marker"]

_FRONT_COLORS = ("#2a6f97", "#c8553d", "#5b7f4b", "#7d5a8c")
_BACK_COLORS = ("#f2c078", "#f3dcc0", "#e3dcae", "#e0cfe8")
# Any two of them, and each beside those of cloths, differ by more than 20 in CIELAB.
_BODY_COLORS = (
    *("#8d99ae", "#8c7864", "#a3c48c", "#d987a2", "#ac9c58"),
    *("#b59ad4", "#406c68", "#e0957c", "#6fcfcb", "#55aed6"),
)
GOAL_COLOR = "#2f9e78"
FORCE_COLOR = "#b3123f"
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
        sheet: Moments in the overview picture, from the first to the last; 0 leaves it out.
        labels: Whether the time and a legend are written.
        contact_forces: Whether arrows show the contact forces on the vertices of bodies and links
            (`State.body_forces`). They end where the forces act; the longest of the motion is a
            fifth of the size of the scene.
        ground: Height of a floor that is only drawn [m]: "auto" takes that of a static level plane
            of the scene, or lies below everything; None leaves it out.
        camera: Where pictures are taken from.
    """

    size: Sequence[int] = (960, 720)
    fps: float | None = None
    video: Literal["mp4", "gif", "none"] = "mp4"
    frames: bool = False
    sheet: int = 5
    labels: bool = True
    contact_forces: bool = False
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

    def for_cloth(self, index: int) -> Paint:
        """Take what is None from the palette of cloths."""
        return Paint(
            self.color or _FRONT_COLORS[index % len(_FRONT_COLORS)],
            self.back_color or _BACK_COLORS[index % len(_BACK_COLORS)],
        )

    def for_body(self, index: int) -> Paint:
        """Take what is None from the palette of bodies and robots."""
        return Paint(self.color or _BODY_COLORS[index % len(_BODY_COLORS)])


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
