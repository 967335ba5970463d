"""The core in C++ for a scene, and for parts of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from diffcloth_torch import _core
from diffcloth_torch.checks import FloatArray
from diffcloth_torch.model.options import ContactOptions, SolverOptions
from diffcloth_torch.model.scene import Assembly
from diffcloth_torch.sim.trees import tree_arguments

__all__ = ["CoreOptions", "make_core", "with_all_pinned", "without_cloths"]


class CoreOptions(NamedTuple):
    """What a core is told besides the arrays of a scene.

    Attributes:
        bending_models: Of each cloth.
        dt: Time step [s].
        scheme: "coupled", "split" or "projective".
        contact: Contact options.
        solver: Solver options.
    """

    bending_models: Sequence[str]
    dt: float
    scheme: str
    contact: ContactOptions
    solver: SolverOptions


def make_core(
    assembly: Assembly,
    options: CoreOptions,
    limit_stiffness: FloatArray | None = None,
    *,
    all_prescribed: bool = False,
) -> _core.Simulator:
    """Make a core.

    Args:
        assembly: Arrays of the scene.
        options: What else there is to say.
        limit_stiffness: Of the barriers at the limits of coordinates, shape [n]; None where all
            bodies move on prescribed poses.
        all_prescribed: Whether all coordinates move as they are told.
    """
    trees: dict[str, Any] = {}
    if limit_stiffness is not None:
        trees = tree_arguments(assembly, limit_stiffness, all_prescribed=all_prescribed)
    return _core.Simulator(
        vertices=assembly.vertices,
        rest_vertices=assembly.rest_vertices,
        faces=assembly.faces,
        cloth_vertex_start=assembly.cloth_vertex_start,
        cloth_face_start=assembly.cloth_face_start,
        bending_models=list(options.bending_models),
        pins=assembly.pins,
        soft_pins=assembly.soft_pins,
        body_vertices=assembly.body_vertices,
        body_faces=assembly.body_faces,
        body_vertex_start=assembly.body_vertex_start,
        body_face_start=assembly.body_face_start,
        self_contact=options.contact.self_contact,
        dt=options.dt,
        scheme=options.scheme,
        metric=options.solver.metric or "energy",
        elastic=options.solver.elastic,
        friction_iterations=options.contact.friction_iterations,
        tolerance=options.solver.tolerance,
        max_iterations=options.solver.max_iterations,
        ignored_pairs=assembly.ignored_pairs,
        primitive_kinds=[p.kind if p is not None else "none" for p in assembly.primitives],
        primitive_sizes=np.array(
            [p.size if p is not None else (0.0, 0.0, 0.0) for p in assembly.primitives]
        ).reshape(-1, 3),
        surface_names=list(assembly.surface_names),
        pin_names=[
            name for name, rows in assembly.pin_groups.items() for _ in range(rows.start, rows.stop)
        ],
        **trees,
    )


def without_cloths(assembly: Assembly) -> Assembly:
    """The bodies and links of a scene alone."""
    cloths = assembly.cloth_count
    pairs = assembly.ignored_pairs
    return replace(
        assembly,
        vertices=np.empty((0, 3)),
        rest_vertices=np.empty((0, 3)),
        faces=np.empty((0, 3), dtype=np.int32),
        cloth_vertex_start=np.zeros(1, dtype=np.int32),
        cloth_face_start=np.zeros(1, dtype=np.int32),
        pins=np.empty(0, dtype=np.int32),
        soft_pins=np.empty(0, dtype=np.int32),
        pin_groups={},
        soft_pin_groups={},
        surface_names=assembly.surface_names[cloths:],
        ignored_pairs=(pairs[(pairs >= cloths).all(axis=1)] - cloths).astype(np.int32),
    )


def with_all_pinned(assembly: Assembly) -> Assembly:
    """The same scene, of which nothing moves by itself."""
    return replace(
        assembly,
        pins=np.arange(len(assembly.vertices), dtype=np.int32),
        soft_pins=np.empty(0, dtype=np.int32),
        pin_groups={},
        soft_pin_groups={},
    )
