"""Roots of equations r(x, u) = 0, as differentiable functions of u."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["attach_root", "find_root", "jacobian"]

Residual = Callable[[Tensor], Tensor]


def find_root(residual: Residual, guess: Tensor, iterations: int) -> Tensor:
    """Root near a guess, without a graph: x <- x - K^-1 r(x) with K = dr/dx of the guess.

    Args:
        residual: r, [..., n] -> [..., n] for any leading axes; no environment sees another.
        guess: Shape [..., n].
        iterations: Their number, fixed, so that the bits of one environment depend on no other.
    """
    inverse = torch.linalg.inv(jacobian(residual, guess))
    with torch.no_grad():
        x = guess
        for _ in range(iterations):
            x = x - (inverse @ residual(x)[..., None])[..., 0]
    return x


def attach_root(residual: Residual, root: Tensor, slope: Residual | None = None) -> Tensor:
    """Give a root its first derivative with respect to what r depends on.

    Along du the root moves by dx = -K^-1 (dr/du) du with K = dr/dx, and so does -K^-1 r with a
    constant K, however the root was found. There is no second derivative.

    Args:
        residual: As for `find_root`.
        root: x without a graph, shape [..., n].
        slope: Gives K [..., row, column] at x; None differentiates r.

    Returns:
        The root, to the same bits, with a graph where r has one.
    """
    if not torch.is_grad_enabled():
        return root
    value = residual(root)
    if not value.requires_grad:
        return root
    with torch.no_grad():
        K = jacobian(residual, root) if slope is None else slope(root)
    step: Tensor = torch.linalg.solve(K, value[..., None])[..., 0]
    return root - (step - step.detach())


def jacobian(residual: Residual, x: Tensor) -> Tensor:
    """dr/dx, [..., row, column]: n copies of x, each of which gives one row, in one backward."""
    n = x.shape[-1]
    with torch.enable_grad():
        copies = x.detach().expand(n, *x.shape).clone().requires_grad_()
        rows = residual(copies).diagonal(dim1=0, dim2=-1).sum()
        (gradient,) = torch.autograd.grad(rows, copies)
    return gradient.movedim(0, -2)
