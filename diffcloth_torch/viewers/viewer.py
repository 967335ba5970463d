"""The protocol of viewers, and a viewer that shows nothing."""

from __future__ import annotations

from types import TracebackType
from typing import Protocol

from torch import Tensor

from diffcloth_torch.sim.records.state import State

__all__ = ["NullViewer", "Viewer"]


class Viewer(Protocol):
    """Receives states in the order of time; a context manager that finishes its files."""

    def show(self, state: State, gradient: Tensor | None = None) -> None:
        """Show one state, without a batch axis, and the gradient of a loss by its positions."""
        ...

    def __enter__(self) -> Viewer: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


class NullViewer:
    """Shows nothing: for measurements."""

    def show(self, state: State, gradient: Tensor | None = None) -> None:
        """Do nothing."""

    def __enter__(self) -> NullViewer:
        """Return the viewer; nothing needs to be opened."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Do nothing."""
