"""The stretch energy: motions without energy, traction law, derivatives."""

import numpy as np
import pytest
from elastic_meshes import (
    MESHES,
    STATES,
    TRIANGLE,
    differences,
    grid,
    jittered,
    model,
    rigid,
)

from diffcloth_torch import _kernels

K_S = 100.0  # [N/m]
RNG = np.random.default_rng(3)


@pytest.mark.parametrize("name", MESHES)
def test_rigid_motion_costs_nothing(name):
    X, faces = MESHES[name](5, 4)
    elastic = model(X, faces, stretch=K_S)
    x = rigid(X)
    # The acceptance bound 1e-12 k_s A, A of order one; forces in k_s times lengths of order one.
    assert abs(elastic.energy(x)) < 1e-12 * K_S
    assert np.abs(elastic.gradient(x)).max() < 1e-12 * K_S * 10


def test_isometric_fold_costs_nothing():
    X, faces = grid(5, 4)
    folded = X.copy()
    beyond = X[:, 0] > 2
    angle = 2.0
    folded[beyond, 0] = 2 + (X[beyond, 0] - 2) * np.cos(angle)
    folded[beyond, 2] = (X[beyond, 0] - 2) * np.sin(angle)
    elastic = model(X, faces, stretch=K_S)
    assert abs(elastic.energy(folded)) < 1e-12 * K_S
    assert np.abs(elastic.gradient(folded)).max() < 1e-12 * K_S * 10


@pytest.mark.parametrize("name", MESHES)
def test_affine_map_has_constant_traction(name):
    """Traction k_s (s1 - 1) along the stretched direction, none across: lateral contraction 0."""
    X, faces = MESHES[name](5, 4)
    s1 = 1.2
    elastic = model(X, faces, stretch=K_S)
    g = elastic.gradient(np.ascontiguousarray(X * [s1, 1.0, 1.0]))

    # The weak form of a constant stress P: force on vertex i = sum over faces A P grad phi_i.
    expected = np.zeros_like(X)
    for a, b, c in faces:
        for i, j, k in ((a, b, c), (b, c, a), (c, a, b)):
            edge = X[k] - X[j]
            expected[i, 0] += K_S * (s1 - 1) * 0.5 * -edge[1]
    np.testing.assert_allclose(g, expected, atol=1e-10 * K_S)


@pytest.mark.parametrize("state", STATES)
def test_gradient_and_hessian_match_differences(state):
    X, faces = TRIANGLE
    x = X @ state.T + 0.02 * RNG.normal(size=X.shape)
    elastic = model(X, faces, stretch=K_S)
    g = differences(elastic.energy, x, 1e-3).reshape(x.shape)
    H = differences(lambda x: elastic.gradient(x).ravel(), x, 1e-3)
    np.testing.assert_allclose(elastic.gradient(x), g, atol=1e-7 * K_S)
    np.testing.assert_allclose(elastic.hessian(x, False), H, atol=1e-7 * K_S)


@pytest.mark.parametrize("state", STATES)
def test_projected_hessian_clamps_the_eigenvalues_of_an_element(state):
    X, faces = TRIANGLE
    x = X @ state.T
    elastic = model(X, faces, stretch=K_S)
    exact = elastic.hessian(x, False)
    positive = elastic.hessian(x, True)
    floor = -1e-12 * K_S
    assert np.linalg.eigvalsh(positive)[0] > floor * 10
    if np.linalg.eigvalsh(exact)[0] > floor:
        np.testing.assert_allclose(positive, exact, atol=1e-12 * K_S)
    else:
        assert np.linalg.eigvalsh(positive - exact)[0] > floor * 10
        assert np.abs(positive - exact).max() > 1e-3 * K_S


def second_stress(F):
    """T = k_s A (I - S^-1) of the triangle, by a singular value decomposition of F = R S."""
    X, _ = TRIANGLE
    area = 0.5 * abs(np.linalg.det(X[1:, :2] - X[0, :2]))
    _, values, V = np.linalg.svd(F, full_matrices=False)
    return K_S * area * (np.eye(2) - V.T @ np.diag(1 / values) @ V)


def positive_part(A):
    values, V = np.linalg.eigh(A)
    return V @ np.diag(np.maximum(values, 0)) @ V.T


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("positive", [False, True])
def test_extrapolated_hessian_has_the_stress_of_the_linear_model(state, positive):
    X, faces = TRIANGLE
    elastic = model(X, faces, stretch=K_S)
    x0 = X @ state.T + 0.02 * RNG.normal(size=X.shape)
    x = x0 + 0.2 * RNG.normal(size=X.shape)
    to_gradient = np.linalg.inv((X[1:, :2] - X[0, :2]).T)

    def gradient(x):
        return (x[1:] - x[0]).T @ to_gradient

    F0, F = gradient(x0), gradient(x)
    step = 1e-5
    change = second_stress(F0 + step * (F - F0)) - second_stress(F0 - step * (F - F0))
    extrapolated, actual = second_stress(F0) + change / (2 * step), second_stress(F)
    along = np.eye(3)
    if positive:
        extrapolated, actual = positive_part(extrapolated), positive_part(actual)
        n = np.cross(F[:, 0], F[:, 1])
        along = np.outer(n, n) / (n @ n)
    shapes = np.vstack([-to_gradient.sum(axis=0), to_gradient])
    expected = np.kron(shapes @ (extrapolated - actual) @ shapes.T, along)
    H = elastic.extrapolated_hessian(x0, x, positive)
    np.testing.assert_allclose(H - elastic.hessian(x, positive), expected, atol=1e-6 * K_S)
    if not positive:
        assert np.abs(expected).max() > 1e-2 * K_S
    else:
        assert np.linalg.eigvalsh(H)[0] > -1e-11 * K_S


@pytest.mark.parametrize(
    "x",
    [
        pytest.param(np.zeros((3, 3)), id="a point"),
        pytest.param(np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0, 0]]), id="a segment"),
        pytest.param(np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-12, 0]]), id="nearly a segment"),
    ],
)
def test_degenerate_triangles_stay_finite(x):
    elastic = model(*TRIANGLE, stretch=K_S)
    assert np.isfinite(elastic.energy(x))
    assert np.isfinite(elastic.gradient(x)).all()
    for positive in (False, True):
        assert np.isfinite(elastic.hessian(x, positive)).all()
    assert np.linalg.eigvalsh(elastic.hessian(x, True))[0] > -1e-9 * K_S


def extended_energy(X, faces, x):
    """The stretch energy in extended precision."""
    X, x = X.astype(np.longdouble), x.astype(np.longdouble)
    total = np.longdouble(0)
    for a, b, c in faces:
        e1, e2 = X[b] - X[a], X[c] - X[a]
        u = np.sqrt(e1 @ e1)
        a2 = e1 @ e2 / u
        b2 = np.sqrt(e2 @ e2 - a2 * a2)
        f1 = (x[b] - x[a]) / u
        f2 = (x[c] - x[a] - a2 * f1) / b2
        c11, c12, c22 = f1 @ f1, f1 @ f2, f2 @ f2
        t = np.sqrt(c11 + c22 + 2 * np.sqrt(c11 * c22 - c12 * c12))
        total += K_S * u * b2 / 4 * (c11 + c22 - 2 * t + 2)
    return total


@pytest.mark.parametrize("size", [1e-1, 1e-4, 1e-7])
def test_energy_change_does_not_cancel(size):
    X, faces = grid(4, 4)
    rng = np.random.default_rng(4)
    x0 = X * [1.01, 0.995, 1.0] + 1e-3 * rng.normal(size=X.shape)
    x1 = x0 + size * rng.normal(size=X.shape)
    elastic = model(X, faces, stretch=K_S)
    expected = extended_energy(X, faces, x1) - extended_energy(X, faces, x0)
    # Rounding of the forces times the step; extended precision itself limits the reference.
    allowed = 1e-13 * K_S * size * len(faces) + 1e-17 * K_S * len(faces)
    assert abs(elastic.energy_change(x0, x1) - float(expected)) < allowed


@pytest.mark.parametrize("positive", [False, True])
def test_instructions_do_not_change_a_bit(positive):
    """Regular, compressed and degenerate faces; their number is no multiple of the lanes."""
    X, faces = jittered(6, 4)
    rng = np.random.default_rng(7)
    x0 = X * [0.9, 1.2, 1.0] + 0.2 * rng.normal(size=X.shape)
    x0[1] = x0[0]
    x1 = x0 + 0.1 * rng.normal(size=X.shape)
    elastic = model(X, faces, stretch=K_S)
    results = [elastic.stretch(level, x0, x1, positive) for level in _kernels.kernel_levels()]
    assert len(faces) % 8 != 0
    assert np.abs(results[0][1]).max() > 0.0
    for change, gradient, blocks in results[1:]:
        assert change == results[0][0]
        np.testing.assert_array_equal(gradient, results[0][1])
        np.testing.assert_array_equal(blocks, results[0][2])
