"""Pictures of a simulation: an animation, an overview of its moments, and single frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.viewers.labels import Entry, legend_strip, overview, write_time
from diffcloth_torch.viewers.look import FORCE_COLOR, GOAL_COLOR, Goal, Paint, Pictures
from diffcloth_torch.viewers.shown import Bounds, Shown
from diffcloth_torch.viewers.stage import Skin, Stage, require_pyvista

__all__ = ["Record"]

Image = NDArray[np.uint8]

_DEFAULT_PICTURES = Pictures()

_LONGEST_ARROW = 0.2  # fraction of the scene's size, for the largest force
_GIF_STEP = 2  # a GIF keeps one of this many pixels along each axis


class Record:
    """Stores states, and draws them at the end, when the whole motion is known.

    The files are `NAME.mp4` or `NAME.gif`, `NAME.png` (an overview of some moments), and optionally
    `NAME_frames/0000.png` and so on.
    """

    def __init__(
        self,
        folder: Path,
        scene: Scene,
        *,
        fps: float,
        pictures: Pictures = _DEFAULT_PICTURES,
        paints: Mapping[str, Paint] = MappingProxyType({}),
        goals: Sequence[Goal] = (),
        name: str = "animation",
    ) -> None:
        """Check that pictures can be made, before a long simulation.

        Args:
            folder: Existing folder for the files.
            scene: The scene to show.
            fps: Pictures per second, unless `pictures` sets them.
            pictures: Options of the pictures.
            paints: Name of a cloth, a body or a robot -> its colors.
            goals: Target shapes to show.
            name: Name of the files.

        Raises:
            InvalidInput: If a package is missing; the message contains the command that installs
                it.
        """
        require_pyvista()
        for kind in (pictures.video, "png" if pictures.sheet else "none"):
            file = folder / f"{name}.{kind}"
            if kind != "none" and file.is_dir():
                raise InvalidInput(f"pictures: {file} must be no folder")
        self._options = pictures
        _require_writer(self._options.video)
        self._folder, self._scene, self._name = folder, scene, name
        self._goals = goals
        self._shown = Shown(scene, paints)
        self._fps = fps if self._options.fps is None else self._options.fps
        self._positions: list[NDArray[np.float64]] = []
        self._frames: list[NDArray[np.float64]] = []
        self._times: list[float] = []
        self._forces: list[NDArray[np.float64]] = []

    def show(self, state: State, gradient: Tensor | None = None) -> None:
        """Store one state; pictures show no gradients."""
        self._positions.append(state.positions.detach().numpy().copy())
        self._frames.append(self._shown.frames(state))
        self._times.append(float(state.time))
        if self._options.contact_forces:
            self._forces.append(self._shown.forces(state))

    def __enter__(self) -> Record:
        """Return the recorder; nothing needs to be opened."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Draw all states; also after a failed step, to show the motion before it."""
        if self._positions and (kind is None or issubclass(kind, SimulationError)):
            self._draw_all()

    def _draw_all(self) -> None:
        count = len(self._positions)
        moments = {round(i) for i in np.linspace(0, count - 1, self._options.sheet)}
        all_are_kept = self._options.frames or self._options.video != "none"
        step = float(np.diff(self._times).min(initial=1.0))
        bounds = self._shown.bounds(self._positions, self._frames, self._goals)
        low, high = bounds
        arrows, entries = self._arrows(float(np.linalg.norm(high - low)))
        labels = self._options.labels
        # The legend is a part of each picture, except in an overview, where it has a cell.
        legend = None
        if labels and (all_are_kept or len(moments) == 1):
            legend = legend_strip(self._options.size, entries)
        sheet = []
        with self._stage(bounds, legend) as stage, self._writer() as writer:
            drawn = range(count) if all_are_kept else sorted(moments)
            for k in tqdm(drawn, desc="draw", unit="frame", disable=None):
                image = stage.draw(
                    self._positions[k], self._shown.placed(self._frames[k]), arrows[k]
                )
                if labels:
                    image = write_time(image, self._times[k], step)
                if k in moments:
                    sheet.append(image)
                if all_are_kept:
                    writer(k, _with(legend, image))
        if len(sheet) == 1:
            _write_image(self._folder / f"{self._name}.png", _with(legend, sheet[0]))
        elif sheet:
            image = overview(sheet, entries if labels else [])
            _write_image(self._folder / f"{self._name}.png", image)

    def _arrows(self, size: float) -> tuple[Sequence[FloatArray | None], list[Entry]]:
        """Arrows [m] of each state if forces are shown, and all entries of the legend."""
        entries = []
        for name, paint in self._shown.paints.items():
            colors = [color for color in (paint.color, paint.back_color) if color is not None]
            sides = " (front, back)" if len(colors) > 1 else ""
            entries.append(Entry(name + sides, tuple(colors)))
        if self._goals:
            entries.append(Entry("target", (GOAL_COLOR,)))
        if not self._options.contact_forces:
            return [None] * len(self._positions), entries
        norms = [np.linalg.norm(forces, axis=1).max(initial=0.0) for forces in self._forces]
        largest = float(max(norms))
        entries.append(Entry(f"contact force, longest {largest:.3g} N", (FORCE_COLOR,)))
        scale = _LONGEST_ARROW * size / largest if largest > 0 else 0.0
        return [scale * forces for forces in self._forces], entries

    def _stage(self, bounds: Bounds, legend: Image | None) -> Stage:
        shown, ground = self._shown, self._options.ground
        width, height = self._options.size
        cloths = zip(shown.cloth_faces, shown.cloth_starts, self._scene.cloth_names, strict=False)
        stage = Stage(
            [Skin(faces + start, shown.paints[name]) for faces, start, name in cloths],
            [Skin(r.faces.numpy(), shown.paints[r.owner]) for r in shown.shown_rigid],
            size=(width, height if legend is None else height - len(legend)),
            bounds=bounds,
            ground=shown.ground(bounds) if ground == "auto" else ground,
            camera=self._options.camera,
        )
        for goal in self._goals:
            stage.add_goal(goal)
        return stage

    @contextmanager
    def _writer(self) -> Iterator[Any]:
        """Yield a function (index, image) that adds a picture to the files."""
        import imageio.v2 as imageio

        frames = self._folder / f"{self._name}_frames"
        if self._options.frames:
            frames.mkdir(exist_ok=True)
            for old in frames.glob("*.png"):
                old.unlink()
        video: Any = None
        if self._options.video == "mp4":
            video = imageio.get_writer(
                self._folder / f"{self._name}.mp4",
                fps=self._fps,
                codec="libx264",
                quality=8,
                macro_block_size=2,
            )
        elif self._options.video == "gif":
            video = imageio.get_writer(
                self._folder / f"{self._name}.gif", duration=1000 / self._fps, loop=0
            )
        step = _GIF_STEP if self._options.video == "gif" else 1

        def add(index: int, image: Image) -> None:
            if self._options.frames:
                _write_image(frames / f"{index:04d}.png", image)
            if video is not None:
                video.append_data(image[::step, ::step])

        try:
            yield add
        finally:
            if video is not None:
                video.close()


def _with(legend: Image | None, image: Image) -> Image:
    return image if legend is None else np.concatenate([image, legend])


def _require_writer(video: str) -> None:
    needed = ["imageio", *(["imageio_ffmpeg"] if video == "mp4" else [])]
    for module in needed:
        if find_spec(module) is None:
            raise InvalidInput(
                f"the animation needs {module.replace('_', '-')}: run  pip install "
                "'diffcloth-torch[viewer]'  or change it with  --set output.pictures.video=gif  "
                "or  --set output.pictures.video=none"
            )


def _write_image(path: Path, image: Image) -> None:
    import imageio.v2 as imageio

    imageio.imwrite(path, image)
