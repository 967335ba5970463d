"""From a state to fields that are checked and have their leading axis."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.autograd.transforms import is_dense, numbers_of
from diffcloth_torch.checks import LARGEST, FloatArray, are_within, check_finite, check_shape
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.poses import refuse_short_quaternions
from diffcloth_torch.model.quantities import Fields, Shape
from diffcloth_torch.operations import label, operation
from diffcloth_torch.sim.inputs.layout import Layout
from diffcloth_torch.sim.records.state import State

__all__ = ["check_state_tensor", "state_fields"]

_POSES = ("body_poses", "base_poses")


def state_fields(layout: Layout, state: State) -> tuple[Fields, int | None]:
    """Check a state; returns its tensors and its batch size, None without a batch axis."""
    if not isinstance(state, State):
        raise TypeError(f"{operation()}: `state` must be a State, got {type(state).__name__}")
    tensors = {name: getattr(state, name) for name in layout.state_shapes}
    for name, tensor in tensors.items():
        check_state_tensor(name, tensor)
    batch = state.batch_size
    environments = () if batch is None else (batch,)
    fit = all(t.shape == (*environments, *layout.state_shapes[n]) for n, t in tensors.items())
    numbers = {name: numbers_of(tensor) for name, tensor in tensors.items() if tensor.numel()}
    if not fit or not are_within(list(numbers.values()), LARGEST):
        _refuse_state(layout, tensors, environments)
    if batch == 0:
        raise InvalidInput(
            f"{operation()}: `state` must hold at least one environment, got a batch of 0"
        )
    for name in _POSES:
        if name in numbers:
            refuse_short_quaternions(label("state", name), numbers[name])
    if layout.joint_names:
        _check_zones(layout, numbers["joint_positions"])
    used = {name: tensors[name] for name in layout.state_fields}
    return {n: t.unsqueeze(0) for n, t in used.items()} if batch is None else used, batch


def _refuse_state(layout: Layout, tensors: Fields, environments: Shape) -> None:
    """Raise an error about the first tensor whose shape or values are not accepted."""
    for name, shape in layout.state_shapes.items():
        opening = label("state", name)
        of_any_batch: list[tuple[int | str, ...]] = [shape, ("B", *shape)]
        accepted = of_any_batch if name == "positions" else [(*environments, *shape)]
        check_shape(opening, tensors[name].shape, accepted)
        check_finite(opening, numbers_of(tensors[name]))


def _check_zones(layout: Layout, positions: FloatArray) -> None:
    """Refuse positions of driven joints at which the barriers at their limits are infinite."""
    lower, upper = layout.permissions.farthest
    beyond = (positions <= lower) | (positions >= upper)
    if beyond.any():
        at = tuple(int(i) for i in np.argwhere(beyond)[0])
        joint = at[-1]
        raise InvalidInput(
            f"{label('state', 'joint_positions')} of a dynamic joint must be at most 1 % of its "
            f"range beyond a limit: between {lower[joint]:g} and {upper[joint]:g} (exclusive) for "
            f"{layout.joint_names[joint]!r}, got {positions[at]:g} at [{joint}]"
        )


def check_state_tensor(name: str, tensor: object) -> None:
    """Require a dense float64 tensor on the CPU."""
    remedy = (
        "positions in lower precision cannot keep surfaces apart; make the state with "
        "initial_state() and replace its tensors by float64 ones on the CPU, .to('cpu', "
        "torch.float64)"
    )
    if not isinstance(tensor, Tensor):
        raise TypeError(
            f"{label('state', name)} must be a torch tensor, got {type(tensor).__name__}; {remedy}"
        )
    if tensor.dtype != torch.float64 or not tensor.is_cpu or not is_dense(tensor):
        layout = "nested" if tensor.is_nested else tensor.layout
        raise TypeError(
            f"{label('state', name)} must be a dense float64 tensor on the CPU, "
            f"got {tensor.dtype} on {tensor.device}, {layout}; {remedy}"
        )
