"""A wrapper of methods: operation names, memory errors, and exclusion from `torch.compile`."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch

from diffcloth_torch.autograd.torch_private import compile_nothing_in, has_compiler
from diffcloth_torch.operations import called

__all__ = ["guarded", "uncompiled"]

P = ParamSpec("P")
T = TypeVar("T")


_UNCOMPILED: dict[Callable[..., Any], Callable[..., Any]] = {}


def _uncompiled(method: Callable[P, T]) -> Callable[P, T]:
    """Return the method, excluded from `torch.compile`: a step has nothing to fuse."""
    # Code that compiles has imported the compiler already.
    if not has_compiler():
        return method
    if method not in _UNCOMPILED:
        # Otherwise the compiler would compile this function again for each new entry.
        compile_nothing_in(_uncompiled)
        _UNCOMPILED[method] = torch.compiler.disable(method)  # type: ignore[no-untyped-call]
    return _UNCOMPILED[method]


def uncompiled(method: Callable[P, T]) -> Callable[P, T]:
    """Exclude a method, and all functions that it calls, from `torch.compile`."""

    @wraps(method)
    def call(*args: P.args, **keywords: P.kwargs) -> T:
        return _uncompiled(method)(*args, **keywords)

    return call


def guarded(method: Callable[P, T], name: str = "") -> Callable[P, T]:
    """Name the operation in messages; raise memory errors of torch as MemoryError, like NumPy.

    Args:
        method: The method.
        name: Name of the operation; by default the name of the method.
    """
    operation = name or method.__name__

    named = called(operation)(method)

    @wraps(method)
    def call(*args: P.args, **keywords: P.kwargs) -> T:
        try:
            return _uncompiled(named)(*args, **keywords)
        except RuntimeError as error:
            if "can't allocate memory" in str(error):
                raise MemoryError(f"{operation}: {error}") from error
            raise

    return call
