"""Bodies with a surface without facets: their skeletons, and their mass properties.

A sphere is the set of points within its radius of a point, a capsule within its radius of a
segment. The core only has this skeleton: objects that touch the body are at the radius' distance
from the skeleton.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from diffcloth_torch.checks import FloatArray, IndexArray, frozen
from diffcloth_torch.saved import saved

__all__ = ["ContactSurface", "Primitive", "round_solid", "round_surface"]


@saved
class Primitive(NamedTuple):
    """An analytic surface around the origin of a body's frame.

    Attributes:
        kind: "plane" (z = 0, the solid below), "sphere", "capsule" (along z) or "box".
        size: Size [m], padded with zeros: nothing for a plane; the radius of a sphere; the radius
            and half the length of the cylinder of a capsule; half the lengths of a box.
    """

    kind: str
    size: tuple[float, float, float]


@saved
class ContactSurface(NamedTuple):
    """Contact surface of a body: a mesh, or a skeleton with a radius.

    Attributes:
        vertices: Vertices of the mesh, or four points of a skeleton that do not lie in one plane:
            its ends, then points that define its orientation [m], shape [v, 3].
        faces: Faces of the mesh; [[0, 0, 0]] for a point, [[0, 1, 1]] for a segment.
        radius: Radius around the skeleton [m]; 0 for a mesh.
    """

    vertices: FloatArray
    faces: IndexArray
    radius: float


def round_surface(primitive: Primitive) -> ContactSurface:
    """The skeleton of a sphere or a capsule."""
    r, half, _ = primitive.size
    ends, face = [(0.0, 0.0, 0.0), (0.0, 0.0, r)], [0, 0, 0]
    if primitive.kind == "capsule":
        ends, face = [(0.0, 0.0, -half), (0.0, 0.0, half)], [0, 1, 1]
    vertices = np.array([*ends, (r, 0.0, 0.0), (0.0, r, 0.0)])
    return ContactSurface(frozen(vertices), np.array([face], dtype=np.int32), r)


def round_solid(primitive: Primitive) -> tuple[float, FloatArray, FloatArray]:
    """Volume, center and inertia of a sphere or a capsule for a density of one."""
    r, half, _ = primitive.size
    ball = 4.0 / 3.0 * math.pi * r**3
    tube = math.pi * r**2 * 2.0 * half
    share = tube / (ball + tube)  # of the cylinder in the mass
    along = share * r**2 / 2 + (1 - share) * 2 / 5 * r**2
    # Half a ball has its center 3/8 r from its flat side.
    across = share * (r**2 / 4 + half**2 / 3) + (1 - share) * (
        2 / 5 * r**2 + half**2 + 3 / 4 * r * half
    )
    volume = ball + tube
    return volume, np.zeros(3), volume * np.diag([across, across, along])
