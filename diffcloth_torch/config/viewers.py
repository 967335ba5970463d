"""The viewers of a configuration."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from diffcloth_torch.config.schema import RunConfig
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.viewers.browser import Browser
from diffcloth_torch.viewers.fitted import FittedPage
from diffcloth_torch.viewers.look import Camera, Goal, Paint, Pictures
from diffcloth_torch.viewers.meshes import MeshSequence
from diffcloth_torch.viewers.record import Record
from diffcloth_torch.viewers.several import Viewers
from diffcloth_torch.viewers.viewer import Viewer

__all__ = ["ANIMATION", "VIEWERS", "open_fitted", "open_viewers"]

ANIMATION = "animation.html"
"""File of the viewer `web` in a folder of results."""


def open_viewers(
    config: RunConfig, scene: Scene, folder: Path, goals: Sequence[Goal] = ()
) -> Viewers:
    """Make the viewers of a configuration.

    Args:
        config: The configuration.
        scene: The scene of the configuration.
        folder: Existing folder for their files.
        goals: Target shapes to show.
    """
    output = config.output
    made = [make(config, scene, folder, goals) for name, make in VIEWERS if name in output.viewers]
    return Viewers(made, output.every)


def open_fitted(config: RunConfig, scenes: Sequence[Scene], folder: Path) -> FittedPage | None:
    """Make the page of a fit, if the configuration requests one.

    Args:
        config: The configuration.
        scenes: The scene of each of its trajectories.
        folder: Existing folder for its file.
    """
    if "web" not in config.output.viewers:
        return None
    return FittedPage(
        scenes,
        paints=_paints(config),
        camera=Camera(**config.output.pictures.model_dump()["camera"]),
        file=folder / ANIMATION,
        live=_is_watched(),
    )


def _is_watched() -> bool:
    return sys.stdin.isatty() and sys.stderr.isatty()


def _paints(config: RunConfig) -> dict[str, Paint]:
    paints = {cloth.name: Paint(cloth.color, cloth.back_color) for cloth in config.scene.cloths}
    paints |= {body.name: Paint(body.color) for body in config.scene.bodies}
    return paints | {robot.name: Paint(robot.color) for robot in config.scene.robots}


def _record(config: RunConfig, scene: Scene, folder: Path, goals: Sequence[Goal]) -> Viewer:
    options = config.output.pictures.model_dump()
    return Record(
        folder,
        scene,
        fps=1 / (config.simulation.dt * config.output.every),
        pictures=Pictures(**{**options, "camera": Camera(**options["camera"])}),
        paints=_paints(config),
        goals=goals,
    )


def _meshes(_config: RunConfig, _scene: Scene, folder: Path, _goals: Sequence[Goal]) -> Viewer:
    return MeshSequence(folder / "meshes")


def _web(config: RunConfig, scene: Scene, folder: Path, goals: Sequence[Goal]) -> Viewer:
    pictures = config.output.pictures
    return Browser(
        scene,
        paints=_paints(config),
        goals=goals,
        camera=Camera(**pictures.model_dump()["camera"]),
        # Only an optimization has gradients; otherwise there are no such arrows.
        arrows=["forces", "gradient"] if pictures.contact_forces else ["gradient"],
        file=folder / ANIMATION,
        live=_is_watched(),
    )


VIEWERS: tuple[tuple[str, Callable[[RunConfig, Scene, Path, Sequence[Goal]], Viewer]], ...] = (
    ("record", _record),
    ("meshes", _meshes),
    ("web", _web),
)
"""Name in a configuration, and function that makes the viewer; shown in this order."""
