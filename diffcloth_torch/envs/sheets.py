"""Tasks with a sheet that lies on a table and pickers that move it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import check_choice, check_count
from diffcloth_torch.envs.actuators import Pickers, Tools
from diffcloth_torch.envs.env import EnvState, Task
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.options import ContactOptions, SolverOptions
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.simulator import Simulator

__all__ = ["SheetTask", "arc", "follow", "uniform"]

OBSERVATIONS = ("keypoints", "particles")
SIDE = 0.3  # of the sheet [m]
HEIGHT = 0.004  # at which it lies [m]
_DT = 0.02  # [s]
_KEY_POINTS = 4  # along a side
_MATERIAL = Material(bending=1e-5, damping=1e-3, friction=0.5)


def uniform(generator: torch.Generator, size: int, low: float, high: float) -> Tensor:
    """Numbers [size] between two bounds, float64."""
    return low + (high - low) * cpu.rand(size, generator=generator)


class SheetTask(Task):
    """A square sheet of n x n vertices on a table, and two pickers.

    The start is drawn: where the sheet lies and how it is turned, and where pickers are. Subclasses
    say how it is shaped, in `shape`, and which vertices the pickers begin at.

    Attributes:
        side: n.
        key_points: Vertices that are observed.
    """

    def __init__(
        self,
        *,
        size: int = 12,
        horizon: int = 50,
        substeps: int = 2,
        observation: str = "keypoints",
        material: Material = _MATERIAL,
        opens_at: float = 0.0,
        reach: float = 0.03,
    ) -> None:
        """Build the scene.

        Args:
            size: Vertices along a side, >= 4.
            horizon: Transitions of an episode.
            substeps: Time steps of a transition, of .02 s each.
            observation: "keypoints" for 4 x 4 vertices, or "particles" for all.
            material: Of the sheet.
            opens_at: The largest grasp of an open picker: 0, or -1 for a soft grasp, whose gradient
                is nowhere zero; see `Pickers`.
            reach: Within which a picker closes on a vertex [m]; at .06 all begin within reach.
        """
        self.side = check_count(f"{operation(self.name)}: `size`", size, 4)
        check_choice(f"{operation(self.name)}: `observation`", observation, OBSERVATIONS)
        sheet = Cloth.grid(
            (size, size), SIDE, name="sheet", pose=[0, 0, HEIGHT, 1, 0, 0, 0], material=material
        )
        pickers = Pickers(sheet, opens_at=opens_at, reach=reach)
        table = RigidBody.plane(4.0, friction=0.5, name="table")
        simulator = Simulator(
            Scene([sheet], [table], attachments=pickers.attachments),
            _DT,
            contact=ContactOptions(barrier_distance=HEIGHT),
            solver=SolverOptions(throw=False),
        )
        super().__init__(simulator, pickers, horizon=horizon, substeps=substeps)
        self.pickers = pickers
        self.rest = cpu.tensor(np.asarray(sheet.rest_positions))
        some = cpu.linspace(0, size - 1, _KEY_POINTS).round().long()
        rows = some if observation == "keypoints" else cpu.arange(size)
        self.key_points = (rows[:, None] * size + rows).flatten()
        self._share = float(np.mean(material.density)) * SIDE**2 * 9.81 / size**2

    def vertex(self, row: int, column: int) -> int:
        """Index of a vertex; negative rows and columns count from the end."""
        return (row % self.side) * self.side + column % self.side

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """How the sheet lies: turned by up to .5 rad, and moved by up to 2 cm; see `Task`."""
        return {
            "turn": uniform(generator, 1, -0.5, 0.5)[0],
            "shift": uniform(generator, 2, -0.02, 0.02),
            "pickers": uniform(generator, 6, -1.0, 1.0).reshape(2, 3),
        }

    def shape(self, drawn: dict[str, Tensor]) -> Tensor:
        """Positions [B, N, 3] of the sheet before it is turned and moved: flat on the table."""
        flat = self.rest + cpu.tensor([0.0, 0.0, HEIGHT])
        return flat.expand(len(drawn["turn"]), -1, -1)

    def posed(self, points: Tensor, drawn: Mapping[str, Tensor]) -> Tensor:
        """Points [B, n, 3] turned about the vertical and moved as the sheet is."""
        x, y, z = points.unbind(dim=-1)
        c, s = drawn["turn"].cos()[:, None], drawn["turn"].sin()[:, None]
        shift = drawn["shift"][:, None]
        return torch.stack(
            [c * x - s * y + shift[..., 0], s * x + c * y + shift[..., 1], z], dim=-1
        )

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """The sheet as drawn, and pickers near the vertices that they begin at; see `Task`."""
        positions = self.posed(self.shape(drawn), drawn)
        drawn["start"] = positions
        state = self.simulator.initial_state(len(positions)).replace(positions=positions)
        return state, self.tools(positions, drawn)

    def tools(self, positions: Tensor, drawn: Mapping[str, Tensor]) -> Tools:
        """Open pickers up to 1.5 cm beside, and 1 to 3 cm above, the vertices of `beginnings`."""
        off = drawn["pickers"] * cpu.tensor([0.015, 0.015, 0.01])
        off = off + cpu.tensor([0.0, 0.0, 0.02])
        return self.pickers.start(positions[:, self.beginnings()] + off)

    def beginnings(self) -> list[int]:
        """Vertices near which the pickers begin: two corners of one edge."""
        return [self.vertex(0, -1), self.vertex(-1, -1)]

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Key points and pickers, in units of the side, of 1 m/s and of a vertex's weight."""
        state, rows = env.state, self.key_points
        return {
            "positions": (state.positions[:, rows] / SIDE).flatten(1),
            "velocities": state.velocities[:, rows].flatten(1),
            "contact_forces": (state.contact_forces[:, rows] / self._share).flatten(1),
            "pickers": (env.tools["points"] / SIDE).flatten(1),
            "grasp": env.tools["grasp"],
            "time": env.elapsed.double()[:, None] / self.horizon,
        }

    def moves_to(self, env: EnvState, points: Tensor, grasp: Tensor) -> Tensor:
        """Actions [B, A] that bring pickers as far towards points [B, P, 3] as they go."""
        moves = (points - env.tools["points"]) / self.pickers.stride
        return torch.cat([moves.clamp(-1, 1), grasp[..., None]], dim=-1).flatten(1)


def follow(
    env: EnvState, times: Sequence[float], points: Sequence[Tensor], grasps: Sequence[float]
) -> tuple[Tensor, Tensor]:
    """Where pickers should be after the next transition, on a path; and their grasp.

    Args:
        env: Of which the time counts.
        times: Transitions after which each point of the path is reached, ascending.
        points: [B, P, 3] each.
        grasps: The grasp on the way to each point.

    Returns:
        Points [B, P, 3], and grasps [B, P].
    """
    after = (env.elapsed + 1).to(torch.float64)
    knots = cpu.tensor(list(times))
    last = torch.searchsorted(knots, after).clamp(max=len(knots) - 1)
    first = (last - 1).clamp(min=0)
    length = (knots[last] - knots[first]).clamp(min=1e-9)
    t = ((after - knots[first]) / length).clamp(0, 1)[:, None, None]
    path = torch.stack(list(points))  # [K, B, P, 3]
    rows = cpu.arange(len(env))
    there = path[first, rows] + t * (path[last, rows] - path[first, rows])
    grasp = cpu.tensor(list(grasps))[last]
    return there, grasp[:, None].expand(-1, there.shape[1])


def arc(a: Tensor, b: Tensor, height: float, count: int) -> list[Tensor]:
    """Points on half an ellipse from a to b above the line between them, without a itself."""
    up = cpu.tensor([0.0, 0.0, height])
    turns = [math.pi * k / count for k in range(1, count + 1)]
    return [a + 0.5 * (1 - math.cos(turn)) * (b - a) + math.sin(turn) * up for turn in turns]
