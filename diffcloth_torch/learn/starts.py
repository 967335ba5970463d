"""Seeds of starts, drawn from the seed of a computation."""

from __future__ import annotations

import numpy as np

__all__ = ["LARGEST_SEED", "PURPOSES", "episode_seeds", "part_seeds", "purpose_seed"]

LARGEST_SEED = 2**32 - 1

PURPOSES = ("undo", "selection", "report")
"""Uses of starts in a training; no two uses share a start."""


def part_seeds(seed: int, part: int, count: int) -> list[int]:
    """Return seeds of starts for a part of a computation; they differ between parts and seeds.

    Args:
        seed: Seed of the computation.
        part: Number of the part, such as a round.
        count: Number of seeds.
    """
    return [int(np.random.SeedSequence([seed, part, i]).generate_state(1)[0]) for i in range(count)]


def episode_seeds(seed: int, episodes: int) -> list[int]:
    """Return one seed for each episode; seed i does not depend on the number of episodes."""
    sequences = [np.random.SeedSequence(seed, spawn_key=(i,)) for i in range(episodes)]
    return [int(s.generate_state(1, np.uint64)[0]) for s in sequences]


def purpose_seed(seed: int, purpose: str) -> int:
    """Return the seed of the starts for one of `PURPOSES`, derived from the seed of a training."""
    # The spawn key separates these seeds from the seeds of rollouts, which have none.
    sequence = np.random.SeedSequence(seed, spawn_key=(PURPOSES.index(purpose),))
    return int(sequence.generate_state(1, np.uint64)[0])
