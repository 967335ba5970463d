"""The tables of quantities agree with the dataclasses, the core, the schema and the docs."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch import _core
from diffcloth_torch.checks import POSITIVE
from diffcloth_torch.config import scene_schema, schema
from diffcloth_torch.config.validation import validate
from diffcloth_torch.model import options
from diffcloth_torch.model.assembly import assemble
from diffcloth_torch.model.quantities import (
    CONTROL,
    DERIVED,
    FACE_QUANTITIES,
    PARAMETERS,
    STATE,
    shape_of,
)

TABLES = {dc.State: STATE, dc.Control: CONTROL, dc.Parameters: PARAMETERS}
EVERY = [
    pytest.param(kind, quantity, id=f"{kind.__name__}.{name}")
    for kind, table in TABLES.items()
    for name, quantity in table.items()
]
NOTATION = Path(__file__).parents[2] / "docs" / "notation.md"


@pytest.fixture(scope="module")
def sim():
    """A scene that has every quantity."""
    cloths = [
        dc.Cloth.grid(3, 4, pins={"a": [0]}, soft_pins={"b": [8]}),
        dc.Cloth.grid(
            *(2, 2),
            pose=[0, 0, 1, 1, 0, 0, 0],
            material=dc.Material(stretch=100.0, stretch_weft=50.0, bending_weft=5e-6),
        ),
    ]
    bodies = [
        dc.RigidBody.box(0.2, motion="kinematic", pose=[0, 0, -0.2, 1, 0, 0, 0]),
        dc.RigidBody.box(0.2, motion="dynamic", mass=1.0, pose=[3, 0, 0, 1, 0, 0, 0]),
    ]
    hand = dc.Robot.load(dc.robots.GRIPPER, pose=[6, 0, 0, 1, 0, 0, 0], stiffness=1.0)
    attachments = [
        dc.Attachment(("cloth0", [0, 1]), stiffness=1.0),
        dc.Attachment(("cloth0", 2), ("cloth1", 0), stiffness=2.0, rest_length=1.0),
    ]
    return dc.Simulator(dc.Scene(cloths, bodies, [hand], attachments=attachments), 0.01)


@pytest.mark.parametrize("kind", TABLES)
def test_a_table_names_the_fields(kind):
    fields = [f.name for f in dataclasses.fields(kind) if not f.name.startswith("_")]
    assert list(TABLES[kind]) == [name for name in fields if name != "report"]


def test_the_core_has_the_inputs_of_the_tables():
    names = [q.core for table in TABLES.values() for q in table.values() if q.core]
    assert set(names) | set(DERIVED) == set(_core.input_names)
    assert not set(names) & set(DERIVED)
    assert len(_core.input_names) == len(set(_core.input_names))
    # An unset control holds the state's value, so control and state may share an input.
    twice = {name for name in names if names.count(name) > 1}
    assert twice == {"soft_pin_targets"}


def test_names_of_options_come_from_the_core():
    """Schemes, metrics and solvers are listed once, in the core; couplings once, in Python."""
    assert _core.schemes.keys() == {"coupled", "split", "projective"}
    assert tuple(_core.schemes) == options.SCHEMES
    section = schema.SimulationSection
    for given, accepted in (
        (section.model_fields["scheme"], _core.schemes),
        (section.model_fields["coupling"], options.COUPLINGS),
        (schema.SolverSection.model_fields["metric"], _core.metrics),
        (schema.SolverSection.model_fields["elastic"], _core.elastic_solvers),
    ):
        literal = next((a for a in get_args(given.annotation) if get_args(a)), given.annotation)
        assert get_args(literal) == tuple(accepted)
    scene = dc.Scene([dc.Cloth.grid(3, 3)])
    for name in _core.schemes:
        assert dc.Simulator(scene, 0.01, scheme=name).scheme == name
    for name, able in _core.schemes.items():
        for metric in _core.metrics if able["metrics"] else []:
            dc.Simulator(scene, 0.01, scheme=name, solver=dc.SolverOptions(metric=metric))


def test_the_core_gets_no_other_names(sim):
    inputs, _ = sim._inputs(sim.initial_state(), None, None)
    # The core has prepared the rest shape of the scene; origins are for a staggered coupling.
    assert set(inputs) | {"rest_positions", "friction_origins"} == set(_core.input_names)


def test_shapes_are_those_of_the_tables(sim):
    sizes = assemble(sim.scene).sizes
    cloth = {"N": 16, "M": 16, "F": 14, "C": 2, "P": 1, "Q": 1, "D": 0}
    assert sizes == {**cloth, "K": 2, "V": 5 * 8, "S": 7, "J": 2, "L": 3, "R": 1, "A": 3, "U": 2}
    state, parameters = sim.initial_state(), sim.default_parameters()
    for record, table in ((state, STATE), (parameters, PARAMETERS)):
        for name, quantity in table.items():
            accepted = [shape_of(axes, sizes) for axes in quantity.axes]
            assert tuple(getattr(record, name).shape) in accepted, name


@pytest.mark.parametrize(("kind", "quantity"), EVERY)
def test_docstrings_say_unit_and_shape(kind, quantity):
    entry = re.search(rf"^ {{8}}{quantity.name}: (.*(?:\n {{9,}}.*)*)", kind.__doc__, re.MULTILINE)
    text = " ".join(entry[1].split())
    if quantity.unit != "m, -":  # poses, written out
        assert f"[{quantity.unit}]" in text
    shapes = [f"[{', '.join(map(str, axes))}]" for axes in quantity.axes]
    for shape in shapes:
        assert shape in text


@pytest.mark.parametrize("name", PARAMETERS)
def test_docstrings_say_the_range(name):
    text = " ".join(dc.Parameters.__doc__.replace(";", ",").split())
    entry = re.search(rf" {name}: (.*?, shape)", text)[1]
    accepted = PARAMETERS[name].accepted
    if math.isfinite(accepted.high):
        assert f"between {accepted.low:g} and {accepted.high:g}," in entry
    elif accepted.low == 0:
        assert (">= 0" if accepted.closed else "> 0") in entry
    else:
        assert ">" not in entry


# The time has no letter, because no quantity depends on it.
@pytest.mark.parametrize(("kind", "quantity"), [e for e in EVERY if e.id != "State.time"])
def test_the_notation_has_unit_and_shape(kind, quantity):
    rows = [line.split("|") for line in NOTATION.read_text().splitlines() if line[:2] == "| "]
    names = rf"`({kind.__name__}\.)?{quantity.name}`"
    row = next(row for row in rows if re.search(names, row[1]))
    assert row[3].partition(";")[0].strip() == quantity.unit.replace("^2", "²").replace("^3", "³")
    assert row[4].strip() == ", ".join(f"[{', '.join(map(str, axes))}]" for axes in quantity.axes)


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_default_comes_from_where_the_table_says(sim, name):
    for owner, field in sources(name):
        assert field in getattr(dc, owner).__annotations__
    if not list(sources(name)):
        assert PARAMETERS[name].source == "zero"
        assert not getattr(sim.default_parameters(), name).any()


def outside(accepted):
    """Numbers just beyond a range."""
    ends = [(accepted.low, -1), (accepted.high, 1)]
    beyond = [end + side * 1e-9 for end, side in ends if math.isfinite(end)]
    return beyond + ([] if accepted.closed else [end for end, _ in ends if math.isfinite(end)])


BOUNDED = [(name, value) for name, q in PARAMETERS.items() for value in outside(q.accepted)]


@pytest.mark.parametrize(("name", "value"), BOUNDED)
def test_a_value_beyond_the_range_is_refused_wherever_it_enters(sim, name, value):
    accepted = re.escape(str(PARAMETERS[name].accepted))
    wrong = torch.full_like(getattr(sim.default_parameters(), name), value)
    with pytest.raises(dc.InvalidInput, match=rf"^step: `parameters\.{name}` must be {accepted}"):
        sim.step(sim.initial_state(), None, sim.default_parameters().replace(**{name: wrong}))
    for owner, field in sources(name):
        if (owner, field) in (("Robot", "mechanism"), ("Robot", "viscosity")):
            continue  # values of the file
        # A body without mass is none.
        range_there = re.escape(str(POSITIVE)) if field == "mass" else accepted
        with pytest.raises(dc.InvalidInput, match=rf"`{field}` must be {range_there}"):
            given_to(owner, field, value)
    for section in (scene_schema.MaterialSection, schema.ContactSection):
        if name in section.model_fields:
            with pytest.raises(dc.InvalidInput, match=rf"`{name}` must be "):
                validate(section, {name: value}, "here")


def sources(name):
    """Class and field of each source of a parameter; none if the default is zero."""
    source = PARAMETERS[name].source
    return [] if source == "zero" else [tuple(s.split(".")) for s in source.split(", ")]


def given_to(owner, field, value):
    mesh = np.eye(3), [[0, 1, 2]]
    if owner == "Robot":
        return dc.Robot.load(dc.robots.GRIPPER, **{field: value})
    if owner == "RigidBody" and field == "mass":
        return dc.RigidBody.box(0.1, motion="dynamic", mass=value)
    if owner in ("Cloth", "RigidBody"):
        return getattr(dc, owner)(*mesh, **{field: value})
    if owner == "Scene":
        return dc.Scene([dc.Cloth.grid(3, 3)], **{field: value})
    if owner == "Attachment":
        return dc.Attachment(("cloth0", 0), **{field: value})
    return getattr(dc, owner)(**{field: value})


def test_the_schema_of_a_material_has_the_fields_of_a_material():
    fields = [f.name for f in dataclasses.fields(dc.Material)]
    assert list(scene_schema.MaterialSection.model_fields) == [*fields, "fabric"]
    assert set(FACE_QUANTITIES) == set(fields) - {"friction", "thickness"}
    given = dict.fromkeys(fields, 0.25) | {"fabric": "denim"}
    section = validate(scene_schema.MaterialSection, given, "here")
    assert section.model_dump() == given
    assert scene_schema.MaterialSection().model_dump() == dict.fromkeys(given)
