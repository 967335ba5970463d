"""Collision shapes of a robot's links as surfaces: boxes, cylinders, spheres and mesh files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray, check_finite
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry import shapes
from diffcloth_torch.geometry.mesh_checks import Surface, surface_arrays
from diffcloth_torch.geometry.meshes import read_mesh
from diffcloth_torch.model.urdf import Link, Shape

__all__ = ["find_mesh", "link_surface"]

# An edge length that gives a box, cylinder or sphere more triangles is taken for a mistake.
_MOST_FACES = 200_000

_DEFAULT_SUBDIVISIONS = 3  # of a sphere, as for `RigidBody.sphere`

_DETACHED = "pass a detached tensor"


def link_surface(
    link: Link, file: Path, mesh_root: Path, edge_length: float | None
) -> Surface | None:
    """Surface of all collision shapes of a link in its frame, or None without shapes.

    Args:
        link: The link.
        file: URDF file of the link.
        mesh_root: Folder that mesh files must lie in.
        edge_length: Longest edge of boxes, cylinders and spheres [m]; None lets the shape choose.
    """
    if not link.shapes:
        return None
    owner = f"{file}: <link name={link.name!r}> <collision>"
    parts = [_placed(owner, shape, file, mesh_root, edge_length) for shape in link.shapes]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    vertices = np.concatenate([part.vertices for part in parts])
    return Surface(*surface_arrays(owner, vertices, np.concatenate(faces), instead=_DETACHED))


def _placed(
    owner: str, shape: Shape, file: Path, mesh_root: Path, edge_length: float | None
) -> Surface:
    if shape.kind == "mesh":
        path = find_mesh(owner, shape.filename, file, mesh_root)
        owner = str(path)
        vertices, faces = read_mesh(path)
        check_finite(f"{owner}: `vertices`", vertices)
        scale = np.array(shape.size)
        if not scale.all():
            raise InvalidInput(f"{owner}: `scale` must be different from zero, got {shape.size}")
        vertices = scale * vertices
        if scale.prod() < 0:  # a mirror image, whose faces look inward
            faces = faces[:, ::-1]
    else:
        vertices, faces = _generated(owner, shape, edge_length)
    placed = vertices @ shape.frame[:3, :3].T + shape.frame[:3, 3]
    return Surface(*surface_arrays(owner, placed, faces, instead=_DETACHED))


def _generated(owner: str, shape: Shape, edge_length: float | None) -> shapes.Mesh:
    """Mesh of a box, sphere or cylinder around its own origin."""
    if edge_length is None:
        if shape.kind == "box":
            return shapes.box(np.array(shape.size))
        if shape.kind == "sphere":
            return shapes.sphere(shape.size[0], _DEFAULT_SUBDIVISIONS)
        return shapes.cylinder(shape.size[0], shape.size[1])
    too_many = InvalidInput(
        f"{owner}: `edge_length` must leave a {shape.kind} of size {shape.size} m at most "
        f"{_MOST_FACES} triangles, got {edge_length:g} m"
    )
    if shape.kind == "sphere":
        for level in range(int(math.log(_MOST_FACES / 20, 4)) + 1):
            vertices, faces = shapes.sphere(shape.size[0], level)
            if _longest_edge(vertices, faces) <= edge_length:
                return vertices, faces
        raise too_many
    # Both sides of a triangle are cut to edge_length / sqrt(2), so that its diagonal fits too.
    cut = math.sqrt(2) / edge_length
    if shape.kind == "box":
        segments = np.ceil(cut * np.array(shape.size))
        if 4 * (segments * np.roll(segments, 1)).sum() > _MOST_FACES:
            raise too_many
        return shapes.box(np.array(shape.size), segments.astype(int).tolist())
    radius, length = shape.size
    # Of 6 n segments around, each is below 2 pi r / (6 n); edges on the ends are below 1.2 r / n.
    rings = max(1.0, np.ceil(cut * radius * math.pi / 3))
    rows = np.ceil(cut * length)
    if 12 * rings * (rings + rows) > _MOST_FACES:
        raise too_many
    return shapes.cylinder(radius, length, int(rings), int(rows))


def _longest_edge(vertices: FloatArray, faces: NDArray[np.int64]) -> float:
    corners = vertices[faces]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max())


def find_mesh(owner: str, filename: str, file: Path, mesh_root: Path) -> Path:
    """Path of a mesh file that a URDF file names.

    "package://name/x" means x or name/x in `mesh_root`; any other path is relative to the file's
    folder. Symbolic links are resolved before the path is checked to lie in `mesh_root`.

    Args:
        owner: Opens the message.
        filename: As written in the file.
        file: URDF file that names it.
        mesh_root: Folder that mesh files must lie in.

    Raises:
        InvalidInput: If there is no such file in `mesh_root`.
    """
    scheme, separator, rest = filename.partition("://")
    if not separator:
        candidates = [file.parent / filename]
    elif scheme == "package":
        candidates = [mesh_root / rest.partition("/")[2], mesh_root / rest]
    else:
        raise InvalidInput(
            f"{owner}: `filename` must be a path or start with package://, got {filename!r}"
        )
    root = mesh_root.resolve()
    try:
        paths = [candidate.resolve() for candidate in candidates]
        outside = [path for path in paths if not path.is_relative_to(root)]
        found = [path for path in paths if path.is_file()]
    except (OSError, RuntimeError) as error:  # names too long; links in circles
        raise InvalidInput(f"{owner}: `filename` {filename!r} cannot be found: {error}") from error
    if outside:
        raise InvalidInput(
            f"{owner}: `filename` must stay inside `mesh_root`, {root}, got {filename!r}, "
            f"which is {outside[0]}"
        )
    if not found:
        raise InvalidInput(
            f"{owner}: `filename` must be a file, got {filename!r}: there is no "
            f"{' nor '.join(map(str, paths))}; `mesh_root` says where packages are"
        )
    return found[0]
