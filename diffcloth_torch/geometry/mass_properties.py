"""Volume, center and inertia of a closed mesh, and the conditions on an inertia."""

from __future__ import annotations

import numpy as np

from diffcloth_torch.checks import FloatArray, IndexArray, check_finite, check_shape
from diffcloth_torch.errors import InvalidInput

__all__ = ["check_inertia", "check_part_of_inertia", "is_closed", "mass_properties"]

# Relative to the largest entry or moment: allows for rounded decimals of a file or a user.
_ROUNDING = 1e-6

# Smallest over largest principal moment. A rod of 1 m by 1 mm has 1e-6; below this ratio, rounding
# alone determines the spin of a body.
_SMALLEST_MOMENT = 1e-12


def is_closed(faces: IndexArray) -> bool:
    """Return whether faces traverse each edge equally often in both directions."""
    a, b = faces[:, [0, 1, 2]].reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    edges, inverse = np.unique(
        np.stack([np.minimum(a, b), np.maximum(a, b)], axis=-1), axis=0, return_inverse=True
    )
    balance = np.bincount(inverse.reshape(-1), np.where(a < b, 1.0, -1.0), len(edges))
    return not balance.any()


def mass_properties(
    vertices: FloatArray, faces: IndexArray
) -> tuple[float, FloatArray, FloatArray]:
    """Integrate over the inside of a closed mesh, exactly except for rounding.

    With the tetrahedra of an apex and the corners a, b, c of each face, D = det(a, b, c), s = a + b
    + c and all points relative to the apex:

        V = sum D/6,  V c = sum D/24 s,  C = sum D/120 (s sᵀ + a aᵀ + b bᵀ + c cᵀ),

    and the inertia of the points x inside is tr(C) 1 − C for C = ∫ x xᵀ, moved to the center.

    Args:
        vertices: Positions [m], shape [n, 3].
        faces: Triangles of a closed mesh, shape [f, 3]. If they point inward, all
            results are negative.

    Returns:
        Volume [m^3], its center [m], shape [3], and the inertia about that for a density of one
        [m^5], shape [3, 3].
    """
    apex = vertices[faces].mean(axis=(0, 1))  # near the center, so that little cancels
    corners = vertices[faces] - apex
    det = np.linalg.det(corners)
    total = corners.sum(axis=1)
    volume = float(det.sum() / 6)
    if volume == 0.0:
        return 0.0, apex, np.zeros((3, 3))
    center = np.einsum("f,fi->i", det, total) / 24 / volume
    squares = np.einsum("f,fi,fj->ij", det, total, total)
    squares += np.einsum("f,fki,fkj->ij", det, corners, corners)
    second = squares / 120 - volume * np.outer(center, center)
    second = (second + second.T) / 2
    return volume, apex + center, np.trace(second) * np.eye(3) - second


def check_inertia(name: str, inertia: FloatArray) -> FloatArray:
    """Require a possible symmetric inertia [3, 3] of a body; return its symmetric part.

    Its principal moments are positive, and none is larger than the sum of the others.
    """
    check_shape(name, inertia.shape, [(3, 3)])
    check_finite(name, inertia)
    asymmetry = np.abs(inertia - inertia.T)
    if asymmetry.max() > _ROUNDING * np.abs(inertia).max():
        i, j = (int(k) for k in np.argwhere(asymmetry == asymmetry.max())[0])
        raise InvalidInput(
            f"{name} must be symmetric, got {inertia[i, j]:g} at [{i}, {j}] "
            f"and {inertia[j, i]:g} at [{j}, {i}]"
        )
    symmetric: FloatArray = (inertia + inertia.T) / 2
    moments = np.linalg.eigvalsh(symmetric)
    text = ", ".join(f"{moment:g}" for moment in moments)
    if moments[0] <= _SMALLEST_MOMENT * abs(moments[2]):
        raise InvalidInput(f"{name} must be positive definite, got principal moments {text} kg m^2")
    if moments[2] > (1 + _ROUNDING) * (moments[0] + moments[1]):
        raise InvalidInput(
            f"{name} must have no principal moment above the sum of the other two, "
            f"as every body has, got {text} kg m^2"
        )
    return symmetric


def check_part_of_inertia(name: str, inertia: FloatArray) -> None:
    """Require a possible symmetric inertia [3, 3] of a part of a body, such as a point's."""
    moments = np.linalg.eigvalsh(inertia)
    if moments[0] < -_SMALLEST_MOMENT * abs(moments[2]):
        text = ", ".join(f"{moment:g}" for moment in moments)
        raise InvalidInput(
            f"{name} must be positive semi-definite, got principal moments {text} kg m^2"
        )
