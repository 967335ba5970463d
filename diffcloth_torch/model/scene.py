"""A scene: cloths, bodies, robots and gravity."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

from diffcloth_torch.checks import (
    ArrayLike,
    FloatArray,
    check_finite,
    check_ignored_pairs,
    check_shape,
    float_array,
    frozen,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.attachment import Attachment
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.deforming_body import DeformingBody
from diffcloth_torch.model.quantities import check_parameter
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.model.robot import Robot
from diffcloth_torch.model.springs import AttachedSurface, Springs, make_springs, surfaces_of
from diffcloth_torch.saved import saved

__all__ = ["Scene"]

_AIR_DENSITY = 1.2  # [kg/m^3], dry, at 20 degrees Celsius and sea level

S = TypeVar("S")


@saved
class Scene:
    """The cloths, bodies and robots to simulate, and gravity. Immutable.

    Attributes:
        cloths: Cloths, then deforming bodies; empty only if a body or a robot is dynamic.
        bodies: Rigid bodies.
        deforming_bodies: Bodies that deform by prescription.
        robots: Robots.
        gravity: Acceleration [m/s^2], shape [3].
        air_density: Density of the air [kg/m^3], which acts on cloths with drag.
        ignore_contact: Pairs of names of surfaces that do not collide with each other, or
            "overlapping".
        cloth_names: Names of the cloths, by default "cloth0", "cloth1" ..; then of the deforming
            bodies, by default "deforming0" .. .
        body_names: Names of the bodies; by default "body0", "body1" .. .
        robot_names: Names of the robots; by default "robot0", "robot1" .. .
        attachments: Springs between points of the scene, or to targets.
        attachment_names: Names of the attachments; by default "attachment0", "attachment1" .. .
        springs: The springs of all attachments, as arrays.
    """

    cloths: tuple[Cloth, ...]
    bodies: tuple[RigidBody, ...]
    deforming_bodies: tuple[DeformingBody, ...] = ()
    robots: tuple[Robot, ...]
    gravity: FloatArray
    air_density: float
    ignore_contact: tuple[tuple[str, str], ...] | str
    cloth_names: tuple[str, ...]
    body_names: tuple[str, ...]
    robot_names: tuple[str, ...]
    attachments: tuple[Attachment, ...]
    attachment_names: tuple[str, ...]
    springs: Springs

    def __init__(
        self,
        cloths: Iterable[Cloth],
        bodies: Iterable[RigidBody | DeformingBody] = (),
        robots: Iterable[Robot] = (),
        *,
        gravity: ArrayLike = (0.0, 0.0, -9.81),
        air_density: float = _AIR_DENSITY,
        ignore_contact: Iterable[Sequence[str]] | str = (),
        attachments: Iterable[Attachment] = (),
    ) -> None:
        """Check the arguments.

        Args:
            cloths: At least one cloth; may be empty if a body or a robot is dynamic.
            bodies: Bodies: rigid bodies in the order of `body_poses`, deforming bodies in the order
                of `Control.body_vertices`.
            robots: Robots, in the order of `base_poses`; their joints are numbered in the same
                order.
            gravity: Acceleration [m/s^2], shape [3].
            air_density: Density of the air [kg/m^3], >= 0; by default the density at 20 degrees
                Celsius.
            ignore_contact: Pairs of names of surfaces that do not collide with each other, or
                "overlapping": the pairs of bodies and links that intersect, touch or are closer
                than their thickness in the initial state.
            attachments: Springs between points of the scene, or to targets.

        Raises:
            InvalidInput: If forces move nothing in the scene, a name occurs twice, a name in a pair
                belongs to no surface, or an attachment refers to a surface or vertex that the scene
                does not have.
            TypeError: If an item is not a Cloth, a RigidBody, a DeformingBody, a Robot or an
                Attachment.
        """
        sheets = _instances("cloths", cloths, Cloth)
        for i, sheet in enumerate(sheets):
            if isinstance(sheet, DeformingBody):
                raise TypeError(
                    f"Scene: `bodies` must hold DeformingBody objects, not `cloths`[{i}]"
                )
        given: tuple[Any, ...] = _instances("bodies", bodies, RigidBody, DeformingBody)
        self.bodies = tuple(body for body in given if isinstance(body, RigidBody))
        self.deforming_bodies = tuple(body for body in given if isinstance(body, DeformingBody))
        self.cloths = (*sheets, *self.deforming_bodies)
        self.robots = _instances("robots", robots, Robot)
        if not sheets and not self.is_dynamic:
            raise InvalidInput(
                "Scene: `cloths` must hold at least one Cloth where no body is dynamic and no "
                "robot has a floating base or a joint under torque or pd"
            )
        if not sheets and self.deforming_bodies:
            raise InvalidInput(
                "Scene: `cloths` must hold at least one Cloth where a body deforms by prescription"
            )
        self.cloth_names = (
            *(c.name or f"cloth{i}" for i, c in enumerate(sheets)),
            *(b.name or f"deforming{i}" for i, b in enumerate(self.deforming_bodies)),
        )
        self.body_names = tuple(b.name or f"body{i}" for i, b in enumerate(self.bodies))
        self.robot_names = tuple(r.name or f"robot{i}" for i, r in enumerate(self.robots))
        _check_unique([*self.cloth_names, *self.body_names, *self.robot_names])
        instead = "differentiate with respect to Parameters.gravity"
        acceleration = float_array("Scene: `gravity`", gravity, instead=instead)
        check_shape("Scene: `gravity`", acceleration.shape, [(3,)])
        check_finite("Scene: `gravity`", acceleration)
        frozen(acceleration)
        self.gravity = acceleration
        self.air_density = check_parameter("Scene", "air_density", air_density)
        self.ignore_contact = check_ignored_pairs(
            "Scene: `ignore_contact`", ignore_contact, self.surface_names
        )
        self.attachments = _instances("attachments", attachments, Attachment)
        self.attachment_names = tuple(
            a.name or f"attachment{i}" for i, a in enumerate(self.attachments)
        )
        _check_unique(self.attachment_names)
        self.springs = make_springs(self.attachment_names, self.attachments, self._attached())

    @property
    def is_dynamic(self) -> bool:
        """True if any body or robot is dynamic, i.e., moved by forces."""
        bodies = any(body.motion == "dynamic" for body in self.bodies)
        return bodies or any(robot.mechanism.is_dynamic for robot in self.robots)

    @property
    def surface_names(self) -> tuple[str, ...]:
        """Names of cloths and bodies, and "robot/link" for links that have collision shapes."""
        links = [
            f"{name}/{link}"
            for name, robot in zip(self.robot_names, self.robots, strict=True)
            for link, surface in zip(robot.link_names, robot.surfaces, strict=True)
            if surface is not None
        ]
        return (*self.cloth_names, *self.body_names, *links)

    def _attached(self) -> dict[str, AttachedSurface]:
        shaped = [s for robot in self.robots for s in robot.contact_surfaces if s is not None]
        vertices = [cloth.vertices for cloth in self.cloths]
        # Smooth bodies and links are attached at the points of their skeletons, which the core has.
        vertices += [body.contact_surface.vertices for body in self.bodies]
        vertices += [s.vertices for s in shaped]
        return surfaces_of(self.surface_names, vertices, len(self.cloths))

    def __repr__(self) -> str:
        robots = f", robots={list(self.robots)}" if self.robots else ""
        attached = f", attachments={list(self.attachments)}" if self.attachments else ""
        return f"Scene(cloths={list(self.cloths)}, bodies={list(self.bodies)}{robots}{attached})"


def _instances(field: str, given: Any, kind: type[S], *others: type) -> tuple[S, ...]:
    if not isinstance(given, Iterable) or getattr(given, "ndim", 1) == 0:
        raise TypeError(f"Scene: `{field}` must be a list of {kind.__name__}")
    items: list[Any] = []
    for i, item in enumerate(given):
        if not isinstance(item, (kind, *others)):
            names = " or ".join(cls.__name__ for cls in (kind, *others))
            raise TypeError(
                f"Scene: `{field}` must hold {names} objects, got {type(item).__name__} at [{i}]"
            )
        items.append(item)
    return tuple(items)


def _check_unique(names: Sequence[str]) -> None:
    for i, name in enumerate(names):
        if name in names[:i]:
            raise InvalidInput(f"Scene: `name` must differ from all others, got {name!r} twice")
