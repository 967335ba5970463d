"""Seeds of starts, drawn from the seed of a computation."""

from __future__ import annotations

import numpy as np

__all__ = ["LARGEST_SEED", "PURPOSES", "episode_seeds", "part_seeds", "purpose_seed"]

LARGEST_SEED = 2**32 - 1

PURPOSES = ("undo", "selection", "report")
"""Uses of starts in a training, which have no start in common."""


def part_seeds(seed: int, part: int, count: int) -> list[int]:
    """Seeds of starts for a part of a computation; other parts and seeds have others.

    Args:
        seed: Of the computation.
        part: Such as a round.
        count: Their number.
    """
    return [int(np.random.SeedSequence([seed, part, i]).generate_state(1)[0]) for i in range(count)]


def episode_seeds(seed: int, episodes: int) -> list[int]:
    """A seed for each episode, of which the first ones do not depend on the number."""
    sequences = [np.random.SeedSequence(seed, spawn_key=(i,)) for i in range(episodes)]
    return [int(s.generate_state(1, np.uint64)[0]) for s in sequences]


def purpose_seed(seed: int, purpose: str) -> int:
    """The seed of the starts of one of `PURPOSES`, by the seed of a training."""
    # Seeds of `Trainer` for its own starts have no spawn key.
    sequence = np.random.SeedSequence(seed, spawn_key=(PURPOSES.index(purpose),))
    return int(sequence.generate_state(1, np.uint64)[0])
