"""Static equilibrium: steps from rest whose length grows until inertia vanishes.

A step of length H from rest minimizes

    P(x) = 1/(2 H^2) (x - x_k)^T M (x - x_k) - f^T x + W(x) + B(x) + D(x - x_0),

with the weight and all other forces f, elasticity W, the barrier B and friction D. As H grows, the
first term vanishes: the steps descend to a stable minimum of the other terms (pseudo-transient
continuation), and the last one is Newton's method without inertia, certified like every step. In
all steps friction counts motion from the state x_0 where the search begins, so that contacts that
stick there keep sticking. Friction uses the normal forces of the previous solution: the last step
is repeated until these no longer change. Its adjoint is that of the equilibrium.

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

from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.model.options import ContactOptions, SolverOptions
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.border import Given
from diffcloth_torch.sim.engine import Check, Engine
from diffcloth_torch.sim.failures import failures_of, mark, refuse_gradients
from diffcloth_torch.sim.layout import Layout
from diffcloth_torch.sim.step import UNCONVERGED
from diffcloth_torch.transforms import numbers_of, outside_transforms, plain

__all__ = ["Equilibria"]

Diagnostics = dict[str, Any]

# Lengths of the steps, in time steps of the simulator. In the last one inertia is below rounding
# compared to any stiffness; modes without stiffness are found in the one before, where inertia
# still counts.
_GROWTH = (1e1, 1e2, 1e3)
_PROBED = 1e5
_LAST = 1e8

# Friction iterations of the last step, so that normal forces settle within it, and how often that
# step is repeated at most.
_FRICTION_ITERATIONS = 8
_REPEATS = 12

# Friction has settled if a repetition moves nothing by more than this fraction of the slip at which
# friction yields.
_SETTLED = 0.1

# Anything that has moved by this many sizes of the scene is falling.
_FALLEN = 30.0

# A mode is free if a velocity moves it by this fraction of its way without forces.
_FREE = 0.5
_AXES = "xyz"


class _Found(NamedTuple):
    """Fields of a state, and the diagnostics of the solve that found it."""

    fields: Fields
    diagnostics: Diagnostics


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
        """Keep the arguments of the engines: those of `Simulator`, checked."""
        self._scene, self._layout, self._dt, self._scheme = scene, layout, dt, scheme
        self._contact, self._solver = contact, solver
        self._engines: dict[float, Engine] = {}
        assembly = layout.assembly
        points = assembly.vertices if len(assembly.vertices) else assembly.body_vertices
        self._size = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0

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
        """
        self._refuse(given)
        given = _resting(given)
        origins = self._engine(_LAST).surfaces.vertices(given.state)
        iterations = torch.zeros(len(given.state["positions"]), dtype=torch.long)

        def step(length: float, at: Given, anchor: Tensor) -> _Found:
            found = _Found(*self._engine(length).step(_slower(at, length), check, anchor))
            iterations.add_(torch.tensor(found.diagnostics["iterations"]))
            return found

        with torch.no_grad(), outside_transforms():
            here = Given(*({n: plain(t) for n, t in part.items()} for part in given))
            anchor = plain(origins)
            for length in _GROWTH:
                here = self._from(here, step(length, here, anchor))
            here = self._probe(here, lambda at: step(_PROBED, at, anchor))
            here, unsettled = self._settle(here, lambda at: step(_LAST, at, anchor))
        fields, diagnostics = step(_LAST, given._replace(state=here.state), origins)
        if unsettled:
            alternate = dict.fromkeys(unsettled, "friction and normal forces alternate")
            mark(diagnostics, alternate, UNCONVERGED)
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
                solver=replace(solver, tolerance=solver.tolerance / length, metric=None),
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
        moved = [r.name for r in assembly.robots if r.is_dynamic]
        if moved:
            raise InvalidInput(
                f"equilibrium: the robot {moved[0]!r} must be prescribed, its joints of position "
                "or velocity actuation and its base fixed or kinematic; roll out until it rests"
            )
        for field, part in (("body_wrenches", slice(3, 6)), ("joint_velocities", slice(None))):
            values = given.control.get(field)
            if values is not None and numbers_of(values)[..., part].any():
                what = "torques" if field == "body_wrenches" else "velocities"
                raise InvalidInput(f"equilibrium: `control.{field}` must have no {what}")
        if numbers_of(given.control["wind"]).any():
            raise InvalidInput(
                "equilibrium: `control.wind` must be zero: what wind does to a sheet follows from "
                "where the sheet is at the start of a step; roll out with damping until it rests"
            )

    def _from(self, here: Given, found: _Found) -> Given:
        """Make the start of the next step, unless something is falling."""
        names = ("positions", "body_poses", "joint_positions", "base_poses")
        after = {n: found.fields[n].detach() for n in names if n in here.state}
        surfaces = self._engine(_LAST).surfaces
        moved = (surfaces.vertices(here.state | after) - surfaces.vertices(here.state)).norm(dim=-1)
        fallen = ~(moved < _FALLEN * self._size)
        if fallen.any():
            environment, vertex = (int(i) for i in fallen.nonzero()[0])
            name = self._surface_of(vertex)
            raise SimulationError(
                f"equilibrium: {name!r} is free to move: in a long step from rest it moves by "
                f"{float(moved[environment, vertex]):.3g} m; hold it, or put something under it",
                environments=fallen.any(dim=-1).nonzero()[:, 0].tolist(),
            )
        return here._replace(state=here.state | after)

    def _settle(self, here: Given, step: Callable[[Given], _Found]) -> tuple[Given, list[int]]:
        """Repeat the last step until friction has settled, a limited number of times."""
        surfaces = self._engine(_LAST).surfaces
        slip = here.parameters.get("slip_velocity")
        enough = self._dt * self._solver.tolerance
        if slip is not None:
            enough = max(enough, _SETTLED * self._dt * float(slip.min()))
        for _ in range(_REPEATS):
            found = step(here)
            after = self._from(here, found)
            moved = surfaces.vertices(after.state) - surfaces.vertices(here.state)
            here, far = after, moved.norm(dim=-1) > enough
            unsettled: list[int] = far.any(dim=-1).nonzero()[:, 0].tolist()
            if not unsettled or any(found.diagnostics["status"]):
                break
        return here, unsettled

    def _probe(self, here: Given, step: Callable[[Given], _Found]) -> Given:
        """Take a step, and refuse things that a push moves without end: the Hessian is singular."""
        names: list[str] = [n for n in ("velocities", "body_velocities") if n in here.state]
        with torch.enable_grad():
            probes = {n: torch.zeros_like(here.state[n]).requires_grad_() for n in names}
            found = step(here._replace(state=here.state | probes))
        if not any(found.diagnostics["status"]):
            self._refuse_free_modes(found.fields, probes)
        return self._from(here, found)

    def _refuse_free_modes(self, fields: Fields, probes: Fields) -> None:
        """Raise if the end of the step, weighted by noise, responds too much to initial pushes."""
        outputs = [fields[n] for n in ("positions", "body_poses")]
        outputs = [t for t in outputs if t.requires_grad]
        if not outputs:
            return
        generator = torch.Generator().manual_seed(0)
        noise = [torch.randn(t.shape, generator=generator, dtype=t.dtype) for t in outputs]
        modes = torch.autograd.grad(
            outputs,
            list(probes.values()),
            noise,
            allow_unused=True,
            materialize_grads=True,
        )
        for name, mode in zip(probes, modes, strict=True):
            count = mode[0].numel() ** 0.5  # a rigid mode spreads its push
            free = mode.flatten(1).norm(dim=1) * count > _FREE * _PROBED * self._dt
            if free.any():
                environments = free.nonzero()[:, 0].tolist()
                raise SimulationError(
                    f"equilibrium: {self._describe(name, mode[environments[0]])}; nothing holds "
                    "it, so that there is no single equilibrium; pin it, or give it friction",
                    environments=environments,
                )

    def _describe(self, field: str, mode: Tensor) -> str:
        """Say what is free, and to do what."""
        assembly = self._layout.assembly
        if field == "body_velocities":
            row = int(mode.abs().amax(dim=1).argmax())
            linear, angular = torch.split(mode[row], 3)
            name = assembly.bodies[row].name
            way, vector = ("slide along", linear)
            if angular.norm() > linear.norm():
                way, vector = ("turn about", angular)
        else:
            vertex = int(mode.norm(dim=1).argmax())
            name = self._surface_of(vertex)
            start = assembly.cloth_vertex_start
            k = assembly.surface_names.index(name)
            vector = mode[start[k] : start[k + 1]].mean(dim=0)
            way = "slide along"
            if vector.norm() < 0.5 * mode[vertex].norm():
                return f"{name!r} is free to turn or to change its shape"
        axis = int(vector.abs().argmax())
        if vector[axis].abs() > 0.95 * vector.norm():
            return f"{name!r} is free to {way} {_AXES[axis]}"
        direction = ", ".join(f"{v:.2f}" for v in (vector / vector.norm()).tolist())
        return f"{name!r} is free to {way} ({direction})"

    def _surface_of(self, vertex: int) -> str:
        """Name of the surface to which a row of all vertices belongs."""
        assembly = self._layout.assembly
        ends = [*assembly.cloth_vertex_start[1:]]
        ends += [len(assembly.vertices) + end for end in assembly.body_vertex_start[1:]]
        surface = next(s for s, end in enumerate(ends) if vertex < end)
        return assembly.surface_names[surface]


def _resting(given: Given) -> Given:
    """The same inputs at rest, without damping and drag, which do not act there."""
    state, parameters = given.state, given.parameters
    still = {n: torch.zeros_like(t) for n, t in state.items() if n.endswith("velocities")}
    resisting = ("damping", "normal_drag", "tangential_drag")
    none = {n: 0.0 * t for n, t in parameters.items() if n in resisting}
    return given._replace(state=state | still, parameters=parameters | none)


def _slower(given: Given, length: float) -> Given:
    """The same inputs with a slip velocity at which a longer step slips equally far."""
    parameters = given.parameters
    slip = {n: t / length for n, t in parameters.items() if n == "slip_velocity"}
    return given._replace(parameters=parameters | slip)
