"""Common parts of tasks that reach a target: rows of actions, and a distance."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import torch
from annotated_types import Ge, Len
from pydantic import model_validator
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.config.scene_schema import BodySection, ClothSection, RobotSection
from diffcloth_torch.config.scenes import (
    Motions,
    pose_array,
    step_control,
)
from diffcloth_torch.config.schema import OptimizerSection, RunConfig
from diffcloth_torch.config.section import Section, Vector3
from diffcloth_torch.config.shape_schema import PoseSection
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.poses import transform
from diffcloth_torch.geometry.rotation import integrate_poses
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.task import Controller, OptimizableTask
from diffcloth_torch.viewers.look import Goal

__all__ = [
    "ActionSection",
    "LossSection",
    "Reach",
    "ReachConfig",
    "ReachShape",
    "RigidActionSection",
    "Rows",
    "ShapeConfig",
    "ShapeSection",
    "check_rigid_actions",
    "find_named",
    "measured",
    "rigid_motion",
    "shape_distance",
]

Rows = Annotated[list[Vector3], Len(1)]
"""Vectors: one for each control interval, or one for all."""


class ActionSection(Section):
    """Actions in rows, each of which applies to `interval` steps.

    A single row is the initial value for all intervals; each interval is then optimized on its own.
    """

    interval: Annotated[int, Ge(1)] = 1


class LossSection(Section):
    """The distance to the target, averaged over the last `steps` of the horizon.

    "distance" is in meters; for a shape it is the root mean square of the distances between
    vertices. "squared" is its square [m^2].
    """

    measure: Literal["distance", "squared"] = "distance"
    steps: Annotated[int, Ge(1)] = 1


class ReachConfig(RunConfig):
    """A scene, a horizon, a loss and an optimizer; tasks add their actions and target."""

    actions: ActionSection
    loss: LossSection = LossSection()
    optimizer: OptimizerSection

    @model_validator(mode="after")
    def _check_steps(self) -> ReachConfig:
        if self.loss.steps > self.simulation.steps:
            raise ValueError("has more steps in `loss.steps` than in `simulation.steps`")
        return self


class Reach(OptimizableTask):
    """A task in which actions move a body or a cloth to a target.

    The start must make contact: without contact there is no gradient. Subclasses have a `Config`
    and define the actions, their motions, and the distance to the target.
    """

    def __init__(self, config: ReachConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        super().__init__(config, source)
        self.optimizer = config.optimizer
        self._loss = config.loss
        self._interval = config.actions.interval

    @abstractmethod
    def initial_rows(self) -> dict[str, list[list[float]]]:
        """Rows of each tensor of actions in the configuration."""

    @abstractmethod
    def motions(self, actions: Mapping[str, Tensor]) -> Motions:
        """Make the targets and forces of all steps from actions with a row for each step."""

    @abstractmethod
    def distance(self, state: State, measure: str) -> Tensor:
        """Distance to the target, or its square, shape [], or [B] of a batch."""

    @abstractmethod
    def goals(self) -> list[Goal]:
        """Show the target."""

    def actions(self) -> dict[str, Tensor]:
        """Initial actions, each of shape [T, n] for T control intervals."""
        intervals = -(-self.steps // self._interval)
        return {
            name: _tensor(name, rows, intervals).requires_grad_()
            for name, rows in self.initial_rows().items()
        }

    def controller(self, actions: Mapping[str, Tensor]) -> Controller:
        """Apply the actions; the rest of the scene follows keyframes."""
        acted = self.motions(self.each_step(actions))
        fields = [*self._motions, *(name for name in acted if name not in self._motions)]
        merged: Motions = {
            field: {**self._motions.get(field, {}), **acted.get(field, {})} for field in fields
        }
        return lambda k, _state: step_control(merged, k, self._wind)

    def each_step(self, actions: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Repeat the row of each control interval for its steps: shape [steps, n]."""
        return {
            name: rows.repeat_interleave(self._interval, dim=0)[: self.steps]
            for name, rows in actions.items()
        }

    def loss(self, states: Sequence[State]) -> Tensor:
        """Distance to the target, averaged over the last states; shape [], or [B] of a batch."""
        last = states[-self._loss.steps :]
        return torch.stack([self.distance(state, self._loss.measure) for state in last]).mean(dim=0)


def _tensor(name: str, rows: list[list[float]], count: int) -> Tensor:
    if len(rows) not in (1, count):
        raise InvalidInput(
            f"`actions.{name}` must have 1 row or one for each of the {count} control intervals, "
            f"got {len(rows)}"
        )
    return cpu.tensor(rows).expand(count, -1).clone()


# --- rigid motion -------------------------------------------------------------------------------


class RigidActionSection(ActionSection):
    """Actions on a rigid body, or on the base of a robot.

    Either `linear` [m/s] and `angular` [rad/s] velocities of a kinematic body or base, or `force`
    [N] at the center of mass (of the root link) and `torque` [N m] on a dynamic body or floating
    base; all in world axes.
    """

    linear: Rows | None = None
    angular: Rows | None = None
    force: Rows | None = None
    torque: Rows | None = None

    def rigid_rows(self) -> dict[str, list[list[float]]]:
        """The fields among the four that are set."""
        rows: dict[str, list[list[float]]] = self.model_dump(include=set(_RIGID), exclude_none=True)
        return rows


_RIGID = ("linear", "angular", "force", "torque")


def rigid_motion(
    actions: Mapping[str, Tensor], name: str, start: Tensor, dt: float, kind: str
) -> Motions:
    """Move a rigid body or the base of a robot by velocities, or push it by forces.

    Args:
        actions: Either `linear` [m/s] and `angular` [rad/s] velocities, or `force` [N] at the
            center of mass and `torque` [N m], in world axes, shape [steps, 3].
        name: Name of the body or robot.
        start: Pose of the body or base at the start, shape [7].
        dt: Time step [s].
        kind: "body" or "base".
    """
    if "force" in actions:
        wrenches = torch.cat([actions["force"], actions["torque"]], dim=-1)
        return {f"{kind}_wrenches": {name: wrenches}}
    twists = torch.cat([actions["linear"], actions["angular"]], dim=-1)
    return {f"{kind}_poses": {name: integrate_poses(start, twists, dt)}}


def check_rigid_actions(given: RigidActionSection, actor: BodySection | RobotSection) -> None:
    """Require velocities if kinematic without a trajectory, forces if dynamic or floating."""
    key, free = ("base", "floating") if isinstance(actor, RobotSection) else ("motion", "dynamic")
    names = [name for name in _RIGID if getattr(given, name)]
    if names not in (["linear", "angular"], ["force", "torque"]):
        raise ValueError(
            "must have in `actions` either `linear` and `angular` or `force` and `torque`, got "
            f"{', '.join(names) or 'none'}"
        )
    needed = "kinematic" if names[0] == "linear" else free
    if getattr(actor, key) != needed or actor.trajectory:
        raise ValueError(
            f"must give {actor.name!r}, which acts by `{names[0]}` and `{names[1]}`, "
            f"`{key}: {needed}` and no `trajectory`"
        )


Named = TypeVar("Named", ClothSection, BodySection, RobotSection)


def find_named(key: str, name: str, sections: Sequence[Named]) -> Named:
    """Find the section of the scene with the name in a key."""
    for section in sections:
        if section.name == name:
            return section
    names = ", ".join(repr(section.name) for section in sections)
    raise ValueError(f"names {name!r} in `{key}`, which must be one of {names or 'none'}")


# --- targets ------------------------------------------------------------------------------------


class ShapeSection(Section):
    """The rest shape of a cloth at a pose."""

    cloth: str
    pose: PoseSection


class ShapeConfig(ReachConfig):
    """A scene, and the target shape of a cloth."""

    target: ShapeSection

    @model_validator(mode="after")
    def _check_target(self) -> ShapeConfig:
        find_named("target.cloth", self.target.cloth, self.scene.cloths)
        return self


class ReachShape(Reach):
    """A task in which actions bring a cloth into a target shape."""

    def __init__(self, config: ShapeConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        super().__init__(config, source)
        section = config.target
        cloth = self.scene.cloths[self.scene.cloth_names.index(section.cloth)]
        if cloth.has_seams:
            raise InvalidInput(
                f"target.cloth must have a rest mesh without seams, which has one shape in space; "
                f"{section.cloth!r} has seams"
            )
        target = transform(cloth.rest_embedding, pose_array(section.pose))
        self._rows = self.simulator.slices[section.cloth]
        self._target = torch.from_numpy(target)
        self._goal = Goal(target, cloth.faces)

    def distance(self, state: State, measure: str) -> Tensor:
        """L2 distance between the cloth and its target; see `shape_distance`."""
        return shape_distance(state.positions[..., self._rows, :], self._target, measure)

    def goals(self) -> list[Goal]:
        """Show the target shape."""
        return [self._goal]


def measured(mean_square: Tensor, measure: str) -> Tensor:
    """Return a mean square [m^2], or for the measure "distance" its root [m]."""
    return mean_square.sqrt() if measure == "distance" else mean_square


def shape_distance(vertices: Tensor, target: Tensor, measure: str = "distance") -> Tensor:
    """Root mean square of the distances between the vertices of two shapes, or its square.

    Args:
        vertices: Positions [m], shape [.., n, 3].
        target: Positions [m], shape [n, 3].
        measure: "distance" [m] or "squared" [m^2].
    """
    return measured((vertices - target).square().sum(dim=-1).mean(dim=-1), measure)
