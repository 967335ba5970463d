"""Control points: springs pull points of cloths along trajectories to targets, through contact.

Nothing is optimized. The results are whether the cloths arrive without intersection, and the final
distances of the points to their targets.

References:
    The experiments "self-intersection" and "cloth and rigid body" of the paper, section V.B.
"""

from __future__ import annotations

from pathlib import Path

import torch
from pydantic import model_validator
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.config.schema import RunConfig
from diffcloth_torch.config.section import Positive
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.task import ConfiguredTask
from diffcloth_torch.viewers.look import Goal, marker

__all__ = ["ControlPoints", "ControlPointsConfig"]


class ControlPointsConfig(RunConfig):
    """A scene with soft pins; each group of soft pins is a control point.

    Targets are shown with the radius `marker_radius` [m].
    """

    marker_radius: Positive = 0.01

    @model_validator(mode="after")
    def _check_control_points(self) -> ControlPointsConfig:
        if not any(cloth.soft_pins for cloth in self.scene.cloths):
            raise ValueError("must have `soft_pins` in a cloth: the control points")
        return self


class ControlPoints(ConfiguredTask):
    """A scene, bodies and pins that follow keyframes, and the targets of its soft pins."""

    Config = ControlPointsConfig

    def __init__(self, config: ControlPointsConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        super().__init__(config, source)
        self._radius = config.marker_radius
        self._points: list[Tensor] = []
        self._targets: list[Tensor] = []
        for name, cloth in zip(self.scene.cloth_names, self.scene.cloths, strict=True):
            first = self.simulator.slices[name].start
            for pins, vertices in cloth.soft_pins.items():
                moved = self._motions["soft_pins"].get(f"{name}/{pins}")
                held = cpu.tensor(cloth.vertices[vertices])
                self._points.append(first + cpu.tensor(vertices, dtype=torch.int64))
                self._targets.append((held if moved is None else moved[-1]).mean(dim=0))

    def distances(self, state: State) -> Tensor:
        """Distance of each control point to its last target [m], shape [.., groups].

        A group of soft pins is one control point, whose position is the mean of its vertices.
        """
        points = torch.stack(
            [state.positions[..., rows, :].mean(dim=-2) for rows in self._points], dim=-2
        )
        distances: Tensor = (points - torch.stack(self._targets)).norm(dim=-1)
        return distances

    def goals(self) -> list[Goal]:
        """Mark the last target of each control point."""
        return [marker(target.numpy(), self._radius) for target in self._targets]
