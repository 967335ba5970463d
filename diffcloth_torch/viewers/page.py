"""Pages of the browser that play a motion, from a server during the simulation, or from a file."""

from __future__ import annotations

import html
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, TypeVar

import numpy as np

from diffcloth_torch.checks import check_count
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.extras import from_extra
from diffcloth_torch.files import replace_file
from diffcloth_torch.viewers.guard import guarded_server, offline
from diffcloth_torch.viewers.look import Camera
from diffcloth_torch.viewers.motion import LAYERS, Motion

__all__ = ["DEFAULT_CAMERA", "VECTORS", "Drawn", "Page"]

P = TypeVar("P", bound="Page")

DEFAULT_CAMERA = Camera()

VECTORS = ("forces", "gradient")
"""Arrows: contact forces on all surfaces, and the gradient of a loss by the cloths' vertices."""

_HEIGHT = 480  # pixels of a page inside a notebook
_SHORTEST_WAIT = 0.01  # seconds between two moments of the page
_SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)


class Drawn(Protocol):
    """The nodes of a viser scene, and one moment in them."""

    def draw(self, k: int, layer: str, vectors: Sequence[str]) -> None:
        """Show moment k with a coloring of the cloths, and with these arrows."""
        ...

    def prepare(self, layer: str) -> None:
        """Add the colored cloths of all moments, hidden."""
        ...

    def aim(self, server: Any, camera: Camera) -> None:
        """Move the camera of the page to the position of the camera of pictures."""
        ...


class Page(ABC):
    """A page with a slider of the moments, play, speed, coloring of the cloths and arrows.

    By default, its server listens on this machine alone; it answers only requests of its own page.
    """

    vectors: tuple[str, ...] = VECTORS

    def __init__(
        self,
        *,
        host: str,
        port: int,
        camera: Camera,
        color: str,
        arrows: Sequence[str],
        file: Path | None,
        live: bool,
    ) -> None:
        """Check that pages can be made; the server starts with the first state.

        Args:
            host: Address of the server.
            port: Port of the server, or the next free one.
            camera: Initial camera.
            color: Initial coloring of the cloths, one of `LAYERS`.
            arrows: The `vectors` that are shown at first.
            file: File to which the page is written at the end.
            live: If true, the context manager runs the server from the first state on, and at the
                end until the user presses Enter.

        Raises:
            InvalidInput: If a package is missing, or an argument is not accepted.
        """
        self._viser = from_extra("viser", "viewer", "pages of the browser need viser")
        check_count("show: `port`", port, 0, 65535)
        if color not in LAYERS:
            raise InvalidInput(f"show: `color` must be one of {', '.join(LAYERS)}, got {color!r}")
        for arrow in arrows:
            if arrow not in self.vectors:
                raise InvalidInput(
                    f"show: `arrows` must be of {', '.join(self.vectors)}, got {arrow!r}"
                )
        self._host, self._port = host, port
        self._camera, self._file = camera, file
        self._color, self._arrow_names, self._live = color, tuple(arrows), live
        self._lock = threading.RLock()  # of the content: a user may move a slider meanwhile
        self._server: Any = None
        self._drawing: Drawn | None = None
        self._closed = threading.Event()

    @property
    @abstractmethod
    def moments(self) -> Motion:
        """The motion whose moments are on the slider."""

    @abstractmethod
    def _draw_on(self, api: Any) -> Drawn:
        """Make the nodes of the shown scene in a viser server."""

    @property
    def url(self) -> str:
        """Address of the page; starts the server if necessary."""
        server = self._serving()
        return f"http://{server.get_host()}:{server.get_port()}"

    def wait(self) -> None:
        """Keep the page until `close`, or until the user interrupts the program."""
        self._serving()
        try:
            self._closed.wait()
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """Stop the server."""
        self._closed.set()
        with self._lock:
            if self._server is not None:
                _stop(self._server)
                self._server, self._drawing = None, None

    def save(self, path: str | Path, *, speed: float = 1.0) -> None:
        """Write a page that plays the motion alone, without a server or a connection.

        Args:
            path: File to write, in an existing folder; an existing file is replaced.
            speed: Speed of the motion relative to real time.
        """
        page = self._page(speed)
        with replace_file(Path(path)) as part:
            part.write_text(page, encoding="utf-8")

    def _repr_html_(self) -> str:
        page = html.escape(self._page(1.0), quote=True)
        return (
            f'<iframe srcdoc="{page}" width="100%" height="{_HEIGHT}" style="border:none"></iframe>'
        )

    def __enter__(self: P) -> P:
        """Start the server if the viewer is live."""
        if self._live:
            print(f"The page is at {self.url}", file=sys.stderr)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Write the file, also after a failed step; a live page stays until the user ends it."""
        if self.moments and (kind is None or issubclass(kind, SimulationError)):
            if self._file is not None:
                self.save(self._file)
            if self._live:
                input(f"The page at {self.url} stays until you press Enter")
        self.close()

    def _page(self, speed: float) -> str:
        if not self.moments:
            raise InvalidInput("show: there must be at least one state")
        # A separate server: the one of the page continues.
        server = self._start("127.0.0.1")
        try:
            drawing = self._draw_on(server.scene)
            drawing.draw(0, "plain", ())
            drawing.prepare(self._color)
            drawing.aim(server, self._camera)
            recorder = server.get_scene_serializer()
            times = [moment.time for moment in self.moments]
            for k, wait in enumerate(np.diff([*times, times[-1]])):
                drawing.draw(k, self._color, self._arrow_names)
                recorder.insert_sleep(max(float(wait) / speed, 0.0))
            page = offline(recorder.as_html())
        finally:
            _stop(server)
        return page

    def _start(self, host: str) -> Any:
        with _silently():
            return guarded_server(self._viser, host, self._port)

    def _serving(self) -> Any:
        with self._lock:
            if self._server is None:
                self._closed.clear()
                self._server = self._start(self._host)
                self._add_controls(self._server.gui)
                if self.moments:
                    self._extend()
                threading.Thread(target=self._play, args=(self._server,), daemon=True).start()
            return self._server

    def _add_controls(self, gui: Any) -> None:
        self._moment = gui.add_slider("moment", 0, max(len(self.moments) - 1, 1), 1, 0)
        self._time = gui.add_text("time [s]", "0", disabled=True)
        self._playing = gui.add_checkbox("play", initial_value=True)
        self._speed = gui.add_dropdown("speed", [str(s) for s in _SPEEDS], initial_value="1.0")
        self._layer = gui.add_dropdown("color", LAYERS, initial_value=self._color)
        self._vectors = {
            name: gui.add_checkbox(f"arrows: {name}", initial_value=name in self._arrow_names)
            for name in self.vectors
        }
        for control in (self._moment, self._layer, *self._vectors.values()):
            control.on_update(lambda _: self._draw())

    def _extend(self) -> None:
        """Add a new moment to the page."""
        if self._drawing is None:
            self._drawing = self._draw_on(self._server.scene)
            self._draw()
            self._drawing.aim(self._server, self._camera)
        follows = self._moment.value >= len(self.moments) - 2
        self._moment.max = max(len(self.moments) - 1, 1)
        if follows:
            self._moment.value = len(self.moments) - 1

    def _draw(self) -> None:
        with self._lock:
            if self._drawing is None or self._server is None:
                return
            k = min(int(self._moment.value), len(self.moments) - 1)
            self._time.value = f"{self.moments[k].time:.3f}"
            vectors = [name for name, box in self._vectors.items() if box.value]
            with self._server.atomic():
                self._drawing.draw(k, self._layer.value, vectors)

    def _play(self, server: Any) -> None:
        """Move from moment to moment while the page of a server plays."""
        while True:
            with self._lock:
                if self._server is not server:  # the lock prevents a later stop
                    return
                k, count = int(self._moment.value), len(self.moments)
                wait = _SHORTEST_WAIT
                if self._playing.value and count > 1:
                    after = (k + 1) % count
                    step = self.moments[after].time - self.moments[min(k, count - 1)].time
                    wait = max(step / float(self._speed.value), _SHORTEST_WAIT)
                    self._moment.value = after
            time.sleep(wait)


def _stop(server: Any) -> None:
    with _silently():
        server.stop()


@contextmanager
def _silently() -> Iterator[None]:
    """Suppress the announcements of servers, which notebooks show below cells."""
    from rich import get_console

    console = get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
