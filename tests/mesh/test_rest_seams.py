"""Rest meshes that are cut at seams: each face has its own triangle, seams are sewn flat."""

import numpy as np
import pytest
from test_rest_shape import FIELDS, Elastic, curved, delaunay, flat, tetrahedron


def cut(X, faces, island, moves):
    """Rest mesh with separate vertices for corners [f, 3] of different islands, each moved."""
    pairs = np.stack([np.broadcast_to(island, faces.shape).ravel(), faces.ravel()], axis=1)
    distinct, rest_faces = np.unique(pairs, axis=0, return_inverse=True)
    rest = np.array([moves[k % len(moves)](X[v]) for k, v in distinct])
    return np.ascontiguousarray(rest), rest_faces.reshape(-1, 3).astype(np.int32)


def turned(angle, shift=(0.0, 0.0, 0.0), scale=1.0, mirror=1.0):
    c, s = np.cos(angle), np.sin(angle)
    turn = scale * np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.diag([1.0, mirror, 1.0])
    return lambda x: turn @ x + np.array(shift)


RIGID = (turned(0.0), turned(2.1, (3.0, -1.0, 0.0)), turned(0.7, mirror=-1.0))
UNEVEN = (turned(0.0), turned(2.1, (3.0, -1.0, 0.0), 1.1), turned(0.7, scale=0.95, mirror=-1.0))


def by_side(X, faces):
    """Three islands side by side."""
    middle = X[faces].mean(axis=1)[:, 0]
    return np.searchsorted(np.quantile(middle, [0.34, 0.67]), middle)[:, None]


def each_alone(X, faces):
    return np.arange(len(faces))[:, None]


def quadrant(X, faces):
    """A corner is an island: an inner vertex where two seams meet."""
    middle = X[faces].mean(axis=1) - X.mean(axis=0)
    return ((middle[:, 0] > 0) & (middle[:, 1] > 0)).astype(int)[:, None]


def dart(X, faces):
    """Faces around the end of a seam, an inner vertex, are neighbors without a seam, too."""
    x, y, _ = (X - X[len(X) // 2]).T
    on_seam = (np.abs(y) < 0.3) & (x > 0.5)
    return on_seam[faces] & (X[faces].mean(axis=1)[:, 1:2] > X[len(X) // 2, 1])


CUTS = [by_side, each_alone, quadrant]


@pytest.mark.parametrize("bending_model", ["patch", "hinge"])
@pytest.mark.parametrize("islands", CUTS)
def test_islands_anywhere_have_the_rest_shape_of_the_whole(islands, bending_model):
    """Positions, rotations and reflections of the islands do not change the rest shape."""
    X, faces = flat(6, 5)
    rest, rest_faces = cut(X, faces, islands(X, faces), RIGID)
    whole = Elastic(X, faces, bending_model).rest()
    found = Elastic(rest, faces, bending_model, rest_faces).rest()
    assert len(rest) > len(X)
    for name in FIELDS:
        scale = np.abs(whole[name]).max()
        # Coordinates of islands of size 3 and their rounding, amplified by fits of second order.
        np.testing.assert_allclose(found[name], whole[name], atol=1e-12 * (scale or 1), rtol=0)
    assert not found["curved"]


def test_without_seams_a_rest_mesh_may_have_another_order():
    X, faces = curved(5, 5)
    order = np.random.default_rng(2).permutation(len(X))
    rest = np.empty_like(X)
    rest[order] = X
    whole = Elastic(X, faces, "patch").rest()
    found = Elastic(rest, faces, "patch", order[faces].astype(np.int32)).rest()
    for name in FIELDS:
        np.testing.assert_array_equal(found[name], whole[name])


def test_a_seam_is_flat_at_rest_and_elsewhere_the_curvature_stays():
    X, faces = curved(12, 5)
    island = (X[faces].mean(axis=1)[:, 0] > 5.5).astype(int)[:, None]
    rest, rest_faces = cut(X, faces, island, RIGID[:2])
    whole, sewn = Elastic(X, faces, "patch"), Elastic(rest, faces, "patch", rest_faces)
    sizes = np.abs(sewn.rest()["curvature"]).max(axis=(1, 2))
    middle = np.abs(X[faces].mean(axis=1)[:, 0] - 5.5)
    assert (sizes[middle < 1] == 0).all()
    assert (sizes[middle > 3] > 0).all()
    far = middle > 3
    np.testing.assert_allclose(
        sewn.rest()["curvature"][far], whole.rest()["curvature"][far], atol=1e-12
    )


def test_an_edge_of_two_lengths_has_the_mean_of_their_squares():
    X, faces = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), [[0, 1, 2], [1, 3, 2]]
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [5, 2, 0], [3, 2, 0]])
    faces = np.array(faces, np.int32)
    elastic = Elastic(rest, faces, "hinge", np.array([[0, 1, 2], [3, 4, 5]], np.int32))
    edge = [tuple(e) for e in elastic.edges].index((1, 2))
    found = elastic.rest()
    assert found["edge_length_sq"][edge] == pytest.approx((2 + 8) / 2)
    np.testing.assert_allclose(found["area"], [0.5, 2.0])
    # The second triangle at half its size beside the first: the hinge of a square.
    square = Elastic(X, faces, "hinge").rest()
    np.testing.assert_allclose(found["curvature_operator"], square["curvature_operator"])


MESHES = [
    pytest.param(lambda: flat(4, 3), by_side, id="flat"),
    pytest.param(lambda: curved(5, 4), quadrant, id="quadrant"),
    pytest.param(lambda: curved(5, 5), dart, id="dart"),
    pytest.param(lambda: curved(4, 3), each_alone, id="each alone"),
    pytest.param(delaunay, by_side, id="delaunay"),
    pytest.param(tetrahedron, each_alone, id="tetrahedron"),
]


@pytest.mark.parametrize("bending_model", ["patch", "hinge"])
@pytest.mark.parametrize(("mesh", "islands"), MESHES)
def test_derivatives_by_rest_vertices(mesh, islands, bending_model):
    """All fields at once, also if a seam has two lengths; the adjoint matches the tangent."""
    X, faces = mesh()
    moves = (turned(0.0), turned(0.1)) if islands is dart else UNEVEN
    rest, rest_faces = cut(X, faces, islands(X, faces), moves)
    assert len(X) < len(rest) <= 3 * len(faces)
    elastic = Elastic(rest, faces, bending_model, rest_faces)

    def phi(rest):
        elastic.set_rest(rest)
        fields = [elastic.rest()[name].ravel() for name in FIELDS]
        return sum(v @ np.cos(np.arange(1, len(v) + 1)) for v in fields)

    bar = elastic.rest_vjp()
    rng = np.random.default_rng(1)
    for _ in range(3):
        d = rng.normal(size=rest.shape)
        scale = np.abs(bar).max() * np.abs(d).sum()
        assert elastic.rest_jvp(d) == pytest.approx((bar * d).sum(), abs=1e-13 * scale)
    eps = 2e-5
    for index in rng.permutation(rest.size)[:24]:
        e = np.zeros(rest.size)
        e[index] = eps
        e = e.reshape(rest.shape)
        near, far = phi(rest + e) - phi(rest - e), phi(rest + 2 * e) - phi(rest - 2 * e)
        expected = (8 * near - far) / (12 * eps)
        assert bar.ravel()[index] == pytest.approx(expected, abs=1e-6 * np.abs(bar).max())
        elastic.set_rest(rest)


@pytest.mark.parametrize(
    ("rest_faces", "message"),
    [
        pytest.param([[0, 1, 2], [1, 9, 2]], "`rest_faces` must be in 0 .. 4, got 9", id="range"),
        pytest.param([[0, 1, 2]], "`rest_faces` must be as many as `faces`, 2, got 1", id="count"),
        pytest.param(
            [[0, 1, 2], [1, 0, 2]], "rest vertex 0 must belong to one vertex, got 0 and 3", id="two"
        ),
    ],
)
def test_bad_rest_faces_are_refused(rest_faces, message):
    faces = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    rest = np.random.default_rng(0).normal(size=(5, 3))
    with pytest.raises(ValueError, match=message):
        Elastic(rest, faces, "patch", np.array(rest_faces, np.int32))
