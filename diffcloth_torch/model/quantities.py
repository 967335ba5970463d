"""The inputs and outputs of a step, defined once: axes, unit, range and source.

Checks, shapes of the core's inputs, configurations and tests read these tables. Axes are numbers,
or letters for the sizes of a scene:

    N cloth vertices, F faces, C cloths, K bodies, R robots, L links of all robots, J joints that
    move and do not mimic, V vertices of bodies and links, S surfaces: cloths, bodies, links that
    have a shape; P pinned vertices, Q softly pinned vertices; A springs of attachments, U springs
    to targets; D vertices of deforming bodies. N, F, C and S count deforming bodies as the last
    cloths.

The leading axis of environments is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from torch import Tensor

from diffcloth_torch.checks import (
    ANY_NUMBER,
    LARGEST,
    NON_NEGATIVE,
    POISSON,
    POSITIVE,
    UNIT_INTERVAL,
    Range,
    check_number,
)

__all__ = [
    "CONTROL",
    "DERIVED",
    "FACE_QUANTITIES",
    "PARAMETERS",
    "STATE",
    "STORING",
    "Axes",
    "Fields",
    "Quantity",
    "Shape",
    "check_parameter",
    "shape_of",
]

Axes = tuple[int | str, ...]
Shape = tuple[int, ...]
Fields = dict[str, Tensor]
"""Values of quantities by name, with a leading axis of environments."""


class Quantity(NamedTuple):
    """A field of `State`, `Control` or `Parameters`.

    Attributes:
        name: Name of the field.
        unit: Unit of the field.
        axes: Accepted axes, from the fewest to the most.
        source: Default value if the field is not set: the named field of a class, "hold" (the value
            of the state before the step), "zero", the "result" of a step, or "released" (targets
            that are not set do not pull).
        accepted: Accepted values.
        core: Name of the core's input for this field; None if the field has no input of its own.
        ignored: Whether a step ignores the field.
        stores: Whether a stored energy may depend on the field: False for motion, loads and
            dissipation.
        at_rest: Value in a static equilibrium, where resistance to motion vanishes; None keeps the
            value of the field.
    """

    name: str
    unit: str
    axes: tuple[Axes, ...]
    source: str
    accepted: Range = ANY_NUMBER
    core: str | None = None
    ignored: bool = False
    stores: bool = True
    at_rest: float | None = None

    @property
    def row_shape(self) -> Shape:
        """Shape of one row of the core's input for a parameter; its other axes count rows."""
        return tuple(n for n in self.axes[-1][1:] if isinstance(n, int))


def _table(*quantities: Quantity) -> Mapping[str, Quantity]:
    return MappingProxyType({quantity.name: quantity for quantity in quantities})


_PER_FACE: tuple[Axes, ...] = ((), ("C",), ("N",), ("F",))
_PAIRS: tuple[Axes, ...] = ((), ("S", "S"))
_ONE: tuple[Axes, ...] = ((),)
_JOINTS: tuple[Axes, ...] = (("J",),)
_OF_SURFACES = "Material.{0}, RigidBody.{0}, Robot.{0}"
_POSES, _TWIST, _WRENCH = "m, -", "m/s, rad/s", "N, N m"

STATE = _table(
    Quantity("positions", "m", (("N", 3),), "result", core="positions"),
    Quantity("velocities", "m/s", (("N", 3),), "result", core="velocities", stores=False),
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
    Quantity("contact_forces", "N", (("N", 3),), "result", ignored=True),
    Quantity("pin_forces", "N", (("P", 3),), "result", ignored=True),
)
CONTROL = _table(
    Quantity("pins", "m", (("P", 3),), "hold", core="pin_targets", stores=False),
    Quantity("soft_pins", "m", (("Q", 3),), "hold", core="soft_pin_targets"),
    Quantity("body_poses", _POSES, (("K", 7),), "hold", core="body_targets", stores=False),
    Quantity("forces", "N", (("N", 3),), "zero", core="forces", stores=False),
    Quantity("body_wrenches", _WRENCH, (("K", 6),), "zero", stores=False),
    Quantity("joint_positions", "rad or m", _JOINTS, "hold", stores=False),
    Quantity("joint_velocities", "rad/s or m/s", _JOINTS, "zero", stores=False),
    Quantity("joint_efforts", "N m or N", _JOINTS, "zero", stores=False),
    Quantity("base_poses", _POSES, (("R", 7),), "hold", stores=False),
    Quantity("base_wrenches", _WRENCH, (("R", 6),), "zero", stores=False),
    Quantity("attachments", "m", (("U", 3),), "released", core="attachment_targets"),
    Quantity(
        "attachment_weights", "-", (("A",),), "released", UNIT_INTERVAL, core="attachment_weights"
    ),
    Quantity("wind", "m/s", ((3,),), "zero", core="wind", stores=False),
    Quantity("body_vertices", "m", (("D", 3),), "hold", stores=False),
)
_TAKEN_BY_THE_CORE = (
    Quantity("stretch", "N/m", _PER_FACE, "Material.stretch", POSITIVE),
    Quantity("bending", "N m", _PER_FACE, "Material.bending", NON_NEGATIVE),
    Quantity("poisson", "-", _PER_FACE, "Material.poisson", POISSON),
    Quantity("density", "kg/m^2", _PER_FACE, "Material.density", POSITIVE, stores=False),
    Quantity(
        "damping", "s", _PER_FACE, "Material.damping", NON_NEGATIVE, stores=False, at_rest=0.0
    ),
    Quantity("friction", "-", _PAIRS, _OF_SURFACES.format("friction"), NON_NEGATIVE, stores=False),
    Quantity("thickness", "m", (("S",),), _OF_SURFACES.format("thickness"), NON_NEGATIVE),
    Quantity("barrier_stiffness", "Pa", _PAIRS, "ContactOptions.barrier_stiffness", POSITIVE),
    Quantity("barrier_distance", "m", _ONE, "ContactOptions.barrier_distance", POSITIVE),
    Quantity("slip_velocity", "m/s", _ONE, "ContactOptions.slip_velocity", POSITIVE, stores=False),
    Quantity("pin_stiffness", "N/m", ((), ("C",)), "Cloth.pin_stiffness", POSITIVE),
    Quantity("gravity", "m/s^2", ((3,),), "Scene.gravity", stores=False),
    Quantity("rest_positions", "m", (("M", 3),), "Cloth.rest_positions"),
    Quantity("attachment_stiffness", "N/m", (("A",),), "Attachment.stiffness", POSITIVE),
    Quantity(
        "normal_drag",
        "-",
        _PER_FACE,
        "Material.normal_drag",
        NON_NEGATIVE,
        stores=False,
        at_rest=0.0,
    ),
    Quantity(
        "tangential_drag",
        "-",
        _PER_FACE,
        "Material.tangential_drag",
        NON_NEGATIVE,
        stores=False,
        at_rest=0.0,
    ),
    Quantity("air_density", "kg/m^3", _ONE, "Scene.air_density", NON_NEGATIVE, stores=False),
)
_OF_WOVEN_CLOTH = (
    Quantity("stretch_weft", "N/m", _PER_FACE, "Material.stretch_weft", POSITIVE),
    Quantity("stretch_shear", "N/m", _PER_FACE, "Material.stretch_shear", POSITIVE),
    Quantity("bending_weft", "N m", _PER_FACE, "Material.bending_weft", NON_NEGATIVE),
    Quantity("bending_twill", "N m", _PER_FACE, "Material.bending_twill", NON_NEGATIVE),
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
    Quantity(
        "joint_damping",
        "N m s/rad or N s/m",
        _JOINTS,
        "Robot.damping",
        NON_NEGATIVE,
        stores=False,
        at_rest=0.0,
    ),
    Quantity(
        "joint_viscosity",
        "N m s/rad or N s/m",
        _JOINTS,
        "Robot.viscosity",
        NON_NEGATIVE,
        stores=False,
        at_rest=0.0,
    ),
    Quantity("joint_armature", "kg m^2 or kg", _JOINTS, "zero", NON_NEGATIVE),
    *(quantity._replace(core=quantity.name) for quantity in _OF_WOVEN_CLOTH),
    Quantity("joint_effort_limits", "N m or N", _JOINTS, "Robot.effort_limits", POSITIVE),
    Quantity(
        "joint_velocity_limits",
        "rad/s or m/s",
        _JOINTS,
        "Robot.velocity_limits",
        POSITIVE,
        stores=False,
        at_rest=LARGEST,
    ),
    Quantity("joint_friction", "N m or N", _JOINTS, "Robot.joint_friction", NON_NEGATIVE),
    Quantity("joint_slip_rates", "rad/s or m/s", _JOINTS, "ContactOptions.slip_velocity", POSITIVE),
)
DERIVED = (
    "coordinates",
    "coordinate_ends",
    "coordinate_targets",
    "coordinate_metric",
    "joint_terms",
    "friction_origins",
)
"""Inputs of the core that follow from several fields and drive the coordinates of bodies."""
STORING = frozenset(
    ("coordinates", *(q.core for t in (STATE, CONTROL, PARAMETERS) for q in t.values() if q.stores))
) - {None}
"""Inputs of the core on which a stored energy may depend."""
FACE_QUANTITIES = tuple(name for name, quantity in PARAMETERS.items() if quantity.axes == _PER_FACE)
"""Names of the parameters that may differ from face to face."""


def shape_of(axes: Axes, sizes: Mapping[str, int]) -> Shape:
    """Replace the letters of axes by the sizes of a scene."""
    return tuple(n if isinstance(n, int) else sizes[n] for n in axes)


def check_parameter(owner: str, name: str, value: object) -> float:
    """Check the number of an owner's field against the parameter of the same name."""
    instead = f"differentiate with respect to Parameters.{name}"
    return check_number(f"{owner}: `{name}`", value, PARAMETERS[name].accepted, instead=instead)
