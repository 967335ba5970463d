"""The state of a simulation: tensors that a step takes and returns, alone or in a batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch._moved import allow_loading
from diffcloth_torch.checks import is_dense
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.meshes import MeshPart, write_mesh
from diffcloth_torch.geometry.poses import transform
from diffcloth_torch.model.kinematics import link_frames, pose_frame
from diffcloth_torch.model.mechanism import Mechanism
from diffcloth_torch.model.quantities import STATE, shape_of
from diffcloth_torch.model.robot import Robot
from diffcloth_torch.model.scene import Assembly, Scene
from diffcloth_torch.reprs import field_text, record_text
from diffcloth_torch.sim.report import Report, outcome_text

__all__ = ["State", "Surfaces", "check_field_names", "stack", "where"]

_BATCHED_DIMENSIONS = 3  # positions [B, N, 3]


@dataclass(frozen=True, eq=False)
class LinkSurfaces:
    """The meshes of a robot's links, and what places them.

    Attributes:
        mechanism: Fields of the robot's `Mechanism`, arrays as tensors.
        vertices: Vertices of each link in its frame [m], shape [v, 3]; None without a surface.
        faces: Vertex indices of each link in its own vertices, shape [g, 3], or None.
    """

    mechanism: dict[str, Any]
    vertices: list[Tensor | None]
    faces: list[Tensor | None]

    @staticmethod
    def of(name: str, robot: Robot) -> LinkSurfaces:
        """Take them from a robot with a name in its scene."""
        plain = {
            field: torch.from_numpy(np.array(value)) if isinstance(value, np.ndarray) else value
            for field, value in vars(replace(robot.mechanism, name=name)).items()
        }
        meshes = robot.surfaces
        return LinkSurfaces(
            mechanism=plain,
            vertices=[
                None if m is None else torch.from_numpy(np.array(m.vertices)) for m in meshes
            ],
            faces=[None if m is None else torch.from_numpy(np.array(m.faces)) for m in meshes],
        )

    @property
    def joint_count(self) -> int:
        """Number of joints, J."""
        return len(self.mechanism["joint_names"])

    def parts(self, base_pose: Tensor, joint_positions: Tensor) -> list[MeshPart]:
        """Place the meshes by a pose [7] of the root link and joint positions [J]."""
        fields: dict[str, Any] = {
            field: value.numpy() if isinstance(value, Tensor) else value
            for field, value in self.mechanism.items()
        }
        mechanism = Mechanism(**fields)
        frames = link_frames(mechanism, pose_frame(base_pose), joint_positions)
        links = zip(mechanism.link_names, self.vertices, self.faces, frames, strict=True)
        return [
            (f"{mechanism.name}/{link}", (v @ frame[:3, :3].mT + frame[:3, 3]).numpy(), f.numpy())
            for link, v, f, frame in links
            if v is not None and f is not None
        ]


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The meshes that a state moves, as plain tensors, so that a saved state can be exported.

    Attributes:
        cloth_names: Name of each cloth.
        cloth_faces: Vertex indices of each cloth in `positions`, shape [f, 3].
        body_names: Name of each body.
        body_vertices: Vertices of each body in its frame [m], shape [v, 3].
        body_faces: Vertex indices of each body in its own vertices, shape [g, 3].
        robots: The surfaces of each robot.
    """

    cloth_names: list[str]
    cloth_faces: list[Tensor]
    body_names: list[str]
    body_vertices: list[Tensor]
    body_faces: list[Tensor]
    robots: tuple[LinkSurfaces, ...] = ()

    @staticmethod
    def of(scene: Scene, assembly: Assembly) -> Surfaces:
        """Take them from a scene."""
        starts = zip(scene.cloths, assembly.cloth_vertex_start.tolist(), strict=False)
        return Surfaces(
            cloth_names=list(scene.cloth_names),
            cloth_faces=[torch.from_numpy(cloth.faces + start) for cloth, start in starts],
            body_names=list(scene.body_names),
            body_vertices=[torch.from_numpy(np.array(body.vertices)) for body in scene.bodies],
            body_faces=[torch.from_numpy(np.array(body.faces)) for body in scene.bodies],
            robots=tuple(
                LinkSurfaces.of(name, robot)
                for name, robot in zip(scene.robot_names, scene.robots, strict=True)
            ),
        )


@dataclass(frozen=True, eq=False)
class State:
    """Positions and velocities at one time. Every tensor may have a leading batch axis.

    Attributes:
        positions: Cloth vertices [m], shape [N, 3].
        velocities: Cloth vertices [m/s], shape [N, 3].
        body_poses: [px, py, pz, qw, qx, qy, qz] of each body, shape [K, 7].
        soft_pin_targets: Where the soft pins pull [m], shape [Q, 3].
        body_forces: Contact forces on the body vertices during the step that led here [N],
            shape [V, 3].
        time: Time since the initial state [s], shape [].
        report: How the step that led here went; None in an initial state.
        body_velocities: Velocity of each body's center of mass, then its angular velocity, in world
            axes [m/s, rad/s], shape [K, 6]; zero where the body is static, and ignored by a step
            where it is not dynamic.
        joint_positions: Values of the joints [rad or m], shape [J].
        joint_velocities: Their rates [rad/s or m/s], shape [J].
        joint_targets: What pd drives pull to until a control says otherwise [rad or m], shape [J].
        joint_efforts: What the drive applied during the step that led here, or where the joint is
            prescribed what a motor there had to give: for inertia, weights and contact, without
            the joint's viscosity and the armature of its drive [N m or N], shape [J].
        base_poses: Frame of each robot's root link, as in `body_poses`, shape [R, 7].
        base_velocities: Velocity of its center of mass, then its angular velocity, in world axes
            [m/s, rad/s], shape [R, 6].
    """

    positions: Tensor
    velocities: Tensor
    body_poses: Tensor
    soft_pin_targets: Tensor
    body_forces: Tensor
    time: Tensor
    report: Report | None = None
    # Never None: what is left out becomes rows of zeros.
    body_velocities: Tensor = None  # type: ignore[assignment]
    joint_positions: Tensor = None  # type: ignore[assignment]
    joint_velocities: Tensor = None  # type: ignore[assignment]
    joint_targets: Tensor = None  # type: ignore[assignment]
    joint_efforts: Tensor = None  # type: ignore[assignment]
    base_poses: Tensor = None  # type: ignore[assignment]
    base_velocities: Tensor = None  # type: ignore[assignment]
    _surfaces: Surfaces | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        missing = [name for name in _ADDED if getattr(self, name) is None]
        if missing:
            shape: tuple[int, ...] = getattr(self.body_poses, "shape", ())
            environments, bodies = shape[:-2], shape[-2] if len(shape) > 1 else 0
            for name in missing:
                rows = shape_of(STATE[name].axes[0], {"K": bodies, "J": 0, "R": 0})
                zeros = torch.zeros(*environments, *rows, dtype=torch.float64)
                object.__setattr__(self, name, zeros)

    def __setstate__(self, state: dict[str, Any]) -> None:
        # States that the first version saved have no robots, and bodies without velocities.
        self.__dict__.update(state)
        self.__post_init__()

    def __repr__(self) -> str:
        # What a scene lacks has no rows, and is left out.
        tensors = {name: getattr(self, name) for name in ("time", *_TENSORS)}
        there = {n: t for n, t in tensors.items() if not isinstance(t, Tensor) or t.numel()}
        parts = [field_text(name, value) for name, value in there.items()]
        parts.append(f"report={outcome_text(self.report)}")
        if self.batch_size is not None:
            parts.insert(0, f"batch_size={self.batch_size}")
        return record_text("State", parts)

    @property
    def batch_size(self) -> int | None:
        """Number of environments, None without a batch axis."""
        batched = self.positions.dim() == _BATCHED_DIMENSIONS
        return self.positions.shape[0] if batched else None

    def replace(self, **changes: Any) -> State:
        """Copy with some fields replaced; the other tensors are shared."""
        check_field_names("State.replace", self, changes)
        return replace(self, **changes)

    def detach(self) -> State:
        """Copy whose tensors carry no graph."""
        return self._map(lambda tensor: tensor.detach(), self.report)

    def __getitem__(self, index: int | slice) -> State:
        """Take one environment of a batch, without the batch axis, or a slice of the batch."""
        _check_state("state[i]", self)
        size = self._require_batch("state[i]")
        if not isinstance(index, slice):
            if isinstance(index, bool) or not isinstance(index, int | np.integer):
                raise TypeError(f"state[i]: `i` must be an integer, got {type(index).__name__}")
            if not -size <= index < size:
                raise InvalidInput(f"state[i]: `i` must be in 0 .. {size - 1}, got {index}")
            index = int(index)
        report = None if self.report is None else self.report.select(index)
        return self._map(lambda tensor: tensor[index], report)

    def __len__(self) -> int:
        """Number of environments."""
        return self._require_batch("len(state)")

    def __iter__(self) -> Iterator[State]:
        """Go through the environments."""
        return (self[i] for i in range(len(self)))

    def __bool__(self) -> bool:
        """Be true: `len` counts environments."""
        return True

    def export(self, path: str | Path, *, bodies: bool = False) -> None:
        """Write the cloths as a mesh, with the vertices in the order of `positions`.

        Args:
            path: File that ends in .obj (one object per surface) or .ply (all in one).
            bodies: Whether the bodies and the links of robots, at their poses, follow the cloths.

        Raises:
            InvalidInput: If the state is a batch, was not made by a simulator, or the file ending
                is another.
        """
        _check_state("export: the state", self)
        if self.batch_size is not None:
            raise InvalidInput("export: the state must be a single one; use state[i].export(...)")
        if self._surfaces is None:
            raise InvalidInput(
                "export: the state must come from a Simulator, which knows its faces"
            )
        write_mesh(path, self._parts(self._surfaces, bodies))

    def _parts(self, surfaces: Surfaces, bodies: bool) -> list[MeshPart]:
        positions = self.positions.detach().numpy()
        parts: list[MeshPart] = []
        start = 0
        for name, faces in zip(surfaces.cloth_names, surfaces.cloth_faces, strict=True):
            end = int(faces.max()) + 1  # every cloth vertex belongs to a face
            parts.append((name, positions[start:end], faces.numpy() - start))
            start = end
        if bodies:
            poses = self.body_poses.detach().numpy()
            for k, name in enumerate(surfaces.body_names):
                vertices = transform(surfaces.body_vertices[k].numpy(), poses[k])
                parts.append((name, vertices, surfaces.body_faces[k].numpy()))
            first = 0
            for r, robot in enumerate(surfaces.robots):
                rows = slice(first, first := first + robot.joint_count)
                joints = self.joint_positions.detach()[rows]
                parts += robot.parts(self.base_poses.detach()[r], joints)
        return parts

    def _require_batch(self, what: str) -> int:
        if self.batch_size is None:
            raise InvalidInput(f"{what}: the state must have a batch axis")
        return self.batch_size

    def _map(self, function: Callable[[Tensor], Tensor], report: Report | None) -> State:
        tensors = {name: function(getattr(self, name)) for name in _TENSORS}
        return State(**tensors, report=report, _surfaces=self._surfaces)


_TENSORS = tuple(STATE)
# Fields that states of the first version lack.
_ADDED = _TENSORS[_TENSORS.index("body_velocities") :]


def stack(states: Sequence[State]) -> State:
    """Make a batch of states without a batch axis; gradients flow to each of them.

    Raises:
        InvalidInput: If there is none, one is a batch already, or their shapes differ.
        TypeError: If one is no State, or holds what a state does not.
    """
    given: Any = states
    if not isinstance(given, Sequence):
        kind = type(given).__name__
        raise TypeError(f"stack: `states` must be a sequence of states, got {kind}")
    if len(states) == 0:
        raise InvalidInput("stack: `states` must hold at least one state")
    for i, state in enumerate(states):
        _check_state(f"stack: `states[{i}]`", state)
        if state.batch_size is not None:
            raise InvalidInput(f"stack: `states` must have no batch axis, got one at [{i}]")
    tensors = {}
    for name in _TENSORS:
        parts = [getattr(state, name) for state in states]
        for i, part in enumerate(parts):
            if part.shape != parts[0].shape:
                raise InvalidInput(
                    f"stack: `{name}` must have the same shape in all states, "
                    f"got {list(parts[0].shape)} at [0] and {list(part.shape)} at [{i}]"
                )
        tensors[name] = torch.stack(parts)
    report = Report.stack([state.report for state in states])
    return State(**tensors, report=report, _surfaces=states[0]._surfaces)


def where(mask: Tensor, a: State, b: State) -> State:
    """Take environment `i` from `a` where `mask[i]` is true, from `b` elsewhere.

    Args:
        mask: Booleans, shape [B].
        a: A batch, or one state for all environments.
        b: A batch, or one state for all environments.

    Raises:
        InvalidInput: If the batch sizes or other shapes differ.
        TypeError: If `mask` is not a boolean tensor, or `a` or `b` is no State.
    """
    _check_mask(mask)
    for name, state in (("a", a), ("b", b)):
        _check_state(f"where: `{name}`", state)
        if state.batch_size not in (None, len(mask)):
            raise InvalidInput(
                f"where: `{name}` must have {len(mask)} environments, as `mask`, "
                f"got {state.batch_size}"
            )
    tensors = {}
    for name in _TENSORS:
        x, y = getattr(a, name), getattr(b, name)
        shapes = [list(z.shape[state.batch_size is not None :]) for z, state in ((x, a), (y, b))]
        if shapes[0] != shapes[1]:
            raise InvalidInput(
                f"where: `{name}` must have the same shape in both states, got {shapes[0]} in `a` "
                f"and {shapes[1]} in `b`"
            )
        tensors[name] = torch.where(mask.reshape(-1, *[1] * len(shapes[0])), x, y)
    report = Report.where(mask, a.report, b.report)
    return State(**tensors, report=report, _surfaces=a._surfaces)


def _check_state(name: str, state: Any) -> None:
    """Require a state whose fields are what they are said to be: it may come from a file."""
    if not isinstance(state, State):
        raise TypeError(f"{name} must be a State, got {type(state).__name__}")
    for entry in _TENSORS:
        value = getattr(state, entry)
        if not isinstance(value, Tensor) or not is_dense(value):
            kind = "another layout" if isinstance(value, Tensor) else type(value).__name__
            raise TypeError(f"{name}: `{entry}` must be a dense torch tensor, got {kind}")
    batch = state.batch_size
    for entry in _TENSORS:
        shape = getattr(state, entry).shape
        if batch is not None and shape[:1] != (batch,):
            raise InvalidInput(
                f"{name}: `{entry}` must have {batch} environments, as `positions`, "
                f"got {list(shape)}"
            )
    report: Any = state.report
    if report is not None:
        if not isinstance(report, Report):
            kind = type(report).__name__
            raise TypeError(f"{name}: `report` must be a Report or None, got {kind}")
        report.check_environments(name, batch)


def _check_mask(mask: object) -> None:
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
        raise TypeError("where: `mask` must be a boolean tensor")
    if mask.dim() != 1:
        raise InvalidInput(f"where: `mask` must have shape [B], got {list(mask.shape)}")


def check_field_names(owner: str, instance: Any, changes: dict[str, Any]) -> None:
    """Require that changes name public fields of a dataclass."""
    accepted = [f.name for f in fields(instance) if not f.name.startswith("_")]
    for name in changes:
        if name not in accepted:
            raise InvalidInput(f"{owner}: the fields are {', '.join(accepted)}; got {name!r}")


allow_loading(State, Surfaces, LinkSurfaces)
