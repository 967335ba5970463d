"""The command line: run, optimize, fit, train, export, info.

Commands import modules when they run: torch takes seconds to import, and `diffcloth --help` or a
misspelled option should not wait for it.
"""

from __future__ import annotations

import atexit
import os
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import click

__all__ = ["main"]

_SIMULATION_FAILED, _BAD_INPUT, _INTERRUPTED = 1, 2, 130  # exit codes

# Packages that a run or its pictures need.
_PACKAGES = ("torch", "numpy", "trimesh", "matplotlib", "pyvista", "imageio", "imageio-ffmpeg")

C = TypeVar("C", bound=Callable[..., Any])


class _Program(click.Group):
    """The commands; as a program, they end at once if the user interrupts them."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        try:
            return self.main(*arguments, **options)
        except SystemExit as end:
            if end.code == _INTERRUPTED:
                # The interpreter would take seconds to free the modules of torch one by one.
                atexit._run_exitfuncs()
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(_INTERRUPTED)
            raise


@click.group(cls=_Program, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="diffcloth-torch", prog_name="diffcloth")
def main() -> None:
    """Differentiable cloth with intersection-free contact."""


def _ending_in_a_sentence(command: C) -> C:
    """Report each error of a command in one sentence, and with its exit code."""

    @wraps(command)
    def guarded(debug: bool, **arguments: Any) -> None:
        try:
            from diffcloth_torch.errors import InvalidInput, SimulationError, WorkerError

            try:
                click.echo(command(**arguments))
            except (InvalidInput, TypeError, OSError, ImportError) as error:
                _end(error, _BAD_INPUT, debug)
            except (SimulationError, WorkerError) as error:
                _end(error, _SIMULATION_FAILED, debug)
        except KeyboardInterrupt as error:
            text = str(error) or "before there was anything to keep"
            click.echo(f"\nInterrupted {text}", err=True)
            sys.exit(_INTERRUPTED)

    debug = click.option("--debug", is_flag=True, help="Show the traceback of an error.")
    return debug(guarded)  # type: ignore[return-value]


def _end(error: Exception, code: int, debug: bool) -> None:
    if debug:
        raise error
    text = str(error)
    if isinstance(error, OSError) and error.filename is None and error.strerror:
        text = error.strerror  # without the number
    click.echo(f"Error: {' '.join(text.split())}", err=True)
    sys.exit(code)


_CONFIG = click.argument("config", type=click.Path(path_type=Path))
_CONFIG_OR_NONE = click.argument("config", type=click.Path(path_type=Path), required=False)
_OVERWRITE = click.option(
    "--overwrite", is_flag=True, help="Replace the results of an earlier run in the folder."
)
_OUT = click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for the results; by default results/ and the name of CONFIG.",
)
_ACTIONS = click.option(
    "--actions",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help="Start from the actions that another run found: its actions.npz.",
)
_SET = click.option(
    "--set",
    "assignments",
    metavar="KEY=VALUE",
    multiple=True,
    help="Change a value of the configuration: simulation.steps=50. Repeatable.",
)


def _resume(work: str) -> Callable[[C], C]:
    return click.option(
        "--resume",
        metavar="DIRECTORY",
        type=click.Path(path_type=Path, file_okay=False),
        help=f"Continue the {work} whose results are there; its CONFIG is there too.",
    )


def _viewers(key: str, choices: Sequence[str], text: str) -> Callable[[C], C]:
    """Add the option --viewer, whose choices become an assignment to a key of CONFIG."""

    def add(command: C) -> C:
        @wraps(command)
        def assigned(assignments: tuple[str, ...], viewers: tuple[str, ...], **others: Any) -> Any:
            chosen = (f"{key}=[{','.join(viewers)}]",) if viewers else ()
            return command(assignments=(*assignments, *chosen), **others)

        option = click.option(
            "--viewer", "viewers", type=click.Choice(choices), multiple=True, help=text
        )
        return option(assigned)  # type: ignore[return-value]

    return add


_MOTION_VIEWERS = _viewers(
    "output.viewers",
    ("record", "meshes", "web"),
    "Show the motion in this viewer, in place of those of CONFIG. Repeatable.",
)


@main.command()
@_CONFIG
@_MOTION_VIEWERS
@_SET
@_ACTIONS
@_OUT
@click.option(
    "--save",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Also write all states to this file; its ending names the format, as for export.",
)
@_OVERWRITE
@_ending_in_a_sentence
def run(**arguments: Any) -> str:
    """Simulate CONFIG without optimizing."""
    from diffcloth_torch.cli.run import run

    return run(**arguments)


@main.command()
@_CONFIG_OR_NONE
@_resume("optimization")
@_MOTION_VIEWERS
@_SET
@_ACTIONS
@_OUT
@_OVERWRITE
@_ending_in_a_sentence
def optimize(**arguments: Any) -> str:
    """Optimize the actions of CONFIG, and show the best of them."""
    from diffcloth_torch.cli.optimize import optimize, resume

    return _begin_or_resume(arguments, optimize, resume, accepted=("assignments",))


@main.command()
@_CONFIG_OR_NONE
@_resume("fit")
@_viewers(
    "output.viewers",
    ("web",),
    "Show the fit on a page while it goes on, beside the observations.",
)
@_SET
@_OUT
@_OVERWRITE
@_ending_in_a_sentence
def fit(**arguments: Any) -> str:
    """Fit the variables of CONFIG to observations."""
    from diffcloth_torch.cli.fit import fit_configuration, resume_fit

    return _begin_or_resume(arguments, fit_configuration, resume_fit)


@main.command()
@_CONFIG_OR_NONE
@_resume("training")
@_viewers(
    "viewers",
    ("record", "web"),
    "Show the last evaluation so, in place of the viewers of CONFIG. Repeatable.",
)
@_SET
@_OUT
@_OVERWRITE
@_ending_in_a_sentence
def train(**arguments: Any) -> str:
    """Train the policy of CONFIG, and show its last evaluation."""
    from diffcloth_torch.cli.train import resume_training, train

    return _begin_or_resume(arguments, train, resume_training)


def _begin_or_resume(
    arguments: dict[str, Any],
    begin: Callable[..., str],
    resume: Callable[..., str],
    accepted: Sequence[str] = (),
) -> str:
    """Begin with the arguments, or resume from a folder with those that `resume` accepts."""
    folder = arguments.pop("resume")
    if folder is None:
        if arguments["config"] is None:
            raise click.UsageError("Missing argument 'CONFIG': a file, or --resume DIRECTORY.")
        return begin(**arguments)
    passed = {name: arguments.pop(name) for name in accepted}
    named = {"config": "CONFIG", "assignments": "--set or --viewer"}
    extra = [named.get(name, f"--{name}") for name, a in arguments.items() if a]
    if extra:
        raise click.UsageError(f"--resume takes these from its DIRECTORY: {', '.join(extra)}.")
    return resume(folder, **passed)


@main.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.argument("target", type=click.Path(path_type=Path))
@click.option("--environment", type=int, help="Write this environment of a batch alone.")
@click.option("--overwrite", is_flag=True, help="Replace the file TARGET.")
@_ending_in_a_sentence
def export(**arguments: Any) -> str:
    """Convert the states in SOURCE, a .pt file, to the format that the ending of TARGET names.

    .npz for NumPy, .pvd for ParaView, .glb and .gltf for Blender and players of glTF, .usd, .usda
    and .usdc for USD.
    """
    from diffcloth_torch.cli.export import export

    return export(**arguments)


@main.command()
@_ending_in_a_sentence
def info() -> str:
    """List the build of the core and the installed packages."""
    import platform
    from importlib.metadata import PackageNotFoundError, version

    import torch

    from diffcloth_torch import _core
    from diffcloth_torch.tasks.registry import TASKS

    def installed(package: str) -> str:
        try:
            return version(package)
        except PackageNotFoundError:
            return "not installed"

    rows: dict[str, Any] = {
        "diffcloth-torch": installed("diffcloth-torch"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        **{package: installed(package) for package in _PACKAGES},
        "torch threads": torch.get_num_threads(),
        "tasks": ", ".join(TASKS),
    }
    rows |= {f"core: {name}": value for name, value in _core.build_info().items()}
    width = max(map(len, rows))
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows.items())
