"""One environment for gymnasium: NumPy arrays, without gradients."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from diffcloth_torch.checks import check_shape, float_tensor
from diffcloth_torch.envs.env import Task
from diffcloth_torch.envs.gym import ClothVectorEnv
from diffcloth_torch.operations import called

__all__ = ["ClothEnv"]


class ClothEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A task in one environment, as `gymnasium.make("diffcloth/FoldCloth-v0")` makes it.

    Observations and actions are float32 arrays [O] and [A]; an episode that has ended begins anew
    by `reset`. Use `dc.envs.make` for several environments, tensors and gradients.

    Attributes:
        vector: The same environment as a batch of one.
        task: The task.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    @called("ClothEnv")
    def __init__(self, task: Task, *, render_mode: str | None = None) -> None:
        """Prepare the environment; `reset` starts it.

        Args:
            task: The task.
            render_mode: "rgb_array" for pictures by `render`; None for none.

        Raises:
            InvalidInput: If an argument is not accepted.
        """
        self.vector = ClothVectorEnv(
            task, 1, autoreset_mode=AutoresetMode.DISABLED, render_mode=render_mode
        )
        self.task, self.render_mode = task, render_mode
        self.metadata = {**self.vector.metadata, "autoreset_mode": None}
        self.observation_space = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; without a seed, the generator continues."""
        observation, info = self.vector.reset(seed=seed, options=options)
        super().reset(seed=seed)
        return observation[0].numpy(), _first(info)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Return the observation, the reward, whether the episode ends, and information."""
        with torch.no_grad():
            given = float_tensor("step: `action`", action)
            check_shape("step: `action`", given.shape, [(self.task.action_size,)])
            observation, reward, terminated, truncated, info = self.vector.step(given[None])
        ends = bool(terminated[0]), bool(truncated[0])
        return observation[0].numpy(), float(reward[0]), *ends, _first(info)

    def scripted_action(self) -> NDArray[np.float32]:
        """The action [A] of the policy made by hand, for the present state."""
        return self.vector.scripted_actions()[0].numpy()

    def render(self) -> NDArray[np.uint8] | None:
        """A picture [height, width, 3] of the present state; None without a render mode."""
        images = self.vector.render()
        return None if images is None else images[0]

    def close(self) -> None:
        """Free the window of pictures."""
        self.vector.close()


def _first(info: dict[str, Any]) -> dict[str, Any]:
    """The information of the only environment: plain numbers."""
    return {name: info[name][0].item() for name in ("success", "failed", "blocked", "elapsed")}
