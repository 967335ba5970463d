"""Velocities of the links of robots, and contact wrenches on links and bodies.

Everything is ordinary differentiable torch on the fields of a state.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.model.kinematics import pose_frame
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.sim.inputs.layout import Layout

__all__ = ["contact_wrenches", "link_velocities"]

ByName = dict[str, Tensor]


def link_velocities(layout: Layout, state: Fields, link_centers: Tensor) -> ByName:
    """Velocities of the links' centers of mass, then angular ones, "robot/link" -> [B, 6].

    Args:
        layout: Meaning of the rows.
        state: Fields of a state.
        link_centers: Centers of mass in the links' frames [m], shape [B or 1, L, 3].
    """
    if not layout.robots:
        return {}
    bases = pose_frame(state["base_poses"])
    named: ByName = {}
    first = 0
    slices = layout.assembly.joint_slices.values()
    for r, (robot, joints) in enumerate(zip(layout.robots, slices, strict=True)):
        links = slice(first, first := first + robot.mechanism.link_count)
        twists = robot.velocities(
            bases[:, r],
            state["joint_positions"][:, joints],
            link_centers[:, links],
            state["base_velocities"][:, r],
            state["joint_velocities"][:, joints],
        )
        named |= dict(zip(layout.link_names[links], twists.unbind(1), strict=True))
    return named


def contact_wrenches(
    layout: Layout, frames: ByName, forces: Tensor, body_centers: Tensor, link_centers: Tensor
) -> ByName:
    """Force, then torque about the center of mass, in world axes, name -> [B, 6].

    Args:
        layout: Meaning of the rows.
        frames: Frames of all bodies, then all links, name -> [B, 4, 4].
        forces: Forces on the vertices of bodies and links [N], shape [B, V, 3].
        body_centers: Centers of mass in the bodies' frames [m], shape [B or 1, K, 3].
        link_centers: Centers of mass in the links' frames [m], shape [B or 1, L, 3].
    """
    environments = max(len(body_centers), len(link_centers))
    of_all = [c.expand(environments, -1, -1) for c in (body_centers, link_centers)]
    centers = torch.cat(of_all, dim=1)
    named: ByName = {}
    for i, (name, frame) in enumerate(frames.items()):
        rows = layout.rigid_vertices.get(name, slice(0, 0))
        vertices = torch.from_numpy(layout.assembly.body_vertices[rows])
        arms = times(frame[:, None, :3, :3], vertices - centers[:, i, None])
        torques = torch.linalg.cross(arms, forces[:, rows])
        named[name] = torch.cat([forces[:, rows].sum(1), torques.sum(1)], dim=-1)
    return named
