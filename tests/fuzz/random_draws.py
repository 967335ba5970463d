"""Draws that random scenes share."""

from __future__ import annotations

import numpy as np


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def maybe(rng: np.random.Generator, probability: float, value: float) -> float:
    """The value with some probability, else zero."""
    return value if rng.random() < probability else 0.0
