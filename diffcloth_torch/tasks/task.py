"""Tasks of configurations: a scene with prescribed motion, and actions that may be optimized."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from diffcloth_torch.config.scenes import (
    build_scene,
    build_simulator,
    prescribed_motions,
    steady_wind,
    step_control,
)
from diffcloth_torch.config.schema import OptimizerSection, RunConfig
from diffcloth_torch.memory import check_memory
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.controls import Control
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.simulator import Simulator
from diffcloth_torch.viewers.look import Goal

__all__ = ["Actions", "ConfiguredTask", "Controller", "LoadedConfig", "OptimizableTask"]

Actions = dict[str, Tensor]
Controller = Callable[[int, State], Control]
"""Function of the index of a step and the state before the step; returns the control."""


class ConfiguredTask:
    """A scene whose bodies and pins follow keyframes. Nothing is optimized.

    Attributes:
        config: The configuration.
        scene: Cloths, bodies and robots.
        simulator: Simulator of the scene.
        steps: Number of time steps.
    """

    Config: type[RunConfig] = RunConfig

    def __init__(self, config: RunConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        self.config = config
        self.scene: Scene = build_scene(config, source)
        self.simulator: Simulator = build_simulator(self.scene, config.simulation)
        each = self.simulator.initial_state().nbytes
        name = f"{source}: `simulation.steps`"
        self.steps = check_memory(name, config.simulation.steps, each, "a state")
        self._motions = prescribed_motions(config, self.scene, self.steps)
        self._wind = steady_wind(config)

    def initial_state(self) -> State:
        """Make the state before the first step."""
        return self.simulator.initial_state()

    def actions(self) -> Actions:
        """Make new leaf tensors of the initial actions; none if nothing is optimized."""
        return {}

    def controller(self, actions: Mapping[str, Tensor]) -> Controller:
        """Make a function that returns the control of a step under the given actions.

        The function returns the same control for the same arguments, because checkpointed rollouts
        repeat steps.
        """
        return lambda k, _state: step_control(self._motions, k, self._wind)

    def goals(self) -> Sequence[Goal]:
        """Shapes to show as targets of the task; may be none."""
        return []


class OptimizableTask(ConfiguredTask, ABC):
    """A task with a loss.

    Attributes:
        optimizer: Options of the optimization.
    """

    optimizer: OptimizerSection

    @abstractmethod
    def loss(self, states: Sequence[State]) -> Tensor:
        """Loss of the states after each step, shape [], or [B] of a batch."""


class LoadedConfig(NamedTuple):
    """The scene, simulator and task of a configuration.

    Attributes:
        scene: Cloths, bodies and robots.
        simulator: Simulator of the scene.
        task: Control and objective of the scene.
    """

    scene: Scene
    simulator: Simulator
    task: ConfiguredTask

    def __repr__(self) -> str:
        return (
            f"LoadedConfig({self.simulator!r}, task={self.task.config.task!r}, "
            f"{self.task.steps} steps)"
        )
