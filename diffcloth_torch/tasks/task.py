"""What a task is: something that can be simulated, and perhaps optimized."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch.config.schema import RunConfig
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.controls import Control
from diffcloth_torch.sim.simulator import Simulator
from diffcloth_torch.sim.state import State
from diffcloth_torch.tasks.optimization import OptimizerSection

__all__ = ["Goal", "Optimizable", "Task"]


@dataclass(frozen=True, eq=False)
class Goal:
    """A shape to reach, for pictures.

    Attributes:
        vertices: Positions [m], shape [n, 3].
        faces: Vertex indices, shape [f, 3].
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]


class Task(Protocol):
    """A scene, and controls for its steps."""

    config: RunConfig
    scene: Scene
    simulator: Simulator

    def initial_state(self) -> State:
        """Make the state before the first step."""
        ...

    def actions(self) -> dict[str, Tensor]:
        """Make new leaf tensors of the initial actions; none where nothing is optimized."""
        ...

    def controls(self, actions: Mapping[str, Tensor]) -> Sequence[Control]:
        """Controls of all steps that follow from some actions."""
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
