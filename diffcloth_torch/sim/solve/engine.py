"""One step of a scene, on checked fields that all have a leading axis of environments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.autograd.core_function import Constant, failing_as
from diffcloth_torch.autograd.transforms import is_differentiated
from diffcloth_torch.checks import FloatArray
from diffcloth_torch.dynamics.dynamics import Dynamics, Prediction
from diffcloth_torch.dynamics.limits import limit_stiffness
from diffcloth_torch.dynamics.totals import Totals
from diffcloth_torch.errors import TurnedTooFar
from diffcloth_torch.model.assembly import Assembly, assemble
from diffcloth_torch.model.options import INTEGRATORS, SCHEMES, ContactOptions, SolverOptions
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.inputs.border import Given
from diffcloth_torch.sim.inputs.layout import Layout
from diffcloth_torch.sim.records.surfaces import Surfaces
from diffcloth_torch.sim.solve.cores import (
    CoreOptions,
    arrays_of,
    constants,
    core_inputs,
    make_core,
    with_deforming_bodies,
)
from diffcloth_torch.sim.solve.failures import failures_of, mark, refuse_gradients
from diffcloth_torch.sim.solve.masses import cloth_totals
from diffcloth_torch.sim.solve.motion import (
    held_targets,
    prescribed_motion,
    reached_poses,
    with_rows,
)
from diffcloth_torch.sim.solve.staggered import Staggered
from diffcloth_torch.sim.solve.step import INTERSECTING, TURNED, Outcome, take_step

__all__ = ["Engine"]

Diagnostics = dict[str, Any]
Check = Callable[[Diagnostics], None]
"""Raises an error if the diagnostics of a solve show a failure."""


class Engine:
    """Solves the steps of a scene. Immutable once its simulator is made.

    Attributes:
        layout: Shapes, and rows by name.
        surfaces: The surfaces that a state places.
        core: The simulator in C++.
        dynamics: Dynamics of bodies and robots; None if all are bodies on prescribed poses.
        constants: Default inputs of the core.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        *,
        dt: float,
        scheme: str,
        coupling: str,
        contact: ContactOptions,
        solver: SolverOptions,
        weight: str | None = None,
        limits_dt: float | None = None,
        begins_at_state: bool = False,
        integrator: str = INTEGRATORS[0],
    ) -> None:
        """Make the cores; the arguments are the checked arguments of `Simulator`.

        Args:
            scene: The scene.
            layout: Its sizes and permissions.
            dt: Time step [s].
            scheme: Name of the scheme.
            coupling: Name of the coupling.
            contact: Options of contact.
            solver: Options of the solver.
            weight: As for `Dynamics`.
            limits_dt: Time step that sets the stiffness of joint limits; None: `dt`.
            begins_at_state: As for `CoreOptions`.
            integrator: Name of the integrator.
        """
        assembly = layout.assembly
        self.layout, self._dt = layout, dt
        self.dynamics = Dynamics(assembly, dt, weight) if layout.has_coordinates else None
        self.surfaces = Surfaces.of(scene, assembly)
        self.constants: Mapping[str, Constant] = {}
        # A scene without cloths has nothing to split or to couple.
        options = CoreOptions(
            bending_models=[cloth.bending_model for cloth in scene.cloths],
            dt=dt,
            scheme=scheme if scene.cloths else SCHEMES[0],
            contact=contact,
            solver=solver,
            begins_at_state=begins_at_state,
            integrator=integrator if scene.cloths else INTEGRATORS[0],
        )
        stiffness = None
        if self.dynamics is not None:
            stiffness = limit_stiffness(assembly, limits_dt or dt, scene.gravity)
        self.core = make_core(assembly, options, stiffness)
        self._cloths_alone = self.core
        if assembly.deforming_count:
            cloths = scene.cloths[: -assembly.deforming_count]
            alone = options._replace(bending_models=[cloth.bending_model for cloth in cloths])
            self._cloths_alone = make_core(assemble(Scene(cloths)), alone)
        self._staggered = None
        in_turn = coupling != "monolithic" and scene.cloths and layout.is_dynamic
        if in_turn and self.dynamics is not None and stiffness is not None:
            self._staggered = Staggered(
                coupling, layout, self.surfaces, self.dynamics, options, stiffness
            )
        self._scene_rest = torch.from_numpy(np.array(assembly.rest_positions))[None]

    def keep(self, parameters: Fields) -> None:
        """Prepare the parameters of the scene as constants: nobody may edit these tensors."""
        self.constants = constants(self.layout, parameters)
        if self.dynamics is not None:
            self.dynamics.keep(parameters)

    @property
    def assembly(self) -> Assembly:
        """Arrays of the scene."""
        return self.layout.assembly

    def smallest_nonadjacent_distance(self) -> float:
        """Smallest distance between parts of one cloth at rest that share no vertex [m]."""
        return self._cloths_alone.smallest_nonadjacent_distance()

    def step(
        self,
        given: Given,
        check: Check,
        origins: Tensor | None = None,
        joint_origins: Tensor | None = None,
    ) -> tuple[Fields, Diagnostics]:
        """Compute a step.

        Args:
            given: Checked state, control and parameters.
            check: Checks the diagnostics of each solve.
            origins: Positions of all vertices from which friction measures motion, [B, N + V, 3] m;
                None: the start of the step, or the choice of a staggered coupling.
            joint_origins: Values of joints from which their friction measures motion, [B, J].

        Returns:
            Fields of the next state except the time, [B, ...], and the diagnostics. Backward
            refuses gradients of environments that failed.
        """
        if self._staggered is None:
            outcome, after = self._step_together(given, check, origins, joint_origins)
        else:
            outcome, after = self._step_in_turn(given, check)
        fields = {
            "positions": outcome.positions,
            "velocities": outcome.velocities,
            "body_forces": outcome.body_forces,
            "contact_forces": outcome.contact_forces,
            "pin_forces": outcome.pin_forces[:, : len(self.assembly.pins)],
            **after,
            "soft_pin_targets": given.control["soft_pins"],
        }
        environments = outcome.positions.shape[0]
        fields = {
            n: t if t.shape[0] == environments else t.expand(environments, *t.shape[1:])
            for n, t in fields.items()
        }
        return refuse_gradients(fields, failures_of(outcome.diagnostics)), outcome.diagnostics

    def _step_together(
        self,
        given: Given,
        check: Check,
        origins: Tensor | None,
        joint_origins: Tensor | None,
    ) -> tuple[Outcome, Fields]:
        """Solve for all objects at once; return the outcome, and fields of bodies and robots."""
        prediction = self.predict(given, joint_origins)
        inputs = self.core_inputs(given, prediction)
        if origins is not None:
            inputs["friction_origins"] = origins
        outcome = take_step(self.core, inputs, self.constants)
        if self.dynamics is None or prediction is None:
            check(outcome.diagnostics)
            return outcome, self._moved(given, outcome.diagnostics["ended"])
        if INTERSECTING in outcome.diagnostics["status"]:
            check(outcome.diagnostics)
        after = self._advanced(self.dynamics, prediction, outcome)
        far = self.dynamics.turned_too_far(prediction, after, outcome.body_forces)
        if far:
            mark(outcome.diagnostics, far, TURNED)
        check(outcome.diagnostics)
        return outcome, {**after, "joint_targets": self._held_targets(given)}

    def _moved(self, given: Given, ended: Mapping[int, FloatArray]) -> Fields:
        """Fields of bodies that all move on prescribed poses, some only part of the way."""
        control = given.control
        if ended:
            poses = reached_poses(control["body_poses"], ended, len(given.state["positions"]))
            control = control | {"body_poses": poses}
        return prescribed_motion(self.layout, given.state, control, self._dt)

    def _advanced(self, dynamics: Dynamics, prediction: Prediction, outcome: Outcome) -> Fields:
        """Fields of bodies and robots after a step that has moved them."""
        forces, coordinates = outcome.body_forces, outcome.coordinates
        if coordinates is None:  # robots without a joint that moves
            coordinates = forces.new_zeros(len(forces), 0)
        after = dynamics.advance(prediction, coordinates, forces)
        ended = outcome.diagnostics["ended"]
        if ended:
            poses = reached_poses(prediction.body_targets, ended, len(forces))
            with torch.no_grad():
                stopped = dynamics.end_at(prediction, poses)
                there = dynamics.advance(stopped, coordinates, forces)
            after = with_rows(after, there, ended)
        return after

    def _step_in_turn(self, given: Given, check: Check) -> tuple[Outcome, Fields]:
        """Compute a step like `_step_together`, by a staggered coupling."""
        assert self._staggered is not None
        inputs = self.core_inputs(given, None)
        outcome, after = self._staggered.step(given, inputs, check)
        return outcome, {**after, "joint_targets": self._held_targets(given)}

    def _held_targets(self, given: Given) -> Tensor:
        return held_targets(self.layout, given.state, given.control)

    def path(self, given: Given, check: Check) -> FloatArray:
        """Polyline that the surfaces of one environment follow in a step, [M, N + V, 3]."""
        with failing_as(operation()):
            if self._staggered is not None:
                return self._staggered.path(given, self.core_inputs(given, None), check)
            prediction = self.predict(given)
            if self.dynamics is not None and prediction is not None:
                for environment, sentence in self.dynamics.too_fast(prediction).items():
                    raise TurnedTooFar(f"{operation()}: {sentence}", environments=[environment])
            return self.core.path(arrays_of(self.core_inputs(given, prediction)))

    def predict(self, given: Given, joint_origins: Tensor | None = None) -> Prediction | None:
        """Predict bodies and robots without contact; None if all are bodies on prescribed poses."""
        if self.dynamics is None:
            return None
        return self.dynamics.predict(*given, joint_origins=joint_origins)

    def core_inputs(self, given: Given, prediction: Prediction | None) -> Fields:
        """Inputs of the core, including the prediction of bodies and robots."""
        inputs = core_inputs(*given)
        if self.assembly.deforming_count:
            inputs |= with_deforming_bodies(self.layout, given)
        if prediction is not None:
            inputs |= prediction.core_inputs()
        rest = inputs.get("rest_positions")
        if rest is not None and not is_differentiated((rest,)) and self._is_of_scene(rest):
            del inputs["rest_positions"]  # the core has prepared the rest shape of the scene
        return inputs

    def _is_of_scene(self, rest: Tensor) -> bool:
        of_scene = self.constants.get("rest_positions")
        return (of_scene is not None and rest is of_scene.tensor) or torch.equal(
            rest, self._scene_rest
        )

    def totals(self, state: Fields, parameters: Fields) -> Totals:
        """Momentum and energy of all objects with mass."""
        totals = cloth_totals(self.assembly, state, parameters)
        if self.dynamics is not None:
            totals = totals.plus(self.dynamics.totals(state, parameters))
        return totals
