"""Spread a sheet that lies in pleats, by pulling its edges apart or by a fling."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.actuators import Tools
from diffcloth_torch.envs.env import EnvState, failures
from diffcloth_torch.envs.sheets import HEIGHT, SIDE, SheetTask, follow, uniform
from diffcloth_torch.errors import SimulationError
from diffcloth_torch.sim.records.state import State

__all__ = ["FlingCloth", "SpreadCloth", "covered_area"]

_PLEATS = 1.5
_SETTLING = 15  # time steps before an episode begins
_CELL = 0.02  # of the grid on which areas are counted [m]
_EXTENT = 0.6  # of the grid: it reaches so far from the origin, along both axes [m]
_WIDTH = 0.6  # of the kernel around a vertex, in distances of vertices
_FILL = 1.5  # so that cells within a flat sheet count .97
_JUDGED = 10  # transitions at the end of a fling
_SPREAD = 0.9  # share of the area of a flat sheet that succeeds


def covered_area(positions: Tensor, spacing: float) -> Tensor:
    """Area that vertices cover as seen from above, smooth in their positions [m^2].

    Each cell of a grid counts 1 - exp(-c sum_i k(distance to vertex i)), with a Gaussian k.

    Args:
        positions: Of the vertices [B, N, 3].
        spacing: Their distances in the flat sheet [m].
    """
    centers = cpu.arange(-_EXTENT, _EXTENT, _CELL, dtype=torch.float64)
    width = _WIDTH * spacing
    x, y = (
        torch.exp(-0.5 * ((centers[:, None] - positions[:, None, :, axis]) / width) ** 2)
        for axis in (0, 1)
    )
    # Sums, no matrix product: that would round by the size of the batch.
    near = torch.stack([(row[:, None] * y).sum(dim=-1) for row in x.unbind(dim=1)], dim=1)
    return _CELL**2 * (1 - torch.exp(-_FILL * near)).sum(dim=(-1, -2))


class SpreadCloth(SheetTask):
    """A sheet that lies in pleats is to be spread flat.

    The reward of each transition is (A - A0) / (Amax - A0) with the covered area A, that of the
    start A0, and that of the flat sheet Amax; after ClothFlatten of SoftGym and unfold of DaXBench.
    """

    name = "SpreadCloth"

    @property
    def spacing(self) -> float:
        """Distance of vertices along a side [m]."""
        return SIDE / (self.side - 1)

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Also how steep the pleats are, up to 1.7 to 2 rad, and where they begin."""
        pleats = {
            "steepness": uniform(generator, 1, 1.7, 2.0)[0],
            "phase": uniform(generator, 1, 0.0, 2 * math.pi)[0],
        }
        return super().draw(generator) | pleats

    def shape(self, drawn: dict[str, Tensor]) -> Tensor:
        """Pleats across x that keep all lengths: the slope is a sine of the arc length."""
        n = self.side
        s = cpu.linspace(0.0, 1.0, 16 * (n - 1) + 1)
        middle = 0.5 * (s[1:] + s[:-1])
        slope = drawn["steepness"][:, None] * torch.sin(
            2 * math.pi * _PLEATS * middle + drawn["phase"][:, None]
        )
        step = SIDE / len(middle)
        x = torch.nn.functional.pad((step * slope.cos()).cumsum(-1), (1, 0))[:, ::16]
        z = torch.nn.functional.pad((step * slope.sin()).cumsum(-1), (1, 0))[:, ::16]
        x = x - 0.5 * x[:, -1:]
        z = z - z.amin(dim=-1, keepdim=True) + HEIGHT
        flat = super().shape(drawn)
        return torch.stack([x.repeat(1, n), flat[..., 1], z.repeat(1, n)], dim=-1)

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """The sheet after it has come to lie; also the areas that rewards compare with."""
        state, _ = super().place(drawn)
        for _ in range(_SETTLING):
            state = self.simulator.step(state)
            failed = failures(state)
            if bool(failed.any()):
                environments = failed.nonzero()[:, 0].tolist()
                raise SimulationError(
                    f"{self.name}: the sheet did not come to lie in environments {environments}",
                    environments=environments,
                )
        state = state.replace(velocities=torch.zeros_like(state.velocities))
        drawn["start"] = state.positions
        flat = self.posed(SheetTask.shape(self, drawn), drawn)
        drawn["least_area"] = covered_area(state.positions, self.spacing)
        drawn["largest_area"] = covered_area(flat, self.spacing)
        return state, self.tools(state.positions, drawn)

    def spread(self, env: EnvState) -> Tensor:
        """Covered share of the area of the flat sheet [B]."""
        return covered_area(env.state.positions, self.spacing) / env.drawn["largest_area"]

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        least, largest = env.drawn["least_area"], env.drawn["largest_area"]
        return (self.spread(env) * largest - least) / (largest - least)

    def success(self, env: EnvState) -> Tensor:
        """Whether 90 % of the flat sheet's area are covered."""
        return self.spread(env) > _SPREAD

    def beginnings(self) -> list[int]:
        """The middles of the edges along the pleats."""
        return [self.vertex(self.side // 2, 0), self.vertex(self.side // 2, -1)]

    def along(self, env: EnvState) -> Tensor:
        """The direction across the pleats, [B, 1, 3]."""
        turn = env.drawn["turn"]
        return torch.stack([turn.cos(), turn.sin(), torch.zeros_like(turn)], dim=-1)[:, None]

    def scripted(self, env: EnvState) -> Tensor:
        """Close on the edges, pull them apart, let go."""
        here = env.drawn["start"][:, self.beginnings()]
        along = self.along(env) * cpu.tensor([[-0.5], [0.5]])
        apart = here.mean(dim=1, keepdim=True) + SIDE * along
        apart = torch.cat([apart[..., :2], torch.full_like(apart[..., 2:], 0.01)], dim=-1)
        up = cpu.tensor([0.0, 0.0, 0.03])
        return self.moves_to(
            env,
            *follow(
                env,
                [4, 6, 26, 30, 34],
                [here, here, apart, apart, apart + up],
                [-1.0, 1.0, 1.0, 1.0, -1.0],
            ),
        )


class FlingCloth(SpreadCloth):
    """Two pickers lift a pleated sheet by one edge and spread it, by a fling or by laying it down.

    The reward is that of `SpreadCloth` in the last ten transitions, and zero before: what counts is
    the covered area after the fling, as in RGBench.
    """

    name = "FlingCloth"

    def __init__(self, *, horizon: int = 70, **options: object) -> None:
        """Build the scene: see `SheetTask`."""
        super().__init__(horizon=horizon, **options)  # type: ignore[arg-type]

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return super().reward(env) * (env.elapsed > self.horizon - _JUDGED)

    def beginnings(self) -> list[int]:
        """Two corners of an edge along the pleats."""
        return [self.vertex(0, -1), self.vertex(-1, -1)]

    def scripted(self, env: EnvState) -> Tensor:
        """Close on the corners, lift the sheet until it hangs, and lay it down along a line."""
        here = env.drawn["start"][:, self.beginnings()]
        along = SIDE * self.along(env)
        foot = torch.cat([here[..., :2], torch.zeros_like(here[..., 2:])], dim=-1) - 0.9 * along
        up = cpu.tensor([0.0, 0.0, SIDE])
        # What has been laid down and what still hangs are together as long as the sheet.
        laid = [foot + k / 6 * along + (1.02 - k / 6) * up for k in range(7)]
        points = [here, here, *[foot + 1.15 * up] * 2, *laid, laid[-1], laid[-1] + 0.1 * up]
        times = [4, 6, 24, 32, *(35 + 4 * k for k in range(7)), 61, 64]
        grasps = [-1.0, *[1.0] * (len(times) - 2), -1.0]
        return self.moves_to(env, *follow(env, times, points, grasps))
