"""Cloths: sheets by counts and lengths, poses, and numbers that are text."""

import warnings

import numpy as np
import pytest

import diffcloth_torch as dc


def test_a_sheet_has_counts_and_lengths_in_one_order():
    sheet = dc.Cloth.grid((4, 3), (0.3, 0.1))
    assert np.ptp(sheet.vertices, axis=0).tolist() == pytest.approx([0.3, 0.1, 0.0])
    np.testing.assert_allclose(sheet.vertices[:4, 0], np.linspace(-0.15, 0.15, 4))
    assert (sheet.vertices[:4, 1] == -0.05).all()
    by_name = dc.Cloth.grid(counts=(4, 3), size=(0.3, 0.1))
    np.testing.assert_array_equal(by_name.vertices, sheet.vertices)
    assert np.ptp(dc.Cloth.grid((3, 2)).vertices, axis=0).tolist() == [1.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("arguments", "keywords"),
    [
        pytest.param((3, 4), {"size": (0.3, 0.1)}, id="positions"),
        pytest.param((3, 4, (0.3, 0.1)), {}, id="three positions"),
        pytest.param((), {"rows": 3, "columns": 4, "size": [0.3, 0.1]}, id="names"),
    ],
)
def test_rows_and_columns_keep_their_meaning_and_warn_of_two_lengths(arguments, keywords):
    sheet = dc.Cloth.grid((4, 3), (0.3, 0.1))
    message = r"write Cloth\.grid\(\(4, 3\), \(0\.3, 0\.1\)\), with x first in both"
    with pytest.warns(FutureWarning, match=message):
        earlier = dc.Cloth.grid(*arguments, **keywords)
    np.testing.assert_array_equal(earlier.vertices, sheet.vertices)
    np.testing.assert_array_equal(earlier.faces, sheet.faces)


def test_rows_and_columns_with_one_length_do_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sheet = dc.Cloth.grid(3, 4, 0.3)
        dc.Cloth.grid(3, 4)
    np.testing.assert_array_equal(sheet.vertices, dc.Cloth.grid((4, 3), 0.3).vertices)


@pytest.mark.parametrize(
    ("arguments", "keywords", "error", "message"),
    [
        pytest.param((3,), {}, TypeError, "`columns` must be given", id="one count"),
        pytest.param(((3, 1),), {}, dc.InvalidInput, r"`counts\[1\]` must be at least 2", id="few"),
        pytest.param(((3, 2.5),), {}, TypeError, r"`counts\[1\]` must be an integer", id="float"),
        pytest.param(((3, 3, 3),), {}, dc.InvalidInput, r"shape \[2\], got \[3\]", id="three"),
        pytest.param(((3, 3), 0.1, 2), {}, TypeError, "takes `counts`, `size`, got 3", id="many"),
        pytest.param((3, 3), {"rows": 3}, TypeError, "`rows` must be given once", id="twice"),
        pytest.param(((9999, 9999),), {}, dc.InvalidInput, "at most 4000000 triangles", id="huge"),
    ],
)
def test_other_counts_are_refused(arguments, keywords, error, message):
    with pytest.raises(error, match=rf"^Cloth\.grid: .*{message}"):
        dc.Cloth.grid(*arguments, **keywords)


def test_a_pose_places_vertices_and_not_the_rest_shape():
    flat = dc.Cloth.grid((3, 3), 0.2)
    pose = [1, 2, 3, 0.5**0.5, 0.5**0.5, 0, 0]
    for cloth in (
        dc.Cloth(flat.vertices, flat.faces, pose=pose),
        dc.Cloth.grid((3, 3), 0.2, pose=pose),
    ):
        np.testing.assert_array_equal(cloth.rest_positions, flat.vertices)
        expected = flat.vertices[:, [0, 2, 1]] * [1, -1, 1] + [1, 2, 3]  # y becomes z
        np.testing.assert_allclose(cloth.vertices, expected, rtol=0, atol=1e-15)
        assert not cloth.vertices.flags.writeable
    cut = dc.Cloth(flat.vertices, flat.faces, pose=pose, rest_positions=1.1 * flat.vertices)
    np.testing.assert_array_equal(cut.rest_positions, 1.1 * flat.vertices)
    with pytest.raises(dc.InvalidInput, match=r"Cloth: `pose` must have shape \[7\], got \[3\]"):
        dc.Cloth(flat.vertices, flat.faces, pose=[0, 0, 1])


def test_numbers_that_are_text_are_refused_with_their_value():
    """YAML 1.1 reads 1e-3 as text."""
    sentence = (
        r"^Material: `bending` must hold real numbers, got the text '1e-3'; convert it with float"
    )
    with pytest.raises(TypeError, match=sentence):
        dc.Material(bending="1e-3")
    with pytest.raises(TypeError, match=r"`size` must hold real numbers, got the text '0\.1'"):
        dc.RigidBody.box(["0.1", "0.2", "0.3"])
