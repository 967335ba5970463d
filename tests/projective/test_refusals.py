"""Bodies without nodal contact, and inputs that a scheme does not support, are refused by name."""

import pickle

import numpy as np
import pytest

import diffcloth_torch as dc

BOX = dc.RigidBody.box(0.1)
CLOTH = dc.Cloth.grid(3, 3, size=(0.1, 0.1))


def simulator(body, scheme):
    below = [0.0, 0.0, -1.0, 1.0, 0.0, 0.0, 0.0]
    return dc.Simulator(dc.Scene([CLOTH], [body(pose=below, name="it")]), 0.01, scheme=scheme)


@pytest.mark.parametrize(
    ("make", "keywords"),
    [
        pytest.param(lambda **k: dc.RigidBody(BOX.vertices, BOX.faces, **k), {}, id="mesh"),
        pytest.param(lambda **k: dc.RigidBody.cylinder(0.1, 0.2, **k), {}, id="cylinder"),
        pytest.param(
            lambda **k: dc.RigidBody.box(0.1, **k), {"motion": "dynamic", "mass": 1.0}, id="dynamic"
        ),
    ],
)
def test_nodal_contact_needs_a_primitive_that_no_force_moves(make, keywords):
    with pytest.raises(dc.InvalidInput, match="nodal_contact"):
        make(nodal_contact=True, **keywords)


def test_nodal_contact_is_true_or_false():
    with pytest.raises(TypeError, match="nodal_contact"):
        dc.RigidBody.box(0.1, nodal_contact=1)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        pytest.param(
            lambda **k: dc.RigidBody(BOX.vertices, BOX.faces, **k),
            "mesh or cylinder 'it'",
            id="mesh",
        ),
        pytest.param(
            lambda **k: dc.RigidBody.box(0.1, motion="dynamic", mass=1.0, **k),
            "dynamic body 'it'",
            id="dynamic",
        ),
    ],
)
def test_projective_takes_prescribed_primitives_only(body, message):
    with pytest.raises(dc.InvalidInput, match=message):
        simulator(body, "projective")


def test_coupled_has_no_contact_at_nodes():
    with pytest.raises(dc.InvalidInput, match="nodal_contact"):
        simulator(lambda **k: dc.RigidBody.box(0.1, nodal_contact=True, **k), "coupled")


def test_projective_has_no_barrier():
    sim = simulator(lambda **k: dc.RigidBody.box(0.1, **k), "projective")
    parameters = sim.default_parameters()
    for name in ("barrier_distance", "barrier_stiffness", "slip_velocity"):
        assert getattr(parameters, name) is None
        with pytest.raises(dc.InvalidInput, match=name):
            sim.step(sim.initial_state(), None, parameters.replace(**{name: 1.0}))


def test_a_body_keeps_its_primitive_in_a_pickle_and_old_ones_have_none():
    body = pickle.loads(pickle.dumps(dc.RigidBody.capsule(0.1, 0.4, nodal_contact=True)))
    assert body.nodal_contact
    assert body.primitive == ("capsule", (0.1, 0.2, 0.0))
    old = dc.RigidBody.box(0.1)
    for name in ("primitive", "nodal_contact"):
        del old.__dict__[name]
    assert (old.primitive, old.nodal_contact) == (None, False)


def test_surfaces_may_overlap_where_nodes_touch():
    low = np.array(CLOTH.vertices) - [0, 0, 0.01]
    cloth = dc.Cloth(low, CLOTH.faces)
    floor = dc.RigidBody.plane(1.0, nodal_contact=True)
    for scheme in ("split", "projective"):
        sim = dc.Simulator(dc.Scene([cloth], [floor]), 0.01, scheme=scheme)
        after = sim.step(sim.initial_state())
        assert after.report.counts["sticking"] == 9
