"""Folders of results: lock, checks before the work, actions, files to resume from, metrics."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib import format as npy
from numpy.typing import NDArray

from diffcloth_torch.checkpoint import read_checkpoint, refusing_damage, write_checkpoint
from diffcloth_torch.cli import results_0_1
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import PART, as_path, read_regular_file, replace_file
from diffcloth_torch.lock import LOCK, locked
from diffcloth_torch.model.quantities import PARAMETERS
from diffcloth_torch.optimize.statistics import finite_or_none, reports_of
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.task import Actions, ConfiguredTask

__all__ = [
    "METRICS",
    "RESUME",
    "check_folder",
    "clear",
    "read_actions",
    "read_resume",
    "results_folder",
    "resume_file",
    "resumed_folder",
    "step_records",
    "values_used",
    "write_metrics",
    "write_resume",
]

# Files in a folder of results; the viewers clear the subfolders into which they write.
METRICS, RESUME = "metrics.json", "resume.pt"
_FILES = (
    *(METRICS, RESUME, "actions.pt", "actions.npz", "loss.png"),
    *("animation.mp4", "animation.gif", "animation.png", "animation.html"),
    *("fit.json", "fit.html", "train.json", "policy.pt"),
    *("evaluation.mp4", "evaluation.gif", "evaluation.png", "evaluation.html"),
)
_FOLDERS = ("meshes", "animation_frames", "evaluation_frames", "evaluations", "events")

_LARGEST_ACTIONS = 256 << 20  # bytes of a file: no run of this code writes a tenth


def check_folder(config: Path, out: Path | None, overwrite: bool, command: str = "") -> Path:
    """Return the folder for results; refuse one with other results unless `overwrite`.

    Args:
        config: The configuration; its name is the default name of the folder.
        out: The folder, or None.
        overwrite: If true, the folder may contain other results.
        command: The command that may resume them, if any.
    """
    folder = Path("results") / config.stem if out is None else out
    if folder.is_dir() and {file.name for file in folder.iterdir()} - {LOCK} and not overwrite:
        goes_on = command and (folder / RESUME).exists()
        going_on = f", `{command} --resume {folder}` goes on" if goes_on else ""
        raise InvalidInput(
            f"--out: {folder} holds results already: --overwrite replaces them{going_on}, and "
            "--out names another folder"
        )
    _check_places(folder)
    return folder


@contextmanager
def results_folder(
    config: Path, out: Path | None, overwrite: bool, command: str = ""
) -> Iterator[Path]:
    """Yield the folder for results, locked; arguments are as for `check_folder`.

    Raises:
        InvalidInput: If another process uses the folder, or it contains other results.
        OSError: If the folder cannot be written.
    """
    folder = check_folder(config, out, overwrite, command)
    with locked("--out", folder):
        check_folder(config, out, overwrite, command)
        yield folder


@contextmanager
def resumed_folder(folder: Path, command: str) -> Iterator[dict[str, Any]]:
    """Yield the content of a file of `write_resume`, while the folder is locked.

    Raises:
        InvalidInput: If another process uses the folder, or it has no such file.
        OSError: If the folder cannot be written.
    """
    read_resume(folder, command)
    with locked("--resume", folder):
        _check_places(folder)
        yield read_resume(folder, command)


def _check_places(folder: Path) -> None:
    """Refuse, before the work, folders at paths of files of results, and vice versa."""
    for name in (*_FILES, *(f"{name}{PART}" for name in _FILES)):
        if (folder / name).is_dir():
            raise InvalidInput(
                f"{folder / name} is a folder, in the place of a file of results: move it away"
            )
    for name in _FOLDERS:
        if (folder / name).exists() and not (folder / name).is_dir():
            raise InvalidInput(
                f"{folder / name} must be a folder, as results are written into it: move it away"
            )


def clear(folder: Path) -> None:
    """Remove the files of earlier results."""
    for name in (*_FILES, results_0_1.RESUME):
        (folder / name).unlink(missing_ok=True)


def read_actions(task: ConfiguredTask, file: Path | None) -> Actions:
    """Return the initial actions of a task, or the actions in a file."""
    actions = task.actions()
    if file is None:
        return actions
    if not actions:
        raise InvalidInput(f"--actions: the task {task.config.task!r} has no actions")
    content = BytesIO(read_regular_file(file, _LARGEST_ACTIONS))
    wanted = {name: list(tensor.shape) for name, tensor in actions.items()}
    given: dict[str, NDArray[Any]] = {}
    try:
        claims = _claims(content)
        got = {name: shape for name, (shape, _) in claims.items()}
        exact = all(dtype == np.float64 for _, dtype in claims.values())
        if got == wanted and exact:
            content.seek(0)
            with np.load(content, allow_pickle=False) as arrays:
                given = {name: arrays[name] for name in wanted}
    except MemoryError:
        raise
    except Exception as error:  # any error of zipfile and NumPy about other bytes
        raise InvalidInput(f"--actions: {file} is not an `actions.npz` of a run") from error
    if got != wanted:
        raise InvalidInput(f"--actions: {file} must hold {_shapes(wanted)}, got {_shapes(got)}")
    if not exact or not all(np.isfinite(array).all() for array in given.values()):
        raise InvalidInput(f"--actions: the arrays of {file} must be finite and float64")
    return {name: torch.from_numpy(given[name]).requires_grad_() for name in actions}


def _claims(file: BytesIO) -> dict[str, tuple[list[int], np.dtype[Any]]]:
    """Shapes and types in the headers of an .npz, without reading its numbers."""
    claims = {}
    with zipfile.ZipFile(file) as entries:
        for entry in entries.namelist():
            with entries.open(entry) as array:
                major, _ = npy.read_magic(array)
                read = npy.read_array_header_1_0 if major == 1 else npy.read_array_header_2_0
                shape, _, dtype = read(array)
                claims[entry.removesuffix(".npy")] = (list(shape), dtype)
    return claims


def _shapes(shapes: dict[str, list[int]]) -> str:
    return ", ".join(f"{name} {shape}" for name, shape in shapes.items()) or "nothing"


def write_resume(
    folder: Path, command: str, document: dict[str, Any], source: Path, **content: Any
) -> None:
    """Write the file that `diffcloth command --resume` reads.

    Args:
        folder: Folder of the results.
        command: The command.
        document: The configuration.
        source: File from which it was read.
        content: Further data for the command, in types that `torch.load` reads.
    """
    kept = {"config": document, "source": str(source.resolve()), **content}
    write_checkpoint(folder / RESUME, command, kept)


def read_resume(folder: Path, command: str) -> dict[str, Any]:
    """Read a file of `write_resume`; its `source` becomes a Path.

    Raises:
        InvalidInput: If there is no such file, or its content is damaged.
    """
    file = resume_file(folder, command)
    if file.name == RESUME:
        content = read_checkpoint("--resume", file, command)
    else:
        content = results_0_1.read_results(folder, command)
    with refusing_damage("--resume", file):
        if not isinstance(content, dict) or not isinstance(content.get("config"), dict):
            raise InvalidInput("its content must be a dict with a configuration")
        return {**content, "source": as_path("the source", content["source"])}


def resume_file(folder: Path, command: str) -> Path:
    """The file that a command goes on from, of 0.1 where there is no other.

    Raises:
        InvalidInput: If there is none.
    """
    for file in (folder / RESUME, folder / results_0_1.RESUME):
        if file.is_file():
            return file
    raise InvalidInput(
        f"--resume: {folder} must hold what `diffcloth {command}` wrote: no {folder / RESUME}"
    )


def write_metrics(path: Path, metrics: dict[str, Any]) -> None:
    """Write numbers as JSON; the file is replaced completely or not at all."""
    text = json.dumps(metrics, indent=2, allow_nan=False) + "\n"
    with replace_file(path) as part:
        part.write_text(text, encoding="utf-8")


def step_records(states: Sequence[State]) -> list[dict[str, Any]]:
    """One record for each step that led to the given states."""
    return [
        {
            "time": float(state.time),
            "converged": bool(report.converged),
            "iterations": int(report.iterations),
            "residual": float(report.residual),
            "minimum_distance": finite_or_none(float(report.minimum_distance)),
            "contact_count": int(report.contact_count),
            "motion_fraction": float(report.motion_fraction),
            "seconds": sum(float(value) for value in report.seconds.values()),
        }
        for state, report in zip(states, reports_of(states), strict=True)
    ]


def values_used(task: ConfiguredTask) -> dict[str, Any]:
    """Return the configuration, and the values that it leaves at their defaults.

    `used` contains the options of contact and solver, the bending model of each cloth, and all
    parameters except the rest positions, which equal the mesh.
    """
    simulator = task.simulator
    parameters = simulator.default_parameters()
    values = {name: getattr(parameters, name) for name in PARAMETERS if name != "rest_positions"}
    given = {name: value.tolist() for name, value in values.items() if value is not None}
    chosen = {name: given.get(name) for name in ("barrier_distance", "barrier_stiffness")}
    return {
        "config": task.config.model_dump(mode="json"),
        "used": {
            "contact": vars(simulator.contact) | chosen,
            "solver": dict(vars(simulator.solver)),
            "bending_models": {
                name: cloth.bending_model
                for name, cloth in zip(task.scene.cloth_names, task.scene.cloths, strict=True)
            },
            "parameters": given,
        },
    }
