"""The states of a rollout: a list that also has their fields over time."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any, SupportsIndex, overload

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import as_path
from diffcloth_torch.model.quantities import STATE
from diffcloth_torch.sim.records.state import State, check_state

__all__ = ["Trajectory"]


class Trajectory(list[State]):
    """A list of successive states that also has each of their fields, stacked over time.

    `positions` has shape [T, N, 3], or [T, B, N, 3] in a batch, and likewise all other fields of
    `State`; they carry gradients. A slice is a trajectory too.
    """

    def __getattr__(self, name: str) -> Tensor:
        if name not in STATE:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        if not self:
            raise InvalidInput(f"Trajectory: `{name}` needs at least one state, got none")
        return torch.stack([getattr(state, name) for state in self])

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *STATE]

    @overload
    def __getitem__(self, index: SupportsIndex) -> State: ...

    @overload
    def __getitem__(self, index: slice) -> Trajectory: ...

    def __getitem__(self, index: SupportsIndex | slice) -> State | Trajectory:
        """Select one state, or several as a trajectory."""
        found = super().__getitem__(index)
        return Trajectory(found) if isinstance(found, list) else found

    def __repr__(self) -> str:
        return f"Trajectory({len(self)} states)"

    def detach(self) -> Trajectory:
        """Copy whose tensors carry no graph."""
        return Trajectory(state.detach() for state in self)

    def save(self, path: str | Path) -> None:
        """Write the states with their reports and surfaces, but without their graph.

        Args:
            path: The file; an existing one is replaced.

        Raises:
            OSError: If it cannot be written.
        """
        for i, state in enumerate(self):
            check_state(f"Trajectory.save: the state [{i}]", state)
        file = as_path("Trajectory.save: `path`", path)
        if not file.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(file.parent))
        torch.save(list(self.detach()), file)

    @staticmethod
    def load(path: str | Path) -> Trajectory:
        """Read a trajectory that `save` has written.

        Args:
            path: The file.

        Raises:
            InvalidInput: If the file holds anything else.
            OSError: If it cannot be read.
        """
        file = as_path("Trajectory.load: `path`", path)
        try:
            states: Any = torch.load(file, map_location=cpu.DEVICE, weights_only=True)
        except OSError:
            raise
        except Exception as error:  # whatever the reader makes of bytes that are not its own
            raise InvalidInput(f"Trajectory.load: {file} holds no trajectory: {error}") from error
        if not isinstance(states, list):
            kind = type(states).__name__
            raise InvalidInput(f"Trajectory.load: {file} must hold states, got {kind}")
        try:
            for i, state in enumerate(states):
                check_state(f"Trajectory.load: {file}: the state [{i}]", state)
        except TypeError as error:
            raise InvalidInput(str(error)) from error
        return Trajectory(states)
