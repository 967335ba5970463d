"""A rigid body: a triangle mesh that is static, follows prescribed poses, or responds to forces."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from diffcloth_torch.checks import (
    POSITIVE,
    ArrayLike,
    FloatArray,
    IndexArray,
    check_bool,
    check_choice,
    check_count,
    check_finite,
    check_name,
    check_number,
    check_range,
    check_shape,
    float_array,
    frozen,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry import shapes
from diffcloth_torch.geometry.loaded import load_mesh
from diffcloth_torch.geometry.mass_properties import check_inertia, is_closed, mass_properties
from diffcloth_torch.geometry.mesh_checks import body_arrays, warn_of_cuts
from diffcloth_torch.geometry.meshes import read_body_mesh
from diffcloth_torch.geometry.poses import pose_array
from diffcloth_torch.model.cloth import plane_size
from diffcloth_torch.model.quantities import check_parameter
from diffcloth_torch.model.round_bodies import (
    ContactSurface,
    Primitive,
    round_solid,
    round_surface,
)
from diffcloth_torch.saved import saved

__all__ = ["MOTIONS", "Primitive", "RigidBody"]

MOTIONS = ("static", "kinematic", "dynamic")

# Smallest volume of a closed mesh over its extent cubed [-]; below, rounding determines the
# volume. A needle of 1 m by 1 um has 1e-12.
_SMALLEST_VOLUME = 1e-14

# Limit for a sphere, whose subdivision begins with the 20 triangles of an icosahedron.
_MOST_SUBDIVISIONS = int(math.log(shapes.MOST_FACES / 20, 4))
_MOST_RINGS = 100

MassProperties = tuple[float, FloatArray, FloatArray]
"""Volume, center and inertia for a density of one."""

_MASS_PROPERTIES = ("density", "mass", "center", "inertia")

_POSES = "differentiate with respect to State.body_poses or Control.body_poses"
_MASS = "differentiate with respect to Parameters.body_mass"
_CENTER = "differentiate with respect to Parameters.body_center"
_INERTIA = "differentiate with respect to Parameters.body_inertia"


@saved
class RigidBody:
    """A rigid triangle mesh; immutable.

    Attributes:
        vertices: Positions in the body frame [m], shape [v, 3].
        faces: Vertex indices, shape [g, 3].
        motion: "static", "kinematic" (follows prescribed poses) or "dynamic" (responds to forces).
        pose: Initial pose [px, py, pz, qw, qx, qy, qz], shape [7].
        friction: Friction coefficient of the surface [-].
        thickness: Full thickness of the surface in contact [m].
        mass: Mass [kg]. Mass, center and inertia are zero unless the body is dynamic.
        center: Center of mass in the body frame [m], shape [3].
        inertia: Inertia about the center, in body axes [kg m^2], shape [3, 3].
        nodal_contact: Whether cloths touch the body at their vertices, with dry friction, instead
            of through the barrier.
        primitive: Analytic surface of the body; None for a given mesh and for a cylinder.
        smooth: Whether contact uses the analytic surface of the body, a sphere or a capsule; then
            `vertices` and `faces` are only for display.
        name: Name in the scene; None means a name chosen by the scene.
    """

    vertices: FloatArray
    faces: IndexArray
    motion: str
    pose: FloatArray
    friction: float
    thickness: float
    # Zero unless the body is dynamic.
    mass: float = 0.0
    center: FloatArray = frozen(np.zeros(3))
    inertia: FloatArray = frozen(np.zeros((3, 3)))
    nodal_contact: bool = False
    primitive: Primitive | None = None
    smooth: bool = False
    name: str | None

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        motion: str = "static",
        pose: ArrayLike | None = None,
        friction: float = 0.4,
        thickness: float = 0.0,
        density: float | None = None,
        mass: float | None = None,
        center: ArrayLike | None = None,
        inertia: ArrayLike | None = None,
        nodal_contact: bool = False,
        name: str | None = None,
    ) -> None:
        """Check and copy the arguments.

        A dynamic body needs exactly one of `density` and `mass`. A closed mesh is filled uniformly;
        this determines `center` and `inertia`, unless they are given.

        Args:
            vertices: Positions in the body frame [m], shape [v, 3].
            faces: Vertex indices of triangles, shape [g, 3]. Faces of a closed mesh must point
                outward if it determines mass properties. Faces without area, and all but one of the
                faces with the same vertices, are dropped with a warning.
            motion: "static", "kinematic" or "dynamic".
            pose: Initial pose [px, py, pz, qw, qx, qy, qz]; the identity by default.
            friction: Friction coefficient [-], >= 0.
            thickness: Full thickness [m], >= 0.
            density: Density of a dynamic body with a closed mesh [kg/m^3], > 0.
            mass: Mass of a dynamic body [kg], > 0.
            center: Center of mass in the body frame [m], shape [3].
            inertia: Inertia about the center, in body axes [kg m^2], shape [3, 3]; symmetric,
                positive definite, no principal moment above the sum of the others. The default is
                the inertia of the uniformly filled mesh, even if `center` is given.
            nodal_contact: Whether cloths touch the body at their vertices, with dry friction
                without smoothing, instead of through the barrier. Only for bodies made by `box`,
                `sphere`, `capsule` or `plane` that are not dynamic. Cloths may then cut through
                the body between their vertices. The scheme "projective" always treats bodies
                this way.
            name: Name in the scene.

        Raises:
            InvalidInput: If a shape, an index or a value is not accepted; if a dynamic body with an
                open mesh lacks mass properties; or if `nodal_contact` is set for a given mesh
                or a dynamic body.
            TypeError: If an argument has a wrong type.
        """
        surface = body_arrays("RigidBody", vertices, faces, instead=_POSES)
        self.vertices, self.faces = surface.vertices, surface.faces
        warn_of_cuts("RigidBody", self.vertices, self.faces)
        self.motion = check_choice("RigidBody: `motion`", motion, MOTIONS)
        self.pose = frozen(pose_array("RigidBody: `pose`", pose, instead=_POSES))
        self.friction = check_parameter("RigidBody", "friction", friction)
        self.thickness = check_parameter("RigidBody", "thickness", thickness)
        given = {"density": density, "mass": mass, "center": center, "inertia": inertia}
        self._set_mass_properties(given, surface.solid)
        self.name = check_name("RigidBody: `name`", name)
        self._set_primitive(None, nodal_contact)

    def _set_primitive(self, primitive: Primitive | None, nodal_contact: object) -> None:
        self.primitive = primitive
        self.nodal_contact = check_bool("RigidBody: `nodal_contact`", nodal_contact)
        if self.nodal_contact and primitive is None:
            raise InvalidInput(
                "RigidBody: `nodal_contact` needs a body made by box, sphere, capsule or plane, "
                "got a mesh or a cylinder"
            )
        if self.nodal_contact and self.motion == "dynamic":
            raise InvalidInput(
                'RigidBody: `nodal_contact` needs motion="static" or "kinematic", got "dynamic"'
            )

    @classmethod
    def _of(
        cls,
        primitive: Primitive,
        mesh: tuple[ArrayLike, ArrayLike],
        *,
        smooth: bool = False,
        nodal_contact: bool = False,
        **keywords: Any,
    ) -> RigidBody:
        is_smooth = check_bool("RigidBody: `smooth`", smooth)
        if is_smooth and primitive.kind not in ("sphere", "capsule"):
            raise InvalidInput(
                "RigidBody: `smooth` is for spheres and capsules, got True for a "
                f"{primitive.kind}, which is exact as a mesh"
            )
        body = cls(*mesh, **keywords)
        body._set_primitive(primitive, nodal_contact)
        body.smooth = is_smooth
        if is_smooth:
            given = {field: keywords.get(field) for field in _MASS_PROPERTIES}
            body._set_mass_properties(given, body.faces, round_solid(primitive))
        if is_smooth and body.nodal_contact:
            raise InvalidInput(
                "RigidBody: `smooth` must not be set with `nodal_contact`, which is with the "
                "analytic surface by itself"
            )
        return body

    @property
    def contact_surface(self) -> ContactSurface:
        """Surface for contact, which is the mesh, or the skeleton of the analytic surface."""
        if not self.smooth or self.primitive is None:
            return ContactSurface(self.vertices, self.faces, 0.0)
        return round_surface(self.primitive)

    def _set_mass_properties(
        self, given: Mapping[str, object], faces: IndexArray, solid: MassProperties | None = None
    ) -> None:
        """Set the given properties; the others are the solid's, by default the filled mesh's."""
        density, mass, center, inertia = (given[field] for field in _MASS_PROPERTIES)
        if self.motion != "dynamic":
            for field, value in given.items():
                if value is not None:
                    raise InvalidInput(
                        f'RigidBody: `{field}` needs motion="dynamic", got {self.motion!r}'
                    )
            return
        if (density is None) == (mass is None):
            got = "neither" if mass is None else "both"
            raise InvalidInput(
                f"RigidBody: a dynamic body must have `density` or `mass`, one of them, got {got}"
            )
        # The mesh may be open, so the filled mesh is used only if a property is missing.
        volume, middle, moments = 1.0, np.zeros(3), np.zeros((3, 3))
        if mass is None or center is None or inertia is None:
            volume, middle, moments = self._filled_mesh(faces) if solid is None else solid
        if mass is None:
            rho = check_number("RigidBody: `density`", density, POSITIVE, instead=_MASS)
            self.mass = rho * volume
        else:
            self.mass = check_number("RigidBody: `mass`", mass, POSITIVE, instead=_MASS)
        if center is not None:
            middle = float_array("RigidBody: `center`", center, instead=_CENTER)
            check_shape("RigidBody: `center`", middle.shape, [(3,)])
            check_finite("RigidBody: `center`", middle)
        moments *= self.mass / volume
        if inertia is not None:
            moments = float_array("RigidBody: `inertia`", inertia, instead=_INERTIA)
        self.center = frozen(middle)
        self.inertia = frozen(check_inertia("RigidBody: `inertia`", moments))

    def _filled_mesh(self, faces: IndexArray) -> MassProperties:
        """Volume, center and inertia of the mesh, which must be closed, for a density of one."""
        if not is_closed(faces):
            raise InvalidInput(
                "RigidBody: a dynamic body must have `mass`, `center` and `inertia` where its "
                "mesh is not closed: some edge has no two faces of one orientation"
            )
        volume, center, inertia = mass_properties(self.vertices, faces)
        extent = float(np.ptp(self.vertices, axis=0).max())
        if not volume > _SMALLEST_VOLUME * extent**3:
            raise InvalidInput(
                "RigidBody: `faces` of a closed mesh must face outward, so that it holds a "
                f"volume > 0, got {volume:g} m^3; reverse them, or give `mass`, `center` and "
                "`inertia`"
            )
        return volume, center, inertia

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        scale: float = 1.0,
        triangulate: bool = True,
        weld: float | None = None,
        **keywords: Any,
    ) -> RigidBody:
        """Read an .obj, .ply, .stl, .dae, .glb or .gltf file.

        A mesh of more than 10 m or less than 1 mm gets a warning about `scale`.

        Args:
            path: Mesh file; its coordinates are the body frame. Files in .dae need the extra
                `robots`; their unit applies.
            scale: Meters per unit of the file, > 0.
            triangulate: Whether to cut polygons into triangles instead of refusing them. Must be
                True for files in .dae, whose polygons are always cut.
            weld: Distance [m] up to which vertices are merged; None merges none.
            **keywords: As for `RigidBody`.
        """
        mesh = load_mesh(
            "RigidBody.load",
            path,
            scale=scale,
            triangulate=triangulate,
            weld=weld,
            instead=_POSES,
            read=read_body_mesh,
        )
        return cls(mesh.vertices, mesh.faces, **keywords)

    @classmethod
    def box(cls, size: ArrayLike, **keywords: Any) -> RigidBody:
        """Make a cuboid centered at the origin.

        Args:
            size: Lengths along x, y and z [m], or one length for all.
            **keywords: As for `RigidBody`.
        """
        lengths = float_array("RigidBody.box: `size`", size)
        check_shape("RigidBody.box: `size`", lengths.shape, [(), (3,)])
        check_range("RigidBody.box: `size`", lengths, POSITIVE)
        sides = np.broadcast_to(lengths, 3)
        x, y, z = (sides / 2).tolist()
        primitive = Primitive("box", (x, y, z))
        return cls._of(primitive, shapes.box(sides), **keywords)

    @classmethod
    def sphere(
        cls, radius: float, *, subdivisions: int = 3, smooth: bool = False, **keywords: Any
    ) -> RigidBody:
        """Make a sphere around the origin: a subdivided icosahedron with vertices on the sphere.

        Args:
            radius: Radius of the sphere [m], > 0.
            subdivisions: Number of splits of each triangle into four, 0 .. 8; with 3, 1280 faces.
            smooth: Whether contact uses the sphere itself instead of the triangles. The body then
                rolls as a sphere and has the mass properties of a sphere; the triangles are only
                for display.
            **keywords: As for `RigidBody`.
        """
        length = check_number("RigidBody.sphere: `radius`", radius, POSITIVE, instead=_POSES)
        check_count("RigidBody.sphere: `subdivisions`", subdivisions, 0, _MOST_SUBDIVISIONS)
        primitive = Primitive("sphere", (length, 0.0, 0.0))
        mesh = shapes.sphere(length, subdivisions)
        return cls._of(primitive, mesh, smooth=smooth, **keywords)

    @classmethod
    def capsule(
        cls, radius: float, length: float, *, smooth: bool = False, **keywords: Any
    ) -> RigidBody:
        """Make a cylinder along z, centered at the origin, with half spheres on its ends.

        Args:
            radius: Radius of the cylinder and the half spheres [m], > 0.
            length: Length of the cylinder alone [m], > 0; the capsule is 2 radius longer.
            smooth: Whether contact uses the capsule itself instead of triangles, as for `sphere`.
            **keywords: As for `RigidBody`.
        """
        name = "RigidBody.capsule: `{}`"
        r = check_number(name.format("radius"), radius, POSITIVE, instead=_POSES)
        h = check_number(name.format("length"), length, POSITIVE, instead=_POSES)
        primitive = Primitive("capsule", (r, h / 2, 0.0))
        return cls._of(primitive, shapes.capsule(r, h), smooth=smooth, **keywords)

    @classmethod
    def cylinder(
        cls, radius: float, length: float, *, rings: int = 5, smooth: bool = False, **keywords: Any
    ) -> RigidBody:
        """Make a closed cylinder along z, centered at the origin, with its vertices on the surface.

        Args:
            radius: Radius [m], > 0.
            length: Length [m], > 0.
            rings: Number of rings of triangles on each end, 1 .. 100; a sixth of the number of flat
                sides. With 5 the cylinder rolls 2 to 7 % too slowly, with 10 less than 1 %.
            smooth: Must be False: a cylinder with flat ends has no smooth surface here.
            **keywords: As for `RigidBody`.
        """
        if check_bool("RigidBody.cylinder: `smooth`", smooth):
            raise InvalidInput(
                "RigidBody.cylinder: `smooth` must be False, as a cylinder has sharp rims; with "
                "`rings=10` it rolls nearly as a round one, and RigidBody.capsule can be smooth"
            )
        name = "RigidBody.cylinder: `{}`"
        r = check_number(name.format("radius"), radius, POSITIVE, instead=_POSES)
        h = check_number(name.format("length"), length, POSITIVE, instead=_POSES)
        check_count(name.format("rings"), rings, 1, _MOST_RINGS)
        return cls(*shapes.cylinder(r, h, rings), **keywords)

    @classmethod
    def plane(cls, size: ArrayLike, **keywords: Any) -> RigidBody:
        """Make a rectangle of two triangles at z = 0 that faces up, centered at the origin.

        In contact at nodes the plane is infinite, and all points below the plane are inside.

        Args:
            size: Lengths along x and y [m], or one length for both.
            **keywords: As for `RigidBody`.
        """
        mesh = shapes.plane(plane_size("RigidBody.plane: `size`", size))
        return cls._of(Primitive("plane", (0.0, 0.0, 0.0)), mesh, **keywords)

    def __repr__(self) -> str:
        name = "" if self.name is None else f"{self.name!r}, "
        smooth = ", smooth" if self.smooth else ""
        return f"RigidBody({name}{self.motion}, {len(self.faces)} faces{smooth})"
