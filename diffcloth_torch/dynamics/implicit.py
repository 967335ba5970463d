"""Roots of equations r(x, u) = 0, as differentiable functions of u."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from diffcloth_torch.dynamics.linear import solve

__all__ = ["attach_root", "jacobian"]

Residual = Callable[[Tensor], Tensor]


def attach_root(residual: Residual, root: Tensor, inputs: Iterable[Tensor]) -> Tensor:
    """Give a root its first derivative with respect to what r depends on.

    Along du the root moves by dx = -K^-1 (dr/du) du with K = dr/dx, and so does -K^-1 r with a
    constant K, however the root was found. There is no second derivative.

    Args:
        residual: r, [..., n] -> [..., n] for any leading axes; no environment sees another.
        root: x without a graph, shape [..., n].
        inputs: All that r depends on; it has a graph where one of them has.

    Returns:
        The root, to the same bits, with a graph where r has one.
    """
    if not (torch.is_grad_enabled() and any(u.requires_grad for u in inputs)):
        return root
    value = residual(root)
    with torch.no_grad():
        K = jacobian(residual, root)
    step = solve(K, value)
    return root - (step - step.detach())


def jacobian(residual: Residual, x: Tensor) -> Tensor:
    """dr/dx, [..., row, column]: n copies of x, each of which gives one row, in one backward."""
    n = x.shape[-1]
    with torch.enable_grad():
        copies = x.detach().expand(n, *x.shape).clone().requires_grad_()
        rows = residual(copies).diagonal(dim1=0, dim2=-1).sum()
        (gradient,) = torch.autograd.grad(rows, copies)
    return gradient.movedim(0, -2)
