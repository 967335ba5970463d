"""The quantities that a step takes and returns, each said once: axes, unit, accepted range, source.

Checks, the shapes of what the core gets, configurations and tests read these tables. Axes are
numbers, or letters that stand for a size of the scene:

    N cloth vertices, F faces, C cloths, K bodies, V body vertices, S = C + K surfaces,
    P pinned vertices, Q softly pinned ones.

A leading axis of environments is never written.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from diffcloth_torch.checks import ANY_NUMBER, NON_NEGATIVE, POISSON, POSITIVE, Range, check_number

__all__ = [
    "CONTROL",
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
        core: Name of the core's input that it becomes; None where a step does not look at it.
    """

    name: str
    unit: str
    axes: tuple[Axes, ...]
    source: str
    accepted: Range = ANY_NUMBER
    core: str | None = None

    @property
    def core_axes(self) -> Shape:
        """Axes of the core's input behind that of the environments, -1 for what is left."""
        return (-1, *(n for n in self.axes[-1][1:] if isinstance(n, int)))


def _table(*quantities: Quantity) -> Mapping[str, Quantity]:
    return MappingProxyType({quantity.name: quantity for quantity in quantities})


def _parameters(*quantities: Quantity) -> Mapping[str, Quantity]:
    """Parameters have one name everywhere."""
    return _table(*(quantity._replace(core=quantity.name) for quantity in quantities))


_PER_FACE: tuple[Axes, ...] = ((), ("C",), ("F",))
_PAIRS: tuple[Axes, ...] = ((), ("S", "S"))
_ONE: tuple[Axes, ...] = ((),)

STATE = _table(
    Quantity("positions", "m", (("N", 3),), "result", core="positions"),
    Quantity("velocities", "m/s", (("N", 3),), "result", core="velocities"),
    Quantity("body_poses", "m, -", (("K", 7),), "result", core="body_poses"),
    Quantity("soft_pin_targets", "m", (("Q", 3),), "result", core="soft_pin_targets"),
    Quantity("body_forces", "N", (("V", 3),), "result"),
    Quantity("time", "s", _ONE, "result"),
)
CONTROL = _table(
    Quantity("pins", "m", (("P", 3),), "hold", core="pin_targets"),
    Quantity("soft_pins", "m", (("Q", 3),), "hold", core="soft_pin_targets"),
    Quantity("body_poses", "m, -", (("K", 7),), "hold", core="body_targets"),
    Quantity("forces", "N", (("N", 3),), "zero", core="forces"),
)
PARAMETERS = _parameters(
    Quantity("stretch", "N/m", _PER_FACE, "Material.stretch", POSITIVE),
    Quantity("bending", "N m", _PER_FACE, "Material.bending", NON_NEGATIVE),
    Quantity("poisson", "-", _PER_FACE, "Material.poisson", POISSON),
    Quantity("density", "kg/m^2", _PER_FACE, "Material.density", POSITIVE),
    Quantity("damping", "s", _PER_FACE, "Material.damping", NON_NEGATIVE),
    Quantity("friction", "-", _PAIRS, "Material.friction, RigidBody.friction", NON_NEGATIVE),
    Quantity("thickness", "m", (("S",),), "Material.thickness, RigidBody.thickness", NON_NEGATIVE),
    Quantity("barrier_stiffness", "Pa", _ONE, "ContactOptions.barrier_stiffness", POSITIVE),
    Quantity("barrier_distance", "m", _ONE, "ContactOptions.barrier_distance", POSITIVE),
    Quantity("slip_velocity", "m/s", _ONE, "ContactOptions.slip_velocity", POSITIVE),
    Quantity("pin_stiffness", "N/m", ((), ("C",)), "Cloth.pin_stiffness", POSITIVE),
    Quantity("gravity", "m/s^2", ((3,),), "Scene.gravity"),
    Quantity("rest_positions", "m", (("N", 3),), "Cloth.rest_vertices"),
)
FACE_QUANTITIES = tuple(name for name, quantity in PARAMETERS.items() if quantity.axes == _PER_FACE)
"""Names of the parameters that may differ from face to face."""


def shape_of(axes: Axes, sizes: Mapping[str, int]) -> Shape:
    """Axes with the sizes of a scene in place of letters."""
    return tuple(n if isinstance(n, int) else sizes[n] for n in axes)


def check_parameter(owner: str, name: str, value: object) -> float:
    """Check the number that an owner's field gives to the parameter of the same name."""
    instead = f"differentiate with respect to Parameters.{name}"
    return check_number(f"{owner}: `{name}`", value, PARAMETERS[name].accepted, instead=instead)
