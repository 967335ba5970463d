"""Plans as a teacher: replanning from the states that a policy reaches."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.env import EnvState
from diffcloth_torch.envs.gym import ClothVectorEnv
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn.plans import Plans, hats, improve, knots_of
from diffcloth_torch.learn.policy import Policy
from diffcloth_torch.learn.rollouts import MakeEnv
from diffcloth_torch.learn.starts import part_seeds

__all__ = ["Replanning"]

_KNOTS = 12
_NOISE = 0.05  # standard deviation of the noise on actions of followed plans
_ITERATIONS = 5  # of a plan that begins from the nearest plan
_RATE = 0.03  # initial learning rate of Adam
_BRANCHES = 3  # times of an episode at which a round replans; the first one is the start
_LAST_BRANCH = 0.75  # share of the episode after which no replanning begins


class Replanning:
    """Lessons from plans.

    In the first round the plans are followed, with noise. In a later round the policy acts from new
    starts; at some times of the episode, the remaining actions are planned by a few gradient
    iterations from the nearest plan: its scaled observation at that time has the smallest distance
    from the present one. The observations along the new plan are labelled with its actions, and the
    new plan is added to the others. A new plan is discarded if it fails and the nearest plan
    succeeds.
    """

    def __init__(
        self, make: MakeEnv, env: ClothVectorEnv, plans: Plans, seed: int, draws: torch.Generator
    ) -> None:
        """Check the plans and fit their knots.

        Args:
            make: Function that makes environments, here one for each plan.
            env: Environments of later rounds.
            plans: Plans for starts of the same task.
            seed: Seed of new starts.
            draws: Generator that draws noise and times.

        Raises:
            InvalidInput: If the lengths of episodes or actions of the plans differ from the task.
        """
        expected = env.task.horizon, env.task.action_size
        if tuple(plans.actions.shape[1:]) != expected:
            raise InvalidInput(
                "imitate: `teacher` must have plans [E, {}, {}], got {}".format(
                    *expected, list(plans.actions.shape)
                )
            )
        self._make, self._env, self._plans = make, env, plans
        self._seed, self._draws = seed, draws
        self._knots = knots_of(plans.actions, _KNOTS)  # [L, K, A]
        self._success = plans.success
        self._seen = cpu.zeros(0, dtype=torch.float32)  # [L, T, O]; infinite before a plan begins

    def round(self, policy: Policy, number: int) -> tuple[Tensor, Tensor]:
        """Return the observations [n, O] and actions [n, A] of a round."""
        if number == 0:
            return self._followed()
        env, found = self._env, []
        env.reset(seed=part_seeds(self._seed, number, env.num_envs))
        place = env.env_state.detach()
        lost = cpu.zeros(env.num_envs, dtype=torch.bool)
        for branch in self._branches():
            while int(place.elapsed[0]) < branch:
                seen = env.task.observation(place).to(torch.float32)
                place = env.task.transition(place, policy(seen).double(), env.parameters)
                lost = lost | env.task.terminal(place)
            found.append(self._planned(place, policy, lost))
        return torch.cat([seen for seen, _ in found]), torch.cat([made for _, made in found])

    def _followed(self) -> tuple[Tensor, Tensor]:
        """Follow the plans with noise; return observations and actions without noise."""
        actions = self._plans.actions
        env = self._make(num_envs=len(actions))
        env.reset(seed=self._plans.seeds.tolist())
        noise = cpu.randn(*actions.shape, generator=self._draws, dtype=torch.float64)
        made = (actions + _NOISE * noise).clamp(-1, 1)
        self._seen, kept = _watched(env, env.env_state.detach(), made)
        return self._seen[kept], actions.to(torch.float32)[kept]

    def _branches(self) -> list[int]:
        """Draw the times at which a round replans, ascending."""
        last = math.ceil(_LAST_BRANCH * self._env.task.horizon)
        later = cpu.randint(last, (_BRANCHES - 1,), generator=self._draws)
        return sorted({0, *later.tolist()})

    def _planned(self, place: EnvState, policy: Policy, lost: Tensor) -> tuple[Tensor, Tensor]:
        """Replan the rest of the episodes; lessons exclude the environments that are lost [B]."""
        env, done = self._env, int(place.elapsed[0])
        here = policy.scale(env.task.observation(place).to(torch.float32))
        near = torch.cdist(here, policy.scale(self._seen[:, done])).argmin(dim=1)
        tried = improve(env, place, self._knots[near], 0)
        tried = tried.better(improve(env, place, self._continued(place, policy), 0))
        with torch.enable_grad():
            found = improve(env, place, tried.knots, _ITERATIONS, _RATE)
        counts = ~lost & (found.success | ~self._success[near])
        actions = (hats(env.task.horizon, _KNOTS)[done:] @ found.knots).tanh()
        seen, kept = _watched(env, place, actions)
        kept = kept & counts[:, None]
        before = cpu.full((len(seen), done, seen.shape[-1]), math.inf, dtype=torch.float32)
        self._seen = torch.cat([self._seen, torch.cat([before, seen], dim=1)[counts]])
        self._knots = torch.cat([self._knots, found.knots[counts]])
        self._success = torch.cat([self._success, found.success[counts]])
        return seen[kept], actions.to(torch.float32)[kept]

    def _continued(self, place: EnvState, policy: Policy) -> Tensor:
        """Fit knots [B, K, A] to the actions of the policy in the rest of the episodes."""
        env, done, actions = self._env, int(place.elapsed[0]), []
        for _ in range(env.task.horizon - done):
            seen = env.task.observation(place).to(torch.float32)
            actions.append(policy(seen).double())
            place = env.task.transition(place, actions[-1], env.parameters)
        return knots_of(torch.stack(actions, dim=1), _KNOTS, done)


def _watched(env: ClothVectorEnv, place: EnvState, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Return observations [n, T, O] before actions [n, T, A], and running flags [n, T]."""
    seen, runs = [], []
    running = cpu.ones(len(place), dtype=torch.bool)
    for k in range(actions.shape[1]):
        seen.append(env.task.observation(place).to(torch.float32))
        runs.append(running)
        place = env.task.transition(place, actions[:, k], env.parameters)
        running = running & ~env.task.terminal(place)
    return torch.stack(seen, dim=1), torch.stack(runs, dim=1)
