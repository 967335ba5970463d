"""The springs of a scene's attachments, as arrays for the core."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from diffcloth_torch.checks import FloatArray, IndexArray, check_shape, index_array, texts
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.attachment import Attachment, Points
from diffcloth_torch.saved import saved

__all__ = ["AttachedSurface", "Springs", "make_springs", "surfaces_of"]

# Volume of four vertices of a body over its extent cubed, below which the body is flat [-].
_FLAT = 1e-9
# Largest distance of a point from the plane of a flat body, over the body's extent [-].
_OFF_PLANE = 1e-9


class AttachedSurface(NamedTuple):
    """A surface that points can be on.

    Attributes:
        first: Index of its first vertex among the vertices of all surfaces.
        vertices: Vertices of a body or link in its frame, or initial vertices of a cloth [m], shape
            [v, 3].
        is_cloth: Whether the surface is a cloth.
    """

    first: int
    vertices: FloatArray
    is_cloth: bool


def _empty(dtype: type = np.int32) -> IndexArray:
    return np.zeros(0, dtype=dtype)


@saved
@dataclass(frozen=True, eq=False)
class Springs:
    """All A springs of a scene, attachment after attachment, U of them to targets.

    Attributes:
        start: First entry of each spring in `points`, then the number of entries; shape [A + 1].
        points: Indices of vertices, which count cloths, then bodies and links.
        coefficients: Coefficients of the points [-]; negative for the second end.
        rest_lengths: Rest lengths [m], shape [A].
        targets: Row of the target of each spring, -1 without a target; shape [A].
        stiffness: Stiffness [N/m], shape [A].
        groups: Name of an attachment -> its rows among the A springs.
        target_groups: Name of an attachment to targets -> its rows among the U targets.
        surfaces: Names of the bodies and links with attachments.
    """

    start: IndexArray = field(default_factory=lambda: np.zeros(1, dtype=np.int32))
    points: IndexArray = field(default_factory=_empty)
    coefficients: FloatArray = field(default_factory=lambda: np.zeros(0))
    rest_lengths: FloatArray = field(default_factory=lambda: np.zeros(0))
    targets: IndexArray = field(default_factory=_empty)
    stiffness: FloatArray = field(default_factory=lambda: np.zeros(0))
    groups: Mapping[str, slice] = field(default_factory=dict)
    target_groups: Mapping[str, slice] = field(default_factory=dict)
    surfaces: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.targets)

    @property
    def target_count(self) -> int:
        """Number of targets, U."""
        return int((self.targets >= 0).sum())


class _Sum(NamedTuple):
    """A point as a weighted sum over vertices."""

    vertices: IndexArray
    coefficients: FloatArray


def make_springs(
    names: Sequence[str],
    attachments: Sequence[Attachment],
    surfaces: Mapping[str, AttachedSurface],
) -> Springs:
    """Resolve the points of attachments.

    Args:
        names: Names of the attachments.
        attachments: The attachments.
        surfaces: Name -> surface.

    Raises:
        InvalidInput: If a name, vertex, point or shape is not accepted.
    """
    sums: list[_Sum] = []
    rest_lengths, stiffness = [np.zeros(0)], [np.zeros(0)]
    targets: list[int] = []
    groups, target_groups, attached = {}, {}, []
    row = 0
    for name, attachment in zip(names, attachments, strict=True):
        label = f"Scene: attachment {name!r}"
        springs = _springs_of(label, attachment, surfaces)
        count = len(springs)
        groups[name] = slice(len(targets), len(targets) + count)
        for field_name, parts in (("rest_length", rest_lengths), ("stiffness", stiffness)):
            values = getattr(attachment, field_name)
            check_shape(f"{label}: `{field_name}`", values.shape, [(), (count,)])
            parts.append(np.broadcast_to(values, (count,)))
        has_targets = attachment.b is None
        targets += range(row, row + count) if has_targets else [-1] * count
        if has_targets:
            target_groups[name] = slice(row, row + count)
            row += count
        sums += springs
        ends = [end.surface for end in (attachment.a, attachment.b) if end is not None]
        attached += [end for end in ends if not surfaces[end].is_cloth]
    return Springs(
        start=np.cumsum([0, *(len(s.vertices) for s in sums)]).astype(np.int32),
        points=np.concatenate([_empty(), *(s.vertices for s in sums)]).astype(np.int32),
        coefficients=np.concatenate([np.zeros(0), *(s.coefficients for s in sums)]),
        rest_lengths=np.concatenate(rest_lengths),
        targets=np.array(targets, dtype=np.int32),
        stiffness=np.concatenate(stiffness),
        groups=groups,
        target_groups=target_groups,
        surfaces=tuple(dict.fromkeys(attached)),
    )


def _springs_of(
    label: str, attachment: Attachment, surfaces: Mapping[str, AttachedSurface]
) -> list[_Sum]:
    """For each spring, the points of both ends as one sum: first end minus second end."""
    a = _resolve(f"{label}: `a`", attachment.a, surfaces)
    if attachment.b is None:
        return a
    b = _resolve(f"{label}: `b`", attachment.b, surfaces)
    same = attachment.a.surface == attachment.b.surface
    if same and not surfaces[attachment.a.surface].is_cloth:
        raise InvalidInput(
            f"{label} must not have both ends on {attachment.a.surface!r}: it is rigid"
        )
    count = max(len(a), len(b))
    if any(len(end) not in (1, count) for end in (a, b)):
        raise InvalidInput(
            f"{label}: `a` and `b` must have as many points, or one of them a single one, "
            f"got {len(a)} and {len(b)}"
        )
    pairs = zip(a * count if len(a) == 1 else a, b * count if len(b) == 1 else b, strict=False)
    springs = []
    for k, (first, second) in enumerate(pairs):
        spring = _merged(
            np.concatenate([first.vertices, second.vertices]),
            np.concatenate([first.coefficients, -second.coefficients]),
        )
        if not spring.coefficients.any():
            raise InvalidInput(f"{label} must have ends that differ, got one point twice at [{k}]")
        springs.append(spring)
    return springs


def _merged(vertices: IndexArray, coefficients: FloatArray) -> _Sum:
    """Merge repeated vertices, in the order of first occurrence, and add their coefficients."""
    unique, first, inverse = np.unique(vertices, return_index=True, return_inverse=True)
    sums = np.zeros(len(unique))
    np.add.at(sums, inverse, coefficients)
    order = np.argsort(first)
    return _Sum(unique[order], sums[order])


def _resolve(label: str, points: Points, surfaces: Mapping[str, AttachedSurface]) -> list[_Sum]:
    if points.surface not in surfaces:
        raise InvalidInput(
            f"{label} has the surfaces {texts(surfaces)}; {points.surface!r} is none of them"
        )
    surface = surfaces[points.surface]
    if surface.is_cloth:
        return _cloth_points(label, points, surface)
    if points.weights is not None:
        raise InvalidInput(
            f"{label} must be points in the frame of {points.surface!r}, without weights"
        )
    where = points.where.astype(np.float64)
    check_shape(f"{label}, points of {points.surface!r},", where.shape, [(3,), ("n", 3)])
    return _rigid_points(label, np.atleast_2d(where), surface)


def _cloth_points(label: str, points: Points, surface: AttachedSurface) -> list[_Sum]:
    label = f"{label}, vertices of {points.surface!r},"
    vertices = index_array(label, points.where, len(surface.vertices)) + np.int32(surface.first)
    if points.weights is None:
        check_shape(label, vertices.shape, [(), ("n",)], hint="; points of faces need weights")
        return [_Sum(row, np.ones(1)) for row in vertices.reshape(-1, 1)]
    rows = zip(np.atleast_2d(vertices), np.atleast_2d(points.weights), strict=True)
    return [_merged(row, weights) for row, weights in rows]


def _rigid_points(label: str, where: FloatArray, surface: AttachedSurface) -> list[_Sum]:
    """Points of a rigid surface as affine combinations of its vertices, which move with it."""
    frame = _frame_of(surface.vertices)
    origin, edges = (
        surface.vertices[frame[0]],
        surface.vertices[frame[1:]] - surface.vertices[frame[0]],
    )
    extent = float(np.linalg.norm(edges[0]))
    sums = []
    for k, point in enumerate(where):
        others = np.linalg.lstsq(edges.T, point - origin, rcond=None)[0]
        off = float(np.linalg.norm(edges.T @ others - (point - origin)))
        if off > _OFF_PLANE * max(extent, float(np.linalg.norm(point - origin))):
            raise InvalidInput(
                f"{label} must lie in the plane of a flat body, which has no other points; "
                f"it is {off:g} m off at [{k}]"
            )
        weights = np.concatenate([[1.0 - others.sum()], others])
        sums.append(_Sum(np.asarray(frame + surface.first, dtype=np.int32), weights))
    return sums


def _frame_of(vertices: FloatArray) -> IndexArray:
    """Four vertices far from one plane, or, if the surface is flat, three far from one line."""
    first = int(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).argmax())
    d = vertices - vertices[first]
    second = int(np.linalg.norm(d, axis=1).argmax())
    areas = np.linalg.norm(np.cross(d, d[second]), axis=1)
    third = int(areas.argmax())
    volumes = np.abs(d @ np.cross(d[second], d[third]))
    fourth = int(volumes.argmax())
    extent = float(np.linalg.norm(d[second]))
    chosen = [first, second, third]
    if volumes[fourth] > _FLAT * extent**3:
        chosen.append(fourth)
    return np.array(chosen, dtype=np.int32)


def surfaces_of(
    names: Sequence[str], vertices: Sequence[FloatArray], cloth_count: int
) -> dict[str, AttachedSurface]:
    """Surfaces by name, from the vertices of each surface; cloths are first."""
    starts = np.cumsum([0, *(len(v) for v in vertices)]).tolist()
    return {
        name: AttachedSurface(first, own, k < cloth_count)
        for k, (name, first, own) in enumerate(zip(names, starts, vertices, strict=False))
    }
