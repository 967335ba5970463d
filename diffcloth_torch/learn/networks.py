"""Networks of policies and of values, and the scale of observations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

__all__ = ["Actor", "Critic", "Scale"]

_LIMIT = 5.0  # of a scaled observation
_QUIET = 0.01  # share of the weights of a last layer that is left at first
_LEAST = 1e-2  # standard deviation that observations are divided by


def _layers(sizes: Sequence[int], outputs: int) -> nn.Sequential:
    """Linear layers with ELU and LayerNorm between them."""
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ELU(), nn.LayerNorm(after)]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


def _quieten(layers: nn.Sequential) -> Tensor:
    """Make the last layer nearly constant; gives its bias."""
    last = layers[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight.mul_(_QUIET)
    return last.bias.detach()


class Actor(nn.Module):
    """A policy: the tanh of a normal distribution, whose width does not depend on what is seen."""

    def __init__(
        self, observations: int, first_action: Tensor, hidden: Sequence[int], deviation: float
    ) -> None:
        """Make a policy whose actions are nearly the first one [A], but for noise."""
        super().__init__()
        self.mean = _layers([observations, *hidden], len(first_action))
        _quieten(self.mean).copy_(first_action.atanh())
        self.log_deviation = nn.Parameter(torch.full_like(first_action, math.log(deviation)))

    def forward(self, scaled: Tensor, noise: Tensor | None = None) -> Tensor:
        """Actions [B, A] for observations [B, O] and standard normal noise [B, A], or without."""
        mean: Tensor = self.mean(scaled)
        if noise is not None:
            mean = mean + self.log_deviation.exp() * noise
        return mean.tanh()


class Critic(nn.Module):
    """The value of a state."""

    def __init__(self, observations: int, hidden: Sequence[int]) -> None:
        """Make a critic that knows of no difference between states, so that it has no gradient."""
        super().__init__()
        self.value = _layers([observations, *hidden], 1)
        _quieten(self.value)

    def forward(self, scaled: Tensor) -> Tensor:
        """Values [...] of observations [..., O]."""
        values: Tensor = self.value(scaled)
        return values[..., 0]


class Scale(nn.Module):
    """Brings observations to mean 0 and deviation 1, by all that have been seen."""

    def __init__(self, observations: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(observations))
        self.register_buffer("square", torch.ones(observations))
        self.count: Tensor
        self.mean: Tensor
        self.square: Tensor

    def see(self, observations: Tensor) -> None:
        """Take note of observations [n, O]."""
        rows = observations.detach()
        self.count += len(rows)
        share = float(len(rows) / self.count)
        self.mean += share * (rows.mean(dim=0) - self.mean)
        self.square += share * (rows.square().mean(dim=0) - self.square)

    def forward(self, observations: Tensor) -> Tensor:
        """Scaled observations [..., O]."""
        deviation = (self.square - self.mean.square()).clamp(min=_LEAST**2).sqrt()
        return ((observations - self.mean) / deviation).clamp(-_LIMIT, _LIMIT)
