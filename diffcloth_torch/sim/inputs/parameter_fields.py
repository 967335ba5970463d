"""From parameters to fields that are checked, complete and have their leading axis."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch.autograd.transforms import numbers_of
from diffcloth_torch.checks import (
    FloatArray,
    check_range,
    check_shape,
    float_tensor,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.mesh_checks import check_areas
from diffcloth_torch.model.orthotropy import check_bending
from diffcloth_torch.model.quantities import FACE_QUANTITIES, PARAMETERS, Fields, Shape
from diffcloth_torch.operations import label, operation
from diffcloth_torch.sim.inputs.layout import Layout
from diffcloth_torch.sim.inputs.named_parameters import has_names, named_rows
from diffcloth_torch.sim.records.controls import Parameters

__all__ = ["check_parameters", "default_fields", "parameter_fields", "without_elasticity"]

_ROUNDING = 1e-12  # of an eigenvalue, relative to the largest
_ROWS = {"C": "cloth", "N": "vertex", "F": "face"}
_BENDING = ("bending", "bending_weft", "bending_twill", "poisson")


def check_parameters(parameters: Parameters) -> Parameters:
    """Promote parameters to tensors; their values are checked in each step."""
    if not isinstance(parameters, Parameters):
        raise TypeError(
            f"{operation()}: `parameters` must be Parameters, got {type(parameters).__name__}"
        )
    given = {name: getattr(parameters, name) for name in PARAMETERS}
    checked = {name: _promoted(name, value) for name, value in given.items() if value is not None}
    return Parameters(**checked, _unbatched=parameters._unbatched)  # type: ignore[arg-type]


def _promoted(name: str, value: object) -> Tensor | dict[object, Tensor]:
    """Promote a parameter to a tensor, or to one tensor for each name."""
    if isinstance(value, Mapping) and has_names(name):
        return {k: float_tensor(label("parameters", f"{name}[{k!r}]"), v) for k, v in value.items()}
    return float_tensor(label("parameters", name), value)


def parameter_fields(
    layout: Layout,
    parameters: Parameters,
    defaults: Fields,
    batch: int | None,
) -> Fields:
    """Check parameters; a field that is None has its value in `defaults`, which has all."""
    checked = check_parameters(parameters)
    fields = dict(defaults)
    for name, quantity in PARAMETERS.items():
        given = getattr(checked, name)
        if given is None:
            continue
        opening = label("parameters", name)
        if name not in defaults:
            raise InvalidInput(f"{opening} must be None: it has no meaning in this scene")
        if isinstance(given, Mapping):
            fields[name] = named_rows(layout, name, given, defaults[name], batch)
            _check_values(layout, name, numbers_of(fields[name]), numbers_of(defaults[name]))
            continue
        check_range(opening, numbers_of(given), quantity.accepted)
        unbatched = name in parameters._unbatched
        environments = _environments(layout, name, tuple(given.shape), batch, unbatched)
        fields[name] = _rows(given, environments, quantity.row_shape)
        if name in FACE_QUANTITIES and not unbatched:
            fields[name] = _at_faces(layout, opening, fields[name])
        _check_values(layout, name, numbers_of(fields[name]), numbers_of(defaults[name]))
    if "bending_weft" in fields and any(getattr(checked, name) is not None for name in _BENDING):
        values = (_per_face(layout, numbers_of(fields[name])) for name in _BENDING)
        check_bending(operation(), *values)
    return fields


def without_elasticity(layout: Layout, fields: Fields) -> Fields:
    """Set elastic stiffness, mass and drag of deforming bodies to zero."""
    if not layout.assembly.deforming_count:
        return fields
    cloths = layout.assembly.cloth_count
    masked = {}
    for name in FACE_QUANTITIES:
        if name in fields and name != "poisson":
            values = fields[name]
            if values.shape[1] == 1:
                values = values.expand(len(values), cloths)
            masked[name] = torch.where(layout.elastic[values.shape[1]], values, 0.0)
    return fields | masked


def _at_faces(layout: Layout, opening: str, values: Tensor) -> Tensor:
    """Return values at vertices as means of the corners of each face, [nb, F]; others unchanged."""
    vertices, faces = len(layout.assembly.vertices), len(layout.assembly.faces)
    if values.shape[1] != vertices:
        return values
    if vertices == faces:
        raise InvalidInput(
            f"{opening} of {faces} values could mean one per vertex or one per face, of which "
            "there are as many; write values of faces by the names of cloths, and values of "
            "vertices as means of corners, values[faces].mean(-1), likewise"
        )
    a, b, c = values[:, layout.corners].unbind(-1)
    return (a + b + c) / 3


def _per_face(layout: Layout, values: FloatArray) -> FloatArray:
    """Values [nb, 1 or C or F] as values [nb, 1 or F]."""
    assembly = layout.assembly
    if values.shape[1] != assembly.cloth_count:
        return values
    return np.repeat(values, np.diff(assembly.cloth_face_start), axis=1)


def default_fields(defaults: Mapping[str, Tensor]) -> Fields:
    """Add the axes of fields to the parameters of one environment."""
    return {name: _rows(tensor, 1, PARAMETERS[name].row_shape) for name, tensor in defaults.items()}


def _rows(tensor: Tensor, environments: int, row: Shape) -> Tensor:
    rows = tensor.numel() // (environments * math.prod(row))
    return tensor.reshape(environments, rows, *row)


def _check_values(layout: Layout, name: str, values: FloatArray, default: FloatArray) -> None:
    """Refuse values [nb, rows, ..] of a parameter that its range alone does not exclude."""
    if name == "rest_positions":
        if not (values == default).all():
            for shape in values:
                check_areas(operation(), name, shape, layout.assembly.rest_faces)
        return
    if name in ("body_mass", "link_mass"):
        _refuse_rows(layout, name, values == 0.0, "> 0", layout.permissions.massive)
    elif name in ("body_inertia", "link_inertia"):
        least, _, largest = np.moveaxis(np.linalg.eigvalsh(_symmetric(values)), -1, 0)
        moved = layout.permissions.moved
        massive = {owner: rows & moved[owner] for owner, rows in layout.permissions.massive.items()}
        # A link that fixed joints join to others may be a point or a rod in its file.
        was_definite = np.linalg.eigvalsh(_symmetric(default))[..., 0] > 0.0
        _refuse_rows(layout, name, (least <= 0.0) & was_definite, "positive definite", massive)
        # Links without mass in their file may be assigned some.
        wrong = least < -_ROUNDING * np.abs(largest)
        _refuse_rows(layout, name, wrong, "positive semi-definite", moved)


def _symmetric(values: FloatArray) -> FloatArray:
    return (values + np.swapaxes(values, -1, -2)) / 2


def _refuse_rows(
    layout: Layout,
    name: str,
    wrong: NDArray[np.bool_],
    accepted: str,
    of: Mapping[str, NDArray[np.bool_]],
) -> None:
    """Refuse wrong values of some bodies or links; all others are ignored."""
    owner = name.partition("_")[0]
    wrong = wrong & of[owner]
    if not wrong.any():
        return
    row = int(np.argwhere(wrong)[0][-1])
    moved = layout.link_names[row] if owner == "link" else layout.assembly.bodies[row].name
    raise InvalidInput(
        f"{label('parameters', name)} must be {accepted} in the row [{row}], that of {moved!r}, "
        "which is dynamic"
    )


def _environments(
    layout: Layout, name: str, shape: Shape, batch: int | None, unbatched: bool
) -> int:
    """Number of environments of a parameter with the given shape: 1, or the batch size."""
    opening, shared = label("parameters", name), layout.parameter_shapes[name]
    is_shared = shape in shared
    is_batched = batch is not None and shape[:1] == (batch,) and shape[1:] in shared
    if is_shared and is_batched and shape != (1,) and not unbatched:
        letter = PARAMETERS[name].axes[shared.index(shape)][0]
        raise InvalidInput(
            f"{opening} of shape {list(shape)} could mean one value per environment or per "
            f"{_ROWS[str(letter)]}; write it as {[batch, *shared[1]]} to say which"
        )
    if is_shared:
        return 1
    if is_batched and batch is not None:
        return batch
    if batch is None and shape[1:] in shared:
        raise InvalidInput(
            f"{opening} has shape {list(shape)}; accepted are {_texts(shared)}. A batch axis needs "
            "a state with one: make it with initial_state(batch_size=...)"
        )
    accepted = list(shared) if batch is None else [*shared, *((batch, *s) for s in shared)]
    check_shape(opening, shape, accepted)
    raise AssertionError("a shape that is accepted is shared or batched")


def _texts(shapes: Sequence[Shape]) -> str:
    return " or ".join(str(list(shape)) for shape in shapes)
