"""A mesh sequence: one OBJ file per state, cloths and bodies in one file."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

from torch import Tensor

from diffcloth_torch.files import writing
from diffcloth_torch.sim.records.state import State

__all__ = ["MeshSequence"]


class MeshSequence:
    """Writes `frame_0000.obj`, `frame_0001.obj` .. into a folder."""

    def __init__(self, folder: Path) -> None:
        """Make the folder, and remove files of an earlier sequence from it.

        Args:
            folder: Folder of the files.
        """
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob("frame_*.obj"):
            old.unlink()
        self._folder = folder
        self._count = 0

    def show(self, state: State, gradient: Tensor | None = None) -> None:
        """Write the file of a state."""
        file = self._folder / f"frame_{self._count:04d}.obj"
        with writing(file):
            state.export(file, bodies=True)
        self._count += 1

    def __enter__(self) -> MeshSequence:
        """Return the viewer; nothing needs to be opened."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Do nothing: each file is complete."""
