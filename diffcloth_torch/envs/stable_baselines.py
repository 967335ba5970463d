"""Environments for Stable-Baselines3: NumPy arrays, without gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from diffcloth_torch.envs.gym import ClothVectorEnv, begins_anew

__all__ = ["StableBaselinesEnv"]


class StableBaselinesEnv(VecEnv):
    """A `VecEnv` of Stable-Baselines3: NumPy arrays, and new starts in the step of an end.

    >>> model = stable_baselines3.PPO("MlpPolicy", StableBaselinesEnv(dc.envs.make("FoldCloth", 8)))
    """

    def __init__(self, env: ClothVectorEnv) -> None:
        """Wrap environments that restart in the step in which they end."""
        self.env = begins_anew("StableBaselinesEnv: `env`", env)
        self._actions: NDArray[np.float32] | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> NDArray[np.float32]:
        """Return observations [B, O] of new starts, with the seeds set by `seed`."""
        seeds = [s for s in self._seeds if s is not None]
        observation, _ = self.env.reset(seed=seeds if len(seeds) == self.num_envs else None)
        self._reset_seeds()
        return observation.numpy()

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Return observations, rewards, whether episodes have ended, and information for each."""
        with torch.no_grad():
            observation, reward, terminated, truncated, info = self.env.step(self._actions)
        ended = terminated | truncated
        infos: list[dict[str, Any]] = []
        for i in range(self.num_envs):
            one = {name: info[name][i].item() for name in ("success", "failed", "blocked")}
            one["TimeLimit.truncated"] = bool(truncated[i])
            if ended[i]:
                one["terminal_observation"] = info["final_obs"][i].numpy()
            infos.append(one)
        return observation.numpy(), reward.numpy(), ended.numpy(), infos

    def close(self) -> None:
        """Free the window of pictures."""
        self.env.close()

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """Pictures [height, width, 3] of all environments, for `VecVideoRecorder`."""
        images = self.env.render()
        return [None] * self.num_envs if images is None else list(images)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the environments, the same for all."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all environments."""
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **keywords: Any
    ) -> list[Any]:
        """Call a method of the environments, once for all."""
        result = getattr(self.env, method_name)(*args, **keywords)
        return [result] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return False for all environments: no environment is wrapped."""
        return [False] * len(list(self._get_indices(indices)))
