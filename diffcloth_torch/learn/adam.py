"""Adam with one scale for each tensor."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu

__all__ = ["TensorAdam"]

_LEAST = 1e-8  # added to the denominator, as in Adam


class TensorAdam(torch.optim.Optimizer):
    """Adam whose second moment is the mean over all numbers of a tensor.

    One step size then serves a whole tensor: numbers with larger gradients move faster, whereas
    Adam moves all numbers at about the same speed. After Zhang et al., "Adam-mini: Use Fewer
    Learning Rates To Gain More", ICLR 2025, with tensors as blocks.
    """

    def __init__(
        self, groups: Iterable[dict[str, Any]], betas: tuple[float, float] = (0.9, 0.999)
    ) -> None:
        """Initialize from groups of parameters, each with its learning rate "lr"."""
        super().__init__(groups, {"betas": betas})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # type: ignore[override]
        """Move all parameters that have gradients."""
        assert closure is None
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._move(parameter, group["lr"], *group["betas"])

    def _move(self, parameter: Tensor, rate: float, first: float, second: float) -> None:
        gradient, kept = parameter.grad, self.state[parameter]
        assert gradient is not None
        if not kept:
            kept["step"] = cpu.zeros((), dtype=torch.float32)
            kept["mean"] = torch.zeros_like(parameter)
            kept["square"] = parameter.new_zeros(())
        kept["step"] += 1
        kept["mean"].lerp_(gradient, 1 - first)
        kept["square"].lerp_(gradient.square().mean(), 1 - second)
        count = float(kept["step"])
        mean, square = kept["mean"] / (1 - first**count), kept["square"] / (1 - second**count)
        parameter -= rate * mean / (square.sqrt() + _LEAST)
