"""Symmetric matrices of 3x3 blocks: patterns, values, dense matrices and factors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffcloth_torch import _kernels as kernels

STEP = 0.01  # time step of the cloth's Hessians [s]
SINGLE = "multifrontal, single precision"  # our own backend in single precision


@dataclass(frozen=True)
class BlockMatrix:
    """Lower blocks by column, then by row.

    Attributes:
        size: Number of vertices.
        pairs: [k, 2] (row, column), including every diagonal block.
        blocks: [k, 9] column-major.
        fixed: [size] True for vertices left out.
    """

    size: int
    pairs: np.ndarray
    blocks: np.ndarray
    fixed: np.ndarray

    @property
    def unknowns(self) -> np.ndarray:
        """Coordinates that are in the matrix."""
        return np.flatnonzero(np.repeat(~self.fixed, 3))

    def dense(self) -> np.ndarray:
        """The matrix without the fixed vertices; diagonal blocks by their lower triangles."""
        full = np.zeros((3 * self.size, 3 * self.size))
        for (i, j), block in zip(self.pairs, self.blocks.reshape(-1, 3, 3), strict=True):
            full[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = block.T
        full = np.tril(full) + np.tril(full, -1).T
        return full[np.ix_(self.unknowns, self.unknowns)]

    def shifted(self, shift: float) -> BlockMatrix:
        """The matrix plus a multiple of the identity."""
        blocks = self.blocks.copy()
        blocks[np.ix_(self.pairs[:, 0] == self.pairs[:, 1], [0, 4, 8])] += shift
        return BlockMatrix(self.size, self.pairs, blocks, self.fixed)

    def with_fixed(self, vertices: list[int]) -> BlockMatrix:
        fixed = self.fixed.copy()
        fixed[vertices] = True
        return BlockMatrix(self.size, self.pairs, self.blocks, fixed)

    def analysis(self, backend: str = "multifrontal", level: str = "", ordering: str = "automatic"):
        if backend == SINGLE:
            backend = "multifrontal"
        return kernels.CholeskyAnalysis(self.size, self.pairs, self.fixed, backend, level, ordering)

    def empty_factor(
        self, backend: str = "multifrontal", level: str = "", ordering: str = "automatic"
    ):
        """A factor on the pattern; nothing is factored yet."""
        analysis = self.analysis(backend, level, ordering)
        return kernels.CholeskyFactor(analysis, single=backend == SINGLE)

    def factor(self, backend: str = "multifrontal", level: str = "", ordering: str = "automatic"):
        """A factor; the matrix must be positive definite."""
        factor = self.empty_factor(backend, level, ordering)
        assert factor.compute(self.blocks, kernels.CholeskyWorkspace())
        return factor

    def is_positive(self, backend: str = "multifrontal", level: str = "") -> bool:
        return self.empty_factor(backend, level).compute(self.blocks, kernels.CholeskyWorkspace())

    def product(self, x: np.ndarray) -> np.ndarray:
        """A x for x [vertices, 3], without forming A densely; no vertex may be fixed."""
        y = np.zeros_like(x)
        for (i, j), block in zip(self.pairs, self.blocks.reshape(-1, 3, 3), strict=True):
            if i == j:
                y[i] += (np.tril(block.T) + np.tril(block.T, -1).T) @ x[i]
            else:
                y[i] += block.T @ x[j]
                y[j] += block @ x[i]
        return y


def solve(factor, b: np.ndarray, fill: float = 0.0, threads: int = 1) -> np.ndarray:
    """Solutions for b [count, vertices, 3]; entries of fixed vertices stay as filled."""
    x = np.full_like(b, fill)
    factor.solve(np.ascontiguousarray(b), x, kernels.CholeskyWorkspace(threads))
    return x


def sorted_pairs(size: int, pairs: list[tuple[int, int]] | np.ndarray) -> np.ndarray:
    """Lower-triangle pairs with the diagonal, in the order of slots."""
    pairs = np.array(pairs, dtype=np.int32).reshape(-1, 2)
    lower = np.stack([pairs.max(1), pairs.min(1)], 1)
    diagonal = np.repeat(np.arange(size, dtype=np.int32)[:, None], 2, axis=1)
    unique = np.unique(np.concatenate([lower, diagonal])[:, ::-1], axis=0)
    return np.ascontiguousarray(unique[:, ::-1], dtype=np.int32)


def random_matrix(
    size: int, pairs: list[tuple[int, int]] | np.ndarray, seed: int = 0
) -> BlockMatrix:
    """Positive definite by diagonal dominance, blocks neither symmetric nor of one scale."""
    rng = np.random.default_rng(seed)
    pairs = sorted_pairs(size, pairs)
    blocks = rng.uniform(-1.0, 1.0, (len(pairs), 9))
    scale = 10.0 ** rng.uniform(-3, 3, size)  # D A D is as definite as A
    couplings = np.bincount(pairs.ravel(), minlength=size)
    diagonal = pairs[:, 0] == pairs[:, 1]
    blocks[np.ix_(diagonal, [0, 4, 8])] += 3.0 * couplings[:, None]
    blocks *= (scale[pairs[:, 0]] * scale[pairs[:, 1]])[:, None]
    return BlockMatrix(size, pairs, blocks, np.zeros(size, dtype=bool))


def grid_pairs(rows: int, columns: int, reach: int) -> list[tuple[int, int]]:
    """Pairs of grid vertices at most `reach` rows and columns apart."""
    pairs = []
    for i in range(rows):
        for j in range(columns):
            for di in range(reach + 1):
                for dj in range(-reach, reach + 1):
                    if di + abs(dj) <= reach and i + di < rows and 0 <= j + dj < columns:
                        pairs.append((i * columns + j, (i + di) * columns + j + dj))
    return pairs


def cloth_matrix(n: int, contacts: int = 0, seed: int = 0) -> BlockMatrix:
    """M / h^2 and the projected Hessian of a crumpled sheet with contacts between its vertices."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    X = np.stack([u.ravel(), v.ravel(), 0 * u.ravel()], 1)
    corner = np.array([i * n + j for i in range(n - 1) for j in range(n - 1)])
    first = np.stack([corner, corner + n, corner + n + 1], 1)
    second = np.stack([corner, corner + n + 1, corner + 1], 1)
    faces = np.concatenate([first, second]).astype(np.int32)
    one = np.ones(len(faces))
    x = np.ascontiguousarray(X + rng.normal(0.0, 0.1 / n, X.shape))
    elastic = kernels.Elastic(X, faces, "patch")
    elastic.set_parameters(300.0 * one, 1e-3 * one, 0.3 * one, 0.0 * one, STEP, None)
    mass = 0.2 * elastic.rest()["vertex_area"]

    pairs = sorted_pairs(n * n, elastic.block_pairs())
    blocks = elastic.hessian_blocks(x, True)
    diagonal = pairs[:, 0] == pairs[:, 1]
    blocks[np.ix_(diagonal, [0, 4, 8])] += mass[:, None] / STEP**2
    matrix = BlockMatrix(n * n, pairs, blocks, np.zeros(n * n, dtype=bool))
    stencils = [rng.choice(n * n, 4, replace=False) for _ in range(contacts)]
    return with_contacts(matrix, stencils, rng) if contacts else matrix


def with_contacts(
    matrix: BlockMatrix, stencils: list[np.ndarray], rng: np.random.Generator
) -> BlockMatrix:
    """Add k (w n)(w n)^T over four vertices each, as a stiff barrier does."""
    added = [(a, b) for stencil in stencils for a in stencil for b in stencil]
    pairs = sorted_pairs(matrix.size, np.concatenate([matrix.pairs, added]))
    slot = {(int(i), int(j)): k for k, (i, j) in enumerate(pairs)}
    blocks = np.zeros((len(pairs), 9))
    for (i, j), block in zip(matrix.pairs, matrix.blocks, strict=True):
        blocks[slot[int(i), int(j)]] = block
    for stencil in stencils:
        w = np.outer([1.0, *-rng.dirichlet([1.0, 1.0, 1.0])], rng.normal(size=3))
        for a in range(4):
            for b in range(4):
                i, j = int(stencil[a]), int(stencil[b])
                if i >= j:
                    blocks[slot[i, j]] += 1e4 * np.outer(w[b], w[a]).ravel()  # column-major
    return BlockMatrix(matrix.size, pairs, blocks, matrix.fixed)
