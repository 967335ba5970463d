"""Two cloths, hooked into each other, are pulled apart until one reaches its target.

A constant force pulls one cloth. The actions are forces on the other cloth, one for each control
interval. The loss is the distance between the center of a cloth, the mean of its vertices, and its
target.

References:
    The experiment "checking differentiation calculation" of the paper, section V.C.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from pydantic import model_validator
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.config.scene_schema import Selection
from diffcloth_torch.config.scenes import Motions, select_vertices
from diffcloth_torch.config.section import Positive, Section, Vector3
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.sim.records.controls import Control
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.reach import (
    ActionSection,
    Reach,
    ReachConfig,
    Rows,
    find_named,
    measured,
)
from diffcloth_torch.tasks.task import Controller
from diffcloth_torch.viewers.look import Goal, marker

__all__ = ["TwoClothsConfig", "TwoClothsProblem"]


class PullSection(Section):
    """A constant force [N], shared evenly by vertices of a cloth."""

    cloth: str
    at: Selection
    force: Vector3


class ForceActionSection(ActionSection):
    """Forces [N], each shared evenly by vertices of a cloth."""

    cloth: str
    at: Selection
    force: Rows


class CenterSection(Section):
    """Target of the center of a cloth [m], and the radius [m] with which it is shown."""

    cloth: str
    position: Vector3
    marker_radius: Positive = 0.01


class TwoClothsConfig(ReachConfig):
    """A scene, the forces in it, and the target of a cloth's center."""

    pull: PullSection
    actions: ForceActionSection
    target: CenterSection

    @model_validator(mode="after")
    def _check_references(self) -> TwoClothsConfig:
        for key in ("pull", "actions", "target"):
            find_named(f"{key}.cloth", getattr(self, key).cloth, self.scene.cloths)
        return self


class TwoClothsProblem(Reach):
    """Two cloths pull at each other until one is at a target."""

    Config = TwoClothsConfig

    def __init__(self, config: TwoClothsConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        super().__init__(config, source)
        self._force = config.actions.force
        self._acting = self._shares("actions", config.actions)
        pull = cpu.tensor(config.pull.force)
        self._constant = self._shares("pull", config.pull)[:, None] * pull
        self._rows = self.simulator.slices[config.target.cloth]
        self._target = cpu.tensor(config.target.position)
        self._radius = config.target.marker_radius

    def _shares(self, key: str, section: PullSection | ForceActionSection) -> Tensor:
        """Fraction of a force that acts on each vertex of the scene, shape [N]."""
        cloth = self.scene.cloths[self.scene.cloth_names.index(section.cloth)]
        chosen = select_vertices(f"{key}.at", section.at, cloth.vertices)
        if chosen.max() >= len(cloth.vertices):
            raise InvalidInput(
                f"`{key}.at.vertices` must be between 0 and {len(cloth.vertices) - 1}, vertices of "
                f"{section.cloth!r}, got {chosen.max()}"
            )
        shares = cpu.zeros(len(self.simulator.initial_state().positions))
        first = self.simulator.slices[section.cloth].start
        shares[first + torch.from_numpy(chosen)] = 1 / len(chosen)
        return shares

    def initial_rows(self) -> dict[str, list[list[float]]]:
        """Forces on the actuated cloth."""
        return {"force": self._force}

    def motions(self, actions: Mapping[str, Tensor]) -> Motions:
        """Return no prescribed motion."""
        return {}

    def controller(self, actions: Mapping[str, Tensor]) -> Controller:
        """Pull both cloths; the rest of the scene follows keyframes."""
        follow = super().controller(actions)
        acting = self.each_step(actions)["force"]

        def control(k: int, state: State) -> Control:
            forces = self._constant + self._acting[:, None] * acting[k]
            return follow(k, state).replace(forces=forces)

        return control

    def distance(self, state: State, measure: str) -> Tensor:
        """Distance between the center of the cloth and its target."""
        away = state.positions[..., self._rows, :].mean(dim=-2) - self._target
        return measured(away.square().sum(dim=-1), measure)

    def goals(self) -> list[Goal]:
        """Mark the target of the center."""
        return [marker(self._target.numpy(), self._radius)]
