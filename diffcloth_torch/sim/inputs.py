"""From a state, a control and parameters to fields that are checked and complete.

Every tensor gets a leading axis of environments here: as many as the state has (one without a
batch axis), or one where a value is shared by all. Everything is ordinary differentiable torch, so
that gradients find their way back to what the caller passed, in its own dtype.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch.checks import (
    LARGEST,
    FloatArray,
    check_finite,
    check_range,
    check_shape,
    float_tensor,
    is_dense,
    texts,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.poses import SHORTEST_QUATERNION, check_quaternions
from diffcloth_torch.geometry.surfaces import check_areas
from diffcloth_torch.model.quantities import CONTROL, PARAMETERS, STATE, Shape
from diffcloth_torch.sim.controls import Control, Parameters
from diffcloth_torch.sim.layout import Layout
from diffcloth_torch.sim.state import State
from diffcloth_torch.sim.step import Constant, are_within, have_quaternions, refuse_transforms

__all__ = [
    "Fields",
    "check_control",
    "check_parameters",
    "constants",
    "control_fields",
    "core_inputs",
    "default_fields",
    "parameter_fields",
    "state_fields",
]

Fields = dict[str, Tensor]
"""Values by name, with a leading axis of environments."""

_CORE_NAMES = tuple(
    tuple((name, quantity.core) for name, quantity in table.items() if quantity.core is not None)
    for table in (STATE, CONTROL, PARAMETERS)
)
_PINS = ("pins", "soft_pins")
_POSES = ("body_poses", "base_poses")
# Field of a control -> field of the state that holds where it is not set.
_HELD = {"soft_pins": "soft_pin_targets", "body_poses": "body_poses", "base_poses": "base_poses"}


def core_inputs(state: Fields, control: Fields, parameters: Fields) -> Fields:
    """Fields under the names that the core has for them."""
    return {
        core: fields[name]
        for names, fields in zip(_CORE_NAMES, (state, control, parameters), strict=True)
        for name, core in names
        if name in fields
    }


def constants(layout: Layout, defaults: Fields) -> dict[str, Constant]:
    """What `core_inputs` has where neither a control nor parameters say otherwise."""
    fields = core_inputs({}, layout.zeros, defaults)
    return {name: Constant.of(tensor) for name, tensor in fields.items()}


def state_fields(layout: Layout, state: State) -> tuple[Fields, int | None]:
    """Check a state; returns its tensors and its batch size, None without a batch axis."""
    if not isinstance(state, State):
        raise TypeError(f"step: `state` must be a State, got {type(state).__name__}")
    refuse_transforms("step")
    tensors = {name: getattr(state, name) for name in layout.state_shapes}
    for name, tensor in tensors.items():
        _check_state_tensor(name, tensor)
    batch = state.batch_size
    environments = () if batch is None else (batch,)
    fit = all(t.shape == (*environments, *layout.state_shapes[n]) for n, t in tensors.items())
    numbers = {name: _numbers(tensor) for name, tensor in tensors.items() if tensor.numel()}
    if not fit or not are_within(list(numbers.values()), LARGEST):
        _refuse_state(layout, tensors, environments)
    if batch == 0:
        raise InvalidInput("step: `state` must hold at least one environment, got a batch of 0")
    for name in _POSES:
        if name in numbers:
            _check_quaternions(f"step: `state.{name}`", numbers[name])
    if layout.joint_names:
        _check_zones(layout, numbers["joint_positions"])
    used = {name: tensors[name] for name in layout.state_fields}
    return {n: t.unsqueeze(0) for n, t in used.items()} if batch is None else used, batch


def _refuse_state(layout: Layout, tensors: Fields, environments: Shape) -> None:
    """Say which is the first tensor whose shape or values are not accepted."""
    for name, shape in layout.state_shapes.items():
        label = f"step: `state.{name}`"
        of_any_batch: list[tuple[int | str, ...]] = [shape, ("B", *shape)]
        accepted = of_any_batch if name == "positions" else [(*environments, *shape)]
        check_shape(label, tensors[name].shape, accepted)
        check_finite(label, _numbers(tensors[name]))


def _check_zones(layout: Layout, positions: FloatArray) -> None:
    """Refuse joints that forces move where the barriers at their limits have no value."""
    lower, upper = layout.farthest
    beyond = (positions <= lower) | (positions >= upper)
    if beyond.any():
        at = tuple(int(i) for i in np.argwhere(beyond)[0])
        joint = at[-1]
        raise InvalidInput(
            "step: `state.joint_positions` must be at most 1 % of the range beyond a limit where "
            f"forces move a joint: between {lower[joint]:g} and {upper[joint]:g} (exclusive) for "
            f"{layout.joint_names[joint]!r}, got {positions[at]:g} at [{joint}]"
        )


def _check_state_tensor(name: str, tensor: object) -> None:
    remedy = (
        "positions in lower precision cannot keep surfaces apart; make the state with "
        "initial_state() and replace its tensors by float64 ones on the CPU, .to('cpu', "
        "torch.float64)"
    )
    if not isinstance(tensor, Tensor):
        raise TypeError(
            f"step: `state.{name}` must be a torch tensor, got {type(tensor).__name__}; {remedy}"
        )
    if tensor.dtype != torch.float64 or not tensor.is_cpu or not is_dense(tensor):
        layout = "nested" if tensor.is_nested else tensor.layout
        raise TypeError(
            f"step: `state.{name}` must be a dense float64 tensor on the CPU, "
            f"got {tensor.dtype} on {tensor.device}, {layout}; {remedy}"
        )


def check_control(layout: Layout, control: Control) -> Control:
    """Promote a control to tensors and check everything that does not depend on a state."""
    return Control(**_targets(layout, control))  # type: ignore[arg-type]


def _targets(layout: Layout, control: Control) -> dict[str, Tensor | dict[str, Tensor]]:
    """The checked fields of a control that it sets."""
    if not isinstance(control, Control):
        raise TypeError(f"step: `control` must be a Control, got {type(control).__name__}")
    refuse_transforms("control")
    checked: dict[str, Tensor | dict[str, Tensor]] = {}
    for field, shape in layout.control_shapes.items():
        given = getattr(control, field)
        if given is None:
            continue
        if field in layout.groups and isinstance(given, Mapping):
            checked[field] = _named_targets(layout, field, given)
        else:
            tensor = _target(field, field, given, shape)
            _check_rows(layout, field, _numbers(tensor))
            checked[field] = tensor
    return checked


def _target(field: str, label: str, value: object, shape: Shape) -> Tensor:
    name = f"control: `{label}`"
    tensor = float_tensor(name, value)
    check_shape(name, tensor.shape, [shape, ("B", *shape)])
    numbers = _numbers(tensor)
    if not are_within([numbers], LARGEST):
        check_finite(name, numbers)
    if field in _POSES:
        _check_quaternions(name, numbers)
    return tensor


def _check_quaternions(name: str, poses: FloatArray) -> None:
    # Where lengths are near the shortest, that function has the last word.
    if not have_quaternions(poses, 2 * SHORTEST_QUATERNION):
        check_quaternions(name, poses)


def _named_targets(layout: Layout, field: str, given: Mapping[str, object]) -> dict[str, Tensor]:
    """Resolve names to full ones and check each entry."""
    named: dict[str, Tensor] = {}
    for key, value in given.items():
        name = layout.full_name(field, key)
        if name in named:
            raise InvalidInput(f"control: `{field}` must name {name!r} once, got it twice")
        if value is None:
            raise InvalidInput(
                f"control: `{field}[{key!r}]` must hold numbers; leave the name out to hold it"
            )
        shape = layout.entry_shape(field, name)
        tensor = _target(field, f"{field}[{key!r}]", value, shape)
        if field not in _PINS:
            numbers = _numbers(tensor)
            row = np.expand_dims(numbers, numbers.ndim - len(shape))
            _check_rows(layout, field, row, first=layout.groups[field][name].start)
        named[name] = tensor
    return named


def _check_rows(layout: Layout, field: str, values: FloatArray, first: int = 0) -> None:
    """Refuse wrenches on what forces do not move, and joint positions beyond a limit."""
    if field in layout.unforced:
        rows = slice(first, first + values.shape[-2])
        for k, why in enumerate(layout.unforced[field][rows]):
            if why and values[..., k, :].any():
                raise InvalidInput(
                    f"control: `{field}` must be zero in the row [{first + k}]: {why}, and no "
                    "force moves it"
                )
    if field == "joint_positions":
        rows = slice(first, first + values.shape[-1])
        lower, upper = layout.lower[rows], layout.upper[rows]
        # A limit that was rounded to float32 is meant to be the limit.
        beyond = (values < np.minimum(lower, lower.astype(np.float32))) | (
            values > np.maximum(upper, upper.astype(np.float32))
        )
        beyond &= layout.settable[field][rows]
        if beyond.any():
            at = tuple(int(i) for i in np.argwhere(beyond)[0])
            joint = at[-1]
            raise InvalidInput(
                f"control: `{field}` must be between the limits {lower[joint]:g} and "
                f"{upper[joint]:g} of {layout.joint_names[first + joint]!r}, "
                f"got {values[at]:g} in the row [{first + joint}]"
            )


def control_fields(
    layout: Layout, control: Control | None, state: Fields, batch: int | None
) -> Fields:
    """Complete a control: prescribed things and pd targets hold the state's, the rest is zero."""
    given = {} if control is None else _targets(layout, control)
    return {
        field: _complete(layout, field, given.get(field), state, batch)
        for field in layout.control_fields
    }


def _unset(layout: Layout, field: str, state: Fields) -> Tensor:
    """What a field of a control is where it says nothing."""
    if field in _HELD:
        return state[_HELD[field]]
    if field == "pins" and layout.pins.numel():
        return state["positions"][:, layout.pins]
    if field == "joint_positions":
        return torch.where(layout.driven, state["joint_targets"], state["joint_positions"])
    return layout.zeros[field]


def _complete(
    layout: Layout,
    field: str,
    given: Tensor | Mapping[str, Tensor] | None,
    state: Fields,
    batch: int | None,
) -> Tensor:
    """Fill what a control leaves out of a field."""
    if given is None:
        return _unset(layout, field, state)
    if isinstance(given, Tensor):
        dimensions = len(layout.control_shapes[field])
        values = _with_batch(f"control: `{field}`", given, dimensions, batch)
        if field in layout.settable:
            sets, unset = torch.from_numpy(layout.settable[field]), _unset(layout, field, state)
            values = torch.where(sets, values, unset)
    else:
        values = _complete_by_name(layout, field, given, _unset(layout, field, state), batch)
    return _keep(layout, field, values, state[field]) if field in layout.kept else values


def _complete_by_name(
    layout: Layout, field: str, given: Mapping[str, Tensor], unset: Tensor, batch: int | None
) -> Tensor:
    if not given:
        return unset
    parts = []
    for name, rows in layout.groups[field].items():
        part = unset[:, rows]
        if name in given:
            dimensions = len(layout.entry_shape(field, name))
            values = _with_batch(f"control: `{field}[{name!r}]`", given[name], dimensions, batch)
            part = values.reshape(len(values), *part.shape[1:])
        parts.append(part)
    environments = max(len(part) for part in parts)
    return torch.cat([part.expand(environments, *part.shape[1:]) for part in parts], dim=1)


def _with_batch(name: str, tensor: Tensor, dimensions: int, batch: int | None) -> Tensor:
    """Give a tensor of checked shape its leading axis."""
    if tensor.dim() == dimensions:
        return tensor.unsqueeze(0)
    if batch is None:
        raise InvalidInput(
            f"{name} has a batch axis, {list(tensor.shape)}, but the state has none; "
            "make the state with initial_state(batch_size=...)"
        )
    if len(tensor) != batch:
        raise InvalidInput(
            f"{name} must have {batch} environments, as the state, got {list(tensor.shape)}"
        )
    return tensor


def _keep(layout: Layout, field: str, targets: Tensor, poses: Tensor) -> Tensor:
    """Refuse targets of what is not kinematic; a row rounded to float32 stands for the state's."""
    reasons = layout.kept[field]
    still = [k for k, why in enumerate(reasons) if why]
    if not still or torch.equal(targets, poses):
        return targets
    given, kept = _numbers(targets)[:, still], _numbers(poses)[:, still]
    rounded = kept.astype(np.float32).astype(np.float64)
    moved = ((given != kept) & (given != rounded)).any(axis=-1)
    if moved.any():
        row = still[int(np.argwhere(moved)[0][1])]
        remedy = 'motion="kinematic"' if field == "body_poses" else 'base="kinematic"'
        raise InvalidInput(
            f"control: `{field}` must keep the row [{row}] of the state: {reasons[row]}; "
            f"make it {remedy} to move it"
        )
    if (given == kept).all():
        return targets
    mask = torch.zeros(targets.shape[-2], 1, dtype=torch.bool)
    mask[still] = True
    return torch.where(mask, poses, targets)


def check_parameters(parameters: Parameters) -> Parameters:
    """Promote parameters to tensors; their values are checked in each step."""
    if not isinstance(parameters, Parameters):
        raise TypeError(f"step: `parameters` must be Parameters, got {type(parameters).__name__}")
    refuse_transforms("parameters")
    given = {name: getattr(parameters, name) for name in PARAMETERS}
    checked = {name: _promoted(name, value) for name, value in given.items() if value is not None}
    return Parameters(**checked, _unbatched=parameters._unbatched)  # type: ignore[arg-type]


def _promoted(name: str, value: object) -> Tensor | dict[object, Tensor]:
    """A parameter as a tensor; of pairs of surfaces that are named, one tensor each."""
    if isinstance(value, Mapping) and _is_of_pairs(name):
        return {k: float_tensor(f"parameters: `{name}[{k!r}]`", v) for k, v in value.items()}
    return float_tensor(f"parameters: `{name}`", value)


def _is_of_pairs(name: str) -> bool:
    return PARAMETERS[name].axes[-1] == ("S", "S")


def parameter_fields(
    layout: Layout,
    parameters: Parameters,
    defaults: Fields,
    batch: int | None,
) -> Fields:
    """Check parameters; a field that is None takes the default, `defaults` has all there are."""
    checked = check_parameters(parameters)
    fields = dict(defaults)
    for name, quantity in PARAMETERS.items():
        given = getattr(checked, name)
        if given is None:
            continue
        label = f"parameters: `{name}`"
        if name not in defaults:
            raise InvalidInput(f"{label} must be None: it has no meaning in this scene")
        if isinstance(given, Mapping):
            fields[name] = _named_pairs(layout, name, given, defaults[name], batch)
            continue
        check_range(label, _numbers(given), quantity.accepted)
        shared = layout.parameter_shapes[name]
        unbatched = name in parameters._unbatched
        environments = _environments(label, tuple(given.shape), shared, batch, unbatched)
        fields[name] = _rows(given, environments, quantity.row_shape)
        _check_values(layout, name, _numbers(fields[name]), _numbers(defaults[name]))
    return fields


def _named_pairs(
    layout: Layout,
    name: str,
    given: Mapping[object, Tensor],
    default: Tensor,
    batch: int | None,
) -> Tensor:
    """A parameter of pairs of surfaces, [nb, S S], of which some are named; the rest is default."""
    label, surfaces = f"parameters: `{name}`", layout.assembly.surface_names
    entries: dict[int, Tensor] = {}
    for key, value in given.items():
        if not isinstance(key, tuple) or len(key) != 2 or any(s not in surfaces for s in key):
            raise InvalidInput(
                f"{label} must name pairs (a, b) of the surfaces {texts(surfaces)}; got {key!r}"
            )
        i, j = sorted(surfaces.index(surface) for surface in key)
        if i * len(surfaces) + j in entries:
            raise InvalidInput(f"{label} must name the pair {key!r} once, got it twice")
        entry = f"parameters: `{name}[{key!r}]`"
        check_shape(entry, value.shape, [(), ("B",)])
        check_range(entry, _numbers(value), PARAMETERS[name].accepted)
        values = _with_batch(entry, value, 0, batch)
        # Both entries of a pair, whose mean is meant.
        entries |= dict.fromkeys((i * len(surfaces) + j, j * len(surfaces) + i), values)
    if not entries:
        return default
    environments = max(map(len, entries.values()))
    columns = [values.expand(environments) for values in entries.values()]
    rows = default.expand(environments, len(surfaces) ** 2)
    return rows.index_copy(1, torch.tensor(list(entries)), torch.stack(columns, dim=1))


def default_fields(defaults: Mapping[str, Tensor]) -> Fields:
    """Give values of parameters, of one environment, the axes of fields."""
    return {name: _rows(tensor, 1, PARAMETERS[name].row_shape) for name, tensor in defaults.items()}


def _rows(tensor: Tensor, environments: int, row: Shape) -> Tensor:
    rows = tensor.numel() // (environments * math.prod(row))
    return tensor.reshape(environments, rows, *row)


def _check_values(layout: Layout, name: str, values: FloatArray, default: FloatArray) -> None:
    """Refuse values [nb, rows, ..] that the range of a parameter does not say."""
    if name == "rest_positions":
        if not (values == default).all():
            for shape in values:
                check_areas("parameters", name, shape, layout.assembly.faces)
        return
    if name in ("body_mass", "link_mass"):
        _refuse_row(layout, name, values == 0.0, "> 0")
    elif name in ("body_inertia", "link_inertia"):
        symmetric = (values + np.swapaxes(values, -1, -2)) / 2
        wrong = np.linalg.eigvalsh(symmetric)[..., 0] <= 0.0
        _refuse_row(layout, name, wrong, "positive definite")


def _refuse_row(layout: Layout, name: str, wrong: NDArray[np.bool_], accepted: str) -> None:
    """Refuse a quantity of bodies or links where it is wrong and matters."""
    owner = name.partition("_")[0]
    wrong = wrong & layout.massive[owner]
    if not wrong.any():
        return
    row = int(np.argwhere(wrong)[0][-1])
    links = [f"{robot.name}/{link}" for robot in layout.robots for link in robot.link_names]
    moved = links[row] if owner == "link" else layout.bodies[row].name
    raise InvalidInput(
        f"parameters: `{name}` must be {accepted} in the row [{row}], that of {moved!r}, which "
        "forces move"
    )


def _environments(
    label: str, shape: Shape, shared: Sequence[Shape], batch: int | None, unbatched: bool
) -> int:
    """Number of environments that a parameter of some shape stands for: 1, or the batch."""
    is_shared = shape in shared
    is_batched = batch is not None and shape[:1] == (batch,) and shape[1:] in shared
    if is_shared and is_batched and shape != (1,) and not unbatched:
        raise InvalidInput(
            f"{label} of shape {list(shape)} could mean one value per environment or per "
            f"{'cloth' if shape == shared[1] else 'face'}; write it as "
            f"{[batch, *shared[1]]} to say which"
        )
    if is_shared:
        return 1
    if is_batched and batch is not None:
        return batch
    if batch is None and shape[1:] in shared:
        raise InvalidInput(
            f"{label} has shape {list(shape)}; accepted are {_texts(shared)}. A batch axis needs "
            "a state with one: make it with initial_state(batch_size=...)"
        )
    accepted = list(shared) if batch is None else [*shared, *((batch, *s) for s in shared)]
    check_shape(label, shape, accepted)
    raise AssertionError("a shape that is accepted is shared or batched")


def _texts(shapes: Sequence[Shape]) -> str:
    return " or ".join(str(list(shape)) for shape in shapes)


def _numbers(tensor: Tensor) -> FloatArray:
    array: FloatArray = tensor.detach().numpy()
    return array
