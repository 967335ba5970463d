"""Tasks with a sheet that lies on a table and pickers that move it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.envs.actuators import Actuator, Pickers, Tools
from diffcloth_torch.envs.built import BuiltTask
from diffcloth_torch.envs.depth_camera import DepthCamera
from diffcloth_torch.envs.env import EnvState
from diffcloth_torch.envs.frames import Frame, level_frame, points_in, vectors_in
from diffcloth_torch.envs.randomization import Randomization
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.options import ContactOptions
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State

__all__ = ["HEIGHT", "SIDE", "SheetTask", "arc", "at", "follow", "uniform"]

SIDE = 0.3  # side of the sheet [m], unless its scale is drawn
HEIGHT = 0.004  # height of the lying sheet [m]
_MATERIAL = Material(bending=1e-5, damping=1e-3, friction=0.5)


def uniform(generator: torch.Generator, size: int, low: float, high: float) -> Tensor:
    """Numbers [size] between two bounds, float64."""
    return low + (high - low) * cpu.rand(size, generator=generator)


def at(positions: Tensor, vertices: Tensor) -> Tensor:
    """Positions [B, n, 3] of vertices [B, n]."""
    return positions.gather(1, vertices[..., None].expand(-1, -1, 3))


class SheetTask(BuiltTask):
    """A square sheet of n x n vertices on a table, and two pickers.

    The start draws position and rotation of the sheet, and positions of the pickers. Subclasses
    define the shape of the sheet (`shape`) and the vertices at which the pickers begin (`picked`).
    The frame of the task is the center and the yaw of the flat sheet as drawn.
    """

    steps = 50
    scales = True
    view = DepthCamera([0.65, -0.5, 0.75], [0.06, 0.0, 0.08])
    beside: ClassVar[float] = 0.012  # largest initial offset of a picker beside its vertex [m]
    above: ClassVar[tuple[float, float]] = (0.01, 0.02)  # range of its height above the vertex [m]

    def __init__(self, *, opens_at: float = 0.0, reach: float = 0.03, **options: Any) -> None:
        """Build the scene; see `BuiltTask` for the other options.

        Args:
            opens_at: The largest grasp of an open picker: 0, or -1 for a soft grasp, whose gradient
                is nowhere zero; see `Pickers`.
            reach: Largest distance at which a picker closes on a vertex [m].
            **options: As for `BuiltTask`.
        """
        self._grasp = opens_at, reach
        super().__init__(**options)
        self._corners = cpu.tensor(
            [self.vertex(row, column) for row in (0, -1) for column in (0, -1)], dtype=torch.int64
        )

    def build(self, material: Material | None) -> tuple[Scene, Actuator]:
        """See `BuiltTask`."""
        material = _MATERIAL if material is None else material
        sheet = Cloth.grid(
            (self.side, self.side),
            SIDE,
            name="sheet",
            pose=[0, 0, HEIGHT, 1, 0, 0, 0],
            material=material,
        )
        opens_at, reach = self._grasp
        self.pickers = Pickers(sheet, opens_at=opens_at, reach=reach)
        table = RigidBody.plane(4.0, friction=0.5, name="table")
        self.rest = cpu.tensor(np.asarray(sheet.rest_positions))
        self._share = float(np.mean(material.density)) * SIDE**2 * 9.81 / self.side**2
        return Scene([sheet], [table], attachments=self.pickers.attachments), self.pickers

    def contact(self) -> ContactOptions:
        """See `BuiltTask`."""
        return ContactOptions(barrier_distance=HEIGHT)

    @property
    def first_action(self) -> tuple[float, ...]:
        """Pickers close and rise: a sheet that is pulled flat along the table gains nothing."""
        return (0.0, 0.0, 0.2, 0.95) * self.pickers.count

    def vertex(self, row: int, column: int) -> int:
        """Index of a vertex; negative rows and columns count from the end."""
        return (row % self.side) * self.side + column % self.side

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Pose of the sheet: rotated by up to .5 rad, and moved by up to 2 cm; see `Task`."""
        return {
            "turn": uniform(generator, 1, -0.5, 0.5)[0],
            "shift": uniform(generator, 2, -0.02, 0.02),
            "pickers": uniform(generator, 6, -1.0, 1.0).reshape(2, 3),
        }

    def shape(self, drawn: dict[str, Tensor]) -> Tensor:
        """Positions [B, N, 3] of the sheet before its rotation and shift: flat on the table."""
        return self.flat(drawn)

    def sides(self, drawn: Mapping[str, Tensor]) -> Tensor:
        """Sides of the sheets [m], [B]."""
        return (SIDE * Randomization.scale(drawn)) * torch.ones_like(drawn["turn"])

    def flat(self, drawn: Mapping[str, Tensor]) -> Tensor:
        """Positions [B, N, 3] of the flat sheet before its rotation and shift."""
        scaled = (self.sides(drawn) / SIDE)[:, None, None] * self.rest
        return scaled + cpu.tensor([0.0, 0.0, HEIGHT])

    def posed(self, points: Tensor, drawn: Mapping[str, Tensor]) -> Tensor:
        """Points [B, n, 3], rotated about the vertical and moved with the sheet."""
        return self.turned(points, drawn) + torch.nn.functional.pad(drawn["shift"], (0, 1))[:, None]

    def turned(self, vectors: Tensor, drawn: Mapping[str, Tensor]) -> Tensor:
        """Vectors [B, n, 3], rotated about the vertical with the sheet."""
        x, y, z = vectors.unbind(dim=-1)
        c, s = drawn["turn"].cos()[:, None], drawn["turn"].sin()[:, None]
        return torch.stack([c * x - s * y, s * x + c * y, z], dim=-1)

    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """The sheet as drawn, and pickers near the vertices at which they begin; see `Task`."""
        positions = self.posed(self.shape(drawn), drawn)
        state = self.simulator.initial_state(len(positions)).replace(positions=positions)
        return self.started(state, drawn)

    def started(self, state: State, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """Add the initial positions and the picked vertices to `drawn`; place the pickers.

        A subclass adds "goal" [B, g, 3] to `drawn`: goals of points of the sheet.
        """
        drawn["start"] = state.positions
        drawn["picked"] = self.picked(drawn)
        return state, self.tools(state.positions, drawn)

    def frame_of(self, state: State, drawn: Mapping[str, Tensor]) -> Frame:
        """See `Task`."""
        shift, turn = drawn["shift"], drawn["turn"]
        origin = torch.cat([shift, torch.zeros_like(shift[:, :1])], dim=-1)
        return level_frame(origin, torch.stack([turn.cos(), turn.sin()], dim=-1))

    def tools(self, positions: Tensor, drawn: Mapping[str, Tensor]) -> Tools:
        """Open pickers beside and above the vertices at which they begin."""
        low, high = self.above
        off = drawn["pickers"] * cpu.tensor([self.beside, self.beside, 0.5 * (high - low)])
        off = off + cpu.tensor([0.0, 0.0, 0.5 * (low + high)])
        return self.pickers.start(at(positions, drawn["picked"]) + self.turned(off, drawn))

    def picked(self, drawn: Mapping[str, Tensor]) -> Tensor:
        """Vertices [B, 2] at which the pickers begin: two corners of one edge."""
        vertices = [self.vertex(0, -1), self.vertex(-1, -1)]
        return cpu.tensor(vertices, dtype=torch.int64).expand(len(drawn["turn"]), -1)

    def features(self, env: EnvState) -> dict[str, Tensor]:
        """Key points and pickers, the corners at the start and the goal, in the frame of the task.

        Lengths are in units of .3 m, the side without a scale, velocities in m/s, forces in weights
        of a vertex of that sheet.
        """
        state, seen, drawn = env.state, self.seen, env.drawn
        points = [seen.of(state.positions), env.tools["points"], drawn["start"][:, self._corners]]
        sizes = [len(seen), self.pickers.count, 4]
        if "goal" in drawn:
            points.append(drawn["goal"])
            sizes.append(drawn["goal"].shape[1])
        placed = points_in(drawn, torch.cat(points, dim=1)) / SIDE
        parts = [part.flatten(1) for part in torch.split(placed, sizes, dim=1)]
        forces = seen.of(state.contact_forces) / self._share
        vectors = vectors_in(drawn, torch.cat([seen.of(state.velocities), forces], dim=1))
        velocities, forces = vectors.chunk(2, dim=1)
        return {
            "positions": parts[0],
            "velocities": velocities.flatten(1),
            "contact_forces": forces.flatten(1),
            "pickers": parts[1],
            "grasp": env.tools["grasp"],
            "start": parts[2],
            **({"goal": parts[3]} if "goal" in drawn else {}),
            "time": self.observed(env.elapsed),
        }

    def moves_to(self, env: EnvState, points: Tensor, grasp: Tensor) -> Tensor:
        """Actions [B, A] that move pickers towards points [B, P, 3], within their stride."""
        moves = vectors_in(env.drawn, points - env.tools["points"]) / self.pickers.stride
        return torch.cat([moves.clamp(-1, 1), grasp[..., None]], dim=-1).flatten(1)


def follow(
    env: EnvState, times: Sequence[float], points: Sequence[Tensor], grasps: Sequence[float]
) -> tuple[Tensor, Tensor]:
    """Wanted positions of pickers on a path after the next transition, and their grasp.

    Args:
        env: State of the environments; only the elapsed transitions are used.
        times: Transitions after which each point of the path is reached, ascending.
        points: Points of the path, [B, P, 3] each.
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
    """Points on half an ellipse from a to b [B, P, 3], without a itself.

    `height` is the height of the arc above the line from a to b, over their horizontal distance.
    """
    up = (b - a)[..., :2].square().sum(dim=-1, keepdim=True).sqrt() * cpu.tensor([0.0, 0.0, height])
    turns = [math.pi * k / count for k in range(1, count + 1)]
    return [a + 0.5 * (1 - math.cos(turn)) * (b - a) + math.sin(turn) * up for turn in turns]
