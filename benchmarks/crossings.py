"""Number of intersecting pairs of triangles in a state, by the predicates of the IPC Toolkit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import diffcloth_torch as dc
from benchmarks.extra import require
from diffcloth_torch.geometry.poses import transform

ipctk = require("ipctk")


class Crossings:
    """Counts intersecting pairs of triangles: of cloths with themselves, each other and bodies."""

    def __init__(self, scene: dc.Scene) -> None:
        self._scene = scene
        surfaces = [*scene.cloths, *scene.bodies]
        counts = [len(surface.vertices) for surface in surfaces]
        starts = np.concatenate([[0], np.cumsum(counts)])
        faces = [s.faces + start for s, start in zip(surfaces, starts[:-1], strict=True)]
        self._faces = np.concatenate(faces).astype(np.int32)
        self._edges = ipctk.edges(self._faces)
        # Overlaps between bodies do not count, because the bodies of a scene are prescribed.
        is_rigid = np.arange(starts[-1]) >= starts[len(scene.cloths)]
        self._is_rigid = is_rigid[self._faces[:, 0]]
        patches = np.where(is_rigid, starts[-1], np.arange(starts[-1])).astype(np.int32)
        self._can_collide = ipctk.make_vertex_patches_filter(patches)
        self._beside: dict[tuple[int, int], list[int]] = {}
        for k, (a, b, c) in enumerate(self._faces.tolist()):
            for pair in ((a, b), (b, c), (c, a)):
                self._beside.setdefault((min(pair), max(pair)), []).append(k)

    def points(self, state: dc.State) -> NDArray[np.float64]:
        """Vertices of cloths and bodies [m]."""
        poses = state.body_poses.numpy()
        bodies = [
            transform(body.vertices, pose)
            for body, pose in zip(self._scene.bodies, poses, strict=True)
        ]
        return np.concatenate([state.positions.detach().numpy(), *bodies])

    def count(self, state: dc.State) -> int:
        """Number of pairs of triangles without a common vertex that intersect."""
        return self.count_points(self.points(state))

    def count_points(self, points: NDArray[np.float64]) -> int:
        """Number of intersecting pairs for these vertices of cloths, then bodies."""
        mesh = ipctk.CollisionMesh(points, self._edges, self._faces)
        mesh.can_collide = self._can_collide
        if not ipctk.has_intersections(mesh, points):
            return 0
        return len(self._pairs(points))

    def _pairs(self, points: NDArray[np.float64]) -> set[tuple[int, int]]:
        search = ipctk.HashGrid()
        search.build(points, self._edges, self._faces)
        pairs = set()
        for candidate in search.detect_edge_face_candidates():
            a, b = self._edges[candidate.edge_id].tolist()
            face = candidate.face_id
            corners = self._faces[face]
            if not ipctk.is_edge_intersecting_triangle(points[a], points[b], *points[corners]):
                continue
            for other in self._beside[min(a, b), max(a, b)]:
                apart = not set(corners.tolist()) & set(self._faces[other].tolist())
                if apart and not (self._is_rigid[face] and self._is_rigid[other]):
                    pairs.add((min(face, other), max(face, other)))
        return pairs
