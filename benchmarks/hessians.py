"""Matrices of the factorization benchmark: Hessians of sheets with and without contact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.extra import require
from benchmarks.scenes import DT, sheet

KDTree = require("scipy.spatial").KDTree
_kernels = require("diffcloth_torch._kernels")

STRETCH, BENDING, POISSON, DENSITY = 300.0, 1e-4, 0.3, 0.2  # [N/m], [N m], [-], [kg/m^2]
BARRIER = 1e4  # stiffness of a contact [N/m]


@dataclass(frozen=True)
class Hessian:
    """A symmetric matrix by its lower 3x3 blocks, by column, then by row.

    Attributes:
        size: Vertices.
        pairs: Row and column of each block, [k, 2].
        blocks: Column-major, [k, 9].
        fixed: Vertices that are left out, [size].
    """

    size: int
    pairs: np.ndarray
    blocks: np.ndarray
    fixed: np.ndarray


def hanging(n: int) -> Hessian:
    """A wavy sheet of n x n vertices, held by two corners: the pattern of elasticity alone."""
    X, faces = sheet(n)
    x = X.copy()
    x[:, 2] = 0.05 * np.sin(9 * X[:, 0]) * np.cos(7 * X[:, 1]) - 0.2 * X[:, 0] ** 2
    return _elastic(X, faces, x, [n * (n - 1), n * n - 1])


def self_contact(n: int) -> Hessian:
    """One half of a sheet on the other: each vertex above is coupled with a triangle below."""
    X, faces = sheet(n)
    s = X[:, 1]
    x = np.stack([X[:, 0], np.where(s < 0, s, -s), np.where(s < 0, 0.0, 0.5 / (n - 1))], axis=-1)
    last = int((s < 0).reshape(n, n)[:, 0].sum()) - 1
    fixed = [*range(n), *range(last * n, (last + 1) * n)]
    matrix = _elastic(X, faces, np.ascontiguousarray(x), fixed)

    lower, upper = np.flatnonzero(s < 0), np.flatnonzero(s > 2.0 / n)
    _, nearest = KDTree(x[lower, :2]).query(x[upper, :2], k=3)
    return _with_contacts(matrix, np.concatenate([upper[:, None], lower[nearest]], axis=1))


HESSIANS = {"hanging": hanging, "self-contact": self_contact}


def _elastic(X: np.ndarray, faces: np.ndarray, x: np.ndarray, fixed: list[int]) -> Hessian:
    """M / h^2 and the projected Hessian of stretch and bending."""
    elastic = _kernels.Elastic(X, faces.astype(np.int32), "patch")
    one = np.ones(len(faces))
    elastic.set_parameters(STRETCH * one, BENDING * one, POISSON * one, 0.0 * one, DT, None)
    pairs, blocks = elastic.block_pairs(), elastic.hessian_blocks(x, True)
    inertia = DENSITY / DT**2 * elastic.rest()["vertex_area"]
    blocks[np.ix_(pairs[:, 0] == pairs[:, 1], [0, 4, 8])] += inertia[:, None]
    is_fixed = np.zeros(len(X), dtype=bool)
    is_fixed[fixed] = True
    return Hessian(len(X), pairs, blocks, is_fixed)


def _with_contacts(matrix: Hessian, stencils: np.ndarray) -> Hessian:
    """Add the stiff direction of a point against a triangle, both horizontal, for each stencil."""
    weight = np.array([1.0, -1 / 3, -1 / 3, -1 / 3])
    rows = np.repeat(stencils, 4, axis=1).ravel()
    columns = np.tile(stencils, (1, 4)).ravel()
    values = np.tile(np.outer(weight, weight).ravel(), len(stencils))
    lower = rows >= columns
    added = np.zeros((lower.sum(), 9))
    added[:, 8] = BARRIER * values[lower]

    pairs = np.concatenate([matrix.pairs, np.stack([rows, columns], axis=1)[lower]])
    key, slot = np.unique(
        pairs[:, 1].astype(np.int64) * matrix.size + pairs[:, 0], return_inverse=True
    )
    blocks = np.zeros((len(key), 9))
    np.add.at(blocks, slot, np.concatenate([matrix.blocks, added]))
    merged = np.stack([key % matrix.size, key // matrix.size], axis=1).astype(np.int32)
    return Hessian(matrix.size, merged, blocks, matrix.fixed)
