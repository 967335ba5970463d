"""Environments with the interface of rsl_rl, without gradients."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from diffcloth_torch.envs.gym import ClothVectorEnv, begins_anew

__all__ = ["RslRlEnv"]


class RslRlEnv:
    """Interface of `rsl_rl.env.VecEnv` (3.0 and later); observations are in the group "policy".

    Attributes:
        num_envs: B, the number of environments.
        num_actions: A, the length of an action.
        max_episode_length: Number of steps of an episode.
        device: The CPU.
        cfg: An empty dict.
    """

    def __init__(self, env: ClothVectorEnv, *, seed: int | None = None) -> None:
        """Wrap environments that restart in the step in which they end, and start them."""
        self.env = begins_anew("RslRlEnv: `env`", env)
        self.num_envs, self.num_actions = env.num_envs, env.task.action_size
        self.max_episode_length = env.task.horizon
        self.device = torch.device("cpu")
        self.cfg: dict[str, Any] = {}
        self._observation, _ = env.reset(seed=seed)

    @property
    def episode_length_buf(self) -> Tensor:
        """Steps since the start of each episode [B]; a runner may set random numbers at first."""
        return self.env.env_state.elapsed

    @episode_length_buf.setter
    def episode_length_buf(self, steps: Tensor) -> None:
        self.env.env_state = replace(self.env.env_state, elapsed=steps)

    def get_observations(self) -> TensorDict:
        """The present observations."""
        return TensorDict({"policy": self._observation}, [self.num_envs])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Return observations, rewards [B], whether episodes have ended [B], and extras."""
        with torch.no_grad():
            self._observation, reward, terminated, truncated, info = self.env.step(actions)
        extras = {
            "time_outs": truncated,
            "log": {name: info[name].float().mean() for name in ("success", "failed", "blocked")},
        }
        return self.get_observations(), reward, (terminated | truncated).long(), extras
