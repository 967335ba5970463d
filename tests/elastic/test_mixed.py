"""Derivatives of z . grad E with respect to everything that a model depends on."""

import numpy as np
import pytest
from elastic_meshes import (
    Elastic,
    differences,
    grid,
    on_cylinder,
    random_materials,
    rest_mesh,
    set_parameters,
)

RNG = np.random.default_rng(7)


def problem(rest, bending_model, damped, woven=False):
    X, faces = rest_mesh(rest)
    parameters = random_materials(RNG, len(faces), damped, woven)
    parameters["x_n"] = X + 0.1 * RNG.normal(size=X.shape)
    x = parameters["x_n"] + 0.1 * RNG.normal(size=X.shape)
    z = RNG.normal(size=X.shape)
    return Elastic(X, faces, bending_model), X, faces, parameters, x, z


CASES = [
    (rest, bending_model, damped)
    for rest in ("flat", "cylinder", "sphere")
    for bending_model in ("patch", "hinge")
    for damped in (0.0, 1.0)
]


@pytest.mark.parametrize("woven", [False, True])
@pytest.mark.parametrize(("rest", "bending_model", "damped"), CASES)
def test_mixed_derivatives_match_differences(rest, bending_model, damped, woven):
    elastic, X, faces, parameters, x, z = problem(rest, bending_model, damped, woven)

    def phi(name, value):
        elastic.set_rest(value if name == "X" else X)
        changed = parameters if name == "X" else parameters | {name: value}
        set_parameters(elastic, len(faces), **changed)
        result = (z * elastic.gradient(x)).sum()
        elastic.set_rest(X)
        set_parameters(elastic, len(faces), **parameters)
        return result

    set_parameters(elastic, len(faces), **parameters)
    bars = elastic.mixed(x, z, True)
    for name, value in [*parameters.items(), ("X", X)]:
        if name == "angles":
            continue
        expected = differences(lambda v, name=name: phi(name, v), value, 2e-4).reshape(value.shape)
        # Differences at 2e-4: rounding 1e-15 / 2e-4, truncation 1e-15 times fifth derivatives.
        scale = max(np.abs(expected).max(), 1e-3)
        np.testing.assert_allclose(bars[name], expected, atol=1e-7 * scale, err_msg=name)


def test_a_flat_rest_shape_has_a_first_order_effect_on_a_bent_sheet():
    """Moving a rest vertex out of plane changes the forces on a bent sheet to first order."""
    X, faces = grid(5, 5)
    elastic = Elastic(X, faces, "patch")
    one = np.ones(len(faces))
    elastic.set_parameters(0 * one, one, 0 * one, 0 * one, 0.01, X)
    assert not elastic.rest()["curved"]
    bars = elastic.mixed(on_cylinder(X, 0.3, 0.0), RNG.normal(size=X.shape), True)
    assert np.abs(bars["X"][:, 2]).max() > 0.1


def test_without_rest_the_other_cotangents_are_the_same():
    elastic, _, faces, parameters, x, z = problem("cylinder", "patch", 1.0)
    set_parameters(elastic, len(faces), **parameters)
    full = elastic.mixed(x, z, True)
    part = elastic.mixed(x, z, False)
    for name in parameters:
        np.testing.assert_array_equal(part[name], full[name])
    np.testing.assert_array_equal(part["X"], 0.0)


@pytest.mark.parametrize("rest", ["flat", "cylinder"])
def test_without_a_start_of_the_step_only_damping_is_left_out(rest):
    elastic, _, faces, parameters, x, z = problem(rest, "patch", 0.0)
    set_parameters(elastic, len(faces), **parameters)
    full = elastic.mixed(x, z, False)
    set_parameters(elastic, len(faces), **parameters | {"x_n": None})
    part = elastic.mixed(x, z, False)
    for name in ("stretch", "bending", "poisson"):
        np.testing.assert_allclose(part[name], full[name], rtol=1e-10)
    assert np.abs(full["damping"]).max() > 0
    np.testing.assert_array_equal(part["damping"], 0.0)
