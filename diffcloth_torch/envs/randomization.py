"""Random physical parameters for each start, by name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import check_choice
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.sim.records.controls import Parameters
from diffcloth_torch.sim.simulator import Simulator

__all__ = ["RANDOMIZED", "Randomization", "Ranges"]

Ranges = bool | Mapping[str, tuple[float, float]] | None
"""True to draw all parameters, or ranges of single parameters by name."""

_FIELDS = {
    "stretch": "stretch",
    "bending": "bending",
    "density": "density",
    "friction": "friction",
    "drag": "normal_drag",
    "mass": "body_mass",
    "scale": "rest_positions",
}
RANDOMIZED = tuple(_FIELDS)
"""Names of the parameters that can be drawn."""

# Ranges of `randomize=True`, in multiples of the values of the scene.
_MULTIPLES = {
    "stretch": (0.5, 2.0),
    "bending": (0.5, 2.0),
    "density": (0.7, 1.4),
    "friction": (0.7, 1.4),
    "mass": (0.7, 1.4),
}
_DRAG = (0.0, 1.5)  # values, not multiples, as the materials of most scenes have no drag
_PREFIX = "random_"
_LACKS = "the scene has nothing with"


class Randomization:
    """Draws physical parameters for each start of an environment.

    Ranges have the units of values: [N/m], [N m], [kg/m^2], [-], [-] and [kg] for stretch, bending,
    density, friction (of all pairs of surfaces), drag (normal) and mass (of each dynamic body,
    whose inertia scales with its mass). The scale multiplies the lengths of the rest shapes of all
    cloths [-]. A parameter is drawn uniformly in its logarithm if its lower bound is positive, and
    uniformly in its value otherwise.
    """

    def __init__(self, owner: str, simulator: Simulator, ranges: Ranges, scales: bool) -> None:
        """Check the ranges; `scales`: whether starts of the task follow the scale of the cloths.

        Raises:
            InvalidInput: If a name or a range is not accepted, or the scene has no such parameter.
            TypeError: If `ranges` is neither a bool nor a mapping.
        """
        opening = f"{owner}: `randomize`"
        given: Any = ranges
        if not isinstance(given, bool | Mapping) and given is not None:
            raise TypeError(f"{opening} must be a bool or ranges by name, got {given!r}")
        self._ranges: dict[str, tuple[float, float]] = {}
        self._multiples = given is True
        if not given:
            return
        scene = simulator.scene
        defaults = simulator.default_parameters()
        self._cloths, self._surfaces = len(scene.cloths), len(simulator.surfaces)
        dynamic = [body.motion == "dynamic" for body in scene.bodies]
        self._dynamic = cpu.tensor(dynamic, dtype=torch.bool)
        has = {name: getattr(defaults, field) is not None for name, field in _FIELDS.items()}
        has["mass"], has["scale"] = any(dynamic), scales
        if given is True:
            self._ranges = {n: r for n, r in (_MULTIPLES | {"drag": _DRAG}).items() if has[n]}
        else:
            for name, limits in given.items():
                check_choice(f"{opening}: a name", name, RANDOMIZED)
                if not has[name]:
                    lacks = "starts of the task have no" if name == "scale" else _LACKS
                    raise InvalidInput(f"{opening}: {lacks} {name!r}")
                self._ranges[name] = _checked(f"{opening}: {name!r}", limits, name)
        fields = {_FIELDS[name] for name in self._ranges} | {"body_inertia"}
        self._defaults = {name: getattr(defaults, name) for name in fields}

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """One number for each parameter: its value, or a multiple of the scene's value."""
        drawn = {}
        for name, (low, high) in self._ranges.items():
            share = cpu.rand(1, generator=generator)[0]
            if low > 0:
                drawn[_PREFIX + name] = low * (high / low) ** share
            else:
                drawn[_PREFIX + name] = low + (high - low) * share
        return drawn

    def parameters(
        self, drawn: Mapping[str, Tensor], given: Parameters | None = None
    ) -> Parameters | None:
        """Parameters of a step: the drawn parameters, and `given` for all others.

        Raises:
            InvalidInput: If a parameter is both given and drawn.
        """
        if not self._ranges:
            return given
        fields: dict[str, Any] = {}
        for name in self._ranges:
            fields |= self._fields(name, drawn[_PREFIX + name])
        if given is None:
            return Parameters(**fields)
        for name in fields:
            if getattr(given, name) is not None:
                raise InvalidInput(
                    f"transition: `parameters.{name}` must be None: `randomize` draws it"
                )
        return given.replace(**fields)

    @staticmethod
    def scale(drawn: Mapping[str, Tensor]) -> Tensor | float:
        """Scale of the cloths of starts, [B], or 1 if it is not drawn."""
        return drawn.get(_PREFIX + "scale", 1.0)

    def _fields(self, name: str, drawn: Tensor) -> dict[str, Tensor]:
        """Fields of `Parameters` for drawn numbers [B]."""
        default = self._defaults[_FIELDS[name]]
        if name == "mass":
            masses = torch.where(
                self._dynamic, self._valued(name, drawn[:, None], default), default
            )
            inertia = self._defaults["body_inertia"]
            ratio = torch.where(self._dynamic, masses / default, 1.0)
            return {"body_mass": masses, "body_inertia": ratio[..., None, None] * inertia}
        if name == "scale":
            return {"rest_positions": drawn[:, None, None] * default}
        if name == "friction":
            size = (self._surfaces, self._surfaces)
            return {name: self._valued(name, drawn[:, None, None], default.expand(size))}
        rows = default if default.dim() else default.expand(self._cloths)
        return {_FIELDS[name]: self._valued(name, drawn[:, None], rows)}

    def _valued(self, name: str, drawn: Tensor, default: Tensor) -> Tensor:
        if self._multiples and name != "drag":
            return drawn * default
        return drawn.expand(len(drawn), *default.shape).contiguous()


def _checked(opening: str, limits: object, name: str) -> tuple[float, float]:
    given: Any = limits
    try:
        low, high = (float(limit) for limit in given)
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"{opening} must be two numbers, got {given!r}") from error
    least = 0.0 if name in ("friction", "drag", "bending") else math.ulp(0.0)
    if not (least <= low <= high and math.isfinite(high)):
        sign = ">= 0" if least == 0.0 else "> 0"
        raise InvalidInput(f"{opening} must be finite and {sign}, the smaller first, got {given!r}")
    return low, high
