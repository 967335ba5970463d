"""Control points: springs pull points of cloths along trajectories to targets, through contact.

Nothing is optimized: what is judged is whether the cloths get through without intersecting, and how
far from their targets the points end.

References:
    The experiments "self-intersection" and "cloth and rigid body" of the paper, section V.B.
"""

from __future__ import annotations

from pathlib import Path

import torch
from pydantic import model_validator
from torch import Tensor

from diffcloth_torch.config.schema import Positive, RunConfig
from diffcloth_torch.sim.state import State
from diffcloth_torch.tasks.drape import Drape
from diffcloth_torch.viewers.look import Goal, marker

__all__ = ["ControlPoints", "ControlPointsConfig"]


class ControlPointsConfig(RunConfig):
    """A scene with soft pins, the control points; targets are shown with a radius [m]."""

    marker_radius: Positive = 0.01

    @model_validator(mode="after")
    def _check_control_points(self) -> ControlPointsConfig:
        if not any(cloth.soft_pins for cloth in self.scene.cloths):
            raise ValueError("must have `soft_pins` in a cloth: the control points")
        return self


class ControlPoints(Drape):
    """A scene, bodies and pins that follow keyframes, and the targets of its soft pins."""

    Config = ControlPointsConfig

    def __init__(self, config: ControlPointsConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        super().__init__(config, source)
        self._radius = config.marker_radius
        groups = [
            (self.simulator.slices[name].start, pins)
            for name, cloth in zip(self.scene.cloth_names, self.scene.cloths, strict=True)
            for pins in cloth.soft_pins.values()
        ]
        self._points = [first + torch.tensor(pins) for first, pins in groups]
        self._targets = self._last_targets()

    def _last_targets(self) -> list[Tensor]:
        """Where the springs of each group pull to in the end, shape [q, 3] each."""
        targets = self.initial_state().soft_pin_targets
        parts = list(targets.split([len(points) for points in self._points]))
        moved = self._prescribed[-1].soft_pins or {}
        names = [
            f"{name}/{pins}"
            for name, cloth in zip(self.scene.cloth_names, self.scene.cloths, strict=True)
            for pins in cloth.soft_pins
        ]
        return [moved.get(name, part) for name, part in zip(names, parts, strict=True)]

    def distances(self, state: State) -> Tensor:
        """Distance of each group of control points to its last target, shape [groups], in meters.

        It is that of their means: a group is one point that is held by several vertices.
        """
        return torch.stack(
            [
                (state.positions[points].mean(dim=0) - target.mean(dim=0)).norm()
                for points, target in zip(self._points, self._targets, strict=True)
            ]
        )

    def goals(self) -> list[Goal]:
        """Mark the last target of each group."""
        return [marker(target.mean(dim=0).numpy(), self._radius) for target in self._targets]
