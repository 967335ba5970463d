"""A scene: cloths, bodies and gravity, and their arrays one after the other in scene order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from diffcloth_torch.checks import (
    FloatArray,
    IndexArray,
    check_finite,
    check_shape,
    float_array,
    frozen,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.rigid_body import RigidBody

__all__ = ["Assembly", "Scene", "assemble"]


class _Surface(Protocol):
    @property
    def vertices(self) -> FloatArray: ...
    @property
    def faces(self) -> IndexArray: ...


S = TypeVar("S")


class Scene:
    """What is simulated; immutable.

    Attributes:
        cloths: At least one.
        bodies: Obstacles.
        gravity: Acceleration [m/s^2], shape [3].
        cloth_names: Names of the cloths; "cloth0", "cloth1" .. where none was given.
        body_names: Names of the bodies; "body0", "body1" .. where none was given.
    """

    cloths: tuple[Cloth, ...]
    bodies: tuple[RigidBody, ...]
    gravity: FloatArray
    cloth_names: tuple[str, ...]
    body_names: tuple[str, ...]

    def __init__(
        self,
        cloths: Iterable[Cloth],
        bodies: Iterable[RigidBody] = (),
        *,
        gravity: object = (0.0, 0.0, -9.81),
    ) -> None:
        """Check the arguments.

        Args:
            cloths: At least one cloth.
            bodies: Bodies, in the order of `body_poses`.
            gravity: Acceleration [m/s^2], shape [3].

        Raises:
            InvalidInput: If there is no cloth, or a name occurs twice.
            TypeError: If something is not a Cloth or a RigidBody.
        """
        self.cloths = _instances("cloths", cloths, Cloth)
        self.bodies = _instances("bodies", bodies, RigidBody)
        if not self.cloths:
            raise InvalidInput("Scene: `cloths` must hold at least one Cloth")
        self.cloth_names = tuple(c.name or f"cloth{i}" for i, c in enumerate(self.cloths))
        self.body_names = tuple(b.name or f"body{i}" for i, b in enumerate(self.bodies))
        _check_unique([*self.cloth_names, *self.body_names])
        instead = "differentiate with respect to Parameters.gravity"
        acceleration = float_array("Scene: `gravity`", gravity, instead=instead)
        check_shape("Scene: `gravity`", acceleration.shape, [(3,)])
        check_finite("Scene: `gravity`", acceleration)
        frozen(acceleration)
        self.gravity = acceleration

    def __repr__(self) -> str:
        return f"Scene(cloths={list(self.cloths)}, bodies={list(self.bodies)})"


def _instances(field: str, given: Iterable[object], kind: type[S]) -> tuple[S, ...]:
    if not isinstance(given, Iterable):
        raise TypeError(f"Scene: `{field}` must be a list of {kind.__name__}")
    items = []
    for i, item in enumerate(given):
        if not isinstance(item, kind):
            raise TypeError(
                f"Scene: `{field}` must hold {kind.__name__} objects, "
                f"got {type(item).__name__} at [{i}]"
            )
        items.append(item)
    return tuple(items)


def _check_unique(names: Sequence[str]) -> None:
    for i, name in enumerate(names):
        if name in names[:i]:
            raise InvalidInput(f"Scene: `name` must differ between surfaces, got {name!r} twice")


@dataclass(frozen=True, eq=False)
class Assembly:
    """The arrays of a scene: vertices, faces and pins of all cloths, then of all bodies.

    Attributes:
        vertices: Initial cloth positions [m], shape [N, 3].
        rest_vertices: Stress-free cloth positions [m], shape [N, 3].
        faces: Cloth faces, indices into `vertices`, shape [F, 3].
        cloth_vertex_start: First vertex of each cloth, and N; shape [C + 1].
        cloth_face_start: First face of each cloth, and F; shape [C + 1].
        pins: Pinned vertices, shape [P].
        soft_pins: Softly pinned vertices, shape [Q].
        pin_groups: "cloth/pin" -> rows of `pins`.
        soft_pin_groups: "cloth/pin" -> rows of `soft_pins`.
        body_vertices: In the body frames [m], shape [V, 3].
        body_faces: Indices into `body_vertices`, shape [G, 3].
        body_vertex_start: First vertex of each body, and V; shape [K + 1].
        body_face_start: First face of each body, and G; shape [K + 1].
        body_poses: Initial poses, shape [K, 7].
        static_bodies: Indices of the bodies that must not move.
    """

    vertices: FloatArray
    rest_vertices: FloatArray
    faces: IndexArray
    cloth_vertex_start: IndexArray
    cloth_face_start: IndexArray
    pins: IndexArray
    soft_pins: IndexArray
    pin_groups: Mapping[str, slice]
    soft_pin_groups: Mapping[str, slice]
    body_vertices: FloatArray
    body_faces: IndexArray
    body_vertex_start: IndexArray
    body_face_start: IndexArray
    body_poses: FloatArray
    static_bodies: tuple[int, ...]

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes by the letters that the tables of quantities have for them."""
        return {
            "N": len(self.vertices),
            "F": len(self.faces),
            "C": self.cloth_count,
            "K": self.body_count,
            "V": len(self.body_vertices),
            "S": self.surface_count,
            "P": len(self.pins),
            "Q": len(self.soft_pins),
        }

    @property
    def cloth_count(self) -> int:
        """Number of cloths, C."""
        return len(self.cloth_vertex_start) - 1

    @property
    def body_count(self) -> int:
        """Number of bodies, K."""
        return len(self.body_poses)

    @property
    def surface_count(self) -> int:
        """Number of surfaces, S = C + K."""
        return self.cloth_count + self.body_count


def assemble(scene: Scene) -> Assembly:
    """Concatenate the arrays of a scene."""
    vertices, faces, vertex_start, face_start = _concatenate(scene.cloths)
    body_vertices, body_faces, body_vertex_start, body_face_start = _concatenate(scene.bodies)
    pins, pin_groups = _concatenate_pins(scene, "pins", vertex_start)
    soft_pins, soft_pin_groups = _concatenate_pins(scene, "soft_pins", vertex_start)
    return Assembly(
        vertices=vertices,
        rest_vertices=np.concatenate([cloth.rest_vertices for cloth in scene.cloths]),
        faces=faces,
        cloth_vertex_start=vertex_start,
        cloth_face_start=face_start,
        pins=pins,
        soft_pins=soft_pins,
        pin_groups=pin_groups,
        soft_pin_groups=soft_pin_groups,
        body_vertices=body_vertices,
        body_faces=body_faces,
        body_vertex_start=body_vertex_start,
        body_face_start=body_face_start,
        body_poses=np.array([body.pose for body in scene.bodies]).reshape(-1, 7),
        static_bodies=tuple(k for k, body in enumerate(scene.bodies) if body.motion == "static"),
    )


def _concatenate(
    surfaces: Sequence[_Surface],
) -> tuple[FloatArray, IndexArray, IndexArray, IndexArray]:
    vertex_start = np.cumsum([0] + [len(s.vertices) for s in surfaces], dtype=np.int32)
    face_start = np.cumsum([0] + [len(s.faces) for s in surfaces], dtype=np.int32)
    vertices = np.concatenate([np.empty((0, 3)), *(s.vertices for s in surfaces)])
    shifted = [s.faces + start for s, start in zip(surfaces, vertex_start, strict=False)]
    faces = np.concatenate([np.empty((0, 3), dtype=np.int32), *shifted]).astype(np.int32)
    return vertices, faces, vertex_start, face_start


def _concatenate_pins(
    scene: Scene, kind: str, vertex_start: IndexArray
) -> tuple[IndexArray, dict[str, slice]]:
    """Pins in cloth order, then dict order, then list order."""
    indices = [np.empty(0, dtype=np.int32)]
    groups = {}
    row = 0
    for cloth, name, start in zip(scene.cloths, scene.cloth_names, vertex_start, strict=False):
        for pin, vertices in getattr(cloth, kind).items():
            indices.append(vertices + start)
            groups[f"{name}/{pin}"] = slice(row, row + len(vertices))
            row += len(vertices)
    return np.concatenate(indices).astype(np.int32), groups
