"""A page of the browser that shows a fit: observations beside the simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.viewers.drawing import Drawing
from diffcloth_torch.viewers.look import Camera, Paint
from diffcloth_torch.viewers.motion import Motion
from diffcloth_torch.viewers.page import DEFAULT_CAMERA, Page
from diffcloth_torch.viewers.shown import Shown

__all__ = ["FittedPage", "Track"]

_COLOR = (230, 85, 13)  # of observations
_POINT, _LINE = 0.012, 0.005  # fractions of the scene's size: widths of a point, and of an outline
_BETWEEN = 8  # points of an outline from one corner to the next


@dataclass(frozen=True, eq=False)
class Track:
    """One trajectory.

    Attributes:
        states: Simulated states, without a batch axis.
        observed: For each state the observed points [m], shape [n, 3], NaN for missing ones; or the
            corners of an outline seen from above, shape [n, 2].
    """

    states: Sequence[State]
    observed: Sequence[FloatArray]

    @property
    def is_outline(self) -> bool:
        """Return whether outlines were observed."""
        return bool(self.observed[0].shape[1] == 2)

    def points(self) -> list[FloatArray]:
        """Points to draw of each state, [n, 3]."""
        return [
            _outline(seen, float(state.positions[:, 2].min()))
            if self.is_outline
            else seen[~np.isnan(seen).any(axis=1)]
            for seen, state in zip(self.observed, self.states, strict=True)
        ]


class FittedPage(Page):
    """Shows the trajectories of a fit side by side, each with its observations.

    Every `show` replaces the previous trajectories, while the page plays. A moment is one
    observation.
    """

    vectors = ("forces",)

    def __init__(
        self,
        scenes: Sequence[Scene],
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        paints: Mapping[str, Paint] = MappingProxyType({}),
        camera: Camera = DEFAULT_CAMERA,
        file: Path | None = None,
        live: bool = False,
    ) -> None:
        """Check that pages can be made; the server starts with the first fit.

        Args:
            scenes: The scene of each trajectory.
            host: Address of the server.
            port: Port of the server, or the next free one.
            paints: Name of a cloth, a body or a robot -> its colors.
            camera: Initial camera.
            file: File to which the page is written at the end.
            live: If true, the context manager runs the server from the first fit on, and at the end
                until the user presses Enter.

        Raises:
            InvalidInput: If a package is missing.
        """
        super().__init__(
            host=host, port=port, camera=camera, color="plain", arrows=(), file=file, live=live
        )
        self._shown = [Shown(scene, paints) for scene in scenes]
        self._motions = [Motion(shown) for shown in self._shown]
        self._points: list[list[FloatArray]] = []
        self._widths: list[float] = []
        self._said = ""
        self._text: Any = None

    @property
    def moments(self) -> Motion:
        """The motion whose moments are on the slider: the longest one."""
        return max(self._motions, key=len)

    @property
    def points(self) -> list[list[FloatArray]]:
        """The drawn points of the observations, for each trajectory and state, [n, 3] each."""
        return self._points

    def show(self, tracks: Sequence[Track], text: str = "") -> None:
        """Replace the shown trajectories.

        Args:
            tracks: One for each scene.
            text: Text on the page about them, in Markdown.

        Raises:
            InvalidInput: If their number differs from the number of scenes.
        """
        if len(tracks) != len(self._shown):
            raise InvalidInput(
                f"show: `tracks` must be one for each of {len(self._shown)} scenes, got "
                f"{len(tracks)}"
            )
        motions = [Motion(shown) for shown in self._shown]
        for motion, track in zip(motions, tracks, strict=True):
            for state in track.states:
                motion.add(state)
        with self._lock:
            self._motions, self._said = motions, text
            self._points = [track.points() for track in tracks]
            self._widths = [_LINE if track.is_outline else _POINT for track in tracks]
            if isinstance(self._drawing, _Beside):
                self._drawing.restart(motions, self._points)
                self._draw()
            if self._server is not None:
                self._text.content = text
                self._extend()

    def _add_controls(self, gui: Any) -> None:
        self._text = gui.add_markdown(self._said)
        super()._add_controls(gui)

    def _draw_on(self, api: Any) -> _Beside:
        return _Beside(api, self._shown, self._motions, self._points, self._widths)


class _Beside:
    """Drawings of several scenes side by side, with points of their observations."""

    def __init__(
        self,
        api: Any,
        shown: Sequence[Shown],
        motions: Sequence[Motion],
        points: Sequence[Sequence[FloatArray]],
        widths: Sequence[float],
    ) -> None:
        ends = [corner for motion in motions for corner in motion.bounds(())]
        ends += [cloud for clouds in points for cloud in clouds]
        every = np.concatenate([np.atleast_2d(end) for end in ends])
        bounds = (every.min(axis=0), every.max(axis=0))
        self._api, self._points = api, points
        size = float(np.linalg.norm(bounds[1] - bounds[0]))
        self._widths = [size * width for width in widths]
        self._clouds: dict[int, Any] = {}
        self._drawings = [
            Drawing(api, s, m, (), bounds=bounds, first=i, places=len(shown))
            for i, (s, m) in enumerate(zip(shown, motions, strict=True))
        ]
        self._lengths = [len(motion) for motion in motions]

    def restart(self, motions: Sequence[Motion], points: Sequence[Sequence[FloatArray]]) -> None:
        """Draw other motions of the same scenes from now on."""
        for drawing, motion in zip(self._drawings, motions, strict=True):
            drawing.restart(motion)
        self._lengths, self._points = [len(motion) for motion in motions], points

    def aim(self, server: Any, camera: Camera) -> None:
        self._drawings[0].aim(server, camera)

    def prepare(self, layer: str) -> None:
        for drawing in self._drawings:
            drawing.prepare(layer)

    def draw(self, k: int, layer: str, vectors: Sequence[str]) -> None:
        for i, drawing in enumerate(self._drawings):
            moment = min(k, self._lengths[i] - 1)  # a shorter trajectory waits at its end
            drawing.draw(moment, layer, vectors)
            self._show_points(i, drawing.root(0), self._points[i][moment].astype(np.float32))

    def _show_points(self, i: int, root: str, points: Any) -> None:
        known = self._clouds.get(i)
        if known is not None:
            known.points, known.visible = points, bool(len(points))
        elif len(points):
            self._clouds[i] = self._api.add_point_cloud(
                f"{root}/observed",
                points,
                _COLOR,
                point_size=self._widths[i],
                point_shape="circle",
                precision="float32",
            )


def _outline(corners: FloatArray, height: float) -> FloatArray:
    """Points along a closed line at a height."""
    shares = np.arange(_BETWEEN)[:, None] / _BETWEEN
    after = np.roll(corners, -1, axis=0)
    points = (corners[:, None] + shares * (after - corners)[:, None]).reshape(-1, 2)
    return np.column_stack([points, np.full(len(points), height)])
