"""Spread a sheet that lies in pleats, by pulling its edges apart or by a fling."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.actuators import Tools
from diffcloth_torch.envs.env import EnvState, failures, graded
from diffcloth_torch.envs.sheets import HEIGHT, SheetTask, at, follow, uniform
from diffcloth_torch.errors import SimulationError
from diffcloth_torch.sim.records.state import State

__all__ = ["FlingCloth", "SpreadCloth", "covered_area"]

_PLEATS = 1.5
_SETTLING = 15  # time steps before an episode begins
_CELL = 0.02  # cell size of the grid for areas [m]
_EXTENT = 0.6  # extent of the grid from the origin in each direction [m]
_WIDTH = 0.6  # kernel width around a vertex, over the distance of vertices or cells, if larger
_FILL = 0.54  # chosen such that cells within a flat sheet count .97
_CLOSED = 9  # transitions of the script of FlingCloth until its pickers are closed
_BARE = 0.06  # largest missing share of the area of a flat sheet for success


def covered_area(positions: Tensor, spacing: Tensor) -> Tensor:
    """Area covered by vertices as seen from above, smooth in their positions [m^2].

    Each cell of a grid counts 1 - exp(-c sum_i k(distance to vertex i)), with a Gaussian k.

    Args:
        positions: Positions of the vertices [m], shape [B, N, 3].
        spacing: Distance of neighbors in the flat sheet [m], shape [B].
    """
    centers = cpu.arange(-_EXTENT, _EXTENT, _CELL, dtype=torch.float64)
    width = _WIDTH * spacing.clamp(min=_CELL)
    x, y = (
        torch.exp(
            -0.5 * ((centers[:, None] - positions[:, None, :, axis]) / width[:, None, None]) ** 2
        )
        for axis in (0, 1)
    )
    # Sums instead of a matrix product, whose rounding would depend on the size of the batch.
    near = torch.stack([(row[:, None] * y).sum(dim=-1) for row in x.unbind(dim=1)], dim=1)
    fill = (_FILL * (spacing / width) ** 2)[:, None, None]
    return _CELL**2 * (1 - torch.exp(-fill * near)).sum(dim=(-1, -2))


class SpreadCloth(SheetTask):
    """A sheet that lies in pleats is to be spread flat.

    The start draws the pleats, across x or across y of the sheet, and pickers begin up to 4 cm
    beside the edges along the pleats. With the covered area A and the area Amax of the flat sheet,
    the reward is graded(1 - A / Amax, .06, .5); after ClothFlatten of SoftGym and unfold of
    DaXBench.
    """

    name = "SpreadCloth"
    steps = 45
    directions: ClassVar[int] = 2  # 1: pleats lie across x; 2: across x or across y
    steepness: ClassVar[tuple[float, float]] = (1.2, 1.5)  # overhangs would bury the edges [rad]
    beside: ClassVar[float] = 0.04
    above: ClassVar[tuple[float, float]] = (0.02, 0.05)

    def area(self, positions: Tensor, drawn: Mapping[str, Tensor]) -> Tensor:
        """Area covered by sheets [m^2], [B]; see `covered_area`."""
        return covered_area(positions, self.sides(drawn) / (self.side - 1))

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Also the steepness of the pleats, their phase, and their direction."""
        pleats = {
            "steepness": uniform(generator, 1, *self.steepness)[0],
            "phase": uniform(generator, 1, 0.0, 2 * math.pi)[0],
            "across": cpu.zeros((), dtype=torch.int64),
        }
        if self.directions > 1:
            pleats["across"] = cpu.randint(self.directions, (1,), generator=generator)[0]
        return super().draw(generator) | pleats

    def shape(self, drawn: dict[str, Tensor]) -> Tensor:
        """Pleats with unchanged lengths: the slope is a sine of the arc length."""
        n = self.side
        s = cpu.linspace(0.0, 1.0, 16 * (n - 1) + 1)
        middle = 0.5 * (s[1:] + s[:-1])
        slope = drawn["steepness"][:, None] * torch.sin(
            2 * math.pi * _PLEATS * middle + drawn["phase"][:, None]
        )
        step = self.sides(drawn)[:, None] / len(middle)
        x = torch.nn.functional.pad((step * slope.cos()).cumsum(-1), (1, 0))[:, ::16]
        z = torch.nn.functional.pad((step * slope.sin()).cumsum(-1), (1, 0))[:, ::16]
        x = x - 0.5 * x[:, -1:]
        z = z - z.amin(dim=-1, keepdim=True) + HEIGHT
        flat = self.flat(drawn)
        across_x = torch.stack([x.repeat(1, n), flat[..., 1], z.repeat(1, n)], dim=-1)
        # Rows of vertices lie along x: the transposed sheet has its pleats across y.
        across_y = across_x.reshape(-1, n, n, 3).transpose(1, 2).reshape(-1, n * n, 3)
        across_y = across_y[..., [1, 0, 2]]
        return torch.where(drawn["across"][:, None, None] == 1, across_y, across_x)

    def started(self, state: State, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """The settled sheet; also the area of the flat sheet, and its corners."""
        parameters = self._randomization.parameters(drawn)
        for _ in range(_SETTLING):
            state = self.simulator.step(state, None, parameters)
            failed = failures(state)
            if bool(failed.any()):
                environments = failed.nonzero()[:, 0].tolist()
                raise SimulationError(
                    f"{self.name}: the sheet did not come to lie in environments {environments}",
                    environments=environments,
                )
        state = state.replace(velocities=torch.zeros_like(state.velocities))
        flat = self.posed(self.flat(drawn), drawn)
        drawn["largest_area"] = self.area(flat, drawn)
        drawn["goal"] = flat[:, self._corners]
        return super().started(state, drawn)

    def bare(self, env: EnvState) -> Tensor:
        """Share of the area of the flat sheet that is not covered [B]."""
        return 1 - self.area(env.state.positions, env.drawn) / env.drawn["largest_area"]

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return graded(self.bare(env), _BARE, 0.5)

    def success(self, env: EnvState) -> Tensor:
        """Return whether 94 % of the flat sheet's area are covered."""
        return self.bare(env) < _BARE

    def picked(self, drawn: Mapping[str, Tensor]) -> Tensor:
        """The middles of the edges along the pleats."""
        middle = self.side // 2
        across_x = [self.vertex(middle, 0), self.vertex(middle, -1)]
        across_y = [self.vertex(0, middle), self.vertex(-1, middle)]
        return cpu.tensor([across_x, across_y], dtype=torch.int64)[drawn["across"]]

    def along(self, env: EnvState) -> Tensor:
        """The direction across the pleats, [B, 1, 3]."""
        turn = env.drawn["turn"]
        turn = turn + 0.5 * math.pi * env.drawn["across"].to(turn.dtype)
        return torch.stack([turn.cos(), turn.sin(), torch.zeros_like(turn)], dim=-1)[:, None]

    def scripted(self, env: EnvState) -> Tensor:
        """Close on the edges, raise them, so that none stays turned under, pull, and release."""
        here = at(env.drawn["start"], env.drawn["picked"])
        side = self.sides(env.drawn)[:, None, None]
        along = side * self.along(env) * cpu.tensor([[-0.5], [0.5]])
        apart = here.mean(dim=1, keepdim=True) + along
        low, high = torch.full_like(here[..., 2:], 0.01), (side / 6).expand_as(here[..., 2:])
        raised = torch.cat([here[..., :2], high], dim=-1)
        above, laid = (torch.cat([apart[..., :2], z], dim=-1) for z in (high, low))
        up = cpu.tensor([0.0, 0.0, 0.03])
        return self.moves_to(
            env,
            *follow(
                env,
                [4, 6, 8, 22, 26, 30, 34],
                [here, here, raised, above, laid, laid, laid + up],
                [-1.0, 1.0, 1.0, 1.0, 1.0, 1.0, -1.0],
            ),
        )


class FlingCloth(SpreadCloth):
    """Two pickers lift a pleated sheet by one edge and spread it, by a fling or by laying it down.

    The start draws the pleats, and one of two opposite edges for the pickers. With the covered
    share A / Amax of the area, as in `SpreadCloth`, and the mean height h of the sheet above the
    table, the reward is graded(1 - A / Amax + h / side, .08, .5): the sheet must lie on the table.
    After the fling of RGBench.
    """

    name = "FlingCloth"
    steps = 86
    directions = 1
    steepness = (1.6, 1.9)
    _ALLOWED = 0.08

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Also the edge at which the pickers begin."""
        return super().draw(generator) | {"edge": cpu.randint(2, (1,), generator=generator)[0]}

    def amiss(self, env: EnvState) -> Tensor:
        """Share of the area that is not covered, and mean height in sides [B]."""
        height = env.state.positions[..., 2].mean(dim=-1) - HEIGHT
        return self.bare(env) + height.clamp(min=0) / self.sides(env.drawn)

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return graded(self.amiss(env), self._ALLOWED, 0.5)

    def success(self, env: EnvState) -> Tensor:
        """Return whether the missing share of area plus the mean height in sides is below .08."""
        return self.amiss(env) < self._ALLOWED

    def picked(self, drawn: Mapping[str, Tensor]) -> Tensor:
        """Two corners of an edge along the pleats."""
        vertices = cpu.tensor([self.vertex(0, -1), self.vertex(-1, -1)], dtype=torch.int64)
        return torch.stack([vertices, self.side**2 - 1 - vertices])[drawn["edge"]]

    def scripted(self, env: EnvState) -> Tensor:
        """Close on the corners, lift the sheet, lay it down along a line, and pull it."""
        here = at(env.drawn["start"], env.drawn["picked"])
        sign = (1 - 2 * env.drawn["edge"])[:, None, None]  # towards the held edge
        side = self.sides(env.drawn)[:, None, None]
        along = sign * side * self.along(env)
        foot = torch.cat([here[..., :2], torch.zeros_like(here[..., 2:])], dim=-1) - 0.9 * along
        up = side * cpu.tensor([0.0, 0.0, 1.0])
        # The parts that lie and that hang are together as long as the sheet.
        laid = [foot + k / 6 * along + (1.02 - k / 6) * up for k in range(7)]
        # Friction with the table pulls out an edge that is turned under.
        end = laid[-1] + 0.3 * along
        # The pleats give way: pickers follow the corners until they hold them.
        corners = at(env.state.positions, env.drawn["picked"])
        corners = torch.where((env.elapsed < _CLOSED)[:, None, None], corners, here)
        points = [corners, corners, *[foot + 1.15 * up] * 2, *laid, end, end, end + 0.1 * up]
        times = [7, _CLOSED, 27, 33, *(36 + 4 * k for k in range(7)), 66, 68, 71]
        grasps = [-1.0, *[1.0] * (len(times) - 2), -1.0]
        return self.moves_to(env, *follow(env, times, points, grasps))
