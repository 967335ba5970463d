"""Friction by the names of pairs of surfaces."""

from __future__ import annotations

import pickle
import re

import pytest
import torch

import diffcloth_torch as dc

F64 = torch.float64


def number(value):
    return torch.tensor(value, dtype=F64, requires_grad=True)


@pytest.fixture(scope="module")
def sim():
    """A mat that slides on a floor, and a box far away."""
    mat = dc.Cloth.grid(4, 3, (0.2, 0.15), pose=[0, 0, 0.001, 1, 0, 0, 0], name="mat")
    floor = dc.RigidBody.plane(3.0, name="floor")
    far = dc.RigidBody.box(0.1, pose=[0, 0, 2, 1, 0, 0, 0], name="far")
    contact = dc.ContactOptions(barrier_distance=0.002)
    return dc.Simulator(dc.Scene([mat], [floor, far]), 0.01, contact=contact)


def slide(sim, friction, batch_size=None, **options):
    state = sim.initial_state(batch_size)
    push = torch.tensor([0.3, 0.0, 0.0], dtype=F64).expand(state.positions.shape)
    parameters = sim.default_parameters().replace(friction=friction)
    return sim.rollout(state.replace(velocities=push), None, parameters, steps=4, **options)[-1]


def matrix(sim, mu):
    """Friction of the scene, of which both entries of the first two surfaces are mu."""
    place = torch.zeros(3, 3, dtype=F64)
    place[0, 1] = place[1, 0] = 1
    return torch.where(place > 0, mu, sim.default_parameters().friction)


@pytest.mark.parametrize("pair", [("mat", "floor"), ("floor", "mat")])
@pytest.mark.parametrize("options", [{}, {"checkpoint_every": 2}], ids=["plain", "checkpoints"])
def test_a_named_pair_is_both_of_its_entries(sim, pair, options):
    named, indexed = number(0.2), number(0.2)
    by_name = slide(sim, {pair: named}, **options)
    by_index = slide(sim, matrix(sim, indexed))
    assert by_name.report.contact_count > 0
    assert torch.equal(by_name.positions, by_index.positions)
    for end in (by_name, by_index):
        end.positions[:, 0].sum().backward()
    assert named.grad < -1e-4
    assert torch.equal(named.grad, indexed.grad)


def test_the_gradient_is_that_of_differences(sim):
    exact = dc.SolverOptions(tolerance=1e-11)
    sim = dc.Simulator(sim.scene, sim.dt, contact=sim.contact, solver=exact)

    def reach(mu):
        return slide(sim, {("floor", "mat"): mu}).positions[:, 0].sum()

    mu, step = number(0.15), 1e-5
    reach(mu).backward()
    with torch.no_grad():
        slope = (reach(mu + step) - reach(mu - step)) / (2 * step)
    assert mu.grad.item() == pytest.approx(slope.item(), rel=1e-6)


def test_pairs_that_are_not_named_keep_the_friction_of_the_scene(sim):
    ordinary = slide(sim, None)
    for friction in ({}, {("mat", "far"): 0.0}, {("mat", "mat"): 0.9}):
        assert torch.equal(slide(sim, friction).positions, ordinary.positions)
    assert not torch.equal(slide(sim, {("mat", "floor"): 0.0}).positions, ordinary.positions)


def test_environments_may_have_separate_friction(sim):
    values = torch.tensor([0.1, 0.3], dtype=F64, requires_grad=True)
    both = slide(sim, {("mat", "floor"): values, ("mat", "mat"): 0.2}, batch_size=2)
    for i, mu in enumerate((0.1, 0.3)):
        alone = slide(sim, {("mat", "floor"): mu, ("mat", "mat"): 0.2})
        assert torch.equal(both.positions[i], alone.positions)
    both.positions[0, :, 0].sum().backward()
    assert values.grad[0] < 0
    assert values.grad[1] == 0


def test_named_friction_prints_and_pickles(sim):
    parameters = dc.Parameters(friction={("mat", "floor"): number(0.25)})
    assert "friction={('mat', 'floor'): 0.25 (grad)}" in repr(parameters)
    copy = pickle.loads(pickle.dumps(dc.Parameters(friction={("mat", "floor"): 0.25})))
    assert copy.friction == {("mat", "floor"): 0.25}


# The box is light; this test does not need the warning about its added mass.
@pytest.mark.filterwarnings("ignore::diffcloth_torch.AddedMassWarning")
def test_couplings_accept_named_friction():
    mat = dc.Cloth.grid(3, 3, 0.2, pose=[0, 0, 0.001, 1, 0, 0, 0], name="mat")
    box = dc.RigidBody.box(
        0.1, motion="dynamic", mass=0.1, pose=[0, 0, 0.053, 1, 0, 0, 0], name="box"
    )
    scene = dc.Scene([mat], [dc.RigidBody.plane(2.0, name="floor"), box])
    contact = dc.ContactOptions(barrier_distance=0.002)
    for coupling in ("monolithic", "rigid_to_cloth", "cloth_to_rigid"):
        sim = dc.Simulator(scene, 0.005, coupling=coupling, contact=contact)
        pairs = {("box", "mat"): 0.7, ("box", "floor"): 0.1}
        friction = sim.default_parameters().friction.clone()
        for i, j, mu in ((0, 2, 0.7), (1, 2, 0.1)):
            friction[i, j] = friction[j, i] = mu
        ends = [
            sim.step(sim.initial_state(), None, sim.default_parameters().replace(friction=given))
            for given in (pairs, friction)
        ]
        assert torch.equal(ends[0].positions, ends[1].positions)
        assert torch.equal(ends[0].body_velocities, ends[1].body_velocities)


ACCEPTED = r"must name pairs \(a, b\) of the surfaces 'mat', 'floor', 'far'; got "


@pytest.mark.parametrize(
    ("friction", "error", "message"),
    [
        pytest.param({("mat", "mats"): 0.1}, dc.InvalidInput, ACCEPTED, id="unknown"),
        pytest.param({"mat": 0.1}, dc.InvalidInput, ACCEPTED + "'mat'", id="one name"),
        pytest.param({("mat",) * 3: 0.1}, dc.InvalidInput, ACCEPTED, id="three names"),
        pytest.param({(0, 1): 0.1}, dc.InvalidInput, ACCEPTED + r"\(0, 1\)", id="numbers"),
        pytest.param(
            {("mat", "floor"): 0.1, ("floor", "mat"): 0.1}, dc.InvalidInput, "once", id="twice"
        ),
        pytest.param(
            {("mat", "floor"): -0.1},
            dc.InvalidInput,
            r"`parameters.friction\[\('mat', 'floor'\)\]` must be finite and >= 0, got -0.1",
            id="negative",
        ),
        pytest.param({("mat", "floor"): [0.1]}, dc.InvalidInput, "has a batch axis", id="batch"),
        pytest.param({("mat", "floor"): [[0.1]]}, dc.InvalidInput, r"shape \[\] or", id="shape"),
        pytest.param({("mat", "floor"): "low"}, TypeError, "real numbers", id="text"),
        pytest.param({("mat", "floor"): None}, TypeError, "real numbers", id="none"),
    ],
)
def test_values_that_are_no_friction_are_refused(sim, friction, error, message):
    with pytest.raises(error, match=r"^rollout: `parameters\.friction") as caught:
        slide(sim, friction)
    assert re.search(message, str(caught.value))
