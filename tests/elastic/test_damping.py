"""Damping: no force on rigid motion, energy loss of all other motion, derivatives."""

import numpy as np
import pytest
from elastic_meshes import STEP, differences, grid, model, on_cylinder, rigid

from diffcloth_torch import _kernels

PARAMETERS = {"stretch": 100.0, "bending": 0.5, "poisson": 0.3}
DAMPING = 0.02  # [s], of the order of the time step
RNG = np.random.default_rng(6)
MODELS = ["patch", "hinge"]


def rests(curved):
    X, faces = grid(4, 4, "alternating")
    return (np.ascontiguousarray(on_cylinder(X, 0.3, 0.4)) if curved else X), faces


@pytest.mark.parametrize("bending_model", MODELS)
@pytest.mark.parametrize("curved", [False, True])
def test_rigid_motion_of_a_bent_sheet_is_not_damped(curved, bending_model):
    X, faces = rests(curved)
    x_n = rigid(X + 0.2 * RNG.normal(size=X.shape))
    x = rigid(x_n, seed=1)
    damped = model(X, faces, bending_model, damping=DAMPING, x_n=x_n, **PARAMETERS)
    plain = model(X, faces, bending_model, **PARAMETERS)
    scale = np.abs(plain.gradient(x)).max()
    np.testing.assert_allclose(damped.gradient(x), plain.gradient(x), atol=1e-12 * scale)


@pytest.mark.parametrize("bending_model", MODELS)
def test_damping_resists_every_other_motion(bending_model):
    X, faces = rests(False)
    x_n = X + 0.1 * RNG.normal(size=X.shape)
    damped = model(X, faces, bending_model, damping=DAMPING, x_n=x_n, **PARAMETERS)
    plain = model(X, faces, bending_model, **PARAMETERS)
    for _ in range(5):
        x = x_n + 1e-3 * RNG.normal(size=X.shape)
        force = damped.gradient(x) - plain.gradient(x)
        assert (force * (x - x_n)).sum() > 0
        assert damped.energy_change(x_n, x) > plain.energy_change(x_n, x)


def test_small_strain_is_damped_at_the_rate_of_its_stiffness():
    """Damping is k_d / h of the elastic energy of the step's strain, stretch and bending alike."""
    X, faces = rests(False)
    step = np.zeros_like(X)
    step[:, 0] = 1e-6 * X[:, 0]
    step[:, 2] = 1e-4 * X[:, 0] ** 2
    damped = model(X, faces, damping=DAMPING, x_n=X, **PARAMETERS)
    elastic = damped.energy(X + step)
    added = damped.energy_change(X, X + step) - elastic
    assert added == pytest.approx(DAMPING / STEP * elastic, rel=1e-3)


@pytest.mark.parametrize("bending_model", MODELS)
@pytest.mark.parametrize("curved", [False, True])
def test_gradient_and_hessian_match_differences(curved, bending_model):
    X, faces = rests(curved)
    x_n = rigid(X + 0.1 * RNG.normal(size=X.shape))
    x = x_n + 0.1 * RNG.normal(size=X.shape)
    elastic = model(X, faces, bending_model, damping=DAMPING, x_n=x_n, **PARAMETERS)
    exact = elastic.hessian(x, False)
    scale = np.abs(exact).max()
    g = differences(lambda y: elastic.energy_change(x_n, y), x, 1e-3).reshape(x.shape)
    H = differences(lambda y: elastic.gradient(y).ravel(), x, 1e-3)
    np.testing.assert_allclose(elastic.gradient(x), g, atol=1e-8 * scale)
    np.testing.assert_allclose(exact, H, atol=1e-8 * scale)
    z = RNG.normal(size=X.shape)
    np.testing.assert_allclose(
        elastic.hessian_product(x, z).ravel(), exact @ z.ravel(), atol=1e-11 * scale
    )
    assert np.linalg.eigvalsh(elastic.hessian(x, True))[0] > -1e-12 * scale


def test_damping_without_a_time_step_is_refused():
    X, faces = rests(False)
    elastic = model(X, faces)
    one = np.ones(len(faces))
    with pytest.raises(ValueError, match="damping needs the start of the step"):
        elastic.set_parameters(one, one, 0 * one, one, 0.0, X)


@pytest.mark.parametrize("bending_model", MODELS)
@pytest.mark.parametrize("positive", [False, True])
@pytest.mark.parametrize("curved", [False, True])
def test_instructions_do_not_change_a_bit(curved, positive, bending_model):
    """Flat or bent at rest, degenerate; with batches that are not full."""
    X, faces = rests(curved)
    x_n = X + 0.1 * RNG.normal(size=X.shape)
    x0 = x_n + 0.1 * RNG.normal(size=X.shape)
    x0[1] = x0[0]
    x1 = x0 + 0.1 * RNG.normal(size=X.shape)
    damped = model(X, faces, bending_model, damping=DAMPING, x_n=x_n, **PARAMETERS)
    _, counts = np.unique(np.diff(damped.stencil_start), return_counts=True)
    assert (counts % 8 != 0).any()
    assert len(faces) % 8 != 0
    for evaluate in (damped.bending, damped.stretch):
        results = [evaluate(level, x0, x1, positive) for level in _kernels.kernel_levels()]
        assert np.abs(results[0][2]).max() > 0.0
        for change, gradient, blocks in results[1:]:
            assert change == results[0][0]
            np.testing.assert_array_equal(gradient, results[0][1])
            np.testing.assert_array_equal(blocks, results[0][2])


@pytest.mark.parametrize("bending_model", MODELS)
@pytest.mark.parametrize("curved", [False, True])
def test_kept_evaluations_have_the_bits_of_new_ones(curved, bending_model):
    X, faces = rests(curved)
    x_n = X + 0.1 * RNG.normal(size=X.shape)
    points = [x_n + 0.1 * RNG.normal(size=X.shape) for _ in range(3)]
    damped = model(X, faces, bending_model, damping=DAMPING, x_n=x_n, **PARAMETERS)
    np.testing.assert_array_equal(
        damped.evaluations(*points, False), damped.evaluations(*points, True)
    )
