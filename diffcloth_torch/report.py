"""What a step says about itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

__all__ = ["Report"]


@dataclass(frozen=True, eq=False)
class Report:
    """How a step went; Python numbers, or tensors of shape [B] in a batch.

    Attributes:
        converged: Whether the residual fell below the tolerance.
        iterations: Newton iterations.
        residual: Largest Newton step at the end, as a velocity [m/s].
        minimum_distance: Smallest distance between mid-surfaces in contact [m], which is above half
            the sum of their thicknesses; infinite where nothing is within the barrier's reach.
        contact_count: Contacts within the barrier distance: pairs of primitives of cloths; of a
            cloth and a body, features that are not hidden behind nearer ones.
        motion_fraction: Part of the prescribed motion that was reached, 1 for all of it.
        seconds: Phase of the solve -> time [s].
    """

    converged: bool | Tensor
    iterations: int | Tensor
    residual: float | Tensor
    minimum_distance: float | Tensor
    contact_count: int | Tensor
    motion_fraction: float | Tensor
    seconds: dict[str, float | Tensor]

    def select(self, index: int | slice) -> Report:
        """Report of one environment, or of some."""

        def pick(values: Any) -> Any:
            return values[index].item() if isinstance(index, int) else values[index]

        return _combine(pick, [self])

    @staticmethod
    def stack(reports: Sequence[Report | None]) -> Report | None:
        """Report of a batch from those of its environments; None if one has none."""
        present = [report for report in reports if report is not None]
        if len(present) < len(reports) or len({tuple(r.seconds) for r in present}) > 1:
            return None
        return _combine(lambda *values: torch.stack([_tensor(v) for v in values]), present)

    @staticmethod
    def where(mask: Tensor, a: Report | None, b: Report | None) -> Report | None:
        """Report that takes the environments of `a` where `mask` is true; None if one has none."""
        if a is None or b is None or tuple(a.seconds) != tuple(b.seconds):
            return None
        return _combine(lambda x, y: torch.where(mask, _tensor(x), _tensor(y)), [a, b])


def _tensor(value: Any) -> Tensor:
    # A Python float would become a float32 tensor.
    return (
        torch.tensor(value, dtype=torch.float64) if type(value) is float else torch.as_tensor(value)
    )


def _combine(function: Callable[..., Any], reports: Sequence[Report]) -> Report:
    """Apply a function to each field of some reports."""
    plain = {
        field.name: function(*(getattr(report, field.name) for report in reports))
        for field in fields(Report)
        if field.name != "seconds"
    }
    phases = reports[0].seconds
    seconds = {phase: function(*(report.seconds[phase] for report in reports)) for phase in phases}
    return Report(**plain, seconds=seconds)


torch.serialization.add_safe_globals([Report])
