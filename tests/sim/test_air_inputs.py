"""Drag, air density and wind as inputs: defaults and refused values."""

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

F64 = torch.float64
DRAG = dc.Material(normal_drag=1.5, tangential_drag=0.03)


def sheet(material=DRAG, **options):
    return dc.Cloth.grid(3, 3, material=material, **options)


def falling_box():
    box = dc.RigidBody.box(0.1, motion="dynamic", mass=1.0)
    return dc.Scene([], [box])


def test_defaults_come_from_materials_and_the_scene():
    parameters = dc.Simulator(dc.Scene([sheet(dc.Material())]), 0.01).default_parameters()
    assert (parameters.normal_drag, parameters.tangential_drag) == (0.0, 0.0)
    assert parameters.air_density == 1.2
    per_face = dc.Material(normal_drag=np.linspace(0.0, 1.0, 8))
    scene = dc.Scene([sheet(per_face), sheet(pose=[0, 0, 1, 1, 0, 0, 0])], air_density=0.9)
    parameters = dc.Simulator(scene, 0.01).default_parameters()
    assert parameters.normal_drag.tolist() == [*np.linspace(0.0, 1.0, 8), *[1.5] * 8]
    assert parameters.tangential_drag.tolist() == [0.0, 0.03]
    assert parameters.air_density == 0.9
    named = parameters.replace(tangential_drag={"cloth1": 0.5})
    state = dc.Simulator(scene, 0.01).initial_state()
    wind = dc.Control(wind=torch.tensor([1.0, 0.0, 0.0], dtype=F64))
    moved = dc.Simulator(scene, 0.01).step(state, wind, named).positions - state.positions
    assert (moved[9:, 0] > 1e-5).all()
    assert (moved[:9, 0].abs() < 1e-12).all()  # no friction, and flat


def test_a_scene_without_cloths_has_no_air():
    sim = dc.Simulator(falling_box(), 0.01, contact=dc.ContactOptions(barrier_distance=1e-3))
    assert sim.default_parameters().air_density is None
    assert sim.default_parameters().normal_drag is None
    state = sim.initial_state()
    with pytest.raises(
        dc.InvalidInput, match=r"^step: `control.wind` must be None: the scene has no"
    ):
        sim.step(state, dc.Control(wind=torch.zeros(3, dtype=F64)))
    with pytest.raises(dc.InvalidInput, match=r"^step: `parameters.air_density` must be None"):
        sim.step(state, None, dc.Parameters(air_density=torch.tensor(1.2)))


@pytest.mark.parametrize(
    ("wind", "message"),
    [
        ([1.0, 2.0], r"control: `wind` must have shape \[3\] or"),
        ([[1.0, 0.0, 0.0]] * 2, "step: `control.wind` has a batch axis"),
        ([np.nan, 0.0, 0.0], r"control: `wind` must be finite"),
        ("south", "control: `wind` must hold real numbers"),
    ],
)
def test_winds_that_are_none_are_refused(wind, message):
    sim = dc.Simulator(dc.Scene([sheet()]), 0.01)
    with pytest.raises((dc.InvalidInput, TypeError), match=message):
        sim.step(sim.initial_state(), sim.control(wind=wind))


@pytest.mark.parametrize("density", [-1.0, np.nan, "thin"])
def test_densities_that_are_none_are_refused(density):
    with pytest.raises((dc.InvalidInput, TypeError), match="Scene: `air_density` must "):
        dc.Scene([sheet()], air_density=density)


def test_equilibria_refuse_wind_and_feel_no_air_at_rest():
    cloth = sheet(pins={"edge": [0, 1, 2]}, pose=[0, 0, 0, 1, 0.2, 0, 0])
    ends = []
    for material in (DRAG, dc.Material()):
        sim = dc.Simulator(
            dc.Scene([dc.Cloth(cloth.vertices, cloth.faces, material=material, pins=cloth.pins)]),
            0.01,
        )
        ends.append(sim.equilibrium(sim.initial_state()).positions)
    assert torch.equal(*ends)
    with pytest.raises(dc.InvalidInput, match=r"equilibrium: `control\.wind` must be zero"):
        sim.equilibrium(sim.initial_state(), sim.control(wind=[1.0, 0.0, 0.0]))
