"""Scenes: names, order of vertices and pins, options, pickling."""

import pickle

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.model.assembly import assemble


def two_cloths():
    shirt = dc.Cloth.grid(2, 3, pins={"b": [5, 1], "a": [2]}, soft_pins={"s": [0]}, name="shirt")
    other = dc.Cloth.grid(2, 2, pins={"a": [3]}, pose=[0, 0, 2, 1, 0, 0, 0])
    return dc.Scene(
        [shirt, other], [dc.RigidBody.box(1.0, motion="kinematic"), dc.RigidBody.plane(9)]
    )


def test_names_are_given_in_scene_order():
    scene = two_cloths()
    assert scene.cloth_names == ("shirt", "cloth1")
    assert scene.body_names == ("body0", "body1")


def test_pins_follow_cloth_order_then_dict_order_then_list_order():
    assembly = assemble(two_cloths())
    assert assembly.pins.tolist() == [5, 1, 2, 6 + 3]
    assert assembly.pin_groups == {
        "shirt/b": slice(0, 2),
        "shirt/a": slice(2, 3),
        "cloth1/a": slice(3, 4),
    }
    assert assembly.soft_pins.tolist() == [0]


def test_vertices_and_faces_follow_scene_order():
    scene = two_cloths()
    assembly = assemble(scene)
    assert assembly.cloth_vertex_start.tolist() == [0, 6, 10]
    assert assembly.cloth_face_start.tolist() == [0, 4, 6]
    np.testing.assert_array_equal(assembly.faces[4:], scene.cloths[1].faces + 6)
    np.testing.assert_array_equal(assembly.body_faces[12:], scene.bodies[1].faces + 8)
    assert assembly.static_bodies == (1,)


def test_duplicate_names_are_refused():
    with pytest.raises(dc.InvalidInput, match="'a' twice"):
        dc.Scene([dc.Cloth.grid(2, 2, name="a"), dc.Cloth.grid(2, 2, name="a")])
    with pytest.raises(dc.InvalidInput, match="'a' twice"):
        dc.Scene([dc.Cloth.grid(2, 2, name="a")], [dc.RigidBody.box(1.0, name="a")])


@pytest.mark.parametrize(
    ("arguments", "keywords", "error", "message"),
    [
        (([],), {}, dc.InvalidInput, "at least one Cloth"),
        (([dc.RigidBody.box(1.0)],), {}, TypeError, r"Cloth objects, got RigidBody at \[0\]"),
        (
            ([dc.Cloth.grid(2, 2)], [3]),
            {},
            TypeError,
            r"RigidBody or DeformingBody objects, got int at \[0\]",
        ),
        ((dc.Cloth.grid(2, 2),), {}, TypeError, "list of Cloth"),
        (([dc.Cloth.grid(2, 2)],), {"gravity": [0, 0]}, dc.InvalidInput, r"\[3\], got \[2\]"),
        (
            ([dc.Cloth.grid(2, 2)],),
            {"gravity": torch.zeros(3, requires_grad=True)},
            dc.InvalidInput,
            "Parameters.gravity instead",
        ),
    ],
)
def test_a_bad_scene_is_refused(arguments, keywords, error, message):
    with pytest.raises(error, match=message):
        dc.Scene(*arguments, **keywords)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: dc.ContactOptions(barrier_distance=0.0), dc.InvalidInput, "> 0, got 0"),
        (lambda: dc.ContactOptions(barrier_stiffness=-1.0), dc.InvalidInput, "> 0, got -1"),
        (lambda: dc.ContactOptions(slip_velocity=None), TypeError, "slip_velocity"),
        (lambda: dc.ContactOptions(friction_iterations=0), dc.InvalidInput, "at least 1"),
        (lambda: dc.ContactOptions(friction_iterations=1.5), TypeError, "integer"),
        (lambda: dc.ContactOptions(self_contact=1), TypeError, "True or False"),
        (lambda: dc.SolverOptions(tolerance=0.0), dc.InvalidInput, "> 0"),
        (lambda: dc.SolverOptions(tolerance="1e-3"), TypeError, "real numbers"),
        (lambda: dc.SolverOptions(max_iterations=0), dc.InvalidInput, "at least 1"),
        (lambda: dc.SolverOptions(elastic="pd"), dc.InvalidInput, "'newton', 'projective'"),
        (lambda: dc.SolverOptions(metric="norm"), dc.InvalidInput, "'energy', 'elastic', 'mass'"),
    ],
)
def test_bad_options_are_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_a_scene_pickles():
    scene = two_cloths()
    again = pickle.loads(pickle.dumps(scene))
    assert again.cloth_names == scene.cloth_names
    np.testing.assert_array_equal(assemble(again).vertices, assemble(scene).vertices)
    assert list(again.cloths[0].pins) == ["b", "a"]


def test_scenes_compare_by_identity():
    assert two_cloths() != two_cloths()
    assert dc.Material() != dc.Material()
