"""Products of many small matrices, in torch."""

from __future__ import annotations

from torch import Tensor

__all__ = ["times"]


def times(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Products of matrices [..., m, n] and vectors [..., n], of shape [..., m].

    For a few entries half as dear as a product of matrices, which is mostly preparation; and its
    bits do not depend on how many there are.
    """
    return (matrices * vectors.unsqueeze(-2)).sum(-1)
