"""The solves of a scene's staggered couplings; `dynamics.staggering` has their order."""

from __future__ import annotations

from collections.abc import Callable, Container
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.dynamics.dynamics import Dynamics, Prediction
from diffcloth_torch.dynamics.limits import LimitStiffness
from diffcloth_torch.dynamics.staggering import cloth_to_rigid, rigid_to_cloth
from diffcloth_torch.errors import InfeasibleMotion
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.inputs.border import Given
from diffcloth_torch.sim.inputs.layout import Layout
from diffcloth_torch.sim.records.contact_points import COLUMNS
from diffcloth_torch.sim.records.surfaces import Surfaces
from diffcloth_torch.sim.solve.added_mass import AddedMassWatch
from diffcloth_torch.sim.solve.cores import (
    CoreOptions,
    arrays_of,
    make_core,
    rigid_inputs,
    with_all_pinned,
    without_cloths,
)
from diffcloth_torch.sim.solve.failures import mark
from diffcloth_torch.sim.solve.motion import with_rows
from diffcloth_torch.sim.solve.step import (
    CONVERGED,
    DIAGNOSTICS,
    INFEASIBLE,
    TURNED,
    Outcome,
    diagnostics_of,
    take_step,
)

__all__ = ["Staggered"]

Check = Callable[[dict[str, Any]], None]
"""Raises an error if the diagnostics of a solve show a failure."""

# Fields of a state besides velocities, forces and efforts.
_PLACES = ("positions", "body_poses", "joint_positions", "base_poses")


class _Solved(NamedTuple):
    """The result of a solve, with a leading axis of environments.

    Attributes:
        outcome: Outcome of the core.
        coordinates: Coordinates of bodies and robots at the end of the step, [B, n].
    """

    outcome: Outcome
    coordinates: Tensor

    @property
    def body_forces(self) -> Tensor:
        """Contact forces on the vertices of bodies and links, [B, V, 3] N."""
        return self.outcome.body_forces


class Staggered:
    """Computes steps by "rigid_to_cloth" or "cloth_to_rigid".

    Attributes:
        layout: Meaning of the rows.
        dynamics: Dynamics of the bodies and robots.
        rigid: Core of bodies and robots, without the cloths.
        cloth: Core of the cloths, with all coordinates prescribed.
        judge: Core in which nothing moves by itself; it detects collisions of a motion.
    """

    def __init__(
        self,
        coupling: str,
        layout: Layout,
        surfaces: Surfaces,
        dynamics: Dynamics,
        options: CoreOptions,
        limit_stiffness: LimitStiffness,
    ) -> None:
        """Make the cores of the solves.

        Args:
            coupling: Name of the coupling.
            layout: Meaning of the rows.
            surfaces: The surfaces that a state places.
            dynamics: Dynamics of the bodies and robots.
            options: Options of the cores.
            limit_stiffness: Stiffness of the barriers at the limits of coordinates.
        """
        self._coupling, self.layout, self.dynamics = coupling, layout, dynamics
        self._throw, self._surfaces = options.solver.throw, surfaces
        assembly = layout.assembly
        coupled = options._replace(scheme="coupled")
        alone = coupled._replace(bending_models=())
        self.rigid = make_core(without_cloths(assembly), alone, limit_stiffness)
        self.cloth = make_core(assembly, options, limit_stiffness, all_prescribed=True)
        # Nothing moves by itself: a step succeeds if the motion is free of collisions.
        pinned = with_all_pinned(assembly)
        self.judge = make_core(pinned, coupled, limit_stiffness, all_prescribed=True)
        self._watch = AddedMassWatch(coupling, layout, surfaces, dynamics, (self.cloth, self.rigid))

    def step(self, given: Given, inputs: Fields, check: Check) -> tuple[Outcome, Fields]:
        """Compute a step; outcome and fields after it have a leading axis of environments.

        Args:
            given: Checked state, control and parameters.
            inputs: Inputs of the core that do not concern bodies and robots.
            check: Checks the diagnostics of each solve.
        """
        outcome, after, _ = self._solve(given, inputs, check)
        return outcome, after

    def path(self, given: Given, inputs: Fields, check: Check) -> FloatArray:
        """Polyline that the surfaces of one environment follow in a step, [M, N + V, 3]."""
        *_, paths = self._solve(given, inputs, check)
        return np.concatenate([path() for path in paths])

    def _solve(
        self, given: Given, inputs: Fields, check: Check
    ) -> tuple[Outcome, Fields, list[Callable[[], FloatArray]]]:
        """Outcome, fields after the step, and polylines of the surfaces solved with the cloths."""
        solves = _Solves(self, given, inputs, check)
        if self._coupling == "rigid_to_cloth":
            prediction = solves.predict(None)
            solved = rigid_to_cloth(
                self.dynamics, prediction, solves.solve_rigid, solves.solve_cloth
            )
        else:
            last = self.dynamics.last_places(given.state, given.parameters)
            solved = cloth_to_rigid(
                self.dynamics,
                solves.predict,
                self._surfaces.vertices(given.state | last),
                solves.solve_rigid,
                solves.solve_cloth,
                solves.check_path,
            )
        cloth, blocked = solved.cloth.outcome, solves.blocked
        self._watch.look_at(given, inputs, solved, blocked=bool(blocked))
        cloths = self.layout.assembly.cloth_count
        diagnostics = _merged(cloth.diagnostics, solved.rigid.outcome.diagnostics, cloths)
        tensors = {
            **solved.fields,
            "positions": cloth.positions,
            "velocities": cloth.velocities,
            "body_forces": solved.body_forces,
            "contact_forces": cloth.contact_forces,
            "pin_forces": cloth.pin_forces,
        }
        if blocked:
            tensors = with_rows(tensors, _at_start(given.state, tensors), blocked)
            for i, message in blocked.items():
                diagnostics["status"][i] = INFEASIBLE
                diagnostics["motion_fraction"][i] = 0.0
                diagnostics["message"][i] = message
        far = self.dynamics.turned_too_far(solved.prediction, solved.fields, solved.body_forces)
        if far:
            mark(diagnostics, far, TURNED)
            check(diagnostics)
        names = ("positions", "velocities", "body_forces", "contact_forces", "pin_forces")
        outcome = Outcome(**{n: tensors.pop(n) for n in names}, diagnostics=diagnostics)
        return outcome, tensors, solves.paths

    def standing_still(self, inputs: Fields, positions: Tensor) -> Fields:
        """Inputs in which all cloth vertices are pinned in place."""
        return inputs | {
            "positions": positions,
            "pin_targets": positions,
            "velocities": torch.zeros_like(positions),
            "soft_pin_targets": positions[:, :0],
            "attachment_targets": positions[:, :0],
            "attachment_weights": positions[:, :0, 0],
            "attachment_stiffness": positions[:, :0, 0],
        }

    def blocked_ways(self, inputs: dict[str, FloatArray], known: Container[int]) -> dict[int, str]:
        """Find motions of bodies and robots into cloths at rest; with `throw`, raise for them.

        Returns:
            Environments with such a motion, except the known ones -> a message with a remedy.
        """
        result = self.judge.forward(inputs, False, torch.get_num_threads())
        diagnostics = diagnostics_of(result)
        outcomes = zip(diagnostics["status"], diagnostics["message"], strict=True)
        remedy = 'lower dt, or use coupling="monolithic"'
        blocked = {
            i: f"dynamic bodies cannot go on past cloths at rest ({message}); {remedy}"
            for i, (status, message) in enumerate(outcomes)
            if status != CONVERGED and i not in known
        }
        if blocked and self._throw:
            environments = list(blocked)
            raise InfeasibleMotion(
                f"{operation()}: environments {environments}: {blocked[environments[0]]}",
                environments=environments,
            )
        return blocked


class _Solves:
    """The solves of one step, called by a coupling in its order.

    Attributes:
        paths: Polylines of the surfaces solved with the cloths.
        blocked: Environments whose motion cannot be completed -> the reason.
    """

    def __init__(
        self,
        owner: Staggered,
        given: Given,
        inputs: Fields,
        check: Check,
    ) -> None:
        self._owner, self._inputs, self._check = owner, inputs, check
        self._given = given
        self.paths: list[Callable[[], FloatArray]] = []
        self.blocked: dict[int, str] = {}

    def predict(self, contact: Tensor | None) -> Prediction:
        """Predict the step without contact and limits, under forces on vertices."""
        return self._owner.dynamics.predict(*self._given, contact)

    def solve_rigid(self, prediction: Prediction) -> _Solved:
        """Solve the step of bodies and robots alone."""
        given = rigid_inputs(self._owner.layout, self._inputs) | prediction.core_inputs()
        outcome = take_step(self._owner.rigid, given)
        self._look_at(outcome)
        ends = outcome.coordinates
        return _Solved(outcome, prediction.coordinates if ends is None else ends)

    def solve_cloth(
        self, prediction: Prediction, ends: Tensor, origins: Tensor | None = None
    ) -> _Solved:
        """Solve the step of the cloths, while all coordinates move to the given ends."""
        given = self._inputs | prediction.core_inputs() | {"coordinate_ends": ends}
        if origins is not None:
            given["friction_origins"] = origins
        outcome = take_step(self._owner.cloth, given)
        self._look_at(outcome)
        if self.blocked:  # the forces of squeezed cloth may be too large to find a motion
            forces = {"": outcome.body_forces}
            none = {"": torch.zeros_like(outcome.body_forces)}
            outcome = outcome._replace(body_forces=with_rows(forces, none, self.blocked)[""])
        self.paths.append(partial(self._owner.cloth.path, arrays_of(given)))
        return _Solved(outcome, ends)

    def check_path(
        self, cloth: _Solved, prediction: Prediction, start: Tensor, end: Tensor
    ) -> None:
        """Look for collisions of moving bodies and robots with cloths at rest."""
        given = self._owner.standing_still(self._inputs, cloth.outcome.positions)
        given |= prediction.core_inputs() | {
            "body_poses": prediction.body_targets,
            "coordinates": start,
            "coordinate_ends": end,
        }
        arrays = arrays_of(given)
        self.blocked.update(self._owner.blocked_ways(arrays, self.blocked))
        self.paths.append(partial(self._owner.judge.path, arrays))

    def _look_at(self, outcome: Outcome) -> None:
        self._check(outcome.diagnostics)
        self.blocked.update(_blocked(outcome.diagnostics))


def _merged(cloth: dict[str, Any], rigid: dict[str, Any], cloth_count: int) -> dict[str, Any]:
    """Merge the diagnostics of the two solves of a step; entries not listed here are summed.

    Args:
        cloth: Diagnostics of the cloths' solve.
        rigid: Diagnostics of the solve of bodies and robots, where surfaces are numbered without
            the cloths.
        cloth_count: Number of cloths.
    """
    combine = {
        "status": np.maximum,
        "criterion": np.maximum,  # failures follow convergence in the order of criteria
        "certified": np.minimum,
        "residual": np.maximum,
        "minimum_distance": np.minimum,
        "motion_fraction": np.minimum,
    }
    merged = {
        name: combine.get(name, np.add)(cloth[name], rigid[name]).tolist() for name in DIAGNOSTICS
    }
    messages = zip(cloth["message"], rigid["message"], strict=True)
    shifted = [
        [(first + cloth_count, second + cloth_count, *rest) for first, second, *rest in pairs]
        for pairs in rigid["pairs"]
    ]
    shift = np.zeros(COLUMNS)
    shift[:2] = cloth_count
    points = [
        np.concatenate([own, others + shift])
        for own, others in zip(cloth["points"], rigid["points"], strict=True)
    ]
    return {
        **merged,
        "points": points,
        "message": ["; ".join(filter(None, pair)) for pair in messages],
        "pairs": [[*a, *b] for a, b in zip(cloth["pairs"], shifted, strict=True)],
    }


def _blocked(diagnostics: dict[str, Any]) -> dict[int, str]:
    """Environments in which a solve did not complete its motion -> its message."""
    messages = enumerate(zip(diagnostics["status"], diagnostics["message"], strict=True))
    return {i: message for i, (status, message) in messages if status == INFEASIBLE}


def _at_start(state: Fields, tensors: Fields) -> Fields:
    """Fields after a step that did not take place: nothing has moved.

    The start is the only configuration common to the successive solves of bodies and cloths.
    """
    return {
        name: state[name].detach() if name in _PLACES and name in state else torch.zeros_like(old)
        for name, old in tensors.items()
    }
