"""The protocol of tasks, which can be simulated, and may be optimized."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from torch import Tensor

from diffcloth_torch.config.schema import RunConfig
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.simulator import Simulator
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
        """Make new leaf tensors of the initial actions; none if nothing is optimized."""
        ...

    def controller(self, actions: Mapping[str, Tensor]) -> Controller:
        """Make a function that returns the control of a step under the given actions.

        It takes the index of a step and the state before it. For the same arguments it returns the
        same control, because checkpointed rollouts repeat steps.
        """
        ...

    def goals(self) -> Sequence[Goal]:
        """Shapes to show as targets of the task; may be none."""
        ...


@runtime_checkable
class Optimizable(Task, Protocol):
    """A task with a loss."""

    @property
    def optimizer(self) -> OptimizerSection:
        """Options of the optimization."""
        ...

    def loss(self, states: Sequence[State]) -> Tensor:
        """Loss of the states after each step, shape [], or [B] of a batch."""
        ...


class LoadedConfig(NamedTuple):
    """The scene, simulator and task of a configuration.

    Attributes:
        scene: Cloths, bodies and robots.
        simulator: Steps the scene.
        task: Control and objective of the scene.
    """

    scene: Scene
    simulator: Simulator
    task: Task

    def __repr__(self) -> str:
        return (
            f"LoadedConfig({self.simulator!r}, task={self.task.config.task!r}, "
            f"{self.task.steps} steps)"
        )
