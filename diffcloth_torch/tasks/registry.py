"""Tasks by their name in a configuration."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from diffcloth_torch.config.documents import check_plain_document, read_document, set_values
from diffcloth_torch.config.schema import RunConfig
from diffcloth_torch.config.validation import validate
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.tasks.control_points import ControlPoints
from diffcloth_torch.tasks.grasp_cloth import GraspClothProblem
from diffcloth_torch.tasks.hit_cloth import HitClothProblem
from diffcloth_torch.tasks.identify import Identify
from diffcloth_torch.tasks.push_cube import PushCubeProblem
from diffcloth_torch.tasks.scenes import sections_of
from diffcloth_torch.tasks.task import ConfiguredTask
from diffcloth_torch.tasks.two_cloths import TwoClothsProblem

__all__ = [
    "TASKS",
    "check_document",
    "complete_document",
    "load_document",
    "load_task",
    "make_task",
    "read_config",
]

DICT = "dict"
"""Path of a configuration that is no file: used in messages and for the current folder."""

TASKS: dict[str, Any] = {
    "drape": ConfiguredTask,
    "hit_cloth": HitClothProblem,
    "push_cube": PushCubeProblem,
    "grasp_cloth": GraspClothProblem,
    "two_cloths": TwoClothsProblem,
    "control_points": ControlPoints,
    "identify": Identify,
}
"""Name -> class with a `Config`; its constructor has a `Config` and its path as arguments."""


def read_config(path: str | Path, assignments: Iterable[str] = ()) -> RunConfig:
    """Read a configuration, change values, and check it against the schema of its task.

    A configuration without a `scene` has the scene and the target of its task.

    Args:
        path: YAML file.
        assignments: "key=value" each, see `set_values`.

    Raises:
        InvalidInput: If the file, a key or a value is not accepted.
    """
    return complete_document(read_document(path), path, assignments)


def complete_document(
    document: Mapping[str, Any], path: str | Path, assignments: Iterable[str] = ()
) -> RunConfig:
    """Add the scene and the target of its task to a document, change values, and check it.

    Args:
        document: Keys and values; it is not changed.
        path: File that it was read from, for messages.
        assignments: "key=value" each, see `set_values`.

    Raises:
        InvalidInput: If a key or a value is not accepted.
    """
    whole = dict(document)
    if "scene" not in whole:
        whole = {**sections_of(str(whole.get("task"))), **whole}
    return check_document(set_values(whole, assignments), path)


def check_document(document: Mapping[str, Any], path: str | Path) -> RunConfig:
    """Check the contents of a configuration file against the schema of its task.

    Args:
        document: Keys and values.
        path: File that it was read from, for messages.

    Raises:
        InvalidInput: If a key or a value is not accepted.
    """
    name = document.get("task")
    if name not in TASKS:
        accepted = ", ".join(TASKS)
        got = "it is missing" if name is None else f"got {name!r}"
        raise InvalidInput(f"{path}: `task` must be one of {accepted}; {got}")
    config: RunConfig = validate(TASKS[name].Config, dict(document), path)
    return config


def make_task(config: RunConfig, path: str | Path) -> ConfiguredTask:
    """Build the scene, simulator and task of a configuration that was read from `path`."""
    constructor: Callable[[RunConfig, Path], ConfiguredTask] = TASKS[config.task]
    return constructor(config, Path(path))


def load_task(path: str | Path, assignments: Iterable[str] = ()) -> ConfiguredTask:
    """Read a configuration, and build its scene, simulator and task."""
    return make_task(read_config(path, assignments), path)


def load_document(document: Mapping[str, Any], assignments: Iterable[str] = ()) -> ConfiguredTask:
    """Build the scene, simulator and task of a configuration that is no file.

    File names in the configuration are relative to the current folder.

    Raises:
        InvalidInput: If a key or a value is not accepted.
    """
    plain = check_plain_document(document)
    return make_task(complete_document(plain, DICT, assignments), Path(DICT))
