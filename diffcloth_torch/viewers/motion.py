"""The states of a viewer, as the arrays that it draws."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.viewers.layers import strain
from diffcloth_torch.viewers.look import Goal
from diffcloth_torch.viewers.shown import Bounds, Shown

__all__ = ["LAYERS", "Moment", "Motion"]

LAYERS = ("plain", "strain", "contact")
"""Colorings of the cloths: own colors, strain, or the contact forces on them [N]."""

_COLORED = 0.99  # share of the numbers: a few peaks would leave one color for all others


@dataclass(frozen=True, eq=False)
class Moment:
    """One state of E environments.

    Attributes:
        time: Time of the first environment [s].
        positions: Cloth vertices [m], [E, N, 3].
        frames: Frames of the drawn bodies and links, [E, n, 4, 4].
        forces: Contact forces on the cloths' vertices [N], [E, N, 3].
        body_forces: Contact forces on the vertices of these bodies and links, [E, v, 3].
        gradient: Gradient of a loss by the cloths' vertices, [E, N, 3]; None if not given.
    """

    time: float
    positions: FloatArray
    frames: FloatArray
    forces: FloatArray
    body_forces: FloatArray
    gradient: FloatArray | None

    def vectors(self, what: str) -> FloatArray | None:
        """Vectors of "forces" at all vertices, or of "gradient" at the cloths', [E, v, 3]."""
        if what == "gradient":
            return self.gradient
        return np.concatenate([self.forces, self.body_forces], axis=1)


class Motion(list[Moment]):
    """Moments in the order of time."""

    def __init__(self, shown: Shown) -> None:
        """Begin without moments.

        Args:
            shown: The drawn surfaces of the scene.
        """
        super().__init__()
        self._shown = shown
        self._values: defaultdict[str, list[FloatArray]] = defaultdict(list)  # of a layer
        self._tops: dict[str, tuple[int, float]] = {}  # of a layer: number of moments, and the top
        self._lengths: defaultdict[str, list[float]] = defaultdict(list)  # of kinds of vectors

    def add(self, state: State, gradient: Tensor | None = None) -> None:
        """Store a state, and the gradient of a loss by its positions, of the same shape.

        Raises:
            InvalidInput: If the gradient has another shape.
        """
        given: object = gradient
        if given is not None and not isinstance(given, Tensor):
            raise TypeError(
                f"show: `gradients`[{len(self)}] must be a tensor, got {type(given).__name__}"
            )
        if gradient is not None and gradient.shape != state.positions.shape:
            raise InvalidInput(
                f"show: `gradients`[{len(self)}] must have shape {list(state.positions.shape)}, "
                f"like the positions of its state, got {list(gradient.shape)}"
            )
        batched = state.batch_size is not None
        shown = self._shown

        def environments(array: FloatArray) -> FloatArray:
            # A copy: later changes of a simulation's tensors must not change shown states.
            return np.array(array if batched else array[None])

        self.append(
            Moment(
                time=float(state.time.reshape(-1)[0]),
                positions=environments(state.positions.detach().numpy()),
                frames=environments(shown.frames(state)),
                forces=environments(state.contact_forces.detach().numpy()),
                body_forces=environments(shown.forces(state)),
                gradient=None if gradient is None else environments(gradient.detach().numpy()),
            )
        )

    def bounds(self, goals: Sequence[Goal]) -> Bounds:
        """Bounds of all moments, and of target shapes."""
        return self._shown.bounds(
            [x for moment in self for x in moment.positions],
            [f for moment in self for f in moment.frames],
            goals,
        )

    def values(self, layer: str, k: int) -> FloatArray:
        """Scalars that color the cloths in moment k, [E, N]."""
        known = self._values[layer]
        for moment in self[len(known) : k + 1]:
            if layer == "contact":
                known.append(np.linalg.norm(moment.forces, axis=-1))
            else:
                cloths = self._shown.scene.cloths
                known.append(np.stack([strain(cloths, x) for x in moment.positions]))
        return known[k]

    def top(self, layer: str) -> float:
        """The top of the color map, above all but the largest percent of the nonzero numbers."""
        if self._tops.get(layer, (0, 0.0))[0] != len(self):
            found = np.concatenate([self.values(layer, k).ravel() for k in range(len(self))])
            found = found[found > 0]
            top = float(np.quantile(found, _COLORED)) if found.size else 0.0
            self._tops[layer] = (len(self), top)
        return self._tops[layer][1]

    def longest(self, what: str) -> float:
        """The largest length of the vectors in the whole motion; 0 if there are none."""
        lengths = self._lengths[what]
        for moment in self[len(lengths) :]:
            vectors = moment.vectors(what)
            norms = np.zeros(1) if vectors is None else np.linalg.norm(vectors, axis=-1)
            lengths.append(float(norms.max(initial=0.0)))
        return max(lengths)
