"""The simulator: a scene, a time step and a solver, and the step that they define."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Sequence
from functools import wraps
from itertools import pairwise
from typing import Any, Literal, ParamSpec, TypeVar, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch.checks import (
    POSITIVE,
    check_bool,
    check_choice,
    check_count,
    check_number,
    check_shape,
)
from diffcloth_torch.dynamics.dynamics import Dynamics, Prediction
from diffcloth_torch.dynamics.limits import limit_stiffness
from diffcloth_torch.dynamics.totals import Totals
from diffcloth_torch.errors import IntersectingState, InvalidInput
from diffcloth_torch.model.defaults import (
    check_barrier,
    choose_barrier_distance,
    has_barrier,
    has_contact,
    scene_parameters,
)
from diffcloth_torch.model.options import COUPLINGS, SCHEMES, ContactOptions, SolverOptions
from diffcloth_torch.model.quantities import STATE, shape_of
from diffcloth_torch.model.scene import Scene, assemble
from diffcloth_torch.sim.controls import Control, Parameters
from diffcloth_torch.sim.cores import CoreOptions, make_core
from diffcloth_torch.sim.coupling import Staggered
from diffcloth_torch.sim.failures import failures_of, refuse_gradients
from diffcloth_torch.sim.inputs import (
    Fields,
    check_control,
    check_parameters,
    constants,
    control_fields,
    core_inputs,
    default_fields,
    parameter_fields,
    state_fields,
)
from diffcloth_torch.sim.layout import Layout
from diffcloth_torch.sim.links import contact_wrenches, link_poses, link_velocities
from diffcloth_torch.sim.masses import cloth_totals, vertex_masses
from diffcloth_torch.sim.motion import (
    ended_poses,
    held_targets,
    prescribed_motion,
    with_rows,
)
from diffcloth_torch.sim.outcome import make_report, raise_on_failure
from diffcloth_torch.sim.rollout import roll_out
from diffcloth_torch.sim.schemes import check_scheme
from diffcloth_torch.sim.state import State, Surfaces
from diffcloth_torch.sim.step import (
    Outcome,
    as_array,
    refuse_transforms,
    take_step,
)

__all__ = ["Simulator"]

# A start is deep inside the barrier below this part of the gap at rest: a sheet is then thrown
# up by several barrier distances.
_DEEP = 0.25

# What a step may be off by when its solver stops: in a scene of micrometers the default tolerance
# would be as long as the barrier.
_LARGEST_PART_OF_BARRIER = 0.1

_DEFAULT_CONTACT = ContactOptions()
_DEFAULT_SOLVER = SolverOptions()


P = ParamSpec("P")
T = TypeVar("T")


_UNCOMPILED: dict[Callable[..., Any], Callable[..., Any]] = {}


def _uncompiled(method: Callable[P, T]) -> Callable[P, T]:
    """The method as `torch.compile` leaves it alone: there is nothing to fuse in a step."""
    # Importing the compiler takes longer than all the rest; nobody compiles without it.
    if not hasattr(sys.modules.get("torch._dynamo"), "disable"):
        return method
    if method not in _UNCOMPILED:
        _UNCOMPILED[method] = torch.compiler.disable(method)  # type: ignore[no-untyped-call]
    return _UNCOMPILED[method]


def _memory_errors(method: Callable[P, T]) -> Callable[P, T]:
    """Let torch's lack of memory be the error that NumPy and the core raise for theirs."""

    @wraps(method)
    def guarded(*args: P.args, **keywords: P.kwargs) -> T:
        try:
            return _uncompiled(method)(*args, **keywords)
        except RuntimeError as error:
            if "can't allocate memory" in str(error):
                raise MemoryError(f"{method.__name__}: {error}") from error
            raise

    return guarded


class Simulator:
    """Steps a scene through time. Immutable, and safe to use from several threads.

    Attributes:
        scene: What is simulated.
        dt: Time step [s].
        scheme: "coupled", "split" or "projective".
        coupling: "monolithic", "rigid_to_cloth" or "cloth_to_rigid".
        contact: Contact options, as given.
        solver: Solver options.
        surfaces: Names of the S surfaces: cloths, bodies, then links that have a shape.
        slices: Name of a surface -> its rows in `positions` for a cloth, in `body_forces` for a
            body or a link.
        joint_slices: Name of a robot -> its rows in `joint_positions` and the like.
    """

    scene: Scene
    dt: float
    scheme: str
    coupling: str
    contact: ContactOptions
    solver: SolverOptions
    surfaces: tuple[str, ...]
    slices: dict[str, slice]
    joint_slices: dict[str, slice]

    def __init__(
        self,
        scene: Scene,
        dt: float,
        *,
        scheme: str = "coupled",
        coupling: str = "monolithic",
        contact: ContactOptions = _DEFAULT_CONTACT,
        solver: SolverOptions = _DEFAULT_SOLVER,
    ) -> None:
        """Prepare the solver and choose the barrier where it is not given.

        A start deep inside the barrier is a warning: it throws surfaces apart.

        Args:
            scene: What is simulated.
            dt: Time step [s], > 0; a plain number, or one in float64.
            scheme: "coupled" solves elasticity and contact together; "split" solves elasticity
                first and then contact, near its result. It takes what forces move only with the
                staggered couplings. "projective" solves elasticity with dry friction at the
                cloths' vertices, against bodies that are boxes, spheres, capsules or planes: the
                baseline, in which surfaces may cross between vertices.
            coupling: How cloths and what forces move act on each other: "monolithic" solves for
                both together; "rigid_to_cloth" moves bodies with their velocities, solves the
                cloths against them, and changes those velocities by the contact impulses;
                "cloth_to_rigid" solves the cloths against bodies at rest and then moves the bodies.
            contact: Contact and friction.
            solver: Tolerance and limits of the solver.

        Raises:
            IntersectingState: If surfaces of the scene intersect, touch, or are closer than their
                thickness.
            InvalidInput: If a value is not accepted, the barrier is too wide for the meshes, or a
                pd joint has no gains.
            TypeError: If something has a wrong type.
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
        self.dt = _check_time_step(dt)
        self.scheme = check_choice("Simulator: `scheme`", scheme, SCHEMES)
        self.coupling = check_choice("Simulator: `coupling`", coupling, COUPLINGS)
        self._assembly = assemble(scene, all_nodal=scheme == "projective")
        self._layout = Layout(self._assembly)
        _check_gains(self._layout)
        check_scheme(self.scheme, self.coupling, scene, self._layout, solver)
        self._dynamics = Dynamics(self._assembly, self.dt) if self._layout.has_coordinates else None
        self.surfaces = self._assembly.surface_names
        starts = self._assembly.cloth_vertex_start.tolist()
        rows = [slice(a, b) for a, b in pairwise(starts)]
        cloths = zip(scene.cloth_names, rows, strict=True)
        self.slices = {**dict(cloths), **self._layout.rigid_vertices}
        self.joint_slices = dict(self._assembly.joint_slices)
        self._surfaces = Surfaces.of(scene, self._assembly)
        # Without cloths there is nothing to split or to couple.
        options = CoreOptions(
            bending_models=[cloth.bending_model for cloth in scene.cloths],
            dt=self.dt,
            scheme=scheme if scene.cloths else "coupled",
            contact=contact,
            solver=solver,
        )
        stiffness = None
        if self._dynamics is not None:
            stiffness = limit_stiffness(self._assembly, self.dt, scene.gravity)
        self._core = make_core(self._assembly, options, stiffness)
        self._staggered = None
        in_turn = coupling != "monolithic" and scene.cloths and self._layout.is_dynamic
        if in_turn and self._dynamics is not None and stiffness is not None:
            self._staggered = Staggered(coupling, self._layout, self._dynamics, options, stiffness)
        self._nonadjacent_distance = self._core.smallest_nonadjacent_distance()
        self._defaults = scene_parameters(scene, self._assembly, has_contact(scene, contact))
        self._default_fields = default_fields(self._defaults)
        if has_barrier(scene, contact, scheme):
            self._choose_barrier()
        self._constants = constants(self._layout, self._default_fields)
        self._check_tolerance()
        if scheme != "projective":
            self._check_start()

    def __reduce__(self) -> tuple[Any, ...]:
        arguments = (self.scene, self.dt, self.scheme, self.contact, self.solver, self.coupling)
        return _restore, arguments

    def __repr__(self) -> str:
        coupling = "" if self.coupling == "monolithic" else f", coupling={self.coupling!r}"
        return f"Simulator({self.scene!r}, dt={self.dt:g}, scheme={self.scheme!r}{coupling})"

    @_memory_errors
    def initial_state(self, batch_size: int | None = None) -> State:
        """Make the state that the scene describes, at rest.

        Args:
            batch_size: Number of equal environments, >= 1; None makes a state without batch axis.
        """
        if batch_size is not None:
            check_count("initial_state: `batch_size`", batch_size, 1)
        assembly = self._assembly
        positions = torch.from_numpy(assembly.vertices)
        tensors = {
            "positions": positions,
            "body_poses": torch.from_numpy(assembly.body_poses),
            "soft_pin_targets": positions[torch.from_numpy(assembly.soft_pins.astype(np.int64))],
            "joint_positions": torch.from_numpy(assembly.joint_positions),
            "joint_targets": torch.from_numpy(assembly.joint_positions),
            "base_poses": torch.from_numpy(assembly.base_poses),
        }
        for name, quantity in STATE.items():  # the rest is at rest
            shape = shape_of(quantity.axes[0], assembly.sizes)
            tensors.setdefault(name, torch.zeros(shape, dtype=torch.float64))
        environments = () if batch_size is None else (batch_size,)
        copies = {
            name: tensor.expand((*environments, *tensor.shape)).clone(
                memory_format=torch.contiguous_format
            )
            for name, tensor in tensors.items()
        }
        return State(**copies, report=None, _surfaces=self._surfaces)

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
    ) -> Control:
        """Make a control and check it against the scene; what is None holds, or is zero.

        Everything but `forces` may be given by name too, as in `Control`.

        Args:
            pins: Positions at the end of the step [m], shape [P, 3].
            soft_pins: Likewise, shape [Q, 3].
            body_poses: Poses of kinematic bodies at the end of the step, shape [K, 7].
            forces: Forces on the cloth vertices [N], shape [N, 3].
            body_wrenches: Forces and torques on dynamic bodies [N, N m], shape [K, 6].
            joint_positions: Targets of position and pd joints [rad or m], shape [J].
            joint_velocities: Targets of velocity and pd joints [rad/s or m/s], shape [J].
            joint_efforts: Efforts at torque and pd joints [N m or N], shape [J].
            base_poses: Poses of kinematic bases at the end of the step, shape [R, 7].
            base_wrenches: Forces and torques on floating bases [N, N m], shape [R, 6].

        Raises:
            InvalidInput: If a name, shape or value is not accepted.
            TypeError: If something is no array of numbers on the CPU.
        """
        refuse_transforms("control")
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
        )
        return check_control(self._layout, control)

    def parameters(self) -> Parameters:
        """Make the parameters of the scene, in new tensors; change them with `.replace(...)`."""
        copies = {name: tensor.clone() for name, tensor in self._defaults.items()}
        return Parameters(**copies, _unbatched=tuple(copies))

    @_memory_errors
    def step(
        self,
        state: State,
        control: Control | None = None,
        parameters: Parameters | None = None,
    ) -> State:
        """Advance by one time step. Pure, and differentiable in all three arguments.

        Args:
            state: Where things are.
            control: Where they shall be; None holds pins and bodies.
            parameters: Physical parameters; None takes those of the scene.

        Returns:
            The state after `dt`. All of its tensors but `time` carry gradients: `positions`,
            `velocities`, `body_forces`, `soft_pin_targets`, and poses, positions, velocities,
            targets and efforts of bodies, joints and bases.

        Raises:
            IntersectingState: If surfaces intersect in `state`.
            InfeasibleMotion: If bodies, joints or pins cannot reach their targets without an
                intersection.
            NotConverged: If the solver stops early. With `SolverOptions(throw=False)` neither
                of these is raised: see there.
            InvalidInput: If a shape or value is not accepted.
            TypeError: If a tensor of the state is not float64 on the CPU.
        """
        (before, wanted, physical), batch = self._fields(state, control, parameters)
        if self._staggered is None:
            outcome, after = self._step_together(before, wanted, physical, batch)
        else:
            outcome, after = self._step_in_turn(before, wanted, physical, batch)
        report = make_report(outcome.diagnostics, batched=batch is not None)
        after["soft_pin_targets"] = wanted["soft_pins"]
        tensors = {
            "positions": outcome.positions,
            "velocities": outcome.velocities,
            "body_forces": outcome.body_forces,
            **{name: _own_copy(values, batch) for name, values in after.items()},
        }
        failures = failures_of(outcome.diagnostics)
        return State(
            **refuse_gradients(tensors, failures, batched=batch is not None),
            time=state.time + self.dt,
            report=report,
            _surfaces=self._surfaces,
        )

    def _step_together(
        self, state: Fields, control: Fields, parameters: Fields, batch: int | None
    ) -> tuple[Outcome, Fields]:
        """One solve for everything; its outcome, and fields of bodies and robots behind it."""
        prediction = self._predict(state, control, parameters)
        inputs = self._core_inputs(state, control, parameters, prediction)
        outcome = take_step(self._core, inputs, self._constants, batched=batch is not None)
        self._check(outcome.diagnostics, batch)
        ended = outcome.diagnostics["ended"]
        if self._dynamics is None or prediction is None:
            after = prescribed_motion(self._layout, state, control, self.dt)
            if ended:
                poses = ended_poses(control["body_poses"], ended, len(state["positions"]))
                with torch.no_grad():
                    reached = control | {"body_poses": poses}
                    there = prescribed_motion(self._layout, state, reached, self.dt)
                after = with_rows(after, there, ended)
            return outcome, after
        forces = outcome.body_forces if batch is not None else outcome.body_forces.unsqueeze(0)
        coordinates = outcome.coordinates
        if coordinates is None:  # robots without a joint that moves
            coordinates = forces.new_zeros(len(forces), 0)
        elif batch is None:
            coordinates = coordinates.unsqueeze(0)
        after = self._dynamics.advance(prediction, coordinates, forces)
        if ended:
            poses = ended_poses(prediction.body_targets, ended, len(forces))
            with torch.no_grad():
                stopped = self._dynamics.end_at(prediction, poses)
                there = self._dynamics.advance(stopped, coordinates, forces)
            after = with_rows(after, there, ended)
        return outcome, {**after, "joint_targets": held_targets(self._layout, state, control)}

    def _step_in_turn(
        self, state: Fields, control: Fields, parameters: Fields, batch: int | None
    ) -> tuple[Outcome, Fields]:
        """Like `_step_together`, by a staggered coupling."""
        assert self._staggered is not None
        inputs = self._core_inputs(state, control, parameters, None)
        outcome, after = self._staggered.step(
            state, control, parameters, inputs, lambda found: self._check(found, batch)
        )
        if batch is None:
            outcome = outcome.first()
        return outcome, {**after, "joint_targets": held_targets(self._layout, state, control)}

    def _check(self, diagnostics: dict[str, Any], batch: int | None) -> None:
        if not any(diagnostics["status"]):
            return
        batched = batch is not None
        report = make_report(diagnostics, batched=batched)
        raise_on_failure(diagnostics, report, throw=self.solver.throw, batched=batched)

    def rollout(
        self,
        state: State,
        controls: Sequence[Control | None] | Callable[[int, State], Control | None] | None = None,
        parameters: Parameters | None = None,
        *,
        steps: int | None = None,
        checkpoint_every: int | None = None,
    ) -> list[State]:
        """Take several steps.

        Args:
            state: Where to start.
            controls: One control for each step (None holds), or a function of the index of a step
                and the state before it; None holds throughout.
            parameters: Physical parameters of all steps.
            steps: Number of steps; needed unless `controls` is a sequence.
            checkpoint_every: Keep tapes of this many steps at a time: backward repeats the steps
                from the state before them. A function `controls` is then called again and must
                return the same: backward raises `InvalidInput` otherwise.

        Returns:
            The states after each step.
        """
        # Copies of NumPy arrays and lists: edits before backward must not reach what is repeated.
        if isinstance(controls, Sequence):
            controls = [c if c is None else check_control(self._layout, c) for c in controls]
        if parameters is not None:
            parameters = check_parameters(parameters)
        return roll_out(
            lambda before, control: self.step(before, control, parameters),
            state,
            controls,
            parameters,
            steps,
            checkpoint_every,
        )

    def link_poses(self, state: State) -> dict[str, Tensor]:
        """Frames of the links of all robots, differentiable in the state.

        Args:
            state: Where things are.

        Returns:
            "robot/link" -> homogeneous matrix from the link to the world, shape [4, 4], or
            [B, 4, 4] in a batch.
        """
        refuse_transforms("link_poses")
        fields, batch = state_fields(self._layout, state)
        return _unbatched(link_poses(self._layout, fields), batch)

    def link_velocities(
        self, state: State, parameters: Parameters | None = None
    ) -> dict[str, Tensor]:
        """Velocities of the links of all robots, differentiable in both arguments.

        Args:
            state: How things move.
            parameters: Physical parameters, of which the centers of mass count; None takes those
                of the scene.

        Returns:
            "robot/link" -> velocity of the link's center of mass (of the origin of its frame where
            the robot is not dynamic), then its angular velocity, in world axes [m/s, rad/s], shape
            [6], or [B, 6] in a batch.
        """
        refuse_transforms("link_velocities")
        fields, batch = state_fields(self._layout, state)
        centers = self._centers("link", parameters, batch)
        return _unbatched(link_velocities(self._layout, fields, centers), batch)

    def contact_wrenches(
        self, state: State, parameters: Parameters | None = None
    ) -> dict[str, Tensor]:
        """What the contact forces of a state add up to, differentiable in both arguments.

        Args:
            state: Its `body_forces` are added up where its bodies and links are.
            parameters: Physical parameters, of which the centers of mass count; None takes those
                of the scene.

        Returns:
            Name of a body, or "robot/link" -> force, then torque about the center of mass (about
            the origin of its frame where it is not dynamic), in world axes [N, N m], shape [6], or
            [B, 6] in a batch.
        """
        refuse_transforms("contact_wrenches")
        fields, batch = state_fields(self._layout, state)
        forces = state.body_forces if batch is not None else state.body_forces.unsqueeze(0)
        shape = (len(fields["positions"]), *self._assembly.body_vertices.shape)
        check_shape("contact_wrenches: `state.body_forces`", forces.shape, [shape])
        centers = [self._centers(owner, parameters, batch) for owner in ("body", "link")]
        return _unbatched(contact_wrenches(self._layout, fields, forces, *centers), batch)

    def _totals(self, state: Fields, parameters: Fields) -> Totals:
        """Momentum and energy of all that has mass."""
        totals = cloth_totals(self._assembly, state, parameters)
        if self._dynamics is not None:
            totals = totals.plus(self._dynamics.totals(state, parameters))
        return totals

    def _centers(self, owner: str, parameters: Parameters | None, batch: int | None) -> Tensor:
        """Centers of mass of bodies or links, zero where nothing is dynamic; [B or 1, rows, 3]."""
        fields = self._physical(parameters, batch)
        rows = self._assembly.sizes["K" if owner == "body" else "L"]
        return fields.get(f"{owner}_center", torch.zeros(1, rows, 3, dtype=torch.float64))

    def vertex_masses(
        self, parameters: Parameters | None = None, *, batch_size: int | None = None
    ) -> Tensor:
        """Masses of the cloths' vertices, differentiable in density and rest shape.

        Args:
            parameters: Physical parameters; None takes those of the scene.
            batch_size: Number of environments, >= 1; needed where parameters have a batch axis.

        Returns:
            A third of the mass of each face around a vertex [kg], shape [N], or [B, N] in a batch.
        """
        refuse_transforms("vertex_masses")
        if batch_size is not None:
            check_count("vertex_masses: `batch_size`", batch_size, 1)
        masses = vertex_masses(self._assembly, self._physical(parameters, batch_size))
        return _own_copy(masses, batch_size)

    def momentum(self, state: State, parameters: Parameters | None = None) -> Tensor:
        """Momentum of all that has mass, differentiable in both arguments.

        That is cloths with their pinned vertices, dynamic bodies, and whole robots of which forces
        move at least a part. Bodies and robots that only follow prescribed motion have no mass.

        Args:
            state: Where things are, and how they move.
            parameters: Physical parameters; None takes those of the scene.

        Returns:
            Linear momentum, then angular momentum about the origin of the world [kg m/s,
            kg m^2/s], shape [6], or [B, 6] in a batch.
        """
        refuse_transforms("momentum")
        fields, batch = state_fields(self._layout, state)
        result = self._totals(fields, self._physical(parameters, batch)).momentum
        return result if batch is not None else result[0]

    def kinetic_energy(self, state: State, parameters: Parameters | None = None) -> Tensor:
        """Kinetic energy of what `momentum` counts, differentiable in both arguments.

        The inertia of drives, `joint_armature`, adds its part at joints that forces move.

        Args:
            state: Where things are, and how they move.
            parameters: Physical parameters; None takes those of the scene.

        Returns:
            Energy [J], shape [], or [B] in a batch.
        """
        refuse_transforms("kinetic_energy")
        fields, batch = state_fields(self._layout, state)
        result = self._totals(fields, self._physical(parameters, batch)).kinetic_energy
        return result if batch is not None else result[0]

    @overload
    def energy(
        self, state: State, parameters: Parameters | None = None, *, parts: Literal[False] = False
    ) -> Tensor: ...

    @overload
    def energy(
        self, state: State, parameters: Parameters | None = None, *, parts: Literal[True]
    ) -> dict[str, Tensor]: ...

    def energy(
        self, state: State, parameters: Parameters | None = None, *, parts: bool = False
    ) -> Tensor | dict[str, Tensor]:
        """Potential energy at the positions of a state: elasticity, soft pins, gravity, contact.

        Gravity is that of cloths, and of the bodies and robots that `momentum` counts; it is zero
        at the origin of the world. What drives and stops of joints store is left out.

        Args:
            state: Where things are. It must not require a gradient: there is none.
            parameters: Physical parameters; None takes those of the scene. They must not require a
                gradient either.
            parts: Whether to return what adds up to the energy.

        Returns:
            Energy [J], shape [], or [B] in a batch; with `parts` a dict of such tensors:
            "stretch", "bending", "soft_pins", "contact" (the barrier's) and "gravity".
        """
        check_bool("energy: `parts`", parts)
        fields, batch = self._fields(state, None, parameters)
        before, control, physical = fields
        # Energy is that of where things are: no speed is too high for it.
        still = before | {
            n: torch.zeros_like(t) for n, t in before.items() if n.endswith("velocities")
        }
        weightless = physical | {"gravity": torch.zeros_like(physical["gravity"])}
        inputs = self._core_inputs(
            before, control, physical, self._predict(still, control, weightless)
        )
        if torch.is_grad_enabled():
            for name, tensor in inputs.items():
                if tensor.requires_grad:
                    raise InvalidInput(
                        f"energy: `{name}` must not require a gradient, energy has none; "
                        "call it under torch.no_grad() or with a detached state"
                    )
        stored = self._core.stored_energy(_arrays(inputs))
        energies = {name: torch.from_numpy(values) for name, values in stored.items()}
        with torch.no_grad():
            energies["gravity"] = self._totals(before, physical).gravity_energy
        energies = _unbatched(energies, batch)
        if parts:
            return energies
        first, *rest = energies.values()
        return sum(rest, first)

    def path(
        self,
        state: State,
        control: Control | None = None,
        parameters: Parameters | None = None,
    ) -> Tensor:
        """Polyline along which the solver takes a step, for an independent judge.

        Every straight segment between successive rows is certified free of collisions, while the
        chord from the first to the last may cross an obstacle. A step that fails gives the path up
        to its failure.

        Args:
            state: Where things are, one environment.
            control: Where they shall be; None holds pins and bodies.
            parameters: Physical parameters; None takes those of the scene.

        Returns:
            Accepted iterates, shape [M, N + V, 3] [m]: cloth vertices, then body vertices.
        """
        with torch.no_grad():
            fields, batch = self._fields(state, control, parameters)
            if batch is not None:
                raise InvalidInput(
                    "path: `state` must be one environment, got a batch; use state[i]"
                )
            if self._staggered is not None:
                inputs = self._core_inputs(*fields, None)
                path = self._staggered.path(*fields, inputs, lambda found: self._check(found, None))
                return torch.from_numpy(path)
            inputs = self._core_inputs(*fields, self._predict(*fields))
            return torch.from_numpy(self._core.path(_arrays(inputs)))

    def _inputs(
        self, state: State, control: Control | None, parameters: Parameters | None
    ) -> tuple[Fields, int | None]:
        """Inputs of the core, and the batch size."""
        fields, batch = self._fields(state, control, parameters)
        return self._core_inputs(*fields, self._predict(*fields)), batch

    def _fields(
        self, state: State, control: Control | None, parameters: Parameters | None
    ) -> tuple[tuple[Fields, Fields, Fields], int | None]:
        """Check everything and give every tensor its leading axis of environments."""
        refuse_transforms("step", state, control, parameters)
        before, batch = state_fields(self._layout, state)
        wanted = control_fields(self._layout, control, before, batch)
        physical = self._physical(parameters, batch)
        return (before, wanted, physical), batch

    def _physical(self, parameters: Parameters | None, batch: int | None) -> Fields:
        """Check parameters and complete them by those of the scene, which are checked already."""
        if parameters is None:
            return self._default_fields
        physical = parameter_fields(self._layout, parameters, self._default_fields, batch)
        self._check_barrier("parameters", physical)
        return physical

    def _predict(self, state: Fields, control: Fields, parameters: Fields) -> Prediction | None:
        """What bodies and robots do by themselves; None where all are bodies on known poses."""
        if self._dynamics is None:
            return None
        return self._dynamics.predict(state, control, parameters)

    def _core_inputs(
        self, state: Fields, control: Fields, parameters: Fields, prediction: Prediction | None
    ) -> Fields:
        inputs = core_inputs(state, control, parameters)
        if prediction is not None:
            inputs |= prediction.core_inputs()
        rest = inputs.get("rest_positions")
        if rest is not None and not rest.requires_grad:
            scene_rest = self._default_fields["rest_positions"]
            if rest is scene_rest or torch.equal(rest, scene_rest):
                del inputs["rest_positions"]  # the core has prepared the rest shape of the scene
        return inputs

    def _choose_barrier(self) -> None:
        """Complete the defaults by what the contact options give or leave to the scene."""
        distance = self.contact.barrier_distance
        if distance is None:
            distance = choose_barrier_distance(self.scene, self._nonadjacent_distance, self.contact)
        slip_velocity = self.contact.slip_velocity
        self._add_defaults(slip_velocity=slip_velocity, barrier_distance=distance)
        self._check_barrier("Simulator", self._default_fields)
        stiffness: float | NDArray[np.float64] | None = self.contact.barrier_stiffness
        if stiffness is None:
            inputs, _ = self._inputs(self.initial_state(), None, None)
            pairs = self._core.default_barrier_stiffness(_arrays(inputs), distance)
            stiffness = pairs if (pairs != pairs[0, 0]).any() else float(pairs[0, 0])
        self._add_defaults(barrier_stiffness=stiffness)

    def _add_defaults(self, **values: float | NDArray[np.float64]) -> None:
        tensors = {n: torch.tensor(v, dtype=torch.float64) for n, v in values.items()}
        self._defaults |= tensors
        self._default_fields |= default_fields(tensors)

    def _check_barrier(self, owner: str, inputs: Fields) -> None:
        cloths = len(self.scene.cloths)
        if cloths and "barrier_distance" in inputs and self.contact.self_contact:
            thickness = as_array(inputs["thickness"])[:, :cloths]
            distance = as_array(inputs["barrier_distance"])
            check_barrier(owner, distance, thickness, self._nonadjacent_distance)

    def _check_tolerance(self) -> None:
        """Refuse a solver that stops before it sees lengths as small as the scene's."""
        if "barrier_distance" not in self._defaults:
            return
        distance = float(self._defaults["barrier_distance"])
        largest = _LARGEST_PART_OF_BARRIER * distance / self.dt
        if self.solver.tolerance > largest:
            raise InvalidInput(
                f"Simulator: `solver.tolerance` must be at most {largest:.3g} m/s, with which a "
                f"step is known to {_LARGEST_PART_OF_BARRIER:g} of the barrier distance "
                f"{distance:.3g} m, got {self.solver.tolerance:.3g}"
            )

    def _check_start(self) -> None:
        """Refuse surfaces that overlap, and warn of those that the barrier would throw apart."""
        inputs = _arrays(self._inputs(self.initial_state(), None, None)[0])
        overlap = self._core.find_overlap(inputs)
        if overlap is not None:
            raise IntersectingState(
                f"Simulator: surfaces of the scene overlap: {overlap}; move them apart",
                environments=(0,),
            )
        close = self._core.find_close_start(inputs)
        if close is not None and close[1] < _DEEP * close[2]:
            elements, gap, rest_gap = close
            warnings.warn(
                f"Simulator: the barrier will throw surfaces apart: {elements} start {gap:.3g} m "
                f"apart, while at rest their gap would be about {rest_gap:.3g} m; start with more, "
                "or give a smaller `contact.barrier_distance`",
                stacklevel=3,
            )


def _restore(
    scene: Scene,
    dt: float,
    scheme: str,
    contact: ContactOptions,
    solver: SolverOptions,
    coupling: str = "monolithic",  # pickles of the first version end before it
) -> Simulator:
    return Simulator(scene, dt, scheme=scheme, coupling=coupling, contact=contact, solver=solver)


def _check_time_step(dt: object) -> float:
    instead = "pass a plain number; no gradient with respect to the time step exists: use one"
    number = check_number("Simulator: `dt`", dt, POSITIVE, instead=instead)
    # Other numbers are widened as they are. This one is added up, step by step.
    dtype = str(getattr(dt, "dtype", ""))
    if dtype.endswith(("float32", "float16")):
        raise TypeError(
            f"Simulator: `dt` must be a plain number or one in float64, got {dtype}, "
            f"which makes it {number!r}"
        )
    return number


def _check_gains(layout: Layout) -> None:
    gains = layout.assembly.stiffness + layout.assembly.damping
    for name, mode, gain in zip(layout.joint_names, layout.actuation, gains, strict=True):
        if mode == "pd" and gain == 0.0:
            raise InvalidInput(
                f"Simulator: the pd joint {name!r} must have gains: give `stiffness` or `damping` "
                "to its Robot, or another `actuation`"
            )


def _arrays(inputs: Fields) -> dict[str, NDArray[np.float64]]:
    return {name: as_array(tensor) for name, tensor in inputs.items()}


def _unbatched(named: dict[str, Tensor], batch: int | None) -> dict[str, Tensor]:
    return named if batch is not None else {name: tensor[0] for name, tensor in named.items()}


def _own_copy(tensor: Tensor, batch: int | None) -> Tensor:
    """Copy rows [nb, ...], so that what a caller gets shares no storage with them."""
    rows = tensor[0] if batch is None else tensor.expand(batch, *tensor.shape[1:])
    return rows.clone(memory_format=torch.contiguous_format)
