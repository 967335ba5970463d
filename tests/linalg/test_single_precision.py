"""Factors in single precision: verdicts on definiteness, range, and solves to rounding."""

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
)

LEVELS = kernels.kernel_levels()


def scaled(matrix: BlockMatrix, scale: np.ndarray) -> BlockMatrix:
    """S A S for a diagonal S of one number a coordinate."""
    s = scale.reshape(-1, 3)
    rows, columns = s[matrix.pairs[:, 0]], s[matrix.pairs[:, 1]]
    blocks = matrix.blocks.reshape(-1, 3, 3) * columns[:, :, None] * rows[:, None, :]
    return BlockMatrix(matrix.size, matrix.pairs, blocks.reshape(-1, 9), matrix.fixed)


def verdict(matrix: BlockMatrix, level: str = "", threads: int = 1) -> str:
    factor = matrix.empty_factor(SINGLE, level)
    return factor.verdict(matrix.blocks, kernels.CholeskyWorkspace(threads))


def iterate(matrix: BlockMatrix, factor, b: np.ndarray, tolerance=1e-12, most=30):
    """Solutions, and which have converged."""
    x = np.full_like(b, 7.5)
    workspace = kernels.CholeskyWorkspace()
    analysis = matrix.analysis()
    converged = factor.conjugate_gradients(
        analysis, matrix.blocks, b, x, tolerance, most, workspace
    )
    return x, converged


def solve_to_rounding(matrix: BlockMatrix, factor, b: np.ndarray) -> np.ndarray:
    x, converged = iterate(matrix, factor, b)
    assert all(converged)
    return x


def agrees(matrix: BlockMatrix, factor, b: np.ndarray) -> bool:
    workspace = kernels.CholeskyWorkspace()
    return factor.agrees(matrix.analysis(), matrix.blocks, b[None], workspace)


@pytest.mark.parametrize("level", LEVELS)
def test_powers_of_two_change_no_bit_of_the_significands(level):
    """Scales of units and of single coordinates, far beyond the range of floats."""
    matrix = cloth_matrix(12, contacts=40)
    rng = np.random.default_rng(1)
    b = rng.normal(size=(2, matrix.size, 3))
    expected = solve(matrix.factor(SINGLE, level), b)
    for exponents in (
        np.full(3 * matrix.size, 120),
        np.full(3 * matrix.size, -121),
        rng.integers(-200, 200, 3 * matrix.size),
    ):
        scale = 2.0 ** exponents.astype(float)
        factor = scaled(matrix, scale).factor(SINGLE, level)
        x = solve(factor, b * scale.reshape(-1, 3)) * scale.reshape(-1, 3)
        assert np.array_equal(x, expected)


@pytest.mark.parametrize("size", [2.0**-900, 2.0**-300, 2.0**300, 2.0**900])
def test_right_sides_of_any_size_have_the_same_significands(size):
    matrix = cloth_matrix(10)
    factor = matrix.factor(SINGLE)
    b = np.random.default_rng(2).normal(size=(3, matrix.size, 3))
    b[1] = 0.0
    assert np.array_equal(solve(factor, size * b), size * solve(factor, b))
    assert (solve(factor, b)[1] == 0.0).all()


def test_a_right_side_that_is_not_finite_gives_a_solution_that_is_not():
    matrix = cloth_matrix(8)
    b = np.ones((2, matrix.size, 3))
    b[0, 5, 1] = np.nan
    x = solve(matrix.factor(SINGLE), b)
    assert np.isnan(x[0]).any()
    assert np.array_equal(x[1:], solve(matrix.factor(SINGLE), b[1:]))


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("name", ["grid", "cloth", "cloth in contact"])
def test_a_verdict_is_right_or_none(name, level):
    """Shifted through all eigenvalues: never positive with a negative one beyond rounding."""
    matrix = {
        "grid": lambda: random_matrix(100, grid_pairs(10, 10, 2)),
        "cloth": lambda: cloth_matrix(9),
        "cloth in contact": lambda: cloth_matrix(9, contacts=30),
    }[name]()
    # Scaled to a unit diagonal, to which rounding is relative.
    dense = matrix.dense()
    root = np.sqrt(np.diag(dense))
    unit = scaled(matrix, 1.0 / root)
    eigenvalues = np.linalg.eigvalsh(dense / np.outer(root, root))
    verdicts = set()
    for shift in np.concatenate([[-0.1, 0.0], np.geomspace(1e-9, 1.0, 40)]):
        least = eigenvalues[0] - shift
        found = verdict(unit.shifted(-shift), level)
        verdicts.add(found)
        if least < -1e-5:
            assert found != "positive"
        if least > 1e-5:
            assert found != "indefinite"
        if least > 0.01:
            assert found == "positive"
    assert {"positive", "indefinite"} <= verdicts


def tied_pair() -> BlockMatrix:
    """Two vertices tied by a stiff spring and held by springs of 1e-6 its stiffness."""
    blocks = np.zeros((3, 9))
    blocks[:, [0, 4, 8]] = np.array([1.0 + 1e-6, -1.0, 1.0 + 1e-6])[:, None]
    pairs = np.array([[0, 0], [1, 0], [1, 1]], np.int32)
    return BlockMatrix(2, pairs, blocks, np.zeros(2, bool))


def test_small_pivots_are_left_to_doubles():
    matrix = tied_pair()
    assert verdict(matrix) == "unclear"
    assert matrix.is_positive()
    assert verdict(matrix.shifted(1e-3)) == "positive"
    assert verdict(matrix.shifted(-1e-3)) == "indefinite"


def beside(first: BlockMatrix, second: BlockMatrix) -> BlockMatrix:
    """Both matrices, uncoupled; eliminated in this order."""
    pairs = np.concatenate([first.pairs, second.pairs + first.size]).astype(np.int32)
    blocks = np.concatenate([first.blocks, second.blocks])
    return BlockMatrix(
        first.size + second.size, pairs, blocks, np.concatenate([first.fixed, second.fixed])
    )


def test_the_first_pivot_that_fails_decides_for_any_number_of_threads():
    """A large sheet fails late; another thread reaches the pair behind the sheet much earlier."""
    sheet = cloth_matrix(44)
    diagonal = np.flatnonzero(sheet.pairs[:, 0] == sheet.pairs[:, 1])
    workspaces = {threads: kernels.CholeskyWorkspace(threads) for threads in (1, 2, 3)}
    for slot in np.random.default_rng(3).choice(diagonal, 12, replace=False):
        blocks = sheet.blocks.copy()
        blocks[slot, [0, 4, 8]] *= 0.3
        broken = BlockMatrix(sheet.size, sheet.pairs, blocks, sheet.fixed)
        for matrix, expected in (
            (beside(broken, tied_pair()), "indefinite"),
            (beside(tied_pair(), broken), "unclear"),
        ):
            factor = matrix.empty_factor(SINGLE)
            for threads in (1, 2, 3) * 6:
                assert factor.verdict(matrix.blocks, workspaces[threads]) == expected


def test_subnormal_numbers_are_zero_inside_and_come_back():
    """Far from a load, a sheet dominated by inertia moves by less than 1e-38 of the load."""
    matrix = cloth_matrix(30).shifted(1e9)
    b = np.zeros((1, matrix.size, 3))
    b[0, 0] = 1.0
    x = np.abs(solve(matrix.factor(SINGLE), b))
    assert (x == 0.0).any()
    assert x[x > 0.0].min() > 1e-39 * x.max()
    # The mode of the thread is as before.
    assert np.array([5e-324]) * np.array([1.0]) > 0.0
    assert np.array([2.0**-1040]) + np.array([0.0]) > 0.0


@pytest.mark.parametrize("contacts", [0, 60])
@pytest.mark.parametrize("level", LEVELS)
def test_solutions_to_rounding(contacts, level):
    matrix = cloth_matrix(16, contacts=contacts).with_fixed([0, 1, 40])
    b = (
        np.random.default_rng(4).normal(size=(3, matrix.size, 3))
        * np.array([1.0, 1e-200, 1e200])[:, None, None]
    )
    x = solve_to_rounding(matrix, matrix.factor(SINGLE, level), b)
    expected = solve(matrix.factor(), b)
    for found, wanted in zip(x, expected, strict=True):
        assert np.abs(found - wanted).max() < 1e-11 * np.abs(wanted).max()


def test_several_right_sides_have_the_bits_of_one():
    """Each right side has its own iterations, independent of the others'."""
    matrix = cloth_matrix(14, contacts=60)
    factor = matrix.factor(SINGLE)
    rng = np.random.default_rng(5)
    b = rng.normal(size=(7, matrix.size, 3))
    b[2] = 0.0
    b[3] = solve(factor, b[3:4])[0]  # smooth
    b[4] = matrix.product(b[4])
    together = solve_to_rounding(matrix, factor, b)
    for k in range(len(b)):
        assert np.array_equal(together[k : k + 1], solve_to_rounding(matrix, factor, b[k : k + 1]))


def test_a_matrix_that_floats_hold_is_solved_at_once():
    """The residual is zero after one iteration."""
    blocks = np.diag([1.0, 4.0, 0.25]).reshape(1, 9)
    matrix = BlockMatrix(1, np.array([[0, 0]], np.int32), blocks, np.zeros(1, bool))
    x = solve_to_rounding(matrix, matrix.factor(SINGLE), np.array([[[1.0, 2.0, 3.0]]]))
    assert np.array_equal(x, [[[1.0, 0.5, 12.0]]])


def test_a_factor_of_another_matrix_is_found_out():
    """The refinement takes too many iterations, or the matrix is not definite."""
    matrix = cloth_matrix(14)
    b = np.random.default_rng(6).normal(size=(2, matrix.size, 3))
    far = matrix.shifted(1e7).factor(SINGLE)
    assert not any(iterate(matrix, far, b)[1])
    assert not any(iterate(matrix.shifted(-1e3), matrix.factor(SINGLE), b)[1])


def test_huge_numbers_of_vertices_left_out_make_no_solution_zero():
    """Huge numbers scale the others so that products underflow: no solution, instead of zero."""
    matrix = cloth_matrix(10).with_fixed([0])
    b = np.ones((2, matrix.size, 3))
    b[0, 0] = 1e300
    x, converged = iterate(matrix, matrix.factor(SINGLE), b)
    assert converged == [False, True]
    b[:, 1:] = 0.0
    x, converged = iterate(matrix, matrix.factor(SINGLE), b)
    assert converged == [True, True]
    assert (x == 0.0).all()


def test_right_sides_that_do_not_converge_leave_the_others_alone():
    matrix = cloth_matrix(14, contacts=60)
    factor = matrix.factor(SINGLE)
    b = np.random.default_rng(5).normal(size=(4, matrix.size, 3))
    expected = solve_to_rounding(matrix, factor, b)
    b[1, 3, 2] = np.nan
    x, converged = iterate(matrix, factor, b)
    assert converged == [True, False, True, True]
    assert np.array_equal(x[[0, 2, 3]], expected[[0, 2, 3]])


@pytest.mark.parametrize("size", [12, 24])
def test_a_negative_direction_keeps_any_right_side_from_converging(size):
    """Single precision finds the matrix definite, because rounding hides the direction."""
    matrix = cloth_matrix(size)
    root = np.sqrt(np.diag(matrix.dense()))
    unit = scaled(matrix, 1.0 / root)
    least = np.linalg.eigvalsh(unit.dense())[0]
    factor = unit.shifted(-least + 1e-6).factor(SINGLE)
    # The least eigenvalue is just below zero; the factor's matrix has 1e-6.
    hidden = unit.shifted(-least - 1e-9)
    assert not hidden.is_positive()
    for b in np.random.default_rng(7).normal(size=(20, matrix.size, 3)):
        assert not agrees(hidden, factor, b)
        # The matrix of the factor.
        assert agrees(unit.shifted(-least + 1e-6), factor, b)
