"""From a state, a control and parameters to the tensors that the core takes.

Every tensor gets a leading axis of environments here: as many as the state has (one without a
batch axis), or one where a value is shared by all. Everything is ordinary differentiable torch, so
that gradients find their way back to what the caller passed, in its own dtype.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import (
    FloatArray,
    check_finite,
    check_range,
    check_shape,
    float_tensor,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.poses import check_quaternions
from diffcloth_torch.geometry.surfaces import check_areas
from diffcloth_torch.model.quantities import CONTROL, PARAMETERS, STATE, Shape, shape_of
from diffcloth_torch.model.scene import Assembly
from diffcloth_torch.sim.controls import Control, Parameters
from diffcloth_torch.sim.state import State

__all__ = [
    "Inputs",
    "check_control",
    "check_parameters",
    "control_inputs",
    "parameter_inputs",
    "state_inputs",
]

Inputs = dict[str, Tensor]


def state_inputs(assembly: Assembly, state: State) -> tuple[Inputs, int | None]:
    """Check a state; returns its tensors and its batch size, None without a batch axis."""
    if not isinstance(state, State):
        raise TypeError(f"step: `state` must be a State, got {type(state).__name__}")
    sizes = assembly.sizes
    shapes = {name: shape_of(q.axes[0], sizes) for name, q in STATE.items() if q.core}
    for name in shapes:
        _check_state_tensor(name, getattr(state, name))
    batch = state.batch_size
    inputs = {}
    for name, shape in shapes.items():
        tensor = getattr(state, name)
        label = f"step: `state.{name}`"
        if name == "positions":
            check_shape(label, tensor.shape, [shape, ("B", *shape)])
        else:
            check_shape(label, tensor.shape, [shape if batch is None else (batch, *shape)])
        check_finite(label, _numbers(tensor))
        inputs[name] = tensor.unsqueeze(0) if batch is None else tensor
    if batch == 0:
        raise InvalidInput("step: `state` must hold at least one environment, got a batch of 0")
    check_quaternions("step: `state.body_poses`", _numbers(state.body_poses))
    _check_state_tensor("time", state.time)
    check_shape("step: `state.time`", state.time.shape, [() if batch is None else (batch,)])
    check_finite("step: `state.time`", _numbers(state.time))
    return inputs, batch


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
    cpu = tensor.device.type == "cpu" and tensor.layout == torch.strided
    if tensor.dtype != torch.float64 or not cpu:
        raise TypeError(
            f"step: `state.{name}` must be a dense float64 tensor on the CPU, "
            f"got {tensor.dtype} on {tensor.device}; {remedy}"
        )


def check_control(assembly: Assembly, control: Control) -> Control:
    """Promote a control to tensors and check everything that does not depend on a state."""
    if not isinstance(control, Control):
        raise TypeError(f"step: `control` must be a Control, got {type(control).__name__}")
    sizes = assembly.sizes
    groups = {"pins": assembly.pin_groups, "soft_pins": assembly.soft_pin_groups}
    checked: dict[str, Tensor | dict[str, Tensor] | None] = {}
    for field, quantity in CONTROL.items():
        given = getattr(control, field)
        if field in groups and isinstance(given, Mapping):
            checked[field] = _named_pins(field, given, groups[field])
        else:
            checked[field] = _target(field, given, shape_of(quantity.axes[0], sizes))
    if checked["body_poses"] is not None:
        check_quaternions("control: `body_poses`", _numbers(checked["body_poses"]))  # type: ignore[arg-type]
    return Control(**checked)  # type: ignore[arg-type]


def _target(field: str, value: object, shape: Shape) -> Tensor | None:
    if value is None:
        return None
    name = f"control: `{field}`"
    tensor = float_tensor(name, value)
    check_shape(name, tensor.shape, [shape, ("B", *shape)])
    check_finite(name, _numbers(tensor))
    return tensor


def _named_pins(
    field: str, given: Mapping[str, object], groups: Mapping[str, slice]
) -> dict[str, Tensor]:
    """Resolve names to "cloth/pin" and check the shape of each entry."""
    named: dict[str, Tensor] = {}
    for key, value in given.items():
        full = [key] if key in groups else [g for g in groups if g.partition("/")[2] == key]
        if len(full) != 1:
            problem = "is the name of several" if full else "is none of them"
            accepted = ", ".join(map(repr, groups)) or "none, the scene has no such pins"
            raise InvalidInput(
                f"control: `{field}` has the names {accepted} (or the part behind '/' where it is "
                f"unique); {key!r} {problem}"
            )
        if full[0] in named:
            raise InvalidInput(f"control: `{field}` must name {full[0]!r} once, got it twice")
        rows = groups[full[0]]
        tensor = _target(f"{field}[{key!r}]", value, (rows.stop - rows.start, 3))
        if tensor is None:
            raise InvalidInput(
                f"control: `{field}[{key!r}]` must hold positions; leave the name out to hold it"
            )
        named[full[0]] = tensor
    return named


def control_inputs(
    assembly: Assembly, control: Control | None, state: Inputs, batch: int | None
) -> Inputs:
    """Targets for the end of the step and forces; what is not set holds what the state has."""
    checked = check_control(assembly, Control() if control is None else control)
    pins = torch.from_numpy(assembly.pins.astype(np.int64))
    held_pins = state["positions"][:, pins]
    held_soft_pins = state["soft_pin_targets"]
    targets = checked.body_poses
    body_targets = state["body_poses"]
    if targets is not None:
        body_targets = _with_batch("control: `body_poses`", targets, 2, batch)
        body_targets = _keep_static(assembly, body_targets, state["body_poses"])
    forces = torch.zeros(1, len(assembly.vertices), 3, dtype=torch.float64)
    if checked.forces is not None:
        forces = _with_batch("control: `forces`", checked.forces, 2, batch)
    return {
        "pin_targets": _pin_targets("pins", checked.pins, assembly.pin_groups, held_pins, batch),
        "soft_pin_targets": _pin_targets(
            "soft_pins", checked.soft_pins, assembly.soft_pin_groups, held_soft_pins, batch
        ),
        "body_targets": body_targets,
        "forces": forces,
    }


def _pin_targets(
    field: str,
    given: Tensor | Mapping[str, Tensor] | None,
    groups: Mapping[str, slice],
    held: Tensor,
    batch: int | None,
) -> Tensor:
    if given is None:
        return held
    if isinstance(given, Tensor):
        return _with_batch(f"control: `{field}`", given, 2, batch)
    parts = [
        _with_batch(f"control: `{field}[{name!r}]`", given[name], 2, batch)
        if name in given
        else held[:, rows]
        for name, rows in groups.items()
    ]
    if not parts:
        return held
    environments = max(len(part) for part in parts)
    return torch.cat([part.expand(environments, -1, -1) for part in parts], dim=1)


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


def _keep_static(assembly: Assembly, targets: Tensor, poses: Tensor) -> Tensor:
    """Refuse targets that move a static body; a row rounded to float32 stands for the state's."""
    static = list(assembly.static_bodies)
    given, kept = _numbers(targets)[:, static], _numbers(poses)[:, static]
    rounded = kept.astype(np.float32).astype(np.float64)
    moved = ((given != kept) & (given != rounded)).any(axis=-1)
    if moved.any():
        body = static[int(np.argwhere(moved)[0][1])]
        raise InvalidInput(
            f"control: `body_poses` must keep the row [{body}] of the state: that body is static; "
            'make it motion="kinematic" to move it'
        )
    if (given == kept).all():
        return targets
    mask = torch.zeros(targets.shape[-2], 1, dtype=torch.bool)
    mask[static] = True
    return torch.where(mask, poses, targets)


def check_parameters(parameters: Parameters) -> Parameters:
    """Promote parameters to tensors; their values are checked in each step."""
    if not isinstance(parameters, Parameters):
        raise TypeError(f"step: `parameters` must be Parameters, got {type(parameters).__name__}")
    given = {name: getattr(parameters, name) for name in PARAMETERS}
    tensors = {
        name: None if value is None else float_tensor(f"parameters: `{name}`", value)
        for name, value in given.items()
    }
    return Parameters(**tensors, _unbatched=parameters._unbatched)


def parameter_inputs(
    assembly: Assembly,
    parameters: Parameters,
    defaults: Mapping[str, Tensor],
    batch: int | None,
) -> Inputs:
    """Check parameters; a field that is None takes the default, `defaults` has all there are."""
    checked = check_parameters(parameters)
    inputs = {}
    sizes = assembly.sizes
    for name, quantity in PARAMETERS.items():
        given = getattr(checked, name)
        if name not in defaults:
            if given is not None:
                raise InvalidInput(
                    f"parameters: `{name}` must be None: it has no meaning in this scene"
                )
            continue
        label = f"parameters: `{name}`"
        tensor = defaults[name] if given is None else given
        if given is not None:
            check_range(label, _numbers(tensor), quantity.accepted)
        shared = [shape_of(axes, sizes) for axes in quantity.axes]
        unbatched = given is None or name in parameters._unbatched
        rows = _environments(label, tuple(tensor.shape), shared, batch, unbatched)
        inputs[name] = tensor.reshape(rows, *quantity.core_axes)
        if (
            name == "rest_positions"
            and given is not None
            and not torch.equal(tensor, defaults[name])
        ):
            for shape in _numbers(inputs[name]):
                check_areas("parameters", name, shape, assembly.faces)
    return inputs


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
