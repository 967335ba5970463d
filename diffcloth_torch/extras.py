"""Packages of extras: imported on use, with an error that names the extra."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from diffcloth_torch.errors import InvalidInput

__all__ = ["from_extra"]


def from_extra(module: str, extra: str, use: str, instead: str = "") -> Any:
    """Import a module of a package of an extra.

    Args:
        module: Name of the module.
        extra: Name of the extra.
        use: Opening of the message, such as "pictures need pyvista".
        instead: Another remedy than the installation.

    Raises:
        InvalidInput: If the package is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        install = f"run  pip install 'diffcloth-torch[{extra}]'"
        raise InvalidInput(f"{use}: {install}{instead}  ({error})") from error
