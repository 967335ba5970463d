"""Resistance to chords: energy, gradient and Hessian in lanes against a dense reference."""

import numpy as np
import pytest
from elastic_meshes import differences, grid, model

from diffcloth_torch import _kernels

RNG = np.random.default_rng(11)
FREE = 1e-4  # q_0
STRETCH = 100.0


def scene(size):
    """A sheet, d and c with strains e from 1e-3 to 1, around sqrt(q_0)."""
    X, faces = grid(*size, "alternating")
    d = 0.3 * RNG.normal(size=X.shape)
    c = X + 0.2 * RNG.normal(size=X.shape)
    x = X + 0.2 * RNG.normal(size=X.shape)
    return X, faces, d, c, x


def gradients(X, faces, x):
    """F of each face by its rest positions, in the frame of the first edge [F, 3, 2]."""
    result = []
    for i, j, k in faces:
        u, v = X[j] - X[i], X[k] - X[i]
        e1 = u / np.linalg.norm(u)
        e2 = v - (v @ e1) * e1
        e2 /= np.linalg.norm(e2)
        rest = np.array([[u @ e1, v @ e1], [u @ e2, v @ e2]])
        result.append(np.stack([x[j] - x[i], x[k] - x[i]], axis=1) @ np.linalg.inv(rest))
    return np.array(result)


def energy(X, faces, x, d, c):
    u, v = X[faces[:, 1]] - X[faces[:, 0]], X[faces[:, 2]] - X[faces[:, 0]]
    area = 0.5 * np.linalg.norm(np.cross(u, v), axis=1)
    product = np.einsum("fka,fkb->fab", gradients(X, faces, x - c), gradients(X, faces, d))
    e = 0.5 * (product + product.transpose(0, 2, 1))
    q = (e**2).sum(axis=(1, 2))
    return float((STRETCH * area * 0.5 * q**2 / (q + FREE)).sum())


def dense(elastic, blocks, n):
    H = np.zeros((3 * n, 3 * n))
    for (i, j), block in zip(elastic.block_pairs(), blocks, strict=True):
        B = block.reshape(3, 3).T
        H[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = B
        H[3 * j : 3 * j + 3, 3 * i : 3 * i + 3] = B.T
    return H


@pytest.mark.parametrize("scale", [1.0, 0.03])
def test_chords_match_a_dense_reference(scale):
    X, faces, d, c, x = scene((3, 4))
    d *= scale
    to = x + 0.1 * RNG.normal(size=X.shape)
    elastic = model(X, faces, stretch=STRETCH)
    level = _kernels.kernel_levels()[0]
    change, g, blocks, value = elastic.chords(level, x, to, d, c)
    at = energy(X, faces, x, d, c)
    assert value == pytest.approx(at, rel=1e-12)
    assert change == pytest.approx(energy(X, faces, to, d, c) - at, rel=1e-10)

    def gradient(y):
        return elastic.chords(level, y, y, d, c)[1].ravel()

    size = np.abs(g).max()
    expected = differences(lambda y: energy(X, faces, y, d, c), x, 1e-3)
    np.testing.assert_allclose(g.ravel(), expected.ravel(), atol=1e-6 * size)
    H = dense(elastic, blocks, len(X))
    np.testing.assert_allclose(H, differences(gradient, x, 1e-3), atol=1e-6 * np.abs(H).max())
    assert np.linalg.eigvalsh(H)[0] > -1e-12 * np.abs(H).max()


def test_a_small_change_of_chords_does_not_cancel():
    X, faces, d, c, x = scene((3, 4))
    to = x + 1e-11 * RNG.normal(size=X.shape)
    elastic = model(X, faces, stretch=STRETCH)
    level = _kernels.kernel_levels()[0]
    _, g, _, _ = elastic.chords(level, x, x, d, c)
    change = elastic.chords(level, x, to, d, c)[0]
    assert change == pytest.approx((g * (to - x)).sum(), rel=1e-7)


def test_instructions_do_not_change_a_bit_of_chords():
    X, faces, d, c, x = scene((4, 4))
    assert len(faces) % 8 != 0  # a batch that is not full
    to = x + 0.1 * RNG.normal(size=X.shape)
    elastic = model(X, faces, stretch=STRETCH)
    results = [elastic.chords(level, x, to, d, c) for level in _kernels.kernel_levels()]
    for other in results[1:]:
        for value, expected in zip(other, results[0], strict=True):
            np.testing.assert_array_equal(value, expected)
