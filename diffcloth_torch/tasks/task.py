"""What a task is: something that can be simulated, and perhaps optimized."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from torch import Tensor

from diffcloth_torch.config.schema import RunConfig
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.simulator import Simulator
from diffcloth_torch.sim.state import State
from diffcloth_torch.tasks.optimization import Controller, OptimizerSection
from diffcloth_torch.viewers.look import Goal

__all__ = ["Controller", "LoadedConfig", "Optimizable", "Task"]


class Task(Protocol):
    """A scene, and how it is controlled."""

    config: RunConfig
    scene: Scene
    simulator: Simulator
    steps: int

    def initial_state(self) -> State:
        """Make the state before the first step."""
        ...

    def actions(self) -> dict[str, Tensor]:
        """Make new leaf tensors of the initial actions; none where nothing is optimized."""
        ...

    def controller(self, actions: Mapping[str, Tensor]) -> Controller:
        """Make what controls each step by some actions.

        It takes the index of a step and the state before it, and may look at that state. Asked
        again for the same step, it gives the same: checkpointed rollouts repeat steps.
        """
        ...

    def goals(self) -> Sequence[Goal]:
        """Shapes that the task aims at; none where it has no aim."""
        ...


@runtime_checkable
class Optimizable(Task, Protocol):
    """A task with a loss."""

    @property
    def optimizer(self) -> OptimizerSection:
        """Options of the optimization."""
        ...

    def loss(self, states: Sequence[State]) -> Tensor:
        """Loss of the states after each step, shape []."""
        ...


class LoadedConfig(NamedTuple):
    """What a configuration describes.

    Attributes:
        scene: Cloths, bodies and robots.
        simulator: Steps the scene.
        task: How the scene is controlled, and what it aims at.
    """

    scene: Scene
    simulator: Simulator
    task: Task

    def __repr__(self) -> str:
        return (
            f"LoadedConfig({self.simulator!r}, task={self.task.config.task!r}, "
            f"{self.task.steps} steps)"
        )
