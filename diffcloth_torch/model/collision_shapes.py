"""Collision shapes of a robot's links as surfaces: boxes, round shapes, cylinders and mesh files.

A sphere or a capsule may touch with its exact surface. A surface is either round or triangles, so
a round shape beside other shapes of a link becomes a link of its own, welded to the first.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray, check_bool, check_finite, frozen, texts
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry import shapes
from diffcloth_torch.geometry.mesh_checks import Surface, body_arrays, surface_arrays
from diffcloth_torch.geometry.meshes import read_body_mesh
from diffcloth_torch.model.refusals import Refusals
from diffcloth_torch.model.round_bodies import ContactSurface, Primitive, round_surface
from diffcloth_torch.model.urdf import Joint, Link, RobotDescription, Shape

__all__ = ["RoundLinks", "find_mesh", "link_surface", "with_round_links"]

# An edge length that results in more triangles for a shape is treated as a mistake.
_MOST_FACES = 200_000

_DEFAULT_SUBDIVISIONS = 3  # for spheres, as in `RigidBody.sphere`

_DETACHED = "pass a detached tensor"

T = TypeVar("T")


class RoundLinks(NamedTuple):
    """A robot whose links are round or have triangles, not both.

    Attributes:
        description: The robot, with an additional link for every round shape that was split off a
            link; the additional links are last.
        skeletons: Name of a round link -> its contact surface, in its frame.
        parts: Name of a link -> names of the links that were split off it.
    """

    description: RobotDescription
    skeletons: Mapping[str, ContactSurface]
    parts: Mapping[str, tuple[str, ...]]

    def with_parts(self, of_links: T) -> T | dict[str, Any]:
        """Apply the value of a link in a mapping to its parts too, unless these have their own."""
        if not isinstance(of_links, Mapping):
            return of_links
        of_parts = {p: value for link, value in of_links.items() for p in self.parts.get(link, ())}
        return of_parts | dict(of_links)

    def pairs_with_parts(self, pairs: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
        """Pairs of links, extended by all pairs of their parts."""
        return [
            (p, q)
            for a, b in pairs
            for p in (a, *self.parts.get(a, ()))
            for q in (b, *self.parts.get(b, ()))
        ]


def with_round_links(description: RobotDescription, smooth: object) -> RoundLinks:
    """Make spheres and capsules of a robot round.

    Args:
        description: The robot.
        smooth: True to make all of them round, or name of a link -> True to make its shapes round.

    Raises:
        InvalidInput: If there is no such link, or none of its shapes is a sphere or a capsule.
        TypeError: If `smooth` has a wrong type.
    """
    label = "Robot.load: `smooth`"
    names = [link.name for link in description.links]
    having = [link.name for link in description.links if any(map(_is_round, link.shapes))]
    if isinstance(smooth, Mapping):
        for name in smooth:
            if name not in names:
                raise InvalidInput(f"{label} has the names {texts(names)}; got {name!r}")
        wanted = {name for name, value in smooth.items() if check_bool(f"{label}[{name!r}]", value)}
        for name in sorted(wanted.difference(having)):
            raise InvalidInput(
                f"{label} is for links with a <sphere> or <capsule>, which are {texts(having)}; "
                f"got True for {name!r}"
            )
    else:
        wanted = set(having) if check_bool(label, smooth) else set()
        if smooth and not having:
            raise InvalidInput(
                f"{label} must be False where no link has a <sphere> or <capsule>, got True"
            )
    links: list[Link] = []
    further: list[Link] = []
    joints = list(description.joints)
    skeletons: dict[str, ContactSurface] = {}
    parts: dict[str, tuple[str, ...]] = {}
    for link in description.links:
        if link.name not in wanted:
            links.append(link)
            continue
        found = [(k, shape) for k, shape in enumerate(link.shapes) if _is_round(shape)]
        others = tuple(shape for shape in link.shapes if not _is_round(shape))
        if not others:  # the link itself becomes its first round shape
            skeletons[link.name] = _skeleton(found[0][1])
            others = (found.pop(0)[1],)
        links.append(replace(link, shapes=others))
        for k, shape in found:
            part = _part(link.name, k, shape)
            if part.name in names:
                raise InvalidInput(
                    f"{label} makes a link {part.name!r} of the round shape {k} of {link.name!r}, "
                    "and so the file must have none of this name; rename it"
                )
            skeletons[part.name] = _skeleton(shape)
            joints.append(_weld(link.name, part.name))
            further.append(part)
            parts[link.name] = (*parts.get(link.name, ()), part.name)
    whole = replace(description, links=(*links, *further), joints=tuple(joints))
    return RoundLinks(whole, skeletons, parts)


def _is_round(shape: Shape) -> bool:
    return shape.kind in ("sphere", "capsule")


def _skeleton(shape: Shape) -> ContactSurface:
    half = shape.size[1] / 2 if shape.kind == "capsule" else 0.0
    vertices, faces, radius = round_surface(Primitive(shape.kind, (shape.size[0], half, 0.0)))
    return ContactSurface(frozen(_in_link(shape, vertices)), faces, radius)


def _part(link: str, k: int, shape: Shape) -> Link:
    """A link for the round shape k of another one."""
    return Link(
        name=f"{link}/{k}",
        mass=0.0,
        center=np.zeros(3),
        inertia=np.zeros((3, 3)),
        shapes=(shape,),
    )


def _weld(parent: str, child: str) -> Joint:
    return Joint(
        name=child,
        type="fixed",
        parent=parent,
        child=child,
        frame=np.eye(4),
        axis=np.zeros(3),
        lower=-math.inf,
        upper=math.inf,
        viscosity=0.0,
        effort=math.inf,
        velocity=math.inf,
        friction=0.0,
        mimic=None,
    )


def link_surface(
    link: Link,
    file: Path,
    mesh_root: Path | None,
    edge_length: float | None,
    refusals: Refusals,
) -> Surface | None:
    """Surface of all collision shapes of a link in its frame, or None without shapes.

    Args:
        link: The link.
        file: URDF file of the link.
        mesh_root: As for `find_mesh`.
        edge_length: Longest edge of all shapes but meshes [m]; None uses defaults of the shapes.
        refusals: Collects the reasons against refused shapes, which are left out.
    """
    owner = f"{file}: <link name={link.name!r}> <collision>"
    parts = []
    for shape in link.shapes:
        with refusals.collected():
            parts.append(_placed(owner, shape, file, mesh_root, edge_length))
    if not parts:
        return None
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    vertices = np.concatenate([part.vertices for part in parts])
    return Surface(*surface_arrays(owner, vertices, np.concatenate(faces), instead=_DETACHED))


def _placed(
    owner: str, shape: Shape, file: Path, mesh_root: Path | None, edge_length: float | None
) -> Surface:
    if shape.kind != "mesh":
        vertices, faces = _generated(owner, shape, edge_length)
        placed = _in_link(shape, vertices)
        return Surface(*surface_arrays(owner, placed, faces, instead=_DETACHED))
    path = find_mesh(owner, shape.filename, file, mesh_root)
    vertices, faces, _ = read_body_mesh(path, f"{owner}: the mesh")
    owner = str(path)
    check_finite(f"{owner}: `vertices`", vertices)
    scale = np.array(shape.size)
    if not scale.all():
        raise InvalidInput(f"{owner}: `scale` must be different from zero, got {shape.size}")
    if scale.prod() < 0:  # a mirror image, whose faces point inward
        faces = faces[:, ::-1]
    surface = body_arrays(owner, _in_link(shape, scale * vertices), faces, instead=_DETACHED)
    return Surface(surface.vertices, surface.faces)


def _in_link(shape: Shape, vertices: FloatArray) -> FloatArray:
    return vertices @ shape.frame[:3, :3].T + shape.frame[:3, 3]


def _generated(owner: str, shape: Shape, edge_length: float | None) -> shapes.Mesh:
    """Mesh of a shape other than a mesh file, around its own origin."""
    if edge_length is None:
        if shape.kind == "box":
            return shapes.box(np.array(shape.size))
        if shape.kind == "sphere":
            return shapes.sphere(shape.size[0], _DEFAULT_SUBDIVISIONS)
        if shape.kind == "capsule":
            return shapes.capsule(shape.size[0], shape.size[1])
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
    # Both sides of a triangle are at most edge_length / sqrt(2), so its diagonal is short enough.
    cut = math.sqrt(2) / edge_length
    if shape.kind == "box":
        segments = np.ceil(cut * np.array(shape.size))
        if 4 * (segments * np.roll(segments, 1)).sum() > _MOST_FACES:
            raise too_many
        return shapes.box(np.array(shape.size), segments.astype(int).tolist())
    radius, length = shape.size
    if shape.kind == "capsule":
        rings, rows = np.ceil(cut * np.array([radius * math.pi / 2, length]))
        if 8 * rings * (2 * rings + rows) > _MOST_FACES:
            raise too_many
        return shapes.capsule(radius, length, int(rings), int(rows))
    # Each of the 6 n segments around is below 2 pi r / (6 n); edges on the ends, below 1.2 r / n.
    rings = max(1.0, np.ceil(cut * radius * math.pi / 3))
    rows = np.ceil(cut * length)
    if 12 * rings * (rings + rows) > _MOST_FACES:
        raise too_many
    return shapes.cylinder(radius, length, int(rings), int(rows))


def _longest_edge(vertices: FloatArray, faces: NDArray[np.int64]) -> float:
    corners = vertices[faces]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max())


def find_mesh(owner: str, filename: str, file: Path, mesh_root: Path | None) -> Path:
    """Path of a mesh file that a URDF file names.

    Candidates are tried in this order, and the first file that exists is returned. For
    "package://name/x" and "package:///name/x": x in a folder "name" that is `mesh_root` or holds
    the URDF file, and name/x in `mesh_root` and in each folder that holds the URDF file, the
    nearest one first; the package in a folder of ROS_PACKAGE_PATH, or in "share" in a folder of
    AMENT_PREFIX_PATH; last, x in `mesh_root` and in each folder that holds the URDF file. For a
    path: the path relative to the folder of the URDF file, to `mesh_root`, and to each other folder
    that holds the URDF file.

    Args:
        owner: Opens the message.
        filename: As written in the file.
        file: URDF file that names the mesh file.
        mesh_root: Folder that the mesh must lie in, symbolic links resolved, if it is not in a
            folder of the environment variables; None accepts any place.

    Raises:
        InvalidInput: If there is no such file, or none inside the allowed folders.
    """
    scheme, separator, rest = filename.partition("://")
    if separator and scheme != "package":
        raise InvalidInput(
            f"{owner}: `filename` must be a path or start with package://, got {filename!r}"
        )
    folders = [*([] if mesh_root is None else [mesh_root]), *file.absolute().parents]
    packages = _package_folders()
    candidates = [folder / filename for folder in (file.parent, *folders)]
    if separator:
        name, _, inside = rest.lstrip("/").partition("/")
        candidates = [
            path
            for folder in (*folders, *packages)
            for path in (*([folder / inside] * (folder.name == name)), folder / name / inside)
        ]
        candidates += [folder / inside for folder in folders]
    try:
        found = [path.resolve() for path in candidates if path.is_file()]
        roots = [folder.resolve() for folder in ([mesh_root] if mesh_root else []) + packages]
    except (OSError, RuntimeError) as error:  # names too long; links in circles
        raise InvalidInput(f"{owner}: `filename` {filename!r} cannot be found: {error}") from error
    if not found:
        raise InvalidInput(
            f"{owner}: `filename` must be a file, got {filename!r}, which is not in {folders[0]}, "
            "in the folders above the URDF file, or in the packages of ROS_PACKAGE_PATH and "
            "AMENT_PREFIX_PATH; `mesh_root` says where packages are"
        )
    if mesh_root is None:
        return found[0]
    for path in found:
        if any(path.is_relative_to(root) for root in roots):
            return path
    raise InvalidInput(
        f"{owner}: `filename` must stay inside `mesh_root`, {roots[0]}, got {filename!r}, "
        f"which is {found[0]}"
    )


def _package_folders() -> list[Path]:
    """Folders in which ROS finds packages, as its environment variables list them."""
    ros, ament = (
        [Path(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder]
        for variable in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")
    )
    return ros + [folder / "share" for folder in ament]
