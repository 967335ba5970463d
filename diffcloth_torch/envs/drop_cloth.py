"""Drop a hanging sheet so that it lies flat."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.actuators import Tools
from diffcloth_torch.envs.env import EnvState, lengths
from diffcloth_torch.envs.sheets import HEIGHT, SIDE, SheetTask, follow, uniform

__all__ = ["DropCloth"]

_CLOSE = 0.1  # of the side: mean distance to flat that succeeds


class DropCloth(SheetTask):
    """A sheet that two pickers hold by the corners is to lie flat beside its lower edge.

    The reward of each transition is -(mean distance of the vertices from where they lie in the flat
    sheet) [m]; after ClothDrop of SoftGym.
    """

    name = "DropCloth"

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Also how high the lower edge is, 1 to 6 cm."""
        return super().draw(generator) | {"height": uniform(generator, 1, 0.01, 0.06)[0]}

    def shape(self, drawn: dict[str, Tensor]) -> Tensor:
        """Upright, with the rest shape's x as height; adds the flat sheet to what was drawn."""
        flat = super().shape(drawn)
        x, y, z = flat.unbind(dim=-1)
        upright = torch.stack(
            [torch.zeros_like(x), y, x + SIDE / 2 + drawn["height"][:, None] + HEIGHT], dim=-1
        )
        drawn["goal"] = self.posed(torch.stack([x + SIDE / 2, y, z], dim=-1), drawn)
        return upright

    def tools(self, positions: Tensor, drawn: Mapping[str, Tensor]) -> Tools:
        """Pickers that hold the upper corners."""
        corners = self.beginnings()
        held = cpu.tensor(corners, dtype=torch.int64).expand(len(positions), -1)
        return self.pickers.start(positions[:, corners], held)

    def distance(self, env: EnvState) -> Tensor:
        """Mean distance from the flat sheet [m], [B]."""
        away = env.state.positions - env.drawn["goal"]
        return lengths(away).mean(dim=-1)

    def reward(self, env: EnvState) -> Tensor:
        """See the class."""
        return -self.distance(env)

    def success(self, env: EnvState) -> Tensor:
        """Whether the mean distance is below .1 of the side."""
        return self.distance(env) < _CLOSE * SIDE

    def scripted(self, env: EnvState) -> Tensor:
        """Lower the sheet until it touches the table, lay it down about its edge, let go."""
        start, goal = env.drawn["start"], env.drawn["goal"]
        corners, edge = self.beginnings(), [self.vertex(0, 0), self.vertex(-1, 0)]
        foot, out = start[:, edge], goal[:, corners] - goal[:, edge]
        foot = torch.cat([foot[..., :2], torch.full_like(foot[..., 2:], HEIGHT)], dim=-1)
        up = cpu.tensor([0.0, 0.0, SIDE])
        # What has been laid down and what still hangs are together as long as the sheet.
        shares = [k / 6 for k in range(7)]
        laid = [foot + share * out + (1 - share) * up for share in shares]
        points = [*laid, laid[-1], laid[-1] + 0.1 * up]
        times = [3, *(6 + 4 * k for k in range(6)), 30, 34]
        return self.moves_to(env, *follow(env, times, points, [*[1.0] * 8, -1.0]))
