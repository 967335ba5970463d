"""Small linear algebra of each environment, with the same bits in every batch."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["solve", "times"]


def solve(matrices: Tensor, vectors: Tensor) -> Tensor:
    """The x with M x = v, from M [.., n, n] and v [.., n].

    torch 2.4 factors M or its transpose, whichever lies better in memory, and rounds accordingly.
    What indexing, `expand` and `movedim` return does not lie alike in a batch of one and in one of
    several; here all lie row by row.
    """
    solutions: Tensor = torch.linalg.solve(matrices.contiguous(), vectors[..., None])[..., 0]
    return solutions


def times(matrices: Tensor, vectors: Tensor) -> Tensor:
    """M v, [.., m], from M [.., m, n] and v [.., n].

    As a sum half as dear as a product of small matrices, which is mostly preparation.
    """
    return (matrices * vectors.unsqueeze(-2)).sum(-1)
