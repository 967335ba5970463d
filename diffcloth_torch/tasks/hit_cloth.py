"""Hit cloth: a body strikes a hanging sheet and carries it into a horizontal target shape.

For each control interval, the actions are a linear and an angular velocity of a kinematic body,
which are integrated to poses, or a force and a torque on a dynamic body. The loss is the L2
distance between the sheet and its target shape.

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
from diffcloth_torch.tasks.reach import (
    ReachShape,
    RigidActionSection,
    ShapeConfig,
    check_rigid_actions,
    find_named,
    rigid_motion,
)

__all__ = ["HitClothConfig", "HitClothProblem"]


class BodyActionSection(RigidActionSection):
    """The actions of one body."""

    body: str


class HitClothConfig(ShapeConfig):
    """A scene, the acting body with its actions, the target shape, and the optimization."""

    actions: BodyActionSection

    @model_validator(mode="after")
    def _check_actor(self) -> HitClothConfig:
        body = find_named("actions.body", self.actions.body, self.scene.bodies)
        check_rigid_actions(self.actions, body)
        return self


class HitClothProblem(ReachShape):
    """A body strikes a cloth into a target shape."""

    Config = HitClothConfig

    def __init__(self, config: HitClothConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        super().__init__(config, source)
        self._actions = config.actions

    def initial_rows(self) -> dict[str, list[list[float]]]:
        """Velocities of the body, or a force and a torque on it."""
        return self._actions.rigid_rows()

    def motions(self, actions: Mapping[str, Tensor]) -> Motions:
        """Move the body, or push it."""
        name = self._actions.body
        body = self.scene.bodies[self.scene.body_names.index(name)]
        start = torch.from_numpy(body.pose.copy())
        return rigid_motion(actions, name, start, self.simulator.dt, "body")
