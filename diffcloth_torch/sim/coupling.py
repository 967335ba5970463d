"""The staggered couplings of a scene: the solves that `dynamics.coupling` puts in their order."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.dynamics.coupling import added_mass_numbers, cloth_to_rigid, rigid_to_cloth
from diffcloth_torch.dynamics.dynamics import Dynamics, Prediction
from diffcloth_torch.errors import AddedMassWarning, InfeasibleMotion
from diffcloth_torch.model.kinematics import pose_frame
from diffcloth_torch.sim.cores import CoreOptions, make_core, with_all_pinned, without_cloths
from diffcloth_torch.sim.inputs import Fields
from diffcloth_torch.sim.layout import Layout
from diffcloth_torch.sim.links import link_poses
from diffcloth_torch.sim.masses import vertex_masses
from diffcloth_torch.sim.step import Outcome, as_array, diagnostics_of, take_step, unconverged

__all__ = ["Staggered"]

Check = Callable[[dict[str, Any]], None]
"""Raises where the diagnostics of a solve say that it failed."""

_LARGEST_ADDED_MASS = 0.5


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
        self._dt = options.dt
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

        def predict(contact: Tensor | None) -> Prediction:
            return self._dynamics.predict(state, control, parameters, contact)

        def solve_rigid(prediction: Prediction) -> _Solved:
            given = self._without_cloths(inputs) | prediction.core_inputs()
            outcome = take_step(self._rigid, given, batched=True)
            check(outcome.diagnostics)
            ends = outcome.coordinates
            return _Solved(outcome, prediction.coordinates if ends is None else ends)

        def solve_cloth(prediction: Prediction, ends: Tensor) -> _Solved:
            given = inputs | prediction.core_inputs() | {"coordinate_ends": ends}
            outcome = take_step(self._cloth, given, batched=True)
            check(outcome.diagnostics)
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
            self._require_free_way(arrays)
            paths.append(partial(self._judge.path, arrays))

        if self._coupling == "rigid_to_cloth":
            solved = rigid_to_cloth(self._dynamics, predict(None), solve_rigid, solve_cloth)
        else:
            solved = cloth_to_rigid(self._dynamics, predict, solve_rigid, solve_cloth, check_path)
        cloth = solved.cloth.outcome
        self._warn(cloth, solved.fields, parameters)
        outcome = Outcome(
            positions=cloth.positions,
            velocities=cloth.velocities,
            body_forces=solved.body_forces,
            diagnostics=_merged(cloth.diagnostics, solved.rigid.outcome.diagnostics),
        )
        return outcome, solved.fields, paths

    def _without_cloths(self, inputs: Fields) -> Fields:
        """What concerns bodies and links alone."""
        assembly = self._layout.assembly
        cloths, surfaces = assembly.cloth_count, assembly.surface_count
        none = torch.zeros(len(inputs["positions"]), 0, 3, dtype=torch.float64)
        names = ("positions", "velocities", "pin_targets", "soft_pin_targets", "forces")
        kept = ("gravity", "barrier_stiffness", "barrier_distance", "slip_velocity")
        rigid = dict.fromkeys(names, none) | {k: inputs[k] for k in kept if k in inputs}
        if "thickness" in inputs:
            rigid["thickness"] = inputs["thickness"][:, cloths:]
            friction = inputs["friction"]
            if friction.shape[1] > 1:  # of pairs
                pairs = friction.reshape(-1, surfaces, surfaces)
                friction = pairs[:, cloths:, cloths:].reshape(len(pairs), -1)
            rigid["friction"] = friction
        return rigid

    def _standing_still(self, inputs: Fields, positions: Tensor) -> Fields:
        """All cloth vertices pinned where they are."""
        return inputs | {
            "positions": positions,
            "pin_targets": positions,
            "velocities": torch.zeros_like(positions),
            "soft_pin_targets": positions[:, :0],
        }

    def _require_free_way(self, inputs: dict[str, FloatArray]) -> None:
        """Refuse a motion of bodies and robots through cloths that stand still."""
        result = self._judge.forward(inputs, False, torch.get_num_threads())
        blocked = unconverged(diagnostics_of(result))
        if blocked:
            raise InfeasibleMotion(
                f"step: what forces move in the environments {blocked} cannot go on without "
                'passing through a cloth; lower dt, or use coupling="monolithic"',
                environments=blocked,
            )

    def _warn(self, cloth: Outcome, after: Fields, parameters: Fields) -> None:
        """Warn once where the cloth that a body touches is not light against it."""
        if self._warned or not cloth.body_forces.detach().any():
            return
        assembly = self._layout.assembly
        with torch.no_grad():
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
        if numbers[worst] > _LARGEST_ADDED_MASS:
            self._warned = True
            name = assembly.surface_names[assembly.cloth_count + worst]
            warnings.warn(
                f"step: the coupling {self._coupling!r} gets inaccurate, and then unstable, where "
                "what a body touches is heavy or stiff against it: the added-mass number of "
                f"{name!r} is about {float(numbers[worst]):.2g}, above {_LARGEST_ADDED_MASS:g}; "
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
        name: combine.get(name, np.add)(values, rigid[name]).tolist()
        for name, values in cloth.items()
        if name != "message"
    }
    pairs = zip(cloth["message"], rigid["message"], strict=True)
    return {**merged, "message": ["; ".join(filter(None, pair)) for pair in pairs]}


def _arrays(inputs: Fields) -> dict[str, FloatArray]:
    return {name: as_array(tensor) for name, tensor in inputs.items()}
