"""Named fabrics: their numbers match the measurements, and each fabric makes a cloth."""

from typing import get_args

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.config.scene_schema import Fabric, MaterialSection
from diffcloth_torch.config.validation import validate
from diffcloth_torch.model.orthotropy import check_bending

NAMES = list(dc.fabrics.MEASUREMENTS)


def test_configurations_know_all_eight_fabrics():
    assert len(NAMES) == 8
    assert list(get_args(Fabric)) == NAMES


def test_the_conversion_is_that_of_the_page():
    """Expected values of denim computed by hand."""
    denim = dc.fabrics.material("denim")
    assert denim.density == 0.324
    assert (denim.stretch, denim.stretch_weft) == (1013.88629, 205.352005)
    assert denim.stretch_shear == 53.387184
    bending = np.array([denim.bending, denim.bending_twill, denim.bending_weft])
    np.testing.assert_allclose(bending, [16.04911425e-6, 18.34614175e-6, 24.237894e-6])


def test_a_quarter_is_the_stiffness_of_a_plate_of_hinges_on_equilateral_triangles():
    """k l^2 theta^2 / (8 A) of all hinges of a bent sheet is the energy of a plate with D = k / 4.

    The sheet z = c s^2 / 2 is bent along s. Each vertex has an edge of each of three directions.
    """
    side, c, k = 1e-2, 0.1, 1.0
    height = np.sqrt(0.75) * side
    area = height * side  # area of two faces, and of one vertex
    corners = np.array([[0.0, 0.0], [side, 0.0], [side / 2, height], [side / 2, -height]])
    for bent in np.linspace(0.0, np.pi, 7):
        energy = 0.0
        for angle in bent + np.array([0.0, np.pi / 3, 2 * np.pi / 3]):
            z = 0.5 * c * (corners @ [np.cos(angle), np.sin(angle)]) ** 2
            theta = (z[2] + z[3] - z[0] - z[1]) / height  # both slopes rise from the edge's middle
            energy += k * side**2 * theta**2 / (8 * area)
        assert energy / area == pytest.approx(0.5 * (k / 4) * c**2, rel=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_every_fabric_is_a_woven_cloth_that_moves(name):
    material = dc.fabrics.material(name, thickness=1e-4)
    assert material.is_orthotropic
    assert material.thickness == 1e-4
    values = [np.asarray(material.per_face(n)) for n in ("bending", "bending_weft")]
    check_bending(name, *values, np.asarray(material.bending_twill), np.asarray(0.45))
    assert material.stretch >= material.stretch_weft
    cloth = dc.Cloth.grid(6, 6, (0.3, 0.3), material=material, pins={"two": [0, 5]})
    sim = dc.Simulator(dc.Scene([cloth]), 0.01)
    state = sim.initial_state()
    with torch.no_grad():
        for _ in range(3):
            state = sim.step(state)
    assert state.report.converged
    assert state.positions[-1, 2] < -1e-3


def test_an_unknown_fabric_is_refused():
    with pytest.raises(dc.InvalidInput, match=r"fabrics.material: `name` must be .*denim"):
        dc.fabrics.material("tweed")
    with pytest.raises(dc.InvalidInput, match="`fabric` must be "):
        validate(MaterialSection, {"fabric": "tweed"}, "here")
    with pytest.raises(dc.InvalidInput, match="Material: `density` must be finite and > 0"):
        dc.fabrics.material("denim", density=-1.0)
