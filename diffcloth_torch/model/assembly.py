"""The arrays of a scene, one surface after the other, for the core and the dynamics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray, IndexArray
from diffcloth_torch.geometry.mesh_checks import Surface
from diffcloth_torch.model.mechanism import Mechanism
from diffcloth_torch.model.rigid_body import Primitive, RigidBody
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.model.springs import Springs

__all__ = ["Assembly", "assemble"]


class _Surface(Protocol):
    @property
    def vertices(self) -> FloatArray: ...
    @property
    def faces(self) -> IndexArray: ...


@dataclass(frozen=True, eq=False)
class Assembly:
    """The arrays of a scene: vertices, faces and pins of all cloths, then of bodies and links.

    Each body and each robot is a mechanism. There are T mechanisms, bodies first.

    Attributes:
        vertices: Initial cloth positions [m], shape [N, 3].
        rest_positions: Vertices of the rest meshes of the cloths [m], shape [M, 3].
        rest_embedding: Vertices of the cloths at rest in space [m], shape [N, 3]; see `Cloth`.
        faces: Cloth faces, indices into `vertices`, shape [F, 3].
        rest_faces: The same faces in the rest meshes, indices into `rest_positions`, shape [F, 3].
        material_axes: Unit vector of the warp in the rest frame of each face, shape [F, 2]; empty
            if no cloth is woven.
        cloth_vertex_start: First vertex of each cloth, then N; shape [C + 1].
        cloth_rest_start: First rest vertex of each cloth, then M; shape [C + 1].
        cloth_face_start: First face of each cloth, then F; shape [C + 1].
        deforming_count: Number of deforming bodies, which are the last cloths.
        pins: Pinned vertices, without the vertices of deforming bodies; shape [P].
        soft_pins: Softly pinned vertices, shape [Q].
        pin_groups: "cloth/pin" -> rows of `pins`.
        soft_pin_groups: "cloth/pin" -> rows of `soft_pins`.
        springs: Springs of the attachments.
        body_vertices: Vertices of the K bodies, then of the Lc links that have collision shapes,
            each in the frame of its body or link [m], shape [V, 3].
        body_faces: Indices into `body_vertices`, shape [G, 3].
        body_radii: Radius of each of these surfaces [m], shape [K + Lc]. 0 for a mesh; otherwise
            `body_vertices` and `body_faces` hold the skeleton of the surface.
        body_vertex_start: First vertex of each of these surfaces, then V; shape [K + Lc + 1].
        body_face_start: First face of each of these surfaces, then G; shape [K + Lc + 1].
        body_poses: Initial poses of the bodies, shape [K, 7].
        static_bodies: Indices of the static bodies.
        mechanisms: Mechanisms of the bodies, then of the robots; length T.
        surface_mechanism: Mechanism of each surface after the cloths, shape [K + Lc].
        surface_link: Index in its mechanism of the link of each of these surfaces, shape [K + Lc].
        surface_names: Names of the cloths and bodies, then "robot/link"; length S.
        ignored_pairs: Pairs of surfaces a < b that are not tested for contact; shape [m, 2].
        primitives: Primitive of each surface after the cloths; None for a surface that does not
            touch cloths at their vertices; length K + Lc.
        base_poses: Initial poses of the root links of robots, shape [R, 7].
        joint_slices: Name of a robot -> its rows among the J joints.
        link_slices: Name of a robot -> its rows among the L links.
        joint_positions: Initial positions of the joints [rad or m], shape [J].
        stiffness: Stiffness of the joints' drives [N m/rad or N/m], shape [J].
        damping: Damping of the joints' drives [N m s/rad or N s/m], shape [J].
        joint_viscosity: Damping of the joints themselves [N m s/rad or N s/m], shape [J].
        joint_effort_limits: Largest efforts of the drives [N m or N], infinity without a limit;
            shape [J].
        joint_velocity_limits: Largest speeds of the joints [rad/s or m/s], likewise.
        joint_friction: Coulomb friction of the joints [N m or N], shape [J].
        joint_armature: Inertia of the drives' rotors on the joints [kg m^2 or kg], shape [J].
    """

    vertices: FloatArray
    rest_positions: FloatArray
    rest_embedding: FloatArray
    faces: IndexArray
    rest_faces: IndexArray
    material_axes: FloatArray
    cloth_vertex_start: IndexArray
    cloth_rest_start: IndexArray
    cloth_face_start: IndexArray
    deforming_count: int
    pins: IndexArray
    soft_pins: IndexArray
    pin_groups: Mapping[str, slice]
    soft_pin_groups: Mapping[str, slice]
    springs: Springs
    body_vertices: FloatArray
    body_faces: IndexArray
    body_radii: FloatArray
    body_vertex_start: IndexArray
    body_face_start: IndexArray
    body_poses: FloatArray
    static_bodies: tuple[int, ...]
    mechanisms: tuple[Mechanism, ...]
    surface_mechanism: IndexArray
    surface_link: IndexArray
    surface_names: tuple[str, ...]
    ignored_pairs: IndexArray
    primitives: tuple[Primitive | None, ...]
    base_poses: FloatArray
    joint_slices: Mapping[str, slice]
    link_slices: Mapping[str, slice]
    joint_positions: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    joint_viscosity: FloatArray
    joint_effort_limits: FloatArray
    joint_velocity_limits: FloatArray
    joint_friction: FloatArray
    joint_armature: FloatArray

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes by their letters in the tables of quantities."""
        return {
            "N": len(self.vertices),
            "M": len(self.rest_positions),
            "F": len(self.faces),
            "C": self.cloth_count,
            "K": self.body_count,
            "V": len(self.body_vertices),
            "S": self.surface_count,
            "P": len(self.pins),
            "D": len(self.body_vertex_rows),
            "Q": len(self.soft_pins),
            "A": len(self.springs),
            "U": self.springs.target_count,
            "J": len(self.joint_positions),
            "L": sum(robot.link_count for robot in self.robots),
            "R": len(self.robots),
        }

    @property
    def bodies(self) -> tuple[Mechanism, ...]:
        """Mechanisms of the K bodies."""
        return self.mechanisms[: self.body_count]

    @property
    def robots(self) -> tuple[Mechanism, ...]:
        """Mechanisms of the R robots."""
        return self.mechanisms[self.body_count :]

    @property
    def forced(self) -> NDArray[np.bool_]:
        """True for joints that forces move, shape [J]; see `Mechanism.forced`."""
        return np.concatenate([np.empty(0, dtype=bool), *(m.forced for m in self.mechanisms)])

    @property
    def cloth_count(self) -> int:
        """Number of cloths, C."""
        return len(self.cloth_vertex_start) - 1

    @property
    def body_vertex_rows(self) -> IndexArray:
        """Vertices of deforming bodies, shape [D]."""
        first = self.cloth_vertex_start[self.cloth_count - self.deforming_count]
        return np.arange(first, len(self.vertices), dtype=np.int32)

    @property
    def deforming_groups(self) -> dict[str, slice]:
        """Name of a deforming body -> its rows among the D vertices."""
        first = self.cloth_count - self.deforming_count
        starts = self.cloth_vertex_start[first:] - self.cloth_vertex_start[first]
        names = self.surface_names[first : self.cloth_count]
        rows = pairwise(starts.tolist())
        return {name: slice(*ends) for name, ends in zip(names, rows, strict=True)}

    @property
    def body_count(self) -> int:
        """Number of bodies, K."""
        return len(self.body_poses)

    @property
    def surface_count(self) -> int:
        """Number of surfaces, S = C + K + Lc."""
        return len(self.surface_names)


def assemble(scene: Scene, *, all_nodal: bool = False) -> Assembly:
    """Concatenate the arrays of a scene.

    Args:
        scene: The scene.
        all_nodal: Whether cloths touch all bodies at their vertices, even without `nodal_contact`.
    """
    vertices, faces, vertex_start, face_start = _concatenate(scene.cloths)
    rest_positions, rest_faces, rest_start, _ = _concatenate(
        [Surface(cloth.rest_positions, cloth.rest_faces) for cloth in scene.cloths]
    )
    links = [
        (len(scene.bodies) + r, link, surface)
        for r, robot in enumerate(scene.robots)
        for link, surface in enumerate(robot.contact_surfaces)
        if surface is not None
    ]
    bodies_touch: list[_Surface] = [
        body if all_nodal else body.contact_surface for body in scene.bodies
    ]
    rigid: list[_Surface] = [*bodies_touch, *(surface for _, _, surface in links)]
    body_vertices, body_faces, body_vertex_start, body_face_start = _concatenate(rigid)
    owners = [(k, 0) for k in range(len(scene.bodies))] + [(t, link) for t, link, _ in links]
    surface_mechanism, surface_link = np.array(owners, dtype=np.int32).reshape(-1, 2).T.copy()
    pins, pin_groups = _concatenate_pins(scene, "pins", vertex_start)
    soft_pins, soft_pin_groups = _concatenate_pins(scene, "soft_pins", vertex_start)
    bodies = zip(scene.body_names, scene.bodies, strict=True)
    robots = zip(scene.robot_names, scene.robots, strict=True)
    joint_positions = _joined(robot.joint_positions for robot in scene.robots)
    return Assembly(
        vertices=vertices,
        rest_positions=rest_positions,
        rest_embedding=np.concatenate(
            [np.empty((0, 3)), *(cloth.rest_embedding for cloth in scene.cloths)]
        ),
        faces=faces,
        rest_faces=rest_faces,
        material_axes=_material_axes(scene),
        cloth_vertex_start=vertex_start,
        cloth_rest_start=rest_start,
        cloth_face_start=face_start,
        deforming_count=len(scene.deforming_bodies),
        pins=pins,
        soft_pins=soft_pins,
        pin_groups=pin_groups,
        soft_pin_groups=soft_pin_groups,
        springs=scene.springs,
        body_vertices=body_vertices,
        body_faces=body_faces,
        body_radii=np.array([getattr(surface, "radius", 0.0) for surface in rigid]),
        body_vertex_start=body_vertex_start,
        body_face_start=body_face_start,
        body_poses=np.array([body.pose for body in scene.bodies]).reshape(-1, 7),
        static_bodies=tuple(k for k, body in enumerate(scene.bodies) if body.motion == "static"),
        mechanisms=(
            *(_body_mechanism(name, body) for name, body in bodies),
            *(replace(robot.mechanism, name=name) for name, robot in robots),
        ),
        surface_mechanism=surface_mechanism,
        surface_link=surface_link,
        surface_names=scene.surface_names,
        ignored_pairs=_ignored_pairs(scene),
        primitives=(
            *(b.primitive if all_nodal or b.nodal_contact else None for b in scene.bodies),
            *(None for _ in links),
        ),
        base_poses=np.array([robot.pose for robot in scene.robots]).reshape(-1, 7),
        joint_slices=_slices(scene.robot_names, [len(r.joint_names) for r in scene.robots]),
        link_slices=_slices(scene.robot_names, [len(r.link_names) for r in scene.robots]),
        joint_positions=joint_positions,
        stiffness=_joined(robot.stiffness for robot in scene.robots),
        damping=_joined(robot.damping for robot in scene.robots),
        joint_viscosity=_joined(robot.viscosity for robot in scene.robots),
        joint_effort_limits=_joined(robot.effort_limits for robot in scene.robots),
        joint_velocity_limits=_joined(robot.velocity_limits for robot in scene.robots),
        joint_friction=_joined(robot.joint_friction for robot in scene.robots),
        joint_armature=np.zeros_like(joint_positions),
    )


def _material_axes(scene: Scene) -> FloatArray:
    """Axes of all cloths if one is woven, as parameters may make the others orthotropic, too."""
    if not any(cloth.material.is_orthotropic for cloth in scene.cloths):
        return np.empty((0, 2))
    cloths = zip(scene.cloth_names, scene.cloths, strict=True)
    return np.concatenate([cloth.material_axes(f"Scene: {name!r}") for name, cloth in cloths])


_BASES = {"static": "fixed", "kinematic": "kinematic", "dynamic": "floating"}


def _body_mechanism(name: str, body: RigidBody) -> Mechanism:
    return Mechanism(
        name=name,
        base=_BASES[body.motion],
        link_names=(name,),
        parent=np.array([-1], dtype=np.int32),
        kind=("fixed",),
        offset=np.eye(4)[None],
        axis=np.zeros((1, 3)),
        dof=np.array([-1], dtype=np.int32),
        multiplier=np.ones(1),
        constant=np.zeros(1),
        joint_names=(),
        lower=np.empty(0),
        upper=np.empty(0),
        actuation=(),
        mass=np.array([body.mass]),
        center=np.array([body.center]),
        inertia=np.array([body.inertia]),
    )


def _ignored_pairs(scene: Scene) -> IndexArray:
    """Pairs of links of one robot that touch by construction, and pairs that the scene names.

    Pairs of a deforming body and a surface with prescribed motion, itself included, are ignored
    too, as neither surface could yield. `sim/overlaps.py` adds the pairs that overlap, because
    that depends on positions.
    """
    index = {name: i for i, name in enumerate(scene.surface_names)}
    named = [] if isinstance(scene.ignore_contact, str) else list(scene.ignore_contact)
    for name, robot in zip(scene.robot_names, scene.robots, strict=True):
        pairs = list(robot.mechanism.adjacent_links)
        if not isinstance(robot.ignore_contact, str):
            pairs += robot.ignore_contact
        named += [(f"{name}/{a}", f"{name}/{b}") for a, b in pairs]
    deforming = scene.cloth_names[len(scene.cloths) - len(scene.deforming_bodies) :]
    named += [(a, b) for a in deforming for b in (*deforming, *_prescribed_surfaces(scene))]
    found = {
        (min(index[a], index[b]), max(index[a], index[b]))
        for a, b in named
        if a in index and b in index  # links without collision shapes are not surfaces
    }
    return np.array(sorted(found), dtype=np.int32).reshape(-1, 2)


def _prescribed_surfaces(scene: Scene) -> list[str]:
    """Names of bodies and of robots' links that forces do not move."""
    bodies = zip(scene.body_names, scene.bodies, strict=True)
    names = [name for name, body in bodies if body.motion != "dynamic"]
    for name, robot in zip(scene.robot_names, scene.robots, strict=True):
        if not robot.mechanism.is_dynamic:
            names += [f"{name}/{link}" for link in robot.link_names]
    return names


def _joined(parts: Iterable[FloatArray]) -> FloatArray:
    return np.concatenate([np.empty(0), *parts])


def _slices(names: Sequence[str], counts: Sequence[int]) -> dict[str, slice]:
    starts = np.cumsum([0, *counts]).tolist()
    return {name: slice(*rows) for name, rows in zip(names, pairwise(starts), strict=True)}


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
