"""Threads that share one factorization and its solves: the bits of one thread, and its errors."""

import os
import sys
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from block_matrices import cloth_matrix, grid_pairs, kernels, random_matrix, solve

# All matrices are large enough for shared work.
MATRICES = {
    "cloth": lambda: cloth_matrix(44),
    "cloth in contact": lambda: cloth_matrix(40, contacts=400),
    "pinned": lambda: cloth_matrix(44).with_fixed(list(range(0, 44 * 44, 97))),
    # The top of the elimination tree has all the work.
    "dense with leaves": lambda: random_matrix(320, dense(290) + [(290 + k, k) for k in range(30)]),
    # Sheets of several sizes with interleaved numbers; the last one has no neighbors.
    "disconnected": lambda: random_matrix(2960, scattered((30, 12, 34, 24, 6)), seed=3),
    # Two sheets and many isolated vertices, all coupled to one row, as to a body's row.
    "star": lambda: random_matrix(1802, star((30, 24), 325), seed=4),
}
THREADS = (2, 3, 4)


def dense(count: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(count) for j in range(i)]


def scattered(sizes: tuple[int, ...]) -> np.ndarray:
    pairs, begin = [], 0
    for n in sizes:
        pairs += [(a + begin, b + begin) for a, b in grid_pairs(n, n, 3)]
        begin += n * n
    return np.random.default_rng(4).permutation(2960)[np.array(pairs)]


def star(sizes: tuple[int, ...], alone: int) -> list[tuple[int, int]]:
    pairs, begin = [], 1
    for n in sizes:
        pairs += [(a + begin, b + begin) for a, b in grid_pairs(n, n, 4)]
        begin += n * n
    return pairs + [(0, k) for k in range(1, begin + alone)]


@cache
def matrix(name: str):
    made = MATRICES[name]()
    return made, made.analysis()


def factored(name: str, threads: int, level: str = "", single: bool = False):
    made, analysis = matrix(name)
    factor = kernels.CholeskyFactor(made.analysis(level=level) if level else analysis, single)
    assert factor.compute(made.blocks, kernels.CholeskyWorkspace(threads))
    return made, factor


def thread_count() -> int:
    return len(list(Path("/proc/self/task").iterdir()))


linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="counts threads in /proc")


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("name", MATRICES)
def test_any_number_of_threads_has_the_bits_of_one(name, single):
    made, alone = factored(name, 1, single=single)
    b = np.random.default_rng(5).normal(size=(5, made.size, 3))
    expected = solve(alone, b)
    for threads in THREADS:
        _, factor = factored(name, threads, single=single)
        assert np.array_equal(solve(factor, b), expected)
        assert np.array_equal(solve(alone, b, threads=threads), expected)
        assert np.array_equal(solve(alone, b[:1], threads=threads), expected[:1])


@pytest.mark.parametrize("name", MATRICES)
def test_shared_solutions_have_a_residual_of_rounding(name):
    made, factor = factored(name, 2)
    b = np.random.default_rng(6).normal(size=(made.size, 3))
    x = solve(factor, b[None], threads=2)[0]
    free = ~made.fixed
    sizes = type(made)(made.size, made.pairs, np.abs(made.blocks), made.fixed)
    x[made.fixed] = 0.0
    bound = sizes.product(np.abs(x)) + np.abs(b)
    # Bound of test_cholesky.py.
    assert (np.abs(made.product(x) - b)[free] <= 1e-13 * bound[free]).all()


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("level", kernels.kernel_levels())
def test_levels_share_their_work_too(level, single):
    made, alone = factored("cloth", 1, level, single)
    _, factor = factored("cloth", 2, level, single)
    b = np.random.default_rng(7).normal(size=(1, made.size, 3))
    assert np.array_equal(solve(factor, b, threads=2), solve(alone, b))


def test_a_solution_may_be_written_over_its_right_side():
    made, factor = factored("disconnected", 2)
    b = np.random.default_rng(8).normal(size=(2, made.size, 3))
    expected = solve(factor, b)
    factor.solve(b, b, kernels.CholeskyWorkspace(3))
    assert np.array_equal(b, expected)


@pytest.mark.parametrize("name", ["cloth", "disconnected"])
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_an_indefinite_matrix_is_found_wherever_it_is(name, threads):
    made, analysis = matrix(name)
    diagonal = np.flatnonzero(made.pairs[:, 0] == made.pairs[:, 1])
    factor = kernels.CholeskyFactor(analysis)
    workspace = kernels.CholeskyWorkspace(threads)
    b = np.ones((1, made.size, 3))
    expected = solve(factored(name, 1)[1], b)
    for slot in np.random.default_rng(9).choice(diagonal, 12):
        blocks = made.blocks.copy()
        blocks[slot, 4] = -1.0
        assert not factor.compute(blocks, workspace)
    assert factor.compute(made.blocks, workspace)
    assert np.array_equal(solve(factor, b, threads=threads), expected)


def test_a_workspace_serves_matrices_of_any_size():
    workspace = kernels.CholeskyWorkspace(2)
    small = cloth_matrix(10)
    for _ in range(3):
        for name in ("cloth", "dense with leaves"):
            made, analysis = matrix(name)
            factor = kernels.CholeskyFactor(analysis)
            b = np.random.default_rng(10).normal(size=(1, made.size, 3))
            x = np.zeros_like(b)
            assert factor.compute(made.blocks, workspace)
            factor.solve(b, x, workspace)
            assert np.array_equal(x, solve(factored(name, 1)[1], b))
        assert kernels.CholeskyFactor(small.analysis()).compute(small.blocks, workspace)


@linux
@pytest.mark.parametrize("name", MATRICES)
def test_helpers_begin_with_the_first_large_matrix_and_end_with_the_workspace(name):
    made, analysis = matrix(name)
    small = cloth_matrix(10)
    before = thread_count()
    workspace = kernels.CholeskyWorkspace(3)
    assert kernels.CholeskyFactor(small.analysis()).compute(small.blocks, workspace)
    assert thread_count() == before
    for _ in range(2):
        assert kernels.CholeskyFactor(analysis).compute(made.blocks, workspace)
        assert thread_count() == before + 2
    del workspace
    assert thread_count() == before


@linux
def test_helpers_sleep_while_there_is_nothing_to_do():
    made, analysis = matrix("cloth")
    workspace = kernels.CholeskyWorkspace(3)
    assert kernels.CholeskyFactor(analysis).compute(made.blocks, workspace)
    before = os.times()
    time.sleep(0.5)
    after = os.times()
    assert after.user + after.system - before.user - before.system < 0.1  # [s]


def chain(count: int) -> list[list[int]]:
    return [[i - 1] if i else [] for i in range(count)]


def tree(count: int) -> list[list[int]]:
    """A binary tree: each inner work waits for two works of the row below."""
    before = [[] for _ in range(count)]
    row = list(range(count))
    while len(row) > 1:
        for j in range(0, len(row) - 1, 2):
            before.append([row[j], row[j + 1]])
        row = list(range(len(before) - len(row) // 2, len(before)))
    return before


def at_random(count: int) -> list[list[int]]:
    rng = np.random.default_rng(1)
    before = [rng.integers(0, max(i, 1), rng.integers(0, 3) if i else 0) for i in range(count)]
    return [[int(j) for j in some] for some in before]


@pytest.mark.parametrize("threads", [-1, 0, 1, 2, 3, 8])
@pytest.mark.parametrize("before", [[], [[]], [[]] * 9, chain(20), tree(16), at_random(60)])
def test_works_wait_for_their_predecessors(before, threads):
    taken = kernels.run_team(before, threads, 0.0, 200)
    assert sorted(turn for _, turn in taken) == list(range(len(before)))
    assert all(0 <= member < max(threads, 1) for member, _ in taken)


def test_works_are_begun_in_their_order_by_all_members():
    taken = kernels.run_team([[]] * 12, 3, 0.02, 2)
    assert {member for member, _ in taken} == {0, 1, 2}
    # Turns are counted a moment after works are taken: neighbors may swap.
    assert all(abs(turn - i) < 3 for i, (_, turn) in enumerate(taken))


def test_no_member_waits_while_another_work_may_begin():
    # The first work is long and the second waits for it; the others must not wait.
    taken = kernels.run_team([[], [0], [], [], []], 2, 0.05)
    assert taken[1][1] > 1
