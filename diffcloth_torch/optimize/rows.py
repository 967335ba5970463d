"""Variables with one row per environment; each environment fails and restarts independently."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.optimize.evaluation import Evaluation, Variables, copies

__all__ = ["Rows"]

_MOMENTA = ("momentum_buffer", "exp_avg")  # of SGD and RMSprop, of Adam and its kin
_TINY = 1e-6  # as in torch.nn.utils.clip_grad_norm_


class Rows:
    """Rows with the smallest loss of each environment, and the handling of failed environments.

    Attributes:
        best: Name of a variable -> rows with the smallest loss of each environment.
        losses: Smallest losses, shape [B]; infinite for environments without a loss.
        risen: Environments whose loss has risen.
    """

    def __init__(self, variables: Variables, allowed: int) -> None:
        """Handle these variables; each environment may fail `allowed` times in a row."""
        self._variables, self._allowed = variables, allowed
        rows = next(iter(variables.values())).shape[0] if variables else 0
        self.best = copies(variables)
        self.losses = cpu.full((rows,), math.inf)
        self.risen: list[int] = []

    def restore(self, best: Variables, losses: Tensor) -> None:
        """Continue from the results of an earlier loop."""
        self.best, self.losses = copies(best), losses.clone()

    def look_at(self, evaluation: Evaluation, history: Sequence[Mapping[str, Any]]) -> None:
        """Keep the best rows, and note which losses have risen since the last record.

        Raises:
            InvalidInput: If the numbers of rows and environments differ.
            SimulationError: If an environment failed at the start, or too often in a row.
        """
        if not self._variables:
            return
        losses = evaluation.environment_losses
        if len(losses) != len(self.losses):
            raise InvalidInput(
                f"descend: variables that are `per_environment` must have {len(losses)} rows, one "
                f"for each environment, got {len(self.losses)}"
            )
        for i, loss in enumerate(losses):
            if loss is None:
                self._check_failure(i, history)
            elif loss < self.losses[i]:
                self.losses[i] = loss
                for name, rows in self.best.items():
                    rows[i] = evaluation.variables[name][i]
        before = history[-1]["environment_losses"] if history else losses
        pairs = enumerate(zip(losses, before, strict=True))
        self.risen = [i for i, (a, b) in pairs if a is not None and b is not None and a > b]

    def _check_failure(self, i: int, history: Sequence[Mapping[str, Any]]) -> None:
        count = 1
        for record in reversed(history):
            if record["environment_losses"][i] is not None:
                break
            count += 1
        if count > self._allowed or self.losses[i] == math.inf:
            raise SimulationError(
                f"the environment [{i}] failed in {count} evaluations in a row, "
                f"{len(history) - count + 1} after the start",
                environments=[i],
            )

    def go_back(self, evaluation: Evaluation, optimizer: torch.optim.Optimizer) -> None:
        """Move the rows of failed environments halfway back to their best rows."""
        failed = evaluation.failed_environments
        for name, tensor in self._variables.items():
            with torch.no_grad():
                tensor[failed] = (evaluation.variables[name][failed] + self.best[name][failed]) / 2
            self.forget(optimizer, tensor, failed)

    def forget(self, optimizer: torch.optim.Optimizer, tensor: Tensor, rows: list[int]) -> None:
        """Reset the momentum of the given rows."""
        gathered = optimizer.state.get(tensor, {})
        for key in _MOMENTA:
            momentum = gathered.get(key)
            if momentum is not None:
                momentum[rows] = 0.0

    def clip(self, tensor: Tensor, limit: float) -> None:
        """Limit the norm of each row's gradient, as `clip_grad_norm_` does for whole tensors."""
        gradient = tensor.grad
        assert gradient is not None  # evaluate() requires it
        norms = gradient.flatten(1).norm(dim=1) if gradient.dim() > 1 else gradient.abs()
        factors = (limit / (norms + _TINY)).clamp(max=1.0)
        gradient.mul_(factors.reshape(-1, *[1] * (gradient.dim() - 1)))
