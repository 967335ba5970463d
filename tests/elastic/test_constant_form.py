"""The constant quadratic form of Projective Dynamics and its elements."""

from itertools import pairwise

import numpy as np
import pytest
from elastic_meshes import STEP, Elastic, differences, random_materials, rest_mesh, set_parameters

RNG = np.random.default_rng(11)
NO_ANCHORS = (np.zeros(0, np.int32), np.zeros(0))


def problem(rest, bending_model, damped, woven=False, rng=RNG):
    X, faces = rest_mesh(rest)
    parameters = random_materials(rng, len(faces), damped, woven) | {"x_n": X}
    elastic = Elastic(X, faces, bending_model)
    set_parameters(elastic, len(faces), **parameters)
    return elastic, X, faces, parameters


def dense(elastic, values):
    """The matrix from its entries, without the product of the core."""
    rows, columns = elastic.block_pairs().T
    n = max(rows) + 1
    L = np.zeros((n, n))
    L[rows, columns] = values
    L[columns, rows] = values
    return L


def axes(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def plate_form(p):
    """On (uu, uv, vv), by its values on nine pairs of curvatures that are turned as matrices."""
    Q = axes(p["angles"])
    coupled = p["poisson"] * np.sqrt(p["bending"] * p["bending_weft"])
    twist = 4 * p["bending_twill"] - p["bending"] - p["bending_weft"] - 2 * coupled
    units = [np.array(u) for u in ([[1, 0], [0, 0]], [[0, 0.5], [0.5, 0]], [[0, 0], [0, 1]])]
    form = np.empty((3, 3))
    # Unit curvatures have 1 in uu, in vv, or in both off-diagonal entries.
    turned = [Q.T @ (u * [[1, 2], [2, 1]]) @ Q for u in units]
    for i, a in enumerate(turned):
        for j, b in enumerate(turned):
            form[i, j] = (
                p["bending"] * a[0, 0] * b[0, 0]
                + p["bending_weft"] * a[1, 1] * b[1, 1]
                + coupled * (a[0, 0] * b[1, 1] + a[1, 1] * b[0, 0])
                + twist * a[0, 1] * b[0, 1]
            )
    return form


def from_elements(elastic, faces, parameters, bending_model):
    """The form by its definition, from the rest shape's operators."""
    rest = elastic.rest()
    factor = 1 + parameters["damping"] / STEP
    n = faces.max() + 1
    L = np.zeros((n, n))
    for f, face in enumerate(faces):
        g = rest["shape_gradient"][f]
        k = parameters["stretch"][f] * np.eye(2)
        if "angles" in parameters:
            Q = axes(parameters["angles"][f])
            k = Q @ np.diag([parameters["stretch"][f], parameters["stretch_weft"][f]]) @ Q.T
        L[np.ix_(face, face)] += rest["area"][f] * factor[f] * g @ k @ g.T
    sides = elastic.edge_faces
    inner = sides[sides[:, 1] >= 0]
    for e, (a, b) in enumerate(pairwise(elastic.stencil_start)):
        vertices = elastic.stencil_vertices[a:b]
        c = rest["curvature_operator"][a:b]
        of = [e] if bending_model == "patch" else inner[e]
        D, nu = parameters["bending"][of].mean(), parameters["poisson"][of].mean()
        Q = D * np.array([[1, 0, nu], [0, 2 * (1 - nu), 0], [nu, 0, 1]])
        if "angles" in parameters and bending_model == "patch":
            Q = plate_form({name: value[e] for name, value in parameters.items() if name != "x_n"})
        weight = rest["bending_area"][e] * (1 + parameters["damping"][of].mean() / STEP)
        L[np.ix_(vertices, vertices)] += weight * c @ Q @ c.T
    return L


CASES = [
    (rest, bending_model, damped)
    for rest in ("flat", "cylinder")
    for bending_model in ("patch", "hinge")
    for damped in (0.0, 1.0)
]


@pytest.mark.parametrize("woven", [False, True])
@pytest.mark.parametrize(("rest", "bending_model", "damped"), CASES)
def test_the_form_is_the_sum_of_its_elements(rest, bending_model, damped, woven):
    elastic, X, faces, parameters = problem(rest, bending_model, damped, woven)
    u, s, z = RNG.normal(size=(3, *X.shape))
    form = elastic.constant_form(*NO_ANCHORS, u, s, z)
    L = from_elements(elastic, faces, parameters, bending_model)
    scale = np.abs(L).max()
    np.testing.assert_allclose(dense(elastic, form["values"]), L, atol=1e-13 * scale)
    np.testing.assert_allclose(form["product"], L @ u, atol=1e-12 * scale)
    change = (((u + s) * (L @ (u + s))).sum() - (u * (L @ u)).sum()) / 2
    assert form["energy_change"] == pytest.approx(change, rel=1e-12)


@pytest.mark.parametrize("woven", [False, True])
@pytest.mark.parametrize("bending_model", ["patch", "hinge"])
def test_the_form_is_the_hessian_at_rest_out_of_plane_and_bounds_it_elsewhere(bending_model, woven):
    """Flat, undamped, shear softer than yarns: no local/global iteration raises the energy."""
    rng = np.random.default_rng(1)
    elastic, X, _, _ = problem(False, bending_model, 0.0, woven, rng)
    L = dense(elastic, elastic.constant_form(*NO_ANCHORS, X, X, X)["values"])
    x = X + 0.2 * rng.normal(size=X.shape)
    H = elastic.hessian(x, False)
    gap = np.linalg.eigvalsh(np.kron(L, np.eye(3)) - H)
    assert gap.min() > -1e-12 * np.abs(H).max()
    assert np.linalg.eigvalsh(H).min() < -1e-2  # the Hessian itself is indefinite


def test_anchors_are_on_the_diagonal_and_constants_cost_nothing_without():
    elastic, X, _, _ = problem(True, "patch", 1.0)
    constant = np.broadcast_to([0.3, -0.2, 0.5], X.shape).copy()
    free = elastic.constant_form(*NO_ANCHORS, constant, constant, X)
    np.testing.assert_array_equal(free["product"], 0.0)
    assert free["energy_change"] == 0.0
    vertex, stiffness = np.array([1, 7], np.int32), np.array([3.0, 5.0])
    held = elastic.constant_form(vertex, stiffness, constant, constant, X)
    np.testing.assert_allclose(held["product"][vertex], stiffness[:, None] * constant[:2])
    assert held["energy_change"] == pytest.approx(1.5 * 8.0 * (constant[0] ** 2).sum())
    difference = dense(elastic, held["values"] - free["values"])
    expected = np.zeros(len(X))
    expected[vertex] = stiffness
    np.testing.assert_allclose(difference, np.diag(expected), atol=1e-14)


@pytest.mark.parametrize("woven", [False, True])
@pytest.mark.parametrize(("rest", "bending_model", "damped"), CASES)
def test_mixed_derivatives_match_differences(rest, bending_model, damped, woven):
    elastic, X, faces, parameters = problem(rest, bending_model, damped, woven)
    u, z = RNG.normal(size=(2, *X.shape))

    def phi(name, value):
        elastic.set_rest(value if name == "X" else X)
        changed = parameters if name == "X" else parameters | {name: value}
        set_parameters(elastic, len(faces), **changed)
        result = (z * elastic.constant_form(*NO_ANCHORS, u, u, z)["product"]).sum()
        elastic.set_rest(X)
        set_parameters(elastic, len(faces), **parameters)
        return result

    bars = elastic.constant_form(*NO_ANCHORS, u, u, z)
    for name in [n for n in parameters if n not in ("angles", "x_n")] + ["X"]:
        value = X if name == "X" else parameters[name]
        expected = differences(lambda v, name=name: phi(name, v), value, 2e-4).reshape(value.shape)
        scale = max(np.abs(expected).max(), 1e-3)
        np.testing.assert_allclose(bars[name], expected, atol=1e-7 * scale, err_msg=name)
