"""Free rigid bodies over one step, all of them at once.

A body by itself moves as Euler's equations say, to rounding: with the angular momentum L about the
center, in world axes, and the inertia J in body axes, it keeps L + h torque and turns by a Q that
the core finds, R_pred = R_n Q. Its coordinates are the center c and the rotation vector w with
R = exp(w) R_pred; the core adds the inertia 1/(2h^2) (m |c - c^|^2 + w^T I w) about the prediction
to what it minimizes. The gradient of that at the solution is the contact force, which gives the
body its momentum after the step: what contact takes from others arrives here.

**What contact gives at most.** The force F of a contact acts at the end of a step, where its point
moves with the end's velocity; the point has come along an arc. Where a step turns a body far, the
force may thus push a point that has been deeper and is already on its way out, and work more than
what stores it has lost; and a body that contact turns by w, but not its L, has another energy. Of
convex potentials the force works at most F . (x_n+1 - x_n), and barriers store at most 0.18 |F| d
with their reach d, of which they have that of the weight from before. Where the bodies of a group,
which touch each other, would have more, and .0009 of what they had, their velocities are

    V = (1 - b) V_1 + b V_0,    V_1 = M^-1 (p + P),    V_0 = M^-1 (exp(w) p + (1 - a) P),

with the impulses P and one b for the group, as small as its energy allows. V_0 is where contact
leaves nothing moving along P, P . V_0 = 0, and has carried L along, so that it has less energy than
without contact; its spin pays for what is stored. Kinetic energy is convex on the way, and so b is
known without a search. What bodies give each other stays equal and opposite: L is carried, and spin
pays, only where something prescribed takes the rest. In translation there is no excess, and with
small turns none that is not paid for: b = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffcloth_torch.dynamics.free_motion import free_turns
from diffcloth_torch.dynamics.linear import solve, times
from diffcloth_torch.dynamics.totals import Totals, ordered_sum
from diffcloth_torch.errors import SimulationError
from diffcloth_torch.geometry.rotation import (
    nearer_quaternion,
    quaternion_exp,
    quaternion_log,
    quaternion_matrix,
    quaternion_multiply,
    rotate,
    torque_from_moment,
)
from diffcloth_torch.model.kinematics import pose_frame

__all__ = [
    "MOST_TURN_IN_CONTACT",
    "BodyContact",
    "BodyInertia",
    "BodyPrediction",
    "advance_bodies",
    "body_totals",
    "predict_bodies",
    "refuse_turns",
]

# The largest energy of a barrier over its force and its reach: -(1 - u)^2 log u over its slope.
_STORED = 0.18

# The turn [rad] that a body may make in a step: by itself, where the core's series would get long,
# and while it touches something, where what touches at the end says nothing of the way there.
_MOST_TURN = 1e3
MOST_TURN_IN_CONTACT = 1.5

# Of the kinetic energy: what contact may give in a step without being asked.
_GAIN = 9e-4

# Of what contact may store: keeps b smooth where even V_0 has an excess.
_SOFT = 0.1


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
        velocities: Of the centers at the start, [B, K, 3].
        momentum: Angular momentum without contact, [B, K, 3].
        spin_energy: Kinetic energy of rotation with it, [B, K].
        speed: Of rotation at the start, with it, [B, K] rad/s.
    """

    frames: Tensor
    coordinates: Tensor
    target: Tensor
    metric: Tensor
    inertia: BodyInertia
    poses: Tensor
    velocities: Tensor
    momentum: Tensor
    spin_energy: Tensor
    speed: Tensor


class BodyContact(NamedTuple):
    """Contact of the bodies with each other and with what is prescribed, over a step.

    Attributes:
        work: Of their forces along the chords of their points, [B, K] J.
        pressure: Sum of the sizes of the forces on each body, [B, K] N.
        reach: Distance at which contact begins, [B or 1, 1] m.
        groups: Which bodies share their bound, [B, K, K]; no row of a body that has none.
        held: Whether something prescribed touches the group, which takes any momentum; [B, K].
    """

    work: Tensor
    pressure: Tensor
    reach: Tensor
    groups: Tensor
    held: Tensor


def predict_bodies(
    poses: Tensor,
    velocities: Tensor,
    inertia: BodyInertia,
    wrenches: Tensor,
    gravity: Tensor,
    dt: float,
    names: Sequence[str] = (),
) -> BodyPrediction:
    """Take a step without contact.

    Args:
        poses: Of the body frames, [B, K, 7].
        velocities: Of the centers, then of rotation, in world axes; [B, K, 6].
        inertia: What the bodies weigh.
        wrenches: Forces at the centers and torques, in world axes; [B, K, 6].
        gravity: [B or 1, 3] m/s^2.
        dt: h [s].
        names: Of the bodies, for messages.
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
    turn, is_found = free_turns(inertia.inertia, momentum, dt)
    omega = solve(inertia.inertia.expand(*spin.shape, 3), momentum)
    if not is_found.all():
        refuse_turns(~is_found, omega.detach().norm(dim=-1), dt, _MOST_TURN, "may", names)
    predicted = quaternion_multiply(quaternion, turn)
    turned = quaternion_matrix(predicted)
    moments = turned @ inertia.inertia @ turned.transpose(-1, -2)
    zeros = torch.zeros_like(spin)
    mass = inertia.mass[..., None, None] * torch.eye(3, dtype=moments.dtype)
    mass, none = mass.expand_as(moments), torch.zeros_like(moments)
    metric = torch.cat([torch.cat([mass, none], -1), torch.cat([none, moments], -1)], dim=-2)
    return BodyPrediction(
        frames=torch.cat([-times(turned, inertia.center), predicted], dim=-1),
        coordinates=torch.cat([center, -times(rotation, quaternion_log(turn))], dim=-1),
        target=torch.cat([center + dt * speed, zeros], dim=-1),
        metric=metric / dt**2,
        inertia=inertia,
        poses=poses,
        velocities=velocities[..., :3],
        momentum=times(rotation, momentum),
        spin_energy=(momentum * omega).sum(-1) / 2,
        speed=omega.detach().norm(dim=-1),
    )


def refuse_turns(
    lost: Tensor, speed: Tensor, dt: float, most: float, how: str, names: Sequence[str]
) -> None:
    """Say which bodies turn too far in a step.

    Args:
        lost: Which, [B, K]; at least one.
        speed: Of rotation, [B, K] rad/s.
        dt: h [s].
        most: Largest turn in a step [rad].
        how: When that holds.
        names: Of the bodies.

    Raises:
        SimulationError: With all environments, and the first body.
    """
    environments = lost.any(-1).nonzero()[:, 0].tolist()
    first, body = lost.nonzero()[0].tolist()
    name = f"body {names[body]!r}" if names else f"body {body}"
    rate = float(speed[first, body])
    raise SimulationError(
        f"step: {name} turns at {rate:.3g} rad/s, too fast for a time step of {dt:g} s: it {how} "
        f"turn by {most:g} rad in a step; take a time step of at most {most / rate:.2g} s",
        environments=environments,
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
    prediction: BodyPrediction,
    coordinates: Tensor,
    kick: Tensor | None,
    dt: float,
    contact: BodyContact | None = None,
) -> tuple[Tensor, Tensor]:
    """Poses [B, K, 7] and velocities [B, K, 6] after a step.

    Args:
        prediction: Of the step.
        coordinates: At its end, [B, K, 6].
        kick: Forces at the centers and torques that change velocities only, [B, K, 6].
        dt: h [s].
        contact: What bounds the energy that the forces of the step may give; None bounds nothing.
    """
    inertia = prediction.inertia
    mass = inertia.mass[..., None]
    center, turn = torch.split(coordinates, 3, dim=-1)
    predicted = prediction.frames[..., 3:]
    quaternion = quaternion_multiply(quaternion_exp(turn), predicted)
    rotation = quaternion_matrix(quaternion)
    back = rotation.transpose(-1, -2)
    moment = times(prediction.metric[..., 3:, 3:], turn)
    impulse = dt * torque_from_moment(turn, moment)
    rate = (center - prediction.coordinates[..., :3]) / dt

    def spin_of(momentum: Tensor) -> Tensor:
        local = solve(inertia.inertia.expand_as(rotation), times(back, momentum))
        return times(rotation, local)

    velocity = torch.cat([rate, spin_of(prediction.momentum + impulse)], dim=-1)
    if contact is not None:
        velocity = _bounded(prediction, contact, velocity, turn, impulse, spin_of, dt)
    if kick is not None:
        kick = kick.expand_as(velocity)
        more = torch.cat([kick[..., :3] / mass, spin_of(kick[..., 3:])], dim=-1)
        velocity = velocity + dt * more
    sign = nearer_quaternion(quaternion, prediction.poses[..., 3:])
    poses = torch.cat([center - times(rotation, inertia.center), sign], dim=-1)
    return poses, velocity


def _bounded(
    prediction: BodyPrediction,
    contact: BodyContact,
    velocity: Tensor,
    turn: Tensor,
    impulse: Tensor,
    spin_of: Callable[[Tensor], Tensor],
    dt: float,
) -> Tensor:
    """Velocities after a step with no more energy than contact can have given, [B, K, 6].

    Args:
        prediction: Of the step.
        contact: What bounds it.
        velocity: With all that contact gives, [B, K, 6].
        turn: w, [B, K, 3].
        impulse: Of its torque, [B, K, 3].
        spin_of: From angular momenta to angular velocities at the end.
        dt: h [s].
    """

    def of_group(values: Tensor) -> Tensor:
        return ordered_sum(contact.groups * values[..., None, :])

    def spin_energy(momentum: Tensor, spin: Tensor) -> Tensor:
        return (momentum * spin).sum(-1) / 2

    def kinetic(velocity: Tensor, momentum: Tensor) -> Tensor:
        linear = (mass * velocity[..., :3].square()).sum(-1) / 2
        return linear + spin_energy(momentum, velocity[..., 3:])

    mass = prediction.inertia.mass[..., None]
    # Force and torque of contact over the step, and what they change.
    rate, before = velocity[..., :3], prediction.velocities
    push = mass * (dt * rate - (prediction.target - prediction.coordinates)[..., :3]) / dt
    impulses = torch.cat([push, impulse], dim=-1)
    change = torch.cat([push / mass, spin_of(impulse)], dim=-1)
    resistance = of_group((impulses * change).sum(-1))

    # Of translation the work of all forces along the chord is in it, less what the step damps.
    worked = (push * rate).sum(-1) - (mass * (rate - before).square()).sum(-1) / 2
    momentum, full = prediction.momentum, prediction.momentum + impulse
    gained = worked + spin_energy(full, velocity[..., 3:]) - prediction.spin_energy
    steady = (prediction.target - prediction.coordinates)[..., :3] / dt - before
    weight = prediction.inertia.mass * steady.norm(dim=-1) / dt
    pressed = of_group(contact.pressure)
    stored = _STORED * contact.reach * (pressed - of_group(weight))
    had = (mass * before.square()).sum(-1) / 2 + prediction.spin_energy
    bound = torch.maximum(of_group(contact.work), -stored) + _GAIN * of_group(had)
    excess = of_group(gained) - bound
    refused = excess > 0
    if not refused.any():
        return velocity
    excess = torch.where(refused, excess, 0.0)

    # The other end: L goes with the body's turn, and nothing moves along the impulses.
    held = contact.held
    carried = torch.where(held[..., None], rotate(quaternion_exp(turn), momentum), momentum)
    taken = torch.cat([rate, spin_of(carried + impulse)], dim=-1)
    along = of_group((impulses * taken).sum(-1)).clamp(min=0)
    refused = refused & (resistance > 0)
    share = torch.where(refused, along, 0.0) / torch.where(refused, resistance, 1.0)
    least = taken - share[..., None] * change
    left = carried + (1 - share[..., None]) * impulse
    # Its spin pays for what is stored, where nothing else does.
    energy = kinetic(velocity, full)
    saved = of_group(energy - kinetic(least, left))
    soft = _SOFT * _STORED * contact.reach * pressed
    spin = of_group(spin_energy(left, least[..., 3:]))
    debt = (excess + soft - saved).clamp(min=0)
    paying = refused & held & (spin > 0)
    slower = 1 - (torch.where(paying, debt, 0.0) / torch.where(paying, spin, 1.0)).clamp(max=1)
    least = torch.cat([least[..., :3], slower[..., None] * least[..., 3:]], dim=-1)
    saved = of_group(energy - kinetic(least, slower[..., None] * left))

    whole = excess + torch.maximum(saved - excess, soft)
    part = excess / torch.where(refused, whole, 1.0)
    return velocity + torch.where(refused, part, 0.0)[..., None] * (least - velocity)
