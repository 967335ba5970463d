"""Roots of equations as differentiable functions of what the equations depend on."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["attach_root"]


def attach_root(residual: Callable[[Tensor], Tensor], root: Tensor) -> Tensor:
    """Give the root x of r(x, u) = 0 its first derivative with respect to u.

    Along du the root moves by dx = -K^-1 (dr/du) du with K = dr/dx, and so does -K^-1 r with a
    constant K. K costs one evaluation for n copies of x and one backward, however many iterations
    found the root. There is no second derivative.

    Args:
        residual: r, [..., n] -> [..., n] for any leading axes; no environment sees another.
        root: x without a graph, shape [..., n].

    Returns:
        The root, to the same bits, with a graph where r has one.
    """
    if not torch.is_grad_enabled():
        return root
    value = residual(root)
    if not value.requires_grad:
        return root
    n = root.shape[-1]
    copies = root.expand(n, *root.shape).clone().requires_grad_()
    rows = residual(copies).diagonal(dim1=0, dim2=-1).sum()
    (K,) = torch.autograd.grad(rows, copies)  # [row, ..., column]
    step: Tensor = torch.linalg.solve(K.movedim(0, -2), value[..., None])[..., 0]
    return root - (step - step.detach())
