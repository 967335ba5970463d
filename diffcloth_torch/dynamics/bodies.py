"""Free rigid bodies over one step, all of them at once.

With the angular momentum L about the center, in world axes, and the inertia J in body axes, the
orientation moves by the midpoint rule,

    R_pred = exp(h omega) R_n,  R_mid = exp(h omega/2) R_n,
    omega = R_mid J^-1 R_mid^T (L + h torque).

A body by itself keeps L to rounding, and its energy up to oscillations. Its coordinates are the
center c and the rotation vector w with R = exp(w) R_pred; the core adds the inertia
1/(2h^2) (m |c - c^|^2 + w^T I w) about the prediction to what it minimizes. The gradient of that at
the solution is the contact force, which gives the body its momentum after the step: what contact
takes from others arrives here.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffcloth_torch.dynamics.free_motion import body_motion, solve_motion
from diffcloth_torch.dynamics.implicit import attach_root
from diffcloth_torch.dynamics.inertia import Inertia
from diffcloth_torch.dynamics.kinematics import CROSS
from diffcloth_torch.dynamics.linear import solve, times
from diffcloth_torch.dynamics.totals import Totals, ordered_sum
from diffcloth_torch.errors import SimulationError
from diffcloth_torch.geometry.products import product
from diffcloth_torch.geometry.rotation import (
    nearer_quaternion,
    quaternion_exp,
    quaternion_matrix,
    quaternion_multiply,
    rotation_exp,
    torque_from_moment,
)
from diffcloth_torch.model.kinematics import pose_frame

__all__ = ["BodyInertia", "BodyPrediction", "advance_bodies", "body_totals", "predict_bodies"]

# Added to angles that something is divided by; its third power is still a number.
_NO_ANGLE = 1e-100


class BodyInertia(NamedTuple):
    """Mass [B or 1, K] kg; center [.., K, 3] m and inertia [.., K, 3, 3] kg m^2 in body axes."""

    mass: Tensor
    center: Tensor
    inertia: Tensor


class BodyPrediction(NamedTuple):
    """What the core needs, and what `advance_bodies` does.

    Attributes:
        frames: Of the core, which turns and shifts them by the coordinates; poses [B, K, 7].
        coordinates: Of the start, [B, K, 6].
        target: t, [B, K, 6].
        metric: A, [B, K, 6, 6].
        inertia: What the bodies weigh.
        poses: At the start, [B, K, 7].
        momentum: Angular momentum without contact, [B, K, 3].
    """

    frames: Tensor
    coordinates: Tensor
    target: Tensor
    metric: Tensor
    inertia: BodyInertia
    poses: Tensor
    momentum: Tensor


def predict_bodies(
    poses: Tensor,
    velocities: Tensor,
    inertia: BodyInertia,
    wrenches: Tensor,
    gravity: Tensor,
    dt: float,
) -> BodyPrediction:
    """Take a step without contact.

    Args:
        poses: Of the body frames, [B, K, 7].
        velocities: Of the centers, then of rotation, in world axes; [B, K, 6].
        inertia: What the bodies weigh.
        wrenches: Forces at the centers and torques, in world axes; [B, K, 6].
        gravity: [B or 1, 3] m/s^2.
        dt: h [s].
    """
    quaternion = torch.nn.functional.normalize(poses[..., 3:], dim=-1)
    rotation = quaternion_matrix(quaternion)
    back = rotation.transpose(-1, -2)
    center = poses[..., :3] + times(rotation, inertia.center)
    speed = velocities[..., :3] + dt * (
        gravity[..., None, :] + wrenches[..., :3] / inertia.mass[..., None]
    )
    # In body axes at the start.
    spin = times(back, velocities[..., 3:])
    momentum = times(inertia.inertia, spin) + dt * times(back, wrenches[..., 3:])
    omega = times(rotation, _midpoint_spin(inertia.inertia, momentum, dt))

    predicted = quaternion_multiply(quaternion_exp(dt * omega), quaternion)
    turned = quaternion_matrix(predicted)
    moments = product(product(turned, inertia.inertia), turned.transpose(-1, -2))
    zeros = torch.zeros_like(omega)
    mass = inertia.mass[..., None, None] * torch.eye(3, dtype=moments.dtype)
    mass, none = mass.expand_as(moments), torch.zeros_like(moments)
    metric = torch.cat([torch.cat([mass, none], -1), torch.cat([none, moments], -1)], dim=-2)
    return BodyPrediction(
        frames=torch.cat([-times(turned, inertia.center), predicted], dim=-1),
        coordinates=torch.cat([center, -dt * omega], dim=-1),
        target=torch.cat([center + dt * speed, zeros], dim=-1),
        metric=metric / dt**2,
        inertia=inertia,
        poses=poses,
        momentum=times(rotation, momentum),
    )


def body_totals(poses: Tensor, velocities: Tensor, inertia: BodyInertia, gravity: Tensor) -> Totals:
    """Momentum and energy of all bodies.

    Args:
        poses: Of the body frames, [B, K, 7].
        velocities: Of the centers, then of rotation, in world axes; [B, K, 6].
        inertia: What the bodies weigh.
        gravity: [B or 1, 3] m/s^2.
    """
    frames = pose_frame(poses)
    rotation = frames[..., :3, :3]
    center = frames[..., :3, 3] + times(rotation, inertia.center)
    spin = times(rotation.transpose(-1, -2), velocities[..., 3:])
    angular = times(rotation, times(inertia.inertia, spin))
    momenta = torch.cat([inertia.mass[..., None] * velocities[..., :3], angular], dim=-1)
    kinetic = ordered_sum((momenta * velocities).flatten(-2)) / 2
    return Totals.of(center, momenta, kinetic, inertia.mass, gravity)


def advance_bodies(
    prediction: BodyPrediction, coordinates: Tensor, kick: Tensor | None, dt: float
) -> tuple[Tensor, Tensor]:
    """Poses [B, K, 7] and velocities [B, K, 6] after a step.

    Args:
        prediction: Of the step.
        coordinates: At its end, [B, K, 6].
        kick: Forces at the centers and torques that change velocities only, [B, K, 6].
        dt: h [s].
    """
    inertia = prediction.inertia
    center, turn = torch.split(coordinates, 3, dim=-1)
    predicted = prediction.frames[..., 3:]
    quaternion = quaternion_multiply(quaternion_exp(turn), predicted)
    rotation = quaternion_matrix(quaternion)
    moment = times(prediction.metric[..., 3:, 3:], turn)
    torque = torque_from_moment(turn, moment)
    rate = (center - prediction.coordinates[..., :3]) / dt
    if kick is not None:
        torque = torque + kick[..., 3:]
        rate = rate + dt * kick[..., :3] / inertia.mass[..., None]
    momentum = times(rotation.transpose(-1, -2), prediction.momentum + dt * torque)
    spin = solve(inertia.inertia.expand_as(rotation), momentum)
    sign = nearer_quaternion(quaternion, prediction.poses[..., 3:])
    poses = torch.cat([center - times(rotation, inertia.center), sign], dim=-1)
    return poses, torch.cat([rate, times(rotation, spin)], dim=-1)


def _midpoint_spin(inertia: Tensor, momentum: Tensor, dt: float) -> Tensor:
    """Omega [B, K, 3] with r = J Omega - exp(-h Omega / 2) momentum = 0, all in body axes."""

    def residual(spin: Tensor, inertia: Tensor, momentum: Tensor) -> Tensor:
        return times(inertia, spin) - times(rotation_exp(-dt / 2 * spin), momentum)

    def slope(spin: Tensor, inertia: Tensor, momentum: Tensor) -> Tensor:
        # d(exp(-x) v) = y x (D dx) with y = exp(-x) v and the left Jacobian D of the exponential.
        x = dt / 2 * spin
        angle = x.norm(dim=-1)[..., None, None] + _NO_ANGLE
        X = _cross(x)
        first = 2 * (torch.sin(angle / 2) / angle) ** 2
        second = (angle - torch.sin(angle)) / angle**3
        D = torch.eye(3, dtype=x.dtype) - first * X + second * product(X, X)
        K: Tensor = inertia - dt / 2 * product(_cross(times(rotation_exp(-x), momentum)), D)
        return K

    spin, found = _solve_spin(inertia, momentum, dt)
    lost = torch.nonzero(~found.all(-1))[:, 0].tolist()
    if lost:
        raise SimulationError(
            f"step: a rigid body turns too fast for a time step of {dt:g} s; it may turn by about "
            "a radian in it",
            environments=lost,
        )
    return attach_root(residual, spin, (inertia, momentum), slope)


def _solve_spin(inertia: Tensor, momentum: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Omega [B, K, 3] without a graph, and where it was found [B, K]."""
    batch, count = momentum.shape[:2]
    # To the core each body is an environment of its own.
    none = momentum.new_zeros(batch * count, 0)
    zeros = momentum.new_zeros(batch * count, 3)
    given = torch.cat([zeros, momentum.reshape(-1, 3)], dim=-1)
    matrices = inertia.expand(batch, count, 3, 3).reshape(-1, 1, 3, 3)
    body = Inertia(mass=_ONE, center=zeros[:1, None], inertia=matrices, armature=none[:1])
    start = (zeros[:1], _EYE, none[:1])
    spin, found = solve_motion(body_motion(dt), body, start, torch.zeros_like(given[:1]), given)
    return spin.reshape(batch, count, 3), found.reshape(batch, count)


_ONE = torch.ones(1, 1, dtype=torch.float64)
_EYE = torch.eye(3, dtype=torch.float64)[None]


def _cross(vectors: Tensor) -> Tensor:
    matrices: Tensor = times(CROSS, vectors).reshape(*vectors.shape, 3)
    return matrices
