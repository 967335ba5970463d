"""The look of pictures: options, camera, colors of surfaces, target shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import (
    ANY_NUMBER,
    POSITIVE,
    FloatArray,
    Range,
    check_finite,
    check_number,
    check_shape,
    float_array,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry import shapes

__all__ = [
    "FORCE_COLOR",
    "GOAL_COLOR",
    "Camera",
    "Goal",
    "Paint",
    "Pictures",
    "checked_camera",
    "marker",
]

_FRONT_COLORS = ("#2a6f97", "#c8553d", "#5b7f4b", "#7d5a8c")
_BACK_COLORS = ("#f2c078", "#f3dcc0", "#e3dcae", "#e0cfe8")
# All pairs of these, and of these with colors of cloths, differ by more than 20 in CIELAB.
_BODY_COLORS = (
    *("#8d99ae", "#8c7864", "#a3c48c", "#d987a2", "#ac9c58"),
    *("#b59ad4", "#406c68", "#e0957c", "#6fcfcb", "#55aed6"),
)
GOAL_COLOR = "#2f9e78"
FORCE_COLOR = "#b3123f"
_MARKER_SUBDIVISIONS = 2


_ACCEPTED = {
    "azimuth": ANY_NUMBER,
    "elevation": Range(-90.0, 90.0),
    "zoom": POSITIVE,
    "distance": POSITIVE,
    "field_of_view": Range(0.0, 180.0),
}


@dataclass(frozen=True, eq=False)
class Camera:
    """The camera of pictures; values of None are derived from the motion.

    Set a position, or directions in degrees that determine it.

    Attributes:
        azimuth: Direction of view in degrees: 0 looks along +y, 90 along -x.
        elevation: Height above the horizon in degrees, between -90 and 90.
        zoom: Divisor of the distance, > 0.
        target: Point at the center of the picture [m], shape [3].
        distance: Distance from the target, before the zoom [m], > 0.
        position: Position of the camera [m], shape [3]; if given, all of the above except `target`
            are ignored.
        up: Upward direction in the picture, shape [3].
        field_of_view: Vertical angle of the picture in degrees, between 0 and 180.
    """

    azimuth: float = 35.0
    elevation: float = 18.0
    zoom: float = 1.0
    target: Sequence[float] | None = None
    distance: float | None = None
    position: Sequence[float] | None = None
    up: Sequence[float] = (0.0, 0.0, 1.0)
    field_of_view: float = 26.0  # a lens long enough to avoid visible distortion

    def __post_init__(self) -> None:
        for name in ("target", "position", "up"):
            value = getattr(self, name)
            if value is not None:
                point = float_array(f"Camera: `{name}`", value)
                check_shape(f"Camera: `{name}`", point.shape, [(3,)])
                check_finite(f"Camera: `{name}`", point)
        for name, accepted in _ACCEPTED.items():
            value = getattr(self, name)
            if value is not None:
                check_number(f"Camera: `{name}`", value, accepted)
        if not np.any(np.asarray(self.up)):
            raise InvalidInput("Camera: `up` must be a direction, got zeros")
        if self.position is not None and self.target is not None:
            view = np.asarray(self.target, float) - np.asarray(self.position, float)
            self._check_view(view)

    def place(self, center: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
        """Compute the position of the camera and the point at which it looks [m].

        Args:
            center: Center of the scene [m].
            radius: Radius of a ball around the scene [m].

        Raises:
            InvalidInput: If it looks along `up`, or its position is the point at which it looks.
        """
        target = center if self.target is None else np.array(self.target, dtype=np.float64)
        if self.position is not None:
            position = np.array(self.position, dtype=np.float64)
            self._check_view(target - position)
            return position, target
        fitting = radius / np.sin(np.radians(self.field_of_view / 2))
        distance = (fitting if self.distance is None else self.distance) / self.zoom
        azimuth, elevation = np.radians(self.azimuth), np.radians(self.elevation)
        towards = np.array(
            [
                np.sin(azimuth) * np.cos(elevation),
                -np.cos(azimuth) * np.cos(elevation),
                np.sin(elevation),
            ]
        )
        return target + distance * towards, target

    def _check_view(self, view: FloatArray) -> None:
        if not np.linalg.norm(np.cross(view, self.up)) > 1e-9 * np.linalg.norm(view) * (
            np.linalg.norm(self.up)
        ):
            raise InvalidInput(
                "Camera: `position` must be apart from `target`, and not in the direction of `up` "
                f"from there, got a view along {view.tolist()}"
            )


@dataclass(frozen=True, eq=False)
class Pictures:
    """Options of pictures and of the animation.

    Attributes:
        size: Width and height [pixels], even numbers.
        fps: Pictures per second; None: real time.
        video: Kind of the animation.
        frames: If true, every picture of the animation is kept.
        sheet: Number of moments in the overview, from the first to the last; 0 for no overview.
        labels: If true, pictures show the time and a legend.
        contact_forces: If true, arrows show the contact forces on the vertices of bodies and links
            (`State.body_forces`). They end at the points of action; the longest arrow of the motion
            is a fifth of the size of the scene.
        ground: Height of a floor that is only drawn [m]: "auto" means the height of a static level
            plane of the scene, or else below all surfaces; None means no floor.
        camera: The camera.
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
    """Colors of a surface as "#rrggbb"; None means a color of the palette.

    Attributes:
        color: Color of the front of a cloth, or of a body.
        back_color: Color of the back of a cloth.
    """

    color: str | None = None
    back_color: str | None = None

    def for_cloth(self, index: int) -> Paint:
        """Replace None by colors of the palette of cloths."""
        return Paint(
            self.color or _FRONT_COLORS[index % len(_FRONT_COLORS)],
            self.back_color or _BACK_COLORS[index % len(_BACK_COLORS)],
        )

    def for_body(self, index: int) -> Paint:
        """Replace None by a color of the palette of bodies and robots."""
        return Paint(self.color or _BODY_COLORS[index % len(_BODY_COLORS)])


@dataclass(frozen=True, eq=False)
class Goal:
    """A target shape.

    Attributes:
        vertices: Positions [m], shape [n, 3].
        faces: Vertex indices, shape [f, 3].
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]


def checked_camera(owner: str, camera: Camera | None) -> Camera:
    """Return the camera, or the default camera for None."""
    given: object = camera
    if given is not None and not isinstance(given, Camera):
        raise TypeError(f"{owner}: `camera` must be a Camera or None, got {type(given).__name__}")
    return Camera() if camera is None else camera


def marker(position: NDArray[np.float64], radius: float) -> Goal:
    """Mark a target point [m], of shape [3], by a small sphere."""
    vertices, faces = shapes.sphere(radius, _MARKER_SUBDIVISIONS)
    return Goal(vertices + position, faces.astype(np.int32))
