"""Residuals of a fit: simulation minus observation, in units of the noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.autograd.transforms import numbers_of
from diffcloth_torch.checks import (
    NON_NEGATIVE,
    POSITIVE,
    ArrayLike,
    FloatArray,
    check_finite,
    check_range,
    check_shape,
    float_array,
    float_tensor,
    index_array,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.optimize.compared import (
    Comparison,
    check_count_of,
    checked_noise,
    checked_points,
    note,
    positions_of,
    times_of,
)
from diffcloth_torch.optimize.extrapolation import extrapolated
from diffcloth_torch.optimize.outlines import outline
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.records.trajectory import Trajectory

__all__ = ["extrapolated", "markers", "outline", "point_cloud"]


def markers(
    states: Sequence[State],
    observed: ArrayLike,
    weights: ArrayLike | None = None,
    *,
    vertices: ArrayLike | None = None,
    noise: ArrayLike = 1.0,
    times: ArrayLike | None = None,
    delay: Tensor | float = 0.0,
    frame: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """Simulated minus observed positions of marked vertices, divided by the noise.

    A camera has its own times, a delay, and its own frame. Delay and frame may be variables of the
    fit:

    >>> def residuals(parameters, values):
    ...     frame = values["rotation"], values["translation"]
    ...     states = dc.Trajectory([start, *simulate(parameters)])
    ...     return dc.residuals.markers(
    ...         states, seen, times=times, delay=values["delay"], frame=frame, noise=0.002
    ...     )

    Args:
        states: T states without a batch axis, one for each observation; with `times` a trajectory
            that contains these times.
        observed: Positions [m], shape [T, m, 3]; NaN where a marker was not seen.
        weights: Weight of each marker, >= 0, shape [m] or [T, m]; 1 by default. A marker of weight
            zero counts as not seen.
        vertices: Indices of the m marked vertices; None means all.
        noise: Standard deviation of an observation [m], > 0: a number; one for each axis [3], for
            each marker [m, 1] or for each frame [T, 1, 1]; or of each coordinate [T, m, 3].
        times: Times of the observations [s], shape [T], on the clock of the camera; positions are
            computed by `Trajectory.at`. None if each state is one observation.
        delay: Time by which the camera's clock is late [s]: the motion is compared at
            `times - delay`. Needs `times`.
        frame: Rotation vector [rad], shape [3], and translation [m], shape [3], that transform
            simulated positions into the frame of the camera: x_camera = R x + t.

    Returns:
        Residuals [M] of the seen markers, without unit; differentiable, also in `delay` and
        `frame`.

    Raises:
        InvalidInput: If a shape or value is not accepted.
    """
    owner = "residuals.markers"
    positions, moments = _seen_positions(owner, states, times, delay)
    rows = None
    if vertices is not None:
        rows = index_array(f"{owner}: `vertices`", vertices, positions.shape[1])
        positions = positions[:, torch.from_numpy(rows.astype(np.int64))]
    if frame is not None:
        positions = _in_frame(owner, positions, frame)
    seen = float_array(f"{owner}: `observed`", observed)
    if seen.shape != tuple(positions.shape):
        raise InvalidInput(
            f"{owner}: `observed` must have shape {list(positions.shape)}, a row for each state "
            f"and marker, got {list(seen.shape)}"
        )
    known = np.where(np.isnan(seen), 0.0, seen)
    check_finite(f"{owner}: `observed`, where it is not NaN,", known)
    scale = _noise_of_coordinates(owner, noise, seen.shape)
    difference = (positions - torch.from_numpy(known)) / torch.from_numpy(scale)
    known_rows = ~np.isnan(seen)
    if weights is not None:
        given = float_array(f"{owner}: `weights`", weights)
        check_shape(f"{owner}: `weights`", given.shape, [seen.shape[1:2], seen.shape[:2]])
        check_range(f"{owner}: `weights`", given, NON_NEGATIVE)
        difference = difference * torch.from_numpy(given)[..., None]
        known_rows &= given[..., None] > 0.0
    mask = torch.from_numpy(known_rows)
    marked = range(positions.shape[1]) if rows is None else rows.tolist()
    note(
        Comparison(
            kind="markers",
            times=moments,
            simulated=list(numbers_of(positions)),
            observed=list(seen),
            placed=list(seen),
            labels=[f"vertex {i}" for i in marked],
            noise=float(np.sqrt(np.square(scale).mean())),
            used=known_rows,
        )
    )
    return difference.flatten()[mask.flatten().nonzero()[:, 0]]


def _seen_positions(
    owner: str, states: Sequence[State], times: ArrayLike | None, delay: Tensor | float
) -> tuple[Tensor, FloatArray]:
    """Positions [T, N, 3] at the times of a camera, and these times [s]."""
    positions = positions_of(owner, states)
    late = float_tensor(f"{owner}: `delay`", delay)
    check_shape(f"{owner}: `delay`", late.shape, [()])
    if times is None:
        given: Any = delay
        if isinstance(given, Tensor) or given != 0.0:
            raise InvalidInput(f"{owner}: `delay` needs `times`, on whose clock it is late")
        return positions, times_of(states)
    clock = float_array(f"{owner}: `times`", times)
    check_shape(f"{owner}: `times`", clock.shape, [("T",)])
    check_finite(f"{owner}: `times`", clock)
    moments = torch.from_numpy(clock) - late
    return Trajectory(states).at(moments), numbers_of(moments)


def _in_frame(owner: str, positions: Tensor, frame: tuple[Tensor, Tensor]) -> Tensor:
    """Positions in the frame of a camera, R x + t."""
    given: Any = frame
    if not isinstance(given, tuple | list) or len(given) != 2:
        raise InvalidInput(f"{owner}: `frame` must be (rotation, translation)")
    vectors = []
    for name, part in zip(("rotation", "translation"), given, strict=True):
        vector = float_tensor(f"{owner}: the {name} of `frame`", part)
        check_shape(f"{owner}: the {name} of `frame`", vector.shape, [(3,)])
        vectors.append(vector)
    rotation, translation = vectors
    x, y, z = rotation.unbind()
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    # The matrix exponential is differentiable at the rotation zero, too.
    turn: Tensor = torch.linalg.matrix_exp(skew)
    return positions @ turn.T + translation


def _noise_of_coordinates(owner: str, noise: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Standard deviation of each coordinate [m]."""
    given = float_array(f"{owner}: `noise`", noise)
    frames, count, _ = shape
    accepted = [(), (3,), (count, 1), (frames, 1, 1), shape]
    check_shape(f"{owner}: `noise`", given.shape, accepted)
    check_range(f"{owner}: `noise`", given, POSITIVE)
    return np.broadcast_to(given, shape).copy()


def point_cloud(
    states: Sequence[State], clouds: Sequence[ArrayLike], *, noise: float = 1.0
) -> Tensor:
    """Nearest vertex of the cloths minus observed point, for each point, divided by the noise.

    Each observed point has residuals; parts of the cloth that no camera saw do not count.
    Derivatives keep the choice of the nearest vertex fixed.

    Args:
        states: T states without a batch axis, one for each cloud.
        clouds: Observed points for each state [m], shape [n, 3], without NaN; n = 0 if the camera
            saw nothing.
        noise: Standard deviation of a point [m], > 0.

    Returns:
        Differentiable residuals [M] without unit, three for each point.

    Raises:
        InvalidInput: If a shape or value is not accepted.
    """
    from scipy.spatial import cKDTree

    owner = "residuals.point_cloud"
    positions = positions_of(owner, states)
    scale = checked_noise(owner, noise)
    check_count_of(owner, "clouds", clouds, len(states))
    parts, nearest_points, seen = [], [], []
    for k, cloud in enumerate(clouds):
        points = checked_points(f"{owner}: `clouds`[{k}]", cloud)
        tree: Any = cKDTree(numbers_of(positions[k]))
        nearest = torch.from_numpy(np.asarray(tree.query(points)[1], dtype=np.int64))
        found = positions[k][nearest]
        parts.append((found - torch.from_numpy(points)).flatten())
        nearest_points.append(numbers_of(found))
        seen.append(points)
    most = max(map(len, seen))
    note(
        Comparison(
            kind="point_cloud",
            times=times_of(states),
            simulated=nearest_points,
            observed=seen,
            placed=seen,
            labels=[f"point {i}" for i in range(most)],
            noise=noise,
        )
    )
    return torch.cat(parts) / scale
