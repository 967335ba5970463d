"""The constant matrix of Projective Dynamics against dense algebra."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from diffcloth_torch import _kernels

RNG = np.random.default_rng(5)


def grid_graph(rows, columns):
    """Pairs (row, column) of a lower triangle, by columns: the diagonal and two rings of a grid."""
    i, j = np.divmod(np.arange(rows * columns), columns)
    near = (np.abs(i[:, None] - i) <= 2) & (np.abs(j[:, None] - j) <= 2)
    columns_, rows_ = np.nonzero(np.triu(near))
    return np.stack([rows_, columns_], 1).astype(np.int32)


def random_values(pairs):
    """Entries of a positive definite matrix on the pairs, and that matrix."""
    n = pairs.max() + 1
    values = RNG.normal(size=len(pairs))
    A = np.zeros((n, n))
    A[pairs[:, 0], pairs[:, 1]] = values
    A = np.tril(A, -1) + np.tril(A, -1).T
    np.fill_diagonal(A, np.abs(A).sum(1) + RNG.uniform(0.1, 1.0, n))
    return A[pairs[:, 0], pairs[:, 1]].copy(), A


@pytest.mark.parametrize("fixed", [[], [0, 37, 38, 99], list(range(1, 100))], ids=len)
def test_a_solve_is_that_of_the_free_vertices(fixed):
    pairs = grid_graph(10, 10)
    values, A = random_values(pairs)
    pinned = np.zeros(100, bool)
    pinned[fixed] = True
    matrix = _kernels.ConstantMatrices(pairs, pinned).find(values)
    b = RNG.normal(size=(100, 3))
    x = np.full((100, 3), np.nan)
    matrix.solve(b, x)
    expected = np.zeros((100, 3))
    free = ~pinned
    expected[free] = np.linalg.solve(A[np.ix_(free, free)], b[free])
    np.testing.assert_allclose(x, expected, atol=1e-13)


def test_all_vertices_may_be_fixed():
    matrix = _kernels.ConstantMatrices(grid_graph(2, 2), np.ones(4, bool)).find(np.ones(10))
    x = np.full((4, 3), np.nan)
    matrix.solve(np.ones((4, 3)), x)
    np.testing.assert_array_equal(x, 0.0)


def test_an_indefinite_matrix_is_refused():
    matrices = _kernels.ConstantMatrices(grid_graph(2, 2), np.zeros(4, bool))
    with pytest.raises(Exception, match="not positive definite"):
        matrices.find(np.ones(10))


def test_the_same_values_give_the_same_matrix_on_any_thread():
    pairs = grid_graph(12, 12)
    matrices = _kernels.ConstantMatrices(pairs, np.zeros(144, bool))
    some = [random_values(pairs)[0] for _ in range(4)]
    b = RNG.normal(size=(144, 3))

    def solve(k):
        x = np.empty_like(b)
        matrices.find(some[k % 4]).solve(b, x)
        return x

    assert matrices.find(some[0]) is matrices.find(some[0])
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(solve, range(64)))
    for k, x in enumerate(results):
        np.testing.assert_array_equal(x, results[k % 4])
    assert not np.array_equal(results[0], results[1])


@pytest.mark.parametrize("entry", [0, 57, -1])
def test_matrices_that_differ_in_one_entry_are_told_apart(entry):
    pairs = grid_graph(6, 6)
    matrices = _kernels.ConstantMatrices(pairs, np.zeros(36, bool))
    values, _ = random_values(pairs)
    other = values.copy()
    other[entry] *= 1 + 1e-15
    assert other[entry] != values[entry]
    assert matrices.find(other) is not matrices.find(values)


@pytest.mark.slow
def test_a_forgotten_matrix_is_remade_with_the_same_bits():
    """More matrices than the cache of 32 MiB keeps; the values alone of each need 1 MB."""
    pairs = grid_graph(100, 100)
    matrices = _kernels.ConstantMatrices(pairs, np.zeros(10_000, bool))
    values, _ = random_values(pairs)
    b = RNG.normal(size=(10_000, 3))
    before, after = np.empty((2, *b.shape))
    first = matrices.find(values)
    first.solve(b, before)
    for k in range(1, 40):
        matrices.find(values * (1 + k))
    again = matrices.find(values)
    assert again is not first
    again.solve(b, after)
    np.testing.assert_array_equal(after, before)
