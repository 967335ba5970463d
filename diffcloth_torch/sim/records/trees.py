"""Records as pytrees of torch, for `tree_map`, `torch.func` and `torch.vmap`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from diffcloth_torch.autograd.torch_private import register_tree

__all__ = ["register_record"]

R = TypeVar("R")
Branches = Mapping[str, Any]


@dataclass(frozen=True)
class _Structure:
    """Names of the fields of a record, and its other parts, which are no branches.

    Two records with fields of the same names have one structure, and a function of several trees
    returns the other parts of the first one.
    """

    names: tuple[str, ...]
    kept: Any = field(compare=False)


def register_record(
    cls: type[R],
    branches: Callable[[R], tuple[Branches, Any]],
    restored: Callable[[dict[str, Any], Any], R],
) -> None:
    """Make a class a pytree whose branches are fields of its objects.

    Args:
        cls: The class.
        branches: Returns the fields that are branches, and the other parts of a restored object.
        restored: Makes an object from both. The values may be of any type, as torch maps trees
            to trees of axes or placeholders.
    """

    def flatten(record: R) -> tuple[list[Any], _Structure]:
        fields, kept = branches(record)
        return list(fields.values()), _Structure(tuple(fields), kept)

    def unflatten(values: Any, structure: Any) -> R:
        return restored(dict(zip(structure.names, values, strict=True)), structure.kept)

    register_tree(cls, flatten, unflatten, lambda structure: structure.names)
