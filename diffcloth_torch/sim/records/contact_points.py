"""Contact points between surfaces at the end of a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.autograd.transforms import is_differentiated
from diffcloth_torch.checks import texts
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.reprs import field_text, record_text
from diffcloth_torch.saved import saved

__all__ = ["COLUMNS", "ContactPoints", "refuse_gradient"]

COLUMNS = 16
"""Numbers of a contact in the core: surfaces, points, normal, gap, normal and tangential force."""


@saved
@dataclass(frozen=True, eq=False)
class ContactPoints:
    """Contacts between surfaces at the end of a step, M of them.

    In a batch every tensor has a leading axis [B], and M is the largest number of contacts in an
    environment; unused rows have a `mask` of False, -1 for surfaces and 0 elsewhere.

    A row is a pair of features, such as a vertex and a face or two edges, that the barrier keeps
    apart. Friction uses the contacts of the solution before the last: if features have changed
    since, it has rows of its own, without a normal force. Rows may overlap at ridges and grooves of
    bodies, and some of them then have negative forces: only sums are meaningful.

    Attributes:
        surfaces: Names of all surfaces; `pairs` are indices into them.
        mask: True for contacts, false for unused rows, bool, shape [M].
        pairs: Both surfaces of each contact, int64, shape [M, 2].
        points: Nearest points, on the first and on the second surface [m], shape [M, 2, 3].
        normals: Unit vectors from the first to the second [-], shape [M, 3].
        gaps: Distances between both points, minus half the sum of both thicknesses [m], shape [M].
        normal_forces: Forces of the first on the second along the normals [N], shape [M].
        tangential_forces: Friction of the first on the second [N], shape [M, 3].
    """

    surfaces: tuple[str, ...]
    mask: Tensor
    pairs: Tensor
    points: Tensor
    normals: Tensor
    gaps: Tensor
    normal_forces: Tensor
    tangential_forces: Tensor

    @staticmethod
    def of(rows: Sequence[Tensor], surfaces: tuple[str, ...], *, batched: bool) -> ContactPoints:
        """Pad the rows of each environment, [M, COLUMNS], and name their columns."""
        largest = max((len(own) for own in rows), default=0)
        padded = cpu.zeros(len(rows), largest, COLUMNS)
        mask = cpu.zeros(len(rows), largest, dtype=torch.bool)
        padded[..., :2] = -1.0
        for i, own in enumerate(rows):
            padded[i, : len(own)] = own
            mask[i, : len(own)] = True
        if not batched:
            padded, mask = padded[0], mask[0]
        return ContactPoints(
            surfaces,
            mask,
            padded[..., :2].long(),
            padded[..., 2:8].reshape(*mask.shape, 2, 3),
            padded[..., 8:11],
            padded[..., 11],
            padded[..., 12],
            padded[..., 13:],
        )

    @property
    def forces(self) -> Tensor:
        """Forces of the first surfaces on the second [N], shape [M, 3]."""
        return self.normal_forces[..., None] * self.normals + self.tangential_forces

    def on(self, surface: str) -> ContactPoints:
        """Return contacts of one surface with others; it is then the second surface of each row.

        Rows of other surfaces, and of the surface with itself, have a mask of False and zeros.

        Raises:
            InvalidInput: If it is not a surface of the scene.
        """
        if surface not in self.surfaces:
            raise InvalidInput(
                f"ContactPoints.on: `surface` must be one of {texts(self.surfaces)}, "
                f"got {surface!r}"
            )
        is_own = self.pairs == self.surfaces.index(surface)
        mask = self.mask & (is_own[..., 0] ^ is_own[..., 1])
        turned = is_own[..., 0]
        sign = torch.where(turned, -1.0, 1.0).to(self.gaps.dtype) * mask
        return replace(
            self,
            mask=mask,
            pairs=torch.where(
                mask[..., None], torch.where(turned[..., None], self.pairs.flip(-1), self.pairs), -1
            ),
            points=torch.where(turned[..., None, None], self.points.flip(-2), self.points)
            * mask[..., None, None],
            normals=sign[..., None] * self.normals,
            gaps=self.gaps * mask,
            normal_forces=self.normal_forces * mask,
            tangential_forces=sign[..., None] * self.tangential_forces,
        )

    def __repr__(self) -> str:
        parts = (field_text(f.name, getattr(self, f.name)) for f in fields(self)[1:])
        return record_text("ContactPoints", [f"surfaces={self.surfaces!r}", *parts])


def refuse_gradient(points: ContactPoints, by: Sequence[Tensor]) -> ContactPoints:
    """Return the same contacts; their derivatives by these tensors raise an error."""
    wanted = [tensor for tensor in by if is_differentiated((tensor,))]
    if not wanted:
        return points
    numbers: dict[str, Any] = {f.name: getattr(points, f.name) for f in fields(points)}
    return replace(
        points,
        **{
            name: _WithoutGradient.apply(tensor, *wanted)  # type: ignore[no-untyped-call]
            for name, tensor in numbers.items()
            if isinstance(tensor, Tensor) and tensor.is_floating_point()
        },
    )


class _WithoutGradient(torch.autograd.Function):
    """The identity in its first argument, without derivatives by the others."""

    @staticmethod
    def forward(values, *by):  # type: ignore[no-untyped-def]
        return values.clone()

    @staticmethod
    def setup_context(ctx, inputs, output):  # type: ignore[no-untyped-def]
        pass

    @staticmethod
    def backward(ctx, cotangent):  # type: ignore[no-untyped-def]
        raise InvalidInput(_NO_GRADIENT)

    @staticmethod
    def jvp(ctx, *tangents):  # type: ignore[no-untyped-def]
        raise InvalidInput(_NO_GRADIENT)


_NO_GRADIENT = (
    "contacts: single contacts have no gradient, as they come and go; take that of "
    "state.contact_forces, state.body_forces or simulator.contact_wrenches(state)"
)
