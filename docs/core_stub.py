"""A stand-in for the C++ core, so that the site is built without compiling it.

`import diffcloth_torch` needs a core to be there, and checks defaults against the names that it
has. Its declarations, `_core.pyi`, hold the values of these.
"""

import __future__

import sys
import typing
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import FunctionType, ModuleType

NAME = "diffcloth_torch._core"


def read(declarations: Path) -> ModuleType:
    """Make a module of what a .pyi file declares, without any behavior.

    Args:
        declarations: The .pyi file. Variables without a value there, and what functions return,
            are empty or zero.
    """
    module = ModuleType(NAME)
    module.__spec__ = ModuleSpec(NAME, None, origin=str(declarations))
    # Annotations stay text until the whole file is known: a .pyi file may name what comes later.
    lazy = __future__.annotations.compiler_flag
    exec(compile(declarations.read_text(), str(declarations), "exec", lazy), vars(module))
    for variable, kind in typing.get_type_hints(module).items():
        if not hasattr(module, variable):
            setattr(module, variable, _empty(kind))
    for name, function in list(vars(module).items()):
        if isinstance(function, FunctionType):
            setattr(module, name, _returning(typing.get_type_hints(function)["return"]))
    return module


def install(declarations: Path) -> None:
    """Put what a .pyi file declares in the place of the core."""
    sys.modules[NAME] = read(declarations)


def _returning(kind: typing.Any) -> Callable[..., typing.Any]:
    return lambda *args, **kwargs: _empty(kind)


def _empty(kind: typing.Any) -> typing.Any:
    """No items, zero or nothing, as the type is."""
    return (typing.get_origin(kind) or kind)()
