"""Tasks with a gripper that holds the edge of a cloth on a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.actuators import Actuator, Hand, Tools
from diffcloth_torch.envs.built import DT, BuiltTask, with_material
from diffcloth_torch.envs.depth_camera import DepthCamera
from diffcloth_torch.envs.env import EnvState, graded, lengths
from diffcloth_torch.envs.frames import Frame, points_in, pose_frame, poses_in, vectors_in
from diffcloth_torch.envs.sheets import uniform
from diffcloth_torch.geometry.rotation import (
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
    rotate,
)
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.scenes import grid_changes, pose_of, scene_of

__all__ = ["LENGTH", "GraspCloth", "HandTask", "LiftCloth", "twist_to"]

LENGTH = 0.12  # length of a side of the cloth [m]
_JOINTS = ("gripper/left_finger_joint", "gripper/right_finger_joint")
_CLOSING = 5  # transitions in which a scripted hand closes


class HandTask(BuiltTask):
    """A cloth lies on a table and over its edge, between the fingers of a gripper.

    Actions are the linear and angular velocity of the gripper's base and the effort of its fingers.
    The start draws the position of the gripper, within 4 mm. The frame of the task is the pose of
    the base at the start.

    Attributes:
        center: Position of the cloth's center at the start [m], [3].
        target: Pose of the target of the task grasp_cloth, [7].
    """

    steps = 40
    view = DepthCamera([0.4, -0.4, 0.45], [0.0, 0.0, 0.19])
    obstacles: ClassVar[tuple[RigidBody, ...]] = ()

    def build(self, material: Material | None) -> tuple[Scene, Actuator]:
        """See `BuiltTask`."""
        scene, sections = scene_of("grasp_cloth", grid_changes("cloth", self.side))
        self.hand = Hand("gripper", _JOINTS, dt=DT)
        self.center = cpu.tensor(sections["scene"]["cloths"][0]["pose"]["position"])
        self.target = cpu.tensor(pose_of(sections["target"]["pose"]))
        corners = [0, self.side - 1, self.side * (self.side - 1), self.side**2 - 1]
        self._corners = cpu.tensor(corners, dtype=torch.int64)
        cloths = [with_material(cloth, material) for cloth in scene.cloths]
        return Scene(cloths, [*scene.bodies, *self.obstacles], scene.robots), self.hand

    @property
    def first_action(self) -> tuple[float, ...]:
        """Fingers close with an effort that holds the cloth, and the hand rises slowly."""
        rise = (0.0, 0.1, 0.0) if self.frame == "task" else (0.0, 0.0, 0.1)  # y of the base is up
        return (*rise, 0.0, 0.0, 0.0, 0.95)

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """The position of the gripper, within 4 mm."""
        return {"shift": uniform(generator, 3, -0.004, 0.004)}

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """See `Task`. A subclass adds "goal" [B, g, 3]: points where the cloth is to be."""
        state = self.simulator.initial_state(len(drawn["shift"]))
        poses = state.base_poses.clone()
        poses[:, 0, :3] += drawn["shift"]
        drawn["start"], drawn["base"] = state.positions, poses[:, 0]
        return state.replace(base_poses=poses), {}

    def frame_of(self, state: State, drawn: Mapping[str, Tensor]) -> Frame:
        """See `Task`."""
        return pose_frame(drawn["base"])

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Points of the cloth, the hand and its joints, the corners at the start, the goal.

        Lengths are in units of the side of the cloth.
        """
        state, seen, drawn = env.state, self.seen, env.drawn
        positions = seen.of(state.positions)
        start, goal = drawn["start"][:, self._corners], drawn["goal"]
        sizes = [len(seen), 4, goal.shape[1]]
        points = points_in(drawn, torch.cat([positions, start, goal], dim=1)) / LENGTH
        placed = [part.flatten(1) for part in torch.split(points, sizes, dim=1)]
        pairs = [seen.of(state.velocities), seen.of(state.contact_forces)]
        velocities, forces = vectors_in(drawn, torch.cat(pairs, dim=1)).chunk(2, dim=1)
        return {
            "positions": placed[0],
            "velocities": velocities.flatten(1),
            "contact_forces": forces.flatten(1),
            "base": poses_in(drawn, state.base_poses[:, 0]),
            "joint_positions": state.joint_positions,
            "joint_velocities": state.joint_velocities,
            "start": placed[1],
            "goal": placed[2],
            "time": self.observed(env.elapsed),
        }

    def towards(self, env: EnvState, twist: Tensor, closing: int = _CLOSING) -> Tensor:
        """Actions that close the fingers, then move by a twist [B, 6] within the limits."""
        duration = self.substeps * DT
        moves = (twist / (duration * self.hand.speeds)).reshape(-1, 2, 3)
        moves = vectors_in(env.drawn, moves).flatten(1)
        moves = moves / moves.abs().amax(dim=-1, keepdim=True).clamp(min=1)
        moves = moves * (env.elapsed >= closing)[:, None]
        return torch.cat([moves, torch.ones_like(moves[:, :1])], dim=-1)


class LiftCloth(HandTask):
    """A gripper lifts a cloth to a goal.

    The start draws the goal, 5 to 13 cm above the table, within 4 cm. With the distance d of the
    cloth's center from the goal the reward is graded(d, side / 6, side); after Lift-Cloth-Franka of
    Isaac Lab.
    """

    name = "LiftCloth"
    of_cloth = (*HandTask.of_cloth, "to_goal")
    _CLOSE = LENGTH / 6

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Also the goal."""
        goal = cpu.tensor([-0.03, 0.0, float(self.center[2]) + 0.09])
        return super().draw(generator) | {"goal": (goal + uniform(generator, 3, -0.04, 0.04))[None]}

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Also the remaining displacement of the cloth's center to the goal, in sides."""
        away = vectors_in(env.drawn, self._away(env)[:, None])[:, 0] / LENGTH
        return super().features(env) | {"to_goal": away}

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return graded(self.distance(env), self._CLOSE, LENGTH)

    def success(self, env: EnvState) -> Tensor:
        """Return whether the center of the cloth is within a sixth of its side of the goal."""
        return self.distance(env) < self._CLOSE

    def scripted(self, env: EnvState) -> Tensor:
        """Close, then bring the center of the cloth to the goal."""
        twist = torch.cat([0.3 * self._away(env), cpu.zeros(len(env), 3)], dim=-1)
        return self.towards(env, twist)

    def distance(self, env: EnvState) -> Tensor:
        """Distance of the cloth's center from the goal [m], [B]."""
        return lengths(self._away(env))

    def _away(self, env: EnvState) -> Tensor:
        return env.drawn["goal"][:, 0] - env.state.positions.mean(dim=1)


class GraspCloth(HandTask):
    """A gripper brings a cloth upright into a target shape.

    The start draws the target: the cloth hangs from the held edge, moved by up to 3 cm along each
    axis and rotated about the vertical by up to .3 rad. With the mean distance d of the vertices
    from the target, the reward is graded(d, side / 8, side); the task of the paper, section V.D.3.
    """

    name = "GraspCloth"
    steps = 50
    _CLOSE = LENGTH / 8

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Also the target."""
        return super().draw(generator) | {
            "away": uniform(generator, 3, -0.03, 0.03),
            "yaw": uniform(generator, 1, -0.3, 0.3)[0],
        }

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """Also the target, its corners, and the pose of a hand that holds the cloth there."""
        state, tools = super().place(drawn)
        zero = torch.zeros_like(drawn["yaw"])
        yaw = quaternion_exp(torch.stack([zero, zero, drawn["yaw"]], dim=-1))
        turn = quaternion_multiply(yaw, self.target[3:].expand(len(yaw), -1))
        place = self.target[:3] + drawn["away"]
        base = drawn["base"]
        drawn["target"] = rotate(turn[:, None], state.positions - self.center) + place[:, None]
        drawn["goal"] = drawn["target"][:, self._corners]
        drawn["target_base"] = torch.cat(
            [
                rotate(turn, base[:, :3] - self.center) + place,
                quaternion_multiply(turn, base[:, 3:]),
            ],
            dim=-1,
        )
        return state, tools

    def distance(self, env: EnvState) -> Tensor:
        """Mean distance from the target shape [m], [B]."""
        return lengths(env.state.positions - env.drawn["target"]).mean(dim=-1)

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return graded(self.distance(env), self._CLOSE, LENGTH)

    def success(self, env: EnvState) -> Tensor:
        """Return whether the mean distance is below an eighth of the side."""
        return self.distance(env) < self._CLOSE

    def scripted(self, env: EnvState) -> Tensor:
        """Close, then move the hand rigidly with the required motion of the cloth."""
        base, target = env.state.base_poses[:, 0], env.drawn["target_base"]
        return self.towards(env, 0.15 * twist_to(base, target))


def twist_to(base: Tensor, target: Tensor) -> Tensor:
    """Translation and rotation vector [B, 6] from base poses [B, 7] to target poses."""
    inverse = base[:, 3:] * cpu.tensor([1.0, -1.0, -1.0, -1.0])
    turn = quaternion_log(quaternion_multiply(target[:, 3:], inverse))
    return torch.cat([target[:, :3] - base[:, :3], turn], dim=-1)
