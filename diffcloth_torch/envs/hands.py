"""Tasks with a gripper that holds the edge of a cloth on a table."""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloth_torch import cpu, robots
from diffcloth_torch.checks import check_count
from diffcloth_torch.envs.actuators import Hand, Tools
from diffcloth_torch.envs.env import EnvState, Task, lengths
from diffcloth_torch.envs.sheets import uniform
from diffcloth_torch.geometry.rotation import (
    quaternion_log,
    quaternion_multiply,
    rotate,
)
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.options import SolverOptions
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.model.robot import Robot
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.simulator import Simulator

__all__ = ["GraspCloth", "HandTask", "LiftCloth", "twist_to"]

_DT = 0.02  # [s]
_SIDE, _TOP = 0.12, 0.105  # of the cloth, and at which it lies [m]
_JOINTS = ("gripper/left_finger_joint", "gripper/right_finger_joint")
_CLOSING = 5  # transitions in which a scripted hand closes


class HandTask(Task):
    """A cloth lies on a table and over its edge, between the fingers of a gripper.

    Actions are the linear and angular velocity of the gripper's base and the effort of its fingers.
    The start is drawn: where the gripper is, within 4 mm.
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
        material = Material(
            stretch=200, bending=1e-4, density=0.2, damping=0.01, thickness=8e-4, friction=0.8
        )
        cloth = Cloth.grid(
            size, size, _SIDE, name="cloth", pose=[0.02, 0, _TOP, 1, 0, 0, 0], material=material
        )
        table = RigidBody.box(
            [0.14, 0.2, 0.1], pose=[0.07, 0, 0.05, 1, 0, 0, 0], friction=0.3, name="table"
        )
        ground = RigidBody.plane(2.0, name="ground")
        gripper = Robot.load(
            robots.GRIPPER,
            base="kinematic",
            pose=[-0.096, 0, _TOP, 0.5, 0.5, 0.5, 0.5],
            actuation="pd",
            stiffness=400.0,
            damping=15.0,
            friction=0.8,
            name="gripper",
        )
        simulator = Simulator(
            Scene([cloth], [table, ground, *self.obstacles], [gripper]),
            _DT,
            solver=SolverOptions(throw=False),
        )
        hand = Hand("gripper", _JOINTS, dt=_DT)
        super().__init__(simulator, hand, horizon=horizon, substeps=substeps)
        self.hand = hand
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
        goal = cpu.tensor([-0.03, 0.0, _TOP + 0.09])
        return super().draw(generator) | {"goal": goal + uniform(generator, 3, -0.03, 0.03)}

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Also what the center of the cloth still has to go."""
        return super().features(env) | {"to_goal": self._away(env)}

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        height = env.state.positions[..., 2].mean(dim=-1) - _TOP
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
        quarter = cpu.tensor([0.5**0.5, 0.0, 0.5**0.5, 0.0])
        center = cpu.tensor([0.02, 0.0, _TOP])
        at = cpu.tensor([-0.03, 0.05, 0.25])
        drawn["target"] = rotate(quarter, state.positions - center) + at
        base = drawn["base"]
        drawn["target_base"] = torch.cat(
            [
                rotate(quarter, base[:, :3] - center) + at,
                quaternion_multiply(quarter.expand(len(base), -1), base[:, 3:]),
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
