"""A viewer in the browser: a page that plays states while they come, and a file that plays them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from torch import Tensor

from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.viewers.drawing import Drawing
from diffcloth_torch.viewers.look import Camera, Goal, Paint
from diffcloth_torch.viewers.motion import Motion
from diffcloth_torch.viewers.page import DEFAULT_CAMERA, Page
from diffcloth_torch.viewers.shown import Shown

__all__ = ["Browser"]


class Browser(Page):
    """Shows the states that it gets on a page of the browser, and writes them to a page of its own.

    The page has a slider of the moments, play, speed, what colors the cloths and which arrows are
    shown. Its server listens on this machine alone unless told otherwise.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        paints: Mapping[str, Paint] = MappingProxyType({}),
        goals: Sequence[Goal] = (),
        camera: Camera = DEFAULT_CAMERA,
        color: str = "plain",
        arrows: Sequence[str] = (),
        file: Path | None = None,
        live: bool = False,
    ) -> None:
        """Check that pages can be made; the server starts with the first state.

        Args:
            scene: The scene to show.
            host: Address that the server listens on.
            port: Its port, or the next one that is free.
            paints: Name of a cloth, a body or a robot -> its colors.
            goals: Shapes to show beside the scene.
            camera: The camera at first.
            color: What colors the cloths at first, one of `LAYERS`.
            arrows: Which of `VECTORS` are shown at first.
            file: A page that is written at the end.
            live: As a context manager, whether the server runs from the first state on, and at the
                end until the user presses Enter.

        Raises:
            InvalidInput: If a package is missing, or an argument is not accepted.
        """
        super().__init__(
            host=host, port=port, camera=camera, color=color, arrows=arrows, file=file, live=live
        )
        self._shown = Shown(scene, paints)
        self._goals = tuple(goals)
        self.motion = Motion(self._shown)

    @property
    def moments(self) -> Motion:
        """The motion whose moments are on the slider."""
        return self.motion

    def show(self, state: State, gradient: Tensor | None = None) -> None:
        """Keep a state, and show it if the page follows.

        Args:
            state: With or without a batch axis: several environments stand side by side.
            gradient: Gradient of a loss by its positions, of their shape.
        """
        with self._lock:
            self.motion.add(state, gradient)
            if self._server is not None:
                self._extend()

    def _draw_on(self, api: Any) -> Drawing:
        return Drawing(api, self._shown, self.motion, self._goals)
