"""Small linear algebra of each environment, with the same bits in every batch."""

from __future__ import annotations

from torch import Tensor

__all__ = ["times"]


def times(matrices: Tensor, vectors: Tensor) -> Tensor:
    """M v, [.., m], from M [.., m, n] and v [.., n].

    A sum costs half as much as a product of small matrices, which is mostly preparation.
    """
    return (matrices * vectors.unsqueeze(-2)).sum(-1)
