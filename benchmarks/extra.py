"""Packages that the benchmarks need beyond the package's own requirements."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HINTS = {
    "diffcloth_torch._kernels": "build the package again by  scripts/test , or by  "
    "CMAKE_ARGS=-DDIFFCLOTH_KERNELS=ON pip install ."
}


def require(module: str) -> Any:
    """Import a module, or end the process with a sentence that names the package to install."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        hint = _HINTS.get(module, "run  pip install 'diffcloth-torch[test]'  or  scripts/test")
        raise SystemExit(f"Error: this benchmark needs {module}: {hint}") from error
