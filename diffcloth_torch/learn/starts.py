"""Seeds of starts, drawn from the seed of a computation."""

from __future__ import annotations

import numpy as np

__all__ = ["LARGEST_SEED", "seeds_of"]

LARGEST_SEED = 2**32 - 1


def seeds_of(seed: int, part: int, count: int) -> list[int]:
    """Seeds of starts for a part of a computation; other parts and seeds have others.

    Args:
        seed: Of the computation.
        part: Such as a round.
        count: Their number.
    """
    return [int(np.random.SeedSequence([seed, part, i]).generate_state(1)[0]) for i in range(count)]
