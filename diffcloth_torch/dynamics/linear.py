"""Small linear algebra of each environment, with the same bits in every batch."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.transforms import is_differentiated, numbers_of

__all__ = ["inverse", "solve", "times"]


def inverse(matrices: Tensor) -> Tensor:
    """M^-1 without a graph, from M [.., n, n].

    NumPy inverts one matrix after the other; torch distributes a few among threads, which do not
    survive a fork.
    """
    inverses: Tensor = torch.from_numpy(np.linalg.inv(numbers_of(matrices)))
    return inverses


def solve(matrices: Tensor, vectors: Tensor) -> Tensor:
    """The x with M x = v, from M [.., n, n] and v [.., n]; it has a first derivative.

    The derivative is dx = M^-1 (dv - dM x), which -M^-1 (M x - v) with a constant M^-1 also has.
    """
    numbers = numbers_of(matrices), numbers_of(vectors)[..., None]
    x: Tensor = torch.from_numpy(np.linalg.solve(*numbers)[..., 0])
    if not is_differentiated((matrices, vectors)):
        return x
    step = times(inverse(matrices), times(matrices, x) - vectors)
    return x - (step - step.detach())


def times(matrices: Tensor, vectors: Tensor) -> Tensor:
    """M v, [.., m], from M [.., m, n] and v [.., n].

    A sum costs half as much as a product of small matrices, which is mostly preparation.
    """
    return (matrices * vectors.unsqueeze(-2)).sum(-1)
