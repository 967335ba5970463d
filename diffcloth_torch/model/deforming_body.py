"""A body whose deformation is prescribed: a control sets the motion of its vertices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from diffcloth_torch.checks import ArrayLike, FloatArray
from diffcloth_torch.geometry.loaded import load_mesh
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.quantities import check_parameter
from diffcloth_torch.saved import saved

__all__ = ["DeformingBody"]

_POSITIONS = "differentiate with respect to Control.body_vertices"


@saved
class DeformingBody(Cloth):
    """A triangle mesh whose vertices follow `Control.body_vertices`; immutable.

    An example is a character that a skeleton moves. The body is a surface like a pinned cloth,
    without mass and without elasticity: cloths collide with it and slide over its moving surface.
    It does not collide with itself, with other deforming bodies or with bodies and robots whose
    motion is prescribed. Its vertices follow the cloths' vertices in `State.positions`.

    Attributes:
        vertices: Initial positions [m], shape [n, 3].
        faces: Vertex indices, shape [f, 3].
        material: Friction coefficient and thickness of the surface.
        name: Name in the scene; None means a name chosen by the scene.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        friction: float = 0.4,
        thickness: float = 0.0,
        pose: ArrayLike | None = None,
        name: str | None = None,
    ) -> None:
        """Check and copy the arguments.

        Args:
            vertices: Initial positions [m], shape [n, 3]; each vertex belongs to a face.
            faces: Vertex indices of triangles, shape [f, 3]; at most two on an edge.
            friction: Friction coefficient [-], >= 0.
            thickness: Full thickness in contact [m], >= 0.
            pose: Pose [px, py, pz, qw, qx, qy, qz] that places `vertices`; the identity by default.
            name: Name in the scene.

        Raises:
            InvalidInput: If a shape, an index or a value is not accepted.
            TypeError: If an argument has a wrong type.
        """
        material = Material(
            friction=check_parameter("DeformingBody", "friction", friction),
            thickness=check_parameter("DeformingBody", "thickness", thickness),
        )
        # Hinges are the cheapest bending elements.
        super().__init__(
            vertices, faces, material=material, pose=pose, name=name, bending_model="hinge"
        )

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        scale: float = 1.0,
        triangulate: bool = False,
        weld: float | None = None,
        **keywords: Any,
    ) -> DeformingBody:
        """Read an .obj, .ply or .stl file.

        A mesh of more than 10 m or less than 1 mm gets a warning about `scale`.

        Args:
            path: Mesh file.
            scale: Meters per unit of the file, > 0.
            triangulate: Whether to cut polygons into triangles instead of refusing them.
            weld: Distance [m] up to which vertices are merged; None merges none.
                `file_vertices` has the vertex of the body for each vertex of the file.
            **keywords: As for `DeformingBody`.
        """
        mesh = load_mesh(
            "DeformingBody.load",
            path,
            scale=scale,
            triangulate=triangulate,
            weld=weld,
            instead=_POSITIONS,
        )
        body = cls(mesh.vertices, mesh.faces, **keywords)
        body.file_vertices = mesh.file_vertices
        return body

    def material_axes(self, owner: str) -> FloatArray:
        """Arbitrary directions, which no result depends on."""
        return np.tile([1.0, 0.0], (len(self.faces), 1))

    def __repr__(self) -> str:
        name = "" if self.name is None else f"{self.name!r}, "
        return f"DeformingBody({name}{len(self.vertices)} vertices, {len(self.faces)} faces)"
