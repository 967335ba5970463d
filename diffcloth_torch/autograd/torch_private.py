"""All uses of names that torch does not document; no other module has any.

Public torch reports neither the transforms of `torch.func` around a call, nor the numbers inside
their wrappers, nor the older vmap of `is_grads_batched`. `tests/autograd/test_torch_private.py`
checks each function against the public behavior on which it depends; run it first with a new torch.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor
from torch._functorch.pyfunctorch import temporarily_clear_interpreter_stack as outside_transforms
from torch.autograd import forward_ad
from torch.utils import _pytree
from torch.utils.data._utils.collate import default_collate_fn_map

__all__ = [
    "compile_nothing_in",
    "has_compiler",
    "in_forward_mode",
    "in_transform",
    "is_batched_by_older_vmap",
    "is_wrapped",
    "outside_transforms",
    "register_collate",
    "register_tree",
    "transforms",
    "unwrap",
    "with_older_axis",
    "with_tangents",
    "without_older_axis",
]

_functorch = torch._C._functorch


# These two are called for each tensor of each step: they are torch's own functions.
in_transform: Callable[[], bool] = torch._C._are_functorch_transforms_active
"""Return true inside a transform of `torch.func` or `torch.vmap`."""
is_wrapped: Callable[[Tensor], bool] = _functorch.is_functorch_wrapped_tensor
"""Return true for the wrapper of a transform, which has no memory of its own."""


def transforms() -> list[bool]:
    """Active transforms from the outermost inwards: true for `grad`, `vjp` and `jacrev`."""
    stack = _functorch.get_interpreter_stack() or []
    return [level.key() == _functorch.TransformType.Grad for level in stack]


def in_forward_mode() -> bool:
    """Return true inside a level of forward-mode differentiation."""
    return forward_ad._current_level >= 0


def with_tangents() -> AbstractContextManager[None]:
    """Allow tangents inside of the `jvp` of a Function, where torch computes none by default."""
    enabled: AbstractContextManager[None] = forward_ad._set_fwd_grad_enabled(True)
    return enabled


def unwrap(tensor: Tensor) -> tuple[Tensor, int | None]:
    """Return the tensor in a wrapper, and its axis of `torch.vmap`, None for other transforms."""
    axis: int = _functorch.maybe_get_bdim(tensor)
    return _functorch.get_unwrapped(tensor), None if axis < 0 else axis


def is_batched_by_older_vmap(tensor: Tensor) -> bool:
    """Return true if the vmap of `is_grads_batched` or vectorized Jacobians batches a tensor."""
    batched: bool = _functorch.is_legacy_batchedtensor(tensor)
    return batched


def _older_level() -> int:
    """Level of the active older vmap."""
    level: int = torch._C._vmapmode_increment_nesting() - 1
    torch._C._vmapmode_decrement_nesting()
    return level


def without_older_axis(tensor: Tensor, count: int = 1) -> Tensor:
    """Rows [count, ...] of a tensor of the older vmap; equal rows of a tensor without its axis."""
    return torch._remove_batch_dim(tensor, _older_level(), count, 0)


def with_older_axis(rows: Tensor) -> Tensor:
    """Inverse of `without_older_axis`."""
    return torch._add_batch_dim(rows, 0, _older_level())


def has_compiler() -> bool:
    """Return true if the compiler is imported; its import takes longer than the rest of torch."""
    return hasattr(sys.modules.get("torch._dynamo"), "disable")


def compile_nothing_in(function: Callable[..., Any]) -> None:
    """Exclude the lines of a function from the compiler, but not the functions that it calls.

    Requires `has_compiler()`.
    """
    sys.modules["torch._dynamo"].eval_frame.skip_code(function.__code__)


def register_tree(
    cls: type[Any],
    flatten: Callable[[Any], tuple[list[Any], Any]],
    unflatten: Callable[[Any, Any], Any],
    names: Callable[[Any], Sequence[str] | None],
) -> None:
    """Make a class a pytree of torch.

    Args:
        cls: The class.
        flatten: Returns the branches of an object, and its structure.
        unflatten: Makes an object of branches and a structure.
        names: Returns the names of the branches of a structure; None numbers them.
    """

    def flatten_with_keys(value: Any) -> tuple[list[tuple[Any, Any]], Any]:
        branches, structure = flatten(value)
        given = names(structure)
        if given is None:
            keys: list[Any] = [_pytree.SequenceKey(i) for i in range(len(branches))]
        else:
            keys = [_pytree.GetAttrKey(name) for name in given]
        return list(zip(keys, branches, strict=True)), structure

    _pytree.register_pytree_node(
        cls,
        flatten,
        unflatten,
        serialized_type_name=f"diffcloth_torch.{cls.__name__}",
        flatten_with_keys_fn=flatten_with_keys,
    )


def register_collate(cls: type[Any], combine: Callable[[list[Any]], Any]) -> None:
    """Make `torch.utils.data.default_collate` combine a list of objects of a class."""

    def collate(batch: list[Any], *, collate_fn_map: Any = None) -> Any:
        return combine(batch)

    default_collate_fn_map[cls] = collate
