"""Hit cloth: a body strikes a hanging sheet and carries it into a horizontal target shape.

What acts is one body: a kinematic one by a linear and an angular velocity for each control
interval, from which its poses follow by integration, or a dynamic one by a force and a torque. The
loss is the L2 distance between the sheet and its target shape.

References:
    The task "control rigid body to hit the cloth" of the paper, section V.D.1.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from pydantic import model_validator
from torch import Tensor

from diffcloth_torch.config.scenes import Motions
from diffcloth_torch.sim.state import State
from diffcloth_torch.tasks.reach import (
    ActionSection,
    Reach,
    ReachConfig,
    Rows,
    ShapeSection,
    ShapeTarget,
    check_rigid_actions,
    find_named,
    rigid_motion,
)
from diffcloth_torch.viewers.look import Goal

__all__ = ["HitCloth", "HitClothConfig"]


class BodyActionSection(ActionSection):
    """The actions of one body.

    Either `linear` [m/s] and `angular` [rad/s] velocities of a kinematic body, or `force` [N] at
    the center of mass and `torque` [N m] on a dynamic one; all in world axes.
    """

    body: str
    linear: Rows | None = None
    angular: Rows | None = None
    force: Rows | None = None
    torque: Rows | None = None


class HitClothConfig(ReachConfig):
    """A scene, the body that acts in it, the target shape and how to get there."""

    actions: BodyActionSection
    target: ShapeSection

    @model_validator(mode="after")
    def _check_references(self) -> HitClothConfig:
        body = find_named("actions.body", self.actions.body, self.scene.bodies)
        check_rigid_actions(self.actions, body)
        find_named("target.cloth", self.target.cloth, self.scene.cloths)
        return self


class HitCloth(Reach):
    """A body strikes a cloth into a target shape."""

    Config = HitClothConfig

    def __init__(self, config: HitClothConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        super().__init__(config, source)
        self._actions = config.actions
        self._target = ShapeTarget(self, config.target)

    def initial_rows(self) -> dict[str, list[list[float]]]:
        """Velocities, or a force and a torque."""
        return self._actions.model_dump(
            include={"linear", "angular", "force", "torque"}, exclude_none=True
        )

    def motions(self, actions: Mapping[str, Tensor]) -> Motions:
        """Move the body, or push it."""
        name = self._actions.body
        body = self.scene.bodies[self.scene.body_names.index(name)]
        start = torch.from_numpy(body.pose.copy())
        return rigid_motion(actions, name, start, self.simulator.dt, "body")

    def distance(self, state: State, measure: str) -> Tensor:
        """L2 distance between the cloth and its target."""
        return self._target.distance(state, measure)

    def goals(self) -> list[Goal]:
        """Show the target shape."""
        return [self._target.goal]
