"""Bodies and robots of a scene over one step: before the core and after it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.autograd.core_function import NO_CONSTANTS, Constant
from diffcloth_torch.checks import LARGEST
from diffcloth_torch.dynamics.bodies import (
    MOST_TURN_IN_CONTACT,
    BodyInertia,
    BodyPrediction,
    advance_bodies,
    body_totals,
    predict_bodies,
    turn_sentence,
)
from diffcloth_torch.dynamics.inertia import Inertia
from diffcloth_torch.dynamics.robots import (
    Bounds,
    Gains,
    RobotControl,
    RobotDynamics,
    RobotPrediction,
    RobotState,
)
from diffcloth_torch.dynamics.totals import Totals
from diffcloth_torch.geometry.rotation import (
    quaternion_exp,
    quaternion_multiply,
    rotate,
    row_velocities,
)
from diffcloth_torch.model.assembly import Assembly
from diffcloth_torch.model.quantities import Fields

__all__ = ["Dynamics", "Prediction"]

_forked = False


def _note_fork() -> None:
    global _forked
    _forked = True


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


@dataclass(frozen=True, eq=False)
class Prediction:
    """A step without contact and limits, from which the core starts.

    There are T mechanisms: K bodies, then R robots. There are n coordinates: for each dynamic body
    the center of mass c [m] and the rotation vector w about its predicted orientation; for each
    robot the same for a floating base, then the values of its joints.

    Attributes:
        body_poses: Frames of the roots at the start of the step, [B, T, 7]. The frame of a free
            root maps points to their predicted positions about the center of mass.
        body_targets: Frames of the roots at the end, likewise.
        coordinates: Coordinates at the start, [B, n].
        coordinate_ends: Coordinates at the end if they are prescribed, [B, n].
        coordinate_targets: t of the term (q - t)^T A (q - t) / 2 of the objective, [B, n].
        coordinate_metric: A, row by row, mechanism after mechanism, [B, sum n_t^2].
        joint_terms: Limits and resistance of joints: rows of the core, one for each coordinate,
            [B, n, 7]; None if no joint is moved by forces.
        bodies: Details of the dynamic bodies, None if there are none.
        robots: Details of the robots.
        held_poses: Poses of all bodies, for dynamic ones at the start, [B, K, 7].
        held_velocities: Velocities of kinematic bodies, zero elsewhere, [B, K, 6].
    """

    body_poses: Tensor
    body_targets: Tensor
    coordinates: Tensor
    coordinate_ends: Tensor
    coordinate_targets: Tensor
    coordinate_metric: Tensor
    joint_terms: Tensor | None
    bodies: BodyPrediction | None
    robots: tuple[RobotPrediction, ...]
    held_poses: Tensor
    held_velocities: Tensor

    def core_inputs(self) -> dict[str, Tensor]:
        """The inputs of the core, by its names."""
        terms = {} if self.joint_terms is None else {"joint_terms": self.joint_terms}
        return terms | {
            "body_poses": self.body_poses,
            "body_targets": self.body_targets,
            "coordinates": self.coordinates,
            "coordinate_ends": self.coordinate_ends,
            "coordinate_targets": self.coordinate_targets,
            "coordinate_metric": self.coordinate_metric,
        }


class _RobotParameters(NamedTuple):
    """Parameters of a robot; `bounds` is None if no joint of the scene is moved by forces."""

    inertia: Inertia
    gains: Gains
    bounds: Bounds | None


class _Parameters(NamedTuple):
    """Parameters of all bodies and robots.

    Attributes:
        gravity: [B or 1, 3] m/s^2.
        bodies: Inertia of the dynamic bodies; None if there are none.
        robots: For each robot its parameters.
    """

    gravity: Tensor
    bodies: BodyInertia | None
    robots: list[_RobotParameters]


class _Kept(NamedTuple):
    """Parameters of the scene, which are prepared once.

    Attributes:
        fields: All fields of the parameters.
        parameters: The same for bodies and robots.
        of_bodies: Constants of the core's functions of bodies.
        of_robots: For each robot the constants of its functions.
    """

    fields: Fields
    parameters: _Parameters
    of_bodies: Mapping[str, Constant]
    of_robots: list[Mapping[str, Constant]]


class Dynamics:
    """Predicts and advances the bodies and robots of a scene. Immutable once parameters are kept.

    Attributes:
        dt: Time step [s].
        coordinate_count: n.
        prescribed: Mask of prescribed coordinates, [n].
    """

    def __init__(self, assembly: Assembly, dt: float, weight: str | None = None) -> None:
        """Prepare the constants.

        Args:
            assembly: Arrays of the scene.
            dt: Time step [s].
            weight: None for steps in time. For steps to an equilibrium, the dependence of the
                weight of robots on their configuration: "bounded" (an upper bound, for steps from
                afar) or "exact" (the derivative).
        """
        self.dt = dt
        K = assembly.body_count
        mechanisms = assembly.mechanisms
        self._free = _indices(k for k in range(K) if mechanisms[k].base == "floating")
        self._moved = _indices(k for k in range(K) if mechanisms[k].base == "kinematic")
        self._free_names = [mechanisms[k].name for k in self._free]
        surface_of_vertex = torch.repeat_interleave(
            cpu.tensor(assembly.body_vertex_start.tolist(), dtype=torch.int64).diff()
        )
        owner = torch.from_numpy(assembly.surface_mechanism).long()[surface_of_vertex]
        link = torch.from_numpy(assembly.surface_link).long()[surface_of_vertex]
        vertices = torch.from_numpy(assembly.body_vertices)

        row = cpu.full((len(mechanisms),), -1, dtype=torch.int64).index_copy(
            0, self._free, cpu.arange(len(self._free))
        )[owner]  # index of a vertex's body among the dynamic ones
        self._on_free = torch.nonzero(row >= 0)[:, 0]
        self._body_of_vertex = row[self._on_free]
        self._body_points = vertices[self._on_free]

        self._robots: list[RobotDynamics] = []
        self._robot_rows: list[tuple[slice, slice, Tensor]] = []  # joints, links, vertices
        self._widths = [6 * len(self._free)]  # lengths of the parts of the coordinates
        held = [cpu.zeros(6 * len(self._free), dtype=torch.bool)]
        joints = links = 0
        for t in range(K, len(mechanisms)):
            mechanism = mechanisms[t]
            rows = torch.nonzero(owner == t)[:, 0]
            robot = RobotDynamics(mechanism, dt, link[rows], vertices[rows], weight)
            joint_rows = slice(joints, joints := joints + mechanism.joint_count)
            link_rows = slice(links, links := links + mechanism.link_count)
            self._robots.append(robot)
            self._robot_rows.append((joint_rows, link_rows, rows))
            self._widths.append(robot.coordinate_count)
            held.append(robot.prescribed)
        self.prescribed = torch.cat(held)
        self.coordinate_count = len(self.prescribed)
        self._kept: _Kept | None = None

    def keep(self, parameters: Fields) -> None:
        """Prepare the parameters of the scene; nobody may edit these tensors.

        Steps with these very tensors do not prepare them again.

        Args:
            parameters: As for `predict`, without gradients.
        """
        own = self._prepared(parameters)
        of_bodies = {} if own.bodies is None else own.bodies._asdict() | {"gravity": own.gravity}
        of_robots = [
            robot.parameters(*parts, own.gravity)
            for robot, parts in zip(self._robots, own.robots, strict=True)
        ]
        self._kept = _Kept(
            fields=dict(parameters),
            parameters=own,
            of_bodies=_constants(of_bodies),
            of_robots=[_constants(named) for named in of_robots],
        )

    def predict(
        self,
        state: Fields,
        control: Fields,
        parameters: Fields,
        contact: Tensor | None = None,
        joint_origins: Tensor | None = None,
    ) -> Prediction:
        """Predict the step without contact and limits.

        Args:
            state: Fields of a state, each with a leading axis B.
            control: Fields of a control, complete, each with a leading axis B or 1.
            parameters: `gravity`, and masses, gains and other parameters of the scene; with leading
                axes B or 1.
            contact: Forces on the vertices of bodies and links [N] that act over the step like
                gravity, shape [B, V, 3].
            joint_origins: Values of all joints from which their friction measures motion, [B, J];
                by default the values at the start.
        """
        if _forked and torch.get_num_threads() > 1:
            # Threads of torch and MKL do not survive a fork: an operation would wait for them
            # forever.
            torch.set_num_threads(1)
        batch = len(state["body_poses"])
        acting = {
            name: values if len(values) == batch else values.expand(batch, *values.shape[1:])
            for name, values in control.items()
        }
        own = self._own_parameters(parameters)

        bodies = self._predict_bodies(state, acting, own, contact)
        start, end = state["body_poses"], acting["body_poses"]
        velocities = row_velocities(start, end, self._moved, self.dt)
        held = end
        if bodies is not None:
            held = end.index_copy(1, self._free, start[:, self._free])
            start = start.index_copy(1, self._free, bodies.frames)
            end = end.index_copy(1, self._free, bodies.frames)
        robots = tuple(
            self._predict_robot(i, state, acting, own, contact, joint_origins)
            for i in range(len(self._robots))
        )
        none = start.new_zeros(batch, 0)

        def rows(of_bodies: Tensor | None, of_robots: Iterable[Tensor]) -> Tensor:
            first = none if of_bodies is None else of_bodies.flatten(1)
            return _joined([first, *(t.flatten(1) for t in of_robots)])

        b = bodies
        terms = [c.terms for c in robots if c.terms is not None]
        if terms:
            terms.insert(0, _idle_terms(terms[0], self._widths[0]))
        return Prediction(
            body_poses=_joined([start, *(c.root_start[:, None] for c in robots)]),
            body_targets=_joined([end, *(c.root_end[:, None] for c in robots)]),
            coordinates=rows(b and b.coordinates, (c.coordinates for c in robots)),
            coordinate_ends=rows(b and b.coordinates, (c.ends for c in robots)),
            coordinate_targets=rows(b and b.target, (c.target for c in robots)),
            coordinate_metric=rows(b and b.metric, (c.metric for c in robots)),
            joint_terms=_joined(terms) if terms else None,
            bodies=bodies,
            robots=robots,
            held_poses=held,
            held_velocities=velocities,
        )

    def end_at(self, prediction: Prediction, poses: Tensor) -> Prediction:
        """Change a prediction so that prescribed motion ends at other poses.

        Args:
            prediction: Prediction of the step.
            poses: Poses of all roots at its end, [B, T, 7]; rows of free roots are ignored.
        """
        moved, bodies = self._moved, prediction.held_poses.shape[1]
        start, end = prediction.body_poses[:, :bodies], poses[:, :bodies]
        robots = zip(self._robots, prediction.robots, poses[:, bodies:].unbind(1), strict=True)
        return replace(
            prediction,
            held_poses=prediction.held_poses.index_copy(1, moved, end[:, moved]),
            held_velocities=row_velocities(start, end, moved, self.dt),
            robots=tuple(robot.end_at(own, pose) for robot, own, pose in robots),
        )

    def last_places(self, state: Fields, parameters: Fields) -> Fields:
        """Positions of bodies and robots one step before the state, by its velocities.

        Prescribed bodies, joints and bases keep their positions.

        Args:
            state: As for `predict`.
            parameters: As for `predict`.

        Returns:
            `body_poses`, `joint_positions` and `base_poses`.
        """
        poses, free = state["body_poses"], self._free
        if len(free):
            centers = self._body_inertia(parameters).center
            rates = state["body_velocities"][:, free]
            poses = poses.index_copy(1, free, self._last_pose(poses[:, free], centers, rates))
        last = {"body_poses": poses}
        if not self._robots:
            return last
        joints, bases = [state["joint_positions"][:, :0]], []
        for i, robot in enumerate(self._robots):
            rows, links, _ = self._robot_rows[i]
            roots = robot.coordinate_count - (rows.stop - rows.start)
            here = state["joint_positions"][:, rows]
            before = here - self.dt * state["joint_velocities"][:, rows]
            joints.append(torch.where(robot.prescribed[roots:], here, before))
            base = state["base_poses"][:, i]
            if roots:
                center = parameters["link_center"][:, links][:, robot.root]
                base = self._last_pose(base, center, state["base_velocities"][:, i])
            bases.append(base[:, None])
        return last | {"joint_positions": torch.cat(joints, 1), "base_poses": torch.cat(bases, 1)}

    def _last_pose(self, poses: Tensor, centers: Tensor, velocities: Tensor) -> Tensor:
        """Poses [.., 7] one step earlier, by velocities [.., 6]; centers are in local frames."""
        shift, turn = torch.split(self.dt * velocities, 3, dim=-1)
        here = torch.nn.functional.normalize(poses[..., 3:], dim=-1)
        centers = centers.expand_as(here[..., :3])
        last = quaternion_multiply(quaternion_exp(-turn), here)
        middle = poses[..., :3] + rotate(here, centers) - shift
        return torch.cat([middle - rotate(last, centers), last], dim=-1)

    def advance(
        self,
        prediction: Prediction,
        coordinates: Tensor,
        contact: Tensor,
        kick: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Fields of the state after the step.

        Args:
            prediction: Prediction of this step.
            coordinates: Coordinates at its end, from the core, [B, n].
            contact: Forces on the vertices of bodies and links in its solution [N], shape
                [B, V, 3].
            kick: Further forces on these vertices, which change velocities only.

        Returns:
            `body_poses`, `body_velocities`, `joint_positions`, `joint_velocities`, `joint_efforts`,
            `base_poses` and `base_velocities`.

        """
        poses, velocities = prediction.held_poses, prediction.held_velocities
        batch = len(poses)
        parts = torch.split(coordinates, self._widths, dim=1)
        bodies = prediction.bodies
        if bodies is not None:
            own = parts[0].reshape(batch, -1, 6)
            wrenches = None
            if kick is not None:
                turned = quaternion_multiply(quaternion_exp(own[..., 3:]), bodies.frames[..., 3:])
                wrenches = self._wrenches(turned, bodies.inputs["center"], kick)
            moved, rates = advance_bodies(bodies, own, wrenches, self.dt)
            poses = poses.index_copy(1, self._free, moved)
            velocities = velocities.index_copy(1, self._free, rates)
        states, efforts = [], []
        for i, robot in enumerate(self._robots):
            rows = self._robot_rows[i][2]
            pushed = None if kick is None else kick[:, rows]
            # The rows ascend: if they are as many as all, they are all.
            touched = contact if len(rows) == contact.shape[1] else contact[:, rows]
            after, effort = robot.advance(prediction.robots[i], parts[1 + i], touched, pushed)
            states.append(after)
            efforts.append(effort)
        none = coordinates.new_zeros(batch, 0)
        bases = coordinates.new_zeros(batch, 0, 7)
        return {
            "body_poses": poses,
            "body_velocities": velocities,
            "joint_positions": _joined([none, *(s.joints for s in states)]),
            "joint_velocities": _joined([none, *(s.rates for s in states)]),
            "joint_efforts": _joined([none, *efforts]),
            "base_poses": _joined([bases, *(s.pose[:, None] for s in states)]),
            "base_velocities": _joined([bases[..., :6], *(s.velocity[:, None] for s in states)]),
        }

    def too_fast(self, prediction: Prediction) -> dict[int, str]:
        """Environments with robots that are too fast for a time step -> a sentence about one."""
        found: dict[int, str] = {}
        for robot, own in zip(self._robots, prediction.robots, strict=True):
            found |= robot.too_fast(own)
        return found

    def turned_too_far(
        self, prediction: Prediction, after: Fields, forces: Tensor
    ) -> dict[int, str]:
        """Dynamic bodies and robots that turn by more than a step, or contact, resolves.

        Args:
            prediction: Prediction of the step.
            after: Result of `advance`.
            forces: Contact forces on the vertices of bodies and links, [B, V, 3] N.

        Returns:
            Environment -> a sentence with its first such body, the speed, and a sufficient time
            step; or with the robot.
        """
        found = self.too_fast(prediction)
        bodies = prediction.bodies
        if bodies is None:
            return found
        on_vertex = forces.detach()[:, self._on_free].abs().sum(-1)
        touched = torch.zeros_like(bodies.speed).index_add(1, self._body_of_vertex, on_vertex) > 0
        end = after["body_velocities"].detach()[:, self._free, 3:].norm(dim=-1)
        speed = torch.maximum(bodies.speed, end)
        lost = touched & ~(self.dt * speed <= MOST_TURN_IN_CONTACT)
        how = "touches something, or is attached to it, and may"
        for environment, body in reversed(lost.nonzero().tolist()):
            found[environment] = turn_sentence(
                f"body {self._free_names[body]!r}",
                float(speed[environment, body]),
                self.dt,
                MOST_TURN_IN_CONTACT,
                how,
            )
        return found

    def joint_weights(self, state: Fields, parameters: Fields) -> Tensor:
        """Generalized forces of the weight of dynamic robots at the joints, [B, J] N m or N.

        Args:
            state: Fields of a state, each with a leading axis B.
            parameters: As for `predict`.
        """
        gravity = parameters["gravity"].reshape(-1, 3)
        none = state["joint_positions"].new_zeros(len(state["joint_positions"]), 0)
        own = [
            robot.joint_weights(
                self._robot_state(i, state), self._robot_inertia(i, parameters), gravity
            )
            for i, robot in enumerate(self._robots)
        ]
        return torch.cat([none, *own], dim=-1)

    def totals(self, state: Fields, parameters: Fields) -> Totals:
        """Momentum and energy of dynamic bodies and robots.

        Args:
            state: Fields of a state, each with a leading axis B.
            parameters: As for `predict`.
        """
        gravity = parameters["gravity"].reshape(-1, 3)
        free = self._free
        result = Totals.zero(len(state["body_poses"]))
        if len(free):
            poses, velocities = state["body_poses"][:, free], state["body_velocities"][:, free]
            result = body_totals(poses, velocities, self._body_inertia(parameters), gravity)
        for i, robot in enumerate(self._robots):
            of_robot = robot.totals(
                self._robot_state(i, state), self._robot_inertia(i, parameters), gravity
            )
            result = result.plus(of_robot)
        return result

    def _body_inertia(self, parameters: Fields) -> BodyInertia:
        free = self._free
        return BodyInertia(
            mass=parameters["body_mass"][:, free],
            center=parameters["body_center"][:, free],
            inertia=_symmetric(parameters["body_inertia"][:, free]),
        )

    def _robot_inertia(self, i: int, parameters: Fields) -> Inertia:
        joints, links, _ = self._robot_rows[i]
        return Inertia(
            mass=_rows(parameters, "link_mass", links),
            center=_rows(parameters, "link_center", links, 3),
            inertia=_symmetric(_rows(parameters, "link_inertia", links, 3, 3)),
            armature=_rows(parameters, "joint_armature", joints),
        )

    def _robot_state(self, i: int, state: Fields) -> RobotState:
        joints = self._robot_rows[i][0]
        return RobotState(
            pose=state["base_poses"][:, i],
            velocity=state["base_velocities"][:, i],
            joints=_part(state["joint_positions"], joints),
            rates=_part(state["joint_velocities"], joints),
        )

    def _own_parameters(self, parameters: Fields) -> _Parameters:
        """Parameters of bodies and robots; these of the scene are prepared."""
        kept = self._kept
        if kept is not None and all(parameters.get(n) is t for n, t in kept.fields.items()):
            return kept.parameters
        return self._prepared(parameters)

    def _prepared(self, parameters: Fields) -> _Parameters:
        return _Parameters(
            gravity=parameters["gravity"].reshape(-1, 3),
            bodies=self._body_inertia(parameters) if len(self._free) else None,
            robots=[self._robot_parameters(i, parameters) for i in range(len(self._robots))],
        )

    def _robot_parameters(self, i: int, parameters: Fields) -> _RobotParameters:
        joints = self._robot_rows[i][0]
        bounds = None
        if "joint_effort_limits" in parameters:  # present if any joint is moved by forces
            bounds = Bounds(
                efforts=parameters["joint_effort_limits"][:, joints],
                velocities=parameters["joint_velocity_limits"][:, joints],
                friction=parameters["joint_friction"][:, joints],
                slip_rates=parameters["joint_slip_rates"][:, joints],
            )
        gains = Gains(
            stiffness=_rows(parameters, "joint_stiffness", joints),
            damping=_rows(parameters, "joint_damping", joints),
            viscosity=_rows(parameters, "joint_viscosity", joints),
        )
        return _RobotParameters(self._robot_inertia(i, parameters), gains, bounds)

    def _predict_bodies(
        self,
        state: Fields,
        control: Fields,
        parameters: _Parameters,
        contact: Tensor | None,
    ) -> BodyPrediction | None:
        inertia = parameters.bodies
        if inertia is None:
            return None
        free = self._free
        poses, velocities = state["body_poses"][:, free], state["body_velocities"][:, free]
        wrenches = control["body_wrenches"][:, free]
        if contact is not None:
            turned = torch.nn.functional.normalize(poses[..., 3:], dim=-1)
            wrenches = wrenches + self._wrenches(turned, inertia.center, contact)
        return predict_bodies(
            poses,
            velocities,
            inertia,
            wrenches,
            parameters.gravity,
            self.dt,
            self._free_names,
            NO_CONSTANTS if self._kept is None else self._kept.of_bodies,
        )

    def _predict_robot(
        self,
        i: int,
        state: Fields,
        control: Fields,
        parameters: _Parameters,
        contact: Tensor | None,
        origins: Tensor | None,
    ) -> RobotPrediction:
        joints, _, vertices = self._robot_rows[i]
        inertia, gains, bounds = parameters.robots[i]
        return self._robots[i].predict(
            self._robot_state(i, state),
            RobotControl(
                pose=control["base_poses"][:, i],
                wrench=control["base_wrenches"][:, i],
                joints=_part(control["joint_positions"], joints),
                rates=_part(control["joint_velocities"], joints),
                efforts=_part(control["joint_efforts"], joints),
            ),
            inertia,
            gains,
            parameters.gravity,
            None if contact is None else contact[:, vertices],
            bounds,
            None if origins is None else origins[:, joints],
            NO_CONSTANTS if self._kept is None else self._kept.of_robots[i],
        )

    def _wrenches(self, quaternions: Tensor, centers: Tensor, forces: Tensor) -> Tensor:
        """Wrenches of forces on all vertices about the dynamic bodies' centers; [B, Kd, 6]."""
        body, own = self._body_of_vertex, forces[:, self._on_free]
        arms = (self._body_points - centers[:, body]).expand_as(own)
        arms = rotate(quaternions[:, body], arms)
        parts = torch.cat([own, torch.linalg.cross(arms, own)], dim=-1)
        return parts.new_zeros(len(parts), len(self._free), 6).index_add(1, body, parts)


def _indices(values: Iterable[int]) -> Tensor:
    return cpu.tensor(list(values), dtype=torch.long)


def _constants(named: Mapping[str, Tensor]) -> dict[str, Constant]:
    return {name: Constant.of(tensor) for name, tensor in named.items()}


def _joined(parts: Sequence[Tensor]) -> Tensor:
    """Concatenate parts along the second axis; the only part with rows is not copied."""
    some = [part for part in parts if part.shape[1]]
    return some[0] if len(some) == 1 else torch.cat(list(parts), dim=1)


def _part(values: Tensor, rows: slice) -> Tensor:
    """Rows of the second axis of values [B, n]."""
    return values if rows == slice(0, values.shape[1]) else values[:, rows]


def _idle_terms(like: Tensor, count: int) -> Tensor:
    """Rows of joint terms without effect, [B, count, 7], for coordinates that are no joints."""
    row = like.new_tensor([0.0, 0.0, 0.0, LARGEST, LARGEST, 0.0, 1.0])
    return row.expand(len(like), count, len(row))


def _rows(parameters: Fields, name: str, rows: slice, *shape: int) -> Tensor:
    """Rows of a parameter; zeros if the scene lacks it because nothing with it is dynamic."""
    if name in parameters:
        return parameters[name][:, rows]
    return cpu.zeros(1, rows.stop - rows.start, *shape)


def _symmetric(matrices: Tensor) -> Tensor:
    return (matrices + matrices.transpose(-1, -2)) / 2
