"""The numbers of tensors that are being differentiated, also inside transforms of `torch.func`.

A computation outside torch reads numbers, and attaches derivatives by a function of its own. Inside
`torch.func.jvp` and similar transforms a tensor is a wrapper without memory, and in
`torch.func.jacfwd` it also has one equal copy for each direction.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import forward_ad

from diffcloth_torch.autograd import torch_private
from diffcloth_torch.autograd.torch_private import (
    in_forward_mode,
    in_transform,
    is_wrapped,
    outside_transforms,
)

__all__ = [
    "has_derivative",
    "in_backward_transform",
    "is_dense",
    "is_differentiated",
    "is_plain",
    "numbers_of",
    "outside_transforms",
    "plain",
    "same_rows",
]

_CLOSE = 1e-13  # relative; batched products round by their batch
_ONE_TRANSFORM = 2  # most interpreters of one transform: `jacfwd` is a vmap of a jvp


def is_dense(value: Tensor) -> bool:
    """Return true for one plain block of memory, false for nested and sparse tensors."""
    return not value.is_nested and value.layout == torch.strided


def is_plain(tensor: Tensor) -> bool:
    """Return whether a tensor has memory of its own: no transform is active."""
    return not is_wrapped(tensor)


def plain(tensor: Tensor) -> Tensor:
    """The numbers of a tensor as a tensor outside of all transforms, without graph or tangent.

    Raises:
        NotImplementedError: If `torch.vmap` assigns it different numbers in one call.
    """
    value = tensor
    with outside_transforms():
        while not is_plain(value):
            inner, axis = torch_private.unwrap(value)
            value = inner if axis is None else _same_row(inner, axis)
        return value.detach()


def same_rows(tensors: Sequence[Tensor], axes: Sequence[int | None]) -> list[Tensor]:
    """Remove the axes of a vmap, along which tensors must be equal up to rounding.

    Raises:
        NotImplementedError: If they are not equal.
    """
    pairs = zip(tensors, axes, strict=True)
    return [t if axis is None else _same_row(t, axis) for t, axis in pairs]


def _same_row(tensor: Tensor, axis: int) -> Tensor:
    rows = tensor.movedim(axis, 0)
    first = rows[0]
    if is_plain(rows) and rows.stride(0):
        values = rows.detach()
        largest = values.abs().max() if values.numel() else 0.0
        if not bool(((values - values[0]).abs() <= _CLOSE * largest).all()):
            raise NotImplementedError(
                "torch.vmap over states, controls or parameters is not supported: give them a "
                "batch axis, initial_state(batch_size=...), as one call then has all environments"
            )
    return first


def numbers_of(tensor: Tensor) -> NDArray[np.float64]:
    """Return an array of a tensor's numbers; shares its memory, without its graph."""
    if not is_wrapped(tensor) and not in_transform():
        return (tensor.detach() if tensor.requires_grad else tensor).numpy()
    value = plain(tensor)
    with outside_transforms():
        return value.numpy()


def in_backward_transform() -> bool:
    """Return whether `torch.func.grad`, `vjp` or `jacrev` is active."""
    return any(torch_private.transforms())


def has_derivative(tensor: Tensor) -> bool:
    """Return whether a tensor is being differentiated; wrappers inside a transform need not be.

    Inside nested transforms this is unknown, and assumed to be true.
    """
    if tensor.requires_grad or _has_tangent(tensor):
        return True
    if is_plain(tensor):
        return False
    if len(torch_private.transforms()) > _ONE_TRANSFORM:
        return True
    value = tensor
    with outside_transforms():
        while not is_plain(value):
            value, _ = torch_private.unwrap(value)
            if value.requires_grad:
                return True
    return False


def is_differentiated(tensors: Iterable[Tensor]) -> bool:
    """Return whether a backward or forward derivative of one of these is requested."""
    tensors = list(tensors)
    if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
        return True
    if any(map(is_wrapped, tensors)):
        return True
    return in_forward_mode() and any(map(_has_tangent, tensors))


def _has_tangent(tensor: Tensor) -> bool:
    unpack: Any = forward_ad.unpack_dual
    return in_forward_mode() and unpack(tensor).tangent is not None
