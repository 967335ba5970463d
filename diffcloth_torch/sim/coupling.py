"""The two staggered couplings: cloths, and what forces move, are solved for one after the other.

Both take three steps in another order: a step of the cloths against surfaces on known poses, a step
of bodies and robots without cloths, and the exchange of contact forces f.

`rigid_to_cloth`: bodies move with their velocities, which hold the last impulse; the cloths are
solved against this motion; the new impulse h f changes the velocities of the bodies only.

`cloth_to_rigid`: the cloths are solved against frozen bodies, which prescribed motion alone moves;
then the bodies move under f. No cloth may be in their way.

Either is right to first order while the cloth that a body touches is light against it. The
added-mass number N estimates how it is: (mass of that cloth + h^2 stiffness of the contact) / mass
of the body. From N = 1 on the exchange overshoots, from 3 or 4 on it creates energy.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.dynamics.dynamics import Dynamics
from diffcloth_torch.errors import AddedMassWarning, InfeasibleMotion
from diffcloth_torch.geometry.rotation import matrix_quaternion
from diffcloth_torch.sim.cores import CoreOptions, make_core, with_all_pinned, without_cloths
from diffcloth_torch.sim.inputs import Fields
from diffcloth_torch.sim.layout import Layout
from diffcloth_torch.sim.links import link_poses
from diffcloth_torch.sim.step import CONVERGED, Outcome, as_array, take_step

__all__ = ["Staggered"]

Check = Callable[[dict[str, Any]], None]
"""Raises where the diagnostics of a solve say that it failed."""

_LARGEST_ADDED_MASS = 0.5

# Of the barrier at half of its distance d_hat from a surface: its stiffness is 3.49 / d_hat times
# its force, and its pressure on a surface 4.33 / 4 times the barrier stiffness.
_STIFFNESS_OF_FORCE = 3.49
_PRESSURE_OF_STIFFNESS = 4.33 / 4


class _Fields(NamedTuple):
    """Checked and completed fields of a step, and the inputs that the core has of them."""

    state: Fields
    control: Fields
    parameters: Fields
    inputs: Fields


class _Stages(NamedTuple):
    """What the stages of a step found, each with a leading axis of environments.

    Attributes:
        cloth: Of the cloths; None without any.
        rigid: Of bodies and robots alone.
        after: Fields of the state behind the step.
        paths: Functions that give the polylines of the solves that move cloths or bodies.
    """

    cloth: Outcome | None
    rigid: Outcome
    after: Fields
    paths: list[Callable[[], FloatArray]]


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
        """Make the cores of the stages.

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
        self._rigid = make_core(
            without_cloths(assembly), coupled._replace(bending_models=()), limit_stiffness
        )
        self._has_cloths = assembly.cloth_count > 0
        if self._has_cloths:
            self._cloth = make_core(assembly, options)
            self._judge = make_core(with_all_pinned(assembly), coupled)
        self._warned = False

    def step(
        self, state: Fields, control: Fields, parameters: Fields, inputs: Fields, check: Check
    ) -> tuple[Outcome, Fields]:
        """Take a step; the outcome and the fields behind it have a leading axis of environments.

        Args:
            state: Checked fields of the state.
            control: Completed fields of the control.
            parameters: Checked parameters.
            inputs: Those of the core that are no coordinates.
            check: Looks at the diagnostics of each stage.
        """
        stages = self._run(_Fields(state, control, parameters, inputs), check)
        cloth, rigid = stages.cloth, stages.rigid
        if cloth is None:
            return rigid, stages.after
        self._warn(cloth.body_forces, parameters)
        outcome = Outcome(
            positions=cloth.positions,
            velocities=cloth.velocities,
            body_forces=cloth.body_forces + rigid.body_forces,
            diagnostics=_merged(cloth.diagnostics, rigid.diagnostics),
        )
        return outcome, stages.after

    def path(
        self, state: Fields, control: Fields, parameters: Fields, inputs: Fields, check: Check
    ) -> FloatArray:
        """Polyline along which the surfaces of one environment move, [M, N + V, 3]."""
        stages = self._run(_Fields(state, control, parameters, inputs), check)
        return np.concatenate([path() for path in stages.paths])

    def _run(self, fields: _Fields, check: Check) -> _Stages:
        if self._coupling == "rigid_to_cloth":
            return self._rigid_to_cloth(fields, check)
        return self._cloth_to_rigid(fields, check)

    def _rigid_to_cloth(self, fields: _Fields, check: Check) -> _Stages:
        dynamics = self._dynamics
        prediction = dynamics.predict(fields.state, fields.control, fields.parameters)
        rigid, coordinates = self._solve_rigid(prediction.core_inputs(), fields.inputs, check)
        after = dynamics.advance(prediction, coordinates, rigid.body_forces)
        if not self._has_cloths:
            return _Stages(None, rigid, after, [])
        inputs = self._cloth_inputs(fields.inputs, fields.state, after)
        cloth = take_step(self._cloth, inputs, batched=True)
        check(cloth.diagnostics)
        kicked = dynamics.advance(
            prediction, coordinates, rigid.body_forces, kick=cloth.body_forces
        )
        return _Stages(cloth, rigid, kicked, [lambda: self._cloth.path(_arrays(inputs))])

    def _cloth_to_rigid(self, fields: _Fields, check: Check) -> _Stages:
        state, control = fields.state, fields.control
        frozen = self._frozen(state, control)
        forces, cloth, paths = None, None, []
        if self._has_cloths:
            inputs = self._cloth_inputs(fields.inputs, state, frozen)
            cloth = take_step(self._cloth, inputs, batched=True)
            check(cloth.diagnostics)
            forces = cloth.body_forces
            paths.append(lambda: self._cloth.path(_arrays(inputs)))
        prediction = self._dynamics.predict(state, control, fields.parameters, contact=forces)
        rigid, coordinates = self._solve_rigid(prediction.core_inputs(), fields.inputs, check)
        after = self._dynamics.advance(prediction, coordinates, rigid.body_forces)
        if cloth is not None:
            judged = self._judge_inputs(fields.inputs, cloth.positions, frozen, after)
            self._require_free_way(judged)
            paths.append(lambda: self._judge.path(judged))
        return _Stages(cloth, rigid, after, paths)

    def _frozen(self, state: Fields, control: Fields) -> Fields:
        """Where prescribed motion alone takes bodies and robots."""
        layout, joints = self._layout, state["joint_positions"]
        turned = joints + self._dt * control["joint_velocities"]
        modes = layout.actuation
        ends = torch.where(_which(modes, "velocity"), turned, joints)
        ends = torch.where(_which(modes, "position"), control["joint_positions"], ends)
        return {
            "body_poses": control["body_poses"],
            "base_poses": control["base_poses"],
            "joint_positions": ends,
        }

    def _solve_rigid(
        self, coordinates: Fields, inputs: Fields, check: Check
    ) -> tuple[Outcome, Tensor]:
        """Solve for bodies and robots alone; their outcome, and coordinates [B, n] at its end."""
        outcome = take_step(self._rigid, self._rigid_inputs(coordinates, inputs), batched=True)
        check(outcome.diagnostics)
        ends = outcome.coordinates
        return outcome, coordinates["coordinates"] if ends is None else ends

    def _rigid_inputs(self, coordinates: Fields, inputs: Fields) -> Fields:
        cloths, surfaces = self._layout.assembly.cloth_count, self._layout.assembly.surface_count
        environments = len(inputs["positions"])
        none = torch.zeros(environments, 0, 3, dtype=torch.float64)
        names = ("positions", "velocities", "pin_targets", "soft_pin_targets", "forces")
        rigid = dict.fromkeys(names, none)
        for name in ("gravity", "barrier_stiffness", "barrier_distance", "slip_velocity"):
            if name in inputs:
                rigid[name] = inputs[name]
        if "thickness" in inputs:
            rigid["thickness"] = inputs["thickness"][:, cloths:]
            friction = inputs["friction"]
            if friction.shape[1] > 1:  # of pairs
                pairs = friction.reshape(-1, surfaces, surfaces)
                friction = pairs[:, cloths:, cloths:].reshape(len(pairs), -1)
            rigid["friction"] = friction
        return {**rigid, **coordinates}

    def _cloth_inputs(self, inputs: Fields, start: Fields, end: Fields) -> Fields:
        poses = {
            "body_poses": _surface_poses(self._layout, start),
            "body_targets": _surface_poses(self._layout, end),
        }
        return {**inputs, **poses}

    def _judge_inputs(
        self, inputs: Fields, positions: Tensor, start: Fields, end: Fields
    ) -> dict[str, FloatArray]:
        given = self._cloth_inputs(inputs, start, end)
        given["positions"] = given["pin_targets"] = positions
        given["velocities"] = torch.zeros_like(positions)
        given["soft_pin_targets"] = positions[:, :0]
        return _arrays(given)

    def _require_free_way(self, inputs: dict[str, FloatArray]) -> None:
        """Refuse a motion of the bodies through cloths that stand still."""
        result = self._judge.forward(inputs, False, torch.get_num_threads())
        blocked = np.flatnonzero(result["status"] != CONVERGED).tolist()
        if blocked:
            raise InfeasibleMotion(
                f"step: the bodies of environments {blocked} cannot move on without passing "
                'through a cloth; lower dt, or use coupling="monolithic"',
                environments=blocked,
            )

    def _warn(self, forces: Tensor, parameters: Fields) -> None:
        """Warn once where the cloth that a body touches is not light against it."""
        if self._warned:
            return
        number, name = self._added_mass(forces.detach(), parameters)
        if number > _LARGEST_ADDED_MASS:
            self._warned = True
            warnings.warn(
                f"step: the staggered coupling {self._coupling!r} gets inaccurate, and then "
                f"unstable, where the cloth that a body touches is heavy or stiff against it: the "
                f"added-mass number of {name!r} is about {number:.2g}, beyond "
                f'{_LARGEST_ADDED_MASS:g}; use coupling="monolithic", or a smaller dt',
                AddedMassWarning,
                stacklevel=4,
            )

    def _added_mass(self, forces: Tensor, parameters: Fields) -> tuple[float, str]:
        """Estimate of the largest added-mass number from contact forces [B, V, 3], and whose it is.

        The force on a body tells how stiff a contact is, and how large, if it is at half of the
        barrier's distance.
        """
        layout, assembly = self._layout, self._layout.assembly
        worst = (0.0, "")
        distance = parameters["barrier_distance"].detach()
        stiffness = parameters["barrier_stiffness"].detach()
        density = parameters["density"].detach().mean(1, keepdim=True)
        owners = assembly.surface_mechanism
        for t, mechanism in enumerate(assembly.mechanisms):
            if not mechanism.is_dynamic:
                continue
            surfaces = np.flatnonzero(owners == t)
            spans = zip(
                assembly.body_vertex_start[surfaces],
                assembly.body_vertex_start[surfaces + 1],
                strict=True,
            )
            rows = torch.tensor([v for a, b in spans for v in range(a, b)], dtype=torch.int64)
            force = forces[:, rows].norm(dim=-1).sum(1, keepdim=True)
            area = force / (_PRESSURE_OF_STIFFNESS * stiffness)
            contact = self._dt**2 * _STIFFNESS_OF_FORCE * force / distance
            mass = layout.mass_of(t, parameters).detach().reshape(-1, 1)
            number = float(((density * area + contact) / mass).max())
            worst = max(worst, (number, mechanism.name))
        return worst


def _surface_poses(layout: Layout, fields: Fields) -> Tensor:
    """Poses of all bodies, then of the links that have a shape, [B, K + Lc, 7]."""
    poses = [fields["body_poses"]]
    frames = link_poses(layout, fields)
    for name in layout.assembly.surface_names[layout.assembly.cloth_count :]:
        if name in frames:
            frame = frames[name]
            pose = torch.cat([frame[:, :3, 3], matrix_quaternion(frame[:, :3, :3])], dim=-1)
            poses.append(pose[:, None])
    environments = max(len(part) for part in poses)
    return torch.cat([part.expand(environments, -1, -1) for part in poses], dim=1)


def _which(modes: tuple[str, ...], mode: str) -> Tensor:
    return torch.tensor([m == mode for m in modes], dtype=torch.bool)


def _merged(cloth: dict[str, Any], rigid: dict[str, Any]) -> dict[str, Any]:
    """Diagnostics of a step from those of its two solves."""
    worst = {"status": np.maximum, "residual": np.maximum}
    least = {"minimum_distance": np.minimum, "motion_fraction": np.minimum}
    combine = {**worst, **least}
    merged = {
        name: combine.get(name, np.add)(values, rigid[name])
        for name, values in cloth.items()
        if name != "message"
    }
    pairs = zip(cloth["message"], rigid["message"], strict=True)
    return {**merged, "message": ["; ".join(filter(None, pair)) for pair in pairs]}


def _arrays(inputs: Fields) -> dict[str, FloatArray]:
    return {name: as_array(tensor) for name, tensor in inputs.items()}
