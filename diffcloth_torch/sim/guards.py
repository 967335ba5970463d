"""A wrapper of a simulator's methods: for lack of memory, `torch.compile`, and default devices."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch.utils import _device

__all__ = ["guarded", "on_cpu"]

P = ParamSpec("P")
T = TypeVar("T")


_UNCOMPILED: dict[Callable[..., Any], Callable[..., Any]] = {}


def _uncompiled(method: Callable[P, T]) -> Callable[P, T]:
    """The method, excluded from `torch.compile`: there is nothing to fuse in a step."""
    # Importing the compiler takes longer than all the rest; who compiles has imported it already.
    if not hasattr(sys.modules.get("torch._dynamo"), "disable"):
        return method
    if method not in _UNCOMPILED:
        _UNCOMPILED[method] = torch.compiler.disable(method)  # type: ignore[no-untyped-call]
    return _UNCOMPILED[method]


def on_cpu(function: Callable[P, T]) -> Callable[P, T]:
    """Make tensors on the CPU, also where a user's default device is another one."""

    @wraps(function)
    def call(*args: P.args, **keywords: P.kwargs) -> T:
        # None unless a default has been set; torch's public question takes some microseconds.
        if _device.CURRENT_DEVICE is None:
            return function(*args, **keywords)
        with torch.device("cpu"):
            return function(*args, **keywords)

    return call


def guarded(method: Callable[P, T]) -> Callable[P, T]:
    """Compute on the CPU; raise torch's lack of memory as MemoryError, like NumPy and the core."""

    @wraps(method)
    def call(*args: P.args, **keywords: P.kwargs) -> T:
        try:
            if _device.CURRENT_DEVICE is None:
                return _uncompiled(method)(*args, **keywords)
            with torch.device("cpu"):
                return _uncompiled(method)(*args, **keywords)
        except RuntimeError as error:
            if "can't allocate memory" in str(error):
                raise MemoryError(f"{method.__name__}: {error}") from error
            raise

    return call
