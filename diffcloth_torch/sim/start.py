"""Preparations of the first step: initial state, choice of the barrier, checks of both."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.autograd.core_function import failing_as
from diffcloth_torch.autograd.transforms import outside_transforms, plain
from diffcloth_torch.checks import OVERLAPPING, POSITIVE, check_number
from diffcloth_torch.dynamics.limits import slip_rates
from diffcloth_torch.errors import (
    BarrierStartWarning,
    IntersectingState,
    InvalidInput,
    warn_caller,
)
from diffcloth_torch.model.assembly import Assembly
from diffcloth_torch.model.defaults import choose_barrier_distance
from diffcloth_torch.model.options import ContactOptions
from diffcloth_torch.model.quantities import STATE, Fields, shape_of
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.inputs.border import Border, Given
from diffcloth_torch.sim.inputs.layout import Layout
from diffcloth_torch.sim.inputs.parameter_fields import default_fields
from diffcloth_torch.sim.overlaps import overlapping_pairs
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.solve.cores import arrays_of
from diffcloth_torch.sim.solve.engine import Engine

__all__ = [
    "StartWatch",
    "check_gains",
    "check_start",
    "check_time_step",
    "check_tolerance",
    "choose_barrier",
    "choose_slip_rates",
    "initial_tensors",
]

# Slower throws are harmless: a falling cloth reaches this speed in a millisecond. [m/s]
_SLOW = 0.01

_NAMED = 8  # environments that a warning lists; for more it states their number

# Largest error of a step when its solver stops, as a share of the barrier distance: in a scene of
# micrometers the default tolerance would be as long as the barrier.
_LARGEST_PART_OF_BARRIER = 0.1


def initial_tensors(assembly: Assembly) -> Fields:
    """Tensors of a scene's initial state, at rest; they may share memory with the scene."""
    positions = torch.from_numpy(assembly.vertices)
    tensors = {
        "positions": positions,
        "body_poses": torch.from_numpy(assembly.body_poses),
        "soft_pin_targets": positions[torch.from_numpy(assembly.soft_pins.astype(np.int64))],
        "joint_positions": torch.from_numpy(assembly.joint_positions),
        "joint_targets": torch.from_numpy(assembly.joint_positions),
        "base_poses": torch.from_numpy(assembly.base_poses),
    }
    for name, quantity in STATE.items():  # everything else is zero
        shape = shape_of(quantity.axes[0], assembly.sizes)
        tensors.setdefault(name, cpu.zeros(shape))
    return tensors


def check_time_step(dt: object) -> float:
    """Return a time step [s] as a float; refuse numbers that are not in double precision."""
    instead = "pass a plain number; no gradient with respect to the time step exists: use one"
    number = check_number("Simulator: `dt`", dt, POSITIVE, instead=instead)
    # Other numbers may be widened. The time step is summed over steps, so its rounding would
    # grow.
    dtype = str(getattr(dt, "dtype", ""))
    if dtype.endswith(("float32", "float16")):
        raise TypeError(
            f"Simulator: `dt` must be a plain number or one in float64, got {dtype}, "
            f"which makes it {number!r}"
        )
    return number


def check_gains(layout: Layout) -> None:
    """Refuse pd joints without gains."""
    gains = layout.assembly.stiffness + layout.assembly.damping
    modes = layout.permissions.actuation
    for name, mode, gain in zip(layout.joint_names, modes, gains, strict=True):
        if mode == "pd" and gain == 0.0:
            raise InvalidInput(
                f"Simulator: the pd joint {name!r} must have gains: give `stiffness` or `damping` "
                "to its Robot, or another `actuation`"
            )


def choose_barrier(
    engine: Engine,
    border: Border,
    scene: Scene,
    contact: ContactOptions,
    start: Given,
    nonadjacent_distance: float,
) -> dict[str, Tensor]:
    """Return the barrier parameters of the contact options, or choose them for the scene.

    Args:
        engine: Engine of the scene.
        border: Checks the barrier; the parameters are added to its defaults.
        scene: The scene.
        contact: Contact options.
        start: The initial state, with a control that holds.
        nonadjacent_distance: Smallest distance between parts of a cloth that share no vertex [m].

    Raises:
        InvalidInput: If the barrier is too wide for the meshes.
    """
    distance = contact.barrier_distance
    if distance is None:
        distance = choose_barrier_distance(scene, nonadjacent_distance, contact)
    chosen = {"slip_velocity": _number(contact.slip_velocity)}
    chosen["barrier_distance"] = _number(distance)
    border.defaults |= default_fields(chosen)
    border.check_barrier("Simulator", border.defaults)
    stiffness: float | NDArray[np.float64] | None = contact.barrier_stiffness
    if stiffness is None:
        given = start._replace(parameters=border.defaults)
        inputs = engine.core_inputs(given, engine.predict(given))
        pairs = engine.core.default_barrier_stiffness(arrays_of(inputs), distance)
        stiffness = pairs if (pairs != pairs[0, 0]).any() else float(pairs[0, 0])
    chosen["barrier_stiffness"] = _number(stiffness)
    border.defaults |= default_fields(chosen)
    return chosen


def choose_slip_rates(assembly: Assembly, contact: ContactOptions) -> dict[str, Tensor]:
    """Compute slip rates of joints that forces move from the slip velocity of contacts."""
    if not assembly.forced.any():
        return {}
    return {"joint_slip_rates": _number(slip_rates(assembly, contact.slip_velocity))}


def check_tolerance(tolerance: float, distance: float, dt: float) -> None:
    """Refuse a solver tolerance that does not resolve the barrier distance.

    Args:
        tolerance: Tolerance of the solver [m/s].
        distance: Distance at which the barrier begins [m].
        dt: Time step [s].
    """
    largest = _LARGEST_PART_OF_BARRIER * distance / dt
    if tolerance > largest:
        raise InvalidInput(
            f"Simulator: `solver.tolerance` must be at most {largest:.3g} m/s, with which a "
            f"step is known to {_LARGEST_PART_OF_BARRIER:g} of the barrier distance "
            f"{distance:.3g} m, got {tolerance:.3g}"
        )


def check_start(engine: Engine, scene: Scene, start: Given) -> None:
    """Refuse surfaces that overlap; the error names all pairs.

    Args:
        engine: Engine of the scene.
        scene: The scene.
        start: The initial state, with a control that holds.
    """
    overlap = engine.core.find_overlap(arrays_of(engine.core_inputs(start, engine.predict(start))))
    if overlap is None:
        return
    assembly = engine.assembly
    pairs = overlapping_pairs(scene, assembly, initial_tensors(assembly))
    names = assembly.surface_names
    of_cloths = [(names[a], names[b]) for a, b in pairs if a < assembly.cloth_count]
    rigid = [(names[a], names[b]) for a, b in pairs if a >= assembly.cloth_count]
    text = f"Simulator: surfaces of the scene overlap: {overlap}; move them apart"
    if of_cloths and len(pairs) > 1:
        text += f"; all pairs with a cloth that overlap: {of_cloths}"
    if rigid:
        text += (
            "; the Scene ignores contact between the bodies and links that overlap with "
            f'`ignore_contact="{OVERLAPPING}"`, as Robot.load does for those of a robot, or with '
            f"all pairs of them ({len(rigid)}):\nignore_contact={rigid}"
        )
    raise IntersectingState(text, environments=(0,))


class StartWatch:
    """Checks a simulator's first initial state for surfaces that the barrier throws apart.

    After a step, surfaces may rest in the barrier, or rebound: only an initial state can be wrong.
    """

    def __init__(self, engine: Engine) -> None:
        """Keep the engine of the scene."""
        self._engine = engine
        self._looked = False

    def close(self, state: State) -> None:
        """Check no other state once a step from an initial state was computed."""
        self._looked = self._looked or state.report is None

    def look_at(self, state: State, given: Given, batch: int | None) -> None:
        """Warn if the barrier throws something apart.

        Args:
            state: State at the start of the step.
            given: This state, control and parameters, checked.
            batch: Batch size, None without a batch axis.
        """
        if self._looked or state.report is not None:
            return
        with torch.no_grad(), outside_transforms():
            numbers = Given(*({n: plain(t) for n, t in fields.items()} for fields in given))
            at_rest = numbers.at_rest()
            inputs = self._engine.core_inputs(at_rest, self._engine.predict(at_rest))
            with failing_as(operation()):
                throws = self._engine.core.find_throws(arrays_of(inputs), torch.get_num_threads())
        fast = {
            i: throw for i, throw in enumerate(throws) if throw is not None and throw[3] > _SLOW
        }
        if not fast:
            return
        worst = max(fast, key=lambda i: fast[i][3])
        elements, gap, distance, speed = fast[worst]
        affected = str(list(fast)) if len(fast) <= _NAMED else f"{len(fast)} environments"
        place = "" if batch is None else f"in environment {worst} of {affected}, "
        warn_caller(
            f"{operation()}: the barrier throws apart what starts inside of it: {place}{elements} "
            f"are {gap:.3g} m apart, {gap / distance:.2g} of the barrier distance {distance:.3g} "
            f"m, and the energy stored there gives about {speed:.2g} m/s; start them "
            f"{distance - gap:.2g} m further apart, or give a `contact.barrier_distance` of at "
            f"most {gap:.3g} m",
            BarrierStartWarning,
        )


def _number(value: float | NDArray[np.float64]) -> Tensor:
    return cpu.tensor(value)
