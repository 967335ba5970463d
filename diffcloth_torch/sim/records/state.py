"""The state of a simulation: the tensors that a step takes and returns, with or without batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.autograd.torch_private import register_collate
from diffcloth_torch.autograd.transforms import is_dense
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.meshes import write_mesh
from diffcloth_torch.model.quantities import STATE
from diffcloth_torch.reprs import field_text, record_text
from diffcloth_torch.saved import saved
from diffcloth_torch.sim.records.environments import Choice, Combination, Selection, Stack
from diffcloth_torch.sim.records.report import Report, combine_reports, outcome_text
from diffcloth_torch.sim.records.surfaces import Surfaces
from diffcloth_torch.sim.records.trees import register_record

__all__ = [
    "State",
    "check_field_names",
    "check_shapes",
    "check_state",
    "stack",
    "where",
]

_BATCHED_DIMENSIONS = 3  # positions [B, N, 3]


@saved
@dataclass(frozen=True, eq=False)
class State:
    """Positions, velocities and forces at one time. All tensors may share a leading batch axis.

    Attributes:
        positions: Positions of the cloth vertices, then of the vertices of deforming bodies [m],
            shape [N, 3].
        velocities: Velocities of these vertices [m/s], shape [N, 3].
        body_poses: [px, py, pz, qw, qx, qy, qz] of each body, shape [K, 7].
        soft_pin_targets: Targets of the soft pins [m], shape [Q, 3].
        body_forces: Forces of contact and attachments on the body vertices during the step that led
            here [N], shape [V, 3]. Smooth bodies have four points that move with them instead of
            vertices.
        time: Time since the initial state [s], shape [].
        report: Report of the step that led here; None in an initial state.
        body_velocities: Velocity of each body's center of mass, then its angular velocity, in world
            axes [m/s, rad/s], shape [K, 6]; zero if the body is static; a step ignores it unless
            the body is dynamic.
        joint_positions: Positions of the joints [rad or m], shape [J].
        joint_velocities: Velocities of the joints [rad/s or m/s], shape [J].
        joint_targets: Position targets of pd drives, which hold until a control changes them
            [rad or m], shape [J].
        joint_efforts: Efforts of the drives during the step that led here [N m or N], within their
            limits and without the friction of the joints, shape [J]. For a prescribed joint, the
            effort that its motion required against inertia, weights and contact, without the
            joint's viscosity and the armature of its drive.
        base_poses: Frame of each robot's root link, as in `body_poses`, shape [R, 7].
        base_velocities: Velocity of the root link's center of mass, then its angular velocity, in
            world axes [m/s, rad/s], shape [R, 6].
        contact_forces: Contact forces on the cloth vertices during the step that led here, barrier
            and friction [N], shape [N, 3].
        pin_forces: Forces that held the pinned vertices during that step [N], shape [P, 3].

    A state is a pytree of torch with these tensors as leaves: `tree_map`, `torch.func` and
    `torch.vmap` accept it. `torch.utils.data.default_collate` stacks states without a batch axis.
    Both drop the report, which describes a step that did not lead to the new state.
    """

    positions: Tensor
    velocities: Tensor
    body_poses: Tensor
    soft_pin_targets: Tensor
    body_forces: Tensor
    time: Tensor
    report: Report | None = None
    # Never None: a field that is left out becomes rows of zeros.
    body_velocities: Tensor = None  # type: ignore[assignment]
    joint_positions: Tensor = None  # type: ignore[assignment]
    joint_velocities: Tensor = None  # type: ignore[assignment]
    joint_targets: Tensor = None  # type: ignore[assignment]
    joint_efforts: Tensor = None  # type: ignore[assignment]
    base_poses: Tensor = None  # type: ignore[assignment]
    base_velocities: Tensor = None  # type: ignore[assignment]
    contact_forces: Tensor = None  # type: ignore[assignment]
    pin_forces: Tensor = None  # type: ignore[assignment]
    _surfaces: Surfaces | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        missing = [name for name in _ADDED if getattr(self, name) is None]
        if missing:
            shape: tuple[int, ...] = getattr(self.body_poses, "shape", ())
            environments = shape[:-2]
            sizes = {"K": _row_count(self.body_poses), "N": _row_count(self.positions)}
            for name in missing:
                letter, *rest = STATE[name].axes[0]
                zeros = cpu.zeros(*environments, sizes.get(str(letter), 0), *rest)
                object.__setattr__(self, name, zeros)

    def __repr__(self) -> str:
        # Tensors without rows, for entities that the scene lacks, are left out.
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
        """Return a copy with some fields replaced; the other tensors are shared."""
        check_field_names("State.replace", self, changes)
        return replace(self, **changes)

    def detach(self) -> State:
        """Return a copy whose tensors carry no graph."""
        return self._map(lambda tensor: tensor.detach(), self.report)

    def clone(self) -> State:
        """Return a copy that shares no memory; gradients flow to the original."""
        return self._map(lambda tensor: tensor.clone(), self.report)

    def to(
        self,
        *targets: Any,
        device: Any = None,
        dtype: torch.dtype | None = None,
        non_blocking: bool = False,
        copy: bool = False,
    ) -> State:
        """Return the state unchanged, for code that moves batches: it stays in float64 on the CPU.

        Args:
            *targets: Devices, dtypes or tensors, as for `torch.Tensor.to`.
            device: A device.
            dtype: A dtype.
            non_blocking: Ignored: nothing is moved.
            copy: If true, copy the tensors.

        Raises:
            InvalidInput: If a device is not the CPU.
            TypeError: If a dtype is not float64, or a target is no device, dtype or tensor.
        """
        for target in (*targets, device, dtype):
            _require_float64_on_cpu(target)
        return self.clone() if copy else self

    def meshes(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Place all surfaces in the world: cloths, bodies, and links that have collision shapes.

        Returns:
            For each surface, in the order of `Simulator.surfaces`, its name -> its vertices in the
            world [m], shape [v, 3], or [B, v, 3] in a batch, differentiable in the state, and its
            faces, shape [f, 3].

        Raises:
            InvalidInput: If the state was not made by a simulator.
        """
        check_state("meshes: the state", self)
        return self._known_surfaces("meshes").meshes(vars(self))

    def _known_surfaces(self, owner: str) -> Surfaces:
        if self._surfaces is None:
            raise InvalidInput(
                f"{owner}: the state must come from a Simulator, which knows its faces"
            )
        return self._surfaces

    @property
    def nbytes(self) -> int:
        """Memory of the tensors [bytes], without the report."""
        return sum(t.nbytes for t in vars(self).values() if isinstance(t, Tensor))

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor) -> State:
        """Select one environment of a batch, without the batch axis, or several as a batch.

        Args:
            index: An integer; or, for several, a slice, a list or tensor of integers, or a mask of
                shape [B].

        Raises:
            InvalidInput: If the state has no batch axis, an integer is out of range, or a mask has
                another length.
            TypeError: If `index` is anything else.
        """
        check_state("state[i]", self)
        chosen = _environments(index, self._require_batch("state[i]"))
        return _combined(Selection(chosen, len(self)), [self])

    def __len__(self) -> int:
        """Number of environments."""
        return self._require_batch("len(state)")

    def __iter__(self) -> Iterator[State]:
        """Iterate over the environments."""
        return (self[i] for i in range(len(self)))

    def __bool__(self) -> bool:
        """Return True: `len` counts environments."""
        return True

    def export(self, path: str | Path, *, bodies: bool = False) -> None:
        """Write cloths and deforming bodies as a mesh, its vertices in the order of `positions`.

        Args:
            path: File ending in .obj (one object per surface) or .ply (all surfaces in one mesh).
            bodies: If true, also write the bodies and links, at their poses, after the cloths.

        Raises:
            InvalidInput: If the state is a batch, was not made by a simulator, or `path` has
                another ending.
        """
        check_state("export: the state", self)
        if self.batch_size is not None:
            raise InvalidInput("export: the state must be a single one; use state[i].export(...)")
        plain, surfaces = vars(self.detach()), self._known_surfaces("export")
        meshes = surfaces.meshes(plain) if bodies else surfaces.cloth_meshes(plain["positions"])
        write_mesh(path, [(n, v.numpy(), f.numpy()) for n, (v, f) in meshes.items()])

    def _require_batch(self, what: str) -> int:
        if self.batch_size is None:
            raise InvalidInput(f"{what}: the state must have a batch axis")
        return self.batch_size

    def _map(self, function: Callable[[Tensor], Tensor], report: Report | None) -> State:
        tensors = {name: function(getattr(self, name)) for name in _TENSORS}
        return State(**tensors, report=report, _surfaces=self._surfaces)


_TENSORS = tuple(STATE)
# Fields that a caller may leave out.
_ADDED = _TENSORS[_TENSORS.index("body_velocities") :]


def _require_float64_on_cpu(target: Any) -> None:
    """Refuse a target of `State.to` that would change a state."""
    where: Any = None if isinstance(target, torch.dtype) else target
    dtype = target if isinstance(target, torch.dtype) else None
    if isinstance(target, Tensor):
        where, dtype = target.device, target.dtype
    if isinstance(where, int) and not isinstance(where, bool):
        where = f"index {where}"
    elif isinstance(where, str):
        where = where.partition(":")[0]
    elif isinstance(where, torch.device):
        where = where.type
    elif where is not None:
        raise TypeError(
            f"State.to: a target must be a device, a dtype or a tensor, got {type(where).__name__}"
        )
    if where not in (None, "cpu"):
        raise InvalidInput(
            f"State.to: the device must be the CPU, where the simulator works, got {where}; move "
            "single tensors instead, as state.positions.to(device)"
        )
    if dtype not in (None, torch.float64):
        raise TypeError(
            f"State.to: the dtype must be torch.float64, as positions in lower precision cannot "
            f"keep surfaces apart, got {dtype}; convert single tensors instead, as "
            "state.positions.to(dtype)"
        )


def _branches(state: State) -> tuple[dict[str, Any], Surfaces | None]:
    return {name: getattr(state, name) for name in _TENSORS}, state._surfaces


def _restored(fields: dict[str, Any], surfaces: Surfaces | None) -> State:
    state = object.__new__(State)  # leaves may be of any type, None included
    state.__dict__.update(fields, report=None, _surfaces=surfaces)
    return state


register_record(State, _branches, _restored)


def stack(states: Sequence[State]) -> State:
    """Combine states without a batch axis into a batch; gradients flow to each of them.

    Raises:
        InvalidInput: If `states` is empty, one of them is already a batch, or their shapes differ.
        TypeError: If an item is not a State, or has a field of a wrong type.
    """
    given: Any = states
    if not isinstance(given, Sequence):
        kind = type(given).__name__
        raise TypeError(f"stack: `states` must be a sequence of states, got {kind}")
    if len(states) == 0:
        raise InvalidInput("stack: `states` must hold at least one state")
    for i, state in enumerate(states):
        check_state(f"stack: `states[{i}]`", state)
        if state.batch_size is not None:
            raise InvalidInput(f"stack: `states` must have no batch axis, got one at [{i}]")
    check_shapes("stack", "all states", [(f"at [{i}]", state) for i, state in enumerate(states)])
    return _combined(Stack(len(states)), states)


register_collate(State, lambda states: stack([s.replace(report=None) for s in states]))


def where(mask: Tensor, a: State, b: State) -> State:
    """Take environment `i` from `a` if `mask[i]` is true, else from `b`.

    Args:
        mask: Booleans, shape [B].
        a: A batch, or one state for all environments.
        b: A batch, or one state for all environments.

    Raises:
        InvalidInput: If the batch sizes or other shapes differ.
        TypeError: If `mask` is not a boolean tensor, or `a` or `b` is not a State.
    """
    _check_mask(mask)
    for name, state in (("a", a), ("b", b)):
        check_state(f"where: `{name}`", state)
        if state.batch_size not in (None, len(mask)):
            raise InvalidInput(
                f"where: `{name}` must have {len(mask)} environments, as `mask`, "
                f"got {state.batch_size}"
            )
    check_shapes("where", "both states", [("in `a`", a), ("in `b`", b)])
    return _combined(Choice(mask, [state.batch_size is not None for state in (a, b)]), [a, b])


def _combined(how: Combination, states: Sequence[State]) -> State:
    tensors = {n: how.tensors([getattr(state, n) for state in states]) for n in _TENSORS}
    report = combine_reports(how, [state.report for state in states])
    return State(**tensors, report=report, _surfaces=states[0]._surfaces)


def check_shapes(owner: str, which: str, states: Sequence[tuple[str, State]]) -> None:
    """Require equal shapes of fields, except for the axis of environments."""
    for name in _TENSORS:
        shapes = [
            list(getattr(state, name).shape[state.batch_size is not None :]) for _, state in states
        ]
        for (place, _), shape in zip(states, shapes, strict=True):
            if shape != shapes[0]:
                raise InvalidInput(
                    f"{owner}: `{name}` must have the same shape in {which}, got {shapes[0]} "
                    f"{states[0][0]} and {shape} {place}"
                )


def check_state(name: str, state: Any) -> None:
    """Require a State with fields of the right types and batch size, as it may come from a file."""
    if not isinstance(state, State):
        raise TypeError(f"{name} must be a State, got {type(state).__name__}")
    for entry in _TENSORS:
        value = getattr(state, entry)
        if not isinstance(value, Tensor) or not is_dense(value):
            kind = "another layout" if isinstance(value, Tensor) else type(value).__name__
            raise TypeError(f"{name}: `{entry}` must be a dense torch tensor, got {kind}")
        if not value.is_cpu or not value.is_floating_point():
            raise TypeError(
                f"{name}: `{entry}` must be a tensor of real numbers on the CPU, got "
                f"{value.dtype} on {value.device}"
            )
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


def _environments(index: Any, size: int) -> int | slice | Tensor:
    """Check an index into a batch of `size` environments; lists and arrays become tensors."""
    if isinstance(index, slice):
        return index
    if isinstance(index, int | np.integer) and not isinstance(index, bool):
        if not -size <= index < size:
            raise InvalidInput(f"state[i]: `i` must be in 0 .. {size - 1}, got {index}")
        return int(index)
    if not isinstance(index, Sequence | np.ndarray | Tensor) or isinstance(index, str | tuple):
        raise TypeError(
            "state[i]: `i` must be an integer, a slice, a list or a tensor, got "
            f"{type(index).__name__}"
        )
    try:
        is_empty = isinstance(index, Sequence) and not len(index)
        rows = cpu.zeros(0, dtype=torch.int64) if is_empty else cpu.as_tensor(index)
    except (TypeError, ValueError) as error:
        raise TypeError(f"state[i]: `i` must be integers or a mask, got {index!r}") from error
    if rows.is_floating_point() or rows.is_complex() or rows.ndim != 1 or not rows.is_cpu:
        raise TypeError(
            "state[i]: `i` must be integers or a mask, of one axis, on the CPU, got "
            f"{rows.dtype} of shape {list(rows.shape)} on {rows.device}"
        )
    if rows.dtype == torch.bool:
        if len(rows) != size:
            raise InvalidInput(f"state[i]: a mask must have shape [{size}], got [{len(rows)}]")
        return rows.nonzero()[:, 0]
    wrong = (rows < -size) | (rows >= size)
    if wrong.any():
        at = int(wrong.nonzero()[0])
        raise InvalidInput(
            f"state[i]: `i` must be in 0 .. {size - 1}, got {int(rows[at])} at [{at}]"
        )
    return rows.to(torch.int64)


def _row_count(tensor: Any) -> int:
    """Number of rows of a tensor [.., rows, k]; 0 for anything else."""
    shape: tuple[int, ...] = getattr(tensor, "shape", ())
    return shape[-2] if len(shape) > 1 else 0


def _check_mask(mask: object) -> None:
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool or not mask.is_cpu:
        raise TypeError("where: `mask` must be a boolean tensor on the CPU")
    if mask.dim() != 1:
        raise InvalidInput(f"where: `mask` must have shape [B], got {list(mask.shape)}")


def check_field_names(owner: str, instance: Any, changes: dict[str, Any]) -> None:
    """Require that changes name public fields of a dataclass."""
    accepted = [f.name for f in fields(instance) if not f.name.startswith("_")]
    for name in changes:
        if name not in accepted:
            raise InvalidInput(f"{owner}: the fields are {', '.join(accepted)}; got {name!r}")
