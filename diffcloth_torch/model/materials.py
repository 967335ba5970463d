"""The material of a cloth."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from diffcloth_torch.checks import (
    FloatArray,
    check_range,
    check_shape,
    float_array,
    frozen,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.orthotropy import STAND_INS, check_bending
from diffcloth_torch.model.quantities import FACE_QUANTITIES, PARAMETERS, check_parameter
from diffcloth_torch.reprs import field_text, record_text
from diffcloth_torch.saved import saved

__all__ = ["Material"]


@saved
@dataclass(frozen=True, eq=False)
class Material:
    """Properties of a cloth; numbers, or one value per face for all but friction and thickness.

    A cloth is isotropic unless one of the last four attributes is set. Woven cloth stretches and
    bends differently along its warp (`Cloth.directions`) and its weft; attributes that are not set
    have the value along the warp.

    Attributes:
        stretch: Membrane stiffness [N/m], > 0; for woven cloth, along the warp.
        bending: Bending stiffness [N m], >= 0; for woven cloth, along the warp.
        poisson: Poisson ratio of bending [-], between -1 and 0.5.
        density: Mass per rest area [kg/m^2], > 0.
        damping: Time over which strain rates are damped [s], >= 0.
        friction: Friction coefficient of the surface [-], >= 0.
        thickness: Full thickness of the surface in contact [m], >= 0.
        normal_drag: Coefficient of the pressure of air that flows across the faces [-], >= 0; about
            1 to 2 for airtight cloth.
        tangential_drag: Coefficient of the friction of air that flows along the faces, both sides
            together [-], >= 0; a few hundredths.
        stretch_weft: Membrane stiffness along the weft [N/m], > 0.
        stretch_shear: Membrane stiffness in shear between warp and weft [N/m], > 0.
        bending_weft: Bending stiffness along the weft [N m], > 0 where `bending` is > 0.
        bending_twill: Bending stiffness at 45 degrees to warp and weft [N m], at least
            (bending + bending_weft + 2 poisson sqrt(bending bending_weft)) / 4.
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
    stretch_weft: float | FloatArray | None = None
    stretch_shear: float | FloatArray | None = None
    bending_weft: float | FloatArray | None = None
    bending_twill: float | FloatArray | None = None

    def __post_init__(self) -> None:
        for field in FACE_QUANTITIES:
            if field in STAND_INS and getattr(self, field) is None:
                continue
            name = f"Material: `{field}`"
            instead = f"differentiate with respect to Parameters.{field}"
            values = float_array(name, getattr(self, field), instead=instead)
            check_shape(name, values.shape, [(), ("F",)])
            check_range(name, values, PARAMETERS[field].accepted)
            self._keep(field, frozen(values) if values.ndim else float(values))
        for field in ("friction", "thickness"):
            self._keep(field, check_parameter("Material", field, getattr(self, field)))
        if self.is_orthotropic:
            self._check_bending()

    def _check_bending(self) -> None:
        names = ("bending", "bending_weft", "bending_twill", "poisson")
        values = [np.asarray(self.per_face(name)) for name in names]
        faces = {len(value) for value in values if value.ndim}
        if len(faces) > 1:
            raise InvalidInput(
                "Material: `bending`, `bending_weft`, `bending_twill` and `poisson` must have as "
                f"many values as there are faces, got {sorted(faces)}"
            )
        check_bending("Material", *values)

    @property
    def is_orthotropic(self) -> bool:
        """True if any attribute of woven cloth is set."""
        return any(getattr(self, field) is not None for field in STAND_INS)

    def per_face(self, field: str) -> float | FloatArray:
        """Value of a field that may differ from face to face; by default, the warp's value."""
        value = getattr(self, field)
        result: float | FloatArray = getattr(self, STAND_INS[field]) if value is None else value
        return result

    def __repr__(self) -> str:
        values = ((f.name, getattr(self, f.name)) for f in fields(self))
        return record_text(
            "Material", (field_text(name, value) for name, value in values if value is not None)
        )

    def _keep(self, field: str, value: Any) -> None:
        object.__setattr__(self, field, value)
