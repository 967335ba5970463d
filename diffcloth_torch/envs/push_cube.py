"""A hanging sheet pushes a cube to a target."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.actuators import Actuator, Tools, Velocities
from diffcloth_torch.envs.built import DT, BuiltTask, with_material
from diffcloth_torch.envs.depth_camera import DepthCamera
from diffcloth_torch.envs.env import EnvState, graded, lengths
from diffcloth_torch.envs.frames import Frame, level_frame, points_in, poses_in, vectors_in
from diffcloth_torch.envs.sheets import uniform
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.scenes import grid_changes, scene_of, sections_of

__all__ = ["PushCube"]

_GAP = 0.004  # smallest gap below the cube [m]
_SPEED = 0.4  # speed of the pins [m/s]
_BRAKING = 0.15  # time in which a scripted cube comes to rest [s]
_CLOSE = 0.03  # largest distance to the target for success, a tenth of the sheet [m]


class PushCube(BuiltTask):
    """The two upper corners of a hanging sheet move, and the sheet pushes a cube to a target.

    The start draws the place of the cube, within 2 cm, and its target, within 7 cm along both axes.
    With the distance d of the cube's center from the target the reward is
    graded(d, side / 10, side / 2); the task of the paper, section V.D.2. The frame of the task is
    the cube at the start, with x to its target.
    """

    name = "PushCube"
    steps = 60
    view = DepthCamera([0.7, 0.6, 0.6], [0.0, 0.08, 0.12])

    def build(self, material: Material | None) -> tuple[Scene, Actuator]:
        """See `BuiltTask`."""
        size = self.side
        section = sections_of("push_cube")["scene"]
        self._length, self._cube = (section[k][0]["shape"]["size"] for k in ("cloths", "bodies"))
        # The cube starts outside of the barrier, whose default distance is a tenth of an edge.
        gap = max(_GAP, 0.1 * self._length / (size - 1))
        scene, _ = scene_of(
            "push_cube",
            [
                *grid_changes("sheet", size),
                f"scene.bodies.cube.pose.position=[0, 0, {0.5 * self._cube + gap}]",
            ],
        )
        sheet = with_material(scene.cloths[0], material)
        pins = {f"sheet/{name}": list(rows) for name, rows in sheet.pins.items()}
        self._pins = [row for rows in pins.values() for row in rows]
        return Scene([sheet], scene.bodies), Velocities(pins, dt=DT, speed=_SPEED)

    @property
    def first_action(self) -> tuple[float, ...]:
        """The sheet moves towards the cube."""
        along = (0.35, 0.0, 0.0) if self.frame == "task" else (0.0, 0.35, 0.0)
        return along * (self.action_size // 3)

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """The place of the cube, within 2 cm, and its target, within 7 cm."""
        return {
            "cube": uniform(generator, 2, -0.02, 0.02),
            "target": cpu.tensor([0.0, 0.22]) + uniform(generator, 2, -0.07, 0.07),
        }

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """See `Task`."""
        state = self.simulator.initial_state(len(drawn["cube"]))
        poses = state.body_poses.clone()
        poses[:, 0, :2] += drawn["cube"]
        way = drawn["target"] - poses[:, 0, :2]
        drawn["way"] = way / lengths(way)[:, None]
        return state.replace(body_poses=poses), {}

    def frame_of(self, state: State, drawn: Mapping[str, Tensor]) -> Frame:
        """See `Task`."""
        return level_frame(state.body_poses[:, 0, :3], drawn["way"])

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Pins, points of the sheet, the cube and its remaining way to the target."""
        state, seen, drawn = env.state, self.seen, env.drawn
        away = torch.nn.functional.pad(self._away(env), (0, 1))[:, None]
        points = [state.positions[:, self._pins], seen.of(state.positions)]
        placed = points_in(drawn, torch.cat(points, dim=1))
        pins, positions = torch.split(placed, [len(self._pins), len(seen)], dim=1)
        twist = state.body_velocities[:, 0].reshape(-1, 2, 3)
        vectors = vectors_in(drawn, torch.cat([seen.of(state.velocities), twist, away], dim=1))
        velocities, twist, away = torch.split(vectors, [len(seen), 2, 1], dim=1)
        return {
            "pins": pins.flatten(1),
            "positions": positions.flatten(1),
            "velocities": velocities.flatten(1),
            "cube": poses_in(drawn, state.body_poses[:, 0]),
            "cube_twist": twist.flatten(1),
            "to_target": away[:, 0, :2],
            "time": self.observed(env.elapsed),
        }

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return graded(self.distance(env), _CLOSE, 0.5 * self._length)

    def success(self, env: EnvState) -> Tensor:
        """Return whether the cube is within 3 cm of the target."""
        return self.distance(env) < _CLOSE

    def goals(self, env: EnvState) -> Tensor:
        """The target of the center of the cube, at its present height."""
        height = env.state.body_poses[:, 0, 2:3]
        return torch.cat([env.drawn["target"], height], dim=1)[:, None]

    def distance(self, env: EnvState) -> Tensor:
        """Distance of the cube from the target [m], [B]."""
        return lengths(self._away(env))

    def scripted(self, env: EnvState) -> Tensor:
        """Push the cube with the sheet across the way to the target, and move back early enough."""
        away, way = self._away(env), env.drawn["way"]
        cube, velocity = env.state.body_poses[:, 0, :2], env.state.body_velocities[:, 0, :2]
        distance = lengths(away)[:, None]
        to_target = away / distance.clamp(min=1e-3)
        ahead = away - _BRAKING * velocity
        pushes = ((ahead * way).sum(dim=-1, keepdim=True) > 0) & (distance > 0.3 * _CLOSE)
        to_target = torch.where(pushes, to_target, way)  # a target that is passed lies behind
        middle = cube + torch.where(pushes, 0.04, -self._cube) * to_target
        across = 0.5 * self._length * torch.stack([to_target[:, 1], -to_target[:, 0]], dim=-1)
        goals = torch.stack([middle - across, middle + across], dim=1)
        pins = env.state.positions[:, self._pins, :2]
        moves = torch.nn.functional.pad(goals - pins, (0, 1)) / (self.substeps * DT * _SPEED)
        return vectors_in(env.drawn, moves).clamp(-0.5, 0.5).flatten(1)

    def _away(self, env: EnvState) -> Tensor:
        return env.drawn["target"] - env.state.body_poses[:, 0, :2]
