"""Poses `[px, py, pz, qw, qx, qy, qz]`: a position [m] and a quaternion, normalized when used."""

from __future__ import annotations

import numpy as np

from diffcloth_torch import _core
from diffcloth_torch.checks import FloatArray, check_finite, check_shape, float_array
from diffcloth_torch.errors import InvalidInput

__all__ = [
    "IDENTITY",
    "SHORTEST_QUATERNION",
    "check_quaternions",
    "pose_array",
    "poses_of_frames",
    "refuse_short_quaternions",
    "rotation_matrix",
    "transform",
]

IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

# A shorter quaternion is assumed to be an uninitialized row, not a rotation.
SHORTEST_QUATERNION = 1e-6


def check_quaternions(name: str, poses: FloatArray) -> None:
    """Require quaternions [..., 3:7] that can be normalized."""
    norms = np.linalg.norm(poses[..., 3:], axis=-1)
    wrong = norms < SHORTEST_QUATERNION
    if wrong.any():
        at = [int(i) for i in np.argwhere(wrong)[0]]
        where = f" at {at}" if at else ""
        raise InvalidInput(
            f"{name} must hold a quaternion (w, x, y, z) of non-zero length in its last four "
            f"entries, got length {norms[tuple(at)]:g}{where}"
        )


def refuse_short_quaternions(name: str, poses: FloatArray) -> None:
    """Refuse poses [..., 7] whose quaternion is too short to have a direction."""
    # A fast check with a margin; near the shortest length the other function decides.
    if not _core.have_quaternions(poses, 2 * SHORTEST_QUATERNION):
        check_quaternions(name, poses)


def pose_array(name: str, pose: object, *, instead: str) -> FloatArray:
    """Check one pose [7]; None is the identity."""
    array = float_array(name, IDENTITY if pose is None else pose, instead=instead)
    check_shape(name, array.shape, [(7,)])
    check_finite(name, array)
    check_quaternions(name, array)
    return array


def rotation_matrix(quaternion: FloatArray) -> FloatArray:
    """Rotation [3, 3] of a quaternion (w, x, y, z) of any length."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def transform(vertices: FloatArray, pose: FloatArray) -> FloatArray:
    """Map points [n, 3] of a body frame to the world."""
    moved: FloatArray = vertices @ rotation_matrix(pose[3:]).T + pose[:3]
    return moved


def poses_of_frames(frames: FloatArray) -> FloatArray:
    """Poses [..., 7] of frames [..., 4, 4], with quaternions of length one and w >= 0."""
    from trimesh.transformations import quaternion_from_matrix

    rows = frames.reshape(-1, 4, 4)
    quaternions = [quaternion_from_matrix(frame) for frame in rows]  # type: ignore[no-untyped-call]
    poses = np.concatenate([rows[:, :3, 3], np.reshape(quaternions, (-1, 4))], axis=1)
    return poses.reshape(*frames.shape[:-2], 7)
