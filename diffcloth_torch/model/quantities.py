"""The quantities that a step takes and returns, each said once: axes, unit, accepted range, source.

Checks, the shapes of what the core gets, configurations and tests read these tables. Axes are
numbers, or letters that stand for a size of the scene:

    N cloth vertices, F faces, C cloths, K bodies, R robots, L links of all robots, J joints that
    move and do not mimic, V vertices of bodies and links, S surfaces: cloths, bodies, links that
    have a shape; P pinned vertices, Q softly pinned ones.

A leading axis of environments is never written.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from diffcloth_torch.checks import ANY_NUMBER, NON_NEGATIVE, POISSON, POSITIVE, Range, check_number

__all__ = [
    "CONTROL",
    "DERIVED",
    "FACE_QUANTITIES",
    "PARAMETERS",
    "STATE",
    "Axes",
    "Quantity",
    "Shape",
    "check_parameter",
    "shape_of",
]

Axes = tuple[int | str, ...]
Shape = tuple[int, ...]


class Quantity(NamedTuple):
    """A field of `State`, `Control` or `Parameters`.

    Attributes:
        name: Of the field.
        unit: Its unit.
        axes: Accepted axes, from the fewest to the most.
        source: What it is where it is not set: that field of a class, "hold" (what the state before
            the step has), "zero", or the "result" of a step.
        accepted: Accepted values.
        core: Name of the core's input that it becomes; None where it becomes none of its own.
        ignored: Whether a step does not look at it.
    """

    name: str
    unit: str
    axes: tuple[Axes, ...]
    source: str
    accepted: Range = ANY_NUMBER
    core: str | None = None
    ignored: bool = False

    @property
    def row_shape(self) -> Shape:
        """Shape of one row of the input that a parameter becomes; what is left are rows."""
        return tuple(n for n in self.axes[-1][1:] if isinstance(n, int))


def _table(*quantities: Quantity) -> Mapping[str, Quantity]:
    return MappingProxyType({quantity.name: quantity for quantity in quantities})


_PER_FACE: tuple[Axes, ...] = ((), ("C",), ("F",))
_PAIRS: tuple[Axes, ...] = ((), ("S", "S"))
_ONE: tuple[Axes, ...] = ((),)
_JOINTS: tuple[Axes, ...] = (("J",),)
_OF_SURFACES = "Material.{0}, RigidBody.{0}, Robot.{0}"
_POSES, _TWIST, _WRENCH = "m, -", "m/s, rad/s", "N, N m"

STATE = _table(
    Quantity("positions", "m", (("N", 3),), "result", core="positions"),
    Quantity("velocities", "m/s", (("N", 3),), "result", core="velocities"),
    Quantity("body_poses", _POSES, (("K", 7),), "result", core="body_poses"),
    Quantity("soft_pin_targets", "m", (("Q", 3),), "result", core="soft_pin_targets"),
    Quantity("body_forces", "N", (("V", 3),), "result", ignored=True),
    Quantity("time", "s", _ONE, "result"),
    Quantity("body_velocities", _TWIST, (("K", 6),), "result"),
    Quantity("joint_positions", "rad or m", _JOINTS, "result"),
    Quantity("joint_velocities", "rad/s or m/s", _JOINTS, "result"),
    Quantity("joint_targets", "rad or m", _JOINTS, "result"),
    Quantity("joint_efforts", "N m or N", _JOINTS, "result", ignored=True),
    Quantity("base_poses", _POSES, (("R", 7),), "result"),
    Quantity("base_velocities", _TWIST, (("R", 6),), "result"),
)
CONTROL = _table(
    Quantity("pins", "m", (("P", 3),), "hold", core="pin_targets"),
    Quantity("soft_pins", "m", (("Q", 3),), "hold", core="soft_pin_targets"),
    Quantity("body_poses", _POSES, (("K", 7),), "hold", core="body_targets"),
    Quantity("forces", "N", (("N", 3),), "zero", core="forces"),
    Quantity("body_wrenches", _WRENCH, (("K", 6),), "zero"),
    Quantity("joint_positions", "rad or m", _JOINTS, "hold"),
    Quantity("joint_velocities", "rad/s or m/s", _JOINTS, "zero"),
    Quantity("joint_efforts", "N m or N", _JOINTS, "zero"),
    Quantity("base_poses", _POSES, (("R", 7),), "hold"),
    Quantity("base_wrenches", _WRENCH, (("R", 6),), "zero"),
)
_TAKEN_BY_THE_CORE = (
    Quantity("stretch", "N/m", _PER_FACE, "Material.stretch", POSITIVE),
    Quantity("bending", "N m", _PER_FACE, "Material.bending", NON_NEGATIVE),
    Quantity("poisson", "-", _PER_FACE, "Material.poisson", POISSON),
    Quantity("density", "kg/m^2", _PER_FACE, "Material.density", POSITIVE),
    Quantity("damping", "s", _PER_FACE, "Material.damping", NON_NEGATIVE),
    Quantity("friction", "-", _PAIRS, _OF_SURFACES.format("friction"), NON_NEGATIVE),
    Quantity("thickness", "m", (("S",),), _OF_SURFACES.format("thickness"), NON_NEGATIVE),
    Quantity("barrier_stiffness", "Pa", _PAIRS, "ContactOptions.barrier_stiffness", POSITIVE),
    Quantity("barrier_distance", "m", _ONE, "ContactOptions.barrier_distance", POSITIVE),
    Quantity("slip_velocity", "m/s", _ONE, "ContactOptions.slip_velocity", POSITIVE),
    Quantity("pin_stiffness", "N/m", ((), ("C",)), "Cloth.pin_stiffness", POSITIVE),
    Quantity("gravity", "m/s^2", ((3,),), "Scene.gravity"),
    Quantity("rest_positions", "m", (("N", 3),), "Cloth.rest_vertices"),
)
PARAMETERS = _table(
    *(quantity._replace(core=quantity.name) for quantity in _TAKEN_BY_THE_CORE),
    Quantity("body_mass", "kg", (("K",),), "RigidBody.mass", NON_NEGATIVE),
    Quantity("body_center", "m", (("K", 3),), "RigidBody.center"),
    Quantity("body_inertia", "kg m^2", (("K", 3, 3),), "RigidBody.inertia"),
    Quantity("link_mass", "kg", (("L",),), "Robot.mechanism", NON_NEGATIVE),
    Quantity("link_center", "m", (("L", 3),), "Robot.mechanism"),
    Quantity("link_inertia", "kg m^2", (("L", 3, 3),), "Robot.mechanism"),
    Quantity("joint_stiffness", "N m/rad or N/m", _JOINTS, "Robot.stiffness", NON_NEGATIVE),
    Quantity("joint_damping", "N m s/rad or N s/m", _JOINTS, "Robot.damping", NON_NEGATIVE),
    Quantity("joint_viscosity", "N m s/rad or N s/m", _JOINTS, "Robot.viscosity", NON_NEGATIVE),
    Quantity("joint_armature", "kg m^2 or kg", _JOINTS, "zero", NON_NEGATIVE),
)
DERIVED = (
    "coordinates",
    "coordinate_ends",
    "coordinate_targets",
    "coordinate_metric",
    "coordinate_origins",
)
"""Inputs of the core that follow from several fields: what drives the coordinates of bodies."""
FACE_QUANTITIES = tuple(name for name, quantity in PARAMETERS.items() if quantity.axes == _PER_FACE)
"""Names of the parameters that may differ from face to face."""


def shape_of(axes: Axes, sizes: Mapping[str, int]) -> Shape:
    """Axes with the sizes of a scene in place of letters."""
    return tuple(n if isinstance(n, int) else sizes[n] for n in axes)


def check_parameter(owner: str, name: str, value: object) -> float:
    """Check the number that an owner's field gives to the parameter of the same name."""
    instead = f"differentiate with respect to Parameters.{name}"
    return check_number(f"{owner}: `{name}`", value, PARAMETERS[name].accepted, instead=instead)
