"""A rigid obstacle: a triangle mesh that stands still or moves on prescribed poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from diffcloth_torch.checks import (
    POSITIVE,
    FloatArray,
    IndexArray,
    check_choice,
    check_count,
    check_name,
    check_number,
    check_range,
    check_shape,
    float_array,
    frozen,
)
from diffcloth_torch.geometry import shapes
from diffcloth_torch.geometry.meshes import read_mesh
from diffcloth_torch.geometry.poses import pose_array
from diffcloth_torch.geometry.surfaces import surface_arrays
from diffcloth_torch.model.cloth import plane_size
from diffcloth_torch.model.quantities import check_parameter

__all__ = ["MOTIONS", "RigidBody"]

MOTIONS = ("static", "kinematic")

_POSES = "differentiate with respect to State.body_poses or Control.body_poses"


class RigidBody:
    """A rigid triangle mesh; immutable.

    Attributes:
        vertices: Positions in the body frame [m], shape [v, 3].
        faces: Vertex indices, shape [g, 3].
        motion: "static", or "kinematic" (moves on prescribed poses).
        pose: Initial pose [px, py, pz, qw, qx, qy, qz], shape [7].
        friction: Friction coefficient of the surface [-].
        thickness: Full thickness of the surface in contact [m].
        name: Name in the scene; None lets the scene choose one.
    """

    vertices: FloatArray
    faces: IndexArray
    motion: str
    pose: FloatArray
    friction: float
    thickness: float
    name: str | None

    def __init__(
        self,
        vertices: object,
        faces: object,
        *,
        motion: str = "static",
        pose: object = None,
        friction: float = 0.4,
        thickness: float = 0.0,
        name: str | None = None,
    ) -> None:
        """Check and copy the arguments.

        Args:
            vertices: Positions in the body frame [m], shape [v, 3].
            faces: Vertex indices of triangles, shape [g, 3].
            motion: "static" or "kinematic".
            pose: Initial pose [px, py, pz, qw, qx, qy, qz]; the identity by default.
            friction: Friction coefficient [-], >= 0.
            thickness: Full thickness [m], >= 0.
            name: Name in the scene.

        Raises:
            InvalidInput: If a shape, an index or a value is not accepted.
            TypeError: If something has a wrong type.
        """
        self.vertices, self.faces = surface_arrays("RigidBody", vertices, faces, instead=_POSES)
        self.motion = check_choice("RigidBody: `motion`", motion, MOTIONS)
        self.pose = frozen(pose_array("RigidBody: `pose`", pose, instead=_POSES))
        self.friction = check_parameter("RigidBody", "friction", friction)
        self.thickness = check_parameter("RigidBody", "thickness", thickness)
        self.name = check_name("RigidBody: `name`", name)

    @classmethod
    def load(cls, path: str | Path, *, scale: float = 1.0, **keywords: Any) -> RigidBody:
        """Read an .obj, .ply or .stl file of triangles.

        Args:
            path: Mesh file; its coordinates are the body frame.
            scale: Meters per unit of the file, > 0.
            **keywords: As for `RigidBody`.
        """
        vertices, faces = read_mesh(path)
        factor = check_number("RigidBody.load: `scale`", scale, POSITIVE, instead=_POSES)
        return cls(factor * vertices, faces, **keywords)

    @classmethod
    def box(cls, size: object, **keywords: Any) -> RigidBody:
        """Make a cuboid centered at the origin.

        Args:
            size: Lengths along x, y and z [m], or one length for all.
            **keywords: As for `RigidBody`.
        """
        lengths = float_array("RigidBody.box: `size`", size)
        check_shape("RigidBody.box: `size`", lengths.shape, [(), (3,)])
        check_range("RigidBody.box: `size`", lengths, POSITIVE)
        return cls(*shapes.box(np.broadcast_to(lengths, 3)), **keywords)

    @classmethod
    def sphere(cls, radius: float, *, subdivisions: int = 3, **keywords: Any) -> RigidBody:
        """Make a subdivided icosahedron with its vertices on a sphere around the origin.

        Args:
            radius: Radius of the sphere [m], > 0.
            subdivisions: Times that each triangle is split in four, >= 0; 3 gives 1280 triangles.
            **keywords: As for `RigidBody`.
        """
        length = check_number("RigidBody.sphere: `radius`", radius, POSITIVE, instead=_POSES)
        check_count("RigidBody.sphere: `subdivisions`", subdivisions, 0)
        return cls(*shapes.sphere(length, subdivisions), **keywords)

    @classmethod
    def capsule(cls, radius: float, length: float, **keywords: Any) -> RigidBody:
        """Make a cylinder along z, centered at the origin, with half spheres on its ends.

        Args:
            radius: Radius of the cylinder and the half spheres [m], > 0.
            length: Length of the cylinder alone [m], > 0; the capsule is 2 radius longer.
            **keywords: As for `RigidBody`.
        """
        name = "RigidBody.capsule: `{}`"
        r = check_number(name.format("radius"), radius, POSITIVE, instead=_POSES)
        h = check_number(name.format("length"), length, POSITIVE, instead=_POSES)
        return cls(*shapes.capsule(r, h), **keywords)

    @classmethod
    def plane(cls, size: object, **keywords: Any) -> RigidBody:
        """Make a rectangle of two triangles at z = 0 that faces up, centered at the origin.

        Args:
            size: Lengths along x and y [m], or one length for both.
            **keywords: As for `RigidBody`.
        """
        return cls(*shapes.plane(plane_size("RigidBody.plane: `size`", size)), **keywords)

    def __repr__(self) -> str:
        return f"RigidBody({self.name!r}, {self.motion}, {len(self.faces)} faces)"
