"""A robot over one step: its motion by itself, and its state after the step is solved.

**Prediction.** A step without contact, drives and limits is that of the variational integrator with
the discrete Lagrangian h T(q_mid, nu) - h V(q_n): kinetic energy at the middle of the step, with
constant velocities nu along it. With the momentum p(q, nu) = M nu and the slope s = dT/dq,

    p(q_mid, nu) - h/2 s(q_mid, nu) = M(q_n) nu_n + h tau(q_n),
    M(q_n+1) nu_n+1 = p(q_mid, nu) + h/2 s(q_mid, nu),

where tau are gravity, wrenches and efforts. Velocity products are thus implicit, and the scheme is
symplectic: by itself a robot neither gains nor loses energy in the long run. Iterations that start
at nu_n and M(q_n) solve the first line. The velocity of a base or joint with prescribed motion is
known.

The objective of the core is quadratic about that motion, with the metric M(q_n+1)/h^2. A robot that
something holds at rest instead would not feel its weight there, but that and velocity products of
the fall: hundredths of it, of the order of h^2. So M changes a little: see `_change_at_rest`.

**Advance.** After the step the velocities nu over it follow from its two ends, and the second
line turns them into nu_n+1. A robot that did not move has no velocity, whatever holds it. If motion
is prescribed, nu_n+1 is nu, and tau lacks an effort tau_c. Both lines together, with the forces f
of contact, give this effort from the change of momentum:

    M(q_n+1) nu_n+1 - M(q_n) nu_n = h (s(q_mid, nu) + tau(q_n) + f(q_n+1) + tau_c).

**At rest.** A step that looks for an equilibrium is long, and tau(q_n) would lead far away in it.
Such a step predicts no motion; it counts tau(q_n) as a force and adds a stiffness of the weight to
M/h^2: see `weights.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import LARGEST
from diffcloth_torch.dynamics.drives import (
    Bounds,
    Drives,
    Gains,
    fold,
    idle_terms,
    joint_terms,
    limited_effort,
)
from diffcloth_torch.dynamics.free_motion import robot_motion, solve_motion
from diffcloth_torch.dynamics.implicit import attach_root, jacobian_of
from diffcloth_torch.dynamics.inertia import (
    Inertia,
    Motion,
    generalized_force,
    link_momenta,
    mass_matrix,
    momentum,
    slope,
    wrenches_of_forces,
)
from diffcloth_torch.dynamics.jacobians import ROOT, DifferentialKinematics, root_frame
from diffcloth_torch.dynamics.linear import solve, times
from diffcloth_torch.dynamics.totals import Totals, ordered_sum
from diffcloth_torch.dynamics.weights import WeightBound
from diffcloth_torch.geometry.products import product
from diffcloth_torch.geometry.rotation import (
    nearer_quaternion,
    pose_velocities,
    quaternion_exp,
    quaternion_log,
    quaternion_matrix,
    quaternion_multiply,
    rotation_exp,
)
from diffcloth_torch.model.kinematics import constant, pose_frame
from diffcloth_torch.model.mechanism import Mechanism
from diffcloth_torch.transforms import outside_transforms, plain

__all__ = ["RobotControl", "RobotDynamics", "RobotPrediction", "RobotState"]

# Turn in a step [rad] beyond which a motion over it is not the only one, and energy is not kept.
_MOST_TURN = math.pi
# Turn in a step [rad] that a fall must exceed to count as one.
_LITTLE_TURN = 1e-6


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
        inertia: Masses and inertias of links and joints.
        drives: Gains and targets of the joints.
        start: Configuration of the robot at the start.
        pose: Pose of its root's frame at the start, [B, 7].
        known: nu if it is prescribed, zero elsewhere; [B, 6 + J].
        given: M(q_n) nu_n + h tau(q_n), [B, 6 + J].
        lost: Which environments have no such motion, as the robot is too fast for the time step: it
            stays where it is there; [B].
    """

    root_start: Tensor
    root_end: Tensor
    coordinates: Tensor
    ends: Tensor
    target: Tensor
    metric: Tensor
    terms: Tensor | None
    inertia: Inertia
    drives: Drives
    start: _Configuration
    pose: Tensor
    known: Tensor
    given: Tensor
    lost: Tensor


class _Configuration(NamedTuple):
    """Center of mass [B, 3] and orientation [B, 3, 3] of the root link, joints [B, J]."""

    center: Tensor
    rotation: Tensor
    joints: Tensor


class RobotDynamics:
    """A robot: a mechanism with actuated joints.

    Attributes:
        mechanism: Its links and joints.
        coordinate_count: n: six of a floating base, then the J joints.
        prescribed: Which of the coordinates are prescribed, [n].
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
        self.mechanism, self._kinematics, self._dt = (
            mechanism,
            DifferentialKinematics(mechanism),
            dt,
        )
        self.root = self._kinematics.root
        self._links, self._points = links, points
        self._floats = mechanism.base == "floating"
        joints = mechanism.joint_count
        self.coordinate_count = joints + ROOT * self._floats

        prescribed = ~mechanism.forced
        self._prescribed = torch.from_numpy(prescribed)
        base = torch.zeros(ROOT * self._floats, dtype=torch.bool)
        self.prescribed = torch.cat([base, self._prescribed])
        self._modes = {
            mode: torch.tensor([m == mode for m in mechanism.actuation], dtype=torch.float64)
            for mode in ("position", "velocity", "pd")
        }
        # The unknowns, among the entries of nu and among the coordinates.
        first = ROOT - ROOT * self._floats
        solved = [i for i in range(ROOT + joints) if i < ROOT or not prescribed[i - ROOT]]
        self._solved = torch.tensor([i for i in solved if i >= first], dtype=torch.long)
        self._unknown = self._solved - first
        # Radians of each link by the joints that forces move, [A, J].
        kinematics = self._kinematics
        self._turns = kinematics.revolute * kinematics.leaders[0] * ~self._prescribed
        # Joints whose fall turns links. What floats falls as a whole, without turning.
        turning = ROOT + torch.nonzero(self._turns.any(0))[:, 0]
        self._turning = turning[:0] if self._floats else turning
        self._free_motion = robot_motion(mechanism, self._solved, dt)
        self._weight = weight
        self._weight_bound = WeightBound(self._kinematics) if weight == "bounded" else None
        # Without joints, nobody needs the efforts that hold a prescribed base.
        self._has_dynamics = mechanism.is_dynamic or joints > 0
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
            origins: Values of the joints from which friction counts motion, [B, J]; those at the
                start by default.
        """
        drives = self._drives(gains, control, bounds)
        inertia = self._acting(inertia)
        local = inertia.center[..., self._kinematics.root, :]
        quaternion = torch.nn.functional.normalize(state.pose[..., 3:], dim=-1)
        start = _Configuration(*_placed(state.pose[..., :3], quaternion, local), state.joints)
        known, ends = self._prescribed_motion(start, quaternion, control, local)

        velocity = given = known
        if self._has_dynamics:
            here = self._motion(inertia, start)
            given = self._given(inertia, here, state, control, drives, gravity, contact)
        lost = torch.zeros(len(state.joints), dtype=torch.bool)
        if len(self._solved) and self._weight is None:
            velocity, lost = self._solve(inertia, start, known, given)
        end = self._moved(start, velocity, self._dt)
        joints = torch.where(self._prescribed, ends, end.joints)
        coordinates, free = state.joints, joints
        root_start, root_end = state.pose, state.pose
        if self.mechanism.base == "kinematic":
            root_end = control.pose
        if self._floats:
            turn = self._dt * velocity[..., 3:ROOT]
            coordinates = torch.cat([start.center, -turn, state.joints], dim=-1)
            free = torch.cat([end.center, torch.zeros_like(turn), joints], dim=-1)
            ends = torch.cat([coordinates[..., :ROOT], ends], dim=-1)
            predicted = quaternion_multiply(quaternion_exp(turn), quaternion)
            offset = -times(end.rotation, local)
            root_start = root_end = torch.cat([offset, predicted], dim=-1)
        mass, force = self._mass(inertia, end), None
        if len(self._turning) and self._weight is None:
            change = self._change_at_rest(inertia, start, mass, velocity, known, given, state)
            change = torch.where(lost[:, None, None], 0.0, change)
            columns = torch.zeros_like(mass[..., self._solved])
            mass = mass.index_add(-1, self._solved, columns.index_add(-2, self._solved, change))
        rows = slice(mass.shape[-1] - self.coordinate_count, None)
        inertial = mass[..., rows, rows] / self._dt**2
        if len(self._solved) and self._weight is not None:
            inertial = inertial + self._weight_stiffness(inertia, start, gravity)[..., rows, rows]
            force = (given / self._dt)[..., rows]
        metric, target = fold(drives, inertial, free, state.joints, self._dt, self._unknown, force)
        terms = None
        if bounds is not None:
            slid_from = state.joints if origins is None else origins
            of_joints = joint_terms(drives, bounds, state.joints, slid_from, self._dt)
            roots = coordinates.shape[-1] - state.joints.shape[-1]
            terms = torch.cat([idle_terms(of_joints, roots), of_joints], dim=1)
        return RobotPrediction(
            root_start=root_start,
            root_end=root_end,
            coordinates=coordinates,
            ends=ends,
            target=target,
            metric=metric,
            terms=terms,
            inertia=inertia,
            drives=drives,
            start=start,
            pose=state.pose,
            known=known,
            given=given,
            lost=lost,
        )

    def end_at(self, prediction: RobotPrediction, pose: Tensor) -> RobotPrediction:
        """Change a prediction so that a prescribed base ends at another pose, [B, 7]."""
        if self.mechanism.base != "kinematic":
            return prediction
        quaternion = torch.nn.functional.normalize(prediction.pose[..., 3:], dim=-1)
        local = prediction.inertia.center[..., self._kinematics.root, :]
        root = self._base_rates(prediction.start, quaternion, pose, local)
        known = torch.cat([root, prediction.known[..., ROOT:]], dim=-1)
        return prediction._replace(root_end=pose, known=known)

    def advance(
        self,
        prediction: RobotPrediction,
        coordinates: Tensor,
        contact: Tensor,
        kick: Tensor | None = None,
    ) -> tuple[RobotState, Tensor]:
        """State after a step, and the efforts on the joints [B, J] during it.

        Args:
            prediction: Prediction of the step.
            coordinates: Coordinates at its end, [B, n].
            contact: Forces on the vertices in the solution of the step, [B, V, 3] N.
            kick: Further forces, which change velocities only.
        """
        pose, known, start = prediction.root_end, prediction.known, prediction.start
        inertia, joints = prediction.inertia, coordinates
        local = inertia.center[..., self._kinematics.root, :]
        if self._floats:
            center, turn, joints = torch.split(coordinates, [3, 3, joints.shape[-1] - ROOT], dim=-1)
            predicted = prediction.root_end[..., 3:]
            last = quaternion_exp(turn)
            quaternion = quaternion_multiply(last, predicted)
            first = quaternion_exp(-prediction.coordinates[..., 3:ROOT])
            turned = quaternion_log(quaternion_multiply(last, first))
            rotation = quaternion_matrix(quaternion)
            end = _Configuration(center, rotation, joints)
            quaternion = nearer_quaternion(quaternion, prediction.pose[..., 3:])
            pose = torch.cat([center - times(rotation, local), quaternion], dim=-1)
            root_rate = torch.cat([center - start.center, turned], dim=-1) / self._dt
        else:
            root_rate = known[..., :ROOT]
            end = self._moved(start, known, self._dt)._replace(joints=joints)
        over = torch.cat([root_rate, (joints - start.joints) / self._dt], dim=-1)

        efforts = prediction.drives.applied_efforts(start.joints, joints, self._dt)
        velocity = over
        if self._has_dynamics:
            velocity, held = self._end(prediction, end, over, contact, kick)
            efforts = torch.where(self._prescribed, held, efforts)
        root_velocity, rates = torch.split(velocity, [ROOT, velocity.shape[-1] - ROOT], dim=-1)
        return RobotState(pose, root_velocity, joints, rates), efforts

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
        motion = Motion.at(self._kinematics, inertia, pose_frame(state.pose), state.joints)
        velocity = self._velocity(state)
        # T = p . nu / 2
        kinetic = ordered_sum(momentum(motion, inertia, velocity) * velocity) / 2
        momenta = link_momenta(motion, velocity)
        return Totals.of(motion.frames.centers, momenta, kinetic, inertia.mass, gravity)

    # Constituents

    def _acting(self, inertia: Inertia) -> Inertia:
        """Inertia that counts, which leaves out the drives of prescribed joints.

        Parameters have no masses of robots that are not dynamic.
        """
        if self._own_inertia is not None:
            return self._own_inertia
        return inertia._replace(armature=~self._prescribed * inertia.armature)

    def _velocity(self, state: RobotState) -> Tensor:
        """Velocities nu, [B, 6 + J]."""
        root = state.velocity
        if self.mechanism.base == "fixed":
            root = torch.zeros_like(root)
        return torch.cat([root, state.rates], dim=-1)

    def _drives(self, gains: Gains, control: RobotControl, bounds: Bounds | None) -> Drives:
        """Set gains and targets to zero that the actuation of a joint does not use."""
        pd, force = self._modes["pd"], ~self._prescribed
        asked = applied = force * control.efforts
        limits = None
        if bounds is not None:
            # What is applied to a joint without a drive has its limit here. A drive has it for all
            # that it asks for; the prediction takes what alone would be within.
            applied = torch.where(force, limited_effort(asked, bounds.efforts), asked)
            asked = torch.where(pd > 0, asked, applied)
            limits = torch.where(pd > 0, bounds.efforts, LARGEST)
        return Drives(
            stiffness=pd * gains.stiffness,
            damping=pd * gains.damping,
            viscosity=force * gains.viscosity,
            positions=pd * control.joints,
            velocities=pd * control.rates,
            asked=asked,
            efforts=applied,
            limits=limits,
        )

    def _prescribed_motion(
        self, start: _Configuration, quaternion: Tensor, control: RobotControl, local: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Velocities nu, zero unless prescribed, and the joints' values at the end."""
        h, joints = self._dt, start.joints
        position, velocity = self._modes["position"], self._modes["velocity"]
        rates = position * (control.joints - joints) / h + velocity * control.rates
        # A position target is reached exactly, not to the rounding of its velocity.
        ends = torch.where(position > 0, control.joints, joints + h * rates)
        root = torch.zeros_like(start.center).repeat(1, 2)
        if self.mechanism.base == "kinematic":
            root = self._base_rates(start, quaternion, control.pose, local)
        return torch.cat([root, rates], dim=-1), ends

    def _base_rates(
        self, start: _Configuration, quaternion: Tensor, end: Tensor, local: Tensor
    ) -> Tensor:
        """Velocities [B, 6] of the root that lead to a pose of its frame."""
        target = torch.nn.functional.normalize(end[..., 3:], dim=-1)
        center, _ = _placed(end[..., :3], target, local)
        between = torch.cat([start.center, quaternion], -1), torch.cat([center, target], -1)
        return pose_velocities(*between, self._dt)

    def _given(
        self,
        inertia: Inertia,
        here: Motion,
        state: RobotState,
        control: RobotControl,
        drives: Drives,
        gravity: Tensor,
        contact: Tensor | None,
    ) -> Tensor:
        """M(q_n) nu_n + h tau(q_n), [B, 6 + J]."""
        acting = torch.cat([control.wrench, drives.efforts], dim=-1)
        acting = acting + generalized_force(here, _weights(inertia, gravity))
        if contact is not None:
            acting = acting + self._generalized(here, contact)
        return momentum(here, inertia, self._velocity(state)) + self._dt * acting

    def _mass(self, inertia: Inertia, at: _Configuration) -> Tensor:
        """M, zero of a robot that is not dynamic; [B, 6 + J, 6 + J]."""
        if not self.mechanism.is_dynamic:
            size = ROOT + self.mechanism.joint_count
            return at.joints.new_zeros(len(at.joints), size, size)
        return mass_matrix(self._motion(inertia, at), inertia)

    def _change_at_rest(
        self,
        inertia: Inertia,
        start: _Configuration,
        mass: Tensor,
        velocity: Tensor,
        known: Tensor,
        given: Tensor,
        state: RobotState,
    ) -> Tensor:
        """What makes M balance the forces on a robot that stays at rest, [B, s, s].

        By itself a robot moves by velocities d of its s unknown ones. One that something holds
        should lack the impulse y that would let it, but M d has the velocity products of a fall
        that does not happen: M d = y - e. The symmetric change U of rank two,

            U = (e w^T + w e^T) / k - (e . d) w w^T / k^2,   w = M d,  k = d . w,

        gives (M + U) d = y, and changes nothing across d and M^-1 e. It counts by the share of the
        kinetic energy that one step of the forces gives: a robot that moves has such products.
        """
        h, solved = self._dt, self._solved
        needed = given
        if self._prescribed.any() or self.mechanism.base == "kinematic":
            middle = self._motion(inertia, self._moved(start, known, h / 2))
            ahead = momentum(middle, inertia, known)
            needed = given + h / 2 * slope(self._kinematics, middle, known) - ahead
        M = mass[..., solved[:, None], solved]
        d = velocity[..., solved]
        w = times(M, d)
        e = needed[..., solved] - w
        # Twice kinetic energies: of the fall, of what a step of the forces adds, and of the motion.
        now = known.index_copy(-1, solved, self._velocity(state)[..., solved])
        added = d - now[..., solved]
        turning = mass.diagonal(dim1=-2, dim2=-1)[..., self._turning].sum(-1)
        little = (_LITTLE_TURN / h) ** 2 * turning
        k = (d * w).sum(-1) + little
        gain = (added * times(M, added)).sum(-1)
        share = gain / (gain + (now * times(mass, now)).sum(-1) + little)
        # A change by more than half could leave M indefinite.
        size_sq = (e * solve(M, e)).sum(-1) / k
        share = share / (1 + (4 * size_sq) ** 4) ** 0.125
        w = w / k[..., None]
        outer = e[..., :, None] * w[..., None, :]
        along = (e * d).sum(-1)[..., None, None] * w[..., :, None] * w[..., None, :]
        return share[..., None, None] * (outer + outer.transpose(-1, -2) - along)

    def _weight_stiffness(self, inertia: Inertia, start: _Configuration, gravity: Tensor) -> Tensor:
        """K of the weight at the start, without a graph, [B, 6 + J, 6 + J]."""
        inertia, start, gravity = (
            Inertia(*map(plain, inertia)),
            _Configuration(*map(plain, start)),
            plain(gravity),
        )

        def pull(x: Tensor) -> Tensor:
            motion = self._motion(inertia, self._moved(start, x, 1.0))
            return generalized_force(motion, _weights(inertia, gravity))

        with torch.no_grad(), outside_transforms():
            if self._weight_bound is not None:
                frames = self._motion(inertia, start).frames
                return torch.diag_embed(self._weight_bound.stiffness(frames, inertia, gravity))
            still = start.joints.new_zeros(len(start.joints), ROOT + self.mechanism.joint_count)
            slopes = jacobian_of(pull)(still)
            # The moments of a turn are those of its rotation vector but for a skew part.
            return -(slopes + slopes.transpose(-1, -2)) / 2

    def _solve(
        self,
        inertia: Inertia,
        start: _Configuration,
        known: Tensor,
        given: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Velocities nu over the step without contact; where there are none, [B], zero."""
        h, solved = self._dt, self._solved

        def residual(velocity: Tensor, *inputs: Tensor) -> Tensor:
            weights, begin, wanted = Inertia(*inputs[:4]), _Configuration(*inputs[4:7]), inputs[-1]
            middle = self._motion(weights, self._moved(begin, velocity, h / 2))
            ahead = momentum(middle, weights, velocity)
            return ahead - h / 2 * slope(self._kinematics, middle, velocity) - wanted

        def complete(x: Tensor, known: Tensor) -> Tensor:
            return known.expand(*x.shape[:-1], known.shape[-1]).index_copy(-1, solved, x)

        def of_solved(x: Tensor, *inputs: Tensor) -> Tensor:
            return residual(complete(x, inputs[-2]), *inputs)[..., solved]

        x, found = solve_motion(self._free_motion, inertia, start, known, given)
        lost = ~found | ~(self._largest_turn(complete(x, known)) <= _MOST_TURN)
        x = torch.where(lost[:, None], 0.0, x)
        return complete(attach_root(of_solved, x, (*inertia, *start, known, given)), known), lost

    def _largest_turn(self, velocity: Tensor) -> Tensor:
        """Largest turn that a floating base or a joint makes by itself in a step [rad], [B]."""
        velocity = plain(velocity)
        of_base = velocity[..., 3:ROOT].norm(dim=-1) * self._floats
        of_joints = times(self._turns, velocity[..., ROOT:]).abs()
        return self._dt * torch.cat([of_base[..., None], of_joints], dim=-1).amax(dim=-1)

    def too_fast(self, prediction: RobotPrediction) -> dict[int, str]:
        """Environment without a motion by itself -> a sentence."""
        sentence = (
            f"the velocities of robot {self.mechanism.name!r} are too large for a time step of "
            f"{self._dt:g} s; no joint, and no base, may turn by more than half a turn in it"
        )
        return dict.fromkeys(prediction.lost.nonzero()[:, 0].tolist(), sentence)

    def _end(
        self,
        prediction: RobotPrediction,
        end: _Configuration,
        over: Tensor,
        contact: Tensor,
        kick: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Velocities nu at the end of a step, from those over it, and efforts that held joints."""
        h, solved, inertia = self._dt, self._solved, prediction.inertia
        placed = self._motion(inertia, end)
        middle = self._motion(inertia, self._moved(prediction.start, over, h / 2))
        rate = slope(self._kinematics, middle, over)
        impulse = None if kick is None else h * self._generalized(placed, kick)
        velocity = over
        if len(solved):
            ahead = momentum(middle, inertia, over) + h / 2 * rate
            if impulse is not None:
                ahead = ahead + impulse
            change = (ahead - momentum(placed, inertia, over))[..., solved]
            mass = mass_matrix(placed, inertia)[..., solved[:, None], solved]
            velocity = over.index_add(-1, solved, solve(mass, change))
        if not self._prescribed.any():
            return velocity, over.new_zeros(())
        missing = momentum(placed, inertia, velocity) - prediction.given
        if impulse is not None:
            missing = missing - impulse
        held = missing / h - rate - self._generalized(placed, contact)
        return velocity, self._at_joints(held)

    def _moved(self, start: _Configuration, velocity: Tensor, time: float) -> _Configuration:
        """Configuration after moving at constant velocities."""
        joints = start.joints + time * velocity[..., ROOT:]
        if self.mechanism.base == "fixed":
            return start._replace(joints=joints)
        turn = rotation_exp(time * velocity[..., 3:ROOT])
        return _Configuration(
            start.center + time * velocity[..., :3], product(turn, start.rotation), joints
        )

    def _motion(self, inertia: Inertia, at: _Configuration) -> Motion:
        local = inertia.center[..., self._kinematics.root, :]
        return Motion.at(
            self._kinematics, inertia, root_frame(at.center, at.rotation, local), at.joints
        )

    def _generalized(self, motion: Motion, forces: Tensor) -> Tensor:
        """Generalized forces [B, 6 + J] of forces on the vertices, [B, V, 3]."""
        wrenches = wrenches_of_forces(motion.frames, self._links, self._points, forces)
        return generalized_force(motion, wrenches)

    def _at_joints(self, values: Tensor) -> Tensor:
        return values[..., values.shape[-1] - self.mechanism.joint_count :]


def _weights(inertia: Inertia, gravity: Tensor) -> Tensor:
    """The weight of each link as a wrench about its center, [B, L, 6]."""
    return inertia.mass[..., None] * torch.nn.functional.pad(gravity, (0, 3))[..., None, :]


def _inertia_of_prescribed(mechanism: Mechanism) -> Inertia:
    """Inertia for the efforts of prescribed joints of a robot that is not dynamic.

    No joint carries the root link. Without a mass there, the velocities of such a root are those of
    its frame's origin.
    """
    center = np.where(
        np.arange(mechanism.link_count)[:, None] == mechanism.root, 0, mechanism.center
    )
    arrays = (mechanism.mass, center, mechanism.inertia, np.zeros(mechanism.joint_count))
    return Inertia(*(constant(array)[None] for array in arrays))


def _placed(position: Tensor, quaternion: Tensor, local: Tensor) -> tuple[Tensor, Tensor]:
    """Center of mass and orientation of a link whose frame is at a pose."""
    rotation = quaternion_matrix(quaternion)
    return position + times(rotation, local), rotation
