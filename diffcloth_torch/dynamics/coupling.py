"""Couplings that solve bodies and cloths one after the other.

Both are exact where what forces move is much heavier than what it touches. Each side sees the other
as it was or will be, so that an error of the first passes back and forth; the added-mass number

    N = (mass of the cloth in contact + h^2 stiffness of the contact) / mass of the body

says by how much it grows or falls each time. From about 1 on results are wrong, from 3 or 4 on they
gain energy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, Protocol, TypeVar

import torch
from torch import Tensor

from diffcloth_torch.dynamics.dynamics import Dynamics, Prediction
from diffcloth_torch.model.scene import Assembly

__all__ = ["Staggered", "added_mass_numbers", "cloth_to_rigid", "rigid_to_cloth"]

# Of the barrier at a gap u d_hat: its stiffness times d_hat over its force is 3.0 where that is
# least, at u = 0.37, and 9.3 at u = 0.8.
_STIFFNESS_OF_FORCE = 3.0


class ClothSolution(Protocol):
    """What a solve of the cloths leaves."""

    @property
    def body_forces(self) -> Tensor:
        """Contact forces on the vertices of bodies and links, [B, V, 3] N."""


class RigidSolution(Protocol):
    """What a solve of bodies and robots leaves."""

    @property
    def coordinates(self) -> Tensor:
        """At the end of the step, [B, n]."""

    @property
    def body_forces(self) -> Tensor:
        """Contact forces among them, on their vertices, [B, V, 3] N."""


Cloth = TypeVar("Cloth", bound=ClothSolution)
Rigid = TypeVar("Rigid", bound=RigidSolution)


@dataclass(frozen=True)
class Staggered(Generic[Cloth, Rigid]):
    """A step in two solves.

    Attributes:
        cloth: The solve of the cloths.
        rigid: That of bodies and robots.
        fields: Of the new state, for bodies and robots.
        body_forces: Of both solves, [B, V, 3] N.
    """

    cloth: Cloth
    rigid: Rigid
    fields: dict[str, Tensor]
    body_forces: Tensor


def rigid_to_cloth(
    dynamics: Dynamics,
    prediction: Prediction,
    solve_rigid: Callable[[Prediction], Rigid],
    solve_cloth: Callable[[Prediction, Tensor], Cloth],
) -> Staggered[Cloth, Rigid]:
    """Move bodies and robots without the cloth, then the cloth against them.

    The forces of the cloth change velocities only: they hold its impulse, which moves things in the
    next step.

    Args:
        dynamics: Of the bodies and robots.
        prediction: Of the step.
        solve_rigid: Takes the step of bodies and robots alone.
        solve_cloth: Takes that of the cloths, while all coordinates move from their start to those
            that it is given, [B, n].
    """
    rigid = solve_rigid(prediction)
    cloth = solve_cloth(prediction, rigid.coordinates)
    fields = dynamics.advance(
        prediction, rigid.coordinates, rigid.body_forces, kick=cloth.body_forces
    )
    return Staggered(cloth, rigid, fields, rigid.body_forces + cloth.body_forces)


def cloth_to_rigid(
    dynamics: Dynamics,
    predict: Callable[[Tensor | None], Prediction],
    solve_rigid: Callable[[Prediction], Rigid],
    solve_cloth: Callable[[Prediction, Tensor], Cloth],
    check_path: Callable[[Cloth, Prediction, Tensor, Tensor], None],
) -> Staggered[Cloth, Rigid]:
    """Move the cloth while what forces move stands still, then that by the forces of the cloth.

    Args:
        dynamics: Of the bodies and robots.
        predict: Predicts the step, with forces [B, V, 3] that act on the vertices.
        solve_rigid: As for `rigid_to_cloth`.
        solve_cloth: Likewise.
        check_path: Raises where bodies and robots, on their straight way between two rows of
            coordinates of the prediction, meet the cloth that has been solved.
    """
    still = predict(None)
    held = torch.where(dynamics.prescribed, still.coordinate_ends, still.coordinates)
    cloth = solve_cloth(still, held)
    prediction = predict(cloth.body_forces)
    rigid = solve_rigid(prediction)
    start = torch.where(dynamics.prescribed, prediction.coordinate_ends, prediction.coordinates)
    check_path(cloth, prediction, start, rigid.coordinates)
    fields = dynamics.advance(prediction, rigid.coordinates, rigid.body_forces)
    return Staggered(cloth, rigid, fields, rigid.body_forces + cloth.body_forces)


def added_mass_numbers(
    assembly: Assembly,
    frames: Tensor,
    masses: Tensor,
    positions: Tensor,
    vertex_masses: Tensor,
    forces: Tensor,
    reach: Tensor,
    dt: float,
) -> Tensor:
    """Estimate the added-mass number of each body and link.

    The cloth in contact is what is in the bounding box of the surface, in its own frame and wider
    by the reach. The contact is as stiff as its force says, at the least: three times that force
    over the reach.

    Args:
        assembly: Arrays of the scene.
        frames: Of the K + Lc surfaces after the cloths, [B, K + Lc, 4, 4].
        masses: Of each of them, zero where it is prescribed, [B or 1, K + Lc] kg.
        positions: Of the cloths' vertices, [B, N, 3] m.
        vertex_masses: [B or 1, N] kg.
        forces: Of the cloth on the surfaces' vertices, [B, V, 3] N.
        reach: Distance at which contact begins, [B or 1] m.
        dt: h [s].

    Returns:
        [B, K + Lc]; zero where nothing is touched, or nothing moves by forces.
    """
    vertices = torch.from_numpy(assembly.body_vertices)
    wider = reach[:, None, None]
    numbers = []
    with torch.no_grad():
        for s, (a, b) in enumerate(pairwise(assembly.body_vertex_start.tolist())):
            own = vertices[a:b]
            frame, force = frames[:, s], forces[:, a:b].norm(dim=-1).sum(-1)
            local = (positions - frame[:, None, :3, 3]) @ frame[:, :3, :3]
            above, below = local >= own.amin(0) - wider, local <= own.amax(0) + wider
            touching = (above & below).all(-1) * vertex_masses
            stiffness = _STIFFNESS_OF_FORCE * force / reach
            added = touching.sum(-1) + dt**2 * stiffness
            moves = (force > 0) & (masses[:, s] > 0)
            numbers.append(torch.where(moves, added / masses[:, s], 0.0))
        return torch.stack(numbers, dim=-1)
