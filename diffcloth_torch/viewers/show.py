"""States in the browser, in one call and without a configuration."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import as_path
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.viewers.browser import Browser
from diffcloth_torch.viewers.look import Camera, Goal, checked_camera
from diffcloth_torch.viewers.render import checked_states

__all__ = ["show"]


def show(
    scene: Scene,
    states: State | Sequence[State],
    path: str | Path | None = None,
    *,
    color: str = "plain",
    arrows: Sequence[str] = (),
    gradients: Sequence[Tensor] | None = None,
    goals: Sequence[Goal] = (),
    camera: Camera | None = None,
    port: int = 8080,
) -> Browser:
    """Show states in the browser: play, scrub, and view them from all sides.

    >>> dc.show(scene, states, "motion.html")          # a page that needs no server
    >>> dc.show(scene, states, color="strain").wait()  # prints its address, and stays

    In a notebook the page appears below the cell that returns it.

    Args:
        scene: Scene of the states.
        states: States in the order of time; environments of a batch are shown side by side.
        path: File `.html` to write instead of a server; an existing file is replaced.
        color: Coloring of the cloths: "plain", their own colors; "strain", the deviation of the
            singular values of dx/dX from one; or "contact", the contact forces on them [N].
        arrows: Any of "forces", the contact forces on all surfaces, and "gradient".
        gradients: For "gradient": for each state the gradient of a loss by its positions.
        goals: Target shapes to show.
        camera: Initial camera; None: a view from the front, slightly from above.
        port: Port of the server on this machine, or the next free one.

    Returns:
        The page: `url`, `wait()`, `save(path)`, `close()`.

    Raises:
        InvalidInput: If an argument is not accepted, or if a package is missing; the message
            contains the command that installs it.
        TypeError: If `states` contains other objects than states.
    """
    shown = checked_states("show", scene, states, batches=True)
    if gradients is not None and len(gradients) != len(shown):
        raise InvalidInput(
            f"show: `gradients` must be one for each of {len(shown)} states, got {len(gradients)}"
        )
    if "gradient" in arrows and gradients is None:
        raise InvalidInput("show: `arrows` has 'gradient', which needs `gradients`")
    for k, goal in enumerate(goals):
        given: object = goal
        if not isinstance(given, Goal):
            raise TypeError(f"show: `goals[{k}]` must be a Goal, got {type(given).__name__}")
    file = None if path is None else as_path("show: `path`", path)
    if file is not None and (file.suffix != ".html" or not file.parent.is_dir()):
        raise InvalidInput(
            f"show: `path` must end in .html, in an existing folder, got {str(path)!r}"
        )
    browser = Browser(
        scene,
        port=port,
        goals=goals,
        camera=checked_camera("show", camera),
        color=color,
        arrows=arrows,
    )
    for k, state in enumerate(shown):
        browser.show(state, None if gradients is None else gradients[k])
    if file is not None:
        browser.save(file)
    elif not _is_notebook():
        print(f"The page is at {browser.url} until this program ends")
    return browser


def _is_notebook() -> bool:
    """Return whether the returned page is shown below a cell."""
    loaded = sys.modules.get("IPython")  # notebooks have imported it
    shell = None if loaded is None else loaded.get_ipython()
    return type(shell).__name__ == "ZMQInteractiveShell"
