"""Gradients of a function of the core, from the cotangents of one loss or of many.

A backward of its own, so that all losses of a `vmap` go through one call of the core, and so that
torch knows all that a gradient depends on. `once_differentiable` is not enough: where the cotangent
has no graph, as for `.sum()`, the gradient would come back as a constant, and a second derivative
through it as zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffcloth_torch.checks import is_dense
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.transforms import same_row

__all__ = ["Differentiated", "needed", "pull_back", "vmap_level"]


class Differentiated(NamedTuple):
    """A function of the core that has been evaluated.

    Attributes:
        owner: What messages say that it is.
        names: Of the tensors that it has saved.
        shapes: Of these.
        axes: Of the cotangent of its first output, without those of losses.
        gradients: From what is saved and cotangents with one leading axis of losses, the gradients
            with that axis.
    """

    owner: str
    names: Sequence[str]
    shapes: Sequence[torch.Size]
    axes: int
    gradients: Callable[[Sequence[Tensor], list[Tensor]], list[Tensor]]


def needed(names: Iterable[str], needs_grad: Iterable[bool]) -> list[str]:
    """Names of the inputs that need a gradient."""
    return [name for name, is_needed in zip(names, needs_grad, strict=True) if is_needed]


def pull_back(
    function: Differentiated, saved: Sequence[Tensor], cotangents: Sequence[Tensor]
) -> Sequence[Tensor]:
    """Gradients from the cotangents of all outputs, which a `vmap` may give an axis more."""
    if not any(map(torch._C._functorch.is_legacy_batchedtensor, cotangents)):
        gradients: Sequence[Tensor] = _PullBack.apply(function, *saved, *cotangents)
        return gradients
    # `is_grads_batched` and vectorized Jacobians still use the older vmap, which knows no rule of
    # a Function: take its batch axis off and put it on again.
    level = vmap_level()
    count = next(
        torch._remove_batch_dim(c, level, 1, 0).shape[0]
        for c in cotangents
        if torch._C._functorch.is_legacy_batchedtensor(c)
    )
    losses = [torch._remove_batch_dim(c, level, count, 0) for c in cotangents]
    gradients = _PullBack.apply(function, *saved, *losses)
    return [torch._add_batch_dim(gradient, 0, level) for gradient in gradients]


def vmap_level() -> int:
    """Level of the older vmap that is active."""
    level: int = torch._C._vmapmode_increment_nesting() - 1
    torch._C._vmapmode_decrement_nesting()
    return level


class _PullBack(torch.autograd.Function):
    """Gradients from cotangents, which may have leading axes."""

    @staticmethod
    def forward(function, *tensors):
        saved, cotangents = tensors[: len(function.shapes)], tensors[len(function.shapes) :]
        _check_saved(function, saved)
        axes = cotangents[0].ndim - function.axes
        leading = cotangents[0].shape[:axes]
        losses = [c.reshape(math.prod(leading), *c.shape[axes:]) for c in cotangents]
        gradients = function.gradients(saved, losses)
        return tuple(g.reshape(*leading, *g.shape[1:]) for g in gradients)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.owner = inputs[0].owner

    @staticmethod
    def vmap(info, in_dims, function, *tensors):
        count = len(function.shapes)
        saved = [
            t if dim is None else same_row(t.movedim(dim, 0))
            for t, dim in zip(tensors[:count], in_dims[1 : 1 + count], strict=True)
        ]
        losses = [
            c.expand(info.batch_size, *c.shape) if dim is None else c.movedim(dim, 0)
            for c, dim in zip(tensors[count:], in_dims[1 + count :], strict=True)
        ]
        gradients = _PullBack.apply(function, *saved, *losses)
        return gradients, (0,) * len(gradients)

    @staticmethod
    def jvp(ctx, *tangents):
        raise RuntimeError(_no_second(ctx.owner))

    @staticmethod
    def backward(ctx, *cotangents):
        raise RuntimeError(_no_second(ctx.owner))


def _no_second(owner):
    return (
        f"{owner}: second derivatives are not available; its gradient cannot be differentiated "
        "again, detach it where it enters another loss"
    )


def _check_saved(function, saved):
    """Refuse what hooks on saved tensors return instead of what was saved."""
    for name, shape, tensor in zip(function.names, function.shapes, saved, strict=True):
        if tensor.dtype != torch.float64 or tensor.device.type != "cpu" or not is_dense(tensor):
            raise TypeError(
                f"backward: saved `{name}` must come back as a dense float64 tensor on the CPU, "
                f"got {tensor.dtype} on {tensor.device}"
            )
        if tensor.shape != shape:
            raise InvalidInput(
                f"backward: saved `{name}` must come back with shape {list(shape)}, "
                f"got {list(tensor.shape)}"
            )
