"""Couplings that solve bodies and cloths one after the other.

Both are accurate if dynamic bodies and robots are much heavier than the cloth that they touch. Each
solve uses the other side before or after its motion, so an error of one side passes back and
forth; the added-mass number

    N = (mass of the cloth in contact + h^2 stiffness of the contact) / mass of the body

is the factor of this error each time. A bouncing body gains energy long before this number is 1:
relative to its force, the barrier is softest at a third of its reach, and stiffer elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, Protocol, TypeVar

import torch
from torch import Tensor

from diffcloth_torch.dynamics.dynamics import Dynamics, Prediction
from diffcloth_torch.model.assembly import Assembly

__all__ = ["StaggeredStep", "added_mass_numbers", "cloth_to_rigid", "rigid_to_cloth"]

# For the barrier at a gap u d_hat, stiffness times d_hat over force has its minimum of 3.0 at u =
# 0.37, and is 9.3 at u = 0.8.
_STIFFNESS_OF_FORCE = 3.0


class ClothSolution(Protocol):
    """The result of a solve of the cloths."""

    @property
    def body_forces(self) -> Tensor:
        """Contact forces on the vertices of bodies and links, [B, V, 3] N."""


class RigidSolution(Protocol):
    """The result of a solve of bodies and robots."""

    @property
    def coordinates(self) -> Tensor:
        """Coordinates at the end of the step, [B, n]."""

    @property
    def body_forces(self) -> Tensor:
        """Contact forces among them, on their vertices, [B, V, 3] N."""


Cloth = TypeVar("Cloth", bound=ClothSolution)
Rigid = TypeVar("Rigid", bound=RigidSolution)


@dataclass(frozen=True)
class StaggeredStep(Generic[Cloth, Rigid]):
    """A step in two solves.

    Attributes:
        cloth: The solve of the cloths.
        rigid: The solve of bodies and robots.
        prediction: Prediction with which the solve of bodies and robots began.
        fields: Fields of the new state, for bodies and robots.
        body_forces: Contact forces of both solves, [B, V, 3] N.
    """

    cloth: Cloth
    rigid: Rigid
    prediction: Prediction
    fields: dict[str, Tensor]
    body_forces: Tensor


def rigid_to_cloth(
    dynamics: Dynamics,
    prediction: Prediction,
    solve_rigid: Callable[[Prediction], Rigid],
    solve_cloth: Callable[[Prediction, Tensor], Cloth],
) -> StaggeredStep[Cloth, Rigid]:
    """Move bodies and robots without the cloth, then the cloth against them.

    The forces of the cloth change velocities only: their impulse moves bodies and robots in the
    next step.

    Args:
        dynamics: Dynamics of the bodies and robots.
        prediction: Prediction of the step.
        solve_rigid: Solves the step of bodies and robots alone.
        solve_cloth: Solves the step of the cloths, while all coordinates move from their start to
            the given ends, [B, n].
    """
    rigid = solve_rigid(prediction)
    cloth = solve_cloth(prediction, rigid.coordinates)
    fields = dynamics.advance(
        prediction, rigid.coordinates, rigid.body_forces, kick=cloth.body_forces
    )
    return StaggeredStep(cloth, rigid, prediction, fields, rigid.body_forces + cloth.body_forces)


def cloth_to_rigid(
    dynamics: Dynamics,
    predict: Callable[[Tensor | None], Prediction],
    origins: Tensor,
    solve_rigid: Callable[[Prediction], Rigid],
    solve_cloth: Callable[[Prediction, Tensor, Tensor], Cloth],
    check_path: Callable[[Cloth, Prediction, Tensor, Tensor], None],
) -> StaggeredStep[Cloth, Rigid]:
    """Move the cloth against bodies and robots at rest, then move these by the forces of the cloth.

    In friction, bodies and robots move as in the step before.

    Args:
        dynamics: Dynamics of the bodies and robots.
        predict: Predicts the step, with forces [B, V, 3] that act on the vertices.
        origins: Positions of all vertices from which friction measures motion, [B, N + V, 3] m.
        solve_rigid: As for `rigid_to_cloth`.
        solve_cloth: Likewise, with those origins.
        check_path: Raises an error if bodies and robots, moving straight between two rows of
            coordinates of the prediction, collide with the solved cloth.
    """
    still = predict(None)
    held = torch.where(dynamics.prescribed, still.coordinate_ends, still.coordinates)
    cloth = solve_cloth(still, held, origins)
    prediction = predict(cloth.body_forces)
    rigid = solve_rigid(prediction)
    start = torch.where(dynamics.prescribed, prediction.coordinate_ends, prediction.coordinates)
    check_path(cloth, prediction, start, rigid.coordinates)
    fields = dynamics.advance(prediction, rigid.coordinates, rigid.body_forces)
    return StaggeredStep(cloth, rigid, prediction, fields, rigid.body_forces + cloth.body_forces)


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

    The cloth in contact is the cloth inside the surface's bounding box in the frame of the surface,
    enlarged by the reach. The stiffness of the contact is the smallest one that its force allows:
    three times that force over the reach.

    Args:
        assembly: Arrays of the scene.
        frames: Frames of the K + Lc surfaces after the cloths, [B, K + Lc, 4, 4].
        masses: Mass of each surface, zero if it is prescribed, [B or 1, K + Lc] kg.
        positions: Positions of the cloths' vertices, [B, N, 3] m.
        vertex_masses: Masses of these vertices, [B or 1, N] kg.
        forces: Forces of the cloth on the surfaces' vertices, [B, V, 3] N.
        reach: Distance at which contact begins, [B or 1] m.
        dt: h [s].

    Returns:
        Added-mass numbers, [B, K + Lc]; zero for surfaces that touch nothing or are not dynamic.
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
