"""Free rigid bodies over one step, all of them at once.

A free body follows Euler's equations to rounding. With the angular momentum L about the center, in
world axes, and the inertia J in body axes, it keeps L + h torque and turns by a rotation Q that the
core computes, R_pred = R_n Q. Its coordinates are the center c and the rotation vector w with R =
exp(w) R_pred; the core adds the inertia 1/(2h^2) (m |c - c^|^2 + w^T I w) about the prediction to
its objective. At the solution its gradient balances the contact force, which determines the
momentum of the body after the step: contact conserves the total momentum.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from torch import Tensor

from diffcloth_torch.autograd.core_function import NO_CONSTANTS, Constant
from diffcloth_torch.dynamics.functions import body_functions, outputs_of
from diffcloth_torch.dynamics.inertia import rigid_totals
from diffcloth_torch.dynamics.totals import Totals
from diffcloth_torch.errors import TurnedTooFar
from diffcloth_torch.model.kinematics import pose_frame
from diffcloth_torch.operations import operation

__all__ = [
    "MOST_TURN_IN_CONTACT",
    "BodyInertia",
    "BodyPrediction",
    "advance_bodies",
    "body_totals",
    "predict_bodies",
    "turn_sentence",
]

# Largest turn [rad] of a body in a step: for free motion, because the core's series would get long;
# and in contact before or after the step, because contact at its end does not describe the path
# there and adds energy to a body that turns further.
_MOST_TURN = 1e3
MOST_TURN_IN_CONTACT = 1.0


class BodyInertia(NamedTuple):
    """Mass [B or 1, K] kg; center [.., K, 3] m and inertia [.., K, 3, 3] kg m^2 in body axes."""

    mass: Tensor
    center: Tensor
    inertia: Tensor


class BodyPrediction(NamedTuple):
    """The prediction of bodies, for the core and for `advance_bodies`.

    Attributes:
        frames: Frames that the core turns and shifts by the coordinates; poses [B, K, 7].
        coordinates: Coordinates at the start, [B, K, 6].
        target: t, [B, K, 6].
        metric: A, [B, K, 6, 6].
        momentum: Angular momentum without contact, [B, K, 3].
        speed: Speed of rotation at the start with that momentum, [B, K] rad/s.
        inputs: Masses, centers, inertias and poses at the start, as for the core's functions.
        constants: Constants among them.
    """

    frames: Tensor
    coordinates: Tensor
    target: Tensor
    metric: Tensor
    momentum: Tensor
    speed: Tensor
    inputs: dict[str, Tensor]
    constants: Mapping[str, Constant]


def predict_bodies(
    poses: Tensor,
    velocities: Tensor,
    inertia: BodyInertia,
    wrenches: Tensor,
    gravity: Tensor,
    dt: float,
    names: Sequence[str] = (),
    constants: Mapping[str, Constant] = NO_CONSTANTS,
) -> BodyPrediction:
    """Predict a step without contact.

    Args:
        poses: Poses of the body frames, [B, K, 7].
        velocities: Velocities of the centers, then angular ones, in world axes; [B, K, 6].
        inertia: Masses, centers and inertias of the bodies.
        wrenches: Forces at the centers and torques, in world axes; [B, K, 6].
        gravity: [B or 1, 3] m/s^2.
        dt: h [s].
        names: Names of the bodies, for messages.
        constants: As for `outputs_of`.
    """
    shared = {
        "mass": inertia.mass,
        "center": inertia.center,
        "inertia": inertia.inertia,
        "poses": poses,
    }
    own = {"velocities": velocities, "wrenches": wrenches, "gravity": gravity}
    prediction, _ = body_functions(poses.shape[-2], dt)
    found = outputs_of(prediction, shared | own, constants)
    speed = found.pop("speed").detach()
    is_found = found.pop("found").detach() > 0
    if not is_found.all():
        _refuse_turns(~is_found, speed, dt, names)
    return BodyPrediction(**found, speed=speed, inputs=shared, constants=constants)


def turn_sentence(name: str, speed: float, dt: float, most: float, how: str) -> str:
    """Make a sentence about a body that turns too far in a step.

    Args:
        name: Name of the body.
        speed: Speed of rotation [rad/s].
        dt: h [s].
        most: Largest turn in a step [rad].
        how: Condition under which that limit applies.
    """
    enough = 0.99 * most / speed  # stays below the limit when rounded in the message
    return (
        f"{name} turns at {speed:.3g} rad/s, too fast for a time step of {dt:g} s: it {how} "
        f"turn by {most:g} rad in a step; take a time step of at most {enough:.3g} s"
    )


def _refuse_turns(lost: Tensor, speed: Tensor, dt: float, names: Sequence[str]) -> None:
    """Raise an error for bodies whose free turn has no solution, [B, K]; at least one is true."""
    first, body = lost.nonzero()[0].tolist()
    name = f"body {names[body]!r}" if names else f"body {body}"
    sentence = turn_sentence(name, float(speed[first, body]), dt, _MOST_TURN, "may")
    environments = lost.any(-1).nonzero()[:, 0].tolist()
    raise TurnedTooFar(f"{operation()}: {sentence}", environments=environments)


def body_totals(poses: Tensor, velocities: Tensor, inertia: BodyInertia, gravity: Tensor) -> Totals:
    """Momentum and energy of all bodies.

    Args:
        poses: Poses of the body frames, [B, K, 7].
        velocities: Velocities of the centers, then angular ones, in world axes; [B, K, 6].
        inertia: Masses, centers and inertias of the bodies.
        gravity: [B or 1, 3] m/s^2.
    """
    return rigid_totals(pose_frame(poses), velocities, *inertia, gravity)


def advance_bodies(
    prediction: BodyPrediction, coordinates: Tensor, kick: Tensor | None, dt: float
) -> tuple[Tensor, Tensor]:
    """Poses [B, K, 7] and velocities [B, K, 6] after a step.

    Args:
        prediction: Prediction of the step.
        coordinates: Coordinates at its end, [B, K, 6].
        kick: Forces at the centers and torques that change velocities only, [B, K, 6].
        dt: h [s].
    """
    _, advance = body_functions(coordinates.shape[-2], dt)
    own = {
        "frames": prediction.frames,
        "coordinates": prediction.coordinates,
        "metric": prediction.metric,
        "momentum": prediction.momentum,
        "reached": coordinates,
    }
    if kick is not None:
        own["kick"] = kick
    found = outputs_of(advance, prediction.inputs | own, prediction.constants)
    return found["poses"], found["velocities"]
