"""Gradients of the example of docs/extending.md against differences; runs in the extended copy."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scenes
import torch
from core_steps import check_pairs, inputs_of

import diffcloth_torch as dc

F64 = torch.float64
DRAG = 3.0  # [Pa s/m]; slows the cloths of the scenes by a tenth in a step
SOLVERS = [
    ("coupled", None, "newton"),
    *(("split", metric, "newton") for metric in ("energy", "elastic", "mass", "identity")),
    ("split", "energy", "projective"),
    ("projective", None, "newton"),
    ("projective", None, "projective"),
]


def test_the_tested_package_is_the_copy():
    assert Path(dc.__file__).is_relative_to(Path(__file__).parents[2])
    assert "drag" in vars(dc.Parameters)


def per_face(count, seed=0):
    return DRAG * (1.0 + scenes.tensor_noise((count,), 0.3, seed))


def losses_of(after, count=2):
    g = torch.Generator().manual_seed(1)
    outputs = [after.positions, after.velocities]
    return outputs, [torch.randn(count, *y.shape, generator=g, dtype=F64) for y in outputs]


def check_gradients(step, given, sizes, rtol=1e-5):
    """Check gradients of two losses at once, against single losses and central differences.

    Args:
        step: Function from named values to the state after a step.
        given: Values by name.
        sizes: Step of the differences for each value.
    """
    leaves = {name: value.clone().requires_grad_() for name, value in given.items()}
    outputs, cotangents = losses_of(step(**leaves))
    values = list(leaves.values())
    both = torch.autograd.grad(
        outputs, values, cotangents, is_grads_batched=True, retain_graph=True
    )
    for k in range(2):
        weights = [c[k] for c in cotangents]
        alone = torch.autograd.grad(outputs, values, weights, retain_graph=True)
        for name, gradients, gradient in zip(given, both, alone, strict=True):
            assert torch.equal(gradients[k], gradient), name
            direction = torch.as_tensor(scenes.noise(tuple(gradient.shape), 1.0, k))
            move = sizes[name] * direction
            with torch.no_grad():
                ends = [
                    losses_of(step(**{**given, name: given[name] + s * move}))[0] for s in (1, -1)
                ]
            change = sum((w * (a - b)).sum() for w, a, b in zip(weights, *ends, strict=True))
            slope = change / (2 * sizes[name])
            assert slope.abs() > 0, name
            torch.testing.assert_close((gradient * direction).sum(), slope, rtol=rtol, atol=1e-7)


@cache
def sheet(scheme, metric, elastic):
    """A sheet that slides on a box, its velocity not zero."""
    vertices, faces = scenes.grid(5, 5, seed=3)
    box = dc.RigidBody.box((0.3, 0.3, 0.4), friction=0.3)
    cloth = dc.Cloth(
        vertices + np.array([0.0, 0.0, 0.206]),
        faces,
        material=scenes.material(faces, friction=0.3),
        soft_pins={"free": [24]},
        pin_stiffness=2.0,
    )
    sim = scenes.simulator([cloth], [box], scheme=scheme, metric=metric)
    solver = replace(sim.solver, elastic=elastic)
    sim = dc.Simulator(sim.scene, sim.dt, scheme=scheme, contact=sim.contact, solver=solver)
    return sim, scenes.settled(sim, sim.initial_state(), 4, velocity=(0.9, 0.5, -0.1))


def gradients_of(sim, state, drag):
    """Check gradients by drag, and by the rest positions and positions that drag depends on."""

    def step(drag, rest_positions, positions):
        parameters = sim.default_parameters().replace(drag=drag, rest_positions=rest_positions)
        return sim.step(state.replace(positions=positions), None, parameters)

    rest = sim.default_parameters().rest_positions
    given = {"drag": drag, "rest_positions": rest, "positions": state.positions}
    check_gradients(step, given, {"drag": 0.02, "rest_positions": 1e-6, "positions": 1e-6})


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: "-".join(filter(None, s)))
def test_the_gradients_are_exact_in_every_scheme(solver):
    sim, state = sheet(*solver)
    gradients_of(sim, state, per_face(len(sim.scene.cloths[0].faces)))
    gradients_of(sim, state, torch.tensor(DRAG, dtype=F64))


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: "-".join(filter(None, s)))
def test_the_tangents_are_the_transpose_of_the_gradients(solver):
    sim, state = sheet(*solver)
    drag = per_face(len(sim.scene.cloths[0].faces))
    core, inputs = inputs_of(
        sim, lambda: sim.step(state, None, sim.default_parameters().replace(drag=drag))
    )
    assert {"drag", "rest_positions"} <= set(inputs)
    assert {"positions", "velocities"} <= check_pairs(core, inputs, core.forward(inputs, True, 1))


@pytest.mark.parametrize("scheme", ["coupled", "split"])
@pytest.mark.parametrize("coupling", ["monolithic", "rigid_to_cloth", "cloth_to_rigid"])
def test_the_gradients_are_exact_in_every_coupling(scheme, coupling):
    if (scheme, coupling) == ("split", "monolithic"):
        pytest.skip("not taken together")
    vertices, faces = scenes.grid(5, 5, edge=0.06, seed=3)
    cloth = dc.Cloth(
        vertices - vertices.mean(axis=0),
        faces,
        material=scenes.material(faces, stretch=200.0),
        pins={"corners": [0, 4, 20, 24]},
    )
    box = dc.RigidBody.box(
        0.06, motion="dynamic", mass=0.5, pose=[0.01, 0, 0.037, 1, 0.02, 0.02, 0.2]
    )
    sim = dc.Simulator(
        dc.Scene([cloth], [box], gravity=(0.04, -0.03, -0.98)),
        0.01,
        scheme=scheme,
        coupling=coupling,
        contact=dc.ContactOptions(
            barrier_distance=0.01, barrier_stiffness=60.0, slip_velocity=0.02
        ),
        solver=dc.SolverOptions(tolerance=1e-11),
    )
    state = scenes.settled(sim, sim.initial_state(), 2, velocity=(0.1, 0.05, -0.1))
    assert state.body_forces.abs().max() > 0  # they touch
    gradients_of(sim, state, per_face(len(faces)))


def test_a_scene_without_cloths_needs_none():
    box = dc.RigidBody.box(0.1, motion="dynamic", mass=0.2)
    contact = dc.ContactOptions(barrier_distance=0.01)
    sim = dc.Simulator(dc.Scene([], [box]), 0.01, contact=contact)
    assert sim.default_parameters().drag is None
    gravity = sim.default_parameters().gravity.clone().requires_grad_()
    after = sim.step(sim.initial_state(), None, sim.default_parameters().replace(gravity=gravity))
    (gradient,) = torch.autograd.grad(after.body_velocities[0, 2], [gravity])
    torch.testing.assert_close(gradient, torch.tensor([0, 0, sim.dt], dtype=F64))


def test_a_sheet_falls_as_drag_has_it():
    """v <- (v - g h) / (1 + h c_d / rho), in all schemes."""
    cloth = dc.Cloth.grid(4, 4, material=dc.Material(density=0.2, drag=DRAG))
    for scheme in ("coupled", "split", "projective"):
        solver = dc.SolverOptions(tolerance=1e-12)
        sim = dc.Simulator(dc.Scene([cloth]), 0.01, scheme=scheme, solver=solver)
        v = sim.step(sim.initial_state()).velocities
        expected = torch.zeros_like(v)
        expected[:, 2] = -9.81 * 0.01 / (1 + 0.01 * DRAG / 0.2)
        torch.testing.assert_close(v, expected, rtol=1e-8, atol=1e-10)
