"""The leading axis of environments: added to inputs of a caller, removed from results.

Inside `sim/` every value of a state, a control, parameters or an outcome has this axis. It has as
many rows as the state has environments (one for a state without a batch axis), or one row for a
value that all environments share.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloth_torch.errors import InvalidInput

__all__ = ["with_axis", "without_axes", "without_axis"]


def with_axis(name: str, tensor: Tensor, dimensions: int, batch: int | None) -> Tensor:
    """Add the leading axis to a tensor of checked shape, if it is missing.

    Args:
        name: Prefix of the message.
        tensor: Tensor of `dimensions` axes, or one more for the environments.
        dimensions: Number of axes of the value of one environment.
        batch: Number of environments of the state, None if it has no batch axis.
    """
    if tensor.dim() == dimensions:
        return tensor.unsqueeze(0)
    if batch is None:
        raise InvalidInput(
            f"{name} has a batch axis, {list(tensor.shape)}, but the state has none; "
            "make the state with initial_state(batch_size=...)"
        )
    if tensor.shape[0] != batch:
        raise InvalidInput(
            f"{name} must have {batch} environments, as the state, got {list(tensor.shape)}"
        )
    return tensor


def without_axis(tensor: Tensor, batch: int | None) -> Tensor:
    """Copy rows [B or 1, ...] for a caller; without the leading axis if `batch` is None.

    The copy shares no storage with inputs of the caller or with internal tensors. A tensor without
    numbers has no storage to share.
    """
    if batch is None:
        rows = tensor.select(0, 0)
    elif tensor.shape[0] == batch:
        rows = tensor
    else:
        rows = tensor.expand(batch, *tensor.shape[1:])
    return rows.clone(memory_format=torch.contiguous_format) if rows.numel() else rows


def without_axes(named: dict[str, Tensor], batch: int | None) -> dict[str, Tensor]:
    """Apply `without_axis` to values by name."""
    return {name: without_axis(tensor, batch) for name, tensor in named.items()}
