"""All pairs of surfaces that overlap at the start of a scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from diffcloth_torch import _core
from diffcloth_torch.autograd.core_function import as_array
from diffcloth_torch.checks import OVERLAPPING, FloatArray, IndexArray
from diffcloth_torch.model.assembly import Assembly
from diffcloth_torch.model.defaults import surface_thickness
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.model.robot_tree import moves_by_forces
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.surfaces import Surfaces

__all__ = ["overlapping_pairs", "with_overlaps_ignored"]

# Surfaces closer than this share of the scene's extent count as overlapping: for touching
# surfaces, rounding in forward kinematics would decide.
_TOUCHING = 1e-10

_ROOT = 6  # coordinates of a floating root


class _Placed(NamedTuple):
    """A surface in the world: vertices [n, 3], faces [f, 3], and its reach from them [m]."""

    vertices: FloatArray
    faces: IndexArray
    radius: float
    thickness: float

    @property
    def reach(self) -> float:
        return self.radius + self.thickness / 2

    @property
    def box(self) -> FloatArray:
        """Lower and upper corner, shape [2, 3]."""
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        return np.stack([low - self.reach, high + self.reach])

    def part_in(self, box: FloatArray) -> _Placed:
        """The faces whose boxes meet a box; all faces of a round surface."""
        if self.radius > 0.0:
            return self
        corners = self.vertices[self.faces]
        low, high = corners.min(axis=1) - self.reach, corners.max(axis=1) + self.reach
        faces = self.faces[((low <= box[1]) & (high >= box[0])).all(axis=1)]
        used, inverse = np.unique(faces, return_inverse=True)
        return self._replace(
            vertices=self.vertices[used], faces=inverse.reshape(-1, 3).astype(np.int32)
        )


def with_overlaps_ignored(scene: Scene, assembly: Assembly, start: Fields) -> Assembly:
    """Add the pairs that overlap to the pairs that do not collide, if the scene requests it.

    Args:
        scene: The scene. Its `ignore_contact` refers to all bodies and links, a robot's to the
            links of the robot.
        assembly: Arrays of the scene.
        start: Fields of the initial state.
    """
    whole = scene.ignore_contact == OVERLAPPING
    robots = [
        name
        for name, robot in zip(scene.robot_names, scene.robots, strict=True)
        if robot.ignore_contact == OVERLAPPING
    ]
    if not whole and not robots:
        return assembly
    owners = [assembly.mechanisms[m].name for m in assembly.surface_mechanism.tolist()]
    cloths = assembly.cloth_count

    def is_meant(a: int, b: int) -> bool:
        if min(a, b) < cloths:
            return False
        return whole or (owners[a - cloths] == owners[b - cloths] and owners[a - cloths] in robots)

    found = overlapping_pairs(scene, assembly, start)
    meant = [pair for pair in found if is_meant(*pair)]
    pairs = sorted({*map(tuple, assembly.ignored_pairs.tolist()), *meant})
    return replace(assembly, ignored_pairs=np.array(pairs, dtype=np.int32).reshape(-1, 2))


def overlapping_pairs(scene: Scene, assembly: Assembly, start: Fields) -> list[tuple[int, int]]:
    """Pairs of surfaces that intersect, touch, or are closer than their thickness.

    Pairs that do not collide, pairs in which forces move neither surface, cloths with bodies that
    they touch at their vertices, and overlaps of a cloth with itself are left out.

    Args:
        scene: The scene.
        assembly: Arrays of the scene.
        start: Fields of the initial state.

    Returns:
        Pairs of indices into `assembly.surface_names`, the smaller one first, in order.
    """
    surfaces = _placed(scene, assembly, start)
    if not surfaces:
        return []
    ignored = set(map(tuple, assembly.ignored_pairs.tolist()))
    is_free = [True] * assembly.cloth_count + [
        moves_by_forces(assembly.mechanisms[m], link)
        for m, link in zip(
            assembly.surface_mechanism.tolist(), assembly.surface_link.tolist(), strict=True
        )
    ]
    is_nodal = [primitive is not None for primitive in assembly.primitives]
    touches_nodes = [False] * assembly.cloth_count + is_nodal
    boxes = [surface.box for surface in surfaces]
    extent = np.ptp(np.concatenate(boxes), axis=0).max()
    return [
        (a, b)
        for a, b in combinations(range(len(surfaces)), 2)
        if (is_free[a] or is_free[b])
        and (a, b) not in ignored
        and not (a < assembly.cloth_count and touches_nodes[b])
        and (boxes[a][0] <= boxes[b][1] + _TOUCHING * extent).all()
        and (boxes[b][0] <= boxes[a][1] + _TOUCHING * extent).all()
        and _overlap(surfaces[a], surfaces[b], _TOUCHING * extent)
    ]


def _placed(scene: Scene, assembly: Assembly, start: Fields) -> list[_Placed]:
    points = as_array(Surfaces.of(scene, assembly).vertices(start).contiguous())
    thickness = surface_thickness(scene)
    radii = [0.0] * assembly.cloth_count + assembly.body_radii.tolist()
    parts = zip(_parts(assembly), radii, thickness.tolist(), strict=True)
    return [_Placed(points[rows], faces, radius, thick) for (rows, faces), radius, thick in parts]


def _parts(assembly: Assembly) -> Iterator[tuple[slice, IndexArray]]:
    """Rows of each surface's vertices among all vertices, and its faces as indices into these."""
    shift = len(assembly.vertices)
    for first, vertex_start, face_start, faces in (
        (0, assembly.cloth_vertex_start, assembly.cloth_face_start, assembly.faces),
        (shift, assembly.body_vertex_start, assembly.body_face_start, assembly.body_faces),
    ):
        ends = zip(pairwise(vertex_start.tolist()), pairwise(face_start.tolist()), strict=True)
        for (start, stop), (begin, end) in ends:
            yield slice(first + start, first + stop), faces[begin:end] - np.int32(start)


def _overlap(a: _Placed, b: _Placed, touching: float) -> bool:
    """Return whether two surfaces overlap, by the core's own test."""
    a = a._replace(thickness=a.thickness + touching)
    b = b._replace(thickness=b.thickness + touching)
    a = a.part_in(b.box)
    if len(a.faces) == 0:
        return False
    b = b.part_in(a.box)
    if len(b.faces) == 0:
        return False
    a = a.part_in(b.box)
    return len(a.faces) > 0 and _core_of(a, b).find_overlap(_inputs(a, b)) is not None


def _core_of(a: _Placed, b: _Placed) -> _core.Simulator:
    """Make a core of two free bodies, whose frames coincide with the world's."""
    none, integers = np.zeros(0), np.zeros(0, dtype=np.int32)
    both, all_free = np.arange(2, dtype=np.int32), np.zeros(2 * _ROOT, dtype=np.int32)
    unlimited = np.full(2 * _ROOT, np.inf)
    counts = [0, len(a.vertices), len(a.vertices) + len(b.vertices)]
    return _core.Simulator(
        vertices=np.zeros((0, 3)),
        rest_positions=np.zeros((0, 3)),
        faces=np.zeros((0, 3), dtype=np.int32),
        material_axes=np.zeros((0, 2)),
        cloth_vertex_start=np.zeros(1, dtype=np.int32),
        cloth_face_start=np.zeros(1, dtype=np.int32),
        bending_models=[],
        pins=integers,
        soft_pins=integers,
        attachment_start=np.zeros(1, dtype=np.int32),
        attachment_points=integers,
        attachment_coefficients=none,
        attachment_rest_lengths=none,
        attachment_targets=integers,
        body_vertices=np.concatenate([a.vertices, b.vertices]),
        body_faces=np.concatenate([a.faces, b.faces + np.int32(len(a.vertices))]),
        body_radii=np.array([a.radius, b.radius]),
        body_vertex_start=np.array(counts, dtype=np.int32),
        # No step is computed: any scheme, time step and tolerance will do.
        self_contact=False,
        dt=1.0,
        scheme="coupled",
        metric="energy",
        elastic="newton",
        friction_iterations=1,
        tolerance=1.0,
        max_iterations=1,
        surface_names=["a", "b"],
        tree_free=np.ones(2, dtype=np.int32),
        link_tree=both,
        link_parent=np.full(2, -1, dtype=np.int32),
        link_kind=np.zeros(2, dtype=np.int32),
        link_offset=np.tile(np.eye(4), (2, 1, 1)),
        link_axis=np.zeros((2, 3)),
        link_coordinate=np.full(2, -1, dtype=np.int32),
        link_multiplier=np.ones(2),
        link_constant=np.zeros(2),
        surface_link=both,
        coordinate_prescribed=all_free,
        coordinate_held=all_free,
        coordinate_lower=-unlimited,
        coordinate_upper=unlimited,
        limit_stiffness=np.zeros(2 * _ROOT),
        limit_zone=1.0,
        velocity_stiffness=np.zeros(2 * _ROOT),
        velocity_force=np.zeros(2 * _ROOT),
    )


def _inputs(a: _Placed, b: _Placed) -> dict[str, FloatArray]:
    nothing, still = np.zeros((1, 0, 3)), np.zeros((1, 2 * _ROOT))
    frames = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (1, 2, 1))
    of_cloths = ("positions", "velocities", "pin_targets", "soft_pin_targets", "forces")
    return dict.fromkeys(of_cloths, nothing) | {
        "gravity": np.zeros((1, 3)),
        "thickness": np.array([[a.thickness, b.thickness]]),
        "body_poses": frames,
        "body_targets": frames,
        "coordinates": still,
        "coordinate_ends": still,
        "coordinate_targets": still,
        "coordinate_metric": np.tile(np.eye(_ROOT).reshape(-1), 2)[None],
    }
