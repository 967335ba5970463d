"""Woven cloth in a scene: directions, parameters and refused values."""

import dataclasses
import pickle

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

F64 = torch.float64
WOVEN = {
    "stretch_weft": 200.0,
    "stretch_shear": 50.0,
    "bending_weft": 8e-6,
    "bending_twill": 9e-6,
}
SHEET = ([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])


def cloth(material=None, **options):
    options.setdefault("pins", {"edge": [0, 1]})
    return dc.Cloth.grid(5, 5, (0.4, 0.4), material=material or dc.Material(**WOVEN), **options)


def fallen(*cloths, steps=3, parameters=None, batch=None, **options):
    sim = dc.Simulator(dc.Scene(cloths), 0.01, **options)
    state = sim.initial_state(batch)
    with torch.no_grad():
        for _ in range(steps):
            state = sim.step(state, None, parameters)
    return state.positions


def test_axes_are_directions_in_the_rest_frames_of_faces():
    """Face 0 has its first side along x, face 1 along the diagonal."""
    sheet = dc.Cloth(*SHEET, directions=[2.0, 2.0, 5.0])
    half = np.sqrt(0.5)
    np.testing.assert_allclose(sheet.material_axes("here"), [[half, half], [1.0, 0.0]], atol=1e-15)
    each = dc.Cloth(*SHEET, directions=[[0.0, 3.0, 0], [1.0, 0, 0]])
    np.testing.assert_allclose(each.material_axes("here"), [[0, 1], [half, -half]], atol=1e-15)
    np.testing.assert_array_equal(dc.Cloth(*SHEET).directions, [1.0, 0.0, 0.0])


def test_the_warp_lies_along_x_by_default():
    """A sheet that hangs by its warp is stretched less than one that hangs by its weft."""
    material = dc.Material(stretch=200.0, stretch_weft=20.0, density=0.5)
    along_y = {
        "pins": {"edge": range(20, 25)},
        "pose": [0, 0, 0, *(0.5**0.5 * np.array([1, 1, 0, 0]))],
    }

    def length(directions):
        sheet = cloth(material, directions=directions, **along_y)
        sim = dc.Simulator(dc.Scene([sheet]), 0.01)
        return float(np.ptp(sim.equilibrium(sim.initial_state()).positions[:, 2].numpy()))

    by_weft, by_warp = length(None), length([0.0, 1.0, 0.0])
    assert length([1.0, 0.0, 0.0]) == by_weft
    weight = 0.5 * 9.81 * 0.4  # of a unit of width
    for found, stiffness in ((by_weft, 20.0), (by_warp, 200.0)):
        assert found == pytest.approx(0.4 * (1 + weight / (2 * stiffness)), rel=5e-3)


def test_directions_belong_to_the_material():
    """A rest shape rotated in its plane rotates the directions too; the motion is unchanged."""
    sheet = cloth()
    sim = dc.Simulator(dc.Scene([sheet]), 0.01)
    c, s = np.cos(0.7), np.sin(0.7)
    turned = torch.tensor(sheet.rest_positions @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
    expected = fallen(sheet)
    found = fallen(sheet, parameters=sim.default_parameters().replace(rest_positions=turned))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-10)
    other = fallen(cloth(directions=[c, s, 0.0]))
    assert (other - expected).abs().max() > 1e-5


@pytest.mark.parametrize("scheme", ["coupled", "split", "projective"])
def test_equal_numbers_are_an_isotropic_cloth_bit_for_bit(scheme):
    equal = dict.fromkeys(("stretch_weft", "stretch_shear"), 550.0)
    equal |= dict.fromkeys(("bending_weft", "bending_twill"), 1e-5)
    woven = cloth(dc.Material(**equal), directions=[0.3, 1.0, 0.0])
    plain = cloth(dc.Material())
    assert torch.equal(fallen(woven, scheme=scheme), fallen(plain, scheme=scheme))
    changed = cloth(dc.Material(**equal | {"stretch_weft": 500.0}), directions=[0.3, 1.0, 0.0])
    assert not torch.equal(fallen(changed, scheme=scheme), fallen(plain, scheme=scheme))


@pytest.mark.parametrize("metric", ["energy", "elastic", "mass", "identity"])
@pytest.mark.parametrize("elastic", ["newton", "projective"])
def test_local_global_iterations_reach_the_minimizer_of_newton(metric, elastic):
    """This includes shear stiffer than the yarns, which the constant form does not bound."""
    material = dc.Material(**WOVEN | {"stretch_shear": 900.0})
    options = {"tolerance": 1e-9, "max_iterations": 5000}
    reference = fallen(cloth(material), scheme="split", solver=dc.SolverOptions(**options))
    solver = dc.SolverOptions(metric=metric, elastic=elastic, **options)
    found = fallen(cloth(material), scheme="split", solver=solver)
    torch.testing.assert_close(found, reference, rtol=0, atol=1e-8)


def test_a_scene_has_the_numbers_that_a_material_of_it_sets():
    other = dc.Cloth.grid(3, 3, pose=[0, 0, 1, 1, 0, 0, 0], material=dc.Material(stretch=300.0))
    plain = dc.Simulator(dc.Scene([other]), 0.01).default_parameters()
    assert all(getattr(plain, name) is None for name in WOVEN)
    stretch = dc.Simulator(dc.Scene([cloth(dc.Material(stretch_weft=5.0)), other]), 0.01)
    parameters = stretch.default_parameters()
    assert parameters.bending_weft is parameters.bending_twill is None
    assert parameters.stretch.tolist() == [550.0, 300.0]
    assert parameters.stretch_weft.tolist() == [5.0, 300.0]
    assert parameters.stretch_shear.tolist() == [550.0, 300.0]
    both = dc.Simulator(dc.Scene([cloth(), other]), 0.01).default_parameters()
    assert both.bending_twill.tolist() == [9e-6, 1e-5]
    per_face = dc.Material(bending_weft=np.full(32, 8e-6))
    rows = dc.Simulator(dc.Scene([cloth(per_face), other]), 0.01).default_parameters().bending_weft
    assert rows.tolist() == [8e-6] * 32 + [1e-5] * 8


def test_parameters_by_name_and_in_batches_act():
    sheet = cloth(name="sheet")
    sim = dc.Simulator(dc.Scene([sheet]), 0.01)
    weft = {"stretch_weft": torch.tensor(100.0, dtype=F64)}
    by_name = sim.default_parameters().replace(stretch_weft={"sheet": weft["stretch_weft"]})
    one = fallen(sheet, parameters=sim.default_parameters().replace(**weft))
    assert torch.equal(fallen(sheet, parameters=by_name), one)
    two = torch.tensor([100.0, 200.0], dtype=F64)
    batched = fallen(sheet, parameters=sim.default_parameters().replace(stretch_weft=two), batch=2)
    assert torch.equal(batched[0], one)
    assert torch.equal(batched[1], fallen(sheet))


BAD_MATERIALS = [
    ({"stretch_weft": 0.0}, "`stretch_weft` must be finite and > 0"),
    ({"stretch_shear": [1.0, -1.0]}, r"`stretch_shear` .* got -1 at \[1\]"),
    ({"bending_weft": -1.0}, "`bending_weft` must be finite and >= 0"),
    ({"bending_weft": 0.0}, "`bending_weft` must be > 0 like `bending`, got 0"),
    ({"bending": 0.0, "bending_weft": 1.0}, "`bending_weft` must be 0 like `bending`, got 1"),
    ({"bending_twill": 6.4e-6}, r"`bending_twill` must be at least .* is 6.5e-06, got 6.4e-06"),
    ({"bending_twill": [1e-5, 1e-6]}, r"`bending_twill` .* got 1e-06 at face \[1\]"),
    ({"bending": [1e-5] * 3, "bending_twill": [1e-5] * 2}, r"as there are faces, got \[2, 3\]"),
    ({"stretch_weft": torch.tensor(1.0, requires_grad=True)}, "Parameters.stretch_weft instead"),
]


@pytest.mark.parametrize(("fields", "message"), BAD_MATERIALS)
def test_a_bad_material_is_refused(fields, message):
    with pytest.raises(dc.InvalidInput, match=f"Material: .*{message}"):
        dc.Material(**fields)


def test_the_least_bending_along_the_twill_is_accepted():
    dc.Material(bending_twill=6.5e-6 * (1 + 1e-12))
    dc.Material(bending=0.0, bending_weft=0.0, bending_twill=0.0)


BAD_DIRECTIONS = [
    ([0.0, 0.0, 0.0], r"must not be zero, got \[0.0, 0.0, 0.0\]"),
    ([[1.0, 0, 0], [0, 0, 0]], r"must not be zero, .* at \[1\]"),
    ([[1.0, 0, 0], [0, 0, 2.0]], r"must not be normal .* \[0.0, 0.0, 2.0\] for face \[1\]"),
    ([0.0, 1e-4, 1.0], r"must not be normal .* for face \[0\], .* 0.001 rad"),
    ([1.0, 0.0], r"must have shape \[3\] or \[2, 3\], got \[2\]"),
    ([np.nan, 0.0, 0.0], "nan"),
    (torch.ones(3, requires_grad=True), "directions have no gradient"),
]


@pytest.mark.parametrize(("directions", "message"), BAD_DIRECTIONS)
def test_bad_directions_are_refused(directions, message):
    with pytest.raises(dc.InvalidInput, match=f"Cloth: `directions`.*{message}"):
        dc.Cloth(*SHEET, directions=directions)


def test_a_closed_cloth_needs_directions_only_where_it_is_woven():
    """The first two faces of this corner are normal to x."""
    wall = np.array([[0.0, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [0, 1, 1], [1, 1, 1]])
    faces = np.array([[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4]])
    plain = dc.Cloth(wall, faces, pins={"a": [0]}, name="wall")
    with pytest.raises(dc.InvalidInput, match=r"Cloth: `directions` must not be normal .*face \[0"):
        dc.Cloth(wall, faces, material=dc.Material(**WOVEN))
    dc.Cloth(wall, faces, material=dc.Material(**WOVEN), directions=[1.0, 1.0, 0.5])
    dc.Simulator(dc.Scene([plain]), 0.01)
    away = cloth(pose=[5, 0, 0, 1, 0, 0, 0])
    with pytest.raises(dc.InvalidInput, match="Scene: 'wall': `directions` must not be normal"):
        dc.Simulator(dc.Scene([away, plain]), 0.01)


def test_hinges_have_one_bending_stiffness():
    with pytest.raises(dc.InvalidInput, match=r"`material.bending_twill` must be None where"):
        cloth(dc.Material(bending_twill=1e-5), bending_model="hinge")
    fallen(cloth(dc.Material(stretch_weft=100.0), bending_model="hinge"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bending_twill": 1e-7}, r"`bending_twill` must be at least .* at face \[0\]"),
        ({"bending": 0.0}, r"`bending_weft` must be 0 like `bending`, got 8e-06"),
        ({"poisson": torch.tensor([0.49, 0.3])}, r"`bending_twill` must be at least"),
        ({"stretch_weft": -1.0}, "`parameters.stretch_weft` must be finite and > 0"),
    ],
)
def test_parameters_without_a_positive_energy_are_refused(changes, message):
    material = dc.Material(**WOVEN | {"bending_twill": 6e-6})
    other = dc.Cloth.grid(3, 3, pose=[0, 0, 1, 1, 0, 0, 0], material=dc.Material(bending=1e-4))
    sim = dc.Simulator(dc.Scene([cloth(material), other]), 0.01)
    changed = sim.default_parameters().replace(**changes)
    with pytest.raises(dc.InvalidInput, match=f"^step: {message}"):
        sim.step(sim.initial_state(), None, changed)


def test_directions_survive_a_pickle():
    sheet = pickle.loads(pickle.dumps(cloth(directions=[1.0, 1.0, 0.0])))
    np.testing.assert_array_equal(sheet.directions, [1.0, 1.0, 0.0])
    assert sheet.material.bending_twill == WOVEN["bending_twill"]


def test_a_material_shows_its_set_fields():
    assert "weft" not in repr(dc.Material())
    assert "stretch_weft=200" in repr(dc.Material(**WOVEN))
    assert dataclasses.replace(dc.Material(**WOVEN), stretch=1.0).stretch_weft == 200.0
