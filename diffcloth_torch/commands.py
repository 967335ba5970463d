"""The commands of the command line; each returns its closing message."""

from __future__ import annotations

import platform
import time
import zipfile
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib import format as npy
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import _core, cpu
from diffcloth_torch.config.documents import set_values
from diffcloth_torch.config.viewers import open_viewers
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.files import read_regular_file
from diffcloth_torch.model.quantities import PARAMETERS
from diffcloth_torch.optimize.descent import Descent
from diffcloth_torch.optimize.statistics import rollout_statistics
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.optimization import Actions, position_gradients
from diffcloth_torch.tasks.optimization import optimize as run_optimization
from diffcloth_torch.tasks.registry import TASKS, check_document, load_task, make_task
from diffcloth_torch.tasks.simulation import simulate
from diffcloth_torch.tasks.statistics import (
    replace_file,
    step_records,
    write_metrics,
)
from diffcloth_torch.tasks.task import Optimizable, Task
from diffcloth_torch.viewers.curves import draw_loss_curve

__all__ = ["check_folder", "info", "optimize", "resume", "run"]

# Packages that a run or its pictures need; `info` lists which of them are installed.
_PACKAGES = ("torch", "numpy", "trimesh", "matplotlib", "pyvista", "imageio", "imageio-ffmpeg")

# Files in a folder of results, and folders, which are cleared by the viewers that write into them.
_METRICS, _RESUME = "metrics.json", "resume.pt"
_RESULTS = (
    *(_METRICS, _RESUME, "actions.pt", "actions.npz", "loss.png"),
    *("animation.mp4", "animation.gif", "animation.png", "animation.html"),
    *("metrics.part", "resume.part"),
)
_FOLDERS = ("meshes", "animation_frames")

_LARGEST_ACTIONS = 256 << 20  # bytes of a file of actions: no run of this code writes a tenth

# Sections that may change when an optimization continues; others would change earlier results.
_RESUMABLE = ("optimizer", "output")


def run(
    config: Path,
    assignments: Iterable[str] = (),
    out: Path | None = None,
    *,
    overwrite: bool = False,
    actions: Path | None = None,
) -> str:
    """Simulate a configuration without optimizing.

    Args:
        config: YAML file.
        assignments: "key=value" each, see `set_values`.
        out: Folder for the results; by default results/ and the name of `config`.
        overwrite: Whether to replace existing results.
        actions: File `actions.npz` of a run whose actions are used instead of the initial ones.

    Raises:
        InvalidInput: If an argument or the configuration is not accepted.
        SimulationError: If a step fails; earlier results are kept.
        KeyboardInterrupt: If the user ends the run; the message says what is kept.
    """
    out = check_folder(config, out, overwrite)
    task = load_task(config, assignments)
    start_actions = _read_actions(task, actions)
    states: list[State] = []
    start = time.perf_counter()
    try:
        _clear(out)
        with open_viewers(task.config, task.scene, out, task.goals()) as viewers:
            for state in simulate(task, start_actions):
                viewers.show(state)
                states.append(state)
            seconds = time.perf_counter() - start
    except SimulationError as error:
        after = _after(states)
        _write_run(task, states[1:], out, time.perf_counter() - start, str(error))
        raise type(error)(f"{config}: {error} ({after})", report=error.report) from error
    except KeyboardInterrupt as error:
        after = _after(states)
        _write_run(task, states[1:], out, time.perf_counter() - start, f"interrupted {after}")
        raise KeyboardInterrupt(
            f"{after} of {task.steps}: {out / _METRICS} has the steps so far; the same command "
            "with --overwrite starts again"
        ) from error
    _write_run(task, states[1:], out, seconds)
    return f"{len(states) - 1} steps in {seconds:.1f} s; results are in {out}"


def _after(states: Sequence[State]) -> str:
    return f"after step {len(states) - 1}" if states else "after the start"


def _write_run(
    task: Task, states: Sequence[State], out: Path, seconds: float, error: str | None = None
) -> None:
    metrics = {
        "task": task.config.task,
        "seconds": seconds,
        "error": error,
        **rollout_statistics(states),
        "per_step": step_records(states),
        **_values_used(task),
    }
    write_metrics(out / _METRICS, metrics)


def optimize(
    config: Path,
    assignments: Iterable[str] = (),
    out: Path | None = None,
    *,
    overwrite: bool = False,
    actions: Path | None = None,
) -> str:
    """Optimize the actions of a configuration, and show the best of them.

    Arguments and errors are those of `run`.
    """
    out = check_folder(config, out, overwrite)
    task = load_task(config, assignments)
    if not isinstance(task, Optimizable):
        able = ", ".join(name for name, kind in TASKS.items() if hasattr(kind, "loss"))
        raise InvalidInput(
            f"{config}: the task {task.config.task!r} has nothing to optimize: use "
            f"`diffcloth run`; tasks that have are {able}"
        )
    start = _read_actions(task, actions)
    _clear(out)
    return _optimize(task, config, out, start, None)


def resume(folder: Path, assignments: Iterable[str] = ()) -> str:
    """Continue an optimization that was interrupted, or now has more iterations.

    The result has the same bits as without the interruption, if the build and the type of machine
    are the same.

    Args:
        folder: Folder of its results.
        assignments: "key=value" each, of the sections `optimizer` and `output`.

    Raises:
        InvalidInput: If the folder has no such results, or an assignment changes another section.
    """
    file = folder / _RESUME
    if not file.is_file():
        raise InvalidInput(
            f"--resume: {folder} must hold what `diffcloth optimize` wrote: no {file}"
        )
    _check_places(folder)
    try:
        saved = torch.load(file, map_location=cpu.DEVICE, weights_only=True)
        document, source = saved["config"], Path(saved["source"])
        start = {name: tensor.requires_grad_() for name, tensor in saved["start"].items()}
        record = saved["found"]
        found = None if record is None else Descent.restore(record)
    except (OSError, MemoryError):
        raise
    except Exception as error:  # whatever unpickling makes of bytes that are not its own
        raise InvalidInput(f"--resume: {file} is not what `diffcloth optimize` wrote") from error
    for assignment in assignments:
        if assignment.partition(".")[0] not in _RESUMABLE:
            raise InvalidInput(
                f"--set with --resume: the key must be in {' or '.join(_RESUMABLE)}, "
                f"got {assignment!r}"
            )
    task = make_task(check_document(set_values(document, assignments), source), source)
    assert isinstance(task, Optimizable)
    return _optimize(task, source, folder, start, found)


def _optimize(
    task: Optimizable, source: Path, out: Path, start: Actions, found: Descent | None
) -> str:
    # Before the long computation, because a package may be missing.
    viewers = open_viewers(task.config, task.scene, out, task.goals())

    # After every iteration, so that an interruption loses only the current one.
    def keep(sofar: Descent) -> None:
        nonlocal found
        found = sofar
        _write_optimization(task, sofar, out)
        _write_resume(task, source, start, sofar, out)

    try:
        _write_resume(task, source, start, found, out)
        found = run_optimization(task, report=keep, start=start, found=found)
    except KeyboardInterrupt as error:
        done = 0 if found is None else len(found.history)
        best = "" if found is None else f", the best with a loss of {found.best.loss:.5f}"
        raise KeyboardInterrupt(
            f"in iteration {done}: {out} has {done} finished iterations{best}; go on with  "
            f"diffcloth optimize --resume {out}"
        ) from error
    draw_loss_curve(out / "loss.png", found.metrics()["losses"])
    # Only pages show them, and they cost another rollout.
    gradients: list[Tensor | None] = [None] * len(found.best.states)
    if "web" in task.config.output.viewers:
        gradients = [*position_gradients(task, found.best.variables)]
    with viewers:
        viewers.show(task.initial_state())
        for state, gradient in zip(found.best.states, gradients, strict=True):
            viewers.show(state, gradient)
    return (
        f"loss {found.first.loss:.5f} -> {found.best.loss:.5f} in {len(found.history)} iterations, "
        f"{found.seconds:.1f} s; results are in {out}"
    )


def _write_optimization(task: Task, found: Descent, out: Path) -> None:
    metrics = {
        "task": task.config.task,
        **found.metrics(),
        "per_step_of_best": step_records(found.best.states),
        **_values_used(task),
    }
    write_metrics(out / _METRICS, metrics)
    torch.save({"best": found.best.variables, "initial": found.first.variables}, out / "actions.pt")
    arrays: dict[str, Any] = {name: a.numpy() for name, a in found.best.variables.items()}
    np.savez(out / "actions.npz", **arrays)


def _write_resume(
    task: Task, source: Path, start: Actions, found: Descent | None, out: Path
) -> None:
    saved = {
        "config": task.config.model_dump(mode="json"),
        "source": str(source.resolve()),
        "start": {name: tensor.detach() for name, tensor in start.items()},
        "found": None if found is None else found.record(),
    }
    with replace_file(out / _RESUME) as part:
        torch.save(saved, part)


def _values_used(task: Task) -> dict[str, Any]:
    """The configuration, and the values that it leaves at their defaults.

    `used` has the options of contact and solver, the bending model of each cloth, and all
    parameters except the rest positions, which are those of the mesh.
    """
    simulator = task.simulator
    parameters = simulator.parameters()
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


def check_folder(config: Path, out: Path | None, overwrite: bool) -> Path:
    """Name the folder for results, and refuse one that holds others unless `overwrite`."""
    folder = Path("results") / config.stem if out is None else out
    if folder.is_dir() and any(folder.iterdir()) and not overwrite:
        going_on = f", `optimize --resume {folder}` goes on" if (folder / _RESUME).exists() else ""
        raise InvalidInput(
            f"--out: {folder} holds results already: --overwrite replaces them{going_on}, and "
            "--out names another folder"
        )
    _check_places(folder)
    return folder


def _check_places(folder: Path) -> None:
    """Refuse, before the work, anything in the way of its results."""
    for name in _RESULTS:
        if (folder / name).is_dir():
            raise InvalidInput(
                f"{folder / name} is a folder, in the place of a file of results: move it away"
            )
    for name in _FOLDERS:
        if (folder / name).exists() and not (folder / name).is_dir():
            raise InvalidInput(
                f"{folder / name} must be a folder, as results are written into it: move it away"
            )


def _clear(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in _RESULTS:
        (folder / name).unlink(missing_ok=True)


def _read_actions(task: Task, file: Path | None) -> Actions:
    """The initial actions of a task, or those in a file."""
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
    except Exception as error:  # whatever zipfile and NumPy raise for other bytes
        raise InvalidInput(f"--actions: {file} is not an `actions.npz` of a run") from error
    if got != wanted:
        raise InvalidInput(f"--actions: {file} must hold {_shapes(wanted)}, got {_shapes(got)}")
    if not exact or not all(np.isfinite(array).all() for array in given.values()):
        raise InvalidInput(f"--actions: the arrays of {file} must be finite and float64")
    return {name: torch.from_numpy(given[name]).requires_grad_() for name in actions}


def _claims(file: BytesIO) -> dict[str, tuple[list[int], np.dtype[Any]]]:
    """Shapes and types that the headers of an .npz claim, without reading its numbers."""
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


def info() -> str:
    """Describe the build and the installed packages."""
    rows: dict[str, Any] = {
        "diffcloth-torch": _version("diffcloth-torch"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        **{package: _version(package) for package in _PACKAGES},
        "torch threads": torch.get_num_threads(),
        "tasks": ", ".join(TASKS),
    }
    rows |= {f"core: {name}": value for name, value in _core.build_info().items()}
    width = max(map(len, rows))
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows.items())


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
