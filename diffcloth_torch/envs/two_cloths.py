"""Two hooked strips of cloth pull at each other; one is to reach a target."""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.actuators import Actuator, Forces, Tools
from diffcloth_torch.envs.built import BuiltTask, with_material
from diffcloth_torch.envs.depth_camera import DepthCamera
from diffcloth_torch.envs.env import EnvState, graded, lengths
from diffcloth_torch.envs.key_points import KeyPoints
from diffcloth_torch.envs.sheets import uniform
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.scenes import scene_of

__all__ = ["TwoCloths"]

_PULL, _LARGEST = 0.3, 0.8  # force on the ends of the other strip, and at an action of 1 [N]
_FAR = 1.0  # distance at which an episode ends [m]
_CLOSE = 0.02  # largest distance to the target for success, a twentieth of a strip [m]


class TwoCloths(BuiltTask):
    """Forces on the ends of a bent strip of cloth bring its center to a target.

    Another strip, which a constant force pulls in the opposite direction, is hooked into the first.
    `size` n makes strips of 5 vertices across and 2 n + 7 along. The start draws the target, within
    3 cm. With the distance d of the center from the target, the reward is graded(d, 2 cm, 20 cm);
    the task of the paper, section V.D.4. An episode ends if d is more than 1 m; then the smallest
    reward is charged for its transition and each remaining transition. The frame is the world.
    """

    name = "TwoCloths"
    steps = 60
    view = DepthCamera([-0.1, -0.8, 0.6], [-0.08, 0.0, 0.0])
    of_cloth = ("positions", "velocities", "to_target", "center_velocity")

    def build(self, material: Material | None) -> tuple[Scene, Actuator]:
        """See `BuiltTask`."""
        columns = 2 * self.side + 7
        names = ("blue", "red")
        changes = [f"scene.cloths.{name}.shape.columns={columns}" for name in names]
        scene, sections = scene_of("two_cloths", changes)
        cloths = [with_material(cloth, material) for cloth in scene.cloths]
        count = len(cloths[0].vertices)
        ends = [row * columns + end for row in range(count // columns) for end in (0, columns - 1)]
        shape = sections["scene"]["cloths"][0]["shape"]
        density = float(cpu.tensor(cloths[0].material.density).mean())
        weight = density * shape["length"] * shape["width"] * 9.81
        steady = cpu.zeros(2 * count, 3)
        steady[ends, 2] = weight / len(ends)
        pulled = [count + i for i in ends]
        steady[pulled] = cpu.tensor([_PULL, 0.0, weight]) / len(ends)
        self._count, self._center = count, cpu.tensor(sections["target"]["position"])
        return Scene(cloths), Forces([ends], steady, largest=_LARGEST)

    def key_points(self) -> KeyPoints:
        """Twenty vertices of both strips, the same as in 0.1; their places depend on the size."""
        count = 2 * self._count
        some = cpu.linspace(0, count - 1, 20).round().long()
        return KeyPoints.at(cpu.arange(count) if self.sees == "particles" else some)

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """The target, within 3 cm."""
        return {"target": self._center + uniform(generator, 3, -0.03, 0.03)}

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """See `Task`."""
        return self.simulator.initial_state(len(drawn["target"])), {}

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Vertices of both strips, and the remaining way of the center, or the target."""
        state = env.state
        return {
            "positions": self.seen.of(state.positions).flatten(1),
            "velocities": self.seen.of(state.velocities).flatten(1),
            "to_target": self._away(env),
            "center_velocity": state.velocities[:, : self._count].mean(dim=1),
            **({} if self.camera is None else {"goal": env.drawn["target"]}),
            "time": self.observed(env.elapsed),
        }

    def goals(self, env: EnvState) -> Tensor:
        """The target of the center."""
        return env.drawn["target"][:, None]

    def distance(self, env: EnvState) -> Tensor:
        """Distance of the center from the target [m], [B]."""
        return lengths(self._away(env))

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        distance = self.distance(env)
        left = (self.horizon - env.elapsed).clamp(min=0)
        reward = graded(distance, _CLOSE, 0.2)
        return torch.where(distance > _FAR, (self.worst * (1 + left)).to(reward), reward)

    def success(self, env: EnvState) -> Tensor:
        """Return whether the center is within 2 cm of the target."""
        return self.distance(env) < _CLOSE

    def terminal(self, env: EnvState) -> Tensor:
        """Also true if the center is more than 1 m from the target."""
        return super().terminal(env) | (self.distance(env) > _FAR)

    def scripted(self, env: EnvState) -> Tensor:
        """Balance the pull, and act as a damped spring to the target."""
        velocity = env.state.velocities[:, : self._count].mean(dim=1)
        bear = cpu.tensor([-_PULL, 0.0, 0.0])
        force = bear + 0.7 * self._away(env) - 0.12 * velocity
        return (force / _LARGEST).clamp(-1, 1)

    def _away(self, env: EnvState) -> Tensor:
        return env.drawn["target"] - env.state.positions[:, : self._count].mean(dim=1)
