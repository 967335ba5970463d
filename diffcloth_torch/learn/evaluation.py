"""Evaluation of policies in episodes from fresh starts, each with its own seed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import (
    check_choice,
    check_count,
    check_shape,
    float_tensor,
)
from diffcloth_torch.envs.gym import ClothVectorEnv
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn.policy import Policy, PolicySizes, check_fits
from diffcloth_torch.learn.rollouts import MakeEnv, environments, threads_of_torch
from diffcloth_torch.learn.starts import episode_seeds
from diffcloth_torch.learn.workers import Workers, check_workers, pickled
from diffcloth_torch.operations import called
from diffcloth_torch.reprs import field_text, record_text
from diffcloth_torch.sim.records.state import State

__all__ = [
    "Acts",
    "Episodes",
    "Step",
    "acting",
    "evaluate",
    "evaluate_starts",
    "follow",
    "noise_of_success",
    "seeds_of",
    "steps_of",
    "wilson",
]

Acts = Callable[[Tensor], Any] | str
"""A function of observations [B, O] that returns actions [B, A], or "scripted"."""

_LARGEST_EPISODES = 10**6  # more than can be computed in a day
_CHUNK = 8  # environments that step together
_LARGEST_SEED = 2**64 - 1
_SCRIPTED = ("scripted",)
_ROWS = ("returns", "success", "ever", "failed", "blocked")
_QUANTILE = 1.959963984540054  # of the normal distribution, for 95 %
_ERRORS = 2  # standard errors of a share of successes


@dataclass(frozen=True, eq=False, repr=False)
class Episodes:
    """Results of episodes of a policy.

    `len` returns E, the number of episodes.

    Attributes:
        returns: Sum of the rewards of each episode, float32 [E].
        success: True if the episode ended in success, bool [E].
        ever: True if the episode was successful at any step, bool [E].
        failed: True if the simulation failed, which ends an episode, bool [E].
        blocked: True if an infeasible motion was blocked, bool [E].
        steps: Number of environment steps of all episodes.
        seeds: Seeds of the starts [E]: `env.reset(seed=seeds[:8])` begins the first eight episodes.
    """

    returns: Tensor
    success: Tensor
    ever: Tensor
    failed: Tensor
    blocked: Tensor
    steps: int
    seeds: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.seeds)

    @property
    def mean_return(self) -> float:
        """Mean of the returns."""
        return float(self.returns.mean())

    @property
    def success_rate(self) -> float:
        """Share of the episodes that succeeded."""
        return float(self.success.float().mean())

    @property
    def interval(self) -> tuple[float, float]:
        """Confidence interval of the probability of success, 95 %; see `wilson`."""
        return wilson(int(self.success.sum()), len(self))

    def __repr__(self) -> str:
        low, high = self.interval
        counts = ("success", "ever", "failed", "blocked")
        parts = [f"{name}={int(getattr(self, name).sum())} of {len(self)}" for name in counts]
        parts[0] += f" ({low:.0%} to {high:.0%})"
        return record_text(
            type(self).__name__,
            [*parts, field_text("mean_return", self.mean_return), field_text("steps", self.steps)],
        )


def wilson(successes: int, count: int) -> tuple[float, float]:
    """Confidence interval of a probability of success, 95 %.

    Wilson, "Probable Inference, the Law of Succession, and Statistical Inference", Journal of the
    American Statistical Association 22 (1927).

    Args:
        successes: Number of successes.
        count: Number of trials, >= 1.
    """
    share, square = successes / count, _QUANTILE**2 / count
    middle = (share + square / 2) / (1 + square)
    half = _QUANTILE / (1 + square) * math.sqrt(share * (1 - share) / count + square / (4 * count))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def noise_of_success(episodes: int, *shares: float) -> float:
    """Two standard errors of a share of successes, or of the difference of two shares.

    Args:
        episodes: Number of episodes of each share, >= 1.
        shares: One or two shares.
    """
    return _ERRORS * math.sqrt(sum(share * (1 - share) for share in shares) / episodes)


@called("evaluate")
def evaluate(
    make: MakeEnv,
    policy: Acts,
    episodes: int = 64,
    seed: int = 10_000,
    *,
    workers: Workers | None = None,
) -> Episodes:
    """Evaluate a policy in episodes from fresh starts.

    The start of episode i depends on the seed and on i alone; the episode has the same bits for any
    number of episodes and any workers. These starts differ from the starts of a training, unless it
    used the same seeds.

    Args:
        make: Makes environments: `functools.partial(dc.envs.make, "FoldCloth", size=7)`.
        policy: A function of observations, float32 [1, O], that returns actions [1, A], such as a
            `Policy`; or "scripted" for the handwritten policy of the task. Policies must not depend
            on earlier observations: steps of several episodes alternate.
        episodes: E, the number of episodes.
        seed: Seed from which the seeds of the starts derive.
        workers: Workers that compute the episodes, to which `make` and `policy` are pickled; None:
            this process.

    Raises:
        InvalidInput: If an argument is not accepted, or the shape of the actions is wrong.
    """
    seeds = seeds_of("evaluate", seed, episodes)
    return evaluate_starts("evaluate", make, policy, seeds, workers=workers)


def seeds_of(owner: str, seed: int, episodes: int) -> list[int]:
    """Check arguments, and return the seeds of the starts of episodes."""
    check_count(f"{owner}: `episodes`", episodes, 1, _LARGEST_EPISODES)
    check_count(f"{owner}: `seed`", seed, 0, _LARGEST_SEED)
    return episode_seeds(seed, episodes)


def evaluate_starts(
    owner: str,
    make: MakeEnv,
    policy: Acts,
    seeds: Sequence[int],
    *,
    workers: Workers | None = None,
    note: Note | None = None,
) -> Episodes:
    """Evaluate a policy from the starts of given seeds; see `evaluate`.

    Args:
        owner: Prefix of messages.
        make: As for `evaluate`.
        policy: As for `evaluate`.
        seeds: Seeds of the starts, one for each episode.
        workers: As for `evaluate`.
        note: Called with the environments, the seeds and the steps of each chunk; unused with
            `workers`.
    """
    if not callable(make):
        raise TypeError(f"{owner}: `make` must be a function that makes environments, got {make!r}")
    given: object = policy
    if isinstance(given, str):
        check_choice(f"{owner}: `policy`", given, _SCRIPTED)
    elif not callable(given) or isinstance(given, type):
        raise TypeError(
            f'{owner}: `policy` must be a function of observations, or "scripted", got {policy!r}'
        )
    check_workers(f"{owner}: `workers`", workers)
    chunks = [tuple(seeds[k : k + _CHUNK]) for k in range(0, len(seeds), _CHUNK)]
    if workers is None:
        made: dict[int, ClothVectorEnv] = {}
        found = []
        for chunk in chunks:
            if len(chunk) not in made:
                made[len(chunk)] = make(num_envs=len(chunk))
            found.append(_rows(owner, made[len(chunk)], policy, chunk, note))
    else:
        make_env = pickled(f"{owner}: with `workers`, `make`", make)
        pickled(f"{owner}: with `workers`, `policy`", policy)
        found = list(workers.map(_rows_remotely, [(owner, make_env, policy, c) for c in chunks]))
    return Episodes(
        **{name: torch.cat([each[name] for each in found]) for name in _ROWS},
        steps=sum(int(each["lengths"].sum()) for each in found),
        seeds=tuple(seeds),
    )


def follow(
    env: ClothVectorEnv, act: Callable[[Tensor], Tensor], seed: int | Sequence[int]
) -> tuple[Tensor, Tensor, list[State]]:
    """Run episodes, and keep the states.

    Args:
        env: Environments, which are reset.
        act: Function that returns actions [B, A] for observations [B, O].
        seed: Seed of the reset.

    Returns:
        Returns [B], successes [B], and the states of all episodes until the first episode ends.
    """
    observation, _ = env.reset(seed=seed)
    total = cpu.zeros(env.num_envs, dtype=torch.float32)
    success = cpu.zeros(env.num_envs, dtype=torch.bool)
    states = [env.env_state.state]
    for step in steps_of(env, act, observation):
        total += torch.where(step.running, step.reward, 0.0)
        success = torch.where(step.running, step.flags["success"], success)
        if bool(step.goes_on.all()):
            states.append(env.env_state.state)
    return total, success, states


@dataclass(frozen=True, eq=False)
class Step:
    """A transition of all environments.

    Attributes:
        seen: Observations before the transition [B, O].
        actions: Actions [B, A].
        reward: Rewards [B].
        after: Observations after the transition, before a new start [B, O].
        terminated: True if the transition ended an episode before the horizon [B].
        truncated: True if the horizon ended an episode [B].
        flags: "success", "failed" and "blocked" after the transition, before a new start, [B] each.
        running: True if the first episode of the environment ran before the transition [B].
    """

    seen: Tensor
    actions: Tensor
    reward: Tensor
    after: Tensor
    terminated: Tensor
    truncated: Tensor
    flags: dict[str, Tensor]
    running: Tensor

    @property
    def goes_on(self) -> Tensor:
        """True if the first episode of the environment runs after the transition [B]."""
        return self.running & ~(self.terminated | self.truncated)


Note = Callable[[ClothVectorEnv, tuple[int, ...], list[Step]], None]


def steps_of(
    env: ClothVectorEnv, act: Callable[[Tensor], Tensor], observation: Tensor
) -> Iterator[Step]:
    """Yield transitions until each environment has ended an episode.

    Args:
        env: Environments at the start of their episodes.
        act: Function that returns actions [B, A] for observations [B, O].
        observation: Initial observation, returned by `env.reset`.
    """
    running = cpu.ones(env.num_envs, dtype=torch.bool)
    while bool(running.any()):
        with torch.no_grad():
            actions = act(observation)
            following, reward, terminated, truncated, info = env.step(actions)
        flags = info.get("final_info", info)
        after = info["obs_before_reset"]
        step = Step(observation, actions, reward, after, terminated, truncated, flags, running)
        yield step
        observation, running = following, step.goes_on


def acting(owner: str, env: ClothVectorEnv, policy: Acts) -> Callable[[Tensor], Tensor]:
    """Return a function that computes checked actions [B, A] for observations [B, O].

    The policy computes one row at a time, as rounding of matrix products depends on the number of
    rows.
    """
    if isinstance(policy, str):
        return lambda _: env.scripted_actions()
    if isinstance(policy, Policy):
        check_fits(f"{owner}: `policy`", policy, PolicySizes.of(env))
    function: Callable[[Tensor], Any] = policy

    def act(observation: Tensor) -> Tensor:
        name = f"{owner}: the actions of `policy`"
        rows = [float_tensor(name, function(row[None])) for row in observation]
        for row in rows:
            check_shape(name, row.shape, [(1, env.task.action_size)])
        actions = torch.cat(rows)
        if not bool(torch.isfinite(actions).all()):
            raise InvalidInput(f"{name} must be finite, got {actions.tolist()}")
        return actions

    return act


def _rows(
    owner: str,
    env: ClothVectorEnv,
    policy: Acts,
    seeds: tuple[int, ...],
    note: Note | None = None,
) -> dict[str, Tensor]:
    """Compute the tensors of `Episodes`, and the lengths of the episodes."""
    count = len(seeds)
    rows = {name: cpu.zeros(count, dtype=torch.bool) for name in _ROWS}
    rows["returns"] = cpu.zeros(count, dtype=torch.float32)
    rows["lengths"] = cpu.zeros(count, dtype=torch.int64)
    steps: list[Step] = []
    with threads_of_torch(1):
        observation, _ = env.reset(seed=seeds)
        for step in steps_of(env, acting(owner, env, policy), observation):
            running, flags = step.running, step.flags
            rows["returns"] += torch.where(running, step.reward, 0.0)
            rows["lengths"] += running
            rows["success"] = torch.where(running, flags["success"], rows["success"])
            rows["ever"] |= running & flags["success"]
            for name in ("failed", "blocked"):
                rows[name] |= running & flags[name]
            if note is not None:
                steps.append(step)
    if note is not None:
        note(env, seeds, steps)
    return rows


def _rows_remotely(work: tuple[str, bytes, Acts, tuple[int, ...]]) -> dict[str, Tensor]:
    owner, make_env, policy, seeds = work
    return _rows(owner, environments(make_env, len(seeds)), policy, seeds)
