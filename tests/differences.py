"""Gradients of a step or a rollout against finite differences, in given directions.

A directional derivative along dense and sparse random directions sees every entry of a gradient, at
a few evaluations instead of one for each entry.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch

F64 = torch.float64

# Stencils of order four: offsets in steps, and weights.
_CENTRAL = ((-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12))
_FORWARD = ((0, -25 / 12), (1, 4), (2, -3), (3, 4 / 3), (4, -1 / 4))

# Other steps, tried if a difference fails: rounding needs larger steps, kinks need smaller ones.
_SWEEP = (1.0, 0.25, 4.0, 0.0625, 16.0, 1 / 64, 1 / 256, 1 / 1024, 1 / 4096, 8.0, 32.0)
# Smallest derivative that differences resolve to five digits despite the noise of a solve.
_RESOLVED = 1e-8


def directions(tensor: torch.Tensor, generator: torch.Generator) -> Iterator[torch.Tensor]:
    """One unit direction per entry of a small tensor; a dense and two sparse ones for a large."""
    if tensor.numel() <= 3:
        for k in range(tensor.numel()):
            unit = torch.zeros(tensor.numel(), dtype=F64)
            unit[k] = 1.0
            yield unit.reshape(tensor.shape)
        return
    for share in (1.0, 0.2, 0.05):
        noise = torch.randn(tensor.shape, dtype=F64, generator=generator)
        mask = torch.rand(tensor.shape, generator=generator) < share
        if not mask.any():
            mask.view(-1)[0] = True
        yield noise * mask


def difference(
    f: Callable[[torch.Tensor], float],
    x: torch.Tensor,
    d: torch.Tensor,
    step: float,
    *,
    forward: bool = False,
) -> float:
    """Derivative of f at x along d."""
    stencil = _FORWARD if forward else _CENTRAL
    return sum(w * f(x + (k * step) * d) for k, w in stencil) / step


def mismatch(
    f: Callable[[torch.Tensor], float],
    x: torch.Tensor,
    gradient: torch.Tensor,
    d: torch.Tensor,
    step: float,
    rtol: float,
    *,
    forward: bool = False,
) -> float:
    """Smallest relative error over a sweep of steps, which ends at an error below rtol.

    Relative to the root of the sum of squares of the terms of gradient . d, whose sum may cancel.
    """
    expected = float((gradient * d).sum())
    scale = float((gradient * d).norm())
    if scale:
        scale = max(scale, _RESOLVED)
    best = np.inf
    for factor in _SWEEP:
        try:
            found = difference(f, x, d, factor * step, forward=forward)
        except ValueError:  # the step leaves the accepted range
            continue
        best = min(best, abs(found - expected) / scale if scale else abs(found))
        if best <= rtol:
            break
    return best


def directional(
    f: Callable[[dict[str, torch.Tensor]], torch.Tensor],
    inputs: dict[str, torch.Tensor],
    names: Sequence[str],
    seed: int = 0,
) -> float:
    """Relative error of a gradient along one random direction in all named inputs."""
    leaves = {n: x.clone().requires_grad_() for n, x in inputs.items() if n in names}
    found = torch.autograd.grad(f({**inputs, **leaves}), list(leaves.values()))
    g = torch.Generator().manual_seed(seed)
    d = {n: torch.randn(inputs[n].shape, generator=g, dtype=F64) for n in leaves}
    terms = [(gradient * d[n]).sum() for n, gradient in zip(leaves, found, strict=True)]
    scale = torch.stack(terms).norm().item()

    def at(t):
        with torch.no_grad():
            return f({**inputs, **{n: inputs[n] + t * d[n] for n in leaves}}).item()

    errors = []
    for h in (1e-4, 1e-5, 1e-6, 1e-7):
        difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
        errors.append(abs(difference - sum(terms).item()) / scale)
    return min(errors)


def slope_error(points: Sequence[tuple[float, float, float]]) -> float:
    """Smallest relative error of the slopes of a function with branches, over every two points.

    A point is (t, value, slope). If a step has several minima, points at a distance of rounding may
    lie on different branches, and a difference across branches is meaningless. On one branch the
    difference is the mean of the slopes at its ends, up to second order in their distance.
    """
    t, value, slope = np.array(points).T
    a, b = np.triu_indices(len(t), 1)
    difference = (value[b] - value[a]) / (t[b] - t[a])
    mean = (slope[a] + slope[b]) / 2
    return float((abs(mean - difference) / np.maximum(abs(mean), abs(difference))).min())
