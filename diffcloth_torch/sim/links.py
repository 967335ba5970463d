"""Where the links of robots are, how they move, and which wrenches contact puts on them.

Everything is ordinary differentiable torch on the fields of a state.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloth_torch.dynamics.kinematics import Tree
from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.model.kinematics import link_frames, pose_frame
from diffcloth_torch.sim.inputs import Fields
from diffcloth_torch.sim.layout import Layout

__all__ = ["contact_wrenches", "link_poses", "link_velocities"]

ByName = dict[str, Tensor]


def link_poses(layout: Layout, state: Fields) -> ByName:
    """Frames of all links, "robot/link" -> [B, 4, 4]."""
    if not layout.robots:  # then the fields lack theirs
        return {}
    bases = pose_frame(state["base_poses"])
    named: ByName = {}
    for r, (tree, joints) in enumerate(_trees(layout)):
        positions = state["joint_positions"][:, joints]
        frames = link_frames(tree.mechanism, bases[:, r], positions)
        named |= _by_link(tree, frames)
    return named


def link_velocities(layout: Layout, state: Fields, link_centers: Tensor) -> ByName:
    """Velocities of the links' centers of mass, then of rotation, "robot/link" -> [B, 6].

    Args:
        layout: What the rows stand for.
        state: Fields of a state.
        link_centers: In the links' frames [m], shape [B or 1, L, 3].
    """
    if not layout.robots:
        return {}
    bases = pose_frame(state["base_poses"])
    named: ByName = {}
    first = 0
    for r, (tree, joints) in enumerate(_trees(layout)):
        links = slice(first, first := first + tree.mechanism.link_count)
        positions = state["joint_positions"][:, joints]
        frames = tree.frames(bases[:, r], positions, link_centers[:, links])
        rates = torch.cat(
            [state["base_velocities"][:, r], state["joint_velocities"][:, joints]], -1
        )
        twists = times(tree.jacobian(frames), rates[:, None])
        named |= _by_link(tree, twists)
    return named


def contact_wrenches(
    layout: Layout, state: Fields, forces: Tensor, body_centers: Tensor, link_centers: Tensor
) -> ByName:
    """Force, then torque about the center of mass, in world axes, name -> [B, 6].

    Args:
        layout: What the rows stand for.
        state: Fields of a state.
        forces: On the vertices of bodies and links [N], shape [B, V, 3].
        body_centers: In the bodies' frames [m], shape [B or 1, K, 3].
        link_centers: In the links' frames [m], shape [B or 1, L, 3].
    """
    bodies = pose_frame(state["body_poses"])
    frames = {body.name: bodies[:, k] for k, body in enumerate(layout.bodies)}
    frames |= link_poses(layout, state)
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


def _trees(layout: Layout) -> list[tuple[Tree, slice]]:
    return list(zip(layout.trees, layout.assembly.joint_slices.values(), strict=True))


def _by_link(tree: Tree, rows: Tensor) -> ByName:
    mechanism = tree.mechanism
    return {f"{mechanism.name}/{link}": rows[:, i] for i, link in enumerate(mechanism.link_names)}
