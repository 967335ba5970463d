"""Drape: simulate the scene of any configuration, with the motion that it prescribes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from diffcloth_torch.config.scenes import (
    build_scene,
    build_simulator,
    prescribed_motions,
    steady_wind,
    step_control,
)
from diffcloth_torch.config.schema import RunConfig
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.optimization import Controller
from diffcloth_torch.viewers.look import Goal

__all__ = ["Drape"]


class Drape:
    """A scene, and bodies and pins that follow keyframes. Nothing is optimized."""

    Config: type[RunConfig] = RunConfig

    def __init__(self, config: RunConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        self.config = config
        self.scene = build_scene(config, source)
        self.simulator = build_simulator(self.scene, config.simulation)
        self.steps = config.simulation.steps
        self._motions = prescribed_motions(config, self.scene, self.steps)
        self._wind = steady_wind(config)

    def initial_state(self) -> State:
        """Make the state that the scene describes."""
        return self.simulator.initial_state()

    def actions(self) -> dict[str, Tensor]:
        """Have none."""
        return {}

    def controller(self, actions: Mapping[str, Tensor]) -> Controller:
        """Follow the keyframes, whatever the state."""
        return lambda k, _state: step_control(self._motions, k, self._wind)

    def goals(self) -> list[Goal]:
        """Have none."""
        return []
