"""The bending energy: the stiffness that it is given, what costs nothing, its derivatives."""

import numpy as np
import pytest
from elastic_meshes import (
    MESHES,
    differences,
    grid,
    model,
    on_cylinder,
    on_sphere,
    rigid,
)

D = 0.5  # [N m]
RNG = np.random.default_rng(5)
DIRECTIONS = np.linspace(0, np.pi, 7)[:-1]


def cylinder_ratios(name, bending_model, poisson):
    """Energy over D c^2 A / 2 of a sheet on a cylinder, over several directions."""
    X, faces = MESHES[name](9, 8)
    elastic = model(X, faces, bending_model, bending=D, poisson=poisson)
    curvature = 0.02  # small against an edge: the discretization error is of second order
    exact = 0.5 * D * curvature**2 * elastic.rest()["area"].sum()
    return np.array([elastic.energy(on_cylinder(X, curvature, a)) for a in DIRECTIONS]) / exact


@pytest.mark.parametrize("poisson", [0.0, 0.3])
@pytest.mark.parametrize("name", MESHES)
def test_patch_has_the_stiffness_it_is_given(name, poisson):
    """The bending patch test, boundaries included; the acceptance bound is 5 % and 1.10."""
    ratio = cylinder_ratios(name, "patch", poisson)
    assert np.abs(ratio - 1).max() < 0.01
    assert ratio.max() / ratio.min() < 1.01


def test_hinge_does_not():
    """The known defect of the hinge, which the patch is there for."""
    ratio = cylinder_ratios("right", "hinge", 0.0)
    assert ratio.min() > 2.5
    assert ratio.max() / ratio.min() > 2.0


def test_saddle_and_sphere_differ_by_poisson():
    """x,uu = c, x,vv = +-c, x,uv = 0: E = D A c^2 (1 +- nu)."""
    X, faces = grid(6, 6)
    poisson, c = 0.3, 1e-3
    elastic = model(X, faces, bending=D, poisson=poisson)
    area = elastic.rest()["area"].sum()
    for sign in (1.0, -1.0):
        x = X.copy()
        x[:, 2] = 0.5 * c * (X[:, 0] ** 2 + sign * X[:, 1] ** 2)
        # Patches at the boundary differ from the exact quadratic by the filter of their fit.
        assert elastic.energy(x) == pytest.approx(D * area * c**2 * (1 + sign * poisson), rel=1e-3)


# Frequencies omega a^2 sqrt(rho / D) of a free square plate of side a with nu = 0.3: twist, saddle
# and dome. A. W. Leissa, The free vibration of rectangular plates, J. Sound Vib. 31, 1973.
FREE_PLATE = np.array([13.49, 19.79, 24.43])


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        pytest.param("right", 0.95, 1.005, id="one diagonal: converges, 4 % below at 12 cells"),
        pytest.param("delaunay", 0.85, 1.005, id="unstructured: relaxes a little"),
        pytest.param("alternating", 0.70, 1.005, id="alternating: relaxes, the known limit"),
    ],
)
def test_modes_of_a_free_plate(name, low, high):
    X, faces = MESHES[name](13, 13)
    X /= 12
    elastic = model(X, faces, bending=1.0, poisson=0.3)
    scale = 1 / np.sqrt(elastic.rest()["vertex_area"])
    H = elastic.hessian(X, False)[2::3, 2::3]
    values = np.linalg.eigvalsh(scale[:, None] * H * scale)
    assert np.abs(values[:3]).max() < 1e-8  # affine maps and nothing else
    ratio = np.sqrt(values[3:6]) / FREE_PLATE
    assert (ratio > low).all()
    assert (ratio < high).all()


@pytest.mark.parametrize("bending_model", ["patch", "hinge"])
@pytest.mark.parametrize("name", MESHES)
def test_affine_maps_cost_nothing(name, bending_model):
    X, faces = MESHES[name](5, 5)
    elastic = model(X, faces, bending_model, bending=D, poisson=0.3)
    assert not elastic.rest()["curved"]
    x = np.ascontiguousarray(rigid(X) @ (np.eye(3) + 0.3 * RNG.normal(size=(3, 3))))
    # Curvatures of rounding size (1e-14 for coordinates of order ten), squared and once.
    assert abs(elastic.energy(x)) < 1e-24 * len(faces)
    assert np.abs(elastic.gradient(x)).max() < 1e-11 * D


@pytest.mark.parametrize(
    "faces",
    [
        pytest.param([[0, 1, 2]], id="single triangle"),
        pytest.param([[0, 1, 2], [2, 1, 3]], id="two triangles"),
        pytest.param([[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5]], id="strip"),
    ],
)
def test_small_meshes_bend_only_where_they_can(faces):
    X = np.array([[i * 0.5, (i % 2) * 0.9, 0] for i in range(max(map(max, faces)) + 1)])
    elastic = model(X, np.array(faces, np.int32), bending=D)
    H = elastic.hessian(X, False)[2::3, 2::3]
    values = np.linalg.eigvalsh(H)
    # Affine maps (3 of them) and, in a strip, x -> y^2 - y, which no vertex sees, cost nothing.
    assert (np.abs(values[:3]) < 1e-9).all()
    assert (values > -1e-9).all()
    assert np.isfinite(H).all()


def bergou_energy(X, faces, x, k):
    """Bergou's hinge with DiffCloth's normalization, edge by edge from cotangents in space."""
    sides = {}
    for f in faces:
        for p in range(3):
            edge = tuple(sorted((f[(p + 1) % 3], f[(p + 2) % 3])))
            sides.setdefault(edge, []).append(f[p])

    def cot(o, p, q):
        a, b = X[p] - X[o], X[q] - X[o]
        return a @ b / np.linalg.norm(np.cross(a, b))

    def area(a, b, c):
        return 0.5 * np.linalg.norm(np.cross(X[b] - X[a], X[c] - X[a]))

    total = 0.0
    for (a, b), opposite in sides.items():
        if len(opposite) == 2:
            c, d = opposite
            w = cot(b, a, c) * (x[a] - x[c]) + cot(a, b, c) * (x[b] - x[c])
            w += cot(b, a, d) * (x[a] - x[d]) + cot(a, b, d) * (x[b] - x[d])
            total += 0.5 * k * 3 / (area(a, b, c) + area(a, b, d)) * w @ w
    return total


def test_hinge_is_that_of_bergou():
    X, faces = MESHES["delaunay"](5, 5)
    elastic = model(X, faces, "hinge", bending=D, poisson=0.3)
    x = X + 0.3 * RNG.normal(size=X.shape)
    assert elastic.energy(x) == pytest.approx(bergou_energy(X, faces, x, D), rel=1e-12)


def flat_rest(X):
    return X


def cylinder_rest(X):
    return on_cylinder(X, 0.3, 0.4)


def sphere_rest(X):
    return on_sphere(X, 6.0)


CURVED = [
    pytest.param(cylinder_rest, id="cylinder"),
    pytest.param(sphere_rest, id="sphere"),
]
RESTS = [pytest.param(flat_rest, id="flat"), *CURVED]
MODELS = ["patch", "hinge"]


@pytest.mark.parametrize("bending_model", MODELS)
@pytest.mark.parametrize("rest", CURVED)
def test_curved_rest_shape_is_stress_free(rest, bending_model):
    X, faces = grid(6, 5)
    X = np.ascontiguousarray(rest(X))
    elastic = model(X, faces, bending_model, bending=D, poisson=0.3, stretch=1.0)
    assert elastic.rest()["curved"]
    for x in (X, rigid(X)):
        # Rounding of curvatures of order one, squared in the energy.
        assert abs(elastic.energy(x)) < 1e-26 * len(faces)
        assert np.abs(elastic.gradient(x)).max() < 1e-12 * D
    flattened = X * [1.0, 1.0, 0.0]
    assert elastic.energy(flattened) > 1e-3 * D


@pytest.mark.parametrize("bending_model", MODELS)
@pytest.mark.parametrize("rest", RESTS)
def test_energy_and_forces_turn_with_the_sheet(rest, bending_model):
    X, faces = grid(5, 5)
    X = np.ascontiguousarray(rest(X))
    elastic = model(X, faces, bending_model, bending=D, poisson=0.3)
    x = X + 0.1 * RNG.normal(size=X.shape)
    assert elastic.energy(rigid(x)) == pytest.approx(elastic.energy(x), rel=1e-12)
    # No net force and no net torque.
    g = elastic.gradient(x)
    np.testing.assert_allclose(g.sum(0), 0, atol=1e-12)
    np.testing.assert_allclose(np.cross(x, g).sum(0), 0, atol=1e-11)


@pytest.mark.parametrize("bending_model", MODELS)
@pytest.mark.parametrize("rest", RESTS)
def test_gradient_and_hessian_match_differences(rest, bending_model):
    X, faces = grid(4, 4, "alternating")
    X = np.ascontiguousarray(rest(X))
    elastic = model(X, faces, bending_model, bending=D, poisson=0.3)
    x = rigid(X + 0.15 * RNG.normal(size=X.shape))
    scale = np.abs(elastic.hessian(x, False)).max()
    g = differences(elastic.energy, x, 1e-3).reshape(x.shape)
    H = differences(lambda x: elastic.gradient(x).ravel(), x, 1e-3)
    # Fourth-order differences at 1e-3: 1e-12 of truncation times high derivatives, 1e-13 / 1e-3 of
    # rounding.
    np.testing.assert_allclose(elastic.gradient(x), g, atol=1e-8 * scale)
    np.testing.assert_allclose(elastic.hessian(x, False), H, atol=1e-8 * scale)
    z = RNG.normal(size=X.shape)
    product = elastic.hessian(x, False) @ z.ravel()
    np.testing.assert_allclose(elastic.hessian_product(x, z).ravel(), product, atol=1e-11 * scale)


@pytest.mark.parametrize("bending_model", MODELS)
@pytest.mark.parametrize("rest", RESTS)
def test_projected_hessian_is_positive_and_exact_at_rest(rest, bending_model):
    X, faces = grid(4, 4)
    X = np.ascontiguousarray(rest(X))
    elastic = model(X, faces, bending_model, bending=D, poisson=0.3)
    x = X + 0.3 * RNG.normal(size=X.shape)
    scale = np.abs(elastic.hessian(x, True)).max()
    assert np.linalg.eigvalsh(elastic.hessian(x, True))[0] > -1e-12 * scale
    np.testing.assert_allclose(
        elastic.hessian(X, True), elastic.hessian(X, False), atol=1e-12 * scale
    )


@pytest.mark.parametrize("bending_model", MODELS)
@pytest.mark.parametrize("rest", RESTS)
@pytest.mark.parametrize("size", [1e-1, 1e-5, 1e-9])
def test_energy_change_does_not_cancel(rest, bending_model, size):
    """Against the midpoint rule, exact to third order in the step, where that is small."""
    X, faces = grid(4, 4)
    X = np.ascontiguousarray(rest(X))
    elastic = model(X, faces, bending_model, bending=D, poisson=0.3)
    x0 = X + 0.1 * RNG.normal(size=X.shape)
    x1 = x0 + size * RNG.normal(size=X.shape)
    change = elastic.energy_change(x0, x1)
    assert change == pytest.approx(-elastic.energy_change(x1, x0), rel=1e-9)
    if size == 1e-1:
        assert change == pytest.approx(elastic.energy(x1) - elastic.energy(x0), rel=1e-10)
    else:
        work = ((x1 - x0) * elastic.gradient(0.5 * (x0 + x1))).sum()
        assert change == pytest.approx(work, rel=1e-8)
