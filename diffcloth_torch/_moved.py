"""Where modules of the first version are now, so that its imports, pickles and saved states load.

An old path is found on its first import, and is then a second name of the module at the new path:
classes are the same objects under both. Nothing in the package itself uses old paths.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

import torch

__all__ = ["MOVED", "allow_loading", "find_old_modules"]

_PACKAGE = "diffcloth_torch."
_NOW = {
    "bodies": "geometry",
    "bodies.rotation": "geometry.rotation",
    "controls": "sim.controls",
    "defaults": "model.defaults",
    "inputs": "sim.inputs",
    "io": "geometry",
    "io.configs": "config.schema",
    "io.meshes": "geometry.meshes",
    "io.ply": "geometry.ply",
    "materials": "model.materials",
    "mesh": "model.cloth",
    "options": "model.options",
    "outcome": "sim.outcome",
    "poses": "geometry.poses",
    "report": "sim.report",
    "rigid_body": "model.rigid_body",
    "rollout": "sim.rollout",
    "scene": "model.scene",
    "shapes": "geometry.shapes",
    "simulator": "sim.simulator",
    "state": "sim.state",
    "step": "sim.step",
    "surfaces": "geometry.surfaces",
    "tasks.scenes": "config.scenes",
    "tasks.shapes": "config.shapes",
    "viewers.registry": "viewers.several",
}
MOVED = {_PACKAGE + old: _PACKAGE + new for old, new in _NOW.items()}
"""Old path -> new path."""

# torch reads classes at a path other than their own since this version; earlier ones read all
# classes unless `weights_only` is asked for.
_OTHER_PATHS = "2.6"


class _Alias(Loader):
    """Gives a module that stands at another path."""

    def __init__(self, path: str) -> None:
        self._path = path

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = import_module(self._path)
        self._spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec  # the import system has put the alias's there


class _Finder(MetaPathFinder):
    """Finds old paths, before the others: `io.ply` would else be a copy of `geometry.ply`."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        new = MOVED.get(name)
        return None if new is None else ModuleSpec(name, _Alias(new))


def find_old_modules() -> None:
    """Let the import system find old paths."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())


def allow_loading(*classes: type) -> None:
    """Let `torch.load` read classes, also where the first version saved them."""
    torch.serialization.add_safe_globals(list(classes))
    if torch.__version__ >= _OTHER_PATHS:
        old = {new: old for old, new in MOVED.items()}
        names = [f"{old[kind.__module__]}.{kind.__qualname__}" for kind in classes]
        torch.serialization.add_safe_globals(list(zip(classes, names, strict=True)))
