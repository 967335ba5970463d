"""A scene: cloths, bodies, robots and gravity, and their arrays one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import (
    FloatArray,
    IndexArray,
    check_finite,
    check_pairs,
    check_shape,
    float_array,
    frozen,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.mechanism import Mechanism
from diffcloth_torch.model.rigid_body import Primitive, RigidBody
from diffcloth_torch.model.robot import Robot

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
        cloths: None only where a body or a robot moves by forces.
        bodies: Rigid bodies.
        robots: Robots.
        gravity: Acceleration [m/s^2], shape [3].
        ignore_contact: Pairs of names of surfaces that do not collide with each other.
        cloth_names: Names of the cloths; "cloth0", "cloth1" .. where none was given.
        body_names: Names of the bodies; "body0", "body1" .. where none was given.
        robot_names: Names of the robots; "robot0", "robot1" .. where none was given.
    """

    cloths: tuple[Cloth, ...]
    bodies: tuple[RigidBody, ...]
    # Without robots, for pickles that were made before scenes had them.
    robots: tuple[Robot, ...] = ()
    gravity: FloatArray
    ignore_contact: tuple[tuple[str, str], ...] = ()
    cloth_names: tuple[str, ...]
    body_names: tuple[str, ...]
    robot_names: tuple[str, ...] = ()

    def __init__(
        self,
        cloths: Iterable[Cloth],
        bodies: Iterable[RigidBody] = (),
        robots: Iterable[Robot] = (),
        *,
        gravity: object = (0.0, 0.0, -9.81),
        ignore_contact: Iterable[Sequence[str]] = (),
    ) -> None:
        """Check the arguments.

        Args:
            cloths: At least one cloth, or none where a body or a robot moves by forces.
            bodies: Bodies, in the order of `body_poses`.
            robots: Robots, in the order of `base_poses`; their joints follow one another likewise.
            gravity: Acceleration [m/s^2], shape [3].
            ignore_contact: Pairs of names of surfaces that do not collide with each other.

        Raises:
            InvalidInput: If nothing in the scene moves by forces, a name occurs twice, or a pair
                names what is no surface.
            TypeError: If something is not a Cloth, a RigidBody or a Robot.
        """
        self.cloths = _instances("cloths", cloths, Cloth)
        self.bodies = _instances("bodies", bodies, RigidBody)
        self.robots = _instances("robots", robots, Robot)
        if not self.cloths and not self.is_dynamic:
            raise InvalidInput(
                "Scene: `cloths` must hold at least one Cloth where no body is dynamic and no "
                "robot has a floating base or a joint under torque or pd"
            )
        self.cloth_names = tuple(c.name or f"cloth{i}" for i, c in enumerate(self.cloths))
        self.body_names = tuple(b.name or f"body{i}" for i, b in enumerate(self.bodies))
        self.robot_names = tuple(r.name or f"robot{i}" for i, r in enumerate(self.robots))
        _check_unique([*self.cloth_names, *self.body_names, *self.robot_names])
        instead = "differentiate with respect to Parameters.gravity"
        acceleration = float_array("Scene: `gravity`", gravity, instead=instead)
        check_shape("Scene: `gravity`", acceleration.shape, [(3,)])
        check_finite("Scene: `gravity`", acceleration)
        frozen(acceleration)
        self.gravity = acceleration
        self.ignore_contact = check_pairs(
            "Scene: `ignore_contact`", ignore_contact, self.surface_names
        )

    @property
    def is_dynamic(self) -> bool:
        """Whether a body or a robot moves by forces."""
        bodies = any(body.motion == "dynamic" for body in self.bodies)
        return bodies or any(robot.mechanism.is_dynamic for robot in self.robots)

    @property
    def surface_names(self) -> tuple[str, ...]:
        """Names of cloths and bodies, and "robot/link" of links that have collision shapes."""
        links = [
            f"{name}/{link}"
            for name, robot in zip(self.robot_names, self.robots, strict=True)
            for link, surface in zip(robot.link_names, robot.surfaces, strict=True)
            if surface is not None
        ]
        return (*self.cloth_names, *self.body_names, *links)

    def __repr__(self) -> str:
        robots = f", robots={list(self.robots)}" if self.robots else ""
        return f"Scene(cloths={list(self.cloths)}, bodies={list(self.bodies)}{robots})"


def _instances(field: str, given: Any, kind: type[S]) -> tuple[S, ...]:
    if not isinstance(given, Iterable) or getattr(given, "ndim", 1) == 0:
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
            raise InvalidInput(f"Scene: `name` must differ from all others, got {name!r} twice")


@dataclass(frozen=True, eq=False)
class Assembly:
    """The arrays of a scene: vertices, faces and pins of all cloths, then of bodies and links.

    Each body and each robot is a mechanism; there are T of them, bodies first.

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
        body_vertices: Of the K bodies in their frames, then of the Lc links that have collision
            shapes in theirs [m], shape [V, 3].
        body_faces: Indices into `body_vertices`, shape [G, 3].
        body_vertex_start: First vertex of each of these surfaces, and V; shape [K + Lc + 1].
        body_face_start: First face of each of them, and G; shape [K + Lc + 1].
        body_poses: Initial poses, shape [K, 7].
        static_bodies: Indices of the bodies that must not move.
        mechanisms: Of the bodies, then of the robots; length T.
        surface_mechanism: Mechanism of each surface after the cloths, shape [K + Lc].
        surface_link: Link of that mechanism, shape [K + Lc].
        surface_names: Of cloths, bodies and "robot/link"; length S.
        ignored_pairs: Pairs of surfaces a < b that are not tested for contact; shape [m, 2].
        primitives: Of each surface after the cloths, where cloths touch it at their vertices; None
            where they do not; length K + Lc.
        base_poses: Initial poses of the root links of robots, shape [R, 7].
        joint_slices: Name of a robot -> its rows among the J joints.
        link_slices: Name of a robot -> its rows among the L links.
        joint_positions: Initial [rad or m], shape [J].
        stiffness: Of the joints' drives [N m/rad or N/m], shape [J].
        damping: Of the joints' drives [N m s/rad or N s/m], shape [J].
        joint_viscosity: Damping of the joints' own [N m s/rad or N s/m], shape [J].
        joint_armature: Inertia of the drives' rotors on the joints [kg m^2 or kg], shape [J].
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
    joint_armature: FloatArray

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes by the letters that the tables of quantities have for them."""
        robots = self.mechanisms[self.body_count :]
        return {
            "N": len(self.vertices),
            "F": len(self.faces),
            "C": self.cloth_count,
            "K": self.body_count,
            "V": len(self.body_vertices),
            "S": self.surface_count,
            "P": len(self.pins),
            "Q": len(self.soft_pins),
            "J": len(self.joint_positions),
            "L": sum(robot.link_count for robot in robots),
            "R": len(robots),
        }

    @property
    def forced(self) -> NDArray[np.bool_]:
        """Which joints forces move, shape [J]: see `Mechanism.forced`."""
        return np.concatenate([np.empty(0, dtype=bool), *(m.forced for m in self.mechanisms)])

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
        """Number of surfaces, S = C + K + Lc."""
        return len(self.surface_names)


def assemble(scene: Scene, *, all_nodal: bool = False) -> Assembly:
    """Concatenate the arrays of a scene.

    Args:
        scene: The scene.
        all_nodal: Whether cloths touch all bodies at their vertices, asked or not.
    """
    vertices, faces, vertex_start, face_start = _concatenate(scene.cloths)
    links = [
        (len(scene.bodies) + r, link, surface)
        for r, robot in enumerate(scene.robots)
        for link, surface in enumerate(robot.surfaces)
        if surface is not None
    ]
    rigid: list[_Surface] = [*scene.bodies, *(surface for _, _, surface in links)]
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
        rest_vertices=np.concatenate(
            [np.empty((0, 3)), *(cloth.rest_vertices for cloth in scene.cloths)]
        ),
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
        joint_armature=np.zeros_like(joint_positions),
    )


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
    """Links of one robot that touch by construction, and what is named."""
    index = {name: i for i, name in enumerate(scene.surface_names)}
    named = list(scene.ignore_contact)
    for name, robot in zip(scene.robot_names, scene.robots, strict=True):
        pairs = [*robot.mechanism.adjacent_links, *robot.ignore_contact]
        named += [(f"{name}/{a}", f"{name}/{b}") for a, b in pairs]
    found = {
        (min(index[a], index[b]), max(index[a], index[b]))
        for a, b in named
        if a in index and b in index  # links without collision shapes are no surfaces
    }
    return np.array(sorted(found), dtype=np.int32).reshape(-1, 2)


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
