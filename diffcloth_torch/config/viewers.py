"""From a configuration to its viewers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from diffcloth_torch.config.schema import RunConfig
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.viewers.look import Camera, Goal, Paint, Pictures
from diffcloth_torch.viewers.meshes import MeshSequence
from diffcloth_torch.viewers.record import Record
from diffcloth_torch.viewers.several import Viewers
from diffcloth_torch.viewers.viewer import Viewer

__all__ = ["VIEWERS", "open_viewers"]


def open_viewers(
    config: RunConfig, scene: Scene, folder: Path, goals: Sequence[Goal] = ()
) -> Viewers:
    """Make the viewers of a configuration.

    Args:
        config: The configuration.
        scene: The scene that was built from it.
        folder: Existing folder for their files.
        goals: Shapes to show beside the scene.
    """
    output = config.output
    made = [make(config, scene, folder, goals) for name, make in VIEWERS if name in output.viewers]
    return Viewers(made, output.every)


def _record(config: RunConfig, scene: Scene, folder: Path, goals: Sequence[Goal]) -> Viewer:
    paints = {cloth.name: Paint(cloth.color, cloth.back_color) for cloth in config.scene.cloths}
    paints |= {body.name: Paint(body.color) for body in config.scene.bodies}
    paints |= {robot.name: Paint(robot.color) for robot in config.scene.robots}
    options = config.output.pictures.model_dump()
    return Record(
        folder,
        scene,
        fps=1 / (config.simulation.dt * config.output.every),
        pictures=Pictures(**{**options, "camera": Camera(**options["camera"])}),
        paints=paints,
        goals=goals,
    )


def _meshes(_config: RunConfig, _scene: Scene, folder: Path, _goals: Sequence[Goal]) -> Viewer:
    return MeshSequence(folder / "meshes")


VIEWERS: tuple[tuple[str, Callable[[RunConfig, Scene, Path, Sequence[Goal]], Viewer]], ...] = (
    ("record", _record),
    ("meshes", _meshes),
)
"""Name in a configuration, and what makes the viewer; shown in this order."""
