"""Shapes that configurations generate: disks, strips, chairs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from short_tasks import SHEET, write_config

import diffcloth_torch as dc
from diffcloth_torch.config import shapes
from diffcloth_torch.geometry.shapes import strip
from diffcloth_torch.tasks.registry import load_task


def edges_of(faces):
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(ends, axis=0, return_counts=True)


def test_a_disk_is_one_sheet_of_good_triangles():
    vertices, _, faces = shapes.disk(0.6, 0.06)
    edges, counts = edges_of(faces)
    border = edges[counts == 1]
    np.testing.assert_allclose(np.linalg.norm(vertices[border].reshape(-1, 3), axis=1), 0.6)
    assert len(vertices) - len(edges) + len(faces) == 1  # Euler: a disk
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] > 0).all()
    polygon = len(border) / 2 * 0.6**2 * math.sin(2 * math.pi / len(border))
    assert normals[:, 2].sum() / 2 == pytest.approx(polygon)
    longest = np.max([np.linalg.norm(q - p, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    height = normals[:, 2] / longest
    assert (height / longest).min() > 0.3  # 0.87 for equal sides
    degrees = np.bincount(edges[counts == 2].ravel(), minlength=len(vertices))
    assert len(np.unique(degrees)) > 3  # unstructured


def test_a_disk_is_the_same_every_time():
    for a, b in zip(shapes.disk(0.5, 0.08), shapes.disk(0.5, 0.08), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_bent_strip_keeps_its_lengths_and_opens_downwards():
    flat, bent, faces = strip(1.4, [0.04, 0.09], 4, 60, 180, 0.07, 0.4)
    edges, _ = edges_of(faces)
    assert len(flat) - len(edges) + len(faces) == 1  # Euler: a disk
    along = np.abs(np.diff(edges)[:, 0]) == 1
    lengths = [np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) for x in (flat, bent)]
    np.testing.assert_allclose(lengths[1][along], lengths[0][along], rtol=1e-12)
    # Across, chords of the bend are shorter than the arc, which is straight in the flat strip.
    np.testing.assert_allclose(lengths[1], lengths[0], rtol=2e-2)
    row = bent.reshape(4, 60, 3)[0]
    assert flat.reshape(4, 60, 3)[[0, -1], :, 1].T[[0, -1]] == pytest.approx(
        np.array([[-0.02, 0.02], [-0.045, 0.045]])
    )
    assert row[[0, -1], 0] == pytest.approx([-0.07, 0.07], abs=1e-3)
    assert row[:, 2].max() == pytest.approx(0.07, abs=1e-3)
    sides = (0.4 * 1.4 - np.pi * 0.035, 0.6 * 1.4 - np.pi * 0.035)
    assert row[[0, -1], 2] == pytest.approx([-sides[0], -sides[1]], abs=2e-3)


def test_a_strip_that_is_not_bent_is_flat():
    flat, bent, _ = strip(1.0, 0.1, 3, 11, 0, 0.1, 0.5)
    np.testing.assert_allclose(bent[:, :2], flat[:, :2], atol=1e-15)
    np.testing.assert_allclose(bent[:, 2], 0.1, atol=1e-15)  # at the top of the bend


def test_a_chair_is_closed_and_has_the_volume_of_its_parts():
    w, d, h, back, t = 0.5, 0.4, 0.45, 0.5, 0.05
    vertices, faces = shapes.chair(w, d, h, back, t, 0.1)
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    forward = {tuple(edge) for edge in directed.tolist()}
    assert len(forward) == len(directed)
    assert forward == {(b, a) for a, b in forward}  # closed, consistently oriented
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert volume == pytest.approx(w * d * t + w * t * back + 4 * t * t * (h - t))
    assert vertices.min(axis=0) == pytest.approx([-w / 2, -d / 2, 0])
    assert vertices.max(axis=0) == pytest.approx([w / 2, d / 2, h + back])


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        pytest.param("{kind: disk, radius: 1, edge_length: 3}", "edge_length", id="coarse"),
        pytest.param("{kind: disk, radius: 1, edge_length: 1e-5}", "edge_length", id="fine"),
        pytest.param(
            "{kind: strip, length: 1, width: 0.1, rows: 3, columns: 9, bend: 180, radius: 0.4}",
            "`bend` and `radius` must fit",
            id="bend",
        ),
    ],
)
def test_a_shape_that_cannot_be_made_is_refused(tmp_path, shape, message):
    config = write_config(tmp_path, SHEET)
    with pytest.raises(dc.InvalidInput, match=message):
        load_task(config, [f"scene.cloths.sheet.shape={shape}"])


def test_a_disk_starts_with_folds_and_is_flat_at_rest():
    flat, folded, _ = shapes.disk(0.15, 0.01, 3, 0.02)
    assert not flat[:, 2].any()
    np.testing.assert_array_equal(folded[:, :2], flat[:, :2])
    angles, radii = np.arctan2(flat[:, 1], flat[:, 0]), np.hypot(*flat[:, :2].T)
    expected = 0.01 * (1 + np.cos(3 * angles)) * (radii / 0.15) ** 4
    np.testing.assert_allclose(folded[:, 2], expected, atol=1e-15)
    assert folded[:, 2].max() == pytest.approx(0.02)
