"""The schema of shapes and poses in configurations."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Len, Lt
from pydantic import model_validator

from diffcloth_torch.config.section import (
    Lengths2,
    Lengths3,
    NonNegative,
    Positive,
    Section,
    Vector3,
)

__all__ = [
    "Box",
    "Capsule",
    "Chair",
    "ClothFile",
    "Cylinder",
    "Disk",
    "Grid",
    "MeshFile",
    "PinKeyframe",
    "Plane",
    "PoseKeyframe",
    "PoseSection",
    "RotationSection",
    "Sphere",
    "Strip",
]


class RotationSection(Section):
    """A rotation: `degrees` about `axis`, or a `quaternion` (w, x, y, z); none by default."""

    axis: Vector3 | None = None
    degrees: float | None = None
    quaternion: Annotated[list[float], Len(4, 4)] | None = None

    @model_validator(mode="after")
    def _check_rotation(self) -> RotationSection:
        if (self.axis is None) != (self.degrees is None):
            raise ValueError("must give `axis` and `degrees` together")
        if self.axis is not None and self.quaternion is not None:
            raise ValueError("must give `axis` and `degrees`, or `quaternion`, not both")
        for name in ("axis", "quaternion"):
            value = getattr(self, name)
            if value is not None and not any(value):
                raise ValueError(f"must have an `{name}` that is not zero")
        return self


class PoseSection(RotationSection):
    """A pose: a rotation about the origin, then a translation to `position` [m]."""

    position: Vector3 = [0.0, 0.0, 0.0]


class PoseKeyframe(PoseSection):
    """Pose of a body at a time [s]."""

    time: NonNegative


class PinKeyframe(RotationSection):
    """Motion of pins at a time [s], relative to their start.

    A rotation about the mean of their starting positions, then a translation by `displacement` [m].
    """

    time: NonNegative
    displacement: Vector3 = [0.0, 0.0, 0.0]


class MeshFile(Section):
    """A mesh file; `scale` is meters per unit of the file."""

    kind: Literal["load"]
    path: str
    scale: Positive = 1.0


class ClothFile(MeshFile):
    """A mesh file of a cloth, and optionally another one of its stress-free shape.

    With "uv" the texture of the file is the stress-free shape, at `rest_scale` meters per unit.
    """

    rest: str | None = None
    rest_scale: Positive | None = None

    @model_validator(mode="after")
    def _check_rest(self) -> ClothFile:
        if (self.rest == "uv") != (self.rest_scale is not None):
            raise ValueError("must give `rest_scale` with `rest: uv`, and only with it")
        return self


class Grid(Section):
    """Rectangle in the xy-plane with `rows` x `columns` vertices; columns run along x."""

    kind: Literal["grid"]
    rows: Annotated[int, Ge(2)]
    columns: Annotated[int, Ge(2)]
    size: Lengths2 = 1.0


class Disk(Section):
    """Round sheet in the xy-plane on an unstructured mesh with edges of about `edge_length` [m].

    It may start with `folds`, waves along the rim of a height of `fold_height` [m].
    """

    kind: Literal["disk"]
    radius: Positive
    edge_length: Positive
    folds: Annotated[int, Ge(0)] = 0
    fold_height: NonNegative = 0.01


class Strip(Section):
    """Strip along x, bent downwards by `bend` degrees about an axis along y, at the origin.

    Its `width` [m] is one number, or one for each of its two ends. The middle of the bend is at the
    fraction `middle` of its length.
    """

    kind: Literal["strip"]
    length: Positive
    width: Lengths2
    rows: Annotated[int, Ge(2)]
    columns: Annotated[int, Ge(2)]
    bend: Annotated[float, Ge(0), Le(180)] = 0.0
    radius: Positive = 0.1
    middle: Annotated[float, Gt(0), Lt(1)] = 0.5


class Box(Section):
    """Cuboid with sides of `size` [m]."""

    kind: Literal["box"]
    size: Lengths3


class Sphere(Section):
    """Sphere."""

    kind: Literal["sphere"]
    radius: Positive
    subdivisions: Annotated[int, Ge(0), Le(6)] = 3
    smooth: bool = False


class Capsule(Section):
    """Cylinder along z of `length` [m] with half spheres on its ends."""

    kind: Literal["capsule"]
    radius: Positive
    length: Positive
    smooth: bool = False


class Cylinder(Section):
    """Cylinder along z of `length` [m]."""

    kind: Literal["cylinder"]
    radius: Positive
    length: Positive
    rings: Annotated[int, Ge(1), Le(100)] = 5


class Plane(Section):
    """Rectangle at z = 0 that faces up."""

    kind: Literal["plane"]
    size: Lengths2


class Chair(Section):
    """Chair that stands on z = 0 and faces -y; lengths in meters, `height` of the seat."""

    kind: Literal["chair"]
    width: Positive = 0.44
    depth: Positive = 0.44
    height: Positive = 0.46
    back_height: Positive = 0.42
    thickness: Positive = 0.04
    edge_length: Positive = 0.12
