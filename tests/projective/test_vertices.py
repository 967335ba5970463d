"""Vertices of cloths in contact with each other: equal and opposite impulses, exact gradients."""

import numpy as np
import pytest
import torch
from nodal_scenes import DT, assert_gradients_are_those_of_differences, counts, stacked
from scenes import F64, grid, material

import diffcloth_torch as dc


def momentum(step, state):
    density = step.sim.default_parameters().density
    triangles = torch.cat([torch.from_numpy(np.array(c.faces)) for c in step.sim.scene.cloths])
    triangles[len(triangles) // 2 :] += 25
    rest = step.sim.default_parameters().rest_positions
    a, b, c = (rest[triangles[:, k]] for k in range(3))
    masses = torch.zeros(50, dtype=F64)
    share = density * torch.linalg.cross(b - a, c - a).norm(dim=1) / 6
    for k in range(3):
        masses.index_add_(0, triangles[:, k], share)
    return masses @ state.velocities


@pytest.mark.parametrize("elastic", ["newton", "projective"])
def test_pairs_keep_the_momentum(elastic):
    step = stacked(elastic)
    state, before = step.state, momentum(step, step.state)
    touched = 0
    for _ in range(5):
        state = step.sim.step(state)
        touched += sum(counts(state)[1:])
        force = state.report.contacts["cloth0", "cloth1"].force
        on_upper = state.contact_forces[25:].sum(0)
        torch.testing.assert_close(force, on_upper, rtol=1e-9, atol=1e-12)
    assert touched > 10
    torch.testing.assert_close(momentum(step, state), before, rtol=0, atol=1e-9)


def test_newton_and_projective_dynamics_agree():
    newton, local_global = stacked(), stacked("projective", tolerance=1e-9)
    after, expected = local_global(newton.inputs), newton()
    assert counts(after) == counts(expected)
    assert sum(counts(expected)[1:]) > 0
    assert (after.positions - expected.positions).abs().max() < 1e-8


@pytest.mark.parametrize("friction", [0.05, 2.0])
def test_gradients_of_pairs_are_those_of_differences(friction):
    step = stacked(friction=friction, tolerance=1e-11)
    _, sticking, slipping = counts(step())
    assert slipping > 0 if friction < 0.5 else sticking > 0
    generator = torch.Generator().manual_seed(0)
    scales = {"positions": 1.0, "velocities": DT, "contact_forces": 1e-2}
    weights = {
        name: scale * torch.randn(50, 3, dtype=F64, generator=generator)
        for name, scale in scales.items()
    }

    def value(changes=None):
        after = step(changes)
        return sum((getattr(after, name) * w).sum() for name, w in weights.items())

    sizes = {
        name: 1e-6 if "positions" in name else 1e-4 * max(1.0, float(tensor.abs().max()))
        for name, tensor in step.inputs.items()
    }
    assert_gradients_are_those_of_differences(value, step.inputs, sizes, generator)


def test_options_turn_self_contact_on_and_off():
    lower, faces = grid(5, 5, seed=1, jitter=0.05)
    folded = lower.copy()
    # One half of the sheet is folded over the other, closer than the vertices' spheres.
    over = folded[:, 0] > 0.02
    folded[over, 0] = 0.04 - folded[over, 0]
    folded[over, 2] += 0.05
    for self_contact in (True, False):
        sim = dc.Simulator(
            dc.Scene([dc.Cloth(folded, faces, rest_positions=lower, material=material(faces))]),
            DT,
            scheme="projective",
            contact=dc.ContactOptions(self_contact=self_contact),
            solver=dc.SolverOptions(throw=False),
        )
        after = sim.step(sim.initial_state())
        assert (sum(counts(after)) > 0) == self_contact


def corner_over_patch(gap, at=(0.0, 0.0), coarse_first=True, bodies=()):
    """A corner of a coarse sheet, of radius 0.05, near the middle of a patch of radius 0.01."""
    patch = dc.Cloth.grid(3, 3, size=(0.04, 0.04))
    corner = dc.Cloth.grid(2, 2, size=(0.1, 0.1))
    offset = np.array([*at, gap]) - np.array(corner.vertices).min(0)
    cloths = [dc.Cloth(np.array(corner.vertices) + offset, corner.faces), patch]
    if not coarse_first:
        cloths.reverse()
    sim = dc.Simulator(
        dc.Scene(cloths, bodies, gravity=(0.0, 0.0, 0.0)),
        DT,
        scheme="projective",
        contact=dc.ContactOptions(self_contact=False),
    )
    return sim, sim.initial_state()


@pytest.mark.parametrize("coarse_first", [True, False])
def test_vertices_touch_where_the_spheres_of_both_meet(coarse_first):
    for gap, count in ((0.0595, 1), (0.0605, 0)):
        sim, state = corner_over_patch(gap, coarse_first=coarse_first)
        assert sum(counts(sim.step(state))) == count


@pytest.mark.parametrize(("x", "y"), [(-0.013, -0.013), (0.013, 0.013), (0.013, -0.013)])
def test_a_vertex_touches_the_one_that_it_is_deepest_in(x, y):
    sim, state = corner_over_patch(0.05, (x, y))
    velocities = torch.zeros_like(state.velocities)
    velocities[:4, 2] = -0.1
    after = sim.step(state.replace(velocities=velocities))
    assert sum(counts(after)) == 1
    touched = after.contact_forces[4:].norm(dim=1).argmax()
    target = torch.tensor([x, y], dtype=F64)
    assert touched == (state.positions[4:, :2] - target).norm(dim=1).argmin()


def test_a_vertex_that_touches_a_body_touches_no_other_vertex():
    floor = dc.RigidBody.plane(
        1.0, pose=[0, 0, -9e-4, 1, 0, 0, 0], thickness=2e-3, nodal_contact=True
    )
    sim, state = corner_over_patch(0.055, bodies=[floor])
    after = sim.step(state)
    assert sum(counts(after)) == 9
    assert after.report.contacts["cloth0", "cloth1"].count == 0
