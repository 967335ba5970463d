"""Rollouts of a policy: initial states, observations, and the gradient of the loss.

A `Piece` holds all inputs of a rollout, a `Rollout` all its results; both can be sent to another
process. No autograd graph leaves the process that made it.
"""

from __future__ import annotations

import pickle
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
    "MakeEnv",
    "Piece",
    "Rollout",
    "environments",
    "roll_out",
    "roll_out_remotely",
    "threads_of_torch",
]

MakeEnv = Callable[..., ClothVectorEnv]
"""A function that makes environments, like `dc.envs.make`; called with the keyword `num_envs`."""


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
    """

    options: TrainerOptions
    weights: dict[str, Tensor]
    start: EnvState
    generators: list[Tensor]
    noise: Tensor
    share: float
    threads: int = 1


@dataclass(frozen=True, eq=False)
class Rollout:
    """Result of a piece: h steps of n environments.

    Attributes:
        gradients: Gradients of the loss, in the order of `Policy.actor.parameters()`.
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
    o = piece.options
    policy = Policy(env, o)
    policy.load_state_dict(piece.weights)
    observation = env.resume(piece.start, piece.generators)
    count, horizon = env.num_envs, len(piece.noise)
    temperature = policy.temperature
    rows: list[dict[str, Tensor]] = []
    discount, total = cpu.ones(count, dtype=torch.float32), cpu.zeros(count, dtype=torch.float32)
    for t, noise in enumerate(piece.noise):
        seen = observation.detach()
        actions, entropy = policy.act(observation if o.feedback else seen, noise)
        observation, reward, terminated, truncated, info = env.step(actions)
        ended = terminated | truncated
        after = info["obs_before_reset"]
        total = total + discount * (reward + temperature * entropy)
        discount = discount * o.discount
        if o.has_critic:
            # Value at the end of an episode or of the rollout; zero after a termination.
            closes = truncated if t < horizon - 1 else ~terminated
            value = policy.targets(policy.scale(after)).mean(dim=0)
            total = total + torch.where(closes, discount * value, 0.0)
        discount = torch.where(ended, 1.0, discount)
        final = info.get("final_info", info)
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
    gradients = torch.autograd.grad(loss, list(policy.actor.parameters()))
    env.clear_grad()
    return Rollout(
        gradients=list(gradients),
        loss=float(loss.detach()),
        end=env.env_state,
        generators=env.generator_states(),
        **{name: torch.stack([row[name] for row in rows]) for name in rows[0]},
    )


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


@contextmanager
def threads_of_torch(count: int) -> Iterator[None]:
    """Set the number of threads of torch in a block; rounding of matrix products depends on it."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
