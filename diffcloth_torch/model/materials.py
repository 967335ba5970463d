"""The material of a cloth."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from diffcloth_torch.checks import (
    FloatArray,
    check_range,
    check_shape,
    float_array,
    frozen,
)
from diffcloth_torch.model.quantities import FACE_QUANTITIES, PARAMETERS, check_parameter
from diffcloth_torch.reprs import field_text, record_text

__all__ = ["Material"]


@dataclass(frozen=True, eq=False)
class Material:
    """Properties of a cloth; numbers, or one value per face for all but friction and thickness.

    Attributes:
        stretch: Membrane stiffness [N/m], > 0.
        bending: Bending stiffness [N m], >= 0.
        poisson: Poisson ratio of bending [-], between -1 and 0.5.
        density: Mass per rest area [kg/m^2], > 0.
        damping: Time over which strain rates are damped [s], >= 0.
        friction: Friction coefficient of the surface [-], >= 0.
        thickness: Full thickness of the surface in contact [m], >= 0.
        normal_drag: Coefficient of the pressure of air that flows across the faces [-], >= 0; about
            1 to 2 for cloth that no air passes through.
        tangential_drag: Coefficient of the friction of air that flows along them, of both sides
            together [-], >= 0; a few hundredths.
    """

    stretch: float | FloatArray = 550.0
    bending: float | FloatArray = 1e-5
    poisson: float | FloatArray = 0.3
    density: float | FloatArray = 0.124
    damping: float | FloatArray = 0.0
    friction: float = 0.4
    thickness: float = 0.0
    normal_drag: float | FloatArray = 0.0
    tangential_drag: float | FloatArray = 0.0

    def __post_init__(self) -> None:
        for field in FACE_QUANTITIES:
            name = f"Material: `{field}`"
            instead = f"differentiate with respect to Parameters.{field}"
            values = float_array(name, getattr(self, field), instead=instead)
            check_shape(name, values.shape, [(), ("F",)])
            check_range(name, values, PARAMETERS[field].accepted)
            self._keep(field, frozen(values) if values.ndim else float(values))
        for field in ("friction", "thickness"):
            self._keep(field, check_parameter("Material", field, getattr(self, field)))

    def __repr__(self) -> str:
        return record_text(
            "Material", (field_text(f.name, getattr(self, f.name)) for f in fields(self))
        )

    def _keep(self, field: str, value: Any) -> None:
        object.__setattr__(self, field, value)
