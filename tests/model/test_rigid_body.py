"""Meshes of bodies that are accepted with a warning."""

import warnings

import pytest

import diffcloth_torch as dc


def test_edges_that_are_cut_are_told():
    """A square of two faces that share no vertex; but not faces that only touch at a corner."""
    a, b, c, d = [0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]
    with pytest.warns(UserWarning, match=r"vertices \[0, 2\] and \[3, 4\] are at the same places"):
        dc.RigidBody([a, b, c, a, c, d], [[0, 1, 2], [3, 4, 5]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dc.RigidBody([a, b, c, d], [[0, 1, 2], [0, 2, 3]])
        dc.RigidBody([a, b, c, a, d, [-1, 0, 0]], [[0, 1, 2], [3, 4, 5]])
