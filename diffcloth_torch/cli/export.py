"""The command `diffcloth export`: converts states of a file to a format of another program."""

from __future__ import annotations

from pathlib import Path

from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.sim.records.trajectory import Trajectory

__all__ = ["export"]


def export(
    source: Path, target: Path, environment: int | None = None, *, overwrite: bool = False
) -> str:
    """Convert a file of states.

    Args:
        source: File of `Trajectory.save` that ends in .pt.
        target: The file to write, in the format of its ending.
        environment: The environment of a batch to write; None: all of them.
        overwrite: If true, replace an existing file.

    Raises:
        InvalidInput: If a file or the environment is not accepted.
        OSError: If a file cannot be read or written.
    """
    if target.exists() and not overwrite:
        raise InvalidInput(f"export: {target} exists already: --overwrite replaces it")
    states = Trajectory.load(source)
    if environment is not None:
        states = Trajectory(state[environment] for state in states)
    states.save(target)
    return f"{len(states)} states of {source} are in {target}"
