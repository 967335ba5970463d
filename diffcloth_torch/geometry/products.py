"""Products of small matrices, of many environments at once, without threads and without a BLAS."""

from __future__ import annotations

import math

import numpy as np
from torch import Tensor, cat, split

__all__ = ["product"]

# From this size on torch shares an operation among its threads, which do not survive a fork.
_MOST_NUMBERS = 2**15 - 1


def product(a: Tensor, b: Tensor) -> Tensor:
    """A B, [.., m, n], from A [.., m, k] and B [.., k, n] with equal leading axes, or none.

    `matmul` would start threads, and its rounding depends on the number of matrices, on their
    memory layout and on `requires_grad`. Here each number is a separate sum, and no operation is
    large.
    """
    shape = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    rows = math.prod(a.shape[-2:]) * b.shape[-1] * math.prod(shape[1:])
    if not shape or shape[0] * rows <= _MOST_NUMBERS:
        return _product(a, b)
    few = max(1, _MOST_NUMBERS // rows)
    parts = [
        split(t, few)
        if t.ndim == len(shape) + 2 and len(t) > 1
        else [t] * math.ceil(shape[0] / few)
        for t in (a, b)
    ]
    return cat([_product(*pair) for pair in zip(*parts, strict=True)])


def _product(a: Tensor, b: Tensor) -> Tensor:
    # The order of a sum also depends on strides.
    terms = a.contiguous().unsqueeze(-1) * b.contiguous().unsqueeze(-3)
    total: Tensor = terms.sum(-2)
    return total
