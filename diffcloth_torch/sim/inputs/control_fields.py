"""From a control to fields that are checked, complete and have their leading axis.

All operations are ordinary differentiable torch, so that gradients flow back to the caller's
inputs, in their own dtype.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.autograd.transforms import numbers_of
from diffcloth_torch.checks import (
    ANY_NUMBER,
    LARGEST,
    FloatArray,
    are_within,
    check_finite,
    check_range,
    check_shape,
    float_tensor,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.poses import refuse_short_quaternions
from diffcloth_torch.model.quantities import CONTROL, Fields, Shape
from diffcloth_torch.operations import label, operation
from diffcloth_torch.sim.inputs.attachment_weights import (
    Targets,
    default_weights,
    refuse_untargeted,
)
from diffcloth_torch.sim.inputs.axes import with_axis
from diffcloth_torch.sim.inputs.layout import SEVERAL, Layout
from diffcloth_torch.sim.records.controls import Control

__all__ = ["check_control", "control_fields"]

_POSES = ("body_poses", "base_poses")
# Field of a control -> field of the state to which it defaults.
_HELD = {"soft_pins": "soft_pin_targets", "body_poses": "body_poses", "base_poses": "base_poses"}


def check_control(layout: Layout, control: Control, argument: str = "control") -> Control:
    """Promote a control to tensors and make all checks that do not depend on a state.

    Args:
        layout: Layout of the scene.
        control: The control.
        argument: Name of the argument in the message of a TypeError.
    """
    return Control(**_targets(layout, control, argument))  # type: ignore[arg-type]


def _targets(
    layout: Layout, control: Control, argument: str = "control"
) -> dict[str, Tensor | dict[str, Tensor]]:
    """The fields that a control sets, checked."""
    if not isinstance(control, Control):
        raise TypeError(
            f"{operation()}: `{argument}` must be a Control, got {type(control).__name__}"
        )
    checked: dict[str, Tensor | dict[str, Tensor]] = {}
    for field, shape in layout.control_shapes.items():
        given = getattr(control, field)
        if given is None:
            continue
        if field in layout.groups and isinstance(given, Mapping):
            checked[field] = _named_targets(layout, field, given)
        else:
            tensor = _target(field, field, given, shape)
            _check_rows(layout, field, numbers_of(tensor))
            layout.permissions.refuse_unused(field, tensor)
            checked[field] = tensor
    return checked


def _target(field: str, entry: str, value: object, shape: Shape) -> Tensor:
    name = label("control", entry)
    tensor = float_tensor(name, value)
    check_shape(name, tensor.shape, [shape, ("B", *shape)])
    numbers = numbers_of(tensor)
    if not are_within([numbers], LARGEST):
        check_finite(name, numbers)
    if field in _POSES:
        refuse_short_quaternions(name, numbers)
    if CONTROL[field].accepted is not ANY_NUMBER:
        check_range(name, numbers, CONTROL[field].accepted)
    return tensor


def _named_targets(layout: Layout, field: str, given: Mapping[str, object]) -> dict[str, Tensor]:
    """Resolve names to full ones and check each entry."""
    named: dict[str, Tensor] = {}
    for key, value in given.items():
        name = layout.full_name(field, key)
        if name in named:
            raise InvalidInput(f"{label('control', field)} must name {name!r} once, got it twice")
        if value is None:
            raise InvalidInput(
                f"{label('control', f'{field}[{key!r}]')} must hold numbers; leave the name out to "
                "hold it"
            )
        shape = layout.entry_shape(field, name)
        tensor = _target(field, f"{field}[{key!r}]", value, shape)
        if field not in SEVERAL:
            numbers = numbers_of(tensor)
            row = np.expand_dims(numbers, numbers.ndim - len(shape))
            _check_rows(layout, field, row, first=layout.groups[field][name].start)
        named[name] = tensor
    return named


def _check_rows(layout: Layout, field: str, values: FloatArray, first: int = 0) -> None:
    """Refuse values without effect, as wrenches on prescribed bodies; joints beyond a limit."""
    if field == "wind" and not layout.cloth_names:
        raise InvalidInput(
            f"{label('control', field)} must be None: the scene has no cloth that feels it"
        )
    if field in layout.permissions.unforced:
        rows = slice(first, first + values.shape[-2])
        for k, why in enumerate(layout.permissions.unforced[field][rows]):
            if why and values[..., k, :].any():
                raise InvalidInput(
                    f"{label('control', field)} must be zero in the row [{first + k}]: {why}, and "
                    "no force moves it"
                )
    if field == "joint_positions":
        rows = slice(first, first + values.shape[-1])
        lower, upper = layout.permissions.lower[rows], layout.permissions.upper[rows]
        # A limit rounded to float32 is accepted as the limit.
        beyond = (values < np.minimum(lower, lower.astype(np.float32))) | (
            values > np.maximum(upper, upper.astype(np.float32))
        )
        beyond &= layout.permissions.settable[field][rows]
        if beyond.any():
            at = tuple(int(i) for i in np.argwhere(beyond)[0])
            joint = at[-1]
            raise InvalidInput(
                f"{label('control', field)} must be between the limits {lower[joint]:g} and "
                f"{upper[joint]:g} of {layout.joint_names[first + joint]!r}, "
                f"got {values[at]:g} in the row [{first + joint}]"
            )


def control_fields(
    layout: Layout, control: Control | None, state: Fields, batch: int | None
) -> Fields:
    """Complete a control: poses and targets default to the state's, all other fields to zero."""
    given = {} if control is None else _targets(layout, control)
    targets = given.get("attachments")
    fields = {}
    for field in layout.control_fields:
        unset = partial(_unset, layout, field, state, targets)
        values = _complete(layout, field, given.get(field), unset, batch)
        if field in given and field in layout.permissions.kept:
            values = _keep(layout, field, values, state[field])
        fields[field] = values
    if "attachment_weights" in given:
        refuse_untargeted(layout, fields["attachment_weights"], targets)
    return fields


def _unset(layout: Layout, field: str, state: Fields, targets: Targets | None) -> Tensor:
    """Return the default of a field of a control."""
    if field == "attachment_weights":
        return default_weights(layout, targets)
    if field in _HELD:
        return state[_HELD[field]]
    if field == "pins" and layout.pins.numel():
        return state["positions"][:, layout.pins]
    if field == "body_vertices" and layout.body_vertex_rows.numel():
        return state["positions"][:, layout.body_vertex_rows]
    if field == "joint_positions":
        return torch.where(
            layout.permissions.driven, state["joint_targets"], state["joint_positions"]
        )
    return layout.zeros[field]


def _complete(
    layout: Layout,
    field: str,
    given: Targets | None,
    unset: Callable[[], Tensor],
    batch: int | None,
) -> Tensor:
    """Complete a field of which a control may set only some rows; `unset` computes the others."""
    if given is None:
        return unset()
    if isinstance(given, Tensor):
        dimensions = len(layout.control_shapes[field])
        values = with_axis(label("control", field), given, dimensions, batch)
        if field in layout.permissions.settable:
            sets = torch.from_numpy(layout.permissions.settable[field])
            values = torch.where(sets, values, unset())
        return values
    return _complete_by_name(layout, field, given, unset, batch)


def _complete_by_name(
    layout: Layout,
    field: str,
    given: Mapping[str, Tensor],
    unset: Callable[[], Tensor],
    batch: int | None,
) -> Tensor:
    groups = layout.groups[field]
    others = unset() if len(given) < len(groups) else None
    if not given:
        assert others is not None  # a group has a name
        return others
    axes = len(layout.control_shapes[field]) - (field not in SEVERAL)
    parts = []
    for name, rows in groups.items():
        if name not in given:
            assert others is not None
            parts.append(others[:, rows])
            continue
        values = with_axis(label("control", f"{field}[{name!r}]"), given[name], axes, batch)
        parts.append(values if field in SEVERAL else values.unsqueeze(1))
    environments = max(part.shape[0] for part in parts)
    wide = [
        part if part.shape[0] == environments else part.expand(environments, *part.shape[1:])
        for part in parts
    ]
    return torch.cat(wide, dim=1)


def _keep(layout: Layout, field: str, targets: Tensor, poses: Tensor) -> Tensor:
    """Refuse to move objects that are not kinematic; poses rounded to float32 are accepted."""
    reasons = layout.permissions.kept[field]
    still = [k for k, why in enumerate(reasons) if why]
    if not still:
        return targets
    given, kept = numbers_of(targets)[:, still], numbers_of(poses)[:, still]
    rounded = kept.astype(np.float32).astype(np.float64)
    moved = ((given != kept) & (given != rounded)).any(axis=-1)
    if moved.any():
        row = still[int(np.argwhere(moved)[0][1])]
        remedy = 'motion="kinematic"' if field == "body_poses" else 'base="kinematic"'
        raise InvalidInput(
            f"{label('control', field)} must keep the row [{row}] of the state: {reasons[row]}; "
            f"make it {remedy} to move it"
        )
    if (given == kept).all():
        return targets
    mask = cpu.zeros(targets.shape[-2], 1, dtype=torch.bool)
    mask[still] = True
    return torch.where(mask, poses, targets)
