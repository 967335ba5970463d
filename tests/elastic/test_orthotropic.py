"""Woven cloth: its energies against a plain formula in torch, its laws of traction and bending."""

import numpy as np
import pytest
import torch
from elastic_meshes import (
    MESHES,
    STATES,
    TRIANGLE,
    WOVEN,
    angles_along,
    differences,
    grid,
    model,
    on_cylinder,
    random_materials,
    rigid,
)

from diffcloth_torch import _kernels

K_W, K_F, K_WF = 100.0, 40.0, 7.0  # [N/m]
STRETCH = {"stretch": K_W, "stretch_weft": K_F, "stretch_shear": K_WF}
ANGLE = 0.6  # of the warp to the first side
RNG = np.random.default_rng(11)


def woven_triangle(**values):
    return model(*TRIANGLE, angles=np.array([ANGLE]), **STRETCH, **values)


def turned(angle, like):
    c, s = np.cos(angle), np.sin(angle)
    return torch.as_tensor(np.array([[c, -s], [s, c]]), dtype=like.dtype)


def stretch_energy(x, X, k_w, k_f, k_wf, angle):
    """E = A (k_w / 2 (|w| - 1)^2 + k_f / 2 (|f| - 1)^2 + k_wf (|w| + |f| - tr S)), S^2 = F^T F."""
    first = X[1] - X[0]
    r1 = first / first.norm()
    normal = torch.linalg.cross(first, X[2] - X[0])
    r2 = torch.linalg.cross(normal / normal.norm(), r1)
    sides = torch.stack([X[1] - X[0], X[2] - X[0]])
    D = torch.stack([sides @ r1, sides @ r2])  # columns: sides in the rest frame
    F = torch.stack([x[1] - x[0], x[2] - x[0]], 1) @ torch.linalg.inv(D) @ turned(angle, x)
    trace = torch.linalg.eigvalsh(F.T @ F).sqrt().sum()
    warp, weft = F.norm(dim=0)
    springs = k_w * (warp - 1) ** 2 / 2 + k_f * (weft - 1) ** 2 / 2
    return 0.5 * normal.norm() * (springs + k_wf * (warp + weft - trace))


def deformed(state, seed=0):
    X, _ = TRIANGLE
    return X @ state.T + 0.02 * np.random.default_rng(seed).normal(size=X.shape)


@pytest.mark.parametrize("state", STATES)
def test_energy_gradient_and_hessian_are_those_of_the_formula(state):
    X = torch.from_numpy(TRIANGLE[0])
    x = deformed(state)

    def energy(x):
        return stretch_energy(x.reshape(3, 3), X, K_W, K_F, K_WF, ANGLE)

    flat = torch.from_numpy(x).ravel()
    elastic = woven_triangle()
    scale = K_W * 1e-12
    assert elastic.energy(x) == pytest.approx(energy(flat).item(), abs=scale)
    g = torch.autograd.functional.jacobian(energy, flat).reshape(3, 3)
    np.testing.assert_allclose(elastic.gradient(x), g, atol=10 * scale)
    H = torch.autograd.functional.hessian(energy, flat)
    np.testing.assert_allclose(elastic.hessian(x, False), H, atol=100 * scale)


@pytest.mark.parametrize("state", STATES)
def test_mixed_derivatives_are_those_of_the_formula(state):
    X = torch.from_numpy(TRIANGLE[0]).requires_grad_()
    x = torch.from_numpy(deformed(state)).requires_grad_()
    k = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (K_W, K_F, K_WF)]
    z = RNG.normal(size=(3, 3))
    energy = stretch_energy(x, X, *k, ANGLE)
    (g,) = torch.autograd.grad(energy, x, create_graph=True)
    expected = torch.autograd.grad((torch.from_numpy(z) * g).sum(), [X, *k])
    bars = woven_triangle().mixed(x.detach().numpy(), z, True)
    np.testing.assert_allclose(bars["X"], expected[0], atol=1e-9 * K_W)
    for name, value in zip(STRETCH, expected[1:], strict=True):
        assert bars[name][0] == pytest.approx(value.item(), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("state", STATES)
def test_product_with_the_hessian_is_that_of_its_blocks(state):
    elastic = woven_triangle()
    x, z = deformed(state), RNG.normal(size=(3, 3))
    expected = elastic.hessian(x, False) @ z.ravel()
    np.testing.assert_allclose(elastic.hessian_product(x, z).ravel(), expected, atol=1e-11 * K_W)


@pytest.mark.parametrize("state", STATES)
def test_projected_hessian_clamps_the_eigenvalues_of_an_element(state):
    elastic = woven_triangle()
    x = deformed(state)
    exact, positive = elastic.hessian(x, False), elastic.hessian(x, True)
    floor = -1e-11 * K_W
    assert np.linalg.eigvalsh(positive)[0] > floor
    if np.linalg.eigvalsh(exact)[0] > floor:
        np.testing.assert_allclose(positive, exact, atol=-floor)
    else:
        assert np.linalg.eigvalsh(positive - exact)[0] > floor
        assert np.abs(positive - exact).max() > 1e-3 * K_W


@pytest.mark.parametrize("height", [0.0, 1e-12, 1e-6])
def test_energy_changes_between_degenerate_triangles(height):
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, height, 0]])
    longer = np.array([[0.0, 0, 0], [1.3, 0, 0], [0.4, 0, height]])
    point = 1e-10 * flat
    elastic = woven_triangle()
    for x0, x1 in ((flat, longer), (longer, flat), (flat, point), (point, flat), (flat, flat)):
        change = elastic.energy(x1) - elastic.energy(x0)
        assert elastic.energy_change(x0, x1) == pytest.approx(change, abs=1e-12 * K_W)


def yarn_lengths(X, x, angle):
    side, other = X[1:, :2] - X[0, :2]
    first = side / np.linalg.norm(side)
    second = np.array([-first[1], first[0]]) * np.sign(first[0] * other[1] - first[1] * other[0])
    F = (x[1:] - x[0]).T @ np.linalg.inv((X[1:, :2] - X[0, :2]).T) @ np.stack([first, second], 1)
    c, s = np.cos(angle), np.sin(angle)
    return np.linalg.norm(F @ np.array([[c, -s], [s, c]]), axis=0)


@pytest.mark.parametrize("ratio", [1.0 + 1e-9, 10.0, 1e4])
def test_projected_hessian_is_that_of_the_eigenvalues_of_the_form_of_f(ratio):
    """H = B^T h B with the map B from motions of the corners to changes of F, 6 x 9.

    If a yarn is so short that its own force turns it, k_wf + (k - k_wf) (1 - 1 / |y|) < 0, the
    projection raises this stiffness first; the result is positive and no smaller than the Hessian.
    """
    X, _ = TRIANGLE
    rng = np.random.default_rng(8)
    to_gradient = np.linalg.inv((X[1:, :2] - X[0, :2]).T)
    shapes = np.vstack([-to_gradient.sum(axis=0), to_gradient])
    B = np.kron(shapes.T, np.eye(3))
    clamped = raised = definite = 0
    for _ in range(300):
        k = K_W * ratio ** rng.uniform(-1, 1, 3)
        values = dict(zip(STRETCH, k, strict=True))
        angle = rng.uniform(-3, 3)
        elastic = model(*TRIANGLE, angles=np.array([angle]), **values)
        x = X @ np.diag([*rng.uniform(0.1, 1.6, 2), 1.0]) + 0.05 * rng.normal(size=X.shape)
        inverse = np.linalg.pinv(B)
        form = inverse.T @ elastic.hessian(x, False) @ inverse
        y, V = np.linalg.eigh(form)
        positive = elastic.hessian(x, True)
        # A clamped eigenvalue is zero up to rounding of the largest.
        rounding = 1e-9 * np.abs(y).max()
        across = k[2] + (k[:2] - k[2]) * (1 - 1 / yarn_lengths(X, x, angle))
        if across.min() >= 0:
            expected = B.T @ (V @ np.diag(np.maximum(y, 0)) @ V.T) @ B
            np.testing.assert_allclose(positive, expected, atol=rounding)
            clamped += y[0] < -1e-2 * k.min()
            definite += y[0] > -rounding
        else:
            assert y[0] < 0
            assert np.linalg.eigvalsh(positive)[0] > -rounding
            assert np.linalg.eigvalsh(positive - elastic.hessian(x, False))[0] > -rounding
            raised += 1
    assert clamped > 40
    assert definite > 20
    assert raised > 10 or ratio < 10


@pytest.mark.parametrize("k_wf", [0.02 * K_F, 0.3 * K_F, 3 * K_W])
@pytest.mark.parametrize("angle", [0.0, 90.0])
def test_a_yarn_under_tension_does_not_shear_by_itself(angle, k_wf):
    """The Hessian at the strain T / k of a dead load T is positive in plane and out of plane."""
    X, faces = MESHES["jittered"](5, 4)
    values = STRETCH | {"stretch_shear": k_wf}
    elastic = model(X, faces, angles=angles_along(X, faces, np.radians(angle)), **values)
    for strain in (0.01, 0.1, 0.6, 3.0):
        H = elastic.hessian(np.ascontiguousarray(X * [1 + strain, 1, 1]), False)
        y = np.linalg.eigvalsh(H)
        assert y[0] > -1e-12 * y[-1]


@pytest.mark.parametrize("state", STATES)
def test_energy_and_its_derivatives_turn_with_the_cloth(state):
    X, faces = MESHES["jittered"](4, 4)
    rng = np.random.default_rng(12)
    elastic = model(X, faces, angles=rng.uniform(-3, 3, len(faces)), **STRETCH)
    x = X @ state.T + 0.05 * rng.normal(size=X.shape)
    R = rigid(np.eye(3)) - rigid(np.zeros((3, 3)))  # rows: images of the axes
    turned = np.ascontiguousarray(x @ R + [3.0, -2.0, 1.0])
    assert elastic.energy(turned) == pytest.approx(elastic.energy(x), rel=1e-12)
    np.testing.assert_allclose(elastic.gradient(turned), elastic.gradient(x) @ R, atol=1e-11 * K_W)
    turn = np.kron(np.eye(len(X)), R)
    for positive in (False, True):
        expected = turn.T @ elastic.hessian(x, positive) @ turn
        np.testing.assert_allclose(elastic.hessian(turned, positive), expected, atol=1e-10 * K_W)


@pytest.mark.parametrize("positive", [False, True])
@pytest.mark.parametrize("damped", [0.0, 1.0])
def test_instructions_do_not_change_a_bit(positive, damped):
    """Compressed, degenerate, a part isotropic, a part damped; with batches that are not full."""
    X, faces = MESHES["jittered"](6, 4)
    rng = np.random.default_rng(9)
    values = random_materials(rng, len(faces), damped, woven=True)
    values["damping"][::3] = 0.0
    for name in ("stretch_weft", "stretch_shear"):
        values[name][:5] = values["stretch"][:5]
    x_n = X + 0.1 * rng.normal(size=X.shape)
    x0 = X * [0.8, 1.1, 1.0] + 0.2 * rng.normal(size=X.shape)
    x0[1] = x0[0]
    x1 = x0 + 0.1 * rng.normal(size=X.shape)
    elastic = model(X, faces, x_n=x_n, **values)
    assert (len(faces) - 5) % 8 != 0
    results = [elastic.stretch(level, x0, x1, positive) for level in _kernels.kernel_levels()]
    for change, gradient, blocks in results[1:]:
        assert change == results[0][0]
        np.testing.assert_array_equal(gradient, results[0][1])
        np.testing.assert_array_equal(blocks, results[0][2])


@pytest.mark.parametrize("positive", [False, True])
def test_extrapolated_hessian_has_the_stress_of_the_linear_model(positive):
    """As in test_stretch.py, with the second stress S^-1 R^T dE/dF by differences of forces."""
    X, _ = TRIANGLE
    elastic = woven_triangle()
    x0 = deformed(np.diag([1.2, 0.8, 1.0]))
    x = x0 + 0.2 * np.random.default_rng(3).normal(size=X.shape)
    to_gradient = np.linalg.inv((X[1:, :2] - X[0, :2]).T)
    shapes = np.vstack([-to_gradient.sum(axis=0), to_gradient])

    def second_stress(x):
        F = (x[1:] - x[0]).T @ to_gradient
        P = np.linalg.lstsq(shapes, elastic.gradient(x), rcond=None)[0].T  # forces are P g_p
        return np.linalg.lstsq(F, P, rcond=None)[0]

    def positive_part(A):
        values, V = np.linalg.eigh(A)
        return V @ np.diag(np.maximum(values, 0)) @ V.T

    step = 1e-5
    change = second_stress(x0 + step * (x - x0)) - second_stress(x0 - step * (x - x0))
    extrapolated, actual = second_stress(x0) + change / (2 * step), second_stress(x)
    np.testing.assert_allclose(actual, actual.T, atol=1e-10 * K_W)
    F = (x[1:] - x[0]).T @ to_gradient
    along = np.eye(3)
    if positive:
        extrapolated, actual = positive_part(extrapolated), positive_part(actual)
        n = np.cross(F[:, 0], F[:, 1])
        along = np.outer(n, n) / (n @ n)
    expected = np.kron(shapes @ (extrapolated - actual) @ shapes.T, along)
    H = elastic.extrapolated_hessian(x0, x, positive)
    np.testing.assert_allclose(H - elastic.hessian(x, positive), expected, atol=1e-6 * K_W)
    assert np.abs(expected).max() > 1e-2 * K_W


@pytest.mark.parametrize(
    "x",
    [
        pytest.param(np.zeros((3, 3)), id="a point"),
        pytest.param(1e-10 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), id="nearly a point"),
        pytest.param(np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0, 0]]), id="a segment"),
        pytest.param(np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-12, 0]]), id="nearly a segment"),
    ],
)
def test_degenerate_triangles_stay_finite(x):
    elastic = woven_triangle()
    assert np.isfinite(elastic.energy(x))
    g = elastic.gradient(x)
    assert np.isfinite(g).all()
    assert np.abs(g).max() < 10 * K_W
    for positive in (False, True):
        assert np.isfinite(elastic.hessian(x, positive)).all()
    assert np.linalg.eigvalsh(elastic.hessian(x, True))[0] > -1e-9 * K_W


def extended_energy(X, faces, x, angles):
    """The stretch energy in extended precision."""
    X, x = X.astype(np.longdouble), x.astype(np.longdouble)
    total = np.longdouble(0)
    for (a, b, c), angle in zip(faces, angles.astype(np.longdouble), strict=True):
        e1, e2 = X[b] - X[a], X[c] - X[a]
        u = np.sqrt(e1 @ e1)
        a2 = e1 @ e2 / u
        b2 = np.sqrt(e2 @ e2 - a2 * a2)
        f1 = (x[b] - x[a]) / u
        f2 = (x[c] - x[a] - a2 * f1) / b2
        w = np.cos(angle) * f1 + np.sin(angle) * f2
        f = -np.sin(angle) * f1 + np.cos(angle) * f2
        ww, wf, ff = w @ w, w @ f, f @ f
        d = np.sqrt(ww * ff - wf * wf)
        t = np.sqrt(ww + ff + 2 * d)
        warp, weft = np.sqrt(ww), np.sqrt(ff)
        springs = K_W * (warp - 1) ** 2 + K_F * (weft - 1) ** 2
        total += u * b2 / 4 * (springs + 2 * K_WF * (warp + weft - t))
    return total


@pytest.mark.parametrize("size", [1e-1, 1e-4, 1e-7])
def test_energy_change_does_not_cancel(size):
    X, faces = grid(4, 4)
    rng = np.random.default_rng(4)
    x0 = X * [1.01, 0.995, 1.0] + 1e-3 * rng.normal(size=X.shape)
    x1 = x0 + size * rng.normal(size=X.shape)
    angles = rng.uniform(-3, 3, len(faces))
    elastic = model(X, faces, angles=angles, **STRETCH)
    expected = extended_energy(X, faces, x1, angles) - extended_energy(X, faces, x0, angles)
    allowed = 1e-13 * K_W * size * len(faces) + 1e-17 * K_W * len(faces)
    assert abs(elastic.energy_change(x0, x1) - float(expected)) < allowed


@pytest.mark.parametrize("name", MESHES)
def test_rigid_motion_costs_nothing(name):
    X, faces = MESHES[name](5, 4)
    elastic = model(X, faces, angles=angles_along(X, faces, 0.3), **STRETCH)
    x = rigid(X)
    assert abs(elastic.energy(x)) < 1e-12 * K_W
    assert np.abs(elastic.gradient(x)).max() < 1e-12 * K_W * 10


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize(
    ("direction", "s", "error"),
    [(0.0, 0.2, 1e-10), (90.0, 0.2, 1e-10), (30.0, 1e-5, 1e-4), (45.0, 1e-5, 1e-4)],
)
def test_uniaxial_stretch_has_the_traction_of_the_law(name, direction, s, error):
    """A strain e along x, with the warp at an angle phi to it, has a traction along x of

    e (k_w c^4 + k_f s^4 + 2 k_wf c^2 s^2),  c = cos phi,  s = sin phi:

    k_w along the warp and k_f along the weft, at any strain; (k_w + k_f + 2 k_wf) / 4 along the
    bias. In these and all other directions the law holds to first order.
    """
    X, faces = MESHES[name](5, 4)
    phi = np.radians(direction)
    elastic = model(X, faces, angles=angles_along(X, faces, phi), **STRETCH)
    g = elastic.gradient(np.ascontiguousarray(X * [1 + s, 1.0, 1.0]))
    c2, s2 = np.cos(phi) ** 2, np.sin(phi) ** 2
    traction = s * (K_W * c2**2 + K_F * s2**2 + 2 * K_WF * c2 * s2)
    area = elastic.rest()["area"].sum()
    # Virtual work of the displacement x, which has strain one: area times traction.
    assert (g[:, 0] * X[:, 0]).sum() == pytest.approx(area * traction, rel=error)


@pytest.mark.parametrize("name", MESHES)
def test_shear_between_warp_and_weft_has_its_own_stiffness(name):
    """S = I + gamma (w f^T + f w^T) has energy k_wf gamma^2 per area, for any k_w and k_f."""
    X, faces = MESHES[name](5, 4)
    gamma = 1e-3
    elastic = model(X, faces, angles=angles_along(X, faces, 0.0), **STRETCH)
    S = np.array([[1.0, gamma, 0], [gamma, 1, 0], [0, 0, 1]])
    area = elastic.rest()["area"].sum()
    assert elastic.energy(X @ S) == pytest.approx(area * K_WF * gamma**2, rel=1e-4)


@pytest.mark.parametrize("strain", [-0.3, -0.04, 0.0, 0.1, 0.6])
@pytest.mark.parametrize("yarn", [0, 1])
def test_tension_stiffens_shear_and_compression_softens_it(yarn, strain):
    """Simple shear rotates the strained yarn and keeps its ends parallel.

    The stiffness is k_wf + (k - k_wf) e / (1 + e) - k_wf / (2 + e): k_wf / 2 at rest, and with
    the tension T = k e about k_wf / 2 + T, which is negative below T = -k_wf / 2.
    """
    X, faces = MESHES["delaunay"](5, 5)
    k = (K_W, K_F)[yarn]
    elastic = model(X, faces, angles=angles_along(X, faces, yarn * np.pi / 2), **STRETCH)
    x = np.ascontiguousarray(X * [1 + strain, 1, 1])
    z = np.outer(X[:, 0], [0.0, 1.0, 0.0])
    stiffness = K_WF + (k - K_WF) * strain / (1 + strain) - K_WF / (2 + strain)
    area = elastic.rest()["area"].sum()
    found = (z * elastic.hessian_product(x, z)).sum()
    assert found == pytest.approx(area * stiffness, rel=1e-10)
    assert (stiffness < 0) == (k * strain < -K_WF / 2)


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("gamma", [1e-6, 0.02, 0.4, -1.2])
def test_a_picture_frame_has_the_energy_of_its_angle(name, gamma):
    """Yarns that keep their lengths and turn against each other: 2 k_wf (1 - cos(gamma / 2))."""
    X, faces = MESHES[name](5, 4)
    phi = 0.3
    elastic = model(X, faces, angles=angles_along(X, faces, phi), **STRETCH)
    rest = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
    yarns = np.array([[1.0, np.sin(gamma)], [0.0, np.cos(gamma)]])
    x = X.copy()
    x[:, :2] = X[:, :2] @ (yarns @ rest.T).T
    energy = K_WF * 4 * np.sin(gamma / 4) ** 2
    area = elastic.rest()["area"].sum()
    assert elastic.energy(x) == pytest.approx(area * energy, rel=1e-9)
    if abs(gamma) < 0.1:
        assert energy == pytest.approx(K_WF * (gamma / 2) ** 2, rel=1e-4)


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("direction", [0.0, 30.0, 45.0, 90.0])
def test_a_strip_that_may_contract_has_the_compliance_of_the_law(name, direction):
    """A tension T along x alone strains along x by T (c^4 / k_w + s^4 / k_f + 2 c^2 s^2 / k_wf).

    In material axes e_ww = T c^2 / k_w, e_ff = T s^2 / k_f, e_wf = -T c s / k_wf: on the bias the
    strain is mostly shear. Only the vertices at the ends have forces.
    """
    X, faces = MESHES[name](6, 5)
    phi, tension = np.radians(direction), 1e-5 * K_F
    c, s = np.cos(phi), np.sin(phi)
    Q = np.array([[c, -s], [s, c]])
    e = np.array([[c * c / K_W, -c * s / K_WF], [-c * s / K_WF, s * s / K_F]])
    e = tension * Q @ e @ Q.T
    law = c**4 / K_W + s**4 / K_F + 2 * (c * s) ** 2 / K_WF
    assert e[0, 0] == pytest.approx(tension * law)
    elastic = model(X, faces, angles=angles_along(X, faces, phi), **STRETCH)
    x = X.copy()
    x[:, :2] += X[:, :2] @ e
    # The weak form of the stress T along x.
    expected = np.zeros_like(X)
    for face in faces:
        for k in range(3):
            edge = X[face[(k + 2) % 3]] - X[face[(k + 1) % 3]]
            expected[face[k], 0] -= 0.5 * tension * edge[1]
    np.testing.assert_allclose(elastic.gradient(x), expected, atol=1e-3 * tension)


D_W, D_F, D_T, NU = 1.0, 0.4, 0.6, 0.3  # [N m], [-]
BENDING = {"bending": D_W, "bending_weft": D_F, "bending_twill": D_T, "poisson": NU}


@pytest.mark.parametrize("angle", [0.0, 22.5, 45.0, 67.5, 90.0])
@pytest.mark.parametrize("name", MESHES)
def test_a_cylinder_at_an_angle_has_the_stiffness_of_the_law(name, angle):
    """D(phi) = D_w c^4 + D_f s^4 + (4 D_t - D_w - D_f) c^2 s^2, D_t at 45 degrees."""
    X, faces = MESHES[name](9, 8)
    curvature, warp = 1e-3, 0.25
    phi = np.radians(angle)
    elastic = model(X, faces, angles=angles_along(X, faces, warp), **BENDING)
    x = on_cylinder(X, curvature, warp + phi)
    area = elastic.rest()["area"].sum()
    c2, s2 = np.cos(phi) ** 2, np.sin(phi) ** 2
    D = D_W * c2**2 + D_F * s2**2 + (4 * D_T - D_W - D_F) * c2 * s2
    if angle == 45.0:
        assert pytest.approx(D_T) == D
    assert elastic.energy(x) == pytest.approx(0.5 * D * curvature**2 * area, rel=1e-5)


def test_equal_numbers_are_those_of_an_isotropic_cloth():
    """The results are bitwise equal: three equal numbers select the isotropic kernels."""
    X, faces = MESHES["jittered"](5, 4)
    x_n = X + 0.05 * RNG.normal(size=X.shape)
    x = x_n + 0.05 * RNG.normal(size=X.shape)
    values = {"stretch": K_W, "bending": D_W, "poisson": NU, "damping": 0.01, "x_n": x_n}
    plain = model(X, faces, **values)
    woven = model(X, faces, angles=angles_along(X, faces, 0.3), **values)
    nearly = model(
        X,
        faces,
        angles=angles_along(X, faces, 0.3),
        **values,
        **{name: values[name.split("_")[0]] * (1 + 1e-12) for name in WOVEN},
    )
    for compared, equal in ((woven, True), (nearly, False)):
        for attribute in ("energy", "gradient"):
            a, b = (getattr(e, attribute)(x) for e in (plain, compared))
            np.testing.assert_allclose(a, b, rtol=0 if equal else 1e-9, atol=0 if equal else 1e-9)
        for positive in (False, True):
            a, b = plain.hessian(x, positive), compared.hessian(x, positive)
            np.testing.assert_allclose(a, b, rtol=0, atol=0 if equal else 1e-9 * K_W)
        assert compared.energy_change(x_n, x) == pytest.approx(
            plain.energy_change(x_n, x), rel=1e-15 if equal else 1e-9
        )
    z = RNG.normal(size=X.shape)
    a, b = plain.mixed(x, z, True), woven.mixed(x, z, True)
    for name, parts in (("stretch", WOVEN[:2]), ("bending", WOVEN[2:])):
        total = sum((b[part] for part in parts), b[name])
        np.testing.assert_allclose(total, a[name], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(b["X"], a["X"], atol=1e-9 * K_W)


@pytest.mark.parametrize("damped", [0.0, 1.0])
@pytest.mark.parametrize("bending_model", ["patch", "hinge"])
def test_gradient_hessian_and_product_match_differences(bending_model, damped):
    X, faces = MESHES["jittered"](4, 3)
    rng = np.random.default_rng(5)
    values = random_materials(rng, len(faces), damped, woven=True)
    x_n = X + 0.1 * rng.normal(size=X.shape)
    x = x_n + 0.1 * rng.normal(size=X.shape)
    elastic = model(X, faces, bending_model, x_n=x_n, **values)
    g = differences(lambda x: elastic.energy_change(x_n, x), x, 1e-3).reshape(x.shape)
    np.testing.assert_allclose(elastic.gradient(x), g, atol=1e-7)
    H = differences(lambda x: elastic.gradient(x).ravel(), x, 1e-3)
    np.testing.assert_allclose(elastic.hessian(x, False), H, atol=1e-7)
    z = rng.normal(size=X.shape)
    np.testing.assert_allclose(elastic.hessian_product(x, z).ravel(), H @ z.ravel(), atol=1e-6)
    positive = elastic.hessian(x, True)
    assert np.linalg.eigvalsh(positive)[0] > -1e-12


@pytest.mark.parametrize("damped", [0.0, 1.0])
def test_damping_does_not_resist_rigid_motion(damped):
    X, faces = MESHES["jittered"](5, 4)
    values = random_materials(np.random.default_rng(6), len(faces), damped, woven=True)
    x_n = X * [1.1, 0.9, 1.0]
    x_n[:, 2] += 0.1 * X[:, 0] ** 2
    elastic = model(X, faces, x_n=x_n, **values)
    undamped = model(X, faces, x_n=x_n, **values | {"damping": 0.0})
    x = rigid(x_n)
    np.testing.assert_allclose(elastic.gradient(x), undamped.gradient(x), atol=1e-11)


def test_numbers_of_a_form_without_bending_have_finite_derivatives():
    """For D_w = D_f = 0 the derivatives add up to the derivative by equal changes."""
    X, faces = MESHES["jittered"](4, 4)
    x, z = on_cylinder(X, 0.2, 0.3), RNG.normal(size=X.shape)
    zero = dict.fromkeys(("bending", "bending_weft", "bending_twill"), 0.0)
    woven = model(X, faces, angles=angles_along(X, faces, 0.3), poisson=NU, **zero)
    plain = model(X, faces, poisson=NU)
    a, b = plain.mixed(x, z, True), woven.mixed(x, z, True)
    total = b["bending"] + b["bending_weft"] + b["bending_twill"]
    np.testing.assert_allclose(total, a["bending"], rtol=1e-9, atol=1e-12)
    assert np.abs(total).max() > 1e-3
