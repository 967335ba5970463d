"""Topology and rest shape: counts, geometry, unfolding and cotangents."""

import functools

import numpy as np
import pytest
import scipy.spatial

from diffcloth_torch import _kernels

Elastic = _kernels.Elastic
RNG = np.random.default_rng(11)


def grid(nu, nv):
    """Cells of unit size, diagonals in turns."""
    i, j = np.meshgrid(np.arange(nu), np.arange(nv), indexing="ij")
    X = np.stack([i.ravel(), j.ravel(), 0 * i.ravel()], 1).astype(float)
    faces = []
    for u in range(nu - 1):
        for v in range(nv - 1):
            a, b, c, d = u * nv + v, (u + 1) * nv + v, (u + 1) * nv + v + 1, u * nv + v + 1
            faces += [[a, b, d], [b, c, d]] if (u + v) % 2 else [[a, b, c], [a, c, d]]
    return X, np.array(faces, np.int32)


def flat(nu, nv):
    X, faces = grid(nu, nv)
    X[:, :2] += RNG.uniform(-0.1, 0.1, (len(X), 2))
    return X, faces


def curved(nu, nv):
    X, faces = flat(nu, nv)
    X[:, 2] = 0.1 * X[:, 0] ** 2 - 0.07 * X[:, 0] * X[:, 1] + 0.2 * np.sin(X[:, 1])
    return X, faces


def tetrahedron():
    """Closed: every vertex has three faces, every neighbor of a face is the same vertex."""
    X = np.array([[0.0, 0, 0], [1, 0, 0], [0.4, 0.9, 0], [0.5, 0.3, 0.8]])
    return X, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)


def star():
    """An interior vertex of three faces, in a flat mesh."""
    X = np.array([[0.0, 0, 0], [1, 0, 0], [-0.5, 0.8, 0], [-0.4, -0.9, 0], [0.7, 1.1, 0]])
    return X, np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 4, 2]], np.int32)


def strip():
    X, faces = grid(5, 2)
    return X, faces


def long_strip():
    """An irregular strip, one triangle wide: no point determines its transverse curvature well."""
    X, faces = grid(6, 2)
    X[:, :2] += np.random.default_rng(4).uniform(-0.15, 0.15, (len(X), 2))
    return X / [1, 4, 1], faces


def nearly_undetermined(bend):
    """A strip whose boundaries deviate from two lines by `bend`: quadratic fits of rank 2 to 3."""
    X, faces = grid(6, 2)
    X[:, 1] += bend * np.random.default_rng(6).uniform(-1, 1, len(X))
    return X, faces


def two_triangles():
    X, faces = grid(2, 2)
    return X, faces


def two_rows():
    X, faces = grid(5, 3)
    X[:, :2] += np.random.default_rng(5).uniform(-0.2, 0.2, (len(X), 2))
    return X / [1, 3, 1], faces


def delaunay():
    X = np.random.default_rng(12).uniform(size=(18, 2))
    return np.c_[X, 0.2 * X[:, 0] * X[:, 1]], scipy.spatial.Delaunay(X).simplices.astype(np.int32)


def rolled_strip(bend):
    """Rank that changes within a strip at rest on a cylinder."""
    X, faces = nearly_undetermined(bend)
    return np.c_[2 * np.sin(X[:, 0] / 2), X[:, 1], 2 * np.cos(X[:, 0] / 2)], faces


MESHES = [
    flat,
    curved,
    tetrahedron,
    star,
    strip,
    two_triangles,
    long_strip,
    two_rows,
    delaunay,
    *(
        pytest.param(functools.partial(shape, bend), id=f"{shape.__name__} {bend}")
        for shape in (nearly_undetermined, rolled_strip)
        for bend in (0.0, 0.02, 0.06, 0.15)
    ),
]


def test_topology_of_a_grid():
    X, faces = grid(4, 3)
    elastic = Elastic(X, faces, "patch")
    edges = elastic.edges
    assert len(edges) == 3 * 3 + 2 * 4 + 6  # across, along, diagonals
    assert (edges[:, 0] < edges[:, 1]).all()
    assert [tuple(e) for e in edges] == sorted({tuple(e) for e in edges})
    for f, face in enumerate(faces):
        for p in range(3):
            e = elastic.face_edges[f, p]
            assert set(edges[e]) == set(face) - {face[p]}
            assert f in elastic.edge_faces[e]
    sides = (elastic.edge_faces >= 0).sum(1)
    assert (sides == 1).sum() == 2 * (3 + 2)
    assert (elastic.edge_faces[sides == 1] != -1).argmax(1).max() == 0


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        pytest.param([[0, 1, 9]], r"`faces` must be in 0 .. 3, got 9 in face 0", id="range"),
        pytest.param([[0, 1, 2], [1, 1, 3]], r"face 1 repeats one", id="repeated corner"),
        pytest.param(
            [[0, 1, 2], [1, 0, 3], [0, 1, 3]],
            r"edge \(0, 1\) must have at most two faces",
            id="three faces",
        ),
    ],
)
def test_bad_faces_are_refused(faces, message):
    with pytest.raises(ValueError, match=message):
        Elastic(RNG.normal(size=(4, 3)), np.array(faces, np.int32), "patch")


@pytest.mark.parametrize("mesh", MESHES)
def test_areas_and_gradients(mesh):
    X, faces = mesh() if mesh not in (flat, curved) else mesh(4, 4)
    rest = Elastic(X, faces, "patch").rest()
    normal = np.cross(X[faces[:, 1]] - X[faces[:, 0]], X[faces[:, 2]] - X[faces[:, 0]])
    area = 0.5 * np.linalg.norm(normal, axis=1)
    np.testing.assert_allclose(rest["area"], area, rtol=1e-13)
    assert rest["vertex_area"].sum() == pytest.approx(area.sum())
    assert rest["edge_area"].sum() == pytest.approx(area.sum())
    # F of the rest shape itself has orthonormal columns that lie in the triangle.
    F = np.einsum("fpi,fpa->fia", X[faces], rest["shape_gradient"])
    np.testing.assert_allclose(
        np.einsum("fia,fib->fab", F, F), np.broadcast_to(np.eye(2), (len(faces), 2, 2)), atol=1e-12
    )
    np.testing.assert_allclose(np.einsum("fi,fia->fa", normal, F), 0, atol=1e-12)


def test_interior_patches_differentiate_quadratics_exactly():
    """Second derivatives x,ab of every full-rank patch, in the frame of its triangle."""
    X, faces = flat(5, 5)
    elastic = Elastic(X, faces, "patch")
    rest = elastic.rest()
    hessian = np.array([[0.7, -0.4], [-0.4, 1.3]])
    value = 0.5 * np.einsum("ia,ab,ib->i", X[:, :2], hessian, X[:, :2])
    start, vertices = elastic.stencil_start, elastic.stencil_vertices
    assert len(start) == len(faces) + 1
    for e in range(len(faces)):
        stencil = vertices[start[e] : start[e + 1]]
        assert list(stencil[:3]) == list(faces[e])
        assert len(set(stencil)) == len(stencil)
        second = rest["curvature_operator"][start[e] : start[e + 1]].T @ value[stencil]
        e1 = (X[faces[e, 1]] - X[faces[e, 0]])[:2]
        e1 /= np.linalg.norm(e1)
        frame = np.array([e1, [-e1[1], e1[0]]])
        turned = frame @ hessian @ frame.T
        # The filter of a well-posed fit differs from the inverse by at most 0.7 %.
        np.testing.assert_allclose(
            second, [turned[0, 0], turned[0, 1], turned[1, 1]], atol=7e-3 * np.abs(hessian).max()
        )


def test_the_curvature_of_a_cylinder():
    """One principal curvature is 1 / r along the normal, the other zero."""
    X, faces = grid(9, 9)
    r, spacing = 2.0, 0.1
    s, t = spacing * X[:, 0], spacing * X[:, 1]
    rolled = np.stack([r * np.sin(s / r), t, r * np.cos(s / r)], 1)
    rest = Elastic(rolled, faces, "patch").rest()
    assert rest["curved"]
    normal = rest["curvature"][:, :, 2]  # [element, (uu, uv, vv)]: columns are stored first
    mean = 0.5 * (normal[:, 0] + normal[:, 2])
    gauss = normal[:, 0] * normal[:, 2] - normal[:, 1] ** 2
    np.testing.assert_allclose(np.abs(mean), 0.5 / r, rtol=0.02)
    np.testing.assert_allclose(gauss, 0, atol=0.02 / r**2)


def test_unfolding_makes_isometric_sheets_alike():
    """A sheet on a cylinder has, to second order, the operator of the flat one."""
    X, faces = flat(5, 5)
    radius = 50.0
    rolled = X.copy()
    rolled[:, 0] = radius * np.sin(X[:, 0] / radius)
    rolled[:, 2] = radius * np.cos(X[:, 0] / radius)
    flat_rest = Elastic(X, faces, "patch").rest()
    rolled_rest = Elastic(rolled, faces, "patch").rest()
    scale = np.abs(flat_rest["curvature_operator"]).max()
    np.testing.assert_allclose(
        rolled_rest["curvature_operator"],
        flat_rest["curvature_operator"],
        atol=20 / radius**2 * scale,
    )


def test_a_flat_sheet_far_away_and_tilted_is_flat():
    X, faces = flat(6, 6)
    rotation, _ = np.linalg.qr(RNG.normal(size=(3, 3)))
    rest = Elastic(np.ascontiguousarray(0.01 * X @ rotation.T + 100.0), faces, "patch").rest()
    assert not rest["curved"]
    assert (rest["curvature"] == 0).all()


FIELDS = [
    "area",
    "shape_gradient",
    "curvature_operator",
    "curvature",
    "bending_area",
    "vertex_area",
    "edge_area",
    "edge_length_sq",
]


@pytest.mark.parametrize("bending_model", ["patch", "hinge"])
@pytest.mark.parametrize("mesh", MESHES)
def test_vjp_matches_differences(mesh, bending_model):
    """All fields at once, with the cotangent cos(k + 1) for entry k of each field."""
    X, faces = mesh() if mesh not in (flat, curved) else mesh(4, 3)
    elastic = Elastic(X, faces, bending_model)

    def phi(X):
        elastic.set_rest(X)
        rest = elastic.rest()
        total = 0.0
        for name in FIELDS:
            values = rest[name].ravel()
            total += values @ np.cos(np.arange(1, len(values) + 1))
        return total

    bar = elastic.rest_vjp()
    eps = 2e-5
    expected = np.zeros_like(X)
    for index in np.ndindex(X.shape):
        e = np.zeros_like(X)
        e[index] = eps
        near, far = phi(X + e) - phi(X - e), phi(X + 2 * e) - phi(X - 2 * e)
        expected[index] = (8 * near - far) / (12 * eps)
    np.testing.assert_allclose(bar, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("bending_model", ["patch", "hinge"])
@pytest.mark.parametrize("mesh", MESHES)
def test_jvp_is_the_adjoint_of_vjp(mesh, bending_model):
    X, faces = mesh() if mesh not in (flat, curved) else mesh(5, 4)
    elastic = Elastic(X, faces, bending_model)
    bar = elastic.rest_vjp()
    for seed in range(3):
        X_dot = np.random.default_rng(seed).normal(size=X.shape)
        scale = np.abs(bar).max() * np.abs(X_dot).sum()
        assert elastic.rest_jvp(X_dot) == pytest.approx((bar * X_dot).sum(), abs=1e-13 * scale)
