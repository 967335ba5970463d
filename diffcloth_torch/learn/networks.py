"""Networks of policies and of values, and the scale of observations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from diffcloth_torch import cpu

__all__ = ["Actor", "Critics", "Plan", "Scale"]

_LIMIT = 5.0  # bound on the magnitude of a scaled observation
_QUIET = 0.01  # factor on the initial weights of a last layer
_WIDEST = 2.0  # largest change of a log deviation by the observation
_LEAST = 1e-2  # smallest standard deviation by which observations are divided
# Device and dtype of observations, independent of torch's defaults.
_KIND: dict[str, Any] = {"device": cpu.DEVICE, "dtype": torch.float32}


def _layers(sizes: Sequence[int], outputs: int) -> nn.Sequential:
    """Linear layers with ELU and LayerNorm between them."""
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [nn.Linear(before, after, **_KIND), nn.ELU(), nn.LayerNorm(after, **_KIND)]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs, **_KIND))


def _quieten(layers: nn.Module) -> Tensor:
    """Make the output of the last layer nearly constant, and return its bias."""
    assert isinstance(layers, nn.Sequential)
    last = layers[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight.mul_(_QUIET)
    return last.bias.detach()


class Plan(nn.Module):
    """Actions over the time of an episode, plus a linear function of observations.

    Attributes:
        knots: Actions before tanh [K, A] at evenly spaced times, interpolated linearly.
        gains: Derivatives of actions before tanh by scaled observations [A, O].
    """

    def __init__(self, observations: int, first: Tensor, knots: int) -> None:
        """Make a plan that returns `first` [A] for all times and observations."""
        super().__init__()
        self.knots = nn.Parameter(first.repeat(knots, 1))
        self.gains = nn.Parameter(cpu.zeros(len(first), observations, dtype=torch.float32))

    def forward(self, scaled: Tensor, time: Tensor) -> Tensor:
        """Return actions before tanh [B, A] for observations [B, O] at times in [0, 1], [B]."""
        count = len(self.knots)
        away = time[:, None] * (count - 1) - cpu.arange(count)
        shares = (1 - away.abs()).clamp(min=0)
        result: Tensor = shares @ self.knots + scaled @ self.gains.T
        return result


class Actor(nn.Module):
    """A policy: the tanh of a normal distribution.

    The standard deviation is constant, or depends on the observation.

    Attributes:
        plan: Plan that is added to the output of the network; None: no plan.
    """

    def __init__(
        self,
        observations: int,
        first_action: Tensor,
        hidden: Sequence[int],
        deviation: float,
        *,
        sees_width: bool,
        knots: int = 0,
    ) -> None:
        """Make a policy whose actions without noise are nearly the first action [A]."""
        super().__init__()
        self._size = len(first_action)
        self.layers = _layers([observations, *hidden], (2 if sees_width else 1) * self._size)
        first = first_action.atanh()
        self.plan = Plan(observations, first, knots) if knots else None
        _quieten(self.layers)[: self._size] = torch.zeros_like(first) if knots else first
        self.log_deviation = nn.Parameter(torch.full_like(first_action, math.log(deviation)))

    def forward(
        self, scaled: Tensor, noise: Tensor, time: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Compute actions and their entropy.

        Args:
            scaled: Observations [B, O].
            noise: Standard normal [B, A]; zeros give the actions of a policy without noise.
            time: Elapsed share of the episode [B]; used by the plan alone.

        Returns:
            Actions [B, A], and minus the logarithm of their density [B], whose mean is the entropy.
        """
        mean, *widths = self.layers(scaled).split(self._size, dim=-1)
        if self.plan is not None:
            mean = mean + self.plan(scaled, time)
        log_deviation = self.log_deviation.expand_as(mean)
        for width in widths:
            log_deviation = log_deviation + _WIDEST * width.tanh()
        before = mean + log_deviation.exp() * noise
        # Logarithm of the slope of tanh, 1 - tanh^2 = 4 / (e^x + e^-x)^2, also if nearly 0.
        log_slope = 2 * (math.log(2.0) - before - softplus(-2 * before))
        entropy = 0.5 * noise.square() + 0.5 * math.log(2 * math.pi) + log_deviation + log_slope
        return before.tanh(), entropy.sum(dim=-1)


class Critics(nn.Module):
    """Several estimates of the value of a state."""

    def __init__(self, observations: int, hidden: Sequence[int], count: int) -> None:
        """Make critics that are nearly constant, so that their initial gradient is nearly zero."""
        super().__init__()
        self.values = nn.ModuleList(_layers([observations, *hidden], 1) for _ in range(count))
        for value in self.values:
            _quieten(value)

    def forward(self, scaled: Tensor) -> Tensor:
        """Return values [critics, ...] of observations [..., O]."""
        return torch.stack([value(scaled)[..., 0] for value in self.values])


class Scale(nn.Module):
    """Scale of observations to mean 0 and deviation 1, by the statistics of all seen so far."""

    def __init__(self, observations: int) -> None:
        super().__init__()
        self.register_buffer("count", cpu.zeros(()))
        self.register_buffer("mean", cpu.zeros(observations, dtype=torch.float32))
        self.register_buffer("square", cpu.ones(observations, dtype=torch.float32))
        self.count: Tensor
        self.mean: Tensor
        self.square: Tensor

    def see(self, observations: Tensor) -> None:
        """Add observations [n, O] to the statistics."""
        rows = observations.detach()
        self.count += len(rows)
        share = float(len(rows) / self.count)
        self.mean += share * (rows.mean(dim=0) - self.mean)
        self.square += share * (rows.square().mean(dim=0) - self.square)

    def forward(self, observations: Tensor) -> Tensor:
        """Return scaled observations [..., O]."""
        deviation = (self.square - self.mean.square()).clamp(min=_LEAST**2).sqrt()
        return ((observations - self.mean) / deviation).clamp(-_LIMIT, _LIMIT)
