"""Rotations as quaternions (w, x, y, z), and poses [px, py, pz, qw, qx, qy, qz], in torch.

A rotation vector w rotates by |w| radians about w / |w|. All functions are differentiable,
even at zero.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from diffcloth_torch import cpu

__all__ = [
    "integrate_poses",
    "interpolate_poses",
    "pose_velocities",
    "quaternion_exp",
    "quaternion_log",
    "quaternion_matrix",
    "quaternion_multiply",
    "rotate",
    "rotation_exp",
    "row_velocities",
]

# Below this angle [rad] the exponential is summed as a series; its first neglected terms are
# 0.1^10 / (2^10 10!) = 3e-20 for the cosine and less for the sine.
_SERIES_ANGLE = 0.1

# Coefficients of (a/2)^2 to the powers 1 to 4 in cos(a/2) - 1, and in sin(a/2) / (a/2) - 1.
_SERIES = cpu.tensor(
    [[(-1) ** k / math.factorial(2 * k + i) for k in range(1, 5)] for i in range(2)],
)

# sin(a / 2) below which a logarithm uses a / sin(a / 2) = 2, exact to rounding.
_SMALLEST_SINE = 1e-9


# The entries of a rotation matrix are twice a product of two entries of its quaternion plus or
# minus another one, minus one on the diagonal; products of (w, x, y, z) are numbered row by row.
_FIRST = cpu.tensor([0, 6, 7, 6, 0, 11, 7, 11, 0], dtype=torch.int64)
_SECOND = cpu.tensor([5, 3, 2, 3, 10, 1, 2, 1, 15], dtype=torch.int64)
_SIGN = cpu.tensor([1, -1, 1, 1, 1, -1, -1, 1, 1])
_IDENTITY = cpu.eye(3).flatten()


def quaternion_exp(rotation_vector: Tensor) -> Tensor:
    """Unit quaternions of rotation vectors.

    With a = |w|, q = (cos(a/2), sin(a/2)/a w). The series in a^2 near zero keeps both the value
    and the gradient, where sin(a/2)/a would be 0/0.

    Args:
        rotation_vector: w [rad], shape [..., 3].

    Returns:
        Quaternions, shape [..., 4].
    """
    angle_sq = (rotation_vector * rotation_vector).sum(-1, keepdim=True)
    near_zero = angle_sq < _SERIES_ANGLE**2
    # Both branches are evaluated: the arguments of each keep value and gradient finite.
    half = torch.where(near_zero, 4.0, angle_sq).sqrt() / 2
    s = torch.where(near_zero, angle_sq, 0.0) / 4
    s_sq = s * s
    powers = torch.cat([s, s_sq, s * s_sq, s_sq * s_sq], dim=-1)
    series = 1 + (powers.unsqueeze(-2) * _SERIES).sum(-1)
    closed = torch.cat([torch.cos(half), torch.sin(half) / half], dim=-1)
    parts = torch.where(near_zero, series, closed)
    cosine, sine_over_half = parts[..., :1], parts[..., 1:]
    return torch.cat([cosine, sine_over_half / 2 * rotation_vector], dim=-1)


def quaternion_log(quaternion: Tensor) -> Tensor:
    """Rotation vectors of unit quaternions, of at most pi radians.

    Args:
        quaternion: Unit quaternions, shape [..., 4].

    Returns:
        Rotation vectors [rad], shape [..., 3].
    """
    # q and -q are the same rotation; the one with w >= 0 turns by pi or less.
    sign = torch.where(quaternion[..., :1] < 0, -1.0, 1.0)
    w, v = sign * quaternion[..., :1], sign * quaternion[..., 1:]
    sine_sq = (v * v).sum(-1, keepdim=True)
    near_zero = sine_sq < _SMALLEST_SINE**2
    sine = torch.where(near_zero, torch.ones_like(sine_sq), sine_sq).sqrt()
    factor = torch.where(near_zero, torch.full_like(sine, 2.0), 2 * torch.atan2(sine, w) / sine)
    vector: Tensor = factor * v
    return vector


def quaternion_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Quaternion of the rotation `b` followed by `a`; shapes [..., 4]."""
    aw, av = a[..., :1], a[..., 1:]
    bw, bv = b[..., :1], b[..., 1:]
    w = aw * bw - (av * bv).sum(-1, keepdim=True)
    v = aw * bv + bw * av + torch.linalg.cross(av, bv)
    return torch.cat([w, v], dim=-1)


def rotate(quaternion: Tensor, points: Tensor) -> Tensor:
    """Rotate points [..., 3] by unit quaternions [..., 4]."""
    w, v = quaternion[..., :1], quaternion[..., 1:]
    v = v.expand_as(points)
    twice = 2 * torch.linalg.cross(v, points)
    turned: Tensor = points + w * twice + torch.linalg.cross(v, twice)
    return turned


def integrate_poses(pose: Tensor, twists: Tensor, dt: float) -> Tensor:
    """Poses along a sequence of velocities.

    In each step p <- p + dt v and q <- exp(dt w) q, which is exact for a constant w.

    Args:
        pose: Pose before the first step, its quaternion of unit length; shape [7].
        twists: Linear velocity v [m/s] and angular velocity w [rad/s] in world axes,
            shape [n, 6].
        dt: Time step [s].

    Returns:
        Poses after each step, shape [n, 7].
    """
    positions = pose[:3] + dt * torch.cumsum(twists[:, :3], dim=0)
    turns = quaternion_exp(dt * twists[:, 3:])
    quaternion = pose[3:]
    quaternions = []
    for turn in turns:
        quaternion = quaternion_multiply(turn, quaternion)
        quaternions.append(quaternion)
    return torch.cat([positions, torch.stack(quaternions)], dim=-1)


def pose_velocities(start: Tensor, end: Tensor, dt: float) -> Tensor:
    """Constant velocities that lead from poses to others by `integrate_poses`.

    Args:
        start: Poses with quaternions of any length, shape [..., 7].
        end: Poses, rotated by less than pi relative to `start`; shape [..., 7].
        dt: Time between both [s].

    Returns:
        Linear velocities [m/s] and angular velocities [rad/s] in world axes, shape [..., 6].
    """
    before, after = (
        pose[..., 3:] / torch.linalg.vector_norm(pose[..., 3:], dim=-1, keepdim=True)
        for pose in (start, end)
    )
    conjugate = before * cpu.tensor([1.0, -1.0, -1.0, -1.0], dtype=before.dtype)
    turn = quaternion_log(quaternion_multiply(after, conjugate))
    return torch.cat([end[..., :3] - start[..., :3], turn], dim=-1) / dt


def row_velocities(start: Tensor, end: Tensor, rows: Tensor, dt: float) -> Tensor:
    """Velocities of some rows of poses, zero for the others: see `pose_velocities`.

    Args:
        start: Poses, shape [B, K, 7].
        end: Poses, shape [B, K, 7]; `start` or `end` may have one environment for all.
        rows: Indices of the rows that move.
        dt: Time between both [s].

    Returns:
        Shape [B, K, 6].
    """
    shape = (max(len(start), len(end)), start.shape[1], 6)
    velocities = cpu.zeros(shape, dtype=start.dtype)
    if not len(rows):
        return velocities
    return velocities.index_copy(1, rows, pose_velocities(start[:, rows], end[:, rows], dt))


def interpolate_poses(times: Tensor, poses: Tensor, at: Tensor) -> Tensor:
    """Poses between keyframes: straight paths, rotations about one axis at constant speed.

    Args:
        times: Increasing times of the keyframes [s], shape [k].
        poses: Their poses, shape [k, 7].
        at: Times [s], shape [n]; before the first and after the last keyframe, their pose.

    Returns:
        Poses, shape [n, 7].
    """
    if len(times) == 1:
        return poses.expand(len(at), 7).clone()
    after = torch.searchsorted(times, at.contiguous()).clamp(1, len(times) - 1)
    a, b = poses[after - 1], poses[after]
    span = times[after] - times[after - 1]
    part = ((at - times[after - 1]) / span).clamp(0, 1)[:, None]
    conjugate = a[:, 3:] * cpu.tensor([1.0, -1.0, -1.0, -1.0], dtype=a.dtype)
    turn = quaternion_log(quaternion_multiply(b[:, 3:], conjugate))
    quaternions = quaternion_multiply(quaternion_exp(part * turn), a[:, 3:])
    return torch.cat([torch.lerp(a[:, :3], b[:, :3], part), quaternions], dim=-1)


def quaternion_matrix(quaternion: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of unit quaternions [..., 4]."""
    products = (quaternion.unsqueeze(-1) * quaternion.unsqueeze(-2)).flatten(-2)
    # Not computed by a product of matrices, whose bits would depend on their number.
    sums = products.index_select(-1, _FIRST) + _SIGN * products.index_select(-1, _SECOND)
    return (2 * sums - _IDENTITY).reshape(*quaternion.shape[:-1], 3, 3)


def rotation_exp(rotation_vector: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3] [rad], smooth also at zero."""
    return quaternion_matrix(quaternion_exp(rotation_vector))
