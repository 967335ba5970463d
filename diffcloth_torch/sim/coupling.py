"""The staggered couplings of a scene: the solves that `dynamics.coupling` puts in their order."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Container
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.dynamics.coupling import Staggered as StaggeredSolution
from diffcloth_torch.dynamics.coupling import added_mass_numbers, cloth_to_rigid, rigid_to_cloth
from diffcloth_torch.dynamics.dynamics import Dynamics, Prediction
from diffcloth_torch.errors import AddedMassWarning, InfeasibleMotion
from diffcloth_torch.model.kinematics import pose_frame
from diffcloth_torch.sim.cores import CoreOptions, make_core, with_all_pinned, without_cloths
from diffcloth_torch.sim.inputs import Fields
from diffcloth_torch.sim.layout import Layout
from diffcloth_torch.sim.links import link_poses
from diffcloth_torch.sim.masses import cloth_totals, vertex_masses
from diffcloth_torch.sim.motion import with_rows
from diffcloth_torch.sim.step import (
    CONVERGED,
    DIAGNOSTICS,
    INFEASIBLE,
    Outcome,
    as_array,
    diagnostics_of,
    take_step,
)

__all__ = ["Staggered"]

Check = Callable[[dict[str, Any]], None]
"""Raises where the diagnostics of a solve say that it failed."""

_LARGEST_ADDED_MASS = 0.5
_LARGEST_GAIN = 0.01  # of what moves and presses, in a step

# What the core takes of bodies and links.
_PLACED = (
    "body_poses",
    "body_targets",
    "coordinates",
    "coordinate_ends",
    "coordinate_targets",
    "coordinate_metric",
)

# What a state has besides velocities, forces and efforts.
_PLACES = ("positions", "body_poses", "joint_positions", "base_poses")


class _Solved(NamedTuple):
    """A solve, with a leading axis of environments.

    Attributes:
        outcome: What it found.
        coordinates: Of bodies and robots at the end of the step, [B, n].
    """

    outcome: Outcome
    coordinates: Tensor

    @property
    def body_forces(self) -> Tensor:
        """On the vertices of bodies and links, [B, V, 3] N."""
        return self.outcome.body_forces


class Staggered:
    """Steps a scene by "rigid_to_cloth" or "cloth_to_rigid"."""

    def __init__(
        self,
        coupling: str,
        layout: Layout,
        dynamics: Dynamics,
        options: CoreOptions,
        limit_stiffness: FloatArray,
    ) -> None:
        """Make the cores of the solves.

        Args:
            coupling: Which of the two.
            layout: What the rows stand for.
            dynamics: Of the bodies and robots.
            options: Of the cores.
            limit_stiffness: Of the barriers at the limits of coordinates, shape [n].
        """
        self._coupling, self._layout, self._dynamics = coupling, layout, dynamics
        self._dt, self._throw = options.dt, options.solver.throw
        assembly = layout.assembly
        coupled = options._replace(scheme="coupled")
        alone = coupled._replace(bending_models=())
        self._rigid = make_core(without_cloths(assembly), alone, limit_stiffness)
        self._cloth = make_core(assembly, options, limit_stiffness, all_prescribed=True)
        # Nothing moves by itself there: a step succeeds where a motion is free of collisions.
        pinned = with_all_pinned(assembly)
        self._judge = make_core(pinned, coupled, limit_stiffness, all_prescribed=True)
        self._warned = False

    def step(
        self, state: Fields, control: Fields, parameters: Fields, inputs: Fields, check: Check
    ) -> tuple[Outcome, Fields]:
        """Take a step; the outcome and the fields behind it have a leading axis of environments.

        Args:
            state: Checked fields of the state.
            control: Completed fields of the control.
            parameters: Checked parameters.
            inputs: Those of the core that do not concern bodies and robots.
            check: Looks at the diagnostics of each solve.
        """
        outcome, after, _ = self._solve(state, control, parameters, inputs, check)
        return outcome, after

    def path(
        self, state: Fields, control: Fields, parameters: Fields, inputs: Fields, check: Check
    ) -> FloatArray:
        """Polyline along which the surfaces of one environment move, [M, N + V, 3]."""
        *_, paths = self._solve(state, control, parameters, inputs, check)
        return np.concatenate([path() for path in paths])

    def _solve(
        self, state: Fields, control: Fields, parameters: Fields, inputs: Fields, check: Check
    ) -> tuple[Outcome, Fields, list[Callable[[], FloatArray]]]:
        """Outcome, fields behind the step, and the polylines of what is solved with the cloths."""
        paths: list[Callable[[], FloatArray]] = []
        blocked: dict[int, str] = {}  # environments whose motion cannot be completed -> why

        def look_at(outcome: Outcome) -> None:
            check(outcome.diagnostics)
            blocked.update(_blocked(outcome.diagnostics))

        def predict(contact: Tensor | None) -> Prediction:
            return self._dynamics.predict(state, control, parameters, contact)

        def solve_rigid(prediction: Prediction) -> _Solved:
            given = self._without_cloths(inputs) | prediction.core_inputs()
            outcome = take_step(self._rigid, given, batched=True)
            look_at(outcome)
            ends = outcome.coordinates
            return _Solved(outcome, prediction.coordinates if ends is None else ends)

        def solve_cloth(
            prediction: Prediction, ends: Tensor, origins: Tensor | None = None
        ) -> _Solved:
            given = inputs | prediction.core_inputs() | {"coordinate_ends": ends}
            if origins is not None:
                given["coordinate_origins"] = origins
            outcome = take_step(self._cloth, given, batched=True)
            look_at(outcome)
            if blocked:  # what is squeezed may push too hard to find a motion
                forces = {"": outcome.body_forces}
                none = {"": torch.zeros_like(outcome.body_forces)}
                outcome = outcome._replace(body_forces=with_rows(forces, none, blocked)[""])
            paths.append(partial(self._cloth.path, _arrays(given)))
            return _Solved(outcome, ends)

        def check_path(cloth: _Solved, prediction: Prediction, start: Tensor, end: Tensor) -> None:
            given = self._standing_still(inputs, cloth.outcome.positions)
            given |= prediction.core_inputs() | {
                "body_poses": prediction.body_targets,
                "coordinates": start,
                "coordinate_ends": end,
            }
            arrays = _arrays(given)
            blocked.update(self._blocked_ways(arrays, blocked))
            paths.append(partial(self._judge.path, arrays))

        if self._coupling == "rigid_to_cloth":
            solved = rigid_to_cloth(self._dynamics, predict(None), solve_rigid, solve_cloth)
        else:
            last = partial(self._dynamics.last_coordinates, state=state)
            solved = cloth_to_rigid(
                self._dynamics, predict, last, solve_rigid, solve_cloth, check_path
            )
        cloth = solved.cloth.outcome
        if not self._warned and cloth.body_forces.any():
            with torch.no_grad():
                passive = not blocked and self._is_passive(state, control)
                gain = self._gain(state, solved, parameters, inputs) if passive else 0.0
                self._warn(cloth, solved.fields, parameters, gain)
        diagnostics = _merged(cloth.diagnostics, solved.rigid.outcome.diagnostics)
        tensors = {
            **solved.fields,
            "positions": cloth.positions,
            "velocities": cloth.velocities,
            "body_forces": solved.body_forces,
        }
        if blocked:
            tensors = with_rows(tensors, _at_start(state, tensors), blocked)
            for i, message in blocked.items():
                diagnostics["status"][i] = INFEASIBLE
                diagnostics["motion_fraction"][i] = 0.0
                diagnostics["message"][i] = message
        names = ("positions", "velocities", "body_forces")
        outcome = Outcome(**{n: tensors.pop(n) for n in names}, diagnostics=diagnostics)
        return outcome, tensors, paths

    def _without_cloths(self, inputs: Fields) -> Fields:
        """What concerns bodies and links alone."""
        assembly = self._layout.assembly
        cloths, surfaces = assembly.cloth_count, assembly.surface_count
        none = torch.zeros(len(inputs["positions"]), 0, 3, dtype=torch.float64)
        names = ("positions", "velocities", "pin_targets", "soft_pin_targets", "forces")
        kept = ("gravity", "barrier_distance", "slip_velocity")
        rigid = dict.fromkeys(names, none) | {k: inputs[k] for k in kept if k in inputs}
        if "thickness" in inputs:
            rigid["thickness"] = inputs["thickness"][:, cloths:]
        for name in ("friction", "barrier_stiffness"):
            if name not in inputs:
                continue
            rigid[name] = inputs[name]
            if rigid[name].shape[1] > 1:  # of pairs
                pairs = rigid[name].reshape(-1, surfaces, surfaces)
                rigid[name] = pairs[:, cloths:, cloths:].reshape(len(pairs), -1)
        return rigid

    def _standing_still(self, inputs: Fields, positions: Tensor) -> Fields:
        """All cloth vertices pinned where they are."""
        return inputs | {
            "positions": positions,
            "pin_targets": positions,
            "velocities": torch.zeros_like(positions),
            "soft_pin_targets": positions[:, :0],
        }

    def _blocked_ways(self, inputs: dict[str, FloatArray], known: Container[int]) -> dict[int, str]:
        """Refuse motions of bodies and robots through cloths that stand still.

        Returns:
            Where that is so, besides what is known, and what to do; where nothing is raised.
        """
        result = self._judge.forward(inputs, False, torch.get_num_threads())
        status = diagnostics_of(result)["status"]
        blocked = [i for i, s in enumerate(status) if s != CONVERGED and i not in known]
        remedy = 'passing through a cloth; lower dt, or use coupling="monolithic"'
        if blocked and self._throw:
            raise InfeasibleMotion(
                f"step: what forces move in the environments {blocked} cannot go on without "
                f"{remedy}",
                environments=blocked,
            )
        return dict.fromkeys(blocked, f"what forces move cannot go on without {remedy}")

    def _is_passive(self, state: Fields, control: Fields) -> bool:
        """Whether only gravity does work: nothing else pushes, and what is prescribed rests."""
        if self._layout.robots or any(control[name].any() for name in ("forces", "body_wrenches")):
            return False
        pins = state["positions"][:, self._layout.pins]
        held = {"pins": pins, "soft_pins": state["soft_pin_targets"]}
        held["body_poses"] = state["body_poses"]
        return all(torch.equal(control[n].expand_as(rests), rests) for n, rests in held.items())

    def _gain(
        self,
        state: Fields,
        solved: StaggeredSolution[_Solved, _Solved],
        parameters: Fields,
        inputs: Fields,
    ) -> float:
        """Rise of the energy over a step as a share of what moves and presses, the largest."""
        cloth, moved = solved.cloth.outcome, solved.prediction
        after = {"positions": cloth.positions, "velocities": cloth.velocities, **solved.fields}
        here = inputs | moved.core_inputs()
        there = here | {
            "positions": cloth.positions,
            "body_poses": moved.body_targets,
            "coordinates": solved.rigid.coordinates,
        }
        before, (kinetic, contact, rest) = (
            self._energies(at, fields, parameters) for at, fields in ((here, state), (there, after))
        )
        rise = kinetic + contact + rest - sum(before)
        return float((rise / (kinetic + contact)).amax())

    def _energies(
        self, inputs: Fields, state: Fields, parameters: Fields
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Kinetic energy, that of contact, and all other, [B] J."""
        stored = self._cloth.stored_energy(_arrays(inputs))
        placed = {name: inputs[name] for name in _PLACED}
        alone = self._rigid.stored_energy(_arrays(self._without_cloths(inputs) | placed))
        totals = cloth_totals(self._layout.assembly, state, parameters)
        totals = totals.plus(self._dynamics.totals(state, parameters))
        contact = torch.from_numpy(stored.pop("contact") + alone["contact"])
        rest = totals.gravity_energy + sum(torch.from_numpy(part) for part in stored.values())
        return totals.kinetic_energy, contact, rest

    def _warn(self, cloth: Outcome, after: Fields, parameters: Fields, gain: float) -> None:
        """Warn once where the cloth that a body touches is not light against it.

        Args:
            cloth: What the cloths' solve has found.
            after: Fields of bodies and robots behind the step.
            parameters: Checked parameters.
            gain: Share of the energy that the step has made from nothing.
        """
        assembly = self._layout.assembly
        numbers = added_mass_numbers(
            assembly,
            self._surface_frames(after),
            self._surface_masses(parameters),
            cloth.positions,
            vertex_masses(assembly, parameters),
            cloth.body_forces,
            parameters["barrier_distance"].reshape(-1),
            self._dt,
        ).amax(0)
        worst = int(numbers.argmax())
        if numbers[worst] > _LARGEST_ADDED_MASS or gain > _LARGEST_GAIN:
            self._warned = True
            name = assembly.surface_names[assembly.cloth_count + worst]
            if gain > _LARGEST_GAIN:
                sign = f"a step near {name!r} gained {gain:.2g} of the energy of motion and contact"
            else:
                sign = (
                    f"the added-mass number of {name!r} is about {float(numbers[worst]):.2g}, "
                    f"above {_LARGEST_ADDED_MASS:g}"
                )
            warnings.warn(
                f"step: the coupling {self._coupling!r} gets inaccurate, and then unstable, where "
                f"what a body touches is heavy or stiff against it: {sign}; "
                'use coupling="monolithic", or a smaller dt',
                AddedMassWarning,
                stacklevel=5,
            )

    def _surface_frames(self, fields: Fields) -> Tensor:
        """Frames of all bodies, then of the links that have a shape, [B, K + Lc, 4, 4]."""
        bodies = pose_frame(fields["body_poses"])
        links = link_poses(self._layout, fields)
        names = self._layout.rigid_vertices
        return torch.cat([bodies, *(links[n][:, None] for n in names if n in links)], dim=1)

    def _surface_masses(self, parameters: Fields) -> Tensor:
        """Masses of them, zero where nothing is dynamic, [B or 1, K + Lc]."""
        layout = self._layout
        bodies = torch.zeros(1, len(layout.bodies), dtype=torch.float64)
        links = torch.zeros(1, sum(r.link_count for r in layout.robots), dtype=torch.float64)
        bodies = parameters.get("body_mass", bodies)
        links = parameters.get("link_mass", links)[:, layout.shaped_links]
        environments = max(len(bodies), len(links))
        return torch.cat([m.expand(environments, -1) for m in (bodies, links)], dim=1)


def _merged(cloth: dict[str, Any], rigid: dict[str, Any]) -> dict[str, Any]:
    """Diagnostics of a step from those of its two solves; what is not listed here is added."""
    combine = {
        "status": np.maximum,
        "residual": np.maximum,
        "minimum_distance": np.minimum,
        "motion_fraction": np.minimum,
    }
    merged = {
        name: combine.get(name, np.add)(cloth[name], rigid[name]).tolist() for name in DIAGNOSTICS
    }
    pairs = zip(cloth["message"], rigid["message"], strict=True)
    return {**merged, "message": ["; ".join(filter(None, pair)) for pair in pairs]}


def _blocked(diagnostics: dict[str, Any]) -> dict[int, str]:
    """Environments in which a solve did not complete its motion -> what it says."""
    messages = enumerate(zip(diagnostics["status"], diagnostics["message"], strict=True))
    return {i: message for i, (status, message) in messages if status == INFEASIBLE}


def _at_start(state: Fields, tensors: Fields) -> Fields:
    """Fields behind a step that did not take place: nothing has moved.

    The solves that move bodies and cloths in turn have no other point in common.
    """
    return {
        name: state[name].detach() if name in _PLACES and name in state else torch.zeros_like(old)
        for name, old in tensors.items()
    }


def _arrays(inputs: Fields) -> dict[str, FloatArray]:
    return {name: as_array(tensor) for name, tensor in inputs.items()}
