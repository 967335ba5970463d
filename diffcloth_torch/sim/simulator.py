"""The simulator: a scene, a time step and a solver, which together define a step."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch

from diffcloth_torch.autograd.guards import guarded, uncompiled
from diffcloth_torch.checks import check_choice, check_count
from diffcloth_torch.errors import warn_caller
from diffcloth_torch.model.assembly import assemble
from diffcloth_torch.model.defaults import has_barrier, has_contact, scene_parameters
from diffcloth_torch.model.options import (
    ABILITIES,
    COUPLINGS,
    INTEGRATORS,
    SCHEMES,
    ContactOptions,
    SolverOptions,
)
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.operations import called
from diffcloth_torch.saved import saved
from diffcloth_torch.sim.half_step import remember, with_half_step_velocities
from diffcloth_torch.sim.inputs.axes import without_axes
from diffcloth_torch.sim.inputs.border import Border, Given
from diffcloth_torch.sim.inputs.control_fields import check_control
from diffcloth_torch.sim.inputs.layout import Layout
from diffcloth_torch.sim.inputs.parameter_fields import check_parameters, default_fields
from diffcloth_torch.sim.inputs.schemes import check_scheme
from diffcloth_torch.sim.observables.observables import (
    Observables,
)
from diffcloth_torch.sim.overlaps import with_overlaps_ignored
from diffcloth_torch.sim.records.controls import Control, Parameters
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.records.trajectory import Trajectory
from diffcloth_torch.sim.rollout import Controls, StepParameters, roll_out
from diffcloth_torch.sim.solve.engine import Engine
from diffcloth_torch.sim.solve.outcome import lazy_report, make_report
from diffcloth_torch.sim.start import (
    StartWatch,
    check_gains,
    check_start,
    check_time_step,
    check_tolerance,
    choose_barrier,
    choose_slip_rates,
    initial_tensors,
)
from diffcloth_torch.sim.statics.equilibrium import Equilibria

__all__ = ["Simulator"]

_DEFAULT_CONTACT = ContactOptions()
_DEFAULT_SOLVER = SolverOptions()


@saved
class Simulator(Observables):
    """Steps a scene through time. Immutable, and safe to use from several threads.

    Attributes:
        scene: The scene.
        dt: Time step [s].
        scheme: "coupled", "split" or "projective".
        integrator: "implicit_euler" or "second_order".
        coupling: "monolithic", "rigid_to_cloth" or "cloth_to_rigid".
        contact: Contact options, as given.
        solver: Solver options.
        surfaces: Names of the S surfaces: cloths, bodies, then links that have collision shapes.
        slices: Name of a surface -> its rows in `positions` for a cloth, in `body_forces` for a
            body or a link.
        joint_slices: Name of a robot -> its rows in `joint_positions` and the like.
    """

    scene: Scene
    dt: float
    scheme: str
    integrator: str
    coupling: str
    contact: ContactOptions
    solver: SolverOptions
    surfaces: tuple[str, ...]
    slices: dict[str, slice]
    joint_slices: dict[str, slice]

    @called("Simulator")
    def __init__(
        self,
        scene: Scene,
        dt: float,
        *,
        scheme: str = "coupled",
        coupling: str = "monolithic",
        contact: ContactOptions = _DEFAULT_CONTACT,
        solver: SolverOptions = _DEFAULT_SOLVER,
        integrator: str = "implicit_euler",
    ) -> None:
        """Prepare the solver, and choose barrier parameters by default.

        The first step from an initial state warns if the barrier throws surfaces apart
        (`BarrierStartWarning`).

        Args:
            scene: The scene.
            dt: Time step [s], > 0; a plain number or a float64 one.
            scheme: "coupled" solves elasticity and contact together; "split" solves elasticity
                first and then contact, with a similar result, and needs a staggered coupling if a
                body or a robot is dynamic. "projective" is the baseline: it solves elasticity with
                dry friction at the cloths' vertices, against boxes, spheres, capsules or planes,
                and surfaces may cross between vertices.
            coupling: Coupling of cloths with dynamic bodies and robots: "monolithic" solves for
                both together; "rigid_to_cloth" moves bodies with their velocities, solves the
                cloths against them, and applies the contact impulses to the velocities;
                "cloth_to_rigid" solves the cloths against bodies at rest and then moves the bodies.
            contact: Options of contact and friction.
            solver: Tolerance and limits of the solver.
            integrator: "implicit_euler", or "second_order" for the scheme "coupled": second order
                where motion is smooth, implicit Euler's behavior in contact. Its states hold
                velocities half a step before the positions: see `at_half_step`.

        Raises:
            IntersectingState: If surfaces of the scene intersect, touch, or are closer than their
                thickness. The message names all pairs, and the `ignore_contact` argument for pairs
                of bodies and links.
            InvalidInput: If a value is not accepted, the barrier is too wide for the meshes, or a
                pd joint has no gains.
            TypeError: If an argument has a wrong type.
        """
        for name, value, kind in (
            ("scene", scene, Scene),
            ("contact", contact, ContactOptions),
            ("solver", solver, SolverOptions),
        ):
            if not isinstance(value, kind):
                raise TypeError(
                    f"Simulator: `{name}` must be a {kind.__name__}, got {type(value).__name__}"
                )
        self.scene, self.contact, self.solver = scene, contact, solver
        self.dt = check_time_step(dt)
        self.scheme = check_choice("Simulator: `scheme`", scheme, SCHEMES)
        self.coupling = check_choice("Simulator: `coupling`", coupling, COUPLINGS)
        self.integrator = check_choice("Simulator: `integrator`", integrator, INTEGRATORS)
        abilities = ABILITIES[scheme]
        assembly = assemble(scene, all_nodal=not abilities["barrier"])
        self._assembly = with_overlaps_ignored(scene, assembly, initial_tensors(assembly))
        self._layout = Layout(self._assembly)
        check_gains(self._layout)
        check_scheme(self.scheme, self.coupling, self.integrator, scene, self._layout, solver)
        self.surfaces = self._assembly.surface_names
        starts = self._assembly.cloth_vertex_start.tolist()
        rows = [slice(a, b) for a, b in pairwise(starts)]
        cloths = zip(scene.cloth_names, rows, strict=True)
        self.slices = {**dict(cloths), **self._layout.rigid_vertices}
        self.joint_slices = dict(self._assembly.joint_slices)
        self._engine = Engine(
            scene,
            self._layout,
            dt=self.dt,
            scheme=scheme,
            coupling=coupling,
            contact=contact,
            solver=solver,
            integrator=integrator,
        )
        self._core = self._engine.core
        self._start_watch = StartWatch(self._engine)
        self._equilibria = Equilibria(
            scene, self._layout, dt=self.dt, scheme=scheme, contact=contact, solver=solver
        )
        nonadjacent = self._engine.smallest_nonadjacent_distance()
        self._defaults = scene_parameters(scene, self._assembly, has_contact(scene, contact))
        self._defaults |= choose_slip_rates(self._assembly, contact)
        fields = default_fields(self._defaults)
        self._border = Border(self._layout, fields, nonadjacent, self_contact=contact.self_contact)
        start, _ = self._border.enter(self._state_at_rest(None), None, None)
        if has_barrier(scene, contact, scheme):
            self._defaults |= choose_barrier(
                self._engine, self._border, scene, contact, start, nonadjacent
            )
        self._engine.keep(self._border.defaults)
        if "barrier_distance" in self._defaults:
            distance = float(self._defaults["barrier_distance"])
            check_tolerance(solver.tolerance, distance, self.dt)
        if abilities["barrier"]:
            check_start(self._engine, scene, start._replace(parameters=self._border.defaults))
        if self.integrator == "second_order":
            remember(self, self._engine.surfaces)

    def __getstate__(self) -> dict[str, Any]:
        arguments = ("scene", "dt", "scheme", "coupling", "contact", "solver", "integrator")
        return {name: getattr(self, name) for name in arguments}

    def __setstate__(self, arguments: dict[str, Any]) -> None:
        self.__init__(**arguments)  # type: ignore[misc]

    def __repr__(self) -> str:
        others = "" if self.coupling == "monolithic" else f", coupling={self.coupling!r}"
        if self.integrator != "implicit_euler":
            others += f", integrator={self.integrator!r}"
        return f"Simulator({self.scene!r}, dt={self.dt:g}, scheme={self.scheme!r}{others})"

    @guarded
    def initial_state(self, batch_size: int | None = None) -> State:
        """Make the state that the scene describes, at rest.

        With `integrator="second_order"`, velocities are half a step before the positions: see
        `at_half_step`, which computes one step.

        Args:
            batch_size: Number of identical environments, >= 1; None makes a state without a batch
                axis.
        """
        if batch_size is not None:
            check_count("initial_state: `batch_size`", batch_size, 1)
        state = self._state_at_rest(batch_size)
        if self.integrator != "second_order":
            return state
        with torch.no_grad():
            return with_half_step_velocities(state, self._advance(state, None, None)).detach()

    def _state_at_rest(self, batch_size: int | None) -> State:
        environments = () if batch_size is None else (batch_size,)
        copies = {
            name: tensor.expand((*environments, *tensor.shape)).clone(
                memory_format=torch.contiguous_format
            )
            for name, tensor in initial_tensors(self._assembly).items()
        }
        return State(**copies, report=None, _surfaces=self._engine.surfaces)

    @guarded
    def control(
        self,
        *,
        pins: Any = None,
        soft_pins: Any = None,
        body_poses: Any = None,
        forces: Any = None,
        body_wrenches: Any = None,
        joint_positions: Any = None,
        joint_velocities: Any = None,
        joint_efforts: Any = None,
        base_poses: Any = None,
        base_wrenches: Any = None,
        attachments: Any = None,
        attachment_weights: Any = None,
        wind: Any = None,
        body_vertices: Any = None,
    ) -> Control:
        """Make a control and check it against the scene.

        A target that is None holds its current value; forces, torques and velocities default to
        zero. All fields but `forces` and `wind` may also be set by name, as in `Control`.

        Args:
            pins: Positions of the pins at the end of the step [m], shape [P, 3].
            soft_pins: Positions to which the soft pins pull [m], shape [Q, 3].
            body_poses: Poses of kinematic bodies at the end of the step, shape [K, 7].
            forces: Forces on the cloth vertices [N], shape [N, 3].
            body_wrenches: Forces and torques on dynamic bodies [N, N m], shape [K, 6].
            joint_positions: Targets of position and pd joints [rad or m], shape [J].
            joint_velocities: Targets of velocity and pd joints [rad/s or m/s], shape [J].
            joint_efforts: Efforts at torque and pd joints [N m or N], shape [J].
            base_poses: Poses of kinematic bases at the end of the step, shape [R, 7].
            base_wrenches: Forces and torques on floating bases [N, N m], shape [R, 6].
            attachments: Targets of attachments at the end of the step [m], shape [U, 3].
            attachment_weights: Weights of the springs of attachments [-], shape [A].
            wind: Velocity of the air around the cloths [m/s], shape [3].
            body_vertices: Vertices of deforming bodies at the end of the step [m], shape [D, 3].

        Raises:
            InvalidInput: If a name, shape or value is not accepted.
            TypeError: If a value is not an array of numbers on the CPU.
        """
        control = Control(
            pins=pins,
            soft_pins=soft_pins,
            body_poses=body_poses,
            forces=forces,
            body_wrenches=body_wrenches,
            joint_positions=joint_positions,
            joint_velocities=joint_velocities,
            joint_efforts=joint_efforts,
            base_poses=base_poses,
            base_wrenches=base_wrenches,
            attachments=attachments,
            attachment_weights=attachment_weights,
            wind=wind,
            body_vertices=body_vertices,
        )
        return check_control(self._layout, control)

    @guarded
    def default_parameters(self) -> Parameters:
        """Copy the parameters of the scene to new tensors; change them with `.replace(...)`.

        They are no iterator, as `torch.nn.Module.parameters()` is: optimizers take tensors, such as
        `[leaf]` of `default_parameters().replace(stretch=leaf)`.
        """
        copies = {name: tensor.clone() for name, tensor in self._defaults.items()}
        return Parameters(**copies, _unbatched=tuple(copies))

    def parameters(self) -> Parameters:
        """Return `default_parameters()`: an alias, the name in 0.1, which warns."""
        warn_caller(
            "Simulator.parameters: its name is `default_parameters` since 0.2.0; `parameters` of "
            "torch is an iterator for optimizers",
            FutureWarning,
        )
        return self.default_parameters()

    @guarded
    def step(
        self,
        state: State,
        control: Control | None = None,
        parameters: Parameters | None = None,
    ) -> State:
        """Advance by one time step. Pure, and differentiable in all three arguments.

        Args:
            state: The state at the start of the step.
            control: Targets for the end of the step, and forces; None holds pins and bodies.
            parameters: Physical parameters; None: the scene's.

        Returns:
            The state after `dt`. All of its tensors but `time` carry gradients: `positions`,
            `velocities`, contact and pin forces, `soft_pin_targets`, and the poses, positions,
            velocities, targets and efforts of bodies, joints and bases.

        Raises:
            IntersectingState: If surfaces intersect in `state`.
            InfeasibleMotion: If bodies, joints or pins cannot reach their targets without an
                intersection.
            NotConverged: If the solver stops before it reaches its tolerance.
            TurnedTooFar: If a dynamic body in contact turns by more than 1 rad. With
                `SolverOptions(throw=False)`, these last three are returned as a status instead.
            InvalidInput: If a shape or value is not accepted.
            TypeError: If a tensor of the state is not float64 on the CPU.
        """
        return self._step(state, control, parameters)

    @guarded
    def equilibrium(
        self,
        state: State,
        control: Control | None = None,
        parameters: Parameters | None = None,
    ) -> State:
        """Find a stable static equilibrium near a state. Pure, and differentiable like a step.

        All forces balance, with pins and prescribed bodies at their targets. Friction resists
        displacement from the positions in `state`, so the result depends on these, as in reality.
        Damping has no effect at rest: its gradient is zero.

        Args:
            state: Start of the search, and origin of friction's displacements. Its velocities are
                ignored.
            control: Targets, and forces that act permanently; None holds pins and bodies.
            parameters: Physical parameters; None: the scene's.

        Returns:
            The state at rest, at the time of `state`. Its derivatives are those of the equilibrium,
            with settled friction and normal forces: backward and forward mode iterate the
            derivative of the last step until it settles as well.

        Raises:
            IntersectingState: If surfaces intersect in `state`.
            SimulationError: If something is free to move, so that the Hessian is singular, or
                swings with a period of more than some 2e4 time steps; the message names it.
            NotConverged: If a solve stops before it reaches its tolerance, or friction does not
                settle.
            InfeasibleMotion: As for `step`.
            InvalidInput: As for `step`; also if contact is at vertices, or the control sets torques
                on bodies or bases, or velocities of joints.
        """
        given, batch = self._border.enter(state, control, parameters)
        fields, diagnostics = self._equilibria.find(given, self._check(batched=batch is not None))
        return State(
            **without_axes(fields, batch),
            time=state.time,
            report=make_report(diagnostics, self.surfaces, batched=batch is not None),
            _surfaces=self._engine.surfaces,
        )

    @uncompiled
    def rollout(
        self,
        state: State,
        controls: Controls = None,
        parameters: StepParameters = None,
        *,
        steps: int | None = None,
        checkpoint_every: int | None = None,
    ) -> Trajectory:
        """Simulate several steps.

        Args:
            state: The state before the first step.
            controls: A sequence with one control, or None to hold, for each step; or a function of
                the index of a step and the state before it; or None to hold throughout.
            parameters: Physical parameters of all steps, or a function of the index of a step and
                the state before it.
            steps: Number of steps; required unless `controls` is a sequence.
            checkpoint_every: Number of steps whose tapes are kept at a time; backward repeats these
                steps from the state before them. Functions are then called again and must return
                the same values, otherwise backward raises `InvalidInput`.

        Returns:
            The states after each step, as a list that also has each of their fields over time.
        """
        controls, parameters = self._kept(controls, parameters)
        return roll_out(self._next, state, controls, parameters, steps, checkpoint_every)

    def _step(self, state: State, control: Control | None, parameters: Parameters | None) -> State:
        given, batch = self._border.enter(state, control, parameters)
        self._start_watch.look_at(state, given, batch)
        after = self._advance_given(state, given, batch)
        self._start_watch.close(state)
        return after

    def _advance(
        self, state: State, control: Control | None, parameters: Parameters | None
    ) -> State:
        """Compute a step without a check for throws at its start."""
        return self._advance_given(state, *self._border.enter(state, control, parameters))

    def _advance_given(self, state: State, given: Given, batch: int | None) -> State:
        fields, diagnostics = self._engine.step(given, self._check(batched=batch is not None))
        return State(
            **without_axes(fields, batch),
            time=state.time + self.dt,
            report=lazy_report(diagnostics, self.surfaces, batched=batch is not None),
            _surfaces=self._engine.surfaces,
        )

    def _copies(
        self, controls: Controls, parameters: StepParameters
    ) -> tuple[Controls, StepParameters]:
        """Copy arrays and lists: edits before backward must not change repeated steps."""
        if isinstance(controls, Sequence):
            controls = [
                c if c is None else check_control(self._layout, c, f"controls[{k}]")
                for k, c in enumerate(controls)
            ]
        if parameters is not None and not callable(parameters):
            parameters = check_parameters(parameters)
        return controls, parameters

    # The parts of a rollout between calls of its caller's functions.
    _next, _kept = guarded(_step, "rollout"), guarded(_copies, "rollout")

    def _inputs(
        self, state: State, control: Control | None, parameters: Parameters | None
    ) -> tuple[Fields, int | None]:
        """Inputs of the core, and the batch size."""
        given, batch = self._border.enter(state, control, parameters)
        return self._engine.core_inputs(given, self._engine.predict(given)), batch


def _restore(
    scene: Scene,
    dt: float,
    scheme: str,
    contact: ContactOptions,
    solver: SolverOptions,
    coupling: str,
) -> Simulator:
    """Make a simulator from a file of version 0.1, which refers to this function."""
    return Simulator(scene, dt, scheme=scheme, coupling=coupling, contact=contact, solver=solver)
