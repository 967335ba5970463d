"""Rollouts of a policy: where they start, what they saw, and their gradient.

A piece of work is all that a rollout needs, and its result all that it found: both can be sent to
another process. No graph leaves the process that made it.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.env import EnvState
from diffcloth_torch.envs.gym import ClothVectorEnv
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn.networks import Actor, Critics, Scale
from diffcloth_torch.learn.options import TrainerOptions
from diffcloth_torch.memory import check_memory

__all__ = [
    "MakeEnv",
    "Piece",
    "Policy",
    "Rollout",
    "roll_out",
    "roll_out_remotely",
    "threads_of_torch",
]

_WEIGHT_BYTES = 16  # with its gradient and the moments of Adam

MakeEnv = Callable[..., ClothVectorEnv]
"""A function that makes environments, as `dc.envs.make` does; called with `num_envs` by name."""


class Policy(torch.nn.Module):
    """A policy, its critics, slower copies that they aim at, and the scale of what they see.

    Attributes:
        log_temperature: Logarithm of what a unit of entropy is worth; of "sapo" alone.
    """

    def __init__(self, env: ClothVectorEnv, options: TrainerOptions) -> None:
        """Make networks for the observations and actions of environments."""
        super().__init__()
        observations = env.task.observation(env.task.example()).shape[-1]
        self.observations = int(observations)
        _check_size(self.observations, env.task.action_size, options)
        first = options.first_action or [0.0] * env.task.action_size
        self.actor = Actor(
            observations,
            cpu.tensor(first, dtype=torch.float32),
            options.hidden,
            options.init_std,
            sees_width=options.has_entropy,
            knots=options.plan_knots,
        )
        self._time = _place_of_time(env) if options.plan_knots else None
        critics = options.critics if options.has_entropy else 1
        self.critics = Critics(observations, options.hidden, critics)
        self.targets = Critics(observations, options.hidden, critics)
        self.targets.load_state_dict(self.critics.state_dict())
        self.scale = Scale(observations)
        self.log_temperature = torch.nn.Parameter(
            cpu.tensor(options.temperature, dtype=torch.float32).log()
        )
        self._has_entropy = options.has_entropy

    @property
    def temperature(self) -> float:
        """What a unit of entropy is worth, in units of reward."""
        return float(self.log_temperature.detach().exp()) if self._has_entropy else 0.0

    def forward(self, observation: Tensor, noise: Tensor | None = None) -> Tensor:
        """Actions [B, A] for observations [B, O], with standard normal noise [B, A] or without."""
        if noise is None:
            noise = cpu.zeros(1, dtype=torch.float32)
        return self.act(observation, noise)[0]

    def act(self, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions [B, A], and minus the logarithm of their density [B]; see `Actor`."""
        time = None if self._time is None else observation[:, self._time]
        actions, entropy = self.actor(self.scale(observation), noise, time)
        return actions, entropy


def _check_size(observations: int, actions: int, options: TrainerOptions) -> None:
    """Refuse networks that do not fit into memory, before they are made."""
    sizes = [observations, *options.hidden]
    inner = sum((before + 3) * after for before, after in pairwise(sizes))
    critics = 2 * (options.critics if options.has_entropy else 1)  # and their slower copies
    weights = (1 + critics) * (inner + (sizes[-1] + 1) * 2 * actions)
    names = "TrainerOptions: the weights by `hidden` and `critics`"
    check_memory(names, weights, _WEIGHT_BYTES, "a weight")
    knots = "TrainerOptions: `plan_knots`"
    check_memory(knots, options.plan_knots, actions * _WEIGHT_BYTES, "a knot")


def _place_of_time(env: ClothVectorEnv) -> int:
    slices = env.task.observation_slices
    if "time" not in slices:
        raise InvalidInput(
            f"TrainerOptions: `plan_knots` must be 0 for {env.task.name}, "
            'which does not observe its "time"'
        )
    place: int = slices["time"].start
    return place


@dataclass(frozen=True, eq=False)
class Piece:
    """A rollout that is to be made, of some of the environments.

    Attributes:
        options: Of the trainer.
        weights: State of the `Policy`.
        start: Where the environments are, without a graph.
        generators: Of their next starts.
        noise: Standard normal, [h, n, A].
        share: What each environment counts in the loss: one over their number in all pieces.
        threads: Of torch.
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
    """What came of a piece: h steps of n environments.

    Attributes:
        gradients: Of the loss, in the order of `Policy.actor.parameters()`.
        loss: Minus what the rollout is worth.
        seen: Observations before each step [h, n, O].
        after: Observations after it, before a new start [h, n, O].
        rewards: [h, n].
        entropies: Of the actions: minus the logarithm of their density [h, n].
        terminated: Whether it ended its episode before the horizon [h, n].
        failed: Whether the simulation failed in it [h, n].
        ended: Whether an episode ended with it [h, n].
        success: Whether the task was done after it [h, n].
        end: Where the environments are.
        generators: Of their next starts.
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
    """Make a rollout, and the gradient of its loss."""
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
            # What follows the end of an episode or of the rollout; nothing follows a failure.
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
    """Make a rollout in this process, whose environments last for later ones.

    Args:
        work: A pickled `MakeEnv`, and the piece.
    """
    make_env, piece = work
    key = make_env, len(piece.start)
    with threads_of_torch(piece.threads):
        if key not in _made:
            make: Any = pickle.loads(make_env)
            _made[key] = make(num_envs=len(piece.start))
        return roll_out(_made[key], piece)


@contextmanager
def threads_of_torch(count: int) -> Iterator[None]:
    """Let torch have some threads; products of its matrices round by their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
