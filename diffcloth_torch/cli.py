"""The command line: run, optimize, fit, train, info.

Commands import what they need when they run: torch takes seconds to import, and `diffcloth --help`
or a misspelled option need not wait for it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import click

__all__ = ["main"]

_SIMULATION_FAILED, _BAD_INPUT, _INTERRUPTED = 1, 2, 130  # exit codes

C = TypeVar("C", bound=Callable[..., Any])


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="diffcloth-torch", prog_name="diffcloth")
def main() -> None:
    """Differentiable cloth with intersection-free contact."""


def _ending_in_a_sentence(command: C) -> C:
    """End the errors of a command with one sentence each, and with its exit code."""

    @wraps(command)
    def guarded(debug: bool, **arguments: Any) -> None:
        try:
            from diffcloth_torch.errors import InvalidInput, SimulationError

            try:
                click.echo(command(**arguments))
            except (InvalidInput, TypeError, OSError, ImportError) as error:
                _end(error, _BAD_INPUT, debug)
            except SimulationError as error:
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
    click.echo(f"Error: {' '.join(str(error).split())}", err=True)
    sys.exit(code)


_OVERWRITE = click.option(
    "--overwrite", is_flag=True, help="Replace the results of an earlier run in the folder."
)
_OUT = click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for the results; by default results/ and the name of CONFIG.",
)
_SET = click.option(
    "--set",
    "assignments",
    metavar="KEY=VALUE",
    multiple=True,
    help="Change a value of the configuration: simulation.steps=50. Repeatable.",
)


def _options(command: C) -> C:
    """Add the options of all commands that simulate; what they choose becomes assignments."""

    @wraps(command)
    def with_viewers(assignments: tuple[str, ...], viewers: tuple[str, ...], **others: Any) -> Any:
        chosen = (f"output.viewers=[{','.join(viewers)}]",) if viewers else ()
        return command(assignments=(*assignments, *chosen), **others)

    added: Any = with_viewers
    for option in (
        _OVERWRITE,
        _OUT,
        click.option(
            "--actions",
            type=click.Path(path_type=Path, dir_okay=False, exists=True),
            help="Start from the actions that another run found: its actions.npz.",
        ),
        _SET,
        click.option(
            "--viewer",
            "viewers",
            type=click.Choice(("record", "meshes", "web")),
            multiple=True,
            help="Show the motion in this viewer, in place of those of CONFIG. Repeatable.",
        ),
    ):
        added = option(added)
    return added  # type: ignore[no-any-return]


@main.command()
@click.argument("config", type=click.Path(path_type=Path))
@_options
@_ending_in_a_sentence
def run(**arguments: Any) -> str:
    """Simulate CONFIG without optimizing."""
    from diffcloth_torch.commands import run

    return run(**arguments)


@main.command()
@click.argument("config", type=click.Path(path_type=Path), required=False)
@click.option(
    "--resume",
    metavar="DIRECTORY",
    type=click.Path(path_type=Path, file_okay=False),
    help="Go on with the optimization whose results are there; its CONFIG is there too.",
)
@_options
@_ending_in_a_sentence
def optimize(**arguments: Any) -> str:
    """Optimize the actions of CONFIG, and show the best of them."""
    from diffcloth_torch.commands import optimize, resume

    folder = arguments.pop("resume")
    if folder is None:
        if arguments["config"] is None:
            raise click.UsageError("Missing argument 'CONFIG': a file, or --resume DIRECTORY.")
        return optimize(**arguments)
    assignments = arguments.pop("assignments")
    extra = ["CONFIG" if name == "config" else f"--{name}" for name, a in arguments.items() if a]
    if extra:
        raise click.UsageError(f"--resume takes these from its DIRECTORY: {', '.join(extra)}.")
    return resume(folder, assignments)


@main.command()
@click.argument("config", type=click.Path(path_type=Path), required=False)
@click.option(
    "--resume",
    metavar="DIRECTORY",
    type=click.Path(path_type=Path, file_okay=False),
    help="Go on with the fit whose results are there; its CONFIG is there too.",
)
@click.option(
    "--viewer",
    "viewers",
    type=click.Choice(("web",)),
    multiple=True,
    help="Show the fit on a page while it goes on, beside what was observed.",
)
@_SET
@_OUT
@_OVERWRITE
@_ending_in_a_sentence
def fit(viewers: tuple[str, ...], assignments: tuple[str, ...], **arguments: Any) -> str:
    """Fit the variables of CONFIG to what was observed."""
    if viewers:
        assignments = (*assignments, f"output.viewers=[{','.join(viewers)}]")
    arguments["assignments"] = assignments
    from diffcloth_torch.fit_command import fit_configuration, resume_fit

    return _begin_or_resume(arguments, fit_configuration, resume_fit)


@main.command()
@click.argument("config", type=click.Path(path_type=Path), required=False)
@click.option(
    "--resume",
    metavar="DIRECTORY",
    type=click.Path(path_type=Path, file_okay=False),
    help="Go on with the training whose results are there; its CONFIG is there too.",
)
@click.option(
    "--viewer",
    "viewers",
    type=click.Choice(("record", "web")),
    multiple=True,
    help="Show the last evaluation so, in place of the viewers of CONFIG. Repeatable.",
)
@_SET
@_OUT
@_OVERWRITE
@_ending_in_a_sentence
def train(viewers: tuple[str, ...], assignments: tuple[str, ...], **arguments: Any) -> str:
    """Train the policy of CONFIG, and show what it does."""
    if viewers:
        assignments = (*assignments, f"viewers=[{','.join(viewers)}]")
    arguments["assignments"] = assignments
    from diffcloth_torch.train_command import resume_training, train

    return _begin_or_resume(arguments, train, resume_training)


def _begin_or_resume(
    arguments: dict[str, Any], begin: Callable[..., str], go_on: Callable[[Path], str]
) -> str:
    folder = arguments.pop("resume")
    if folder is None:
        if arguments["config"] is None:
            raise click.UsageError("Missing argument 'CONFIG': a file, or --resume DIRECTORY.")
        return begin(**arguments)
    named = {"config": "CONFIG", "assignments": "--set or --viewer"}
    extra = [named.get(name, f"--{name}") for name, a in arguments.items() if a]
    if extra:
        raise click.UsageError(f"--resume takes these from its DIRECTORY: {', '.join(extra)}.")
    return go_on(folder)


@main.command()
@_ending_in_a_sentence
def info() -> str:
    """Say what was built in, and which packages are there."""
    from diffcloth_torch.commands import info

    return info()
