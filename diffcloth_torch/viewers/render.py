"""Pictures of a scene and its states, in one call and without a configuration."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import torch

from diffcloth_torch.checks import POSITIVE, check_count, check_number
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import as_path
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State, check_state
from diffcloth_torch.viewers.look import Camera, Pictures, checked_camera
from diffcloth_torch.viewers.record import Record

__all__ = ["checked_states", "render"]

_ONE_STATE_FPS = 25.0


def render(
    scene: Scene,
    states: State | Sequence[State],
    path: str | Path,
    *,
    size: Sequence[int] = Pictures.size,
    fps: float | None = None,
    moments: int = Pictures.sheet,
    labels: bool = True,
    contact_forces: bool = False,
    camera: Camera | None = None,
) -> None:
    """Draw states: an animation (.mp4, .gif), or an overview of some moments (.png).

    >>> dc.render(scene, [start, *states], "motion.mp4")
    >>> dc.render(scene, states[-1], "end.png", contact_forces=True)

    Args:
        scene: Scene of the states.
        states: States in the order of time, without a batch axis.
        path: File to write, in an existing folder; an existing file is replaced.
        size: Width and height of a picture [pixels], even numbers from 64 to 4096.
        fps: Pictures per second of an animation, > 0; None: real time.
        moments: Number of pictures in an overview, from the first state to the last, >= 1.
        labels: If true, pictures show the time and a legend.
        contact_forces: If true, arrows show the contact forces on bodies and links
            (`State.body_forces`).
        camera: The camera; None: a view from the front, slightly from above.

    Raises:
        InvalidInput: If an argument is not accepted, or if a package is missing; the message
            contains the command that installs it.
        TypeError: If `states` contains other objects than states.
    """
    path = as_path("render: `path`", path)
    kind = path.suffix.lower().removeprefix(".")
    if kind not in ("mp4", "gif", "png"):
        raise InvalidInput(f"render: `path` must end in .mp4, .gif or .png, got {str(path)!r}")
    if not path.parent.is_dir():
        raise InvalidInput(f"render: the folder of `path` must exist, got {str(path)!r}")
    shown = checked_states("render", scene, states)
    given: object = size
    if (
        not isinstance(given, Sequence)
        or [*map(type, size)] != [int, int]
        or any(n % 2 or not 64 <= n <= 4096 for n in size)
    ):
        raise InvalidInput(f"render: `size` must be two even numbers in 64 .. 4096, got {size}")
    moments = check_count("render: `moments`", moments, 1)
    if fps is not None:
        fps = check_number("render: `fps`", fps, POSITIVE)

    video: Literal["mp4", "gif", "none"] = "mp4" if kind == "mp4" else "gif"
    pictures = Pictures(
        size=size,
        video="none" if kind == "png" else video,
        sheet=moments if kind == "png" else 0,
        labels=labels,
        contact_forces=contact_forces,
        camera=checked_camera("render", camera),
    )
    real_time = _real_time(shown)
    with Record(
        path.parent,
        scene,
        fps=real_time if fps is None else fps,
        pictures=pictures,
        name=path.stem,
    ) as record:
        for state in shown:
            record.show(state)


def checked_states(
    owner: str, scene: Scene, states: State | Sequence[State], *, batches: bool = False
) -> list[State]:
    """Return a list of states; refuse states of other scenes.

    Args:
        owner: Prefix of messages.
        scene: The scene.
        states: One state or several.
        batches: If true, states may have a batch axis, of the same size for all.

    Raises:
        InvalidInput: If there is no state, or one has another shape.
        TypeError: If an item is not a State.
    """
    given: object = states
    if not isinstance(given, State | Iterable):
        raise TypeError(f"{owner}: `states` must be states, got {type(given).__name__}")
    states = [states] if isinstance(states, State) else list(states)
    if not states:
        raise InvalidInput(f"{owner}: `states` must hold at least one state")
    shown: object = scene
    if not isinstance(shown, Scene):
        raise TypeError(f"{owner}: `scene` must be a Scene, got {type(shown).__name__}")
    vertices = sum(len(cloth.vertices) for cloth in scene.cloths)
    joints = sum(len(robot.joint_names) for robot in scene.robots)
    links = [link for robot in scene.robots for link in robot.contact_surfaces if link is not None]
    rigid = [*(body.contact_surface for body in scene.bodies), *links]
    touching = sum(len(surface.vertices) for surface in rigid)
    for i, state in enumerate(states):
        if not isinstance(state, State):
            raise TypeError(
                f"{owner}: `states` must be states, got {type(state).__name__} at [{i}]"
            )
        check_state(f"{owner}: `states`[{i}]", state)
        size = state.batch_size
        if size is not None and not batches:
            raise InvalidInput(f"{owner}: states[{i}] is a batch; take one of it by its index")
        if size != states[0].batch_size:
            raise InvalidInput(
                f"{owner}: states[{i}] must be a batch of {states[0].batch_size} as states[0] is, "
                f"got {size}"
            )
        lead = () if size is None else (size,)
        shapes = {
            "positions": (*lead, vertices, 3),
            "body_poses": (*lead, len(scene.bodies), 7),
            "joint_positions": (*lead, joints),
            "base_poses": (*lead, len(scene.robots), 7),
            "body_forces": (*lead, touching, 3),
        }
        for name, shape in shapes.items():
            got = tuple(getattr(state, name).shape)
            if got != shape:
                raise InvalidInput(
                    f"{owner}: states[{i}] must be of this scene, whose `{name}` have shape "
                    f"{list(shape)}, got {list(got)}"
                )
            if not torch.isfinite(getattr(state, name)).all():
                raise InvalidInput(f"{owner}: states[{i}] must be finite, its `{name}` are not")
    return states


def _real_time(states: Sequence[State]) -> float:
    """Pictures per second for an animation in real time."""
    duration = float(states[-1].time) - float(states[0].time)
    return (len(states) - 1) / duration if duration > 0 else _ONE_STATE_FPS
