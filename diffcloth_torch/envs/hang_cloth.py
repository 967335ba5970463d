"""Hang a cloth over two pegs, and let go."""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.actuators import Tools
from diffcloth_torch.envs.env import EnvState, lengths
from diffcloth_torch.envs.hands import HandTask, twist_to
from diffcloth_torch.envs.sheets import follow
from diffcloth_torch.geometry.rotation import quaternion_multiply
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.sim.records.state import State

__all__ = ["HangCloth"]

_PEG = cpu.tensor([0.3, 0.0, 0.2])  # between the pegs [m]
_TIP = 0.075  # from the frame of the hand to between its fingers [m]
_CLOSE = 0.06  # distance of a cloth that hangs [m]


def _peg(y: float) -> RigidBody:
    """A short capsule across the way of the hand, which passes between two of them."""
    x, _, z = _PEG.tolist()
    across = [0.5**0.5, 0.5**0.5, 0, 0]
    side = "left" if y > 0 else "right"
    return RigidBody.capsule(0.01, 0.02, pose=[x, y, z, *across], friction=2.0, name=f"{side}_peg")


class HangCloth(HandTask):
    """A gripper hangs a cloth over two pegs of rubber, and lets it go.

    The reward of each transition is -(distance of the cloth's center from between the pegs) [m];
    after the hanging tasks of GarmentLab. A cloth that is let go and stays there succeeds.
    """

    name = "HangCloth"
    obstacles = (_peg(0.045), _peg(-0.045))

    def __init__(self, *, size: int = 12, horizon: int = 115, substeps: int = 2) -> None:
        """Build the scene: see `HandTask`."""
        super().__init__(size=size, horizon=horizon, substeps=substeps)

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """Also the orientation of a hand that points down."""
        state, tools = super().place(drawn)
        quarter = cpu.tensor([0.5**0.5, 0.0, 0.5**0.5, 0.0])
        base = drawn["base"]
        drawn["down"] = quaternion_multiply(quarter.expand(len(base), -1), base[:, 3:])
        return state, tools

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Also what the center of the cloth still has to go."""
        return super().features(env) | {"to_pegs": self._away(env)}

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return -lengths(self._away(env))

    def success(self, env: EnvState) -> Tensor:
        """Whether the cloth hangs near the pegs, at rest, and nothing else holds it."""
        slow = env.state.velocities.square().sum(dim=-1).mean(dim=-1) < 0.05**2
        hand = env.state.base_poses[:, 0, :3]
        nearest = (env.state.positions - hand[:, None]).square().sum(dim=-1).amin(dim=-1)
        return (self.reward(env) > -_CLOSE) & slow & (nearest > _TIP**2)

    def scripted(self, env: EnvState) -> Tensor:
        """Close, lift and turn down, pass between the pegs, sink behind them, let go, rise."""
        steps, tips = zip(*_PATH, strict=True)
        pegs = _PEG + cpu.tensor([0.0, 0.0, _TIP])
        points = [(pegs + cpu.tensor(tip)) for tip in tips]
        path = [p.expand(len(env), 1, 3) for p in points]
        grasps = [1.0 if step <= _RELEASE else _AJAR for step in steps]
        wanted, grasp = follow(env, steps, path, grasps)
        target = torch.cat([wanted[:, 0], env.drawn["down"]], dim=-1)
        base = env.state.base_poses[:, 0]
        rise = cpu.zeros(len(env), 6)
        rise[:, 2] = 0.02
        risen = (env.elapsed >= _RISEN)[:, None]
        moves = self.towards(env, torch.where(risen, 0.5 * twist_to(base, target), rise))
        return torch.cat([moves[:, :6], grasp], dim=-1)

    def _away(self, env: EnvState) -> Tensor:
        return _PEG - env.state.positions.mean(dim=1)


# Transitions, and where the tip of the hand should then be from between the pegs [m]. With the tip
# 2.8 cm beyond them the middle of the cloth lies on the pegs.
_PATH = (
    (30, (-0.15, 0.0, 0.1)),
    (44, (-0.05, 0.0, 0.06)),
    (64, (0.018, 0.0, 0.04)),
    (72, (0.028, 0.0, 0.005)),
    (80, (0.028, 0.0, 0.005)),
    (86, (0.028, 0.0, 0.005)),
    (112, (0.028, 0.0, 0.12)),
)
_RELEASE = 80
_AJAR = 0.5  # effort with which fingers open by 1.7 cm each: further ones would push the cloth
_RISEN = 12  # transitions after which the hand may turn: it has left the table
