"""Roots of equations r(x, u) = 0, as differentiable functions of u."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks

from diffcloth_torch.dynamics.linear import inverse, times
from diffcloth_torch.transforms import is_differentiated, outside_transforms, plain

__all__ = ["attach_root", "jacobian_of"]

Residual = Callable[..., Tensor]


def attach_root(residual: Residual, root: Tensor, inputs: Sequence[Tensor]) -> Tensor:
    """Give a root its first derivative with respect to the inputs of r.

    Along du the root moves by dx = -K^-1 (dr/du) du with K = dr/dx. So does -K^-1 r with a constant
    K, however the root was found. There is no second derivative.

    Args:
        residual: r(x, *inputs), [..., n] -> [..., n] for any leading axes of x; environments are
            independent.
        root: x without a graph, shape [..., n].
        inputs: All inputs of r; the root has a graph if one of them has.

    Returns:
        The root, to the same bits, with a graph if r has one.
    """
    if not is_differentiated(inputs):
        return root
    value = residual(root, *inputs)
    # Detached: searching the whole graph of a rollout in each of its steps would make its cost
    # quadratic.
    numbers = [plain(u) for u in inputs]
    with torch.no_grad(), outside_transforms():
        K = jacobian_of(residual)(root, *numbers)
    step = times(inverse(K), value)
    return root - (step - step.detach())


def jacobian_of(residual: Residual) -> Residual:
    """Function that gives dr/dx, [..., row, column], from the arguments of r(x, *inputs).

    Neither the result nor the inputs have a graph: n copies of x each give one row, in one
    backward.
    """

    def jacobian(x: Tensor, *inputs: Tensor) -> Tensor:
        n = x.shape[-1]
        with torch.enable_grad(), _without_hooks():
            copies = x.detach().expand(n, *x.shape).clone().requires_grad_()
            rows = residual(copies, *inputs).diagonal(dim1=0, dim2=-1).sum()
            (gradient,) = torch.autograd.grad(rows, copies)
        return gradient.movedim(0, -2)

    return jacobian


def _without_hooks() -> AbstractContextManager[None]:
    """Save tensors as they are: they are used at once, and a checkpoint's hooks repeat its steps.

    Reverse-mode transforms of `torch.func` forbid hooks, and so there are none inside them.
    """
    # Not among the stubs of torch.
    if torch._C._autograd._saved_tensors_hooks_is_enabled():  # type: ignore[attr-defined]
        return saved_tensors_hooks(_same, _same)
    return nullcontext()


def _same(tensor: Tensor) -> Tensor:
    return tensor
