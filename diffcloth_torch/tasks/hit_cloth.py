"""Hit cloth: a cuboid strikes a hanging sheet and carries it into a horizontal target shape.

The cuboid moves on prescribed poses. Its actions are a linear and an angular velocity for each
control interval; poses follow by integration, and the loss is the L2 distance between the sheet
and its target shape.

References:
    The task "control rigid body to hit the cloth" of the paper, section V.D.1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Len
from pydantic import model_validator
from torch import Tensor

from diffcloth_torch.config.scenes import (
    build_scene,
    build_simulator,
    pose_array,
    prescribed_controls,
)
from diffcloth_torch.config.schema import PoseSection, RunConfig, Section, Vector3
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.poses import transform
from diffcloth_torch.geometry.rotation import integrate_poses
from diffcloth_torch.sim.state import State
from diffcloth_torch.tasks.optimization import Controller, OptimizerSection
from diffcloth_torch.viewers.look import Goal

__all__ = ["HitCloth", "HitClothConfig", "shape_distance"]


class ActionSection(Section):
    """The actions of one body.

    Each row of `linear` [m/s] and `angular` [rad/s] velocities holds for `interval` steps; a
    single row holds for all intervals at the start and is optimized for each of them.
    """

    body: str
    interval: Annotated[int, Ge(1)] = 1
    linear: Annotated[list[Vector3], Len(1)]
    angular: Annotated[list[Vector3], Len(1)]


class TargetSection(Section):
    """The rest shape of a cloth at a pose."""

    cloth: str
    pose: PoseSection


class LossSection(Section):
    """The L2 distance between shapes, averaged over the last `steps` of the horizon.

    "distance" is the root mean square of the distances between vertices [m]; "squared" is its
    square [m^2].
    """

    measure: Literal["distance", "squared"] = "distance"
    steps: Annotated[int, Ge(1)] = 1


class HitClothConfig(RunConfig):
    """A scene, the body that acts in it, the target shape and how to get there."""

    actions: ActionSection
    target: TargetSection
    loss: LossSection = LossSection()
    optimizer: OptimizerSection

    @model_validator(mode="after")
    def _check_references(self) -> HitClothConfig:
        bodies = {body.name: body for body in self.scene.bodies}
        name = self.actions.body
        if name not in bodies:
            raise ValueError(f"names the body {name!r} in `actions.body`, which is none of them")
        if bodies[name].motion != "kinematic" or bodies[name].trajectory:
            raise ValueError(
                f"must give the body {name!r}, which acts, `motion: kinematic` and no `trajectory`"
            )
        if self.target.cloth not in [cloth.name for cloth in self.scene.cloths]:
            raise ValueError(f"names the cloth {self.target.cloth!r} in `target`, which is none")
        if self.loss.steps > self.simulation.steps:
            raise ValueError("has more steps in `loss.steps` than in `simulation.steps`")
        return self


class HitCloth:
    """A body strikes a cloth into a target shape."""

    Config = HitClothConfig

    def __init__(self, config: HitClothConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        self.config = config
        self.scene = build_scene(config, source)
        self.simulator = build_simulator(self.scene, config.simulation)
        self.steps = config.simulation.steps
        self.optimizer = config.optimizer
        self._name = config.actions.body
        cloth = self.scene.cloths[self.scene.cloth_names.index(config.target.cloth)]
        target = transform(cloth.rest_vertices, pose_array(config.target.pose))
        self._target = torch.from_numpy(target)
        self._goal = Goal(target, cloth.faces)
        self._prescribed = prescribed_controls(config, self.scene, self.steps)

    def initial_state(self) -> State:
        """Make the state that the scene describes."""
        return self.simulator.initial_state()

    def actions(self) -> dict[str, Tensor]:
        """Velocities of the initial actions, each of shape [T, 3] for T control intervals."""
        section = self.config.actions
        intervals = -(-self.steps // section.interval)
        return {
            name: _rows(name, getattr(section, name), intervals).requires_grad_()
            for name in ("linear", "angular")
        }

    def controller(self, actions: Mapping[str, Tensor]) -> Controller:
        """Integrate the actions to poses of the body; the rest of the scene follows keyframes."""
        twists = torch.cat([actions["linear"], actions["angular"]], dim=-1)
        body = self.scene.bodies[self.scene.body_names.index(self._name)]
        start = torch.from_numpy(body.pose.copy())
        poses = integrate_poses(
            start,
            twists.repeat_interleave(self.config.actions.interval, dim=0)[: self.steps],
            self.simulator.dt,
        )
        controls = []
        for control, pose in zip(self._prescribed, poses, strict=True):
            others: Any = control.body_poses or {}  # by name
            controls.append(control.replace(body_poses={**others, self._name: pose}))
        return lambda k, _state: controls[k]

    def loss(self, states: Sequence[State]) -> Tensor:
        """L2 distance between the cloth and its target, averaged over the last states."""
        section = self.config.loss
        rows = self.simulator.slices[self.config.target.cloth]
        distances = [
            shape_distance(state.positions[rows], self._target, section.measure)
            for state in states[-section.steps :]
        ]
        return torch.stack(distances).mean()

    def goals(self) -> list[Goal]:
        """Show the target shape."""
        return [self._goal]


def shape_distance(vertices: Tensor, target: Tensor, measure: str = "distance") -> Tensor:
    """L2 distance between two shapes over the square root of the number of vertices, or its square.

    Args:
        vertices: Positions [m], shape [n, 3].
        target: Positions [m], shape [n, 3].
        measure: "distance" [m] or "squared" [m^2].
    """
    mean_square = (vertices - target).square().sum(dim=-1).mean()
    return mean_square.sqrt() if measure == "distance" else mean_square


def _rows(name: str, rows: list[list[float]], count: int) -> Tensor:
    if len(rows) not in (1, count):
        raise InvalidInput(
            f"`actions.{name}` must have 1 row or one for each of the {count} control intervals, "
            f"got {len(rows)}"
        )
    return torch.tensor(rows, dtype=torch.float64).expand(count, 3).clone()
