"""Rest meshes with touching parts, which are frequent in files."""

import numpy as np
import pytest

import diffcloth_torch as dc

SHEET = dc.Cloth.grid(4, 4, 0.3)
VERTICES, FACES = np.array(SHEET.vertices), np.array(SHEET.faces)


def simulator(vertices, faces, **options):
    scene = dc.Scene([dc.Cloth(vertices, faces, name="shirt")])
    return dc.Simulator(scene, 0.01, contact=dc.ContactOptions(**options))


def test_vertices_at_one_place_are_named():
    faces = FACES.copy()
    faces[3] = np.where(faces[3] == faces[3][0], len(VERTICES), faces[3])
    twin = int(FACES[3][0])
    cut = np.vstack([VERTICES, VERTICES[twin]])
    message = f"vertices {twin} and 16 of cloth 'shirt' are at one place in its rest mesh"
    with pytest.raises(dc.InvalidInput, match=message):
        simulator(cut, faces)
    simulator(cut, faces, self_contact=False)


@pytest.mark.parametrize("gap", [1e-12, 1e-9])
def test_layers_that_touch_are_refused_by_their_distance(gap):
    layers = np.vstack([VERTICES, VERTICES + np.array([0, 0, gap])])
    message = f"elements of the rest mesh of a cloth that are not neighbors are {gap:g} m apart"
    with pytest.raises(dc.InvalidInput, match=message):
        simulator(layers, np.vstack([FACES, FACES + 16]))
