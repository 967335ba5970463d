"""Tangents of a function of the core, along one direction or along many.

Like `pull_back`: a function of its own, so that all directions of a `vmap` go through one call of
the core, and so that torch knows all that a tangent depends on: a derivative of it is refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffcloth_torch.sim.pull_back import vmap_level
from diffcloth_torch.transforms import same_row

__all__ = ["Directed", "push_forward"]


class Directed(NamedTuple):
    """A function of the core that has been evaluated.

    Attributes:
        owner: What messages say that it is.
        saved: Number of the tensors that it has saved.
        axes: Of the tangent of each input that has one, without those of directions.
        tangents: From what is saved and directions with one leading axis, the tangents of all
            outputs with that axis.
    """

    owner: str
    saved: int
    axes: Sequence[int]
    tangents: Callable[[Sequence[Tensor], list[Tensor]], list[Tensor]]


def push_forward(
    function: Directed, saved: Sequence[Tensor], directions: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """Tangents of all outputs, from those of the inputs that have one."""
    if not any(map(torch._C._functorch.is_legacy_batchedtensor, directions)):
        tangents: tuple[Tensor, ...] = _PushForward.apply(function, *saved, *directions)
        return tangents
    # As in `pull_back`: the older vmap knows no rule of a Function.
    level = vmap_level()
    count = next(
        torch._remove_batch_dim(d, level, 1, 0).shape[0]
        for d in directions
        if torch._C._functorch.is_legacy_batchedtensor(d)
    )
    rows = [torch._remove_batch_dim(d, level, count, 0) for d in directions]
    tangents = _PushForward.apply(function, *saved, *rows)
    return tuple(torch._add_batch_dim(tangent, 0, level) for tangent in tangents)


class _PushForward(torch.autograd.Function):
    """Tangents from directions, which may have leading axes."""

    @staticmethod
    def forward(function, *tensors):
        saved, directions = tensors[: function.saved], tensors[function.saved :]
        leading = directions[0].shape[: directions[0].ndim - function.axes[0]]
        rows = [
            d.reshape(math.prod(leading), *d.shape[len(leading) :]).contiguous() for d in directions
        ]
        tangents = function.tangents(saved, rows)
        return tuple(t.reshape(*leading, *t.shape[1:]) for t in tangents)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.owner = inputs[0].owner

    @staticmethod
    def vmap(info, in_dims, function, *tensors):
        count = function.saved
        saved = [
            t if axis is None else same_row(t.movedim(axis, 0))
            for t, axis in zip(tensors[:count], in_dims[1 : 1 + count], strict=True)
        ]
        directions = [
            d.expand(info.batch_size, *d.shape) if axis is None else d.movedim(axis, 0)
            for d, axis in zip(tensors[count:], in_dims[1 + count :], strict=True)
        ]
        tangents = _PushForward.apply(function, *saved, *directions)
        return tangents, (0,) * len(tangents)

    @staticmethod
    def jvp(ctx, *tangents):
        raise RuntimeError(_no_second(ctx.owner))

    @staticmethod
    def backward(ctx, *cotangents):
        raise RuntimeError(_no_second(ctx.owner))


def _no_second(owner):
    return (
        f"{owner}: second derivatives are not available; its tangent cannot be differentiated "
        "again, detach it where it enters another loss"
    )
