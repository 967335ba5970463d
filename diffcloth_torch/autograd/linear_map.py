"""Tangents and gradients of a function of the core as linear functions of one or more vectors.

A separate function of torch, so that all directions or losses of a `vmap` go through one call of
the core, and so that torch knows all dependences of a derivative. `once_differentiable` is not
enough: if the cotangent has no graph, as for `.sum()`, the gradient would be returned as a
constant, and a second derivative through it as zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffcloth_torch.autograd import torch_private
from diffcloth_torch.autograd.transforms import is_dense, same_rows
from diffcloth_torch.errors import InvalidInput

__all__ = ["LinearMap", "apply_map"]


class LinearMap(NamedTuple):
    """The derivative of a function of the core at the point of its evaluation.

    Attributes:
        owner: Name of the function in messages.
        kind: "tangent" or "gradient".
        saved_names: Names of the tensors that the function has saved.
        saved_shapes: Shapes of these tensors.
        axes: Number of axes of the first vector, without axes of directions or losses.
        rows: Maps saved tensors and vectors with one leading axis to the results with that axis.
    """

    owner: str
    kind: str
    saved_names: Sequence[str]
    saved_shapes: Sequence[torch.Size]
    axes: int
    rows: Callable[[Sequence[Tensor], list[Tensor]], list[Tensor]]


def apply_map(
    linear: LinearMap, saved: Sequence[Tensor], vectors: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """Return the results for vectors, which may have an additional axis from a `vmap`."""
    batched = [v for v in vectors if torch_private.is_batched_by_older_vmap(v)]
    if not batched:
        return _apply(linear, *saved, *vectors)
    # The older vmap ignores the rules of a Function: remove its axis and add it again.
    count = len(torch_private.without_older_axis(batched[0]))
    rows = (torch_private.without_older_axis(v, count) for v in vectors)
    return tuple(map(torch_private.with_older_axis, _apply(linear, *saved, *rows)))


def _apply(linear: LinearMap, *tensors: Tensor) -> tuple[Tensor, ...]:
    """Return results with their dependences, unless nothing can differentiate them."""
    is_watched = (
        torch.is_grad_enabled() or torch_private.in_forward_mode() or torch_private.in_transform()
    )
    apply = _Apply.apply if is_watched else _Apply.forward
    results: tuple[Tensor, ...] = apply(linear, *tensors)
    return results


class _Apply(torch.autograd.Function):
    """Results from vectors, which may have leading axes."""

    @staticmethod
    def forward(linear, *tensors):
        count = len(linear.saved_names)
        saved, vectors = tensors[:count], tensors[count:]
        _check_saved(linear, saved)
        leading = vectors[0].shape[: vectors[0].ndim - linear.axes]
        rows = [v.reshape(math.prod(leading), *v.shape[len(leading) :]) for v in vectors]
        results = linear.rows(saved, rows)
        return tuple(r.reshape(*leading, *r.shape[1:]) for r in results)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.map = inputs[0]

    @staticmethod
    def vmap(info, in_dims, linear, *tensors):
        count = len(linear.saved_names)
        saved = same_rows(tensors[:count], in_dims[1 : 1 + count])
        vectors = [
            v.expand(info.batch_size, *v.shape) if axis is None else v.movedim(axis, 0)
            for v, axis in zip(tensors[count:], in_dims[1 + count :], strict=True)
        ]
        results = _Apply.apply(linear, *saved, *vectors)
        return results, (0,) * len(results)

    @staticmethod
    def jvp(ctx, *tangents):
        raise RuntimeError(_no_second(ctx.map))

    @staticmethod
    def backward(ctx, *cotangents):
        raise RuntimeError(_no_second(ctx.map))


def _no_second(linear):
    return (
        f"backward: second derivatives of {linear.owner} are not available; its {linear.kind} "
        "cannot be differentiated again, detach it where it enters another loss"
    )


def _check_saved(linear, saved):
    """Refuse invalid tensors that hooks return instead of the saved ones."""
    for name, shape, tensor in zip(linear.saved_names, linear.saved_shapes, saved, strict=True):
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
