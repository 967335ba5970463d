"""Nested dissection: an order of any graph, which fills less on large sheets."""

import numpy as np
import pytest
from block_matrices import cloth_matrix, grid_pairs, random_matrix, solve

LARGE = 5200  # vertices: beyond the size from which large graphs are dissected by default

GRAPHS = {
    "sheet": lambda: (72 * 73, grid_pairs(72, 73, 2)),
    "strip": lambda: (2600 * 2, grid_pairs(2600, 2, 1)),
    "chain": lambda: (LARGE, [(i, i + 1) for i in range(LARGE - 1)]),
    "ring": lambda: (LARGE, [(i, (i + 1) % LARGE) for i in range(LARGE)]),
    "star": lambda: (LARGE, [(0, i) for i in range(1, LARGE)]),
    "uncoupled": lambda: (LARGE, []),
    "two sheets": lambda: (
        2 * 51 * 52,
        [(2 * a + k, 2 * b + k) for k in range(2) for a, b in grid_pairs(51, 52, 1)],
    ),
    "tree": lambda: (LARGE, [((i - 1) // 2, i) for i in range(1, LARGE)]),
}


@pytest.mark.quick("sheet", "chain", "star", "two sheets")
@pytest.mark.parametrize("name", GRAPHS)
def test_large_graphs_of_any_kind_are_solved(name):
    size, pairs = GRAPHS[name]()
    matrix = random_matrix(size, pairs)
    x = np.random.default_rng(1).normal(size=(size, 3))
    b = matrix.product(x)
    y = solve(matrix.factor(), b[None])[0]
    # Rows have different scales, so residuals are judged row by row: a few roundings of their sums.
    scale = np.sqrt(matrix.blocks[matrix.pairs[:, 0] == matrix.pairs[:, 1], 0])[:, None]
    residual = np.abs(matrix.product(y) - b) / scale
    assert residual.max() <= 1e-12 * np.abs(b / scale).max()


@pytest.mark.parametrize("contacts", [0, 60])
def test_any_order_solves_the_same_matrix(contacts):
    matrix = cloth_matrix(22, contacts=contacts)  # more vertices than a part that is not cut
    b = np.random.default_rng(2).normal(size=(1, matrix.size, 3))
    orders = ("minimum degree", "nested dissection")
    first, second = (solve(matrix.factor(ordering=o), b) for o in orders)
    eigenvalues = np.linalg.eigvalsh(matrix.dense())
    condition = eigenvalues[-1] / eigenvalues[0]
    # A hundred roundings, times the condition of the matrix.
    assert np.abs(first - second).max() <= 2e-14 * condition * np.abs(first).max()
    assert not np.array_equal(first, second)


def test_dissecting_a_large_sheet_fills_less():
    size, pairs = 110 * 110, grid_pairs(110, 110, 3)
    matrix = random_matrix(size, pairs)
    degree, dissection = (
        matrix.analysis(ordering=o) for o in ("minimum degree", "nested dissection")
    )
    assert dissection.flops() < 0.95 * degree.flops()
    assert dissection.nonzeros() < degree.nonzeros()
    assert matrix.analysis().flops() == dissection.flops()


def test_small_sheets_are_left_to_minimum_degree():
    matrix = cloth_matrix(24)
    assert matrix.analysis().flops() == matrix.analysis(ordering="minimum degree").flops()
    with pytest.raises(ValueError, match="ordering"):
        matrix.analysis(ordering="alphabetical")
