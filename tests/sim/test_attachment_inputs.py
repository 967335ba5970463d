"""Accepted and refused inputs of attachments and their controls."""

import re

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

F64 = torch.float64


def sheet(name="sheet"):
    return dc.Cloth.grid(3, 3, 0.2, name=name)


def box(motion="kinematic", **options):
    return dc.RigidBody.box(0.1, motion=motion, pose=[0, 0, 1, 1, 0, 0, 0], name="box", **options)


def scene(*attachments, bodies=None):
    return dc.Scene([sheet()], bodies or [box()], attachments=attachments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"a": ("sheet", 0), "stiffness": 0.0}, "`stiffness` must be finite and > 0, got 0"),
        ({"a": ("sheet", 0), "stiffness": -1.0}, "`stiffness` must be finite and > 0, got -1"),
        ({"a": ("sheet", 0), "stiffness": float("nan")}, "`stiffness` must be finite"),
        (
            {"a": ("sheet", 0), "stiffness": 1.0, "rest_length": -0.1},
            "`rest_length` must be finite and >= 0, got -0.1",
        ),
        ({"a": ("sheet", 0), "stiffness": 1.0, "name": "a/b"}, "`name` must be .* without '/'"),
        ({"a": ("sheet",), "stiffness": 1.0}, r"`a` must be \(surface, points\)"),
        ({"a": ("sheet", []), "stiffness": 1.0}, "`a` must hold one point or more of 'sheet'"),
        (
            {"a": ("sheet", [0, 1, 3], [0.5, 0.4, 0.2]), "stiffness": 1.0},
            "weights of corners, must add to one, got 1.1",
        ),
        (
            {"a": ("sheet", [0, 1, 3], [1.5, -0.5, 0.0]), "stiffness": 1.0},
            r"must be between 0 and 1 \(inclusive\), got 1.5 at \[0\]",
        ),
        ({"a": ("sheet", [0, 1], [1.0]), "stiffness": 1.0}, r"must have shape \[2\], got \[1\]"),
    ],
)
def test_an_attachment_refuses(arguments, message):
    with pytest.raises(dc.InvalidInput, match=message):
        dc.Attachment(**arguments)


def test_an_attachment_refuses_other_types():
    with pytest.raises(TypeError, match=r"`a` must be \(surface, points\)"):
        dc.Attachment(None, stiffness=1.0)
    with pytest.raises(dc.InvalidInput, match=r"Parameters\.attachment_stiffness"):
        dc.Attachment(("sheet", 0), stiffness=torch.tensor(1.0, requires_grad=True))
    with pytest.raises(TypeError, match="`attachments` must hold Attachment objects"):
        dc.Scene([sheet()], attachments=[sheet()])


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        (("shirt", 0), None, "'shirt' is none of them"),
        (("sheet", 9), None, "between 0 and 8, got 9"),
        (("sheet", [0, 12]), None, r"between 0 and 8, got 12 at \[1\]"),
        (("sheet", [[0, 1], [2, 3]]), None, "points of faces need weights"),
        (("sheet", [0, 1]), ("sheet", [2, 3, 4]), "as many points.* got 2 and 3"),
        (("sheet", 4), ("sheet", 4), r"ends that differ, got one point twice at \[0\]"),
        (("sheet", 0), ("box", [0.0, 0.0]), r"shape \[3\] or \[n, 3\], got \[2\]"),
        (("sheet", 0), ("box", [0, 1, 2], [0.5, 0.2, 0.3]), "in the frame of 'box', without"),
        (("box", [0, 0, 0]), ("box", [0, 0, 1]), "both ends on 'box'"),
    ],
)
def test_a_scene_refuses_points_that_it_does_not_have(a, b, message):
    with pytest.raises(dc.InvalidInput, match=f"attachment 'bad'.*{message}"):
        scene(dc.Attachment(a, b, stiffness=1.0, name="bad"))


def test_a_vertex_must_be_an_integer():
    with pytest.raises(TypeError, match="integers"):
        scene(dc.Attachment(("sheet", 1.5), stiffness=1.0))


def test_a_scene_refuses_names_twice_and_points_off_a_plane():
    twice = dc.Attachment(("sheet", 0), stiffness=1.0, name="a")
    with pytest.raises(dc.InvalidInput, match="'a' twice"):
        scene(twice, twice)
    floor = dc.RigidBody.plane(1.0, name="floor")
    with pytest.raises(dc.InvalidInput, match=r"plane of a flat body.* 0.1 m off at \[0\]"):
        scene(dc.Attachment(("sheet", 0), ("floor", [0, 0, 0.1]), stiffness=1.0), bodies=[floor])
    with pytest.raises(dc.InvalidInput, match=r"`stiffness` must have shape \[\] or \[2\]"):
        scene(dc.Attachment(("sheet", [0, 1]), stiffness=[1.0, 2.0, 3.0]))


def test_names_and_rows_are_those_of_the_attachments():
    attachments = [
        dc.Attachment(("sheet", [0, 2]), stiffness=[1.0, 2.0]),
        dc.Attachment(("sheet", 4), ("box", [0, 0, 0]), stiffness=3.0, name="grasp"),
        dc.Attachment(("sheet", range(3)), ("sheet", 8), stiffness=4.0, rest_length=0.1),
    ]
    given = scene(*attachments)
    assert given.attachment_names == ("attachment0", "grasp", "attachment2")
    springs = given.springs
    assert springs.stiffness.tolist() == [1, 2, 3, 4, 4, 4]
    assert springs.targets.tolist() == [0, 1, -1, -1, -1, -1]
    assert springs.groups["attachment2"] == slice(3, 6)
    ends = np.split(springs.coefficients, springs.start[1:-1])
    assert [e.sum() for e in ends] == pytest.approx([1, 1, 0, 0, 0, 0], abs=1e-15)
    sim = dc.Simulator(given, 0.01)
    assert sim.default_parameters().attachment_stiffness.tolist() == [1, 2, 3, 4, 4, 4]
    stiffer = dc.Parameters(attachment_stiffness={"grasp": 7.0})
    sim.step(sim.initial_state(), None, stiffer)
    assert "attachments=" in repr(given)
    assert dc.Simulator(dc.Scene([sheet()]), 0.01).default_parameters().attachment_stiffness is None


@pytest.fixture(scope="module")
def sim():
    picker = dc.Attachment(("sheet", [0, 2]), stiffness=5.0, name="picker")
    grasp = dc.Attachment(("sheet", 4), ("box", [0, 0, 0]), stiffness=3.0, name="grasp")
    return dc.Simulator(scene(picker, grasp), 0.01)


@pytest.mark.parametrize(
    ("control", "message"),
    [
        ({"attachment_weights": {"grasp": [1.2]}}, r"between 0 and 1 \(inclusive\), got 1.2"),
        ({"attachment_weights": {"grasp": [-0.1]}}, "got -0.1"),
        ({"attachment_weights": {"grip": [1.0]}}, "'picker', 'grasp'.*'grip' is none of them"),
        ({"attachment_weights": {"grasp": [1.0, 1.0]}}, r"must have shape \[1\]"),
        ({"attachment_weights": [1.0]}, r"must have shape \[3\]"),
        ({"attachment_weights": {"picker": [0.5, 0]}}, "must set the target of 'picker'"),
        ({"attachment_weights": [1.0, 1.0, 1.0]}, "must set the target of 'picker'"),
        ({"attachments": {"grasp": [[0, 0, 0]]}}, "'picker'.*'grasp' is none of them"),
        ({"attachments": {"picker": [[0, 0, 0]]}}, r"must have shape \[2, 3\]"),
        ({"attachments": {"picker": [[0, 0, 0], [0, 0, float("nan")]]}}, "must be finite"),
    ],
)
def test_a_control_refuses(sim, control, message):
    tensors = {
        field: {k: torch.tensor(v, dtype=F64) for k, v in value.items()}
        if isinstance(value, dict)
        else torch.tensor(value, dtype=F64)
        for field, value in control.items()
    }
    with pytest.raises(dc.InvalidInput, match=message):
        sim.step(sim.initial_state(), dc.Control(**tensors))


def test_attachments_pull_to_their_own_targets():
    """Stored energies computed by hand; targets may be set together or by name."""
    first = dc.Attachment(("sheet", [0, 2]), stiffness=5.0, name="first")
    between = dc.Attachment(("sheet", 4), ("box", [0, 0, 0]), stiffness=0.1)
    second = dc.Attachment(("sheet", [1, 3, 5]), stiffness=[1.0, 2.0, 3.0], name="second")
    sim = dc.Simulator(scene(first, between, second), 0.01)
    state = sim.initial_state()
    ways = 0.01 * torch.arange(15, dtype=F64).reshape(5, 3)
    targets = state.positions[[0, 2, 1, 3, 5]] + ways
    together = sim.control(attachments=targets)
    by_name = sim.control(attachments={"second": targets[2:], "first": targets[:2]})
    stiffness = torch.tensor([5.0, 5.0, 1.0, 2.0, 3.0], dtype=F64)
    pulled = 0.5 * stiffness @ ways.square().sum(1)
    rest = sim.energy(state, parts=True)["attachments"]
    for control in (together, by_name):
        found = sim.energy(state, control=control, parts=True)["attachments"]
        torch.testing.assert_close(found - rest, pulled, rtol=1e-12, atol=0)


def test_no_environment_is_pulled_to_a_target_that_is_not_set(sim):
    weights = torch.zeros(3, 2, dtype=F64)
    released = sim.control(attachment_weights={"picker": weights})
    sim.step(sim.initial_state(3), released)
    weights[2, 1] = 0.5
    pulled = sim.control(attachment_weights={"picker": weights})
    with pytest.raises(dc.InvalidInput, match="must set the target of 'picker'"):
        sim.step(sim.initial_state(3), pulled)


def test_unset_fields_of_a_control_have_defaults(sim):
    """Without a target a picker is released; with a target it pulls with its full stiffness."""
    state = sim.initial_state()
    targets = state.positions[[0, 2]] + 0.05
    released = sim.control(attachment_weights={"picker": [0.0, 0.0], "grasp": [1.0]})
    assert torch.equal(sim.step(state).positions, sim.step(state, released).positions)
    whole = dc.Control(attachments=targets, attachment_weights=torch.ones(3, dtype=F64))
    by_name = dc.Control(attachments={"picker": targets})
    assert torch.equal(sim.step(state, by_name).positions, sim.step(state, whole).positions)
    assert not torch.equal(sim.step(state, by_name).positions, sim.step(state).positions)
    one = dc.Control(
        attachments={"picker": targets}, attachment_weights={"picker": torch.tensor([1.0, 0.0])}
    )
    assert not torch.equal(sim.step(state, one).positions, sim.step(state, whole).positions)


@pytest.mark.parametrize("scheme", ["split", "projective"])
def test_schemes_in_stages_refuse_attached_bodies(scheme):
    grasp = dc.Attachment(("sheet", 4), ("box", [0, 0, 0]), stiffness=3.0)
    message = re.escape(f"scheme {scheme!r} takes attachments of cloths to cloths and targets")
    with pytest.raises(dc.InvalidInput, match=message):
        dc.Simulator(scene(grasp), 0.01, scheme=scheme)


@pytest.mark.parametrize("coupling", ["rigid_to_cloth", "cloth_to_rigid"])
def test_staggered_couplings_refuse_attachments_to_dynamic_bodies(coupling):
    free = box("dynamic", mass=1.0)
    grasp = dc.Attachment(("sheet", 4), ("box", [0, 0, 0]), stiffness=3.0)
    with pytest.raises(dc.InvalidInput, match="'box', which is dynamic, needs coupling"):
        dc.Simulator(scene(grasp, bodies=[free]), 0.01, coupling=coupling)
