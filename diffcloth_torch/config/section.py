"""Elements of sections of configurations: strict mappings, numbers with ranges."""

from __future__ import annotations

import difflib
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Interval, Le, Len
from pydantic import BaseModel, ConfigDict, Field, model_validator

from diffcloth_torch.model.quantities import PARAMETERS

__all__ = [
    "Actuation",
    "Color",
    "Count",
    "Lengths2",
    "Lengths3",
    "NonNegative",
    "Positive",
    "Section",
    "Seed",
    "Updates",
    "Vector3",
    "limits",
    "require_increasing",
    "require_one",
]

Count = Annotated[int, Ge(1), Le(10**8)]
"""A count of steps or similar; a day of the fastest steps has fewer than the upper end."""

Updates = Annotated[int, Ge(1), Le(10**7)]
"""A count of updates or evaluations; a day of the fastest ones has fewer than the upper end."""

Seed = Annotated[int, Ge(0), Le(2**31 - 1)]
Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]
Vector3 = Annotated[list[float], Len(3, 3)]
Actuation = Literal["position", "velocity", "torque", "pd"]
Lengths2 = Positive | Annotated[list[Positive], Len(2, 2)]
Lengths3 = Positive | Annotated[list[Positive], Len(3, 3)]


def limits(parameter: str) -> Interval:
    """Range of a parameter's values for the schema of a configuration."""
    accepted = PARAMETERS[parameter].accepted
    low = None if math.isinf(accepted.low) else accepted.low
    high = None if math.isinf(accepted.high) else accepted.high
    return Interval(ge=low, le=high) if accepted.closed else Interval(gt=low, lt=high)


Color = Annotated[str, Field(pattern="^#[0-9a-fA-F]{6}$")]
"""A color as "#rrggbb"."""


class Section(BaseModel):
    """A mapping of a configuration; unknown keys are refused."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, protected_namespaces=()
    )

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, given: Any) -> Any:
        if not isinstance(given, Mapping):
            return given
        for key in given:
            if key not in cls.model_fields:
                close = difflib.get_close_matches(str(key), cls.model_fields, n=1)
                hint = f" (did you mean `{close[0]}`?)" if close else ""
                accepted = ", ".join(cls.model_fields)
                raise ValueError(f"has no key `{key}`{hint}; its keys are {accepted}")
        return given


def require_one(section: Section, names: Iterable[str]) -> None:
    """Refuse a section that has none or several of the named keys."""
    given = [name for name in names if getattr(section, name) is not None]
    if len(given) != 1:
        raise ValueError(
            f"must have exactly one of {', '.join(names)}, got {', '.join(given) or 'none'}"
        )


def require_increasing(name: str, times: Sequence[float]) -> None:
    """Refuse keyframes with times that do not increase."""
    if any(b <= a for a, b in itertools.pairwise(times)):
        raise ValueError(f"must have increasing times in `{name}`, got {times}")
