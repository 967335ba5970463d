"""Quantities of a state: energy, momentum, velocities and poses of links, contact wrenches."""

from __future__ import annotations

from typing import Any, Literal, overload

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.autograd.guards import guarded
from diffcloth_torch.checks import check_bool, check_count, check_shape
from diffcloth_torch.dynamics.totals import Totals
from diffcloth_torch.errors import InvalidInput, warn_caller
from diffcloth_torch.model.options import SolverOptions
from diffcloth_torch.model.quantities import CONTROL, Fields
from diffcloth_torch.operations import label
from diffcloth_torch.sim.inputs.axes import with_axis, without_axes, without_axis
from diffcloth_torch.sim.inputs.border import Border, Given
from diffcloth_torch.sim.inputs.state_fields import check_state_tensor
from diffcloth_torch.sim.observables.links import (
    contact_wrenches,
    link_velocities,
)
from diffcloth_torch.sim.observables.stored_energy import (
    stored_energy,
)
from diffcloth_torch.sim.records.contact_points import ContactPoints, refuse_gradient
from diffcloth_torch.sim.records.controls import Control, Parameters
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.solve.engine import Check, Engine
from diffcloth_torch.sim.solve.masses import vertex_masses
from diffcloth_torch.sim.solve.outcome import make_report, raise_on_failure

__all__ = ["Observables"]

# Targets and weights of springs.
_STORING = [name for name, quantity in CONTROL.items() if quantity.stores]


class Observables:
    """The methods of a simulator that evaluate a state, and return no other state."""

    surfaces: tuple[str, ...]
    scheme: str
    solver: SolverOptions
    _engine: Engine
    _border: Border

    @guarded
    def link_poses(self, state: State) -> dict[str, Tensor]:
        """Return the frames of the links of all robots, differentiable in the state.

        Args:
            state: The state.

        Returns:
            "robot/link" -> homogeneous matrix from the link to the world, shape [4, 4], or
            [B, 4, 4] in a batch.
        """
        fields, batch = self._border.state(state)
        return without_axes(self._engine.surfaces.link_frames(fields), batch)

    @guarded
    def link_velocities(
        self, state: State, parameters: Parameters | None = None
    ) -> dict[str, Tensor]:
        """Return the velocities of the links of all robots, differentiable in both arguments.

        Args:
            state: The state.
            parameters: Physical parameters, of which only the centers of mass are used; None: the
                scene's.

        Returns:
            "robot/link" -> velocity of the link's center of mass (of the origin of its frame if the
            robot is not dynamic), then its angular velocity, in world axes [m/s, rad/s], shape [6],
            or [B, 6] in a batch.
        """
        fields, batch = self._border.state(state)
        centers = self._centers("link", parameters, batch)
        velocities = link_velocities(self._engine.layout, fields, centers)
        return without_axes(velocities, batch)

    @guarded
    def contact_wrenches(
        self, state: State, parameters: Parameters | None = None
    ) -> dict[str, Tensor]:
        """Return net wrenches of contact and attachments, differentiable in both arguments.

        Args:
            state: The state, whose `body_forces` act on its bodies and links.
            parameters: Physical parameters, of which only the centers of mass are used; None: the
                scene's.

        Returns:
            Name of a body, or "robot/link" -> force, then torque about the center of mass (about
            the origin of its frame if it is not dynamic), in world axes [N, N m], shape [6], or
            [B, 6] in a batch.
        """
        fields, batch = self._border.state(state)
        engine = self._engine
        check_state_tensor("body_forces", state.body_forces)
        shape = (*(() if batch is None else (batch,)), *engine.assembly.body_vertices.shape)
        check_shape(label("state", "body_forces"), state.body_forces.shape, [shape])
        forces = with_axis("body_forces", state.body_forces, 2, batch)
        centers = [self._centers(owner, parameters, batch) for owner in ("body", "link")]
        frames = engine.surfaces.frames(fields)
        return without_axes(contact_wrenches(engine.layout, frames, forces, *centers), batch)

    @guarded
    def contacts(self, state: State) -> ContactPoints:
        """Return the contact points and forces of the step that led to a state.

        The result has no gradient: a derivative by the state raises InvalidInput.
        `state.contact_forces`, `state.body_forces` and `contact_wrenches(state)` have gradients.

        Args:
            state: The result of a step of this simulator. Fields that were replaced since do not
                change its contacts.

        Returns:
            All contacts; in a batch with a leading axis, and padded to equal numbers.

        Raises:
            InvalidInput: If the state has no contacts of a step, or the scene has contact at
                vertices (the scheme "projective", and `nodal_contact`).
        """
        nodal = any(primitive is not None for primitive in self._engine.assembly.primitives)
        if nodal or self.scheme == "projective":
            raise InvalidInput(
                "contacts: contact at vertices, of the scheme 'projective' and of bodies with "
                "nodal_contact, has no points; take state.contact_forces and report.contacts"
            )
        fields, batch = self._border.state(state)
        rows = () if state.report is None else state.report.contacts.rows
        if len(rows) != (1 if batch is None else batch):
            raise InvalidInput(
                "contacts: `state` must be the result of a step, whose report has the contacts"
            )
        points = ContactPoints.of(rows, self.surfaces, batched=batch is not None)
        return refuse_gradient(points, list(fields.values()))

    @guarded
    def path(
        self,
        state: State,
        control: Control | None = None,
        parameters: Parameters | None = None,
    ) -> Tensor:
        """Return the polyline that the surfaces follow in a step, to check it independently.

        The solver certifies that each straight segment between successive rows is free of
        collisions; the chord from the first to the last may cross an obstacle. If the step fails,
        the path ends at the failure.

        Args:
            state: The state at the start of the step, without a batch axis.
            control: Targets for the end of the step, and forces; None holds pins and bodies.
            parameters: Physical parameters; None: the scene's.

        Returns:
            Accepted iterates, shape [M, N + V, 3] [m]: cloth vertices, then body vertices; for
            smooth bodies and links the ends of their skeletons and points that follow their
            rotation.
        """
        with torch.no_grad():
            given, batch = self._border.enter(state, control, parameters)
            if batch is not None:
                raise InvalidInput(
                    "path: `state` must be one environment, got a batch; use state[i]"
                )
            return torch.from_numpy(self._engine.path(given, self._check(batched=False)))

    @guarded
    def vertex_masses(
        self, parameters: Parameters | None = None, *, batch_size: int | None = None
    ) -> Tensor:
        """Return the masses of the cloths' vertices, differentiable in density and rest shape.

        Args:
            parameters: Physical parameters; None: the scene's.
            batch_size: Number of environments, >= 1; required if the parameters have a batch axis.

        Returns:
            Mass of each vertex, a third of the mass of each adjacent face [kg], shape [N], or
            [B, N] in a batch.
        """
        if batch_size is not None:
            check_count("vertex_masses: `batch_size`", batch_size, 1)
        physical = self._border.parameters(parameters, batch_size)
        return without_axis(vertex_masses(self._engine.assembly, physical), batch_size)

    @guarded
    def momentum(self, state: State, parameters: Parameters | None = None) -> Tensor:
        """Return the momentum of all objects with mass, differentiable in both arguments.

        Momentum includes cloths with their pinned vertices, dynamic bodies, and all links of
        dynamic robots. Bodies and robots with only prescribed motion have no mass.

        Args:
            state: The state.
            parameters: Physical parameters; None: the scene's.

        Returns:
            Linear momentum, then angular momentum about the origin of the world [kg m/s,
            kg m^2/s], shape [6], or [B, 6] in a batch.
        """
        totals, batch = self._totals(state, parameters)
        return without_axis(totals.momentum, batch)

    @guarded
    def kinetic_energy(self, state: State, parameters: Parameters | None = None) -> Tensor:
        """Return the kinetic energy of the objects in `momentum`, differentiable in both arguments.

        It includes the inertia of the drives, `joint_armature`, at joints under torque or pd.

        Args:
            state: The state.
            parameters: Physical parameters; None: the scene's.

        Returns:
            Energy [J], shape [], or [B] in a batch.
        """
        totals, batch = self._totals(state, parameters)
        return without_axis(totals.kinetic_energy, batch)

    @overload
    def energy(
        self,
        state: State,
        control: Control | None = None,
        parameters: Parameters | None = None,
        *,
        parts: Literal[False] = False,
    ) -> Tensor: ...

    @overload
    def energy(
        self,
        state: State,
        control: Control | None = None,
        parameters: Parameters | None = None,
        *,
        parts: Literal[True],
    ) -> dict[str, Tensor]: ...

    @guarded
    def energy(
        self,
        state: State,
        control: Control | None = None,
        parameters: Parameters | None = None,
        *,
        parts: bool = False,
    ) -> Tensor | dict[str, Tensor]:
        """Return the potential energy of a state: elasticity, springs, gravity, contact.

        Gravity acts on cloths, and on the bodies and robots in `momentum`; its energy is zero at
        the origin of the world. Energy in drives and stops of joints is left out.

        A state holds neither targets nor weights of attachments: a control does. By default,
        attachments between points pull with a weight of one, and attachments to targets are
        released.

        All parts are differentiable in positions, poses, joints and targets of the state, in
        targets and weights of the control, and in the parameters on which they depend; velocities,
        damping and friction are not among these. The gradient by the positions of a cloth is minus
        the force of these parts on it. Backward processes all parts, and many losses with
        `is_grads_batched`, in one call; a second derivative is refused.

        Args:
            state: Positions, poses and joints at which the energy is evaluated.
            control: Control as in a step. Only `attachments`, `attachment_weights` and `soft_pins`
                store energy; other fields, such as forces and the motion of pins and bodies, have
                no effect.
            parameters: Physical parameters; None: the scene's.
            parts: If true, return the parts of the energy.

        Returns:
            Energy [J], shape [], or [B] in a batch; with `parts` a dict of such tensors:
            "stretch", "bending", "attachments", "soft_pins", "contact" (the barrier's) and
            "gravity".

        Raises:
            InvalidInput: If an input has a wrong shape, device or value.
            SimulationError: In backward, if surfaces overlap: the energy is infinite there.
        """
        check_bool("energy: `parts`", parts)
        second: object = control
        if isinstance(second, Parameters) and parameters is None:  # the order of 0.1
            warn_caller(
                "energy: the order is (state, control, parameters): write energy(state, "
                "parameters=...)",
                FutureWarning,
            )
            control, parameters = None, second
        given, batch = self._border.enter(state, control, parameters)
        if control is not None:
            unset = self._border.enter(state, None, None)[0].control
            kept = {name: given.control[name] for name in _STORING if name in given.control}
            given = given._replace(control=unset | kept)
        energies = stored_energy(self._engine.core, self._at_rest(given))
        energies["gravity"] = self._engine.totals(given.state, given.parameters).gravity_energy
        energies = without_axes(energies, batch)
        if parts:
            return energies
        first, *rest = energies.values()
        return sum(rest, first)

    def _at_rest(self, given: Given) -> Fields:
        """Inputs of the core without motion, as energy depends on positions alone."""
        weightless = {"gravity": torch.zeros_like(given.parameters["gravity"])}
        prediction = self._engine.predict(
            given.at_rest()._replace(parameters=given.parameters | weightless)
        )
        return self._engine.core_inputs(given, prediction)

    def _check(self, *, batched: bool) -> Check:
        """Make a function that raises if the diagnostics of a solve show a failure."""

        def check(diagnostics: dict[str, Any]) -> None:
            if any(diagnostics["status"]):
                report = make_report(diagnostics, self.surfaces, batched=batched)
                raise_on_failure(diagnostics, report, throw=self.solver.throw, batched=batched)

        return check

    def _totals(self, state: State, parameters: Parameters | None) -> tuple[Totals, int | None]:
        """Momentum and energy of all objects with mass, and the batch size."""
        fields, batch = self._border.state(state)
        return self._engine.totals(fields, self._border.parameters(parameters, batch)), batch

    def _centers(self, owner: str, parameters: Parameters | None, batch: int | None) -> Tensor:
        """Centers of mass of bodies or links, zero if nothing is dynamic; [B or 1, rows, 3]."""
        fields = self._border.parameters(parameters, batch)
        rows = self._engine.assembly.sizes["K" if owner == "body" else "L"]
        return fields.get(f"{owner}_center", cpu.zeros(1, rows, 3))
