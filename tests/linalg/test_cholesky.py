"""Sparse Cholesky factorizations against dense ones, backends and instruction levels with each
other."""

import os
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from block_matrices import (
    SINGLE,
    BlockMatrix,
    cloth_matrix,
    grid_pairs,
    kernels,
    random_matrix,
    solve,
    sorted_pairs,
)

LEVELS = kernels.kernel_levels()
# Each level of our own kernels, and the other backends of this build.
DOUBLES = [pytest.param("multifrontal", level, id=level) for level in LEVELS]
DOUBLES += [pytest.param(b, "", id=b) for b in kernels.cholesky_backends() if b != "multifrontal"]
METHODS = [*DOUBLES, *(pytest.param(SINGLE, level, id=f"{level}, single") for level in LEVELS)]
# Units of roundoff for judging residuals and definiteness: n eps is the usual bound for n unknowns,
# and factors have far shorter sums.
ROUNDING = {SINGLE: 1e-5}


def random_graph(size: int, couplings: int, seed: int) -> list[tuple[int, int]]:
    rng = np.random.default_rng(seed)
    return [tuple(rng.choice(size, 2, replace=False)) for _ in range(couplings)]


def disconnected() -> BlockMatrix:
    """Three sheets and vertices without neighbors, numbered across each other."""
    pairs = [(a + 36 * k, b + 36 * k) for k in range(3) for a, b in grid_pairs(6, 6, 2)]
    number = np.random.default_rng(4).permutation(115)
    return random_matrix(115, number[np.array(pairs)], seed=4)


MATRICES = {
    "one vertex": lambda: random_matrix(1, []),
    "two vertices": lambda: random_matrix(2, [(1, 0)]),
    "uncoupled": lambda: random_matrix(9, []),
    "chain": lambda: random_matrix(40, [(i, i + 1) for i in range(39)]),
    "long chain": lambda: random_matrix(300, [(i, i + 1) for i in range(299)]),
    "star": lambda: random_matrix(30, [(0, i) for i in range(1, 30)]),
    **{
        f"dense {n}": lambda n=n: random_matrix(n, [(i, j) for i in range(n) for j in range(i)])
        for n in (3, 5, 8, 11, 16, 33, 50)
    },
    "strip": lambda: random_matrix(3 * 60, grid_pairs(3, 60, 2)),
    "grid, one ring": lambda: random_matrix(13 * 11, grid_pairs(13, 11, 1)),
    "grid, two rings": lambda: random_matrix(12 * 12, grid_pairs(12, 12, 2)),
    "grid, three rings": lambda: random_matrix(9 * 14, grid_pairs(9, 14, 3)),
    "sparse at random": lambda: random_matrix(150, random_graph(150, 200, 1), seed=1),
    "denser at random": lambda: random_matrix(80, random_graph(80, 500, 2), seed=2),
    "disconnected": disconnected,
    "fixed row": lambda: random_matrix(100, grid_pairs(10, 10, 2)).with_fixed(list(range(10))),
    "scattered fixed": lambda: random_matrix(100, grid_pairs(10, 10, 2)).with_fixed(
        [0, 37, 38, 99]
    ),
    "all but one fixed": lambda: random_matrix(9, grid_pairs(3, 3, 1)).with_fixed(
        [0, 1, 2, 3, 5, 6, 7, 8]
    ),
    "all fixed": lambda: random_matrix(9, grid_pairs(3, 3, 1)).with_fixed(list(range(9))),
    "cloth": lambda: cloth_matrix(14),
    "cloth, pinned": lambda: cloth_matrix(14).with_fixed(list(range(14))),
    "cloth in contact": lambda: cloth_matrix(14, contacts=60),
    "cloth in much contact": lambda: cloth_matrix(10, contacts=400),
}


@pytest.fixture(scope="module", params=MATRICES)
def matrix(request):
    return MATRICES[request.param]()


@pytest.mark.parametrize(("backend", "level"), METHODS)
def test_solution_has_a_residual_of_rounding(matrix, backend, level):
    """Residual against |A||x|, which a backward stable solver keeps near the unit roundoff."""
    b = np.random.default_rng(5).normal(size=(3, matrix.size, 3))
    x = solve(matrix.factor(backend, level), b)
    dense = matrix.dense()
    x, b = (v.reshape(3, -1)[:, matrix.unknowns].T for v in (x, b))
    bound = np.abs(dense) @ np.abs(x) + np.abs(b)
    assert (np.abs(dense @ x - b) <= ROUNDING.get(backend, 1e-13) * bound).all()


def test_the_analysis_counts_the_fill_of_a_dense_elimination(matrix):
    """Entries of L: no fewer than the pattern needs, no more than the lower triangle."""
    n = len(matrix.unknowns)
    for backend in kernels.cholesky_backends():
        analysis = matrix.analysis(backend)
        assert analysis.dimension() == n
        free = ~matrix.fixed[matrix.pairs].any(1)
        off_diagonal = matrix.pairs[:, 0] != matrix.pairs[:, 1]
        needed = 9 * (free & off_diagonal).sum() + 6 * (free & ~off_diagonal).sum()
        assert needed <= analysis.nonzeros() <= n * (n + 1) // 2
        assert analysis.nonzeros() <= analysis.flops() + 1
        assert analysis.bytes() > 0
        # A factor holds at least its entries.
        assert matrix.factor(backend).bytes() >= 8 * analysis.nonzeros()


def test_merged_supernodes_store_few_zeros():
    """Our factor against Eigen's exact structure, in the same elimination order."""
    matrix = cloth_matrix(24)
    exact, stored = (matrix.analysis(b).nonzeros() for b in ("eigen", "multifrontal"))
    assert exact <= stored <= 1.2 * exact


@pytest.mark.parametrize(("backend", "level"), METHODS)
def test_entries_of_fixed_vertices_stay(backend, level):
    matrix = MATRICES["scattered fixed"]()
    b = np.random.default_rng(6).normal(size=(2, matrix.size, 3))
    x = solve(matrix.factor(backend, level), b, fill=7.5)
    assert (x[:, matrix.fixed] == 7.5).all()
    assert (x[:, ~matrix.fixed] != 7.5).all()


@pytest.mark.parametrize(("backend", "level"), METHODS)
def test_upper_triangles_of_diagonal_blocks_do_not_count(backend, level):
    matrix = MATRICES["grid, two rings"]()
    other = matrix.blocks.copy()
    other[np.ix_(matrix.pairs[:, 0] == matrix.pairs[:, 1], [3, 6, 7])] = np.nan
    b = np.ones((1, matrix.size, 3))
    changed = BlockMatrix(matrix.size, matrix.pairs, other, matrix.fixed)
    assert np.array_equal(
        solve(matrix.factor(backend, level), b), solve(changed.factor(backend, level), b)
    )


@pytest.mark.parametrize(("backend", "level"), DOUBLES)
@pytest.mark.parametrize("name", ["grid, two rings", "cloth in contact", "dense 33", "strip"])
def test_definiteness_is_that_of_the_eigenvalues(name, backend, level):
    """Shifted until the smallest eigenvalue is just above, or just below, zero."""
    matrix = MATRICES[name]()
    eigenvalues = np.linalg.eigvalsh(matrix.dense())
    # Rounding moves eigenvalues by about the largest one's unit roundoff.
    margin = 1e-12 * eigenvalues[-1]
    assert matrix.shifted(-eigenvalues[0] + margin).is_positive(backend, level)
    assert not matrix.shifted(-eigenvalues[0] - margin).is_positive(backend, level)
    for k in (1, len(eigenvalues) // 2, len(eigenvalues) - 1):
        middle = 0.5 * (eigenvalues[k - 1] + eigenvalues[k])
        assert not matrix.shifted(-middle).is_positive(backend, level)


@pytest.mark.parametrize(("backend", "level"), METHODS)
@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf, -np.inf])
def test_bad_values_are_reported_wherever_they_stand(backend, level, bad):
    matrix = random_matrix(60, grid_pairs(6, 10, 2))
    diagonal = np.flatnonzero(matrix.pairs[:, 0] == matrix.pairs[:, 1])
    factor = matrix.empty_factor(backend, level)
    workspace = kernels.CholeskyWorkspace()
    for slot in diagonal:
        for entry in (0, 4, 8):
            blocks = matrix.blocks.copy()
            blocks[slot, entry] = bad
            assert not factor.compute(blocks, workspace)
    if np.isnan(bad):
        for slot in range(len(matrix.pairs)):
            blocks = matrix.blocks.copy()
            blocks[slot, 2] = bad
            assert not factor.compute(blocks, workspace)


@pytest.mark.parametrize(("backend", "level"), METHODS)
def test_a_failed_factor_is_not_used_and_recovers(backend, level):
    matrix = MATRICES["cloth"]()
    b = np.ones((1, matrix.size, 3))
    expected = solve(matrix.factor(backend, level), b)
    factor = matrix.empty_factor(backend, level)
    workspace = kernels.CholeskyWorkspace()
    with pytest.raises(RuntimeError, match="has not been factored"):
        solve(factor, b)
    assert not factor.compute(matrix.shifted(-1e5).blocks, workspace)
    with pytest.raises(RuntimeError, match="has not been factored"):
        solve(factor, b)
    assert factor.compute(matrix.blocks, workspace)
    assert np.array_equal(solve(factor, b), expected)


@pytest.mark.parametrize(("backend", "level"), METHODS)
def test_history_leaves_no_trace(backend, level):
    """A reused factor and workspace yield the bits of new ones."""
    workspace = kernels.CholeskyWorkspace()
    b = np.random.default_rng(7).normal(size=(1, 196, 3))
    for contacts in (0, 60, 5):
        pattern = cloth_matrix(14, contacts=contacts)
        factor = pattern.empty_factor(backend, level)
        for shift in (0.0, 30.0, 2.0):
            matrix = pattern.shifted(shift)
            assert factor.compute(matrix.blocks, workspace)
            assert np.array_equal(solve(factor, b), solve(matrix.factor(backend, level), b))


@pytest.mark.parametrize(("backend", "level"), METHODS)
@pytest.mark.parametrize("count", [1, 4, 5, 8, 9, 13])
def test_several_right_hand_sides_have_the_bits_of_single_ones(backend, level, count):
    matrix = MATRICES["cloth in contact"]()
    factor = matrix.factor(backend, level)
    b = np.random.default_rng(8).normal(size=(count, matrix.size, 3))
    together = solve(factor, b)
    for k in range(count):
        assert np.array_equal(together[k : k + 1], solve(factor, b[k : k + 1]))


@pytest.mark.parametrize("backend", ["multifrontal", SINGLE])
@pytest.mark.parametrize("name", ["cloth", "cloth in contact", "dense 50", "disconnected"])
def test_levels_with_fused_arithmetic_agree_in_every_bit(name, backend):
    matrix = MATRICES[name]()
    b = np.random.default_rng(9).normal(size=(5, matrix.size, 3))
    fused = [level for level in LEVELS if level != "portable"]
    if len(fused) < 2:
        pytest.skip("this machine has fewer than two levels with fused multiply-add")
    first, second = (solve(matrix.factor(backend, level), b) for level in fused)
    assert np.array_equal(first, second)


@pytest.mark.quick("portable", f"{LEVELS[-1]}, single")
@pytest.mark.parametrize(("backend", "level"), METHODS)
def test_threads_do_not_disturb_each_other(backend, level):
    """Eight threads factor and solve at once, at sizes at which a shared BLAS once failed."""
    matrices = [cloth_matrix(n, contacts=20, seed=n) for n in (12, 18, 24)]
    b = [np.random.default_rng(n).normal(size=(2, m.size, 3)) for n, m in enumerate(matrices)]
    factors = [m.factor(backend, level) for m in matrices]
    expected = [solve(f, v) for f, v in zip(factors, b, strict=True)]

    def work(seed: int) -> bool:
        same = True
        for k in np.random.default_rng(seed).permutation(12) % 3:
            same &= np.array_equal(solve(factors[k], b[k]), expected[k])
            own = matrices[k].factor(backend, level)
            same &= np.array_equal(solve(own, b[k]), expected[k])
        return same

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(work, range(16)))


def test_a_forked_process_factors_too():
    """A fork copies no threads, and must not copy their locks or caches."""
    matrix = cloth_matrix(16)
    b = np.ones((1, matrix.size, 3))
    expected = solve(matrix.factor(), b)
    with ThreadPoolExecutor(2) as pool:
        assert all(pool.map(lambda _: matrix.is_positive(), range(4)))
    with warnings.catch_warnings():
        # Python 3.12 warns of any fork beside threads, such as numpy's: this test is about that.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        os._exit(0 if np.array_equal(solve(matrix.factor(), b), expected) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_backends_agree():
    matrix = MATRICES["cloth in contact"]()
    b = np.random.default_rng(10).normal(size=(1, matrix.size, 3))
    expected = np.linalg.solve(matrix.dense(), b.ravel()).reshape(b.shape)
    eigenvalues = np.linalg.eigvalsh(matrix.dense())
    condition = eigenvalues[-1] / eigenvalues[0]
    for backend in kernels.cholesky_backends():
        x = solve(matrix.factor(backend), b)
        # A hundred roundings, times the condition of the matrix.
        assert np.abs(x - expected).max() < 2e-14 * condition * np.abs(expected).max()


def test_names_that_are_not_there_are_refused():
    matrix = MATRICES["chain"]()
    with pytest.raises(ValueError, match="backend"):
        matrix.analysis("umfpack")
    with pytest.raises(ValueError, match="level"):
        matrix.analysis("multifrontal", "avx1024")


def test_workspace_grows_to_the_largest_and_stays():
    workspace = kernels.CholeskyWorkspace()
    sizes = []
    for n in (6, 20, 6):
        matrix = cloth_matrix(n)
        assert kernels.CholeskyFactor(matrix.analysis()).compute(matrix.blocks, workspace)
        sizes.append(workspace.bytes())
    assert 0 < sizes[0] < sizes[1] == sizes[2]


def test_pattern_keeps_the_order_of_slots():
    """The tests' own numbering of blocks is the core's."""
    pairs = sorted_pairs(50, random_graph(50, 120, 3))
    analysis = kernels.CholeskyAnalysis(50, pairs, np.zeros(50, dtype=bool))
    start, row = np.array(analysis.column_start()), np.array(analysis.row())
    assert np.array_equal(row, pairs[:, 0])
    assert np.array_equal(np.repeat(np.arange(50), np.diff(start)), pairs[:, 1])
