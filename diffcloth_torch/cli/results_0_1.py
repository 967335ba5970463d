"""Folders of results of `fit` and `train` of 0.1, to resume from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from diffcloth_torch.checkpoint import read_checkpoint, refusing_damage
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import read_regular_file
from diffcloth_torch.saved_0_1 import with_names_of_today

__all__ = ["RESUME", "read_results"]

RESUME = "resume.json"
_RESULT, _POLICY = "train.json", "policy.pt"
_LARGEST = 256 << 20  # bytes of a file


def read_results(folder: Path, command: str) -> dict[str, Any]:
    """Return the content of `resume.pt`, converted from files of 0.1.

    Args:
        folder: Folder with a file `RESUME`.
        command: Command that resumes, "fit" or "train".

    Raises:
        InvalidInput: If a file is damaged, or was written by another command.
        OSError: If a file cannot be read.
    """
    kept = _read_json(folder / RESUME)
    with refusing_damage("--resume", folder / RESUME):
        content = {"config": kept["config"], "source": kept["source"]}
        wrote = "train" if kept["config"]["task"] == "train" else "fit"
        if command != wrote:
            raise InvalidInput(f"it must be of `diffcloth {command}`, got one of {wrote}")
        if command == "fit":
            return content
        return content | _training(folder, kept["config"])


def _training(folder: Path, config: dict[str, Any]) -> dict[str, Any]:
    """Return configuration and results of a training; drops evaluations after the saved policy."""
    options = with_names_of_today(config.get("trainer", {}))
    content = {"config": config | {"trainer": options}, "evaluations": [], "tried": []}
    if not (folder / _POLICY).is_file():
        return content | {"trainer": None}
    trainer = read_checkpoint("--resume", folder / _POLICY, "trainer")
    result = _read_json(folder / _RESULT)
    with refusing_damage("--resume", folder):
        updates = trainer["counts"][1]
        found = [entry for entry in result["evaluations"] if entry["updates"] <= updates]
        return content | {"evaluations": found, "tried": result["tried"], "trainer": trainer}


def _read_json(path: Path) -> Any:
    data = read_regular_file(path, _LARGEST)
    with refusing_damage("--resume", path):
        return json.loads(data)
