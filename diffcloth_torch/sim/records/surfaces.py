"""Every surface of a scene, placed at a state: cloths, bodies, links with collision shapes.

Exported meshes, pictures, wrenches and the staggered couplings use the vertices and frames of this
module. A state carries the surfaces as plain tensors, so that a saved state can be exported without
its scene.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.autograd.transforms import numbers_of
from diffcloth_torch.geometry.products import product
from diffcloth_torch.model.assembly import Assembly
from diffcloth_torch.model.kinematics import link_frames, pose_frame
from diffcloth_torch.model.mechanism import Mechanism
from diffcloth_torch.model.robot import Robot
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.saved import saved

__all__ = ["LinkSurfaces", "Surfaces", "place"]

ByName = dict[str, Tensor]


def place(vertices: Tensor, frames: Tensor) -> Tensor:
    """Transform vertices [v, 3] by frames [..., 4, 4] to the world, [..., v, 3]."""
    lead = frames.shape[:-2]
    points = vertices.expand(*lead, *vertices.shape[-2:])
    return product(points, frames[..., :3, :3].mT) + frames[..., None, :3, 3]


@saved
@dataclass(frozen=True, eq=False)
class LinkSurfaces:
    """The meshes of a robot's links, and the mechanism that places them.

    Attributes:
        mechanism: Fields of the robot's `Mechanism`, with arrays as tensors.
        vertices: Vertices of each link in its frame [m], shape [v, 3]; None without a surface.
        faces: Faces of each link, as indices into its own vertices, shape [g, 3], or None.
    """

    mechanism: dict[str, Any]
    vertices: list[Tensor | None]
    faces: list[Tensor | None]

    @staticmethod
    def of(name: str, robot: Robot) -> LinkSurfaces:
        """Make the surfaces of a robot that has this name in its scene."""
        plain = {
            field: torch.from_numpy(np.array(value)) if isinstance(value, np.ndarray) else value
            for field, value in vars(replace(robot.mechanism, name=name)).items()
        }
        meshes = robot.surfaces
        return LinkSurfaces(
            mechanism=plain,
            vertices=[
                None if m is None else torch.from_numpy(np.array(m.vertices)) for m in meshes
            ],
            faces=[None if m is None else torch.from_numpy(np.array(m.faces)) for m in meshes],
        )

    @property
    def joint_count(self) -> int:
        """Number of joints, J."""
        return len(self.mechanism["joint_names"])

    @property
    def link_names(self) -> list[str]:
        """Name of each link, "robot/link"."""
        return [f"{self.mechanism['name']}/{link}" for link in self.mechanism["link_names"]]

    def frames(self, base: Tensor, joint_positions: Tensor) -> ByName:
        """Frames of all links [..., 4, 4], from the root's [..., 4, 4] and joints [..., J]."""
        fields: dict[str, Any] = {
            field: numbers_of(value) if isinstance(value, Tensor) else value
            for field, value in self.mechanism.items()
        }
        frames = link_frames(Mechanism(**fields), base, joint_positions)
        return dict(zip(self.link_names, frames.unbind(-3), strict=True))


@saved
@dataclass(frozen=True, eq=False)
class Surfaces:
    """The meshes that a state moves, as plain tensors.

    Attributes:
        cloth_names: Name of each cloth.
        cloth_faces: Faces of each cloth, as indices into `positions`, shape [f, 3].
        body_names: Name of each body.
        body_vertices: Vertices of each body in its frame [m], shape [v, 3].
        body_faces: Faces of each body, as indices into its own vertices, shape [g, 3].
        robots: The surfaces of each robot.
        body_points: Points of bodies, then of links with a shape, on which forces act: vertices of
            the mesh, or of the skeleton where a surface is smooth; shape [v, 3] each.
    """

    cloth_names: list[str]
    cloth_faces: list[Tensor]
    body_names: list[str]
    body_vertices: list[Tensor]
    body_faces: list[Tensor]
    robots: tuple[LinkSurfaces, ...]
    body_points: list[Tensor]

    @staticmethod
    def of(scene: Scene, assembly: Assembly) -> Surfaces:
        """Make the surfaces of a scene."""
        starts = zip(scene.cloths, assembly.cloth_vertex_start.tolist(), strict=False)
        return Surfaces(
            cloth_names=list(scene.cloth_names),
            cloth_faces=[torch.from_numpy(cloth.faces + start) for cloth, start in starts],
            body_names=list(scene.body_names),
            body_vertices=[torch.from_numpy(np.array(body.vertices)) for body in scene.bodies],
            body_faces=[torch.from_numpy(np.array(body.faces)) for body in scene.bodies],
            robots=tuple(
                LinkSurfaces.of(name, robot)
                for name, robot in zip(scene.robot_names, scene.robots, strict=True)
            ),
            body_points=[
                torch.from_numpy(np.array(assembly.body_vertices[first:last]))
                for first, last in pairwise(assembly.body_vertex_start.tolist())
            ],
        )

    def frames(self, state: Mapping[str, Tensor]) -> ByName:
        """Frames of all bodies, then of all links, name -> [..., 4, 4], differentiable.

        Args:
            state: `body_poses`, and if there are robots `base_poses` and `joint_positions`.
        """
        named = dict(zip(self.body_names, pose_frame(state["body_poses"]).unbind(-3), strict=True))
        return named | self.link_frames(state)

    def link_frames(self, state: Mapping[str, Tensor]) -> ByName:
        """Frames of all links, without the bodies."""
        if not self.robots:  # fields of a step may lack base poses and joints
            return {}
        bases, first = pose_frame(state["base_poses"]), 0
        named: ByName = {}
        for r, robot in enumerate(self.robots):
            rows = slice(first, first := first + robot.joint_count)
            named |= robot.frames(bases[..., r, :, :], state["joint_positions"][..., rows])
        return named

    def joint_slices(self) -> dict[str, slice]:
        """Name of a robot -> its rows among the joints."""
        ends = np.cumsum([0, *(robot.joint_count for robot in self.robots)]).tolist()
        names = (robot.mechanism["name"] for robot in self.robots)
        return {name: slice(*rows) for name, rows in zip(names, pairwise(ends), strict=True)}

    def rigid_meshes(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Vertices [v, 3] and faces [g, 3] of bodies, then links with a shape, in their frames."""
        bodies = zip(self.body_names, self.body_vertices, self.body_faces, strict=True)
        meshes = {name: (vertices, faces) for name, vertices, faces in bodies}
        for robot in self.robots:
            links = zip(robot.link_names, robot.vertices, robot.faces, strict=True)
            meshes |= {n: (v, f) for n, v, f in links if v is not None and f is not None}
        return meshes

    def rigid_points(self) -> dict[str, Tensor]:
        """Points of bodies, then of links with a shape, on which forces act, in their frames."""
        return dict(zip(self.rigid_meshes(), self.body_points, strict=True))

    def surface_frames(self, state: Mapping[str, Tensor]) -> Tensor:
        """Frames of bodies, then of links with a shape, [..., K + Lc, 4, 4]."""
        poses, frames = state["body_poses"], self.frames(state)
        none = poses.new_zeros(*poses.shape[:-2], 0, 4, 4)
        shaped = (frames[name].unsqueeze(-3) for name in self.rigid_meshes())
        return torch.cat([none, *shaped], dim=-3)

    def cloth_meshes(self, positions: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
        """Vertices [..., v, 3] and faces [f, 3] of the cloths, from positions [..., N, 3]."""
        meshes, start = {}, 0
        for name, faces in zip(self.cloth_names, self.cloth_faces, strict=True):
            end = int(faces.max()) + 1  # every cloth vertex belongs to a face
            meshes[name] = (positions[..., start:end, :], faces - start)
            start = end
        return meshes

    def meshes(self, state: Mapping[str, Tensor]) -> dict[str, tuple[Tensor, Tensor]]:
        """Vertices [..., v, 3] in the world, differentiable, and faces [f, 3] of every surface.

        Args:
            state: `positions`, and the fields that `frames` takes.
        """
        frames = self.frames(state)
        rigid = {n: (place(v, frames[n]), f) for n, (v, f) in self.rigid_meshes().items()}
        return self.cloth_meshes(state["positions"]) | rigid

    def vertices(self, state: Mapping[str, Tensor]) -> Tensor:
        """Cloths and `rigid_points` in the world, [..., N + V, 3], in the order of `meshes`.

        Args:
            state: As for `meshes`.
        """
        positions, frames = state["positions"], self.frames(state)
        cloths = (vertices for vertices, _ in self.cloth_meshes(positions).values())
        rigid = (place(points, frames[name]) for name, points in self.rigid_points().items())
        return torch.cat([positions[..., :0, :], *cloths, *rigid], dim=-2)
