"""A progress bar over the iterations of an optimization, or over all of their steps."""

from __future__ import annotations

from typing import Any

from tqdm import tqdm

__all__ = ["Progress"]


class Progress:
    """A progress bar as a context manager; hidden if the output is not a terminal."""

    def __init__(self, iterations: int, steps: int = 1, unit: str = "iteration") -> None:
        """Count `iterations` of `steps` units each."""
        self._steps = steps
        self._iterations = 0
        self._texts: dict[str, str] = {}
        # disable=None: quiet if the output is not a terminal.
        self._bar: tqdm[Any] = tqdm(
            total=steps * iterations, desc="optimize", unit=unit, disable=None
        )

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def start(self, iterations: int) -> None:
        """Continue after the given number of iterations."""
        self._iterations = iterations
        self._bar.initial = self._bar.n = iterations * self._steps

    def step(self, k: int) -> None:
        """Show that the steps before step k of this iteration are done."""
        self._bar.n = self._iterations * self._steps + k
        self._bar.update(0)

    def done(self, loss: float, best: float) -> None:
        """Show that an iteration is done."""
        self._iterations += 1
        self._texts |= {"loss": f"{loss:.5f}", "best": f"{best:.5f}"}
        self._show()

    def failed(self, count: int) -> None:
        """Show how many attempts have failed."""
        self._texts["failed"] = str(count)
        self._show()

    def _show(self) -> None:
        self._bar.n = self._iterations * self._steps
        self._bar.set_postfix(self._texts, refresh=False)
        self._bar.refresh()
