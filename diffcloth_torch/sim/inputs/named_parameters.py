"""Parameters given by names: of cloths, surfaces, bodies, links, joints, or pairs of them.

Rows that are not named keep the values of the scene.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.autograd.transforms import numbers_of
from diffcloth_torch.checks import check_range, check_shape, texts
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.quantities import PARAMETERS, Axes, Shape
from diffcloth_torch.operations import label
from diffcloth_torch.sim.inputs.axes import with_axis
from diffcloth_torch.sim.inputs.layout import Layout

__all__ = ["has_names", "named_rows"]


def has_names(name: str) -> bool:
    """Return whether a parameter has rows with names."""
    return any(isinstance(letter, str) for letter in PARAMETERS[name].axes[-1])


def named_rows(
    layout: Layout, name: str, given: Mapping[object, Tensor], default: Tensor, batch: int | None
) -> Tensor:
    """Complete a parameter with some rows given by names, to rows [1 or B, rows, ..].

    Args:
        layout: Meaning of the rows.
        name: Name of the parameter.
        given: Name, or pair of names, -> values.
        default: Values of the scene, [1, rows, ..].
        batch: Number of environments of the state, None if it has no batch axis.

    Raises:
        InvalidInput: If a name is unknown or occurs twice, or a shape or value is not accepted.
    """
    axes = PARAMETERS[name].axes[-1]
    if axes == ("S", "S"):
        return _named_pairs(layout, name, given, default, batch)
    if axes[0] in ("F", "C"):
        return _named_cloths(layout, name, given, default, batch)
    groups = layout.rows_by_name[str(axes[0])]
    count = layout.assembly.sizes[str(axes[0])]
    rows = _full_rows(default, count)
    taken: set[str] = set()
    for key, value in given.items():
        full = _full_name(name, groups, key, taken)
        place = groups[full]
        opening = label("parameters", f"{name}[{key!r}]")
        row = PARAMETERS[name].row_shape
        size = place.stop - place.start
        # A single row has no axis of its own, but the rest vertices of a cloth do.
        several = size > 1 or axes[0] == "M"
        values = _checked(name, opening, value, (size, *row) if several else row, row, batch)
        rows = _replaced(rows, cpu.arange(place.start, place.stop), values)
    return rows


def _checked(
    name: str, opening: str, value: Tensor, shape: Shape, shared: Shape, batch: int | None
) -> Tensor:
    """Check the values of one name; returns them as rows [1 or B, rows, ..]."""
    row = PARAMETERS[name].row_shape
    accepted: list[Axes] = [shape, ("B", *shape)]
    is_shared = value.shape == shared != shape
    check_shape(opening, value.shape, [*accepted, shared] if shared != shape else accepted)
    check_range(opening, numbers_of(value), PARAMETERS[name].accepted)
    if is_shared:
        return value.reshape(1, 1, *row)
    values = with_axis(opening, value, len(shape), batch)
    return values.reshape(len(values), -1, *row)


def _full_name(name: str, groups: Mapping[str, slice], key: object, taken: set[str]) -> str:
    """Return the full name of a key, which may be the part after '/' if that is unique."""
    full = [key] if key in groups else [g for g in groups if g.partition("/")[2] == key]
    if len(full) != 1:
        problem = "is the name of several" if full else "is none of them"
        raise InvalidInput(
            f"{label('parameters', name)} has the names {texts(groups)}; {key!r} {problem}"
        )
    found = str(full[0])
    place = groups[found]
    overlapping = [t for t in taken if groups[t].start < place.stop > place.start < groups[t].stop]
    if overlapping:
        raise InvalidInput(
            f"{label('parameters', name)} must name each row once, got {found!r} besides "
            f"{texts(overlapping)}"
        )
    taken.add(found)
    return found


def _full_rows(default: Tensor, count: int) -> Tensor:
    return default.expand(len(default), count, *default.shape[2:])


def _replaced(rows: Tensor, places: Tensor, values: Tensor) -> Tensor:
    """Replace some of the rows [nb, R, ..]."""
    environments = max(len(rows), len(values))
    wide = values.expand(environments, len(places), *values.shape[2:])
    return rows.expand(environments, *rows.shape[1:]).index_copy(1, places, wide)


def _named_cloths(
    layout: Layout, name: str, given: Mapping[object, Tensor], default: Tensor, batch: int | None
) -> Tensor:
    """Complete a parameter of cloths, given as one number per cloth or per face."""
    assembly = layout.assembly
    cloths = {n: slice(i, i + 1) for i, n in enumerate(layout.cloth_names)}
    faces = layout.rows_by_name["F"]
    counts = cpu.tensor([rows.stop - rows.start for rows in faces.values()], dtype=torch.int64)
    per_face = PARAMETERS[name].axes[-1] == ("F",)
    entries: dict[str, Tensor] = {}
    taken: set[str] = set()
    for key, value in given.items():
        cloth = _full_name(name, cloths, key, taken)
        opening, n = label("parameters", f"{name}[{key!r}]"), int(counts[cloths[cloth].start])
        is_per_face = per_face and value.ndim > 0 and value.shape[-1] == n
        if is_per_face and value.shape == (batch,) and n > 1:
            raise InvalidInput(
                f"{opening} of shape {[n]} could mean one value per environment or per face; "
                f"write it as {[batch, n]} or {[batch, 1]} to say which"
            )
        if per_face and value.ndim == 2 and value.shape[-1] == 1 != n:
            value = value[:, 0]
        entries[cloth] = _checked(name, opening, value, (n,) if is_per_face else (), (), batch)
    wide = default.shape[1] not in (1, len(cloths)) or any(e.shape[1] > 1 for e in entries.values())
    if not wide:
        rows = _full_rows(default, len(cloths))
        for cloth, values in entries.items():
            rows = _replaced(rows, cpu.tensor([cloths[cloth].start], dtype=torch.int64), values)
        return rows
    rows = default
    if default.shape[1] == len(cloths):
        rows = default.repeat_interleave(counts, dim=1)
    rows = _full_rows(rows, len(assembly.faces))
    for cloth, values in entries.items():
        rows = _replaced(rows, cpu.arange(faces[cloth].start, faces[cloth].stop), values)
    return rows


def _named_pairs(
    layout: Layout, name: str, given: Mapping[object, Tensor], default: Tensor, batch: int | None
) -> Tensor:
    """Complete a parameter of pairs of surfaces, [nb, S S]; both entries of a pair are set."""
    opening, surfaces = label("parameters", name), layout.assembly.surface_names
    count = len(surfaces)
    rows = _full_rows(default, count**2)
    taken: set[tuple[int, ...]] = set()
    for key, value in given.items():
        if not isinstance(key, tuple) or len(key) != 2 or any(s not in surfaces for s in key):
            raise InvalidInput(
                f"{opening} must name pairs (a, b) of the surfaces {texts(surfaces)}; got {key!r}"
            )
        i, j = pair = tuple(sorted(surfaces.index(surface) for surface in key))
        if pair in taken:
            raise InvalidInput(f"{opening} must name the pair {key!r} once, got it twice")
        taken.add(pair)
        values = _checked(name, label("parameters", f"{name}[{key!r}]"), value, (), (), batch)
        rows = _replaced(
            rows, cpu.tensor(sorted({i * count + j, j * count + i}), dtype=torch.int64), values
        )
    return rows
