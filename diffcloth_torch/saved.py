"""Objects in files, under names that stay when modules move.

A pickle of an object whose class is `saved` holds the function `restore`, the name of the class,
the number of the format and the fields of the object. Arrays and slices in the fields become calls
of functions here, as `torch.load` does not trust those that their own pickles name. With
`weights_only` it reads these files as soon as `diffcloth_torch.sim` has been imported, which any
public name does. Files of 0.1 name modules instead; `saved_0_1.py` has their paths.
"""

from __future__ import annotations

import base64
import copyreg
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.saved_0_1 import MODULES

__all__ = ["FORMAT", "read_saved_objects", "restore", "restore_array", "restore_slice", "saved"]

FORMAT = 1
"""Number of the format of files; raised where an older reader would misread a file."""

_PACKAGE = "diffcloth_torch"

_MODULES = {
    "Attachment": "model.attachment",
    "Cloth": "model.cloth",
    "ContactOptions": "model.options",
    "ContactPoints": "sim.records.contact_points",
    "ContactSurface": "model.round_bodies",
    "Contacts": "sim.records.contacts",
    "Control": "sim.records.controls",
    "DeformingBody": "model.deforming_body",
    "LinkSurfaces": "sim.records.surfaces",
    "Material": "model.materials",
    "Mechanism": "model.mechanism",
    "Parameters": "sim.records.controls",
    "Points": "model.attachment",
    "Primitive": "model.round_bodies",
    "Report": "sim.records.report",
    "RigidBody": "model.rigid_body",
    "Robot": "model.robot",
    "Scene": "model.scene",
    "Simulator": "sim.simulator",
    "SolverOptions": "model.options",
    "Springs": "model.springs",
    "State": "sim.records.state",
    "Surface": "geometry.mesh_checks",
    "Surfaces": "sim.records.surfaces",
}
"""Class that files name -> its module."""

# Reads classes at a path other than their own since this version of torch.
_OTHER_PATHS = (2, 6)

C = TypeVar("C", bound=type)


def saved(cls: C) -> C:
    """Save objects of a class by its name and their fields."""
    if _MODULES.get(cls.__name__) != cls.__module__.removeprefix(f"{_PACKAGE}."):
        raise TypeError(f"saved: {cls.__name__} needs its module in the table of saved classes")
    copyreg.pickle(cls, _reduce)
    return cls


def _reduce(value: Any) -> tuple[Any, ...]:
    if isinstance(value, tuple):
        fields = value._asdict()  # type: ignore[attr-defined]
    else:
        own = getattr(value, "__getstate__", None)  # Python 3.10 has it only where a class does
        fields = dict(own() if own else vars(value))
    fields = {name: _plain(field) for name, field in fields.items()}
    return restore, (type(value).__name__, FORMAT, fields)


class _Call:
    """A value whose pickle calls a function of this module."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._call = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self._call


def _plain(value: Any) -> Any:
    """A value without arrays and slices, also inside of plain containers."""
    if isinstance(value, np.ndarray):
        text = base64.b64encode(value.tobytes()).decode("ascii")
        return _Call(restore_array, value.dtype.str, value.shape, text, value.flags.writeable)
    if isinstance(value, slice):
        return _Call(restore_slice, value.start, value.stop, value.step)
    if type(value) in (list, tuple):
        return type(value)(map(_plain, value))
    if type(value) is dict:
        return {key: _plain(entry) for key, entry in value.items()}
    return value


def restore_slice(start: int | None, stop: int | None, step: int | None) -> slice:
    """Make a slice from a file."""
    return slice(start, stop, step)


def restore_array(dtype: str, shape: tuple[int, ...], text: str, writable: bool) -> NDArray[Any]:
    """Make an array of numbers from a file.

    Args:
        dtype: Type of its numbers, as "<f8".
        shape: Its shape.
        text: Its bytes in base64.
        writable: Whether it may be edited.

    Raises:
        InvalidInput: If these do not belong together.
    """
    try:
        kind = np.dtype(dtype)
        if kind.kind not in "fiub":
            raise ValueError(f"{dtype!r} is no type of numbers")
        array = np.frombuffer(base64.b64decode(text, validate=True), dtype=kind).reshape(shape)
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"load: the file must hold arrays of numbers: {error}") from error
    return array.copy() if writable else array


def restore(name: str, version: int, fields: dict[str, Any]) -> Any:
    """Make an object from a file.

    Args:
        name: Name of its class.
        version: Format of the file.
        fields: Names and values of its fields.

    Raises:
        InvalidInput: If the format is newer than this version of the package, or holds a class
            that it does not have.
    """
    if version > FORMAT or name not in _MODULES:
        raise InvalidInput(
            f"load: the file must have format {FORMAT} at most and classes of this version, got "
            f"{name!r} of format {version}; install a later diffcloth_torch"
        )
    cls = _class(name)
    if issubclass(cls, tuple):
        return cls(**fields)
    value = cls.__new__(cls)
    getattr(value, "__setstate__", value.__dict__.update)(fields)
    return value


def _class(name: str) -> Any:
    return getattr(import_module(f"{_PACKAGE}.{_MODULES[name]}"), name)


def read_saved_objects() -> None:
    """Allow `torch.load` to read saved objects, and pickles to name the modules of 0.1."""
    import torch

    torch.serialization.add_safe_globals([restore, restore_array, restore_slice])
    release = tuple(int(part) for part in torch.__version__.split(".")[:2])
    for module, names in MODULES.items():
        classes = [_class(name) for name in names]
        sys.modules[f"{_PACKAGE}.{module}"] = sys.modules[classes[0].__module__]
        if release >= _OTHER_PATHS:
            torch.serialization.add_safe_globals(
                [(cls, f"{_PACKAGE}.{module}.{cls.__name__}") for cls in classes]
            )
