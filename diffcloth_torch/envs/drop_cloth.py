"""Drop a hanging sheet so that it lies flat at a place."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.actuators import Tools
from diffcloth_torch.envs.env import EnvState, graded, lengths
from diffcloth_torch.envs.sheets import HEIGHT, SheetTask, at, follow, uniform
from diffcloth_torch.sim.records.state import State

__all__ = ["DropCloth"]

_CLOSE = 0.1  # largest mean distance to the flat sheet for success, over the side
_AWAY = 0.06  # largest offset of the goal from the place beside the lower edge, in each axis [m]


class DropCloth(SheetTask):
    """A sheet that two pickers hold by the corners is to lie flat at a goal beside its lower edge.

    The start draws the height of the sheet, and the goal. With the mean distance d of the vertices
    from their places in the flat sheet, the reward is graded(d, side / 10, side / 2); after
    ClothDrop of SoftGym.
    """

    name = "DropCloth"
    steps = 68

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Also the height of the lower edge, 1 to 6 cm, and the place of the goal, within 6 cm."""
        return super().draw(generator) | {
            "height": uniform(generator, 1, 0.01, 0.06)[0],
            "away": uniform(generator, 2, -_AWAY, _AWAY),
        }

    def shape(self, drawn: dict[str, Tensor]) -> Tensor:
        """Upright, with the rest shape's x as height."""
        x, y, _ = self.flat(drawn).unbind(dim=-1)
        height = x + 0.5 * self.sides(drawn)[:, None] + drawn["height"][:, None] + HEIGHT
        return torch.stack([torch.zeros_like(x), y, height], dim=-1)

    def started(self, state: State, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """Also the goals of all vertices, and of the corners among them."""
        x, y, z = self.flat(drawn).unbind(dim=-1)
        x = x + 0.5 * self.sides(drawn)[:, None]
        away = drawn["away"][:, None]
        flat = torch.stack([x + away[..., 0], y + away[..., 1], z], dim=-1)
        drawn["flat"] = self.posed(flat, drawn)
        drawn["goal"] = drawn["flat"][:, self._corners]
        return super().started(state, drawn)

    @property
    def first_action(self) -> tuple[float, ...]:
        """Pickers hold the corners."""
        return (0.0, 0.0, 0.0, 0.95) * self.pickers.count

    def tools(self, positions: Tensor, drawn: Mapping[str, Tensor]) -> Tools:
        """Pickers that hold the upper corners."""
        return self.pickers.start(at(positions, drawn["picked"]), drawn["picked"])

    def distance(self, env: EnvState) -> Tensor:
        """Mean distance from the flat sheet [m], [B]."""
        return lengths(env.state.positions - env.drawn["flat"]).mean(dim=-1)

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        side = self.sides(env.drawn)
        return graded(self.distance(env), _CLOSE * side, 0.5 * side)

    def success(self, env: EnvState) -> Tensor:
        """Return whether the mean distance is below .1 of the side."""
        return self.distance(env) < _CLOSE * self.sides(env.drawn)

    def scripted(self, env: EnvState) -> Tensor:
        """Move the lower edge over its place, lower it, lay the sheet down about it, release."""
        start, flat = env.drawn["start"], env.drawn["flat"]
        picked = env.drawn["picked"]
        edge = cpu.tensor([self.vertex(0, 0), self.vertex(-1, 0)], dtype=torch.int64)
        foot, out = flat[:, edge], at(flat, picked) - flat[:, edge]
        up = self.sides(env.drawn)[:, None, None] * cpu.tensor([0.0, 0.0, 1.0])
        begin = at(start, picked)
        high = torch.cat([foot[..., :2], begin[..., 2:]], dim=-1)
        # The parts that lie and that hang are together as long as the sheet.
        shares = [k / 6 for k in range(7)]
        laid = [foot + (share - 0.03 * (1 - share)) * out + (1.03 - share) * up for share in shares]
        middle = 0.5 * (begin + high)
        points = [begin, middle, middle, high, high, *laid, laid[-1], laid[-1] + 0.1 * up]
        # The second half of the way begins half a swing of the sheet after the first half, which
        # stops the swinging.
        times = [0, 4, 11, 15, 17, *(26 + 4 * k for k in range(7)), 52, 56]
        return self.moves_to(env, *follow(env, times, points, [*[1.0] * 13, -1.0]))
