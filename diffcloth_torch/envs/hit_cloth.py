"""A cuboid swings a hanging sheet up, so that it lies on it."""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import check_count
from diffcloth_torch.envs.actuators import Tools, Twist
from diffcloth_torch.envs.env import EnvState, Task, lengths
from diffcloth_torch.envs.sheets import follow, uniform
from diffcloth_torch.geometry.poses import transform
from diffcloth_torch.model.options import SolverOptions
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.simulator import Simulator
from diffcloth_torch.tasks.scenes import grid_changes, pose_of, scene_of

__all__ = ["HitCloth"]

_DT = 0.02  # [s]
_CLOSE = 0.08  # mean distance to the target that succeeds [m]

# A path of the cuboid that succeeds: y, z [m] and angle [rad], every .1 s.
_PATH = (
    (0.053, 0.9, 0.22), (0.163, 0.924, 0.45), (0.265, 0.99, 0.67), (0.354, 1.08, 0.9),
    (0.425, 1.19, 1.12), (0.47, 1.3, 1.32), (0.491, 1.39, 1.46), (0.499, 1.44, 1.54),
    (0.501, 1.465, 1.57), (0.501, 1.475, 1.57),
)  # fmt: skip


class HitCloth(Task):
    """A kinematic cuboid hits a hanging sheet, so that it lies flat on it, behind its pins.

    The reward of each transition is -(mean distance of the vertices from the target) [m]; the task
    of the paper, section V.D.1.
    """

    name = "HitCloth"

    def __init__(self, *, size: int = 12, horizon: int = 30, substeps: int = 2) -> None:
        """Build the scene.

        Args:
            size: Vertices along a side of the sheet, >= 4.
            horizon: Transitions of an episode.
            substeps: Time steps of a transition, of .02 s each.
        """
        check_count(f"{operation(self.name)}: `size`", size, 4)
        scene, sections = scene_of("hit_cloth", grid_changes("sheet", size))
        simulator = Simulator(scene, _DT, solver=SolverOptions(throw=False))
        actuator = Twist("cuboid", 0, dt=_DT, speed=1.5, spin=4.0)
        super().__init__(simulator, actuator, horizon=horizon, substeps=substeps)
        some = cpu.linspace(0, size - 1, 4).round().long()
        self._rows = (some[:, None] * size + some).flatten()
        target = transform(scene.cloths[0].rest_positions, pose_of(sections["target"]["pose"]))
        self.target = cpu.tensor(target)
        self._speeds = actuator.speeds

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """How far the cuboid is from the sheet, up to 4 cm more."""
        return {"away": uniform(generator, 1, 0.0, 0.04)[0]}

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """See `Task`."""
        state = self.simulator.initial_state(len(drawn["away"]))
        poses = state.body_poses.clone()
        poses[:, 0, 1] -= drawn["away"]
        return state.replace(body_poses=poses), {}

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Some vertices of the sheet, what they still have to go, and the cuboid."""
        positions = env.state.positions[:, self._rows]
        return {
            "positions": positions.flatten(1),
            "velocities": env.state.velocities[:, self._rows].flatten(1),
            "to_target": (self.target[self._rows] - positions).flatten(1),
            "cuboid": env.state.body_poses[:, 0],
            "time": env.elapsed.double()[:, None] / self.horizon,
        }

    def distance(self, env: EnvState) -> Tensor:
        """Mean distance from the target [m], [B]."""
        away = env.state.positions - self.target
        return lengths(away).mean(dim=-1)

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return -self.distance(env)

    def success(self, env: EnvState) -> Tensor:
        """Whether the mean distance is below 8 cm."""
        return self.distance(env) < _CLOSE

    def scripted(self, env: EnvState) -> Tensor:
        """Swing the cuboid along a path made by hand."""
        duration = self.substeps * _DT
        path = cpu.tensor(_PATH).expand(len(env), -1, -1)
        times = [0.1 * (k + 1) / duration for k in range(len(_PATH))]
        wanted, _ = follow(env, times, path[:, :, None].unbind(dim=1), [0.0] * len(_PATH))
        pose = env.state.body_poses[:, 0]
        now = torch.stack([pose[:, 1], pose[:, 2], 2 * torch.atan2(pose[:, 4], pose[:, 3])], dim=-1)
        rates = (wanted[:, 0] - now) / duration
        zero = torch.zeros_like(rates[:, 0])
        twist = torch.stack([zero, rates[:, 0], rates[:, 1], rates[:, 2], zero, zero], dim=-1)
        return (twist / self._speeds).clamp(-1, 1)
