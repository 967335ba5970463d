"""The operation of the package that a caller has called; its name begins every message."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from functools import wraps
from typing import ParamSpec, TypeVar

__all__ = ["called", "label", "operation"]

P = ParamSpec("P")
T = TypeVar("T")

_CALLED: ContextVar[str] = ContextVar("operation")  # each thread has its own


def operation(otherwise: str = "backward") -> str:
    """Return the name of the active operation.

    Args:
        otherwise: The name outside of all operations, where torch calls the package in backward.
    """
    return _CALLED.get(otherwise)


def label(argument: str, field: str) -> str:
    """Return the prefix of a message about a field of an argument, as "step: `control.pins`".

    The method with the name of the argument has the fields as arguments: "control: `pins`".
    """
    name = operation()
    return f"{name}: `{field}`" if name == argument else f"{name}: `{argument}.{field}`"


def called(name: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Name an operation while it is active; a public one that it calls has its own name."""

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        @wraps(function)
        def call(*args: P.args, **keywords: P.kwargs) -> T:
            token = _CALLED.set(name)
            try:
                return function(*args, **keywords)
            finally:
                _CALLED.reset(token)

        return call

    return decorate
