"""The C++ core of a scene, or of a part of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from diffcloth_torch import _core, cpu
from diffcloth_torch.autograd.core_function import Constant, as_array
from diffcloth_torch.checks import FloatArray
from diffcloth_torch.dynamics.limits import LimitStiffness
from diffcloth_torch.model.assembly import Assembly
from diffcloth_torch.model.options import INTEGRATORS, ContactOptions, SolverOptions
from diffcloth_torch.model.quantities import CONTROL, PARAMETERS, STATE, Fields
from diffcloth_torch.model.springs import Springs
from diffcloth_torch.sim.inputs.border import Given
from diffcloth_torch.sim.inputs.layout import Layout
from diffcloth_torch.sim.solve.trees import tree_arguments

__all__ = [
    "Core",
    "CoreOptions",
    "arrays_of",
    "constants",
    "core_inputs",
    "make_core",
    "rigid_inputs",
    "with_all_pinned",
    "with_deforming_bodies",
    "without_cloths",
]

Core = _core.Simulator

_CORE_NAMES = tuple(
    tuple((name, quantity.core) for name, quantity in table.items() if quantity.core is not None)
    for table in (STATE, CONTROL, PARAMETERS)
)


class CoreOptions(NamedTuple):
    """The options of a core, besides the arrays of a scene.

    Attributes:
        bending_models: Bending model of each cloth.
        dt: Time step [s].
        scheme: "coupled", "split" or "projective".
        contact: Contact options.
        solver: Solver options.
        begins_at_state: If true, solves begin at the start of the step, not at the inertial guess.
        integrator: "implicit_euler" or "second_order", of the scheme "coupled".
    """

    bending_models: Sequence[str]
    dt: float
    scheme: str
    contact: ContactOptions
    solver: SolverOptions
    begins_at_state: bool = False
    integrator: str = INTEGRATORS[0]


def make_core(
    assembly: Assembly,
    options: CoreOptions,
    limit_stiffness: LimitStiffness | None = None,
    *,
    all_prescribed: bool = False,
) -> _core.Simulator:
    """Make a core.

    Args:
        assembly: Arrays of the scene.
        options: Options of the core.
        limit_stiffness: Stiffness of the barriers at the limits of coordinates; None if
            all bodies move on prescribed poses.
        all_prescribed: True if the motion of all coordinates is prescribed.
    """
    trees: dict[str, Any] = {}
    if limit_stiffness is not None:
        trees = tree_arguments(assembly, limit_stiffness, all_prescribed=all_prescribed)
    seconds = options.solver.max_seconds
    return _core.Simulator(
        vertices=assembly.vertices,
        rest_positions=assembly.rest_positions,
        rest_embedding=assembly.rest_embedding,
        faces=assembly.faces,
        rest_faces=assembly.rest_faces,
        material_axes=assembly.material_axes,
        cloth_vertex_start=assembly.cloth_vertex_start,
        cloth_face_start=assembly.cloth_face_start,
        bending_models=list(options.bending_models),
        pins=np.concatenate([assembly.pins, assembly.body_vertex_rows]),
        soft_pins=assembly.soft_pins,
        attachment_start=assembly.springs.start,
        attachment_points=assembly.springs.points,
        attachment_coefficients=assembly.springs.coefficients,
        attachment_rest_lengths=assembly.springs.rest_lengths,
        attachment_targets=assembly.springs.targets,
        body_vertices=assembly.body_vertices,
        body_faces=assembly.body_faces,
        body_radii=assembly.body_radii,
        body_vertex_start=assembly.body_vertex_start,
        self_contact=options.contact.self_contact,
        dt=options.dt,
        scheme=options.scheme,
        integrator=options.integrator,
        metric=options.solver.metric or "energy",
        elastic=options.solver.elastic,
        friction_iterations=options.contact.friction_iterations,
        tolerance=options.solver.tolerance,
        max_iterations=options.solver.max_iterations,
        max_seconds=math.inf if seconds is None else seconds,
        certify=options.solver.certify == "always",
        begins_at_state=options.begins_at_state,
        ignored_pairs=assembly.ignored_pairs,
        primitive_kinds=[p.kind if p is not None else "none" for p in assembly.primitives],
        primitive_sizes=np.array(
            [p.size if p is not None else (0.0, 0.0, 0.0) for p in assembly.primitives]
        ).reshape(-1, 3),
        surface_names=list(assembly.surface_names),
        pin_names=[
            name
            for groups in (assembly.pin_groups, assembly.deforming_groups)
            for name, rows in groups.items()
            for _ in range(rows.start, rows.stop)
        ],
        **trees,
    )


def core_inputs(state: Fields, control: Fields, parameters: Fields) -> Fields:
    """Return fields by the core's names."""
    return {
        core: fields[name]
        for names, fields in zip(_CORE_NAMES, (state, control, parameters), strict=True)
        for name, core in names
        if name in fields
    }


def constants(layout: Layout, defaults: Fields) -> dict[str, Constant]:
    """Values of `core_inputs` for an empty control and default parameters."""
    fields = core_inputs({}, layout.zeros, defaults)
    return {name: Constant.of(tensor) for name, tensor in fields.items()}


def arrays_of(inputs: Fields) -> dict[str, FloatArray]:
    """Numbers of inputs, by the core's names."""
    return {name: as_array(tensor) for name, tensor in inputs.items()}


def rigid_inputs(layout: Layout, inputs: Fields) -> Fields:
    """Select the inputs of bodies and links from the inputs of a scene."""
    assembly = layout.assembly
    cloths, surfaces = assembly.cloth_count, assembly.surface_count
    none = cpu.zeros(len(inputs["positions"]), 0, 3)
    names = ("positions", "velocities", "pin_targets", "soft_pin_targets", "forces")
    kept = ("gravity", "barrier_distance", "slip_velocity")
    rigid = dict.fromkeys(names, none) | {k: inputs[k] for k in kept if k in inputs}
    if "thickness" in inputs:
        rigid["thickness"] = inputs["thickness"][:, cloths:]
    for name in ("friction", "barrier_stiffness"):
        if name not in inputs:
            continue
        rigid[name] = inputs[name]
        if rigid[name].shape[1] > 1:  # of pairs
            pairs = rigid[name].reshape(-1, surfaces, surfaces)
            rigid[name] = pairs[:, cloths:, cloths:].reshape(len(pairs), -1)
    return rigid


def with_deforming_bodies(layout: Layout, given: Given) -> Fields:
    """Inputs of the core in which deforming bodies have rows of their own.

    Their vertices are the last pins. They have no stiffness (`Border`) and no mass, but the core
    divides by masses, even where they have no effect: it gets the smallest density of the cloths.
    """
    density = given.parameters["density"]
    elastic = layout.elastic[density.shape[1]]
    smallest = torch.where(elastic, density.detach(), torch.inf).amin(dim=1, keepdim=True)
    held = torch.where(elastic, density, smallest)
    targets = [given.control[name] for name in ("pins", "body_vertices")]
    environments = max(len(rows) for rows in targets)
    wide = [rows.expand(environments, *rows.shape[1:]) for rows in targets]
    return {"density": held, "pin_targets": torch.cat(wide, dim=1)}


def without_cloths(assembly: Assembly) -> Assembly:
    """Return the scene without its cloths."""
    cloths = assembly.cloth_count
    pairs = assembly.ignored_pairs
    return replace(
        assembly,
        vertices=np.empty((0, 3)),
        rest_positions=np.empty((0, 3)),
        rest_embedding=np.empty((0, 3)),
        faces=np.empty((0, 3), dtype=np.int32),
        rest_faces=np.empty((0, 3), dtype=np.int32),
        material_axes=np.empty((0, 2)),
        cloth_vertex_start=np.zeros(1, dtype=np.int32),
        cloth_rest_start=np.zeros(1, dtype=np.int32),
        cloth_face_start=np.zeros(1, dtype=np.int32),
        pins=np.empty(0, dtype=np.int32),
        soft_pins=np.empty(0, dtype=np.int32),
        pin_groups={},
        soft_pin_groups={},
        springs=Springs(),
        deforming_count=0,
        surface_names=assembly.surface_names[cloths:],
        ignored_pairs=(pairs[(pairs >= cloths).all(axis=1)] - cloths).astype(np.int32),
    )


def with_all_pinned(assembly: Assembly) -> Assembly:
    """Return the scene with all cloth vertices pinned, so that nothing moves by itself."""
    return replace(
        assembly,
        deforming_count=0,
        pins=np.arange(len(assembly.vertices), dtype=np.int32),
        soft_pins=np.empty(0, dtype=np.int32),
        pin_groups={},
        soft_pin_groups={},
        springs=Springs(),
    )
