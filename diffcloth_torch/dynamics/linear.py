"""Small linear systems, one for each environment, with the same bits in every batch.

torch 2.4 factors M or its transpose, whichever lies better in memory, and rounds accordingly. What
indexing, `expand` and `movedim` return does not lie alike in a batch of one and in one of several;
here all lie row by row.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["inverse", "solve"]


def solve(matrices: Tensor, vectors: Tensor) -> Tensor:
    """X with M x = v, from M [.., n, n] and v [.., n]."""
    solutions: Tensor = torch.linalg.solve(matrices.contiguous(), vectors[..., None])[..., 0]
    return solutions


def inverse(matrices: Tensor) -> Tensor:
    """M^-1, [.., n, n]."""
    inverted: Tensor = torch.linalg.inv(matrices.contiguous())
    return inverted
