"""Grasp cloth: a robot grasps a cloth by friction and brings it into a target shape.

For each control interval, the actions are velocities of a kinematic base or a force and a torque on
a floating base, velocities of velocity joints, and efforts of torque and pd joints. The loss is the
L2 distance between the cloth and its target shape.

References:
    The task "control a gripper to grasp and lift the cloth" of the paper, section V.D.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import torch
from annotated_types import Len
from pydantic import model_validator
from torch import Tensor

from diffcloth_torch.config.scenes import Motions
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.mechanism import FORCED
from diffcloth_torch.tasks.reach import (
    ReachShape,
    RigidActionSection,
    ShapeConfig,
    check_rigid_actions,
    find_named,
    rigid_motion,
)

__all__ = ["GraspClothConfig", "GraspClothProblem"]

_JOINTS = {"velocities": ("velocity",), "efforts": FORCED}
"""Key of the actions -> accepted actuations of its joints."""

JointRows = dict[str, Annotated[list[float], Len(1)]]


class RobotActionSection(RigidActionSection):
    """The actions of the base of one robot, and of its joints by name.

    `velocities` [rad/s or m/s] apply to velocity joints, `efforts` [N m or N] to torque and pd
    joints.
    """

    robot: str
    velocities: JointRows | None = None
    efforts: JointRows | None = None


class GraspClothConfig(ShapeConfig):
    """A scene, the acting robot with its actions, the target shape, and the optimization."""

    actions: RobotActionSection

    @model_validator(mode="after")
    def _check_actor(self) -> GraspClothConfig:
        robot = find_named("actions.robot", self.actions.robot, self.scene.robots)
        if self.actions.rigid_rows():
            check_rigid_actions(self.actions, robot)
        elif not (self.actions.velocities or self.actions.efforts):
            raise ValueError("must have actions of the base or of joints in `actions`")
        for key in _JOINTS:
            counts = {len(rows) for rows in (getattr(self.actions, key) or {}).values()}
            if len(counts) > 1:
                raise ValueError(f"must have equally many rows for all joints in `actions.{key}`")
        return self


class GraspClothProblem(ReachShape):
    """A robot grasps a cloth and brings it into a target shape."""

    Config = GraspClothConfig

    def __init__(self, config: GraspClothConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        super().__init__(config, source)
        self._actions = config.actions
        self._robot = self.scene.robots[self.scene.robot_names.index(config.actions.robot)]
        self._check_joints()

    def _check_joints(self) -> None:
        mechanism = self._robot.mechanism
        modes = dict(zip(mechanism.joint_names, mechanism.actuation, strict=True))
        for key, accepted in _JOINTS.items():
            names = [name for name, mode in modes.items() if mode in accepted]
            for name in getattr(self._actions, key) or ():
                if name not in names:
                    raise InvalidInput(
                        f"`actions.{key}` may name joints that are actuated by "
                        f"{' or '.join(accepted)}: {', '.join(names) or 'none'}; got {name!r}"
                    )

    def initial_rows(self) -> dict[str, list[list[float]]]:
        """Actions of the base, then velocities and efforts with a column for each joint."""
        rows = self._actions.rigid_rows()
        for key in _JOINTS:
            columns = getattr(self._actions, key)
            if columns:
                rows[key] = [list(row) for row in zip(*columns.values(), strict=True)]
        return rows

    def motions(self, actions: Mapping[str, Tensor]) -> Motions:
        """Move or push the base, and drive the joints."""
        name = self._actions.robot
        motions: Motions = {}
        if self._actions.rigid_rows():
            start = torch.from_numpy(self._robot.pose.copy())
            motions = rigid_motion(actions, name, start, self.simulator.dt, "base")
        for key in _JOINTS:
            joints = enumerate(getattr(self._actions, key) or ())
            motions[f"joint_{key}"] = {
                f"{name}/{joint}": actions[key][:, column] for column, joint in joints
            }
        return motions
