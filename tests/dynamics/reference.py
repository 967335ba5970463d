"""Reference for the core's recursions along a tree, by Jacobians and autograd in torch.

Joint j turns about the axis z through the point o; F and N are the momentum and the angular
momentum about o of all links that the joint carries. A rotation of the joint moves these links and
no others, so at constant rates the derivative of the kinetic energy T = p . nu / 2 by its value is

    dT/dq_j = dz/dt . N + z . (F x do/dt),   dz/dt = omega x z      (dz/dt . F if it slides).
"""

import torch
from tree_in_torch import link_momenta

from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.dynamics.totals import about_origin
from diffcloth_torch.geometry.products import product


def slope(kinematics, motion, velocity):
    """dT/dq of the kinetic energy at constant velocities nu [B, 6 + J], likewise.

    Args:
        kinematics: The mechanism.
        motion: Configuration of its links.
        velocity: nu.
    """
    frames = motion.frames
    twists = times(motion.jacobian, velocity[..., None, :])  # [B, L, 6]
    momenta = link_momenta(motion, velocity)
    linear = momenta[..., :3]
    carried = about_origin(frames.centers, momenta)
    # Momentum of all links that each joint carries, first about the origin, then about the pivot.
    F, N = torch.split(product(kinematics.reach.T[None], carried), 3, dim=-1)
    N = N - torch.linalg.cross(frames.pivots, F)
    rate, omega = torch.split(twists[..., kinematics.moving, :], 3, dim=-1)
    arms = frames.pivots - frames.centers[..., kinematics.moving, :]
    pivot_rate = rate + torch.linalg.cross(omega, arms)
    axis_rate = torch.linalg.cross(omega, frames.axes)
    turning = (axis_rate * N + frames.axes * torch.linalg.cross(F, pivot_rate)).sum(-1)
    sliding = (axis_rate * F).sum(-1)
    rows = torch.lerp(sliding, turning, kinematics.revolute[:, 0]).unsqueeze(-2)
    joints = product(rows, kinematics.leaders)[..., 0, :]
    root_rate = velocity[..., :3]
    root = torch.linalg.cross(linear.sum(-2), root_rate)
    return torch.cat([torch.zeros_like(root_rate), root, joints], dim=-1)


def wrenches_of_forces(frames, links, points, forces):
    """Force and torque about the center of each link, from forces at points on them.

    Args:
        frames: Frames of the links.
        links: Index of each point's link, shape [V].
        points: Points in the frames of their links [m], shape [V, 3].
        forces: Forces in world axes [N], shape [B, V, 3].

    Returns:
        Wrenches in N and N m, shape [B, L, 6].
    """
    poses = frames.poses[..., links, :, :]
    placed = times(poses[..., :3, :3], points) + poses[..., :3, 3]
    arms = placed - frames.centers[..., links, :]
    parts = torch.cat([forces, torch.linalg.cross(arms, forces)], dim=-1)
    zeros = parts.new_zeros(*parts.shape[:-2], frames.centers.shape[-2], 6)
    return zeros.index_add(-2, links, parts)
