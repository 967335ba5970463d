"""A robot: its mechanism, the surfaces of its links, and how its joints are driven."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from diffcloth_torch.checks import (
    ANY_NUMBER,
    NON_NEGATIVE,
    FloatArray,
    Range,
    check_name,
    check_pairs,
    check_range,
    check_shape,
    float_array,
    frozen,
    texts,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.poses import pose_array
from diffcloth_torch.geometry.surfaces import Surface
from diffcloth_torch.model.mechanism import Mechanism
from diffcloth_torch.model.quantities import PARAMETERS

__all__ = ["ACTUATIONS", "BASES", "Robot"]

BASES = ("fixed", "kinematic", "floating")
ACTUATIONS = ("position", "velocity", "torque", "pd")

_POSE = "differentiate with respect to State.base_poses or Control.base_poses"


class Robot:
    """Links joined by joints; immutable. Made by `Robot.load`.

    Attributes:
        mechanism: Its tree of links and joints.
        surfaces: Collision surface of each of the L links in the link's frame, or None; length L.
        pose: Initial pose of the root link [px, py, pz, qw, qx, qy, qz], shape [7].
        joint_positions: Initial [rad or m], shape [J].
        stiffness: Of the drives of "pd" joints [N m/rad or N/m], zero for others; shape [J].
        damping: Likewise [N m s/rad or N s/m], shape [J].
        viscosity: Damping that the joints have of their own, likewise; shape [J].
        friction: Friction coefficient of each link's surface [-], shape [L].
        thickness: Full thickness of each link's surface [m], shape [L].
        ignore_contact: Pairs of names of links that do not collide with each other.
        name: Name in the scene; None lets the scene choose one.
    """

    mechanism: Mechanism
    surfaces: tuple[Surface | None, ...]
    pose: FloatArray
    joint_positions: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    viscosity: FloatArray
    friction: FloatArray
    thickness: FloatArray
    ignore_contact: tuple[tuple[str, str], ...]
    name: str | None

    def __init__(
        self,
        mechanism: Mechanism,
        surfaces: Sequence[Surface | None],
        viscosity: FloatArray,
        *,
        pose: object = None,
        joint_positions: object = None,
        stiffness: object = None,
        damping: object = None,
        friction: object = 0.4,
        thickness: object = 0.0,
        ignore_contact: Iterable[Sequence[str]] = (),
        name: str | None = None,
    ) -> None:
        self.mechanism = mechanism
        self.surfaces = tuple(surfaces)
        self.viscosity = frozen(viscosity)
        self.pose = frozen(pose_array("Robot: `pose`", pose, instead=_POSE))
        joints, links = self.joint_names, self.link_names
        self.joint_positions = _named("joint_positions", joint_positions, joints, 0.0)
        _check_limits(mechanism, self.joint_positions)
        driven = np.array([mode == "pd" for mode in mechanism.actuation], dtype=bool)
        self.stiffness = frozen(driven * _named("stiffness", stiffness, joints, 0.0, NON_NEGATIVE))
        self.damping = frozen(driven * _named("damping", damping, joints, 0.0, NON_NEGATIVE))
        self.friction = _named("friction", friction, links, 0.4, NON_NEGATIVE)
        self.thickness = _named("thickness", thickness, links, 0.0, NON_NEGATIVE)
        self.ignore_contact = check_pairs("Robot: `ignore_contact`", ignore_contact, links)
        self.name = check_name("Robot: `name`", name)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the J joints that move and do not mimic, in the order of the file."""
        return self.mechanism.joint_names

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of the L links, in the order of the file."""
        return self.mechanism.link_names

    def __repr__(self) -> str:
        return (
            f"Robot({self.name!r}, {self.mechanism.base}, {len(self.joint_names)} joints, "
            f"{len(self.link_names)} links)"
        )


def _named(
    field: str, given: object, names: Sequence[str], default: float, accepted: Range = ANY_NUMBER
) -> FloatArray:
    """One value for each name, from one for all, from name -> value, or from an array of them."""
    label = f"Robot: `{field}`"
    if field in PARAMETERS:
        instead = f"differentiate with respect to Parameters.{field}"
    else:
        instead = "differentiate with respect to the field of State or Parameters"
    if isinstance(given, Mapping):
        values = np.full(len(names), default)
        for key, value in given.items():
            if key not in names:
                raise InvalidInput(f"{label} has the names {texts(names)}; got {key!r}")
            number = float_array(f"{label}[{key!r}]", value, instead=instead)
            check_shape(f"{label}[{key!r}]", number.shape, [()])
            values[names.index(key)] = number
    else:
        values = float_array(label, default if given is None else given, instead=instead)
        check_shape(label, values.shape, [(), (len(names),)])
        values = np.array(np.broadcast_to(values, len(names)))
    check_range(label, values, accepted)
    return frozen(values)


def _check_limits(mechanism: Mechanism, positions: FloatArray) -> None:
    outside = (positions < mechanism.lower) | (positions > mechanism.upper)
    if outside.any():
        j = int(np.flatnonzero(outside)[0])
        raise InvalidInput(
            f"Robot: `joint_positions` of {mechanism.joint_names[j]!r} must be between its limits "
            f"{mechanism.lower[j]:g} and {mechanism.upper[j]:g}, got {positions[j]:g} at [{j}]"
        )
