"""Roots of equations r(x, u) = 0, as differentiable functions of u."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from diffcloth_torch.dynamics.linear import solve

__all__ = ["attach_root", "find_root", "jacobian"]

# Of the scale of x: a step that counts as none, and one that is rounding if it does not shrink.
_TOLERANCE, _FLOOR = 1e-12, 1e-8
_MOST_ITERATIONS = 40

Residual = Callable[[Tensor], Tensor]


def find_root(
    residual: Residual, guess: Tensor, inverse: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor]:
    """Root near a guess by Broyden's method, without a graph.

    An environment stops when its own step is small, so that its bits depend on no other.

    Args:
        residual: r, [B, n] -> [B, n]; no environment sees another.
        guess: Shape [B, n].
        inverse: About that of dr/dx, shape [B, n, n].
        scale: Size of what adds up to x, whose rounding is in it, shape [B].

    Returns:
        The root, and which environments have found theirs, shape [B].
    """
    with torch.no_grad():
        x, H = guess, inverse
        r = residual(x)
        active = torch.ones(len(x), 1, dtype=torch.bool)
        last = torch.full_like(x[:, :1], torch.inf)
        for _ in range(_MOST_ITERATIONS):
            step = -_times(H, r)
            x = torch.where(active, x + step, x)
            size = step.abs().amax(-1, True)
            whole = torch.maximum(x.abs().amax(-1, True), scale[:, None])
            at_floor = (size <= _FLOOR * whole) & (size >= last / 2)
            # The next step, which shrinks at least as this one did.
            ahead = size * torch.where(last.isinf(), 1.0, size / last)
            active = active & ~((ahead <= _TOLERANCE * whole) | at_floor)
            if not active.any():
                break
            before, r, last = r, residual(x), size
            change = _times(H, r - before)
            row = (step[:, None] @ H) / (step * change).sum(-1)[:, None, None]
            H = H + (step - change)[..., None] * row
    return x, ~active[:, 0]


def attach_root(
    residual: Residual, root: Tensor, inputs: Iterable[Tensor], slope: Residual | None = None
) -> Tensor:
    """Give a root its first derivative with respect to what r depends on.

    Along du the root moves by dx = -K^-1 (dr/du) du with K = dr/dx, and so does -K^-1 r with a
    constant K, however the root was found. There is no second derivative.

    Args:
        residual: r, [..., n] -> [..., n] for any leading axes; no environment sees another.
        root: x without a graph, shape [..., n].
        inputs: All that r depends on; it has a graph where one of them has.
        slope: Gives K [..., row, column] at x; None differentiates r.

    Returns:
        The root, to the same bits, with a graph where r has one.
    """
    if not (torch.is_grad_enabled() and any(u.requires_grad for u in inputs)):
        return root
    value = residual(root)
    with torch.no_grad():
        K = jacobian(residual, root) if slope is None else slope(root)
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


def _times(matrices: Tensor, vectors: Tensor) -> Tensor:
    product: Tensor = (matrices @ vectors[..., None])[..., 0]
    return product
