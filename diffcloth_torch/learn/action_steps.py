"""Updates that move actions, and fit the policy to the moved actions.

A step of weights along their gradient changes actions by different amounts at different starts: the
norms of gradients differ by orders of magnitude, and a start with a large norm determines the step.
Here each start moves its actions by the same distance, along its own gradient, and the policy is
fitted to the moved actions: a step in the space of policies, projected onto the networks. The fit
also retains the actions of the policy at observations of former rollouts, which a step from few
starts would change.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.learn.policy import Policy
from diffcloth_torch.learn.rollouts import unit_gradients

__all__ = ["fit_moved_actions", "moved_actions"]

_LARGEST_ACTION = 0.995  # moved actions are clipped to this, short of the ends of tanh
_FORMER_SHARE = 2  # ratio of former observations to new observations in a step of the fit


def moved_actions(actions: Tensor, slopes: Tensor, step: float, largest: float) -> Tensor:
    """Move actions along gradients, each environment by the same distance.

    Args:
        actions: Actions [h, B, A].
        slopes: Derivatives of the return of each environment by its actions [h, B, A]; where all
            are zero, actions are not moved.
        step: Root mean square of the moves of an environment, before clipping.
        largest: Largest move of a number of an action.

    Returns:
        Moved actions [h, B, A], between -.995 and .995.
    """
    size = math.sqrt(slopes.shape[0] * slopes.shape[2])
    moves = (step * size * unit_gradients(slopes, (0, 2))).clamp(-largest, largest)
    return (actions + moves).clamp(-_LARGEST_ACTION, _LARGEST_ACTION)


def fit_moved_actions(
    policy: Policy,
    seen: Tensor,
    slopes: Tensor,
    former: list[Tensor],
    step: float,
    largest: float,
    iterations: int,
    optimizer: torch.optim.Optimizer,
    draws: torch.Generator,
) -> float:
    """Move the actions of a rollout, and fit the policy to the moved actions.

    The loss is the mean squared difference from the moved actions, plus the mean squared change of
    actions at observations that are drawn from former rollouts.

    Args:
        policy: Policy whose actor is updated.
        seen: Observations of the rollout [h, B, O].
        slopes: Derivatives of returns by actions [h, B, A].
        former: Observations of former rollouts, each [n, O].
        step: Root mean square of the moves of an environment.
        largest: Largest move of a number of an action.
        iterations: Steps of the optimizer.
        optimizer: Optimizer of the actor.
        draws: Generator that draws former observations.

    Returns:
        Root mean square change of the actions of the rollout by the fit.
    """
    rows = seen.flatten(0, 1)
    with torch.no_grad():
        before = policy(rows)
        together = before.unflatten(0, seen.shape[:2])
        wanted = moved_actions(together, slopes, step, largest).flatten(0, 1)
        retained = [policy(each) for each in former]
    if former:
        other_rows, other_actions = torch.cat(former), torch.cat(retained)
        count = min(len(other_rows), _FORMER_SHARE * len(rows))
    for _ in range(iterations):
        loss = (policy(rows) - wanted).square().mean()
        if former:
            chosen = (cpu.rand(count, generator=draws) * len(other_rows)).long()
            loss = loss + (policy(other_rows[chosen]) - other_actions[chosen]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        with cpu.DEVICE:  # device of the step counts of Adam
            optimizer.step()
    with torch.no_grad():
        return float((policy(rows) - before).square().mean().sqrt())
