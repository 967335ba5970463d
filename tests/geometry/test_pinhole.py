"""Triangles that a pinhole camera sees, against rays that are met one by one."""

import numpy as np
import pytest

from diffcloth_torch.geometry import shapes
from diffcloth_torch.geometry.pinhole import nearest_triangles

SIZE = (24, 32)
FOCAL = 20.0


def rays():
    rows, columns = np.indices(SIZE)
    x = (columns + 0.5 - SIZE[1] / 2) / FOCAL
    y = (rows + 0.5 - SIZE[0] / 2) / FOCAL
    return np.stack([x, y, np.ones(SIZE)], axis=-1)


def met(corners):
    """Depths at which all rays meet triangles [f, 3, 3], infinite without: a system for each."""
    a, b, c = (corners[:, k] for k in range(3))
    directions = np.broadcast_to(rays()[..., None, :], (*SIZE, *a.shape))
    system = np.stack([directions, *np.broadcast_arrays(a - b, a - c, directions)[:2]], axis=-1)
    right = np.broadcast_to(a[..., None], (*SIZE, *a.shape, 1))
    depths, u, v = np.moveaxis(np.linalg.solve(system, right)[..., 0], -1, 0)
    return np.where((depths > 0) & (u >= 0) & (v >= 0) & (u + v <= 1), depths, np.inf)


def soup(seed):
    """Triangles around the camera, some in part or altogether behind it."""
    noise = np.random.default_rng(seed)
    centers = noise.uniform([-2, -2, -1], [2, 2, 4], (30, 3))
    corners = centers[:, None] + noise.uniform(-1, 1, (30, 3, 3))
    return corners.reshape(-1, 3), np.arange(90).reshape(30, 3)


@pytest.mark.parametrize("seed", [0, 1])
def test_each_pixel_sees_the_nearest_triangle(seed):
    vertices, faces = soup(seed)
    corners = vertices[faces]
    assert ((corners[..., 2] > 0).any(1) & (corners[..., 2] < 0).any(1)).any()
    seen = nearest_triangles(vertices, faces, FOCAL, SIZE)
    depths = met(corners)
    none = np.isinf(depths).all(axis=-1)
    np.testing.assert_array_equal(seen.triangles, np.where(none, -1, depths.argmin(axis=-1)))
    np.testing.assert_allclose(seen.depths, depths.min(axis=-1), rtol=1e-9)
    assert not seen.weights[none].any()
    assert seen.weights.min() >= -1e-9
    points = np.einsum("hwk,hwkx->hwx", seen.weights, corners[seen.triangles])
    expected = np.where(none, 0.0, seen.depths)[..., None] * rays()
    np.testing.assert_allclose(points, expected, rtol=0, atol=1e-9)
    assert 0.2 < (seen.triangles >= 0).mean() < 1


def test_no_ray_passes_between_neighbors():
    """Edges and vertices of a tilted grid lie on the rays themselves."""
    rows, columns = np.indices(SIZE)
    direction = rays()
    depths = 1.5 + 0.07 * rows + 0.03 * columns
    vertices = (depths[..., None] * direction).reshape(-1, 3)
    index = (rows * SIZE[1] + columns)[:-1, :-1].ravel()
    below = index + SIZE[1]
    faces = np.concatenate(
        [np.stack([index, below, index + 1], 1), np.stack([index + 1, below, below + 1], 1)]
    )
    seen = nearest_triangles(vertices, faces, FOCAL, SIZE)
    inner = np.s_[1:-1, 1:-1]
    assert (seen.triangles[inner] >= 0).all()
    np.testing.assert_allclose(seen.depths[inner], depths[inner], rtol=1e-12)


def test_both_sides_are_seen_and_nothing_behind():
    vertices, faces = shapes.sphere(0.8, 2)
    ahead = np.array([0, 0, 3.0]) + vertices
    one, other = (nearest_triangles(ahead, f, FOCAL, SIZE) for f in (faces, faces[:, ::-1]))
    np.testing.assert_array_equal(one.triangles, other.triangles)
    middle = np.s_[SIZE[0] // 2, SIZE[1] // 2]
    assert one.depths[middle] == pytest.approx(2.2, abs=0.02)
    behind = nearest_triangles(vertices - np.array([0, 0, 3.0]), faces, FOCAL, SIZE)
    assert (behind.triangles == -1).all()


def test_a_floor_that_reaches_behind_the_camera_is_seen_up_to_the_lower_border():
    vertices = np.array([[-50.0, 1.0, 50.0], [50.0, 1.0, 50.0], [0.0, 1.0, -50.0]])
    seen = nearest_triangles(vertices, np.array([[0, 1, 2]]), FOCAL, SIZE)
    y = rays()[..., 1]
    floor = y > 1 / 50
    np.testing.assert_array_equal(seen.triangles >= 0, floor)
    np.testing.assert_allclose(seen.depths[floor], 1 / y[floor], rtol=1e-12)
