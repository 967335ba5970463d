"""Tasks with a gripper that holds the edge of a cloth on a table."""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import check_count
from diffcloth_torch.envs.actuators import Hand, Tools
from diffcloth_torch.envs.env import EnvState, Task, lengths
from diffcloth_torch.envs.sheets import uniform
from diffcloth_torch.geometry.rotation import (
    quaternion_log,
    quaternion_multiply,
    rotate,
)
from diffcloth_torch.model.options import SolverOptions
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.simulator import Simulator
from diffcloth_torch.tasks.scenes import grid_changes, pose_of, scene_of

__all__ = ["GraspCloth", "HandTask", "LiftCloth", "twist_to"]

_DT = 0.02  # [s]
_JOINTS = ("gripper/left_finger_joint", "gripper/right_finger_joint")
_CLOSING = 5  # transitions in which a scripted hand closes


class HandTask(Task):
    """A cloth lies on a table and over its edge, between the fingers of a gripper.

    Actions are the linear and angular velocity of the gripper's base and the effort of its fingers.
    The start is drawn: where the gripper is, within 4 mm.

    Attributes:
        center: Position of the cloth's center at the start [m], [3].
        target: Pose of the target of the task grasp_cloth, [7].
    """

    obstacles: tuple[RigidBody, ...] = ()

    def __init__(self, *, size: int = 12, horizon: int = 40, substeps: int = 2) -> None:
        """Build the scene.

        Args:
            size: Vertices along a side of the cloth, >= 4.
            horizon: Transitions of an episode.
            substeps: Time steps of a transition, of .02 s each.
        """
        check_count(f"{operation(self.name)}: `size`", size, 4)
        scene, sections = scene_of("grasp_cloth", grid_changes("cloth", size))
        simulator = Simulator(
            Scene(scene.cloths, [*scene.bodies, *self.obstacles], scene.robots),
            _DT,
            solver=SolverOptions(throw=False),
        )
        hand = Hand("gripper", _JOINTS, dt=_DT)
        super().__init__(simulator, hand, horizon=horizon, substeps=substeps)
        self.hand = hand
        self.center = cpu.tensor(sections["scene"]["cloths"][0]["pose"]["position"])  # of the cloth
        self.target = cpu.tensor(pose_of(sections["target"]["pose"]))
        some = cpu.linspace(0, size - 1, 4).round().long()
        self._rows = (some[:, None] * size + some).flatten()

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Where the gripper is, within 4 mm."""
        return {"shift": uniform(generator, 3, -0.004, 0.004)}

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """See `Task`."""
        state = self.simulator.initial_state(len(drawn["shift"]))
        poses = state.base_poses.clone()
        poses[:, 0, :3] += drawn["shift"]
        drawn["start"], drawn["base"] = state.positions, poses[:, 0]
        return state.replace(base_poses=poses), {}

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Some vertices of the cloth, the hand and its joints."""
        state = env.state
        return {
            "positions": state.positions[:, self._rows].flatten(1),
            "velocities": state.velocities[:, self._rows].flatten(1),
            "contact_forces": state.contact_forces[:, self._rows].flatten(1),
            "base": state.base_poses[:, 0],
            "joint_positions": state.joint_positions,
            "joint_velocities": state.joint_velocities,
            "time": env.elapsed.double()[:, None] / self.horizon,
        }

    def towards(self, env: EnvState, twist: Tensor) -> Tensor:
        """Actions that close the fingers, and then move by a twist [B, 6] as far as they go."""
        duration = self.substeps * _DT
        moves = twist / (duration * self.hand.speeds)
        moves = moves / moves.abs().amax(dim=-1, keepdim=True).clamp(min=1)
        moves = moves * (env.elapsed >= _CLOSING)[:, None]
        return torch.cat([moves, torch.ones_like(moves[:, :1])], dim=-1)


class LiftCloth(HandTask):
    """A gripper lifts a cloth to a goal.

    The reward of each transition is lifted (1 - tanh(d / s)) with the distance d of the cloth's
    center from the goal and s = .1 m; "lifted" goes smoothly from 0 to 1 where the center is 3 cm
    higher than at the start. After Lift-Cloth-Franka of Isaac Lab.
    """

    name = "LiftCloth"

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Also the goal, 6 to 12 cm above the table."""
        goal = cpu.tensor([-0.03, 0.0, float(self.center[2]) + 0.09])
        return super().draw(generator) | {"goal": goal + uniform(generator, 3, -0.03, 0.03)}

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Also what the center of the cloth still has to go."""
        return super().features(env) | {"to_goal": self._away(env)}

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        height = env.state.positions[..., 2].mean(dim=-1) - self.center[2]
        return torch.sigmoid((height - 0.03) / 0.005) * (1 - torch.tanh(self._distance(env) / 0.1))

    def success(self, env: EnvState) -> Tensor:
        """Whether the center of the cloth is within 2 cm of the goal."""
        return self._distance(env) < 0.02

    def scripted(self, env: EnvState) -> Tensor:
        """Close, then bring the center of the cloth to the goal."""
        twist = torch.cat([0.3 * self._away(env), cpu.zeros(len(env), 3)], dim=-1)
        return self.towards(env, twist)

    def _away(self, env: EnvState) -> Tensor:
        return env.drawn["goal"] - env.state.positions.mean(dim=1)

    def _distance(self, env: EnvState) -> Tensor:
        return lengths(self._away(env))


class GraspCloth(HandTask):
    """A gripper brings a cloth upright into a target shape.

    The reward of each transition is -(mean distance of the vertices from the target shape) [m]; the
    task of the paper, section V.D.3.
    """

    name = "GraspCloth"

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """Also the target: the cloth hanging from the edge that is held."""
        state, tools = super().place(drawn)
        at, turn = self.target[:3], self.target[3:]
        drawn["target"] = rotate(turn, state.positions - self.center) + at
        base = drawn["base"]
        drawn["target_base"] = torch.cat(
            [
                rotate(turn, base[:, :3] - self.center) + at,
                quaternion_multiply(turn.expand(len(base), -1), base[:, 3:]),
            ],
            dim=-1,
        )
        return state, tools

    def distance(self, env: EnvState) -> Tensor:
        """Mean distance from the target shape [m], [B]."""
        away = env.state.positions - env.drawn["target"]
        return lengths(away).mean(dim=-1)

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return -self.distance(env)

    def success(self, env: EnvState) -> Tensor:
        """Whether the mean distance is below 1.5 cm."""
        return self.distance(env) < 0.015

    def scripted(self, env: EnvState) -> Tensor:
        """Close, then move the hand as the cloth has to move."""
        base, target = env.state.base_poses[:, 0], env.drawn["target_base"]
        return self.towards(env, 0.15 * twist_to(base, target))


def twist_to(base: Tensor, target: Tensor) -> Tensor:
    """Translation and rotation vector [B, 6] from poses [B, 7] to others."""
    inverse = base[:, 3:] * cpu.tensor([1.0, -1.0, -1.0, -1.0])
    turn = quaternion_log(quaternion_multiply(target[:, 3:], inverse))
    return torch.cat([target[:, :3] - base[:, :3], turn], dim=-1)
