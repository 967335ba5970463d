"""Woven cloth: default values, parameters that belong together, and directions of the warp."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray, IndexArray
from diffcloth_torch.errors import InadmissibleMaterial, InvalidInput

__all__ = ["STAND_INS", "WOVEN_GROUPS", "check_bending", "material_axes"]

STAND_INS: Mapping[str, str] = MappingProxyType(
    {
        "stretch_weft": "stretch",
        "stretch_shear": "stretch",
        "bending_weft": "bending",
        "bending_twill": "bending",
    }
)
"""Parameter of woven cloth -> parameter whose value is its default."""

WOVEN_GROUPS = (("stretch_weft", "stretch_shear"), ("bending_weft", "bending_twill"))
"""Groups of parameters that a scene has together or not at all."""

_SMALLEST_SINE = 1e-3


def check_bending(
    owner: str,
    bending: FloatArray,
    weft: FloatArray,
    twill: FloatArray,
    poisson: FloatArray,
) -> None:
    """Refuse bending stiffnesses whose energy is negative somewhere or not differentiable.

    Args:
        owner: Opens the message.
        bending: Stiffness along the warp, D_w [N m].
        weft: Stiffness along the weft, D_f [N m].
        twill: Stiffness along the twill, D_t [N m].
        poisson: Poisson ratio [-]. All arguments have shapes that broadcast, with faces as the last
            axis.
    """
    bending, weft, twill, poisson = np.broadcast_arrays(bending, weft, twill, poisson)
    uneven = (weft > 0.0) != (bending > 0.0)
    if uneven.any():
        at, where = _first(uneven)
        sign = "> 0" if bending[at] > 0.0 else "0"
        raise InadmissibleMaterial(
            f"{owner}: `bending_weft` must be {sign} like `bending`, got {weft[at]:g}{where}"
        )
    least = (bending + weft + 2.0 * poisson * np.sqrt(bending * weft)) / 4.0
    low = twill < least
    if low.any():
        at, where = _first(low)
        raise InadmissibleMaterial(
            f"{owner}: `bending_twill` must be at least (bending + bending_weft + 2 poisson "
            f"sqrt(bending bending_weft)) / 4, which is {least[at]:g}, got {twill[at]:g}{where}"
        )


def _first(wrong: NDArray[np.bool_]) -> tuple[tuple[int, ...], str]:
    at = tuple(np.argwhere(wrong)[0].tolist())
    return at, f" at face [{at[-1]}]" if at and wrong.shape[-1] > 1 else ""


def material_axes(
    owner: str, directions: FloatArray, rest: FloatArray, faces: IndexArray
) -> FloatArray:
    """Unit vectors of the warp in the rest frames of faces, shape [f, 2].

    The rest frame of a face has its first axis along the side from its first to its second vertex,
    and its second to the left of the first, seen against the normal.

    Args:
        owner: Opens the message.
        directions: Directions of the warp at rest, shape [3] or [f, 3]; each is projected onto its
            face.
        rest: Rest positions [m], shape [n, 3].
        faces: Vertex indices, shape [f, 3].

    Raises:
        InvalidInput: If a direction is normal to its face.
    """
    corners = rest[faces]
    side, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    first = side / np.linalg.norm(side, axis=1, keepdims=True)
    normal = np.cross(side, other)
    second = np.cross(normal / np.linalg.norm(normal, axis=1, keepdims=True), first)
    given = np.broadcast_to(directions, first.shape)
    unit = given / np.linalg.norm(given, axis=1, keepdims=True)
    axes = np.stack([(unit * first).sum(axis=1), (unit * second).sum(axis=1)], axis=1)
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    normal_to = lengths[:, 0] < _SMALLEST_SINE
    if normal_to.any():
        face = int(np.argmax(normal_to))
        raise InvalidInput(
            f"{owner}: `directions` must not be normal to a face at rest, got "
            f"{given[face].tolist()} for face [{face}], to whose normal it is closer than "
            f"{_SMALLEST_SINE:g} rad"
        )
    return np.ascontiguousarray(axes / lengths)
