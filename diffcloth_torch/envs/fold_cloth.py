"""Fold a sheet in half, along an edge or along a diagonal."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.env import EnvState, lengths
from diffcloth_torch.envs.sheets import SIDE, SheetTask, arc, follow

__all__ = ["FoldCloth", "FoldClothDiagonal"]

_DRIFT = 1.2  # weight of how far the kept half moves, as in SoftGym


class FoldCloth(SheetTask):
    """One half of a sheet is to lie on the other, which is to stay where it is.

    The reward of each transition is -(mean distance of paired vertices + 1.2 times the mean drift
    of the kept half) [m], after ClothFold of SoftGym and fold_cloth of DaXBench.
    """

    name = "FoldCloth"
    closes = (True, True)  # pickers that a fold needs
    lift = 0.45  # how high they carry it, in sides
    pace = 3  # transitions for an eighth of the way
    close = 0.1  # in sides: see success()

    @cached_property
    def _pairs(self) -> tuple[Tensor, Tensor]:
        return self.pairs()

    def pairs(self) -> tuple[Tensor, Tensor]:
        """Vertices that move, and the ones on which they are to lie."""
        rows = cpu.arange(self.side)[:, None]
        columns = cpu.arange(self.side // 2)
        kept = rows * self.side + columns
        moved = rows * self.side + self.side - 1 - columns
        return moved.flatten(), kept.flatten()

    def distances(self, env: EnvState) -> tuple[Tensor, Tensor]:
        """Mean distance of the pairs, and mean drift of the kept half [m], [B] each."""
        moved, kept = self._pairs
        x = env.state.positions
        drift = x[:, kept] - env.drawn["start"][:, kept]
        return _mean_length(x[:, moved] - x[:, kept]), _mean_length(drift)

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        apart, drift = self.distances(env)
        return -(apart + _DRIFT * drift)

    def success(self, env: EnvState) -> Tensor:
        """Whether the reward is above -`close` sides."""
        return self.reward(env) > -self.close * SIDE

    def ends(self) -> list[int]:
        """Vertices onto which the pickers carry those that they begin at."""
        return [self.vertex(0, 0), self.vertex(-1, 0)]

    def scripted(self, env: EnvState) -> Tensor:
        """Close on the corners, carry them over in an arc, put them down, let go."""
        start = env.drawn["start"]
        low = cpu.tensor([0.0, 0.0, 0.016])
        here, there = start[:, self.beginnings()], start[:, self.ends()] + low
        carried = arc(here, there, self.lift * SIDE, 8)
        end = 5 + 8 * self.pace
        times = [4, *(5 + self.pace * k for k in range(1, 9)), end + 2, end + 6]
        points = [here, *carried, there, there + 4 * low]
        wanted, grasp = follow(env, times, points, [-1.0, *[1.0] * 9, -1.0])
        closes = cpu.tensor(self.closes, dtype=torch.bool)
        return self.moves_to(
            env,
            torch.where(closes[:, None], wanted, env.tools["points"]),
            torch.where(closes, grasp, -1.0),
        )


class FoldClothDiagonal(FoldCloth):
    """One triangle of a sheet is to lie on the other, along a diagonal.

    One picker carries a corner to the opposite one; the other begins in the middle of the moved
    half. Reward as in `FoldCloth`.
    """

    name = "FoldClothDiagonal"
    closes = (True, False)
    lift = 0.7
    pace = 4
    close = 0.25  # corners beside the fold hang

    def pairs(self) -> tuple[Tensor, Tensor]:
        """Vertices that move, and the ones on which they are to lie."""
        n = self.side
        row, column = torch.meshgrid(cpu.arange(n), cpu.arange(n), indexing="ij")
        moves = row + column > n - 1
        moved = row[moves] * n + column[moves]
        kept = (n - 1 - column[moves]) * n + n - 1 - row[moves]
        return moved, kept

    def beginnings(self) -> list[int]:
        """Near the corner, and near a vertex half way to the middle."""
        return [self.vertex(-1, -1), self.vertex(3 * self.side // 4, 3 * self.side // 4)]

    def ends(self) -> list[int]:
        """The opposite corner, and the vertex that the other one should lie on."""
        n = self.side
        row = 3 * n // 4
        return [self.vertex(0, 0), self.vertex(n - 1 - row, n - 1 - row)]


def _mean_length(vectors: Tensor) -> Tensor:
    """Mean length [B] of vectors [B, n, 3]; those that are zero have no gradient."""
    return lengths(vectors).mean(dim=-1)
