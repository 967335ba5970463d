"""Bodies and robots of a scene over one step: before the core, and after it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffcloth_torch.dynamics.bodies import (
    MOST_TURN_IN_CONTACT,
    BodyInertia,
    BodyPrediction,
    advance_bodies,
    body_totals,
    predict_bodies,
    refuse_turns,
)
from diffcloth_torch.dynamics.chain import Chain, ChainControl, ChainPrediction, ChainState
from diffcloth_torch.dynamics.drives import Gains
from diffcloth_torch.dynamics.inertia import Inertia
from diffcloth_torch.dynamics.totals import Totals
from diffcloth_torch.geometry.rotation import (
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
    rotate,
    row_velocities,
)
from diffcloth_torch.model.scene import Assembly

__all__ = ["Dynamics", "Fields", "Prediction"]

Fields = Mapping[str, Tensor]

_forked = False


def _note_fork() -> None:
    global _forked
    _forked = True


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


@dataclass(frozen=True, eq=False)
class Prediction:
    """A step without contact and limits: what the core starts from.

    T trees: K bodies, then R robots. n coordinates: for each dynamic body its center of mass c [m]
    and the rotation vector w about its predicted orientation; for each robot the same of a base
    that floats, then its joints.

    Attributes:
        body_poses: Frames of the roots at the start of the step, [B, T, 7]. That of a free root
            takes points to where they are predicted about the center of mass.
        body_targets: Likewise at the end.
        coordinates: At the start, [B, n].
        coordinate_ends: At the end where they are prescribed, [B, n].
        coordinate_targets: t of the term (q - t)^T A (q - t) / 2 that the step minimizes, [B, n].
        coordinate_metric: A, row by row, tree after tree, [B, sum n_t^2].
        bodies: Details of the dynamic bodies, None where there are none.
        chains: Details of the robots.
        held_poses: Poses of all bodies, dynamic ones as at the start, [B, K, 7].
        held_velocities: Velocities of kinematic bodies, zero elsewhere, [B, K, 6].
    """

    body_poses: Tensor
    body_targets: Tensor
    coordinates: Tensor
    coordinate_ends: Tensor
    coordinate_targets: Tensor
    coordinate_metric: Tensor
    bodies: BodyPrediction | None
    chains: tuple[ChainPrediction, ...]
    held_poses: Tensor
    held_velocities: Tensor

    def core_inputs(self) -> dict[str, Tensor]:
        """The inputs of the core, by its names."""
        return {
            "body_poses": self.body_poses,
            "body_targets": self.body_targets,
            "coordinates": self.coordinates,
            "coordinate_ends": self.coordinate_ends,
            "coordinate_targets": self.coordinate_targets,
            "coordinate_metric": self.coordinate_metric,
        }


class Dynamics:
    """Predicts and advances the bodies and robots of a scene. Immutable.

    Attributes:
        dt: Time step [s].
        coordinate_count: n.
        prescribed: Which coordinates are prescribed, [n].
    """

    def __init__(self, assembly: Assembly, dt: float) -> None:
        """Prepare the constants.

        Args:
            assembly: Arrays of the scene.
            dt: Time step [s].
        """
        self.dt = dt
        K = assembly.body_count
        mechanisms = assembly.mechanisms
        self._free = _indices(k for k in range(K) if mechanisms[k].base == "floating")
        self._moved = _indices(k for k in range(K) if mechanisms[k].base == "kinematic")
        self._free_names = [mechanisms[k].name for k in self._free]
        surface_of_vertex = torch.repeat_interleave(
            torch.tensor(assembly.body_vertex_start.tolist()).diff()
        )
        owner = torch.from_numpy(assembly.surface_mechanism).long()[surface_of_vertex]
        link = torch.from_numpy(assembly.surface_link).long()[surface_of_vertex]
        vertices = torch.from_numpy(assembly.body_vertices)

        row = torch.full((len(mechanisms),), -1).index_copy(
            0, self._free, torch.arange(len(self._free))
        )[owner]  # of a vertex's body among the dynamic ones
        self._on_free = torch.nonzero(row >= 0)[:, 0]
        self._body_of_vertex = row[self._on_free]
        self._body_points = vertices[self._on_free]

        self._chains: list[Chain] = []
        self._chain_rows: list[tuple[slice, slice, Tensor]] = []  # joints, links, vertices
        self._widths = [6 * len(self._free)]  # of the parts of the coordinates
        held = [torch.zeros(6 * len(self._free), dtype=torch.bool)]
        joints = links = 0
        for t in range(K, len(mechanisms)):
            mechanism = mechanisms[t]
            rows = torch.nonzero(owner == t)[:, 0]
            chain = Chain(mechanism, dt, link[rows], vertices[rows])
            joint_rows = slice(joints, joints := joints + mechanism.joint_count)
            link_rows = slice(links, links := links + mechanism.link_count)
            self._chains.append(chain)
            self._chain_rows.append((joint_rows, link_rows, rows))
            self._widths.append(chain.coordinate_count)
            held.append(chain.prescribed)
        self.prescribed = torch.cat(held)
        self.coordinate_count = len(self.prescribed)

    def predict(
        self,
        state: Fields,
        control: Fields,
        parameters: Fields,
        contact: Tensor | None = None,
    ) -> Prediction:
        """Take the step without contact and limits.

        Args:
            state: Fields of a state, each with a leading axis B.
            control: Fields of a control, complete, each with a leading axis B or 1.
            parameters: `gravity`, and masses, gains and so on where the scene has them; with
                leading axes B or 1.
            contact: Forces on the vertices of bodies and links [N] that act over the step like
                gravity, shape [B, V, 3].
        """
        if _forked and torch.get_num_threads() > 1:
            # Threads of torch and MKL do not outlive a fork: an operation would wait for them.
            torch.set_num_threads(1)
        batch = len(state["body_poses"])
        now = {name: values.expand(batch, *values.shape[1:]) for name, values in state.items()}
        acting = {name: values.expand(batch, *values.shape[1:]) for name, values in control.items()}
        gravity = parameters["gravity"].reshape(-1, 3)

        bodies = self._predict_bodies(now, acting, parameters, gravity, contact)
        start, end = now["body_poses"], acting["body_poses"]
        velocities = row_velocities(start, end, self._moved, self.dt)
        held = end
        if bodies is not None:
            held = end.index_copy(1, self._free, start[:, self._free])
            start = start.index_copy(1, self._free, bodies.frames)
            end = end.index_copy(1, self._free, bodies.frames)
        chains = tuple(
            self._predict_chain(i, now, acting, parameters, gravity, contact)
            for i in range(len(self._chains))
        )
        none = start.new_zeros(batch, 0)

        def rows(of_bodies: Tensor | None, of_chains: Iterable[Tensor]) -> Tensor:
            first = none if of_bodies is None else of_bodies.flatten(1)
            return torch.cat([first, *(t.flatten(1) for t in of_chains)], dim=1)

        b = bodies
        return Prediction(
            body_poses=torch.cat([start, *(c.root_start[:, None] for c in chains)], dim=1),
            body_targets=torch.cat([end, *(c.root_end[:, None] for c in chains)], dim=1),
            coordinates=rows(b and b.coordinates, (c.coordinates for c in chains)),
            coordinate_ends=rows(b and b.coordinates, (c.ends for c in chains)),
            coordinate_targets=rows(b and b.target, (c.target for c in chains)),
            coordinate_metric=rows(b and b.metric, (c.metric for c in chains)),
            bodies=bodies,
            chains=chains,
            held_poses=held,
            held_velocities=velocities,
        )

    def end_at(self, prediction: Prediction, poses: Tensor) -> Prediction:
        """The prediction of a step in which what is prescribed has ended at other poses.

        Args:
            prediction: Of the step.
            poses: Of all roots at its end, [B, T, 7]; those of free ones do not count.
        """
        moved, bodies = self._moved, prediction.held_poses.shape[1]
        start, end = prediction.body_poses[:, :bodies], poses[:, :bodies]
        chains = zip(self._chains, prediction.chains, poses[:, bodies:].unbind(1), strict=True)
        return replace(
            prediction,
            held_poses=prediction.held_poses.index_copy(1, moved, end[:, moved]),
            held_velocities=row_velocities(start, end, moved, self.dt),
            chains=tuple(chain.end_at(own, pose) for chain, own, pose in chains),
        )

    def last_coordinates(self, prediction: Prediction, state: Fields) -> Tensor:
        """Coordinates a step before the start, by the velocities there, [B, n].

        Those that are prescribed are at the start.

        Args:
            prediction: Of the step.
            state: As for `predict`.
        """
        here = prediction.coordinates
        own, *chains = torch.split(here, self._widths, dim=1)
        last = []
        if prediction.bodies is not None:
            rates = state["body_velocities"][:, self._free]
            root = self._moved_back(own.reshape(len(own), -1, 6), rates)
            last.append(root.flatten(1))
        for i, (chain, rows) in enumerate(zip(self._chains, chains, strict=True)):
            joints = self._chain_rows[i][0]
            count = joints.stop - joints.start
            root, values = torch.split(rows, [chain.coordinate_count - count, count], dim=1)
            if root.shape[1]:
                root = self._moved_back(root, state["base_velocities"][:, i])
            last += [root, values - self.dt * state["joint_velocities"][:, joints]]
        return torch.where(self.prescribed, here, torch.cat([here[:, :0], *last], dim=1))

    def _moved_back(self, roots: Tensor, velocities: Tensor) -> Tensor:
        """Coordinates of free roots a step before, [.., 6]."""
        shift, turn = torch.split(self.dt * velocities, 3, dim=-1)
        center, vector = torch.split(roots, 3, dim=-1)
        back = quaternion_multiply(quaternion_exp(-turn), quaternion_exp(vector))
        return torch.cat([center - shift, quaternion_log(back)], dim=-1)

    def advance(
        self,
        prediction: Prediction,
        coordinates: Tensor,
        contact: Tensor,
        kick: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Fields of the state after the step.

        Args:
            prediction: Of this step.
            coordinates: At its end, as the core found them, [B, n].
            contact: Forces on the vertices of bodies and links that it was solved with [N], shape
                [B, V, 3].
            kick: More forces on them, which change velocities only.

        Returns:
            `body_poses`, `body_velocities`, `joint_positions`, `joint_velocities`, `joint_efforts`,
            `base_poses` and `base_velocities`.

        Raises:
            SimulationError: Where a dynamic body turns too far in a step that touches it.
        """
        poses, velocities = prediction.held_poses, prediction.held_velocities
        batch = len(poses)
        parts = torch.split(coordinates, self._widths, dim=1)
        bodies = prediction.bodies
        if bodies is not None:
            own = parts[0].reshape(batch, -1, 6)
            self._require_slow(bodies, contact)
            wrenches = None
            if kick is not None:
                self._require_slow(bodies, kick)
                turned = quaternion_multiply(quaternion_exp(own[..., 3:]), bodies.frames[..., 3:])
                wrenches = self._wrenches(turned, bodies.inertia.center, kick)
            moved, rates = advance_bodies(bodies, own, wrenches, self.dt)
            poses = poses.index_copy(1, self._free, moved)
            velocities = velocities.index_copy(1, self._free, rates)
        states, efforts = [], []
        for i, chain in enumerate(self._chains):
            rows = self._chain_rows[i][2]
            pushed = None if kick is None else kick[:, rows]
            after, effort = chain.advance(
                prediction.chains[i], parts[1 + i], contact[:, rows], pushed
            )
            states.append(after)
            efforts.append(effort)
        none = coordinates.new_zeros(batch, 0)
        bases = coordinates.new_zeros(batch, 0, 7)
        return {
            "body_poses": poses,
            "body_velocities": velocities,
            "joint_positions": torch.cat([none, *(s.joints for s in states)], dim=1),
            "joint_velocities": torch.cat([none, *(s.rates for s in states)], dim=1),
            "joint_efforts": torch.cat([none, *efforts], dim=1),
            "base_poses": torch.cat([bases, *(s.pose[:, None] for s in states)], dim=1),
            "base_velocities": torch.cat(
                [bases[..., :6], *(s.velocity[:, None] for s in states)], dim=1
            ),
        }

    def totals(self, state: Fields, parameters: Fields) -> Totals:
        """Momentum and energy of what forces move, bodies and robots.

        Args:
            state: Fields of a state, each with a leading axis B.
            parameters: As for `predict`.
        """
        gravity = parameters["gravity"].reshape(-1, 3)
        free = self._free
        result = Totals.zero(len(state["body_poses"]))
        if len(free):
            poses, velocities = state["body_poses"][:, free], state["body_velocities"][:, free]
            result = body_totals(poses, velocities, self._body_inertia(parameters), gravity)
        for i, chain in enumerate(self._chains):
            of_chain = chain.totals(
                self._chain_state(i, state), self._chain_inertia(i, parameters), gravity
            )
            result = result.plus(of_chain)
        return result

    def _body_inertia(self, parameters: Fields) -> BodyInertia:
        free = self._free
        return BodyInertia(
            mass=parameters["body_mass"][:, free],
            center=parameters["body_center"][:, free],
            inertia=_symmetric(parameters["body_inertia"][:, free]),
        )

    def _chain_inertia(self, i: int, parameters: Fields) -> Inertia:
        joints, links, _ = self._chain_rows[i]
        return Inertia(
            mass=_rows(parameters, "link_mass", links),
            center=_rows(parameters, "link_center", links, 3),
            inertia=_symmetric(_rows(parameters, "link_inertia", links, 3, 3)),
            armature=_rows(parameters, "joint_armature", joints),
        )

    def _chain_state(self, i: int, state: Fields) -> ChainState:
        joints = self._chain_rows[i][0]
        return ChainState(
            pose=state["base_poses"][:, i],
            velocity=state["base_velocities"][:, i],
            joints=state["joint_positions"][:, joints],
            rates=state["joint_velocities"][:, joints],
        )

    def _predict_bodies(
        self,
        state: Fields,
        control: Fields,
        parameters: Fields,
        gravity: Tensor,
        contact: Tensor | None,
    ) -> BodyPrediction | None:
        free = self._free
        if not len(free):
            return None
        poses, velocities = state["body_poses"][:, free], state["body_velocities"][:, free]
        wrenches = control["body_wrenches"][:, free]
        inertia = self._body_inertia(parameters)
        if contact is not None:
            turned = torch.nn.functional.normalize(poses[..., 3:], dim=-1)
            wrenches = wrenches + self._wrenches(turned, inertia.center, contact)
        prediction = predict_bodies(
            poses, velocities, inertia, wrenches, gravity, self.dt, self._free_names
        )
        if contact is not None:
            self._require_slow(prediction, contact)
        return prediction

    def _predict_chain(
        self,
        i: int,
        state: Fields,
        control: Fields,
        parameters: Fields,
        gravity: Tensor,
        contact: Tensor | None,
    ) -> ChainPrediction:
        joints, _, vertices = self._chain_rows[i]
        gains = Gains(
            stiffness=_rows(parameters, "joint_stiffness", joints),
            damping=_rows(parameters, "joint_damping", joints),
            viscosity=_rows(parameters, "joint_viscosity", joints),
        )
        return self._chains[i].predict(
            self._chain_state(i, state),
            ChainControl(
                pose=control["base_poses"][:, i],
                wrench=control["base_wrenches"][:, i],
                joints=control["joint_positions"][:, joints],
                rates=control["joint_velocities"][:, joints],
                efforts=control["joint_efforts"][:, joints],
            ),
            self._chain_inertia(i, parameters),
            gains,
            gravity,
            None if contact is None else contact[:, vertices],
        )

    def _require_slow(self, bodies: BodyPrediction, forces: Tensor) -> None:
        """Refuse bodies that turn too far while forces act on their vertices [B, V, 3]."""
        on_vertex = forces.detach()[:, self._on_free].abs().sum(-1)
        touched = torch.zeros_like(bodies.speed).index_add(1, self._body_of_vertex, on_vertex) > 0
        lost = touched & (self.dt * bodies.speed > MOST_TURN_IN_CONTACT)
        if lost.any():
            how = "touches something and may"
            refuse_turns(lost, bodies.speed, self.dt, MOST_TURN_IN_CONTACT, how, self._free_names)

    def _wrenches(self, quaternions: Tensor, centers: Tensor, forces: Tensor) -> Tensor:
        """Of forces on all vertices, about the centers of the dynamic bodies; [B, Kd, 6]."""
        body, own = self._body_of_vertex, forces[:, self._on_free]
        arms = (self._body_points - centers[:, body]).expand_as(own)
        arms = rotate(quaternions[:, body], arms)
        parts = torch.cat([own, torch.linalg.cross(arms, own)], dim=-1)
        return parts.new_zeros(len(parts), len(self._free), 6).index_add(1, body, parts)


def _indices(values: Iterable[int]) -> Tensor:
    return torch.tensor(list(values), dtype=torch.long)


def _rows(parameters: Fields, name: str, rows: slice, *shape: int) -> Tensor:
    """Rows of a parameter; zeros where the scene has none because nothing of it is dynamic."""
    if name in parameters:
        return parameters[name][:, rows]
    return torch.zeros(1, rows.stop - rows.start, *shape, dtype=torch.float64)


def _symmetric(matrices: Tensor) -> Tensor:
    return (matrices + matrices.transpose(-1, -2)) / 2
