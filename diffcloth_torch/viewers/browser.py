"""A viewer in the browser: a page that plays states as they arrive, and a file that plays them."""

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
    """Shows states on a page of the browser, and writes them to a file that is a page of its own.

    The page has a slider of the moments, play, speed, coloring of the cloths and arrows. By
    default, its server listens on this machine alone.
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
            host: Address of the server.
            port: Port of the server, or the next free one.
            paints: Name of a cloth, a body or a robot -> its colors.
            goals: Target shapes to show.
            camera: Initial camera.
            color: Initial coloring of the cloths, one of `LAYERS`.
            arrows: The `VECTORS` that are shown at first.
            file: File to which the page is written at the end.
            live: If true, the context manager runs the server from the first state on, and at the
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
        """Store a state, and show it if the page follows.

        Args:
            state: State with or without a batch axis; several environments are shown side by side.
            gradient: Gradient of a loss by the positions, of the same shape.
        """
        with self._lock:
            self.motion.add(state, gradient)
            if self._server is not None:
                self._extend()

    def _draw_on(self, api: Any) -> Drawing:
        return Drawing(api, self._shown, self.motion, self._goals)
