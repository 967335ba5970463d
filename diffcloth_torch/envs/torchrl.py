"""Environments for TorchRL, with gradients."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium.vector import AutoresetMode
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from diffcloth_torch import cpu
from diffcloth_torch.envs.gym import ClothVectorEnv
from diffcloth_torch.errors import InvalidInput

__all__ = ["TorchRLEnv"]


class TorchRLEnv(EnvBase):  # type: ignore[misc]  # torchrl has no types
    """An `EnvBase` with the batch size [B]; rewards keep the graph of the actions.

    >>> env = TorchRLEnv(dc.envs.make("FoldCloth", 8, autoreset_mode="Disabled"))
    >>> rollout = env.rollout(10, policy)
    """

    def __init__(self, env: ClothVectorEnv) -> None:
        """Wrap environments that do not restart by themselves.

        Raises:
            InvalidInput: If the environments restart by themselves.
        """
        if env.metadata["autoreset_mode"] is not AutoresetMode.DISABLED:
            raise InvalidInput("TorchRLEnv: `env` must have autoreset_mode='Disabled'")
        batch = torch.Size([env.num_envs])
        super().__init__(device="cpu", batch_size=batch)
        self.env = env
        observations = env.task.observation(env.task.example()).shape[-1]
        flags = {"success": Binary(1, shape=(*batch, 1), dtype=torch.bool)}
        self.observation_spec = Composite(
            observation=Unbounded((*batch, observations)), **flags, shape=batch
        )
        self.action_spec = Bounded(-1.0, 1.0, (*batch, env.task.action_size))
        self.reward_spec = Unbounded((*batch, 1))
        ends = {
            name: Binary(1, shape=(*batch, 1), dtype=torch.bool)
            for name in ("done", "terminated", "truncated")
        }
        self.full_done_spec = Composite(**ends, shape=batch)
        self._next_seed: int | None = None

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        options = None
        if tensordict is not None and "_reset" in tensordict:
            options = {"reset_mask": tensordict["_reset"].reshape(-1)}
        observation, info = self.env.reset(seed=self._next_seed, options=options)
        self._next_seed = None
        ends = dict.fromkeys(
            ("terminated", "truncated"), cpu.zeros(self.batch_size, dtype=torch.bool)
        )
        return self._dict(observation, info, ends)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, reward, terminated, truncated, info = self.env.step(tensordict["action"])
        ends = {"terminated": terminated, "truncated": truncated}
        result = self._dict(observation, info, ends)
        return result.set("reward", reward[:, None])

    def _set_seed(self, seed: int | None) -> None:
        self._next_seed = seed

    def _dict(
        self, observation: torch.Tensor, info: dict[str, Any], ends: dict[str, torch.Tensor]
    ) -> TensorDict:
        done = ends["terminated"] | ends["truncated"]
        flags = {"success": info["success"], **ends, "done": done}
        columns = {name: flag[:, None] for name, flag in flags.items()}
        return TensorDict({"observation": observation, **columns}, self.batch_size)
