"""Hang a cloth over two pegs, and release it."""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.actuators import Tools
from diffcloth_torch.envs.depth_camera import DepthCamera
from diffcloth_torch.envs.env import EnvState, graded, lengths
from diffcloth_torch.envs.frames import vectors_in
from diffcloth_torch.envs.hands import LENGTH, HandTask, twist_to
from diffcloth_torch.envs.sheets import follow, uniform
from diffcloth_torch.geometry.rotation import quaternion_multiply
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.sim.records.state import State

__all__ = ["HangCloth"]

_PEGS = cpu.tensor([0.3, 0.0, 0.2])  # mean place between the pegs [m]
_ASIDE = 0.045  # distance of a peg from that place, along y [m]
_TIP = 0.075  # distance from the frame of the hand to the middle between its fingertips [m]
_FREE = 0.09  # distance of the nearest vertex from the frame of a hand that released the cloth [m]
_CLOSE = LENGTH / 4
_SECONDS = 0.2  # weight of the speed of the cloth as a distance [s]


def _peg(name: str, y: float) -> RigidBody:
    """A short capsule across the way of the hand, which passes between two pegs."""
    x, _, z = _PEGS.tolist()
    across = [0.5**0.5, 0.5**0.5, 0, 0]
    return RigidBody.capsule(
        0.01, 0.02, pose=[x, y, z, *across], friction=2.0, name=name, motion="kinematic"
    )


class HangCloth(HandTask):
    """A gripper hangs a cloth over two rubber pegs, and releases it.

    The start draws the place of the pegs: within 4.5 cm along x, and 3 cm along y and z. The reward
    is graded(d, side / 4, 2 sides). The distance d is the sum of the distance of the cloth's center
    from the middle between the pegs, up to side / 4 for a hand that holds the cloth, and .2 s times
    the speed of the cloth: a cloth that is released and stays there succeeds. After the hanging
    tasks of GarmentLab.
    """

    name = "HangCloth"
    view = DepthCamera([0.65, -0.6, 0.55], [0.19, 0.0, 0.2])
    of_cloth = (*HandTask.of_cloth, "to_goal")
    steps = 140
    obstacles = (_peg("left_peg", _ASIDE), _peg("right_peg", -_ASIDE))

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Also the place of the pegs."""
        spread = cpu.tensor([0.045, 0.03, 0.03])
        return super().draw(generator) | {"away": spread * uniform(generator, 3, -1.0, 1.0)}

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """Also the pegs, and the orientation of a hand that points down."""
        state, tools = super().place(drawn)
        poses = state.body_poses.clone()
        names = self.simulator.scene.body_names
        for peg in self.obstacles:
            poses[:, names.index(peg.name), :3] += drawn["away"]
        drawn["pegs"] = _PEGS + drawn["away"]
        drawn["goal"] = drawn["pegs"][:, None]
        quarter = cpu.tensor([0.5**0.5, 0.0, 0.5**0.5, 0.0])
        base = drawn["base"]
        drawn["down"] = quaternion_multiply(quarter.expand(len(base), -1), base[:, 3:])
        return state.replace(body_poses=poses), tools

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Also the remaining displacement of the cloth's center to the goal, in sides."""
        away = vectors_in(env.drawn, self._away(env)[:, None])[:, 0] / LENGTH
        return super().features(env) | {"to_goal": away}

    def amiss(self, env: EnvState) -> Tensor:
        """Distance of the cloth from its goal, with charges for holding and for motion [m]."""
        state = env.state
        hand = state.base_poses[:, :1, :3]
        nearest = lengths(state.positions - hand).amin(dim=-1)
        held = ((_FREE - nearest) / (_FREE - 0.5 * _TIP)).clamp(0, 1)
        speed = lengths(state.velocities).mean(dim=-1)
        return lengths(self._away(env)) + _CLOSE * held + _SECONDS * speed

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return graded(self.amiss(env), _CLOSE, 2 * LENGTH)

    def success(self, env: EnvState) -> Tensor:
        """Return whether the cloth hangs on the pegs, at rest, and nothing else holds it."""
        return self.amiss(env) < _CLOSE

    def scripted(self, env: EnvState) -> Tensor:
        """Close, lift and turn down, pass between the pegs, sink behind them, release, rise."""
        steps, tips = zip(*_PATH, strict=True)
        pegs = env.drawn["pegs"][:, None] + cpu.tensor([0.0, 0.0, _TIP])
        path = [pegs + cpu.tensor(tip) for tip in tips]
        grasps = [1.0 if step <= _RELEASE else _AJAR for step in steps]
        wanted, grasp = follow(env, steps, path, grasps)
        target = torch.cat([wanted[:, 0], env.drawn["down"]], dim=-1)
        base = env.state.base_poses[:, 0]
        rise = cpu.zeros(len(env), 6)
        rise[:, 2] = 0.02
        risen = (env.elapsed >= _RISEN)[:, None]
        moves = self.towards(
            env, torch.where(risen, 0.5 * twist_to(base, target), rise), _ALIGNED + 5
        )
        # The hand aligns with the cloth, to hold all cloths equally deep and in the middle between
        # the fingers.
        edge = env.drawn["start"][:, self._corners[::2]].mean(dim=1) + cpu.tensor(_GRIP)
        grip = torch.cat([edge - base[:, :3], cpu.zeros(len(env), 3)], dim=-1)
        aligns = (env.elapsed < _ALIGNED)[:, None]
        moves = torch.where(aligns, self.towards(env, grip, closing=0), moves)
        return torch.cat([moves[:, :6], torch.where(aligns, 0.0, grasp)], dim=-1)

    def _away(self, env: EnvState) -> Tensor:
        return env.drawn["goal"][:, 0] - env.state.positions.mean(dim=1)


# Transitions, and the wanted position of the hand's tip then, from the middle between the pegs [m].
# With the tip 2.8 cm beyond the pegs, the middle of the cloth lies on them.
_PATH = (
    (34, (-0.15, 0.0, 0.1)),
    (48, (-0.05, 0.0, 0.06)),
    (68, (0.018, 0.0, 0.04)),
    (76, (0.028, 0.0, 0.005)),
    (84, (0.028, 0.0, 0.005)),
    (90, (0.028, 0.0, 0.005)),
    (116, (0.028, 0.0, 0.12)),
)
_RELEASE = 84
_AJAR = 0.5  # effort that opens each finger by 1.7 cm; wider fingers would push the cloth
_RISEN = 16  # transitions after which the hand may turn, as it is above the table
_ALIGNED = 4  # transitions in which the hand moves to the place where it closes
_GRIP = (-0.058, 0.0, 0.0)  # position of the hand's base from the edge of the cloth [m]
