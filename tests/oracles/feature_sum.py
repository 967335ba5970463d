"""The energy of contact as a plain sum over every feature of every surface, with ipctk's distances.

Without candidates, merging and classification: the reference for the core's sums.
"""

import collections
import itertools
from dataclasses import dataclass, field

import ipctk
import numpy as np

from diffcloth_torch import _kernels as kernels


@dataclass
class ContactScene:
    """Surfaces in contact, and all that their energy depends on."""

    X: np.ndarray  # rest positions
    x: np.ndarray
    faces: np.ndarray
    surface: np.ndarray
    cloth_count: int
    prescribed: np.ndarray
    d_hat: float = 0.1
    kappa: float | np.ndarray = 3.0  # of all pairs of surfaces, or of each
    slip: float = 0.02
    thickness: list = field(default_factory=list)
    self_contact: bool = True
    body_dynamic: list = field(default_factory=list)
    ignored_pairs: list = field(default_factory=list)
    radius: list = field(default_factory=list)  # of every surface; empty: none is round

    @property
    def surface_count(self):
        return int(self.surface.max()) + 1

    def potential(self, **changes):
        count = self.surface_count
        friction = 0.1 + np.arange(count**2) / count**2
        values = {
            "kappa": np.broadcast_to(self.kappa, (count, count)).ravel().tolist(),
            "d_hat": self.d_hat,
            "slip": self.slip,
            "thickness": self.thickness or [0.0] * count,
            "friction": friction.tolist(),
            "body_dynamic": self.body_dynamic,
            "ignored_pairs": self.ignored_pairs,
            "radius": self.radius,
        } | changes
        return kernels.ContactPotential(
            self.faces.astype(np.int32),
            self.surface.tolist(),
            self.cloth_count,
            self.self_contact,
            self.X,
            self.prescribed.tolist(),
            **values,
        )


def stack(cloths, bodies, pins=(), body_dynamic=(), **values):
    """Scene of (X, x, faces) of every cloth and (x, faces) of every body."""
    parts = [*cloths, *((x, x, f) for x, f in bodies)]
    counts = [len(x) for _, x, _ in parts]
    starts = np.cumsum([0, *counts[:-1]])
    surface = np.repeat(np.arange(len(parts), dtype=np.int32), counts)
    dynamic = np.zeros(len(parts), bool)
    dynamic[len(cloths) : len(cloths) + len(body_dynamic)] = body_dynamic
    prescribed = (surface >= len(cloths)) & ~dynamic[surface]
    prescribed[list(pins)] = True
    return ContactScene(
        X=np.concatenate([X for X, _, _ in parts]).astype(float),
        x=np.concatenate([x for _, x, _ in parts]).astype(float),
        faces=np.concatenate([f + s for (_, _, f), s in zip(parts, starts, strict=True)]),
        surface=surface,
        cloth_count=len(cloths),
        prescribed=prescribed,
        body_dynamic=list(body_dynamic),
        **values,
    )


def edges_of(faces):
    return sorted({tuple(sorted((f[k], f[(k + 1) % 3]))) for f in faces for k in range(3)})


def area(a, b, c):
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a))


def distance_sq(p, q):
    """Squared distance between two edges or points."""
    if len(p) == 2 and len(q) == 2:
        return ipctk.edge_edge_distance(*p, *q)
    if len(p) == len(q):
        return np.sum((p[0] - q[0]) ** 2)
    return ipctk.point_edge_distance(p[0], *q) if len(q) == 2 else distance_sq(q, p)


class FeatureSum:
    """Sum over features; sharpness and areas of a body's features come from the core."""

    def __init__(self, scene):
        self.scene = scene
        potential = scene.potential()
        count = scene.surface_count
        self.thickness = scene.thickness or [0.0] * count
        self.radius = scene.radius or [0.0] * count
        kappa = np.broadcast_to(scene.kappa, (count, count))
        self.kappa = 0.5 * (kappa + kappa.T)
        self.faces = [
            [tuple(map(int, f)) for f in scene.faces if scene.surface[f[0]] == s]
            for s in range(count)
        ]
        self.vertex_area = collections.Counter()
        self.edge_area = collections.Counter()
        for f in scene.faces:
            if self.radius[scene.surface[f[0]]]:
                continue
            third = area(*scene.X[f]) / 3
            for k in range(3):
                self.vertex_area[f[k]] += third
                self.edge_area[tuple(sorted((f[k], f[(k + 1) % 3])))] += third
        edges = [tuple(map(int, e)) for e in potential.edges()]
        first = sum(scene.surface[e[0]] < scene.cloth_count for e in edges)
        first_vertex = int((scene.surface < scene.cloth_count).sum())
        self.edge_sharpness, self.vertex_sharpness = [], []
        for cloth in range(scene.cloth_count):
            of_edge, of_vertex = potential.sharpness(cloth)
            self.edge_sharpness.append(dict(zip(edges[first:], of_edge, strict=True)))
            self.vertex_sharpness.append(dict(enumerate(of_vertex, first_vertex)))
        self.continuation = dict(zip(edges[first:], potential.continuation(), strict=True))
        corner_area, theta, ridge_area, surface_area = potential.body_areas()
        single = [corner_area, np.clip(2 * theta / np.pi, 0, 1), ridge_area, surface_area]
        self.corner_area, share, ridge_area, self.surface_area = (
            np.float32(values).astype(float) for values in single
        )
        self.ridge_share = dict(zip(edges, share, strict=True))
        self.ridge_area = dict(zip(edges, ridge_area, strict=True))

    def barrier(self, d_sq, s, r):
        xi = 0.5 * (self.thickness[s] + self.thickness[r]) + self.radius[s] + self.radius[r]
        return self.kappa[s, r] * kernels.barrier(d_sq, xi, self.scene.d_hat)

    def counted_faces(self, s, p):
        """Faces of s that act on point p; for prescribed p, a cloth's faces with a free vertex."""
        if s >= self.scene.cloth_count or not self.scene.prescribed[p]:
            return self.faces[s]
        return [f for f in self.faces[s] if not self.scene.prescribed[list(f)].all()]

    def is_still(self, s):
        """Return whether a body is prescribed."""
        return self.scene.prescribed[self.faces[s][0][0]]

    def point_against(self, x, p, s, r):
        """Sum over the features of surface r of w b(D)."""
        faces = self.counted_faces(r, p)
        of_edge = collections.Counter(e for f in faces for e in edges_of([f]))
        of_vertex = collections.Counter(v for f in faces for v in f)
        total = sum(
            self.barrier(ipctk.point_triangle_distance(x[p], *x[list(f)]), s, r) for f in faces
        )
        for e, n_f in of_edge.items():
            if n_f != 1:
                b = self.barrier(ipctk.point_edge_distance(x[p], *x[list(e)]), s, r)
                total += (1 - n_f) * b
        for v, n_f in of_vertex.items():
            w = 1 - n_f + sum(n - 1 for e, n in of_edge.items() if v in e)
            if w:
                total += w * self.barrier(np.sum((x[p] - x[v]) ** 2), s, r)
        return total

    def mollifier(self, x, c, e):
        rest = self.scene.X
        length_sq = [np.sum((rest[i] - rest[j]) ** 2) for i, j in (c, e)]
        is_round = any(self.radius[self.scene.surface[edge[0]]] for edge in (c, e))
        return kernels.mollifier(x[[*c, *e]], kernels.mollifier_threshold(*length_sq, is_round))[0]

    def edge_against(self, x, c, s, r):
        """Sum over the sharp edges of body r."""
        total = 0.0
        for e in edges_of(self.faces[r]):
            sharpness = self.edge_sharpness[s][e]
            if not sharpness:
                continue
            inner = self.barrier(ipctk.edge_edge_distance(*x[list(c)], *x[list(e)]), s, r)
            for v, gamma in zip(e, self.continuation[e], strict=True):
                b = self.barrier(ipctk.point_edge_distance(x[v], *x[list(c)]), s, r)
                inner -= 0.5 * gamma * b
            total += sharpness * self.mollifier(x, c, e) * inner
        return total

    def energy(self, x):
        scene = self.scene
        total = 0.0
        for s in range(scene.cloth_count):
            points = np.unique(self.faces[s])
            for r in range(scene.cloth_count, len(self.faces)):
                if [s, r] in scene.ignored_pairs:
                    continue
                if self.radius[r]:
                    total += self.cloth_against_round(x, s, r)
                    continue
                for p in points:
                    if not scene.prescribed[p] or not self.is_still(r):
                        total += 0.25 * self.vertex_area[p] * self.point_against(x, p, s, r)
                for c in edges_of(self.faces[s]):
                    if not scene.prescribed[list(c)].all() or not self.is_still(r):
                        total += 0.5 * self.edge_area[c] * self.edge_against(x, c, s, r)
                mean_area = np.mean([area(*scene.X[list(f)]) for f in self.faces[s]])
                for v in np.unique(self.faces[r]):
                    sharpness = self.vertex_sharpness[s][v]
                    if sharpness:
                        sum_over_cloth = self.point_against(x, v, r, s)
                        total += 0.25 * sharpness * mean_area * sum_over_cloth
            for r in range(s, scene.cloth_count):
                total += self.between_cloths(x, s, r)
        bodies = range(scene.cloth_count, len(self.faces))
        for s, r in itertools.combinations(bodies, 2):
            still = self.is_still(s) and self.is_still(r)
            if not still and [s, r] not in scene.ignored_pairs:
                total += self.between_bodies(x, s, r)
        return total

    def skeleton(self, s):
        """Ends (one or two) of a round body, its area, and the areas of an end and of the axis."""
        ends = sorted(set(self.faces[s][0]))
        length = np.linalg.norm(self.scene.X[ends[-1]] - self.scene.X[ends[0]])
        whole = 2 * np.pi * self.radius[s] * (2 * self.radius[s] + length)
        areas = [whole, whole / 6 / len(ends), whole / 6]
        return ends, *np.float32(areas).astype(float)

    def cloth_against_round(self, x, s, r):
        """A quarter of every area, against the ends or, if nearer, the axis."""
        scene = self.scene
        ends, *_ = self.skeleton(r)
        total = 0.0
        for p, f in itertools.product(ends, self.faces[s]):
            if not (scene.prescribed[list(f)].all() and self.is_still(r)):
                b = self.barrier(ipctk.point_triangle_distance(x[p], *x[list(f)]), s, r)
                total += 0.25 * area(*scene.X[list(f)]) * b
        for c in edges_of(self.faces[s]) if len(ends) == 2 else ():
            if scene.prescribed[list(c)].all() and self.is_still(r):
                continue
            d_sq = [ipctk.edge_edge_distance(*x[list(c)], *x[ends])]
            d_sq += [ipctk.point_edge_distance(x[p], *x[list(c)]) for p in ends]
            whole, first, second = (self.barrier(d, s, r) for d in d_sq)
            weight = 0.25 * self.edge_area[c] * self.mollifier(x, c, ends)
            total += weight * (whole - first - second)
        return total

    def round_against_mesh(self, x, s, r):
        """Ends as corners, and the axis as a ridge, of a round body s and a mesh r."""
        ends, _, corner, axis = self.skeleton(s)
        corner = min(corner, self.surface_area[r])
        total = sum(0.25 * corner * self.point_against(x, p, s, r) for p in ends)
        for c in edges_of(self.faces[r]) if len(ends) == 2 else ():
            w = float(np.float32(self.ridge_share[c] * min(self.ridge_area[c], axis)))
            inner = sum(
                share * self.barrier(distance_sq(x[p], x[ends]), s, r) for p, share in self.parts(c)
            )
            total += 0.5 * w * self.mollifier(x, c, ends) * inner
        return total

    def between_round(self, x, s, r):
        (a, whole_a, corner_a, axis_a), (b, whole_b, corner_b, axis_b) = (
            self.skeleton(s),
            self.skeleton(r),
        )
        if len(a) == 2 and len(b) == 1:
            return self.between_round(x, r, s)

        def against(ends, other, corner, most):
            """Ends of one body as corners, against the whole other body."""
            sums = [self.barrier(distance_sq(x[[p]], x[other]), s, r) for p in ends]
            return 0.25 * min(corner, most) * sum(sums)

        total = against(a, b, corner_a, whole_b)
        if len(a) == 1:
            return total
        total += against(b, a, corner_b, whole_a)
        w = 0.5 * min(axis_a, axis_b) * self.mollifier(x, a, b)
        return total + w * self.barrier(distance_sq(x[a], x[b]), s, r)

    def between_bodies(self, x, s, r):
        if self.radius[s] and self.radius[r]:
            return self.between_round(x, s, r)
        if self.radius[s] or self.radius[r]:
            return self.round_against_mesh(x, *((s, r) if self.radius[s] else (r, s)))
        total = 0.0
        for a, b in ((s, r), (r, s)):
            for v in np.unique(self.faces[a]):
                area = min(self.corner_area[v], self.surface_area[b])
                if area:
                    total += 0.25 * area * self.point_against(x, v, a, b)
        for c, e in itertools.product(edges_of(self.faces[s]), edges_of(self.faces[r])):
            area = min(self.ridge_area[c], self.ridge_area[e])
            area = float(np.float32(self.ridge_share[c] * self.ridge_share[e] * area))
            if not area:
                continue
            inner = 0.0
            # Each whole edge, less half of each end at which another edge continues.
            for p, share_p in self.parts(c):
                for q, share_q in self.parts(e):
                    d_sq = distance_sq(x[p], x[q])
                    inner += share_p * share_q * self.barrier(d_sq, s, r)
            total += 0.5 * area * self.mollifier(x, c, e) * inner
        return total

    def parts(self, e):
        ends = [([v], -0.5 * g) for v, g in zip(e, self.continuation[e], strict=True) if g]
        return [(list(e), 1.0), *ends]

    def between_cloths(self, x, s, r):
        scene = self.scene
        if s == r and not scene.self_contact:
            return 0.0
        total = 0.0
        for a, b in {(s, r), (r, s)}:
            for p, f in itertools.product(np.unique(self.faces[a]), self.faces[b]):
                if p in f or scene.prescribed[[p, *f]].all():
                    continue
                d_sq = ipctk.point_triangle_distance(x[p], *x[list(f)])
                total += 0.25 * self.vertex_area[p] * self.barrier(d_sq, s, r)
        for c, e in itertools.product(edges_of(self.faces[s]), edges_of(self.faces[r])):
            if (s == r and c >= e) or set(c) & set(e) or scene.prescribed[[*c, *e]].all():
                continue
            b = self.barrier(ipctk.edge_edge_distance(*x[list(c)], *x[list(e)]), s, r)
            if b:
                weight = 0.25 * (self.edge_area[c] + self.edge_area[e])
                total += weight * self.mollifier(x, c, e) * b
        return total
