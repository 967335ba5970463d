"""Fold a sheet along a line, parallel to an edge or to a diagonal."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.actuators import Tools
from diffcloth_torch.envs.env import EnvState, graded, lengths
from diffcloth_torch.envs.sheets import SheetTask, arc, at, follow
from diffcloth_torch.sim.records.state import State

__all__ = ["FoldCloth", "FoldClothDiagonal"]

_DRIFT = 1.2  # weight of the drift of the kept part, as in SoftGym
_CLOSE = 0.1  # largest distance for success, over the side


class FoldCloth(SheetTask):
    """A part of a sheet is to lie on the rest of the sheet, which must not move.

    The start draws which of two opposite edges moves, and the line of the fold: a row of vertices
    such that between a fifth and a half of the sheet is moved. A sheet folds along its mesh edges,
    so a row of vertices suits all sizes. The distance is d = mean distance of the moved material
    from its goal + 1.2 times the mean drift of the kept material, both weighted by area, after
    ClothFold of SoftGym and fold_cloth of DaXBench; the reward is graded(d, side / 10, side / 2).
    """

    name = "FoldCloth"
    steps = 45
    closes: ClassVar[tuple[bool, bool]] = (True, True)  # pickers that a fold needs
    pace: ClassVar[int] = 3  # transitions for an eighth of the way

    def lines(self) -> list[int]:
        """Columns of vertices of possible folds: between half and four fifths of the sheet stay."""
        n = self.side
        return [c for c in range(n - 1) if 0.5 <= c / (n - 1) <= 0.8]

    def beyond(self, row: Tensor, column: Tensor, line: int) -> Tensor:
        """Signed distance of vertices beyond a line, in rows of vertices."""
        return column - line

    def mirror(self, row: Tensor, column: Tensor, line: int) -> tuple[Tensor, Tensor]:
        """Row and column onto which vertices beyond a line are folded."""
        return row, 2 * line - column

    def lift(self) -> float:
        """Height of the script's arc, in shares of its width."""
        return 0.45

    def corners(self) -> list[int]:
        """Vertices near which the pickers begin."""
        return [self.vertex(0, -1), self.vertex(-1, -1)]

    @cached_property
    def _tables(self) -> dict[str, Tensor]:
        """For both edges and all lines: partners of vertices, their areas, and picked vertices.

        A half turn maps the triangles of the sheet to themselves: vertex i becomes N - 1 - i.
        """
        n, count = self.side, self.side**2
        index = cpu.arange(count)
        row, column = index // n, index % n
        faces = cpu.as_tensor(self.simulator.scene.cloths[0].faces).long()
        partners, areas, landing = [], [], []
        for line in self.lines():
            beyond = self.beyond(row, column, line)
            there = self.mirror(row, column, line)
            partner = torch.where(beyond > 0, there[0] * n + there[1], index)
            moved, kept = (
                _shares(faces, (side >= 0)[faces].all(dim=-1), count) for side in (beyond, -beyond)
            )
            partners.append(torch.stack([partner, (count - 1 - partner).flip(0)]))
            areas.append(
                torch.stack([torch.stack([moved, kept]), torch.stack([moved, kept]).flip(1)])
            )
            landing.append(partner[self.corners()])
        picked = cpu.tensor(self.corners(), dtype=torch.int64)
        landing_at = torch.stack(landing)
        return {
            "partner": torch.stack(partners, dim=1),  # [2, L, N]
            "area": torch.stack(areas, dim=1),  # [2, L, 2, N]
            "picked": torch.stack([picked, count - 1 - picked]),  # [2, P]
            "landing": torch.stack([landing_at, count - 1 - landing_at]),  # [2, L, P]
        }

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Also the edge that moves, and the line of the fold."""
        return super().draw(generator) | {
            "edge": cpu.randint(2, (1,), generator=generator)[0],
            "line": cpu.randint(len(self.lines()), (1,), generator=generator)[0],
        }

    def picked(self, drawn: Mapping[str, Tensor]) -> Tensor:
        """See `SheetTask`."""
        return self._tables["picked"][drawn["edge"]]

    def started(self, state: State, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """Also the vertices that moved material is to lie on, and goals of picked vertices."""
        edge, line = drawn["edge"], drawn["line"]
        drawn["partner"] = self._tables["partner"][edge, line]
        drawn["area"] = self._tables["area"][edge, line]
        drawn["goal"] = at(state.positions, self._tables["landing"][edge, line])
        return super().started(state, drawn)

    def distance(self, env: EnvState) -> Tensor:
        """Distance of moved material from its goal + 1.2 drift of kept material [m], [B]."""
        x = env.state.positions
        away = torch.stack([x - at(x, env.drawn["partner"]), x - env.drawn["start"]], dim=1)
        apart, drift = (lengths(away) * env.drawn["area"]).sum(dim=-1).unbind(dim=1)
        return apart + _DRIFT * drift

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        side = self.sides(env.drawn)
        return graded(self.distance(env), _CLOSE * side, 0.5 * side)

    def success(self, env: EnvState) -> Tensor:
        """Return whether the distance is below a tenth of the side."""
        return self.distance(env) < _CLOSE * self.sides(env.drawn)

    def scripted(self, env: EnvState) -> Tensor:
        """Close on the corners, move them over in an arc, put them down, release."""
        low = cpu.tensor([0.0, 0.0, 0.016])
        here, there = at(env.drawn["start"], env.drawn["picked"]), env.drawn["goal"] + low
        carried = arc(here, there, self.lift(), 8)
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
    """A triangle of a sheet is to lie on the rest of the sheet.

    The start draws which of two opposite corners moves, and the line of the fold, parallel to the
    diagonal between the other corners. One picker carries the corner; the other begins in the
    middle of the moved triangle. Distance and reward are as in `FoldCloth`.
    """

    name = "FoldClothDiagonal"
    closes = (True, False)
    steps = 55
    pace = 4

    def lines(self) -> list[int]:
        """Columns at which the line begins: up to a third of the side away from the diagonal."""
        return [c for c in range(self.side - 2) if c / (self.side - 1) <= 0.34]

    def beyond(self, row: Tensor, column: Tensor, line: int) -> Tensor:
        """See `FoldCloth`."""
        return column - row - line

    def mirror(self, row: Tensor, column: Tensor, line: int) -> tuple[Tensor, Tensor]:
        """See `FoldCloth`."""
        return column - line, row + line

    def lift(self) -> float:
        """See `FoldCloth`; lower for fine sheets, which drag the kept part along if taut."""
        return 0.4 if self.side <= 16 else 0.3

    def corners(self) -> list[int]:
        """The corner, and a vertex halfway to the middle."""
        quarter = self.side // 4
        return [self.vertex(0, -1), self.vertex(quarter, -1 - quarter)]


def _shares(faces: Tensor, chosen: Tensor, count: int) -> Tensor:
    """Shares of vertices [N] in the area of chosen faces, which are of the same size."""
    corners = faces[chosen].flatten()
    return cpu.zeros(count).index_add(0, corners, cpu.ones(len(corners))) / len(corners)
