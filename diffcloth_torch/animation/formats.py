"""The formats of animations, by the endings of files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from diffcloth_torch.animation.gltf import write_gltf
from diffcloth_torch.animation.surfaces import Animation
from diffcloth_torch.animation.usd import write_usd
from diffcloth_torch.animation.vtk import write_pvd

__all__ = ["ANIMATIONS"]

ANIMATIONS: Mapping[str, Callable[[Path, Animation], None]] = {
    ".pvd": write_pvd,
    ".glb": write_gltf,
    ".gltf": write_gltf,
    ".usd": write_usd,
    ".usda": write_usd,
    ".usdc": write_usd,
}
"""Ending -> writer."""
