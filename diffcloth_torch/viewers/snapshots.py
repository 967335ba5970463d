"""Pictures of single states of a scene, by a camera that stays open."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.viewers.look import Camera
from diffcloth_torch.viewers.shown import Bounds, Shown
from diffcloth_torch.viewers.stage import Skin, Stage

__all__ = ["Snapshots"]

_ROOM = 0.35  # added to the bounds of the first state on all sides, as a share of its size


class Snapshots:
    """A stage with a fixed camera, which sees the surroundings of the first state.

    Attributes:
        size: Width and height of a picture [pixels].
    """

    def __init__(self, scene: Scene, state: State, *, size: Sequence[int], camera: Camera) -> None:
        """Open the stage.

        Args:
            scene: The scene.
            state: Its first state, without a batch axis.
            size: Width and height [pixels].
            camera: The camera.

        Raises:
            InvalidInput: If pyvista is not installed; the message contains the command that
                installs it.
        """
        self.size = size
        self._shown = Shown(scene, {})
        low, high = self._shown.bounds([_positions(state)], [self._shown.frames(state)], ())
        room = _ROOM * float(np.linalg.norm(high - low))
        bounds: Bounds = (low - [room, room, 0.0], high + room)
        shown = self._shown
        cloths = zip(shown.cloth_faces, shown.cloth_starts, scene.cloth_names, strict=False)
        self._stage = Stage(
            [Skin(faces + start, shown.paints[name]) for faces, start, name in cloths],
            [Skin(r.faces.numpy(), shown.paints[r.owner]) for r in shown.shown_rigid],
            size=size,
            bounds=bounds,
            ground=shown.ground(bounds),
            camera=camera,
        )

    def image(self, state: State) -> NDArray[np.uint8]:
        """Colors [height, width, 3] of a state without a batch axis."""
        placed = self._shown.placed(self._shown.frames(state))
        return self._stage.draw(_positions(state), placed)

    def close(self) -> None:
        """Free the window."""
        self._stage.__exit__()


def _positions(state: State) -> NDArray[Any]:
    positions: NDArray[Any] = state.positions.detach().numpy()
    return positions
