"""Scenes and targets of tasks, one YAML file each, which configurations and environments share."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.config.documents import Document, read_document, set_values
from diffcloth_torch.config.scenes import build_scene, pose_array
from diffcloth_torch.config.schema import RunConfig
from diffcloth_torch.config.shape_schema import PoseSection
from diffcloth_torch.config.validation import validate
from diffcloth_torch.model.scene import Scene

__all__ = ["grid_changes", "pose_of", "scene_of", "sections_of"]

_FILES = {file.stem: file for file in Path(__file__).parent.glob("*.yaml")}
_ANY = {"dt": 1.0, "steps": 1}  # arbitrary values, which the scene does not depend on


def sections_of(task: str) -> Document:
    """Read the sections `scene` and `target` of a task; none if the task has no file."""
    return read_document(_FILES[task]) if task in _FILES else {}


def scene_of(task: str, changes: Iterable[str] = ()) -> tuple[Scene, Document]:
    """Build the scene of a task.

    Args:
        task: Name of the task in configurations.
        changes: "key=value" each, as after `--set`.

    Returns:
        The scene, and the sections from which it was built.
    """
    sections = set_values(sections_of(task), changes)
    document = {"task": task, "simulation": _ANY, "scene": sections["scene"]}
    config = validate(RunConfig, document, _FILES[task])
    return build_scene(config, _FILES[task]), sections


def grid_changes(cloth: str, size: int) -> list[str]:
    """Changes that set the vertices along a side of a square cloth."""
    return [f"scene.cloths.{cloth}.shape.{axis}={size}" for axis in ("rows", "columns")]


def pose_of(section: Document) -> NDArray[np.float64]:
    """Pose [px, py, pz, qw, qx, qy, qz] of a section."""
    return pose_array(PoseSection.model_validate(section))
