"""Push cube: moving points of a cloth make it push a dynamic body to a target position.

For each control interval, the actions are velocities of pins of the cloth, which are integrated to
positions. The loss is the distance between the center of the body's frame and its target.

References:
    The task "control cloth to hit the rigid body" of the paper, section V.D.2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from annotated_types import Len
from pydantic import model_validator
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.config.scenes import Motions, PerStep
from diffcloth_torch.config.section import Section, Vector3
from diffcloth_torch.geometry.poses import transform
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.reach import (
    ActionSection,
    Reach,
    ReachConfig,
    Rows,
    find_named,
    measured,
)
from diffcloth_torch.viewers.look import Goal

__all__ = ["PushCubeConfig", "PushCubeProblem"]


class PinActionSection(ActionSection):
    """Velocities [m/s] of pins of a cloth, by their names; the pins of a name move together."""

    cloth: str
    pins: Annotated[dict[str, Rows], Len(1)]


class PositionSection(Section):
    """Target of the center of a body's frame [m]."""

    body: str
    position: Vector3


class PushCubeConfig(ReachConfig):
    """A scene, the acting pins, the pushed body, and its target."""

    actions: PinActionSection
    target: PositionSection

    @model_validator(mode="after")
    def _check_references(self) -> PushCubeConfig:
        cloth = find_named("actions.cloth", self.actions.cloth, self.scene.cloths)
        for name in self.actions.pins:
            if name not in cloth.pins or name in cloth.pin_trajectories:
                free = ", ".join(p for p in cloth.pins if p not in cloth.pin_trajectories)
                raise ValueError(
                    f"names {name!r} in `actions.pins`, which must be pins of {cloth.name!r} "
                    f"without a trajectory: {free or 'it has none'}"
                )
        body = find_named("target.body", self.target.body, self.scene.bodies)
        if body.motion != "dynamic":
            raise ValueError(f"must give the body {body.name!r} in `target` `motion: dynamic`")
        return self


@dataclass(frozen=True)
class _Moved:
    """Displaced positions [p, 3] of pins, made for one step at a time to save memory."""

    start: Tensor
    displacements: Tensor

    def __getitem__(self, k: int, /) -> Tensor:
        return self.start + self.displacements[k]


class PushCubeProblem(Reach):
    """A cloth pushes a body to a target position."""

    Config = PushCubeConfig

    def __init__(self, config: PushCubeConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        super().__init__(config, source)
        self._actions = config.actions
        self._body = self.scene.body_names.index(config.target.body)
        self._target = cpu.tensor(config.target.position)

    def initial_rows(self) -> dict[str, list[list[float]]]:
        """Velocities of each group of pins."""
        return dict(self._actions.pins)

    def motions(self, actions: Mapping[str, Tensor]) -> Motions:
        """Integrate velocities to positions of the pins."""
        cloth = self.scene.cloths[self.scene.cloth_names.index(self._actions.cloth)]
        targets: dict[str, PerStep] = {}
        for name, velocities in actions.items():
            start = torch.from_numpy(cloth.vertices[cloth.pins[name]])
            moved = self.simulator.dt * velocities.cumsum(dim=0)
            targets[f"{self._actions.cloth}/{name}"] = _Moved(start, moved)
        return {"pins": targets}

    def distance(self, state: State, measure: str) -> Tensor:
        """Distance between the body and its target."""
        away = state.body_poses[..., self._body, :3] - self._target
        return measured(away.square().sum(dim=-1), measure)

    def goals(self) -> list[Goal]:
        """Show the body at its target, with its initial orientation."""
        body = self.scene.bodies[self._body]
        pose = np.concatenate([self._target.numpy(), body.pose[3:]])
        return [Goal(transform(body.vertices, pose), np.asarray(body.faces))]
