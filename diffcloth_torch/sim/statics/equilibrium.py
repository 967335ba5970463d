"""Static equilibrium: steps from rest whose length grows until inertia vanishes.

A step of length H from rest minimizes

    P(x) = 1/(2 H^2) (x - x_k)^T M (x - x_k) - f^T x + W(x) + B(x) + D(x - x_0),

with the weight and all other forces f, elasticity W, the barrier B and friction D. As H grows, the
first term vanishes: the steps descend to a stable minimum of the other terms (pseudo-transient
continuation), and the last one is Newton's method without inertia, certified like every step. In
all steps friction measures motion from the initial state x_0 of the search, so that sticking
contacts keep sticking. Friction uses the normal forces of the previous solution, and the weight of
robots their previous configuration: the last step is repeated until these no longer change. The
equilibrium is a fixed point of the last step, and has the derivative of this fixed point
(`fixed_point`).

References:
    Kelley and Keyes, "Convergence analysis of pseudo-transient continuation", SIAM Journal on
    Numerical Analysis 35 (1998).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.autograd.torch_private import in_forward_mode
from diffcloth_torch.autograd.transforms import (
    is_differentiated,
    numbers_of,
    outside_transforms,
    plain,
)
from diffcloth_torch.errors import InvalidInput, SimulationError, TurnedTooFar
from diffcloth_torch.model.mechanism import Mechanism
from diffcloth_torch.model.options import ContactOptions, SolverOptions
from diffcloth_torch.model.quantities import PARAMETERS, Fields
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.inputs.border import Given
from diffcloth_torch.sim.inputs.layout import Layout
from diffcloth_torch.sim.solve.engine import Check, Engine
from diffcloth_torch.sim.solve.failures import failures_of, mark, refuse_gradients
from diffcloth_torch.sim.solve.step import CONVERGED, UNCONVERGED
from diffcloth_torch.sim.statics.fixed_point import Linearization, as_fixed_point, at_values
from diffcloth_torch.sim.statics.free_modes import refuse_free_modes, surface_of_vertex

__all__ = ["Equilibria"]

Diagnostics = dict[str, Any]
Anchor = tuple[Tensor, Tensor | None]

# Lengths of the steps, in time steps of the simulator. In the last one inertia is below rounding
# compared to any stiffness. Modes without stiffness are detected in the one before, where inertia
# still exceeds the stiffness that a residual force adds to a free mode: of 49 sheets that turn
# about one vertex, probes at 1e5 steps missed 12, probes at 3e3 steps none. A held mode with a
# period of more than some 2e4 steps counts as free.
_GROWTH = (1e1, 1e2, 1e3)
_PROBED = 3e3
_LAST = 1e8

# Fields of a state that an equilibrium determines.
_MOVING = ("positions", "body_poses", "joint_positions", "base_poses")

# Robots settle in steps that use an upper bound for the stiffness of their weight, until nothing
# moves by more than this share of the scene; then in steps with the stiffness itself.
_NEAR = 1e-3
_DESCENTS = 300

# Friction iterations of the last step, so that normal forces settle within it, and the largest
# number of its repetitions.
_FRICTION_ITERATIONS = 8
_REPEATS = 12

# Friction has settled if a repetition moves nothing by more than this fraction of the slip at which
# friction yields.
_SETTLED = 0.1

# Anything that has moved by this many sizes of the scene is falling.
_FALLEN = 30.0


class _Found(NamedTuple):
    """Fields of a state, and the diagnostics of the solve that found it."""

    fields: Fields
    diagnostics: Diagnostics


class _Settled(NamedTuple):
    """A state that a further last step does not change.

    Attributes:
        here: The state.
        unsettled: Environments in which friction has not settled.
        touching: Environments with contacts, [B].
    """

    here: Given
    unsettled: list[int]
    touching: Tensor


class Equilibria:
    """Finds equilibria of a scene; makes engines of the long steps when they are first needed."""

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        *,
        dt: float,
        scheme: str,
        contact: ContactOptions,
        solver: SolverOptions,
    ) -> None:
        """Keep the arguments of the engines: the checked arguments of `Simulator`."""
        self._scene, self._layout, self._dt, self._scheme = scene, layout, dt, scheme
        self._contact, self._solver = contact, solver
        self._engines: dict[float, Engine] = {}
        assembly = layout.assembly
        self._settles = any(robot.is_dynamic for robot in assembly.robots)
        points = assembly.vertices if len(assembly.vertices) else assembly.body_vertices
        size = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
        # Without any extent, as for a single wheel, a radian counts like a meter.
        self._size = max([size, *(_reach(robot) for robot in assembly.robots)]) or 1.0
        turns = [turn for robot in assembly.robots for turn in _turns(robot)]
        # A radian counts like the size of the scene.
        self._lever = cpu.tensor([self._size if turn else 1.0 for turn in turns])

    def find(self, given: Given, check: Check) -> tuple[Fields, Diagnostics]:
        """Find an equilibrium in each environment.

        Args:
            given: A state, a control that acts permanently, and parameters.
            check: Checks the diagnostics of each solve.

        Returns:
            Fields of the state at equilibrium except the time, with zero velocities; and the
            diagnostics of the last step, with the iterations of all steps.

        Raises:
            InvalidInput: If the scene or the control has something for which no equilibrium is
                defined.
            SimulationError: If something is free to move.
            TurnedTooFar: If a body turns too far on the way.
        """
        self._refuse(given)
        given = _resting(given)
        origins = self._engine(_LAST).surfaces.vertices(given.state)
        joints = given.state.get("joint_positions")
        iterations = cpu.zeros(len(given.state["positions"]), dtype=torch.long)

        def step(
            length: float,
            at: Given,
            anchor: Tensor,
            turned: Tensor | None,
            counted: Tensor | None = None,
        ) -> _Found:
            given = _slower(at, length)
            # An intermediate step may fail to converge: the next one continues from its end.
            checked = _unless_unconverged(check) if length in _GROWTH else check
            try:
                found = _Found(*self._engine(length).step(given, checked, anchor, turned))
            except TurnedTooFar as error:  # its message names a time step of the search
                raise TurnedTooFar(
                    "equilibrium: a body turns further on the way to rest than a step resolves; "
                    "begin nearer to rest, as at the end of a rollout",
                    report=error.report,
                    environments=error.environments,
                ) from error
            spent = cpu.tensor(found.diagnostics["iterations"], dtype=torch.int64)
            iterations.add_(spent if counted is None else torch.where(counted, spent, 0))
            return found

        with torch.no_grad(), outside_transforms():
            here = _plain(given)
            anchor = plain(origins), None if joints is None else plain(joints)
            for length in _GROWTH:
                here = self._from(here, step(length, here, *anchor))
            if self._settles:
                here = self._descend(here, lambda at, far: step(_GROWTH[-1], at, *anchor, far))
            here = self._probe(here, lambda at: step(_PROBED, at, *anchor))
            settled = self._settle(here, lambda at, on: step(_LAST, at, *anchor, on))
            here = settled.here

        def uncounted(at: Given, anchor: Anchor) -> Fields:
            none = torch.zeros_like(iterations, dtype=torch.bool)
            return step(_LAST, at, *anchor, none).fields

        begun = self._begun(given, here.state)
        if is_differentiated(t for part in given for t in part.values()):
            begun = self._with_derivative(
                given, here, settled.touching, uncounted, (origins, joints)
            )
        fields, diagnostics = step(_LAST, begun, origins, joints)
        if self._settles:
            fields = fields | {"joint_efforts": self._efforts(begun, fields)}
        if settled.unsettled:
            message = f"friction and normal forces have not settled in {_REPEATS} repetitions"
            mark(diagnostics, dict.fromkeys(settled.unsettled, message), UNCONVERGED)
            check(diagnostics)
            fields = refuse_gradients(fields, failures_of(diagnostics))
        diagnostics["iterations"] = iterations.tolist()
        still = {n: torch.zeros_like(t) for n, t in fields.items() if n.endswith("velocities")}
        return fields | still, diagnostics

    def _engine(self, length: float) -> Engine:
        """The engine for steps of the given length, in time steps of the simulator."""
        if length not in self._engines:
            contact, solver = self._contact, self._solver
            if length == _LAST:
                contact = replace(
                    contact,
                    friction_iterations=max(contact.friction_iterations, _FRICTION_ITERATIONS),
                )
            self._engines[length] = Engine(
                self._scene,
                self._layout,
                dt=length * self._dt,
                scheme="coupled",
                coupling="monolithic",
                contact=contact,
                # Steps of all lengths must be solved to the same length, not to the same velocity.
                solver=replace(
                    solver, tolerance=solver.tolerance / length, metric=None, certify="always"
                ),
                weight="bounded" if length in _GROWTH else "exact",
                limits_dt=self._dt,
                begins_at_state=True,  # inertia alone would move it millions of meters away
            )
        return self._engines[length]

    def _refuse(self, given: Given) -> None:
        """Refuse a scene or control for which no equilibrium is defined."""
        assembly = self._layout.assembly
        names = assembly.surface_names[assembly.cloth_count :]
        nodal = [n for n, p in zip(names, assembly.primitives, strict=False) if p is not None]
        if self._scheme == "projective" or nodal:
            raise InvalidInput(
                "equilibrium: contact at vertices has no positions that friction holds to; "
                + ("use another scheme" if self._scheme == "projective" else "")
                + (f"make {nodal[0]!r} without nodal_contact" if nodal else "")
            )
        for field, part in (
            ("body_wrenches", slice(3, 6)),
            ("base_wrenches", slice(3, 6)),
            ("joint_velocities", slice(None)),
        ):
            values = given.control.get(field)
            if values is not None and numbers_of(values)[..., part].any():
                what = "velocities" if field == "joint_velocities" else "torques"
                raise InvalidInput(f"equilibrium: `control.{field}` must have no {what}")
        if numbers_of(given.control["wind"]).any():
            raise InvalidInput(
                "equilibrium: `control.wind` must be zero: what wind does to a sheet follows from "
                "where the sheet is at the start of a step; roll out with damping until it rests"
            )

    def _begun(self, given: Given, state: Fields) -> Given:
        """Return the inputs at a computed state; prescribed joints and bases keep their graph.

        They begin at their targets, as the weight of robots is evaluated at the start of a step.
        """
        permissions = self._layout.permissions
        kept = {n: t for n, t in given.state.items() if n == "joint_targets"}
        if (joints := state.get("joint_positions")) is not None:
            joints = torch.where(permissions.at_rates, given.state["joint_positions"], joints)
            targets = given.control["joint_positions"]
            kept["joint_positions"] = torch.where(permissions.at_positions, targets, joints)
        if (poses := state.get("base_poses")) is not None:
            floating = permissions.floating[:, None]
            kept["base_poses"] = torch.where(floating, poses, given.control["base_poses"])
        return given._replace(state=state | kept)

    def _with_derivative(
        self,
        given: Given,
        here: Given,
        touching: Tensor,
        step: Callable[[Given, Anchor], Fields],
        anchor: Anchor,
    ) -> Given:
        """Return the start of the last step, with the derivative of its equal end."""
        begun = self._begun(given, here.state)
        if not touching.any():  # the end depends on the start through contact alone
            return begun
        still = {n: here.state[n] for n in _MOVING if n in here.state}
        numbers = _plain(given)
        at = plain(anchor[0]), None if anchor[1] is None else plain(anchor[1])
        linearization = Linearization(
            lambda moving: step(self._begun(numbers, here.state | moving), at), still, touching
        )
        if not in_forward_mode():
            fields = step(begun, anchor)
            moving = as_fixed_point({n: fields[n] for n in still}, linearization, still)
            return self._begun(given, here.state | moving)
        terms = linearization.terms()
        for k in range(int(terms.max())):
            fields = step(begun, anchor)
            moving = at_values({n: fields[n] for n in still}, still)
            begun = _only(terms > k, self._begun(given, here.state | moving), begun)
        return begun

    def _efforts(self, begun: Given, fields: Fields) -> Tensor:
        """Return the efforts of the last step, for prescribed joints with the weight at its end.

        The step uses the weight at its start. It has the same value, but no graph if joints and
        bases are free.
        """
        dynamics = self._engine(_LAST).dynamics
        assert dynamics is not None  # some robot is dynamic
        end = begun.state | {n: fields[n] for n in ("joint_positions", "base_poses")}
        change = dynamics.joint_weights(begun.state, begun.parameters) - dynamics.joint_weights(
            end, begun.parameters
        )
        permissions = self._layout.permissions
        held = permissions.at_rates | permissions.at_positions
        return fields["joint_efforts"] + torch.where(held, change, 0.0)

    def _descend(self, here: Given, step: Callable[[Given, Tensor], _Found]) -> Given:
        """Repeat a step until robots are near an equilibrium, independently in each environment."""
        far = cpu.ones(len(here.state["positions"]), dtype=torch.bool)
        for _ in range(_DESCENTS):
            after = _only(far, self._from(here, step(here, far)), here)
            moved = self._moved(here.state, after.state)
            here, far = after, (moved > _NEAR * self._size).any(dim=-1)
            if not far.any():
                break
        return here

    def _moved(self, before: Fields, after: Fields) -> Tensor:
        """Return the displacements of vertices and joints [m], [B, N + V + J]."""
        surfaces = self._engine(_LAST).surfaces
        moved: Tensor = (surfaces.vertices(after) - surfaces.vertices(before)).norm(dim=-1)
        if "joint_positions" not in after:
            return moved
        turned = (after["joint_positions"] - before["joint_positions"]).abs() * self._lever
        return torch.cat([moved, turned], dim=-1)

    def _from(self, here: Given, found: _Found) -> Given:
        """Make the start of the next step, unless something is falling."""
        after = {n: found.fields[n].detach() for n in _MOVING if n in here.state}
        surfaces = self._engine(_LAST).surfaces
        moved = (surfaces.vertices(here.state | after) - surfaces.vertices(here.state)).norm(dim=-1)
        fallen = ~(moved < _FALLEN * self._size)
        if fallen.any():
            environment, vertex = (int(i) for i in fallen.nonzero()[0])
            name = surface_of_vertex(self._layout, vertex)
            raise SimulationError(
                f"equilibrium: {name!r} is free to move: in a long step from rest it moves by "
                f"{float(moved[environment, vertex]):.3g} m; hold it, or put something under it",
                environments=fallen.any(dim=-1).nonzero()[:, 0].tolist(),
            )
        return here._replace(state=here.state | after)

    def _settle(self, here: Given, step: Callable[[Given, Tensor], _Found]) -> _Settled:
        """Repeat the last step until friction has settled, a limited number of times.

        Environments are independent: neither values nor failures of one affect another.
        """
        slip = here.parameters.get("slip_velocity")
        enough = cpu.tensor([self._dt * self._solver.tolerance])
        if slip is not None:
            enough = torch.maximum(enough, _SETTLED * self._dt * slip.flatten())
        moves = cpu.ones(len(here.state["positions"]), dtype=torch.bool)
        for _ in range(_REPEATS):
            found = step(here, moves)
            after = _only(moves, self._from(here, found), here)
            moves = (self._moved(here.state, after.state) > enough[:, None]).any(dim=-1)
            moves &= cpu.tensor(found.diagnostics["status"], dtype=torch.int64) == CONVERGED
            here = after
            if not moves.any():
                break
        failed = cpu.tensor(found.diagnostics["status"], dtype=torch.int64) != CONVERGED
        touching = cpu.tensor(found.diagnostics["contact_count"], dtype=torch.int64) > 0
        return _Settled(here, moves.nonzero()[:, 0].tolist(), touching & ~failed)

    def _probe(self, here: Given, step: Callable[[Given], _Found]) -> Given:
        """Compute a step; refuse things that a push moves without bound: a singular Hessian."""
        names = ["velocities", "body_velocities"]
        if self._settles:
            names += ["joint_velocities", "base_velocities"]
        pushes = {n: _leaf(here.state[n]) for n in names if n in here.state}
        forces = {}
        if self._settles:
            forces = {
                "joint_efforts": _leaf(here.state["joint_velocities"]),
                "base_wrenches": _leaf(here.state["base_velocities"]),
            }
        with torch.enable_grad():
            control = here.control | {n: here.control[n] + push for n, push in forces.items()}
            found = step(Given(here.state | pushes, control, here.parameters))
        if not any(found.diagnostics["status"]):
            refuse_free_modes(self._layout, found.fields, pushes, forces, _PROBED * self._dt)
        return self._from(here, found)


def _unless_unconverged(check: Check) -> Check:
    """Check all failures except a solve that has not reached its tolerance."""

    def checked(diagnostics: Diagnostics) -> None:
        if any(status not in (CONVERGED, UNCONVERGED) for status in diagnostics["status"]):
            check(diagnostics)

    return checked


def _only(mask: Tensor, after: Given, before: Given) -> Given:
    """Return the later state in the environments of a mask; the others keep their bits."""
    state = {
        name: torch.where(mask.reshape(-1, *[1] * (t.dim() - 1)), t, before.state[name])
        for name, t in after.state.items()
    }
    return after._replace(state=state)


def _plain(given: Given) -> Given:
    """The numbers of the inputs, without graph or tangent."""
    return Given(*({n: plain(t) for n, t in part.items()} for part in given))


def _leaf(values: Tensor) -> Tensor:
    return torch.zeros_like(values).requires_grad_()


def _reach(robot: Mechanism) -> float:
    """Upper bound on the distance of links and their centers of mass, without shifts of joints [m].

    A robot whose joints all meet in one point may have its center of mass outside of it.
    """
    offsets = np.linalg.norm(robot.offset[:, :3, 3], axis=-1).sum()
    return float(offsets + np.linalg.norm(robot.center, axis=-1).max(initial=0.0))


def _turns(robot: Mechanism) -> list[bool]:
    """For each of the J joints, return whether it is rotational."""
    leads = (int(np.flatnonzero(robot.dof == j)[0]) for j in range(robot.joint_count))
    return [bool(robot.turning[link]) for link in leads]


def _resting(given: Given) -> Given:
    """Return the inputs at rest, without resistance to motion."""
    parameters = given.parameters
    at_rest = {n: PARAMETERS[n].at_rest for n in parameters}
    values = {n: 0.0 * parameters[n] + v for n, v in at_rest.items() if v is not None}
    return given.at_rest()._replace(parameters=parameters | values)


def _slower(given: Given, length: float) -> Given:
    """The same inputs with slip velocities at which a longer step slips equally far."""
    parameters, slipping = given.parameters, ("slip_velocity", "joint_slip_rates")
    slip = {n: t / length for n, t in parameters.items() if n in slipping}
    return given._replace(parameters=parameters | slip)
