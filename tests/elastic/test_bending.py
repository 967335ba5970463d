"""The bending energy: effective stiffness, motions without energy, derivatives."""

import numpy as np
import pytest
from elastic_meshes import (
    MESHES,
    annulus,
    differences,
    fan,
    grid,
    l_shape,
    model,
    on_cylinder,
    on_sphere,
    rigid,
    slivers,
    squeezed,
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


def test_hinge_is_stiffer_than_given():
    """The known defect of the hinge model, which the patch model avoids."""
    ratio = cylinder_ratios("right", "hinge", 0.0)
    assert ratio.min() > 2.5
    assert ratio.max() / ratio.min() > 2.0


def wave_ratio(X, faces, k):
    """Energy of a small sine wave over D / 2 times the integral of the square of its curvature."""
    height = 1e-3
    x = X + np.outer(height * np.sin(X[:, :2] @ k + 0.3), [0, 0, 1])
    t, w = np.polynomial.legendre.leggauss(5)
    t, w = 0.5 * (1 + t), 0.5 * w
    u, v = np.meshgrid(t, t, indexing="ij")  # of a square, folded to a triangle
    corners = np.stack([(1 - u) * (1 - v), u, (1 - u) * v], -1).reshape(-1, 3)
    weights = (2 * (1 - u) * np.outer(w, w)).ravel()
    elastic = model(X, faces, bending=D)
    phase = corners @ (X[faces, :2] @ k)[:, :, None] + 0.3
    exact = elastic.rest()["area"] @ (np.sin(phase[..., 0]) ** 2 @ weights)
    return elastic.energy(x) / (0.5 * D * (k @ k) ** 2 * height**2 * exact)


@pytest.mark.parametrize("size", [(33, 9), (41, 6), (26, 15)])
@pytest.mark.parametrize("aspect", [1, 2, 3, 4])
@pytest.mark.parametrize("name", ["alternating", "right", "delaunay", "jittered"])
def test_a_sine_wave_along_long_edges_has_its_energy(name, aspect, size):
    """Varying curvature: a quadratic fit maps a cubic along long edges to curvature across."""
    X, faces = squeezed(name, *size, aspect)
    bound = {16: 0.05, 32: 0.01}
    for edges, allowed in bound.items():
        ratio = wave_ratio(X, faces, np.array([2 * np.pi / edges, 0.0]))
        assert ratio == pytest.approx(1, abs=allowed), edges


@pytest.mark.parametrize("aspect", [1, 2, 4])
@pytest.mark.parametrize("name", ["alternating", "right", "delaunay", "jittered"])
def test_a_sine_wave_in_other_directions_has_its_energy(name, aspect):
    X, faces = squeezed(name, 17, 41, aspect)
    across = np.array([0.0, 2 * np.pi * aspect / 16])
    assert wave_ratio(X, faces, across) == pytest.approx(1, abs=0.05)
    X, faces = squeezed(name, 25, 25, aspect)
    diagonal = np.array([1.0, 1.0]) * 2 * np.pi / 16 / np.sqrt(2)
    assert wave_ratio(X, faces, diagonal) == pytest.approx(1, abs=0.05)


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


@pytest.mark.parametrize("name", ["right", "left", "alternating", "delaunay"])
def test_modes_of_a_free_plate(name):
    """The stiffness after relaxation, of which single quadratics lose up to 45 % here."""
    X, faces = MESHES[name](13, 13)
    X /= 12
    elastic = model(X, faces, bending=1.0, poisson=0.3)
    scale = 1 / np.sqrt(elastic.rest()["vertex_area"])
    H = elastic.hessian(X, False)[2::3, 2::3]
    values = np.linalg.eigvalsh(scale[:, None] * H * scale)
    assert np.abs(values[:3]).max() < 1e-8  # affine maps and nothing else
    ratio = np.sqrt(values[3:6]) / FREE_PLATE
    # 12 cells: 4 % of discretization error in the saddle's frequency; a quarter of this at 24.
    assert (ratio > 0.95).all()
    assert (ratio < 1.005).all()


@pytest.mark.parametrize("aspect", [1, 4])
@pytest.mark.parametrize("name", MESHES)
def test_constant_curvature_leaves_no_force_inside(name, aspect):
    X, faces = squeezed(name, 11, 12, aspect)
    elastic = model(X, faces, bending=D, poisson=0.3)
    x = X.copy()
    x[:, 2] = 0.01 * (X[:, 0] ** 2 - 0.7 * X[:, 1] ** 2 + 0.4 * X[:, 0] * X[:, 1])
    grid_place = grid(11, 12)[0]
    inside = ((grid_place > 2.5) & (grid_place < [7.5, 8.5, 1]))[:, :2].all(1)
    assert inside.any()
    g = elastic.gradient(x)
    # Quadratics have the error of the filter of a fit, 2e-4 at most, and that only in slivers.
    is_regular = aspect == 1 and name in ("right", "left", "alternating", "equilateral")
    assert np.abs(g[inside]).max() < (1e-10 if is_regular else 1e-6) * np.abs(g).max()


ODD_MESHES = {
    "two triangles": lambda: grid(2, 2),
    "one row": lambda: grid(9, 2, "alternating"),
    "long row": lambda: squeezed("alternating", 9, 2, 4),
    "two rows": lambda: grid(9, 3, "alternating"),
    "long rows": lambda: squeezed("alternating", 9, 3, 4),
    "fan": fan,
    "annulus": annulus,
    "L": l_shape,
    "random": lambda: slivers(1),
    "slivers": lambda: slivers(6),
} | {
    f"{name} {aspect}": lambda name=name, aspect=aspect: squeezed(name, 9, 8, aspect)
    for name in MESHES
    for aspect in (1, 2, 4)
}


@pytest.mark.parametrize("name", ODD_MESHES)
def test_affine_maps_and_no_others_cost_nothing(name):
    X, faces = ODD_MESHES[name]()
    H = model(X, faces, bending=D, poisson=0.3).hessian(X, False)[2::3, 2::3]
    scale = 1 / np.sqrt(np.diag(H))
    affine = np.c_[np.ones(len(X)), X[:, :2] - X[:, :2].mean(0)] / scale[:, None]
    basis = np.linalg.qr(affine, mode="complete")[0]
    scaled = scale[:, None] * H * scale
    assert np.abs(scaled @ basis[:, :3]).max() < 1e-11
    others = basis[:, 3:].T @ scaled @ basis[:, 3:]
    # The smallest eigenvalue is between 1e-5 (slivers) and 1 on these meshes.
    assert np.linalg.eigvalsh(others)[0] > 1e-6


@pytest.mark.parametrize("name", ["alternating", "delaunay", "jittered"])
def test_bending_does_not_depend_on_frame_and_units(name):
    """H scales with 1 / length^2 and turns with the mesh."""
    X, faces = squeezed(name, 7, 6, 3)
    H = model(X, faces, bending=D, poisson=0.3).hessian(X, False)
    for scale in (1e-3, 1.0, 1e3):
        moved = np.ascontiguousarray(rigid(X) * scale)
        turned = model(moved, faces, bending=D, poisson=0.3).hessian(moved, False)
        np.testing.assert_allclose(turned * scale**2, H, atol=1e-10 * np.abs(H).max())


@pytest.mark.parametrize("aspect", [1, 4])
@pytest.mark.parametrize("name", ["alternating", "right", "delaunay", "jittered"])
def test_a_curved_rest_shape_bends_by_the_change_of_its_curvature(name, aspect):
    """D (c - c_0)^2 A / 2 of a sheet at rest on a cylinder that is rolled more, and flat."""
    X, faces = squeezed(name, 17, 9, aspect)
    rest = 0.02
    rolled = np.ascontiguousarray(on_cylinder(X, rest, 0.0))
    elastic = model(rolled, faces, bending=D)
    area = elastic.rest()["area"].sum()
    for curvature in (1e-6, 0.03, 0.05):
        x = np.ascontiguousarray(on_cylinder(X, curvature, 0.0))
        exact = 0.5 * D * (curvature - rest) ** 2 * area
        assert elastic.energy(x) == pytest.approx(exact, rel=0.01)


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
    # Affine maps cost nothing; a single triangle does not bend.
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
    """Against the midpoint rule, exact to third order, for small steps."""
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
