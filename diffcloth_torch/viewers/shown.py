"""The shown parts of a scene, and their colors: cloths, bodies, links with a shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.poses import transform
from diffcloth_torch.model.assembly import assemble
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.records.surfaces import Surfaces, place
from diffcloth_torch.viewers.look import Goal, Paint

__all__ = ["Bounds", "Rigid", "Shown"]

Bounds = tuple[FloatArray, FloatArray]
"""Lowest and highest coordinates [m], each of shape [3]."""

_GAP_BELOW = 0.04  # fraction of the scene's size, between its lowest point and our floor


@dataclass(frozen=True, eq=False)
class Rigid:
    """A surface of a body or a link: vertices [v, 3] in its frame, faces [f, 3].

    Attributes:
        name: Name of the surface: "body" or "robot/link".
        owner: Name of the body or the robot.
        vertices: Vertices in the frame of the body or link [m].
        faces: Vertex indices.
        shown: True if it is drawn; a level plane is not, as the floor replaces it.
    """

    name: str
    owner: str
    vertices: Tensor
    faces: Tensor
    shown: bool


class Shown:
    """The drawn surfaces of a scene, and their places in a state.

    Attributes:
        scene: The scene.
        rigid: Surfaces of bodies, then of links with a shape, in the order of `State.body_forces`.
        cloth_faces: Faces of each cloth, as indices into its own vertices, [f, 3].
        cloth_starts: First row of each cloth among the positions, and the number of all rows.
        paints: Name of a cloth, of a drawn body or robot -> its colors, none of them None.
    """

    def __init__(self, scene: Scene, paints: Mapping[str, Paint]) -> None:
        """Select the surfaces to draw.

        Args:
            scene: The scene.
            paints: Name of a cloth, a body or a robot -> its colors.

        Raises:
            InvalidInput: If the scene has no surface to draw.
        """
        self.scene = scene
        self._surfaces = Surfaces.of(scene, assemble(scene))
        floors = [n for n, b in zip(scene.body_names, scene.bodies, strict=True) if _is_floor(b)]
        self.rigid = [
            Rigid(name, name.partition("/")[0], vertices, faces, name not in floors)
            for name, (vertices, faces) in self._surfaces.rigid_meshes().items()
        ]
        if not scene.cloths and not any(surface.shown for surface in self.rigid):
            raise InvalidInput(
                "pictures: the scene must have a surface: its robots have no collision shapes, and "
                "a level plane is only the floor of what stands on it"
            )
        counts = [len(cloth.vertices) for cloth in scene.cloths]
        self.cloth_starts: list[int] = np.cumsum([0, *counts]).tolist()
        self.cloth_faces: list[NDArray[np.integer[Any]]] = [cloth.faces for cloth in scene.cloths]
        owners = dict.fromkeys(surface.owner for surface in self.rigid if surface.shown)
        self.paints = {
            name: paints.get(name, Paint()).for_cloth(i) for i, name in enumerate(scene.cloth_names)
        } | {name: paints.get(name, Paint()).for_body(i) for i, name in enumerate(owners)}

    @property
    def shown_rigid(self) -> list[Rigid]:
        """The drawn surfaces of bodies and links."""
        return [surface for surface in self.rigid if surface.shown]

    def frames(self, state: State) -> FloatArray:
        """Frames [..., n, 4, 4] of the drawn bodies and links."""
        frames = self._surfaces.surface_frames(vars(state.detach()))
        shown: FloatArray = frames.numpy()[..., [surface.shown for surface in self.rigid], :, :]
        return shown

    def placed(self, frames: FloatArray) -> list[FloatArray]:
        """Vertices [v, 3] in the world of the drawn bodies and links."""
        return [
            place(surface.vertices, torch.from_numpy(frame)).numpy()
            for surface, frame in zip(self.shown_rigid, frames, strict=True)
        ]

    def forces(self, state: State) -> FloatArray:
        """Contact forces on the vertices of drawn bodies and links [N], [..., v, 3].

        Forces on a smooth body are summed to one force, at the vertex that faces it.
        """
        state = state.detach()
        counts = [len(points) for points in self._surfaces.rigid_points().values()]
        forces = torch.split(state.body_forces, counts, dim=-2)
        frames = self._surfaces.surface_frames(vars(state)).unbind(-3)
        drawn = [state.body_forces[..., :0, :]]
        for surface, own, frame in zip(self.rigid, forces, frames, strict=True):
            if not surface.shown:
                continue
            if own.shape[-2] != len(surface.vertices):
                total = own.sum(dim=-2, keepdim=True)
                facing = -(place(surface.vertices, frame) * total).sum(dim=-1)
                row = torch.nn.functional.one_hot(facing.argmax(-1), len(surface.vertices))
                own = row.unsqueeze(-1) * total
            drawn.append(own)
        return torch.cat(drawn, dim=-2).numpy()

    def bounds(
        self, positions: Sequence[FloatArray], frames: Sequence[FloatArray], goals: Sequence[Goal]
    ) -> Bounds:
        """Bounds of a whole motion.

        Args:
            positions: Cloth vertices of each state [m], shape [N, 3].
            frames: Frames of each state, shape [n, 4, 4].
            goals: Target shapes.
        """
        placed = (points for f in np.unique(frames, axis=0) for points in self.placed(f))
        lows, highs = [], []
        for points in (*positions, *(goal.vertices for goal in goals), *placed):
            if len(points):
                lows.append(points.min(axis=0))
                highs.append(points.max(axis=0))
        return np.min(lows, axis=0), np.max(highs, axis=0)

    def ground(self, bounds: Bounds) -> float:
        """Height of the floor [m]: of a static level plane, or else below all surfaces."""
        floors = [body for body in self.scene.bodies if _is_floor(body)]
        if floors:
            return max(float(_placed_body(body)[0, 2]) for body in floors)
        low, high = bounds
        return float(low[2] - _GAP_BELOW * np.linalg.norm(high - low))


def _placed_body(body: RigidBody) -> NDArray[np.float64]:
    return transform(body.vertices, body.pose)


def _is_floor(body: RigidBody) -> bool:
    """Return whether a body is a static level plane, as made by `RigidBody.plane`."""
    is_plane = len(body.vertices) == 4 and len(body.faces) == 2
    return is_plane and body.motion == "static" and not np.ptp(_placed_body(body)[:, 2])
