"""Rollouts of a policy: initial states, observations, and the gradient of the loss.

A `Piece` holds all inputs of a rollout, a `Rollout` all its results; both can be sent to another
process. No autograd graph leaves the process that made it.
"""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.env import EnvState
from diffcloth_torch.envs.gym import ClothVectorEnv
from diffcloth_torch.learn.options import TrainerOptions
from diffcloth_torch.learn.policy import Policy

__all__ = [
    "LAST_WEIGHT",
    "MakeEnv",
    "Piece",
    "Rollout",
    "environments",
    "roll_out",
    "roll_out_remotely",
    "threads_of_torch",
    "unit_gradients",
]

MakeEnv = Callable[..., ClothVectorEnv]
"""A function that makes environments, like `dc.envs.make`; called with the keyword `num_envs`."""

LAST_WEIGHT = 3.0
"""Additional weight of the last rewards of an episode, in which success is read."""


@dataclass(frozen=True, eq=False)
class Piece:
    """Inputs of a rollout of some of the environments.

    Attributes:
        options: Options of the trainer.
        weights: State of the `Policy`.
        start: Initial state of the environments, without a graph.
        generators: States of the random generators that draw their next starts.
        noise: Standard normal noise [h, n, A].
        share: Weight of each environment in the loss: one over their number in all pieces.
        threads: Number of threads of torch.
        learns: True if the rollout is differentiated.
    """

    options: TrainerOptions
    weights: dict[str, Tensor]
    start: EnvState
    generators: list[Tensor]
    noise: Tensor
    share: float
    threads: int = 1
    learns: bool = True


@dataclass(frozen=True, eq=False)
class Rollout:
    """Result of a piece: h steps of n environments.

    Attributes:
        gradients: Gradients of the loss, in the order of `Policy.actor.parameters()`; empty with
            `action_step`.
        slopes: With `action_step`, derivatives of the objective of each environment by its actions
            [h, n, A], otherwise None.
        loss: Minus the objective: mean discounted rewards, with the entropy and value terms of the
            algorithm.
        seen: Observations before each step [h, n, O].
        after: Observations after each step, before a new start [h, n, O].
        rewards: Rewards [h, n].
        entropies: Minus the logarithms of the densities of the actions [h, n].
        terminated: True if the step ended its episode before the horizon [h, n].
        failed: True if the simulation failed in the step [h, n].
        ended: True if the step ended an episode [h, n].
        success: True if the task was done after the step [h, n].
        end: Final state of the environments.
        generators: States of the random generators that draw their next starts.
    """

    gradients: list[Tensor]
    slopes: Tensor | None
    loss: float
    seen: Tensor
    after: Tensor
    rewards: Tensor
    entropies: Tensor
    terminated: Tensor
    failed: Tensor
    ended: Tensor
    success: Tensor
    end: EnvState
    generators: list[Tensor]


def roll_out(env: ClothVectorEnv, piece: Piece) -> Rollout:
    """Compute a rollout, and the gradient of its loss."""
    with torch.set_grad_enabled(piece.learns):
        return _rolled_out(env, piece)


def _rolled_out(env: ClothVectorEnv, piece: Piece) -> Rollout:
    o = piece.options
    policy = Policy(env, o)
    policy.load_state_dict(piece.weights)
    observation = env.resume(piece.start, piece.generators)
    count, horizon = env.num_envs, len(piece.noise)
    temperature = policy.temperature
    moves_actions = o.action_step is not None
    rows: list[dict[str, Tensor]] = []
    leaves: list[Tensor] = []
    last: deque[Tensor] = deque(maxlen=env.task.holds)  # discounted rewards
    discount, total = cpu.ones(count, dtype=torch.float32), cpu.zeros(count, dtype=torch.float32)
    for t, noise in enumerate(piece.noise):
        seen = observation.detach()
        actions, entropy = policy.act(observation if o.feedback else seen, noise)
        if moves_actions:
            actions = actions.detach().requires_grad_(piece.learns)
            leaves.append(actions)
        observation, reward, terminated, truncated, info = env.step(actions)
        ended = terminated | truncated
        after = info["obs_before_reset"]
        final = info.get("final_info", info)
        total = total + discount * (reward + temperature * entropy)
        if moves_actions:
            last.append(discount * reward)
            missed = truncated & ~final["success"]
            total = total + torch.where(missed, LAST_WEIGHT * torch.stack([*last]).sum(dim=0), 0.0)
            if bool(ended.any()):  # rewards of an episode do not count in the next one
                last = deque([torch.where(ended, 0.0, each) for each in last], maxlen=last.maxlen)
        discount = discount * o.discount
        if o.has_critic:
            # Value at the end of an episode or of the rollout; zero after a termination.
            closes = truncated if t < horizon - 1 else ~terminated
            value = policy.targets(policy.scale(after)).mean(dim=0)
            total = total + torch.where(closes, discount * value, 0.0)
        discount = torch.where(ended, 1.0, discount)
        rows.append(
            {
                "seen": seen,
                "after": after.detach(),
                "rewards": reward.detach(),
                "entropies": entropy.detach(),
                "terminated": terminated,
                "failed": final["failed"],
                "ended": ended,
                "success": final["success"],
            }
        )
    loss = -piece.share / horizon * total.sum()
    gradients: list[Tensor] = []
    slopes = None
    if piece.learns and moves_actions:
        slopes = _slopes(total, leaves)
    elif piece.learns:
        gradients = list(torch.autograd.grad(loss, list(policy.actor.parameters())))
    env.clear_grad()
    return Rollout(
        gradients=gradients,
        slopes=slopes,
        loss=float(loss.detach()),
        end=env.env_state,
        generators=env.generator_states(),
        **{name: torch.stack([row[name] for row in rows]) for name in rows[0]},
    )


def _slopes(total: Tensor, leaves: list[Tensor]) -> Tensor:
    """Return derivatives [h, n, A] of objectives [n] by actions; zero where they do not depend."""
    if not total.requires_grad:
        return torch.zeros_like(torch.stack(leaves))
    found = torch.autograd.grad(total.sum(), leaves, materialize_grads=True)
    return torch.stack(found)


_made: dict[tuple[bytes, int], ClothVectorEnv] = {}  # in a worker's process


def roll_out_remotely(work: tuple[bytes, Piece]) -> Rollout:
    """Compute a rollout in this process, whose environments are reused.

    Args:
        work: A pickled `MakeEnv`, and the piece.
    """
    make_env, piece = work
    with threads_of_torch(piece.threads):
        return roll_out(environments(make_env, len(piece.start)), piece)


def environments(make_env: bytes, count: int) -> ClothVectorEnv:
    """Return environments of this process, which are reused for later pieces.

    Args:
        make_env: A pickled `MakeEnv`.
        count: Number of environments.
    """
    key = make_env, count
    if key not in _made:
        make: Any = pickle.loads(make_env)
        _made[key] = make(num_envs=count)
    return _made[key]


def unit_gradients(slopes: Tensor, dim: tuple[int, ...]) -> Tensor:
    """Divide the gradient of each environment by its own norm; zero gradients remain zero.

    Args:
        slopes: Derivatives of returns by actions.
        dim: Dimensions of time and actions.
    """
    norms = torch.linalg.vector_norm(slopes, dim=dim, keepdim=True)
    return torch.where(norms > 0, slopes / norms, 0.0)


@contextmanager
def threads_of_torch(count: int) -> Iterator[None]:
    """Set the number of threads of torch in a block; rounding of matrix products depends on it."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
