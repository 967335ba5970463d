"""Loading of saved states, including those of version 0.1.0.

A pickle names the module of each class: modules that 0.1.0 had elsewhere have a stand-in at their
old path. `torch.load` with `weights_only` reads classes that are registered with torch: they are as
soon as this package and torch are imported, in whichever order.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

__all__ = ["allow_loading", "let_saved_states_load", "register_classes"]

_PACKAGE = "diffcloth_torch."
_NOW = {
    "controls": "sim.controls",
    "materials": "model.materials",
    "mesh": "model.cloth",
    "options": "model.options",
    "report": "sim.report",
    "rigid_body": "model.rigid_body",
    "scene": "model.scene",
    "simulator": "sim.simulator",
    "state": "sim.state",
}
"""Module of 0.1.0 whose classes are in saved states and simulators -> where it is now."""

# torch reads classes at a path other than their own since this version; earlier ones read all
# classes unless `weights_only` is asked for.
_OTHER_PATHS = "2.6"


class _StandIn(ModuleType):
    """A stand-in for a module at its path in 0.1.0, with the contents of its new path."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(import_module(_PACKAGE + _NOW[self.__name__.removeprefix(_PACKAGE)]), name)


class _TorchFinder:  # no importlib.abc.MetaPathFinder: that import takes 9 ms
    """Finds torch, which is not imported yet, and registers our classes when it has been."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != "torch":
            return None
        finders = [finder for finder in sys.meta_path if finder is not self]
        specs = (finder.find_spec(name, path, target) for finder in finders)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_and_register(module: ModuleType) -> None:
            execute(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
            # A module of ours that imports torch cannot be imported again here.
            if not any(_is_being_imported(module) for module in list(sys.modules.values())):
                register_classes()

        spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


def let_saved_states_load() -> None:
    """Put the stand-ins in place, and register classes with torch now or once it is imported."""
    for old in _NOW:
        sys.modules.setdefault(_PACKAGE + old, _StandIn(_PACKAGE + old))
    if "torch" in sys.modules:
        register_classes()
    else:
        sys.meta_path.insert(0, _TorchFinder())


def _is_being_imported(module: ModuleType) -> bool:
    spec = getattr(module, "__spec__", None)
    return bool(spec and spec.name.startswith(_PACKAGE) and getattr(spec, "_initializing", False))


def register_classes() -> None:
    """Import the modules that register what they have."""
    import_module("diffcloth_torch.sim.records.state")
    import_module("diffcloth_torch.sim.records.controls")


def allow_loading(*classes: type, once_in: str | None = None) -> None:
    """Let `torch.load` read classes, also where earlier versions saved them.

    Args:
        classes: The classes.
        once_in: Module of this package in which they once were, None if they have not moved.
    """
    import torch

    torch.serialization.add_safe_globals(list(classes))
    if torch.__version__ >= _OTHER_PATHS:
        old = {_PACKAGE + new: _PACKAGE + old for old, new in _NOW.items()}
        places = {k: once_in or k.__module__ for k in classes}
        paths = {k: {place, old.get(place, place)} for k, place in places.items()}
        torch.serialization.add_safe_globals(
            [(k, f"{path}.{k.__qualname__}") for k in classes for path in paths[k]]
        )
