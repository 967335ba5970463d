"""A cuboid swings a hanging sheet up, until the sheet lies on the cuboid."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.actuators import Actuator, Tools, Twist
from diffcloth_torch.envs.built import DT, BuiltTask, with_material
from diffcloth_torch.envs.depth_camera import DepthCamera
from diffcloth_torch.envs.env import EnvState, graded, lengths
from diffcloth_torch.envs.sheets import follow, uniform
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.scenes import grid_changes, pose_of, scene_of

__all__ = ["HitCloth"]

_LENGTH = 1.0  # length of a side of the sheet [m]
_CLOSE = 0.08 * _LENGTH  # largest mean distance to the target for success [m]
_TARGETS = (30.0, 90.0)  # angles of the target from the hanging sheet [degrees]
_UNDER = 0.025  # distance of the target's plane from the center of a cuboid that supports it [m]

# A path of the cuboid that swings the sheet up to 90 degrees, every .1 s: y and z of its center [m]
# and its angle [rad]. `_path` uses the offset from the center that supports a sheet at that angle.
_PATH = (
    (0.053, 0.9, 0.22), (0.163, 0.924, 0.45), (0.265, 0.99, 0.67), (0.354, 1.08, 0.9),
    (0.425, 1.19, 1.12), (0.47, 1.3, 1.32), (0.491, 1.39, 1.46), (0.499, 1.44, 1.54),
    (0.501, 1.465, 1.57), (0.501, 1.475, 1.57),
)  # fmt: skip


class HitCloth(BuiltTask):
    """A kinematic cuboid hits a hanging sheet, which is to lie flat on it, behind its pins.

    The start draws the distance of the cuboid, and the target angle of the sheet about its pins, 30
    to 90 degrees. With the mean distance d of the vertices from the target, the reward is
    graded(d, .08 sides, .5 sides); the task of the paper, section V.D.1. The frame is the world.
    """

    name = "HitCloth"
    steps = 36
    view = DepthCamera([2.0, 2.0, 2.0], [0.0, 0.4, 1.1])
    of_cloth = (*BuiltTask.of_cloth, "to_target")

    def build(self, material: Material | None) -> tuple[Scene, Actuator]:
        """See `BuiltTask`."""
        scene, sections = scene_of("hit_cloth", grid_changes("sheet", self.side))
        sheet = with_material(scene.cloths[0], material)
        self._pins = float(pose_of(sections["target"]["pose"])[2])  # their height [m]
        rest = cpu.tensor(sheet.rest_positions)
        self._across, self._down = rest[:, 0], _LENGTH / 2 - rest[:, 1]
        self.actuator = Twist("cuboid", 0, dt=DT, speed=1.5, spin=4.0)
        self._speeds = self.actuator.speeds
        return Scene([sheet], scene.bodies), self.actuator

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """The additional distance of the cuboid, up to 4 cm, and the angle of the target."""
        low, high = (math.radians(degrees) for degrees in _TARGETS)
        return {
            "away": uniform(generator, 1, 0.0, 0.04)[0],
            "angle": uniform(generator, 1, low, high)[0],
        }

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """See `Task`."""
        state = self.simulator.initial_state(len(drawn["away"]))
        poses = state.body_poses.clone()
        poses[:, 0, 1] -= drawn["away"]
        angle = drawn["angle"][:, None]
        drawn["target"] = torch.stack(
            [
                self._across.expand(len(angle), -1),
                self._down * angle.sin(),
                self._pins - self._down * angle.cos(),
            ],
            dim=-1,
        )
        return state.replace(body_poses=poses), {}

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Points of the sheet, their way to the target, the cuboid, and the angle."""
        positions = self.seen.of(env.state.positions)
        return {
            "positions": positions.flatten(1),
            "velocities": self.seen.of(env.state.velocities).flatten(1),
            "to_target": (self.seen.of(env.drawn["target"]) - positions).flatten(1),
            "cuboid": env.state.body_poses[:, 0],
            "goal": env.drawn["angle"][:, None],
            "time": self.observed(env.elapsed),
        }

    def goals(self, env: EnvState) -> Tensor:
        """The vertices of the target."""
        return env.drawn["target"]

    def distance(self, env: EnvState) -> Tensor:
        """Mean distance from the target [m], [B]."""
        return lengths(env.state.positions - env.drawn["target"]).mean(dim=-1)

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return graded(self.distance(env), _CLOSE, 0.5 * _LENGTH)

    def success(self, env: EnvState) -> Tensor:
        """Return whether the mean distance is below .08 sides."""
        return self.distance(env) < _CLOSE

    def scripted(self, env: EnvState) -> Tensor:
        """Swing the cuboid along a hand-made path, up to the angle of the target."""
        duration = self.substeps * DT
        path = self._path(env.drawn["angle"])
        times = [0.1 * (k + 1) / duration for k in range(len(_PATH))]
        wanted, _ = follow(env, times, path[:, :, None].unbind(dim=1), [0.0] * len(_PATH))
        pose = env.state.body_poses[:, 0]
        now = torch.stack([pose[:, 1], pose[:, 2], 2 * torch.atan2(pose[:, 4], pose[:, 3])], dim=-1)
        rates = (wanted[:, 0] - now) / duration
        zero = torch.zeros_like(rates[:, 0])
        twist = torch.stack([zero, rates[:, 0], rates[:, 1], rates[:, 2], zero, zero], dim=-1)
        return (twist / self._speeds).clamp(-1, 1)

    def _path(self, angle: Tensor) -> Tensor:
        """Coordinates y and z, and angles [B, K, 3] of a path to an angle [B]."""
        path = cpu.tensor(_PATH)
        behind = path[:, :2] - self._bearing(path[:, 2])
        angles = path[:, 2] * (angle / path[-1, 2])[:, None]
        return torch.cat([self._bearing(angles) + behind, angles[..., None]], dim=-1)

    def _bearing(self, angle: Tensor) -> Tensor:
        """Center (y, z) [..., 2] of a cuboid that supports the middle of a sheet."""
        sine, cosine = angle.sin(), angle.cos()
        half = _LENGTH / 2
        return torch.stack(
            [half * sine - _UNDER * cosine, self._pins - half * cosine - _UNDER * sine], dim=-1
        )
