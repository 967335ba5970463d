"""Stencil matrices built from vectors: against numpy, at every level, on any rows."""

import numpy as np
import pytest

from diffcloth_torch import _kernels as kernels

SIZE = 40  # vertices; the first columns are long enough for the loop of the search
ROWS = {
    "in order": [3, 9, 20, 39, 38],
    "backwards": [39, 30, 17, 2, 0],
    "mixed": [17, 39, 0, 21, 5],
    "some without": [17, -1, 0, -1, 5],
}


def cross(u: np.ndarray) -> np.ndarray:
    return np.cross(np.eye(3), u).T @ -np.eye(3)


def numbers(points: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(points)
    size = 12 if points == 4 else 16
    core = rng.normal(size=(3, 3))
    sign = np.zeros((2, points))
    sign[0, :2] = -1, 1
    sign[1, [0 if points == 5 else 2, 3]] = -1, 1
    h = rng.normal(size=(12, 12))
    return {
        "left": rng.normal(size=(3, size)),
        "core": core + core.T,
        "c": rng.normal(size=4),
        "rest": h + h.T,
        "turn": rng.normal(size=3),
        "sign": sign,
    }


def by_vectors(given: dict[str, np.ndarray]) -> tuple[dict, np.ndarray]:
    """A contact's: symmetric products, along, rest."""
    left = given["left"]
    arguments = {
        "left": left.tolist(),
        "right": (2 * left).tolist(),
        "core": [],
        "along": 0.7,
        "c": given["c"].tolist(),
        "rest": given["rest"].ravel().tolist(),
        "turn": [],
        "sign": [],
    }
    c = given["c"]
    return arguments, 2 * left.T @ left + 0.7 * np.kron(np.outer(c, c), np.eye(3)) + given["rest"]


def by_core(given: dict[str, np.ndarray]) -> tuple[dict, np.ndarray]:
    """A friction's: a core between vectors, and an edge turned by another."""
    arguments = {
        "left": given["left"].tolist(),
        "right": [],
        "core": given["core"].ravel().tolist(),
        "along": 0.0,
        "c": [],
        "rest": [],
        "turn": given["turn"].tolist(),
        "sign": given["sign"].tolist(),
    }
    points = given["sign"].shape[1]
    left = given["left"][:, : 3 * points]
    e1, e2 = given["sign"]
    turning = np.kron(np.outer(e1, e2) - np.outer(e2, e1), cross(given["turn"]))
    return arguments, left.T @ given["core"] @ left + turning


def dense(blocks: list[float]) -> np.ndarray:
    """Lower blocks of all pairs, column by column; the upper blocks remain zero."""
    result = np.zeros((SIZE, 3, SIZE, 3))
    k = 0
    values = np.array(blocks).reshape(-1, 3, 3)
    for j in range(SIZE):
        for i in range(j, SIZE):
            result[i, :, j] = values[k].T
            k += 1
    return result


@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS.keys())
@pytest.mark.parametrize(("make", "points"), [(by_vectors, 4), (by_core, 4), (by_core, 5)])
def test_a_stencil_adds_its_lower_blocks(make, points, rows):
    rows = rows[:points]
    arguments, h = make(numbers(points))
    expected = np.zeros((SIZE, 3, SIZE, 3))
    for p, i in enumerate(rows):
        for q, j in enumerate(rows):
            if i >= j >= 0:
                expected[i, :, j] = h[3 * p : 3 * p + 3, 3 * q : 3 * q + 3]
    found = [
        kernels.stencil_blocks(level, SIZE, rows, **arguments) for level in kernels.kernel_levels()
    ]
    np.testing.assert_allclose(dense(found[0]), expected, rtol=0, atol=1e-13)
    for other in found[1:]:
        assert np.array(other).tobytes() == np.array(found[0]).tobytes()
