"""A robot over one step: its free motion, and its state after the step is solved.

**Prediction.** A step without contact, drives and limits follows the variational integrator with
the discrete Lagrangian h T(q_mid, nu) - h V(q_n): kinetic energy at the middle of the step, with
constant velocities nu along it. With the momentum p(q, nu) = M nu and the slope s = dT/dq,

    p(q_mid, nu) - h/2 s(q_mid, nu) = M(q_n) nu_n + h tau(q_n),
    M(q_n+1) nu_n+1 = p(q_mid, nu) + h/2 s(q_mid, nu),

where tau are gravity, wrenches and efforts. Velocity products are thus implicit, and the scheme is
symplectic: a free robot neither gains nor loses energy in the long run. Iterations that start at
nu_n and M(q_n) solve the first line. The velocity of a base or joint with prescribed motion is
known.

The objective of the core is quadratic about that motion, with the metric M(q_n+1)/h^2. A robot that
is held at rest instead would not feel its exact weight, but the weight with the velocity products
of the fall, a relative error of hundredths, of the order of h^2. M is therefore changed slightly:
see `add_change_at_rest` in `csrc/bodies/robot_prediction.cpp`, where all these equations are
evaluated.

**Advance.** After the step the velocities nu over it follow from its two ends, and the second line
yields nu_n+1. A robot that did not move has no velocity, whatever holds it. If motion is
prescribed, nu_n+1 is nu, and tau lacks an effort tau_c. Both lines together, with the forces f of
contact, yield this effort from the change of momentum:

    M(q_n+1) nu_n+1 - M(q_n) nu_n = h (s(q_mid, nu) + tau(q_n) + f(q_n+1) + tau_c).

The rows of a floating root belong to the whole robot, without any tau_c: they determine nu_n+1
of the root, with the f for which the solve moved the root from the prediction. The metric of the
solve differs from M along the path, and by this difference the joints would add momentum to the
robot.

**Drives.** A joint under `pd` adds to the objective, with q_n its value at the start of the step,

    1/2 kp (q - q_t)^2 + kd/(2h) (q - q_n - h qd_t)^2 + d/(2h) (q - q_n)^2,

so its drive acts at the end of the step, implicitly and without a bound on the gains. Under
`torque` there is only the last term, the joint's own viscosity.

Such a drive exerts any effort a that its gains require. With a limit L it exerts only

    s(a) = a for |a| <= 0.9 L,    sign(a) (0.9 L + 0.1 L r / sqrt(1 + r^2)) beyond,

with the excess r = (|a| - 0.9 L) / (0.1 L). This function has two continuous derivatives, and its
slope never vanishes. The missing effort a - s(a) is part of the term of a joint, which the solver
evaluates (see csrc/bodies/joint_term.h), as are a limit of the speed and Coulomb friction.

**At rest.** A step to an equilibrium is long, and tau(q_n) would move the robot far away in it.
Such a step predicts no motion; it treats tau(q_n) as a force and adds a stiffness of the weight to
M/h^2: see csrc/bodies/weight_stiffness.h.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.autograd.core_function import NO_CONSTANTS, Constant
from diffcloth_torch.checks import LARGEST
from diffcloth_torch.dynamics.functions import outputs_of, robot_functions
from diffcloth_torch.dynamics.inertia import ROOT, Inertia, rigid_totals
from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.dynamics.totals import Totals, ordered_sum
from diffcloth_torch.geometry.rotation import pose_velocities, quaternion_matrix
from diffcloth_torch.model.kinematics import Links, constant, pose_frame
from diffcloth_torch.model.mechanism import Mechanism

__all__ = ["Bounds", "Gains", "RobotControl", "RobotDynamics", "RobotPrediction", "RobotState"]


class RobotState(NamedTuple):
    """State of a robot.

    Attributes:
        pose: Pose of the root's frame, [B, 7].
        velocity: Velocity of the root's center of mass, then angular velocity, in world axes;
            [B, 6].
        joints: Values of the joints [rad or m], [B, J].
        rates: Their velocities, [B, J].
    """

    pose: Tensor
    velocity: Tensor
    joints: Tensor
    rates: Tensor


class RobotControl(NamedTuple):
    """Targets and forces of a robot over a step, used as its base and its joints require.

    Attributes:
        pose: Pose of the root's frame at the end, [B, 7].
        wrench: Force at the root's center of mass and torque, in world axes; [B, 6].
        joints: Targets of the joints [rad or m], [B, J].
        rates: Targets of their velocities, [B, J].
        efforts: Efforts at the joints [N m or N], [B, J].
    """

    pose: Tensor
    wrench: Tensor
    joints: Tensor
    rates: Tensor
    efforts: Tensor


class Gains(NamedTuple):
    """Gains of each joint, [B or 1, J].

    Attributes:
        stiffness: kp [N m/rad or N/m].
        damping: kd [N m s/rad or N s/m].
        viscosity: d of the joint itself, in the same unit.
    """

    stiffness: Tensor
    damping: Tensor
    viscosity: Tensor


class Bounds(NamedTuple):
    """Limits and resistance of each joint, [B or 1, J].

    Attributes:
        efforts: L [N m or N].
        velocities: Largest speed [rad/s or m/s].
        friction: Coulomb friction [N m or N].
        slip_rates: Speed at which sticking turns into sliding [rad/s or m/s].
    """

    efforts: Tensor
    velocities: Tensor
    friction: Tensor
    slip_rates: Tensor


class RobotPrediction(NamedTuple):
    """The prediction of a robot, for the core and for `RobotDynamics.advance`.

    Attributes:
        root_start: Frame of the root for the core at the start of the step, [B, 7].
        root_end: Likewise at the end; the same if the base floats.
        coordinates: Coordinates at the start, [B, n].
        ends: Coordinates at the end if they are prescribed, [B, n].
        target: t, [B, n].
        metric: A, [B, n, n].
        terms: Rows of the core's joint terms, [B, n, 7]; None if the scene has none.
        velocity: nu over the step, [B, 6 + J].
        known: nu if it is prescribed, zero elsewhere; [B, 6 + J].
        given: M(q_n) nu_n + h tau(q_n), [B, 6 + J].
        lost: Mask of environments without such a motion, as the robot is too fast for the time
            step; the robot then stays in place; [B].
        inputs: Arrays that the core's functions of prediction and `advance` share.
        constants: Constants among them.
    """

    root_start: Tensor
    root_end: Tensor
    coordinates: Tensor
    ends: Tensor
    target: Tensor
    metric: Tensor
    terms: Tensor | None
    velocity: Tensor
    known: Tensor
    given: Tensor
    lost: Tensor
    inputs: dict[str, Tensor]
    constants: Mapping[str, Constant]


class RobotDynamics:
    """A robot: a mechanism with actuated joints.

    Attributes:
        mechanism: Its links and joints.
        coordinate_count: n: six of a floating base, then the J joints.
        prescribed: Mask of prescribed coordinates, [n].
        root: The root link.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        dt: float,
        links: Tensor,
        points: Tensor,
        weight: str | None = None,
    ) -> None:
        """Prepare the constants.

        Args:
            mechanism: Links and joints.
            dt: Time step [s].
            links: Index of the link of each vertex that may be in contact, shape [V].
            points: These vertices, in the frames of their links [m], shape [V, 3].
            weight: As for `Dynamics`.
        """
        self.mechanism, self._dt = mechanism, dt
        self._links = Links(mechanism)
        self.root = mechanism.root
        self._prescribed = torch.from_numpy(~mechanism.forced)
        base = cpu.zeros(ROOT * (mechanism.base == "floating"), dtype=torch.bool)
        self.prescribed = torch.cat([base, self._prescribed])
        self.coordinate_count = len(self.prescribed)
        self._prediction, self._advance = robot_functions(
            mechanism,
            dt,
            links,
            points,
            LARGEST,
            is_at_rest=weight is not None,
            bounds_weight=weight == "bounded",
        )
        self._own_inertia = None if mechanism.is_dynamic else _inertia_of_prescribed(mechanism)

    def predict(
        self,
        state: RobotState,
        control: RobotControl,
        inertia: Inertia,
        gains: Gains,
        gravity: Tensor,
        contact: Tensor | None = None,
        bounds: Bounds | None = None,
        origins: Tensor | None = None,
        constants: Mapping[str, Constant] = NO_CONSTANTS,
    ) -> RobotPrediction:
        """Predict a step without contact, limits and drives of the joints.

        Args:
            state: State at the start.
            control: Targets and forces.
            inertia: Masses and inertias of links and joints.
            gains: Gains of the joints.
            gravity: [B or 1, 3] m/s^2.
            contact: Forces on the vertices that act like the wrenches, [B, V, 3] N.
            bounds: Limits and friction of the joints; None if no joint of the scene can have any.
            origins: Values of the joints from which friction measures motion, [B, J]; by default
                the values at the start.
            constants: As for `outputs_of`: `parameters` of the scene.
        """
        of_both, of_prediction = self._named(inertia, gains, bounds, gravity)
        shared = {
            **of_both,
            "targets": control.joints,
            "target_rates": control.rates,
            "efforts": control.efforts,
            "pose": state.pose,
            "joints": state.joints,
        }
        own = {
            "velocity": state.velocity,
            "rates": state.rates,
            "end_pose": control.pose,
            "wrench": control.wrench,
            **of_prediction,
        }
        if contact is not None:
            own["contact"] = contact
        if origins is not None:
            own["origins"] = origins
        found = outputs_of(self._prediction, shared | own, constants)
        terms, lost = found.pop("terms"), found.pop("lost")
        return RobotPrediction(
            **found,
            terms=None if bounds is None else terms,
            lost=lost.detach() > 0,
            inputs=shared,
            constants=constants,
        )

    def parameters(
        self, inertia: Inertia, gains: Gains, bounds: Bounds | None, gravity: Tensor
    ) -> dict[str, Tensor]:
        """Parameters by the names of the core's functions; arguments as for `predict`."""
        of_both, of_prediction = self._named(inertia, gains, bounds, gravity)
        return of_both | of_prediction

    def _named(
        self, inertia: Inertia, gains: Gains, bounds: Bounds | None, gravity: Tensor
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Parameters of both functions of the core, and further ones of the prediction."""
        inertia = inertia if self._own_inertia is None else self._own_inertia
        of_both, of_prediction = {**inertia._asdict(), **gains._asdict()}, {"gravity": gravity}
        if bounds is not None:
            of_both["effort_limits"] = bounds.efforts
            of_prediction["velocity_limits"] = bounds.velocities
            of_prediction["friction"] = bounds.friction
            of_prediction["slip_rates"] = bounds.slip_rates
        return of_both, of_prediction

    def end_at(self, prediction: RobotPrediction, pose: Tensor) -> RobotPrediction:
        """Change a prediction so that a prescribed base ends at another pose, [B, 7]."""
        if self.mechanism.base != "kinematic":
            return prediction
        center = prediction.inputs["center"][..., self.root, :]
        start = _placed(prediction.inputs["pose"], center)
        root = pose_velocities(start, _placed(pose, center), self._dt)
        known = torch.cat([root, prediction.known[..., ROOT:]], dim=-1)
        return prediction._replace(root_end=pose, known=known)

    def advance(
        self,
        prediction: RobotPrediction,
        coordinates: Tensor,
        contact: Tensor,
        kick: Tensor | None = None,
    ) -> tuple[RobotState, Tensor]:
        """Return the state after a step, and the efforts on the joints [B, J] during it.

        Args:
            prediction: Prediction of the step.
            coordinates: Coordinates at its end, [B, n].
            contact: Forces on the vertices in the solution of the step, [B, V, 3] N.
            kick: Further forces, which change velocities only.
        """
        own = {
            "root_end": prediction.root_end,
            "coordinates": prediction.coordinates,
            "known": prediction.known,
            "given": prediction.given,
            "target": prediction.target,
            "metric": prediction.metric,
            "reached": coordinates,
            "contact": contact,
        }
        if kick is not None:
            own["kick"] = kick
        found = outputs_of(self._advance, prediction.inputs | own, prediction.constants)
        joints = coordinates[..., self.coordinate_count - self.mechanism.joint_count :]
        after = RobotState(found["pose"], found["velocity"], joints, found["rates"])
        return after, found["efforts"]

    def joint_weights(self, state: RobotState, inertia: Inertia, gravity: Tensor) -> Tensor:
        """Generalized forces of the weight at the joints, [B, J] N m or N; zero if not dynamic.

        Args:
            state: State of the robot; its velocities are ignored.
            inertia: Masses and inertias of links and joints.
            gravity: [B or 1, 3] m/s^2.
        """
        if not self.mechanism.is_dynamic:
            return torch.zeros_like(state.joints)
        weights = inertia.mass[..., None] * gravity[..., None, :]
        root = pose_frame(state.pose)
        return self._links.efforts(root, state.joints, inertia.center, weights)

    def totals(self, state: RobotState, inertia: Inertia, gravity: Tensor) -> Totals:
        """Momentum and energy of a state; zero if the robot is not dynamic.

        Args:
            state: State of the robot.
            inertia: Masses and inertias of links and joints.
            gravity: [B or 1, 3] m/s^2.
        """
        if not self.mechanism.is_dynamic:
            return Totals.zero(len(state.pose))
        inertia = self._acting(inertia)
        root, at = pose_frame(state.pose), (state.joints, inertia.center)
        velocity = state.velocity
        if self.mechanism.base == "fixed":
            velocity = torch.zeros_like(velocity)
        velocities = self._links.velocities(root, *at, velocity, state.rates)
        frames = self._links.frames(root, state.joints)
        mass, center, moments, armature = inertia
        totals = rigid_totals(frames, velocities, mass, center, moments, gravity)
        if not self.mechanism.joint_count:
            return totals
        drives = ordered_sum(armature * state.rates**2) / 2
        return totals._replace(kinetic_energy=totals.kinetic_energy + drives)

    # Constituents

    def _acting(self, inertia: Inertia) -> Inertia:
        """Inertia that takes part in motion, without the drives of prescribed joints.

        Parameters have no masses of robots that are not dynamic.
        """
        if self._own_inertia is not None:
            return self._own_inertia
        return inertia._replace(armature=~self._prescribed * inertia.armature)

    def too_fast(self, prediction: RobotPrediction) -> dict[int, str]:
        """Environments without a free motion -> a sentence."""
        sentence = (
            f"the velocities of robot {self.mechanism.name!r} are too large for a time step of "
            f"{self._dt:g} s; no joint, and no base, may turn by more than half a turn in it"
        )
        return dict.fromkeys(prediction.lost.nonzero()[:, 0].tolist(), sentence)


def _inertia_of_prescribed(mechanism: Mechanism) -> Inertia:
    """Inertia for the efforts of prescribed joints of a robot that is not dynamic.

    No joint carries the root link. Without a mass there, the velocities of such a root refer to its
    frame's origin.
    """
    center = np.where(
        np.arange(mechanism.link_count)[:, None] == mechanism.root, 0, mechanism.center
    )
    arrays = (mechanism.mass, center, mechanism.inertia, np.zeros(mechanism.joint_count))
    return Inertia(*(constant(array)[None] for array in arrays))


def _placed(pose: Tensor, local: Tensor) -> Tensor:
    """Pose [.., 7] of a link's center of mass, from its frame's pose; the quaternion is unit."""
    quaternion = torch.nn.functional.normalize(pose[..., 3:], dim=-1)
    center = pose[..., :3] + times(quaternion_matrix(quaternion), local)
    return torch.cat([center, quaternion], dim=-1)
