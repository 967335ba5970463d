"""Policies that imitate a teacher in the states that the policies visit.

Reference: Ross, Gordon, Bagnell, "A Reduction of Imitation Learning and Structured Prediction to
No-Regret Online Learning", AISTATS 2011 (DAgger).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import check_count, check_shape, float_tensor
from diffcloth_torch.envs.gym import ClothVectorEnv
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn.options import TrainerOptions
from diffcloth_torch.learn.plans import Plans
from diffcloth_torch.learn.policy import Policy
from diffcloth_torch.learn.replanning import Replanning
from diffcloth_torch.learn.rollouts import MakeEnv, threads_of_torch
from diffcloth_torch.learn.starts import LARGEST_SEED, part_seeds
from diffcloth_torch.memory import check_memory
from diffcloth_torch.operations import called

__all__ = ["OPTIONS", "Teacher", "imitate"]

Teacher = Callable[[Tensor, ClothVectorEnv], Tensor]
"""A function of observations [B, O] and environments that returns actions [B, A]."""

OPTIONS = TrainerOptions("apg", plan_knots=12, hidden=(128, 128), init_std=0.05)
"""Default options, which define the networks of a policy."""

_NOISE = 0.1  # standard deviation of the noise on the actions of a teacher in the first round
_NOISY = 0.5  # share of these actions that have noise
_RATE = 3e-3  # initial learning rate of Adam; it falls to 0 along a cosine
_BATCH = 256
_DECAY = 1.0  # weight decay for plans as a teacher, whose starts are few


@called("imitate")
def imitate(
    make: MakeEnv,
    teacher: str | Plans | Teacher = "scripted",
    rounds: int = 6,
    episodes: int = 24,
    seed: int = 0,
    *,
    iterations: int = 1000,
    options: TrainerOptions | None = None,
) -> Policy:
    """Fit a policy to the actions of a teacher in the states that the policy visits.

    In the first round the teacher acts, with noise on half of its actions; in later rounds the
    policy acts, without noise. The teacher labels each observation with its action, and after each
    round the policy is fitted to all labels so far, by mean squared error.

    If the teacher is a set of plans, the first round follows the plans. In a later round the policy
    acts from new starts, and at some times of an episode the remaining actions are planned anew, by
    a few gradient iterations from the nearest plan; see `Replanning`.

    Args:
        make: Makes environments: `functools.partial(dc.envs.make, "FoldCloth", size=7)`.
        teacher: "scripted" for the handwritten policy of the task, plans of `dc.learn.plan` for
            the same task, or a function of observations [B, O] and environments that returns
            actions [B, A], between -1 and 1.
        rounds: Number of rounds.
        episodes: Number of episodes of a round.
        seed: Seed of the starts, of the noise, of the networks and of the fit.
        iterations: Steps of Adam after each round.
        options: Options whose `hidden`, `plan_knots`, `init_std` and `first_action` define the
            policy; a trainer with equal values can continue from it. None: (128, 128), 12, .05 and
            None.

    Returns:
        The policy. The scale of its observations is computed from the first round.

    Raises:
        InvalidInput: If an argument is not accepted, or the teacher returns actions that are not
            finite or have a wrong shape.
    """
    if not callable(make):
        raise TypeError(f"imitate: `make` must be a function that makes environments, got {make!r}")
    checked = _checked_teacher(teacher)
    check_count("imitate: `rounds`", rounds, 1)
    check_count("imitate: `episodes`", episodes, 1)
    check_count("imitate: `seed`", seed, 0, LARGEST_SEED)
    check_count("imitate: `iterations`", iterations, 1)
    given: object = OPTIONS if options is None else options
    if not isinstance(given, TrainerOptions):
        raise TypeError(f"imitate: `options` must be TrainerOptions, got {type(given).__name__}")
    with threads_of_torch(1):
        env = make(num_envs=episodes)
        noise = cpu.generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            policy = Policy(env, given)
        each = 4 * (policy.observations + env.task.action_size)
        check_memory("imitate: `rounds`", rounds, episodes * env.task.horizon * each, "a round")
        lessons: Replanning | _Labels = (
            Replanning(make, env, checked, seed, noise)
            if isinstance(checked, Plans)
            else _Labels(env, checked, seed, noise)
        )
        seen: list[Tensor] = []
        shown: list[Tensor] = []
        for k in range(rounds):
            with torch.no_grad():
                observations, actions = lessons.round(policy, k)
            seen.append(observations)
            shown.append(actions)
            if k == 0:
                policy.scale.see(observations)
            decay = _DECAY if isinstance(checked, Plans) else 0.0
            fit(policy, torch.cat(seen), torch.cat(shown), iterations, noise, decay)
    return policy


def fit(
    policy: Policy,
    seen: Tensor,
    shown: Tensor,
    iterations: int,
    draws: torch.Generator,
    decay: float = 0.0,
) -> float:
    """Fit the actor to actions [n, A] of observations [n, O]; return the last loss.

    Args:
        policy: Policy whose actor is updated.
        seen: Observations.
        shown: Actions.
        iterations: Number of steps of Adam.
        draws: Generator that draws the batches.
        decay: Weight decay of AdamW; it does not apply to knots, which are actions, nor to the
            logarithm of the deviation of the noise, on which the loss does not depend.
    """
    groups: dict[bool, list[torch.nn.Parameter]] = {True: [], False: []}
    for name, parameter in policy.actor.named_parameters():
        groups[name.endswith(("knots", "log_deviation"))].append(parameter)
    adam = torch.optim.AdamW(
        [
            {"params": parameters, "weight_decay": 0.0 if fixed else decay}
            for fixed, parameters in groups.items()
            if parameters
        ],
        lr=_RATE,
    )
    rates = torch.optim.lr_scheduler.CosineAnnealingLR(adam, iterations)
    loss = cpu.zeros(())
    for _ in range(iterations):
        rows = (cpu.rand(min(_BATCH, len(seen)), generator=draws) * len(seen)).long()
        loss = (policy(seen[rows]) - shown[rows]).square().mean()
        adam.zero_grad()
        loss.backward()
        with cpu.DEVICE:  # device of the step counts of Adam
            adam.step()
        rates.step()
    return float(loss.detach())


def _checked_teacher(teacher: Any) -> Plans | Teacher:
    if isinstance(teacher, Plans):
        return teacher
    if isinstance(teacher, str):
        if teacher != "scripted":
            raise InvalidInput(
                f"imitate: `teacher` must be 'scripted', Plans or a function, got {teacher!r}"
            )
        return lambda _, env: env.scripted_actions()
    if not callable(teacher):
        raise TypeError(
            "imitate: `teacher` must be 'scripted', Plans or a function of observations and "
            f"environments, got {teacher!r}"
        )
    act: Teacher = teacher
    return act


class _Labels:
    """Lessons from a teacher that can act in every state."""

    def __init__(
        self, env: ClothVectorEnv, teacher: Teacher, seed: int, draws: torch.Generator
    ) -> None:
        self._env, self._teacher, self._seed, self._draws = env, teacher, seed, draws

    def round(self, policy: Policy, number: int) -> tuple[Tensor, Tensor]:
        """Return observations [n, O] of one episode of each environment, and labels [n, A]."""
        env = self._env
        observation, _ = env.reset(seed=part_seeds(self._seed, number, env.num_envs))
        running = cpu.ones(env.num_envs, dtype=torch.bool)
        seen, shown = [], []
        while bool(running.any()):
            label = _label(self._teacher, observation, env)
            seen.append(observation[running])
            shown.append(label[running])
            actions = _noisy(label, self._draws) if number == 0 else policy(observation)
            observation, _, terminated, truncated, _ = env.step(actions)
            running = running & ~(terminated | truncated)
        return torch.cat(seen), torch.cat(shown)


def _label(teacher: Teacher, observation: Tensor, env: ClothVectorEnv) -> Tensor:
    """Return the checked actions of the teacher, float32 [B, A]."""
    name = "imitate: actions of `teacher`"
    actions = float_tensor(name, teacher(observation, env)).detach()
    check_shape(name, actions.shape, [(env.num_envs, env.task.action_size)])
    if not bool(torch.isfinite(actions).all()):
        row = int((~torch.isfinite(actions)).any(dim=-1).nonzero()[0])
        raise InvalidInput(f"{name} must be finite, those of environment {row} are not")
    return actions.clamp(-1, 1).to(torch.float32)


def _noisy(actions: Tensor, generator: torch.Generator) -> Tensor:
    """Add noise to half of the rows of actions [B, A], chosen at random."""
    noise = _NOISE * cpu.randn(*actions.shape, generator=generator, dtype=actions.dtype)
    chosen = cpu.rand(len(actions), 1, generator=generator) < _NOISY
    return (actions + noise * chosen).clamp(-1, 1)
