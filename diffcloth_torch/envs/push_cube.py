"""A hanging sheet pushes a cube to a target."""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import check_count
from diffcloth_torch.envs.actuators import Tools, Velocities
from diffcloth_torch.envs.env import EnvState, Task, lengths
from diffcloth_torch.envs.sheets import uniform
from diffcloth_torch.model.options import SolverOptions
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.simulator import Simulator
from diffcloth_torch.tasks.scenes import grid_changes, scene_of, sections_of

__all__ = ["PushCube"]

_GAP = 0.004  # below the cube, at least [m]
_DT, _SPEED = 0.02, 0.4  # [s], [m/s] of the pins
_BRAKING = 0.1  # time in which a scripted cube comes to rest [s]
_CLOSE = 0.03  # distance to the target that succeeds [m]


class PushCube(Task):
    """The two upper corners of a hanging sheet move, so that it pushes a cube to a target.

    The reward of each transition is -(distance of the cube's center from the target) [m]; the task
    of the paper, section V.D.2.
    """

    name = "PushCube"

    def __init__(self, *, size: int = 12, horizon: int = 50, substeps: int = 2) -> None:
        """Build the scene.

        Args:
            size: Vertices along a side of the sheet, >= 4.
            horizon: Transitions of an episode.
            substeps: Time steps of a transition, of .02 s each.
        """
        check_count(f"{operation(self.name)}: `size`", size, 4)
        section = sections_of("push_cube")["scene"]
        self._side, self._cube = (section[k][0]["shape"]["size"] for k in ("cloths", "bodies"))
        # Outside of the barrier, whose default is a tenth of an edge.
        gap = max(_GAP, 0.1 * self._side / (size - 1))
        scene, _ = scene_of(
            "push_cube",
            [
                *grid_changes("sheet", size),
                f"scene.bodies.cube.pose.position=[0, 0, {0.5 * self._cube + gap}]",
            ],
        )
        sheet = scene.cloths[0]
        simulator = Simulator(scene, _DT, solver=SolverOptions(throw=False))
        pins = {f"sheet/{name}": list(rows) for name, rows in sheet.pins.items()}
        actuator = Velocities(pins, dt=_DT, speed=_SPEED)
        super().__init__(simulator, actuator, horizon=horizon, substeps=substeps)
        self._pins = [row for rows in pins.values() for row in rows]
        self._rows = cpu.linspace(0, size * size - 1, 16).round().long()

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Where the cube stands, within 2 cm, and its target, within 5 cm."""
        return {
            "cube": uniform(generator, 2, -0.02, 0.02),
            "target": cpu.tensor([0.0, 0.22]) + uniform(generator, 2, -0.05, 0.05),
        }

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """See `Task`."""
        state = self.simulator.initial_state(len(drawn["cube"]))
        poses = state.body_poses.clone()
        poses[:, 0, :2] += drawn["cube"]
        return state.replace(body_poses=poses), {}

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Pins, some vertices of the sheet, the cube and what it still has to go."""
        state = env.state
        return {
            "pins": state.positions[:, self._pins].flatten(1),
            "positions": state.positions[:, self._rows].flatten(1),
            "velocities": state.velocities[:, self._rows].flatten(1),
            "cube": state.body_poses[:, 0],
            "cube_velocities": state.body_velocities[:, 0],
            "to_target": self._away(env),
            "time": env.elapsed.double()[:, None] / self.horizon,
        }

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return -lengths(self._away(env))

    def success(self, env: EnvState) -> Tensor:
        """Whether the cube is within 3 cm of the target."""
        return self.reward(env) > -_CLOSE

    def scripted(self, env: EnvState) -> Tensor:
        """Push the cube with the sheet across the way to the target, and step back in time."""
        away = self._away(env)
        cube, velocity = env.state.body_poses[:, 0, :2], env.state.body_velocities[:, 0, :2]
        distance = lengths(away)[:, None]
        to_target = away / distance.clamp(min=1e-3)
        ahead = away - _BRAKING * velocity
        pushes = ((ahead * away).sum(dim=-1, keepdim=True) > 0) & (distance > 0.3 * _CLOSE)
        middle = cube + torch.where(pushes, 0.04 * to_target, -self._cube * to_target)
        across = 0.5 * self._side * torch.stack([to_target[:, 1], -to_target[:, 0]], dim=-1)
        goals = torch.stack([middle - across, middle + across], dim=1)
        pins = env.state.positions[:, self._pins, :2]
        moves = ((goals - pins) / (self.substeps * _DT * _SPEED)).clamp(-0.5, 0.5)
        return torch.cat([moves, torch.zeros_like(moves[..., :1])], dim=-1).flatten(1)

    def _away(self, env: EnvState) -> Tensor:
        return env.drawn["target"] - env.state.body_poses[:, 0, :2]
