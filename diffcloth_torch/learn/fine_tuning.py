"""Fine-tuning of a policy: a trust region for updates, and checks at held-out starts.

A few unbounded updates can degrade a good policy, as its weights affect all actions of an episode
at once.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch.checkpoint import check_like, check_optimizer
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn.options import TrainerOptions
from diffcloth_torch.learn.policy import Policy

__all__ = ["Kept", "TrustRegion", "for_fine_tuning"]

_MAX_CHANGE = 0.02  # 0.1 in each action of a FoldCloth episode moves a picker by 9 cm
_HELD_OUT = 16
_HALVINGS = 20
_RESTORED = ("actor", "scale")  # parts of a policy on which actions depend


def for_fine_tuning(options: TrainerOptions) -> TrainerOptions:
    """Return options in which missing bounds have the defaults of fine-tuning."""
    return replace(
        options,
        max_change=_MAX_CHANGE if options.max_change is None else options.max_change,
        held_out=_HELD_OUT if options.held_out is None else options.held_out,
    )


class TrustRegion:
    """Bound on the change of actions by an update of a policy."""

    def __init__(self, policy: Policy, seen: Tensor, largest: float) -> None:
        """Store the weights before an update.

        Args:
            policy: The policy.
            seen: Observations [n, O] in which actions are compared.
            largest: Largest root mean square of the changes of actions without noise.
        """
        self._policy, self._seen, self._largest = policy, seen, largest
        self._parameters = list(policy.actor.parameters())
        self._before = [p.detach().clone() for p in self._parameters]
        self._actions = self._act()

    @torch.no_grad()
    def limit(self) -> tuple[float, float]:
        """Scale the update of the weights back, by bisection, until the bound holds.

        Returns:
            The change of the actions, and the remaining share of the update.
        """
        moved = [p.detach().clone() for p in self._parameters]
        change = self._change()
        if change <= self._largest:
            return change, 1.0
        least, most = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (least + most)
            self._move(moved, middle)
            if self._change() <= self._largest:
                least = middle
            else:
                most = middle
        self._move(moved, least)
        return self._change(), least

    @torch.no_grad()
    def _act(self) -> Tensor:
        actions: Tensor = self._policy(self._seen)
        return actions

    def _change(self) -> float:
        return float((self._act() - self._actions).square().mean().sqrt())

    def _move(self, moved: list[Tensor], share: float) -> None:
        for parameter, start, end in zip(self._parameters, self._before, moved, strict=True):
            parameter.copy_(torch.lerp(start, end, share))


@dataclass(frozen=True, eq=False)
class Kept:
    """The last policy with the largest success at the held-out starts.

    It is restored if a later policy succeeds less often.

    Attributes:
        updates: Number of updates at the check.
        success: Share of successes.
        weights: Weights of the actor, and the scale of observations.
        steps: State of the optimizer of the actor.
    """

    updates: int
    success: float
    weights: dict[str, Tensor]
    steps: dict[str, Any]

    @staticmethod
    def weights_of(policy: Policy) -> dict[str, Tensor]:
        """Return copies of the weights on which actions depend."""
        return {
            name: tensor.detach().clone()
            for name, tensor in policy.state_dict().items()
            if name.partition(".")[0] in _RESTORED
        }

    def restore(self, policy: Policy, optimizer: torch.optim.Optimizer) -> None:
        """Restore this state of a policy and its optimizer."""
        policy.load_state_dict(self.weights, strict=False)
        # A copy, as steps of the optimizer change its state in place.
        optimizer.load_state_dict(copy.deepcopy(self.steps))

    @staticmethod
    def checked(
        owner: str, given: Any, policy: Policy, optimizer: torch.optim.Optimizer, updates: int
    ) -> Kept:
        """Return a `Kept` from the fields of a file, after checks.

        Raises:
            InvalidInput: If the fields do not match this policy and optimizer.
        """
        example = {"updates": 0, "success": 0.0, "weights": Kept.weights_of(policy)}
        if not isinstance(given, dict) or given.keys() != {*example, "steps"}:
            raise InvalidInput(f"{owner} must have the keys {', '.join([*example, 'steps'])}")
        check_like(owner, {name: given[name] for name in example}, example)
        if given["updates"] > updates or not 0 <= given["success"] <= 1:
            raise InvalidInput(
                f"{owner} must be of at most {updates} updates, with a success in [0, 1]"
            )
        check_optimizer(f"{owner}['steps']", given["steps"], optimizer)
        return Kept(**given)
