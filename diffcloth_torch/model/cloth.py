"""A piece of cloth: its mesh, its rest shape, its material and its pins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, overload

import numpy as np

from diffcloth_torch.checks import (
    POSITIVE,
    ArrayLike,
    FloatArray,
    IndexArray,
    check_choice,
    check_count,
    check_finite,
    check_name,
    check_number,
    check_range,
    check_shape,
    float_array,
    frozen,
    index_array,
)
from diffcloth_torch.errors import InvalidInput, warn_caller
from diffcloth_torch.geometry import shapes
from diffcloth_torch.geometry.loaded import load_mesh
from diffcloth_torch.geometry.mesh_checks import check_areas, check_manifold, surface_arrays
from diffcloth_torch.geometry.poses import pose_array, transform
from diffcloth_torch.geometry.texture import flat_rest_mesh
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.orthotropy import material_axes
from diffcloth_torch.model.quantities import FACE_QUANTITIES, check_parameter
from diffcloth_torch.saved import saved

__all__ = ["BENDING_MODELS", "Cloth", "plane_size"]

BENDING_MODELS = ("patch", "hinge")

_DEFAULT_MATERIAL = Material()
_ALONG_X = frozen(np.array([1.0, 0.0, 0.0]))
_POSITIONS = "differentiate with respect to State.positions"
_REST = "differentiate with respect to Parameters.rest_positions"


@saved
class Cloth:
    """A triangulated sheet; immutable.

    Attributes:
        vertices: Initial positions [m], shape [n, 3].
        faces: Vertex indices, shape [f, 3].
        material: Material of the sheet.
        pins: Name -> indices of vertices whose motion is prescribed.
        soft_pins: Name -> indices of vertices that springs pull to targets.
        pin_stiffness: Stiffness of each spring of a soft pin [N/m].
        rest_positions: Vertices of the stress-free rest mesh [m], shape [r, 3]; r = n without
            seams.
        rest_faces: Faces of the rest mesh, indices into `rest_positions`, shape [f, 3]; `faces`
            without seams.
        bending_model: "patch" (isotropic on any mesh) or "hinge".
        name: Name in the scene; None lets the scene choose one.
        directions: Direction of the warp at rest, shape [3], or one per face, shape [f, 3].
        file_vertices: For each vertex of the file read by `load`, its vertex of the cloth, shape
            [m]; None for other cloths.
    """

    vertices: FloatArray
    faces: IndexArray
    material: Material
    pins: Mapping[str, IndexArray]
    soft_pins: Mapping[str, IndexArray]
    pin_stiffness: float
    rest_positions: FloatArray
    rest_faces: IndexArray
    bending_model: str
    name: str | None
    directions: FloatArray
    file_vertices: IndexArray | None = None

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        material: Material = _DEFAULT_MATERIAL,
        pins: Mapping[str, ArrayLike] | None = None,
        soft_pins: Mapping[str, ArrayLike] | None = None,
        pin_stiffness: float = 1e4,
        rest_positions: ArrayLike | None = None,
        rest_faces: ArrayLike | None = None,
        bending_model: str = "patch",
        name: str | None = None,
        directions: ArrayLike | None = None,
        pose: ArrayLike | None = None,
    ) -> None:
        """Check and copy the arguments.

        Args:
            vertices: Initial positions [m], shape [n, 3]; each vertex belongs to a face.
            faces: Vertex indices, shape [f, 3]; triangles, at most two on an edge.
            material: Material; its arrays hold one value per face.
            pins: Name -> indices of vertices whose motion is prescribed.
            soft_pins: Name -> indices of vertices that springs pull to targets.
            pin_stiffness: Stiffness of each spring of a soft pin [N/m], > 0.
            rest_positions: Stress-free positions [m], shape [n, 3], or [r, 3] with `rest_faces`;
                `vertices` by default.
            rest_faces: Faces of a rest mesh that is cut at seams, indices into `rest_positions`,
                shape [f, 3]. Each face has its own triangle at rest, and a vertex of a seam has
                several rest vertices. Seams are sewn flat: the angle between the faces at both
                sides is zero at rest. By default the rest mesh has no seams.
            bending_model: "patch" or "hinge".
            name: Name in the scene.
            directions: Direction of the warp in the rest shape, shape [3] or [f, 3]; along x by
                default. The direction is projected onto each face and fixed to the material, also
                if `Parameters.rest_positions` differ. Isotropic cloth does not use it.
            pose: Pose [px, py, pz, qw, qx, qy, qz] that places `vertices`, but not the rest shape;
                the identity by default.

        Raises:
            InvalidInput: If a shape, an index or a value is not accepted.
            TypeError: If an argument has a wrong type.
        """
        owner = type(self).__name__
        points, triangles = surface_arrays(owner, vertices, faces, instead=_POSITIONS)
        check_manifold(owner, len(points), triangles)
        # The rest shape does not depend on the pose, and unrotated coordinates are exact.
        self.rest_positions, self.rest_faces = _rest(rest_positions, rest_faces, points, triangles)
        if pose is not None:
            placement = pose_array(f"{owner}: `pose`", pose, instead=_POSITIONS)
            points = frozen(transform(points, placement))
        self.vertices, self.faces = points, triangles
        self.material = _material(material, len(triangles))
        self.pins, self.soft_pins = _pin_groups(pins, soft_pins, len(points))
        self.pin_stiffness = check_parameter("Cloth", "pin_stiffness", pin_stiffness)
        self.bending_model = check_choice("Cloth: `bending_model`", bending_model, BENDING_MODELS)
        self.name = check_name(f"{owner}: `name`", name)
        self.directions = _directions(directions, len(triangles))
        if self.material.is_orthotropic or directions is not None:
            self.material_axes("Cloth")
        if self.bending_model == "hinge":
            _refuse_woven_hinges(self.material)

    @property
    def has_seams(self) -> bool:
        """Return whether the rest mesh is cut, so that some vertices have several rest vertices."""
        return len(self.rest_positions) > len(self.vertices)

    @property
    def rest_embedding(self) -> FloatArray:
        """Positions of the vertices at rest [m], shape [n, 3].

        A cloth with seams may have no such positions; the result then equals `vertices`, scaled to
        the area of the rest mesh.
        """
        if self.has_seams:
            areas = (
                _double_areas(self.rest_positions[self.rest_faces]).sum(),
                _double_areas(self.vertices[self.faces]).sum(),
            )
            scaled: FloatArray = np.sqrt(areas[0] / areas[1]) * self.vertices
            return scaled
        embedding = np.empty_like(self.vertices)
        embedding[self.faces] = self.rest_positions[self.rest_faces]
        return embedding

    def material_axes(self, owner: str) -> FloatArray:
        """Unit vectors of the warp in the rest frames of the faces, shape [f, 2].

        Args:
            owner: Beginning of the error message if a direction is normal to a face.
        """
        return material_axes(owner, self.directions, self.rest_positions, self.rest_faces)

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        scale: float = 1.0,
        rest: str | None = None,
        rest_scale: float | None = None,
        triangulate: bool = False,
        weld: float | None = None,
        **keywords: Any,
    ) -> Cloth:
        """Read an .obj, .ply or .stl file.

        >>> flag = dc.Cloth.load("flag.obj", rest="uv", rest_scale=1.5)

        Vertex `i` of an .obj or .ply file is vertex `i` of the cloth unless `weld` merges vertices.
        A mesh of more than 10 m or less than 1 mm causes a warning about `scale`.

        Args:
            path: Mesh file.
            scale: Meters per unit of the file, > 0.
            rest: "uv" uses the triangles of the texture of an .obj file as rest shape, flat in the
                xy-plane, with u along x. The islands of the texture may lie anywhere, also mirrored
                or on each other. Seams between islands are sewn flat, as with `rest_faces`.
            rest_scale: Meters per unit of the texture coordinates, > 0; required for `rest`.
            triangulate: Whether to cut quads and other polygons into triangles, from their shorter
                diagonals on, instead of refusing them.
            weld: Distance [m] up to which vertices are merged into the first of them; 0 merges
                coincident vertices. `file_vertices` maps vertices of the file to vertices of the
                cloth.
            **keywords: As for `Cloth`; `rest_positions` is in meters, `scale` does not apply to it.

        Raises:
            InvalidInput: If the file or an argument is not accepted; the message names the line,
                the vertex or the face.
        """
        mesh = load_mesh(
            "Cloth.load",
            path,
            scale=scale,
            triangulate=triangulate,
            weld=weld,
            instead=_POSITIONS,
        )
        if rest is not None:
            check_choice("Cloth.load: `rest`", rest, ("uv",))
            for field in ("rest_positions", "rest_faces"):
                if keywords.get(field) is not None:
                    raise InvalidInput(f"Cloth.load: `rest` must be None beside `{field}`")
            if rest_scale is None:
                raise InvalidInput(
                    "Cloth.load: `rest_scale` must be given with `rest`: the meters per unit of "
                    "the texture coordinates"
                )
            size = check_number("Cloth.load: `rest_scale`", rest_scale, POSITIVE, instead=_REST)
            flat = flat_rest_mesh(f"{path}", mesh.faces, mesh.texture, size)
            keywords |= {"rest_positions": flat.positions, "rest_faces": flat.faces}
        elif rest_scale is not None:
            raise InvalidInput("Cloth.load: `rest_scale` must be None without `rest`")
        cloth = cls(mesh.vertices, mesh.faces, **keywords)
        cloth.file_vertices = mesh.file_vertices
        return cloth

    @overload
    @classmethod
    def grid(cls, counts: Sequence[int], size: ArrayLike = 1.0, **keywords: Any) -> Cloth: ...

    @overload
    @classmethod
    def grid(cls, rows: int, columns: int, size: ArrayLike = 1.0, **keywords: Any) -> Cloth: ...

    @classmethod
    def grid(cls, *arguments: Any, **keywords: Any) -> Cloth:
        """Make a rectangular sheet in the xy-plane, centered at the origin.

        >>> sheet = dc.Cloth.grid((4, 3), (0.3, 0.2))  # 4 vertices over 30 cm along x

        Vertex `j * counts[0] + i` lies at x = (i / (counts[0] - 1) - 1/2) * size[0] and
        y = (j / (counts[1] - 1) - 1/2) * size[1]. The faces point up.

        Args:
            *arguments: `counts`, the numbers of vertices along x and y, each >= 2; then `size`, the
                lengths along x and y [m], or one length for both, 1 by default. An earlier form
                has `rows` (along y), `columns` (along x) and `size`; with two lengths it warns.
            **keywords: As for `Cloth`.
        """
        owner = f"{cls.__name__}.grid"
        columns, rows, size = _grid_shape(owner, arguments, keywords)
        vertices, faces = shapes.grid(rows, columns, plane_size(f"{owner}: `size`", size))
        return cls(vertices, faces, **keywords)

    def __repr__(self) -> str:
        name = "" if self.name is None else f"{self.name!r}, "
        return f"Cloth({name}{len(self.vertices)} vertices, {len(self.faces)} faces)"

    def __getstate__(self) -> dict[str, Any]:
        plain = {"pins": dict(self.pins), "soft_pins": dict(self.soft_pins)}
        fields = {**vars(self), **plain}
        if self.rest_faces is self.faces:
            del fields["rest_faces"]
        return fields

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({"rest_faces": state["faces"], **state})
        self.pins, self.soft_pins = MappingProxyType(self.pins), MappingProxyType(self.soft_pins)


def _grid_shape(
    owner: str, arguments: Sequence[Any], keywords: dict[str, Any]
) -> tuple[int, int, object]:
    """Numbers of vertices along x and y, and the size; removes these arguments from `keywords`."""
    by_counts = "counts" in keywords or _has_an_axis(arguments[:1])
    names = ("counts", "size") if by_counts else ("rows", "columns", "size")
    if len(arguments) > len(names):
        raise TypeError(
            f"{owner}: takes {', '.join(f'`{name}`' for name in names)}, got {len(arguments)} "
            "arguments"
        )
    given = dict(zip(names, arguments, strict=False))
    for name in names:
        if name in keywords:
            if name in given:
                raise TypeError(f"{owner}: `{name}` must be given once, got it twice")
            given[name] = keywords.pop(name)
        elif name not in given and name != "size":
            raise TypeError(f"{owner}: `{name}` must be given")
    size = given.get("size", 1.0)
    if not by_counts:
        rows = check_count(f"{owner}: `rows`", given["rows"], 2)
        columns = check_count(f"{owner}: `columns`", given["columns"], 2)
        if _has_an_axis((size,)):
            x, y = plane_size(f"{owner}: `size`", size).tolist()
            warn_caller(
                f"{owner}: rows and columns are counted along y and x, lengths along x and y; "
                f"write {owner}(({columns}, {rows}), ({x:g}, {y:g})), with x first in both",
                FutureWarning,
            )
        _check_face_count(owner, "`rows` and `columns`", rows, columns)
        return columns, rows, size
    counts = given["counts"]
    check_shape(f"{owner}: `counts`", np.shape(counts), [(2,)])
    columns, rows = (
        check_count(f"{owner}: `counts[{i}]`", count, 2) for i, count in enumerate(counts)
    )
    _check_face_count(owner, "`counts`", columns, rows)
    return columns, rows, size


def _has_an_axis(values: Sequence[Any]) -> bool:
    """Return whether a value, of none or one, is a list or an array of one axis."""
    return any(isinstance(v, list | tuple) or getattr(v, "ndim", 0) == 1 for v in values)


def _check_face_count(owner: str, arguments: str, first: int, second: int) -> None:
    if 2 * (first - 1) * (second - 1) > shapes.MOST_FACES:
        raise InvalidInput(
            f"{owner}: {arguments} must make at most {shapes.MOST_FACES} triangles, got "
            f"{first} x {second} vertices"
        )


def plane_size(name: str, size: object) -> FloatArray:
    """Lengths along x and y [m] from two numbers or one."""
    lengths = float_array(name, size)
    check_shape(name, lengths.shape, [(), (2,)])
    check_range(name, lengths, POSITIVE)
    return np.broadcast_to(lengths, 2)


def _rest(
    given: object, given_faces: object, vertices: FloatArray, faces: IndexArray
) -> tuple[FloatArray, IndexArray]:
    """Check the rest mesh."""
    if given is None:
        if given_faces is not None:
            raise InvalidInput("Cloth: `rest_faces` must be None without `rest_positions`")
        return vertices, faces
    rest = float_array("Cloth: `rest_positions`", given, instead=_REST)
    shape = vertices.shape if given_faces is None else ("r", 3)
    check_shape("Cloth: `rest_positions`", rest.shape, [shape])
    check_finite("Cloth: `rest_positions`", rest)
    rest_faces = faces if given_faces is None else _rest_faces(given_faces, len(rest), faces)
    check_areas("Cloth", "rest_positions", rest, rest_faces)
    frozen(rest)
    return rest, rest_faces


def _rest_faces(given: object, rest_count: int, faces: IndexArray) -> IndexArray:
    """Check the faces of the rest mesh; return the object `faces` if the arrays are equal."""
    name = "Cloth: `rest_faces`"
    rest_faces = index_array(name, given, rest_count)
    check_shape(name, rest_faces.shape, [faces.shape])
    owner = np.full(rest_count, -1)
    owner[rest_faces] = faces
    if (owner < 0).any():
        unused = int(np.argmax(owner < 0))
        raise InvalidInput(
            f"{name} must name each rest vertex; {unused} is not named "
            f"({int((owner < 0).sum())} in all)"
        )
    other = np.argwhere(owner[rest_faces] != faces)
    if len(other):
        face, corner = other[0].tolist()
        vertex = int(rest_faces[face, corner])
        raise InvalidInput(
            f"{name} must give each rest vertex one vertex, got {vertex} for the vertices "
            f"{faces[face, corner]} and {owner[vertex]}, at [{face}, {corner}]"
        )
    return faces if np.array_equal(rest_faces, faces) else frozen(rest_faces)


def _double_areas(triangles: FloatArray) -> FloatArray:
    """Twice the areas of triangles [f, 3, 3]."""
    a, b, c = triangles.transpose(1, 0, 2)
    areas: FloatArray = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return areas


def _material(material: object, face_count: int) -> Material:
    if not isinstance(material, Material):
        raise TypeError(f"Cloth: `material` must be a Material, got {type(material).__name__}")
    for field in FACE_QUANTITIES:
        value = np.asarray(material.per_face(field))
        check_shape(f"Cloth: `material.{field}`", value.shape, [(), (face_count,)])
    return material


def _directions(given: object, face_count: int) -> FloatArray:
    if given is None:
        return _ALONG_X
    name = "Cloth: `directions`"
    directions = float_array(name, given, instead="directions have no gradient: detach them")
    check_shape(name, directions.shape, [(3,), (face_count, 3)])
    check_finite(name, directions)
    zero = ~directions.any(axis=-1)
    if zero.any():
        where = f" at [{int(np.argmax(zero))}]" if directions.ndim == 2 else ""
        raise InvalidInput(f"{name} must not be zero, got [0.0, 0.0, 0.0]{where}")
    frozen(directions)
    return directions


def _refuse_woven_hinges(material: Material) -> None:
    for field in ("bending_weft", "bending_twill"):
        if getattr(material, field) is not None:
            raise InvalidInput(
                f"Cloth: `material.{field}` must be None where `bending_model` is 'hinge', which "
                "has one bending stiffness; 'patch' has three"
            )


def _pin_groups(
    pins: Mapping[str, ArrayLike] | None,
    soft_pins: Mapping[str, ArrayLike] | None,
    vertex_count: int,
) -> tuple[Mapping[str, IndexArray], Mapping[str, IndexArray]]:
    """Check both kinds together: no vertex may be pinned twice."""
    groups = []
    holder: dict[int, str] = {}
    for field, given in (("pins", pins), ("soft_pins", soft_pins)):
        if given is not None and not isinstance(given, Mapping):
            raise InvalidInput(
                f"Cloth: `{field}` must be a dict of name -> vertex indices, "
                f"got {type(given).__name__}"
            )
        group = {}
        for pin, indices in (given or {}).items():
            check_name(f"Cloth: a name in `{field}`", pin)
            name = f"Cloth: `{field}[{pin!r}]`"
            array = index_array(name, indices, vertex_count)
            check_shape(name, array.shape, [("n",)])
            if array.size == 0:
                raise InvalidInput(f"{name} must hold at least one vertex")
            for vertex in array.tolist():
                if vertex in holder:
                    raise InvalidInput(
                        f"{name} must not pin vertex {vertex} again: `{holder[vertex]}` does"
                    )
                holder[vertex] = f"{field}[{pin!r}]"
            group[str(pin)] = frozen(array)
        groups.append(MappingProxyType(group))
    return groups[0], groups[1]
