"""Several viewers as one."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from types import TracebackType

from torch import Tensor

from diffcloth_torch.sim.records.state import State
from diffcloth_torch.viewers.viewer import Viewer

__all__ = ["Viewers"]


class Viewers:
    """Several viewers, each of which shows every n-th state."""

    def __init__(self, viewers: Iterable[Viewer], every: int = 1) -> None:
        """Store the viewers.

        Args:
            viewers: Viewers that show the same states.
            every: Number of states from one that is shown to the next.
        """
        self._viewers = list(viewers)
        self._every = every
        self._count = 0
        self._stack = ExitStack()

    def show(self, state: State, gradient: Tensor | None = None) -> None:
        """Show the next state, and the gradient of a loss by its positions."""
        if self._count % self._every == 0:
            for viewer in self._viewers:
                viewer.show(state, gradient)
        self._count += 1

    def __enter__(self) -> Viewers:
        """Open all viewers."""
        for viewer in self._viewers:
            self._stack.enter_context(viewer)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish all viewers."""
        self._stack.__exit__(kind, error, trace)
