"""Numbers whose powers overflow or underflow float64 are refused at every input."""

import dataclasses
import re

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

F64 = torch.float64
HUGE = [1e31, 1e155, 1e308, -1e308]


@pytest.fixture(scope="module")
def sim():
    cloth = dc.Cloth.grid(3, 3, pins={"a": [0]}, soft_pins={"b": [8]})
    box = dc.RigidBody.box(0.2, motion="kinematic", pose=[0, 0, -0.2, 1, 0, 0, 0])
    return dc.Simulator(dc.Scene([cloth], [box]), 0.01)


@pytest.fixture(scope="module")
def moved_sim():
    """A simulator with every parameter: forces also move a body and a robot."""
    material = dc.fabrics.material("denim")
    cloth = dc.Cloth.grid(3, 3, pins={"a": [0]}, soft_pins={"b": [8]}, material=material)
    box = dc.RigidBody.box(0.2, motion="dynamic", mass=1.0, pose=[0, 0, -0.2, 1, 0, 0, 0])
    hand = dc.Robot.load(dc.robots.GRIPPER, pose=[0, 0, 3, 1, 0, 0, 0], stiffness=1.0, damping=1.0)
    picker = dc.Attachment(("cloth0", 4), stiffness=1.0)
    return dc.Simulator(dc.Scene([cloth], [box], [hand], attachments=[picker]), 0.01)


def with_last(tensor, value):
    changed = tensor.clone()
    changed.reshape(-1)[-1] = value
    return changed


def refused(name, value, at):
    got = re.escape(f"{value:g}")
    return pytest.raises(
        dc.InvalidInput, match=rf"`{name}` must be at most 1e\+30 in size.* got {got}{at}"
    )


@pytest.mark.parametrize("value", HUGE)
@pytest.mark.parametrize(
    ("field", "at"),
    [
        ("positions", r" at \[8, 2\]"),
        ("velocities", r" at \[8, 2\]"),
        ("body_poses", r" at \[0, 6\]"),
        ("soft_pin_targets", r" at \[0, 2\]"),
        ("time", ""),
    ],
)
def test_a_state_of_absurd_size_is_refused(sim, field, at, value):
    state = sim.initial_state()
    bad = state.replace(**{field: with_last(getattr(state, field), value)})
    with refused(f"state.{field}", value, at):
        sim.step(bad)


def test_the_message_names_the_environment(sim):
    state = sim.initial_state(3)
    velocities = state.velocities.clone()
    velocities[1, 4, 2] = 1e40
    with pytest.raises(dc.InvalidInput, match=r"`state.velocities` .* got 1e\+40 at \[1, 4, 2\]"):
        sim.step(state.replace(velocities=velocities))


@pytest.mark.parametrize("value", HUGE)
@pytest.mark.parametrize("field", ["pins", "soft_pins", "body_poses", "forces"])
def test_a_control_of_absurd_size_is_refused(sim, field, value):
    state = sim.initial_state()
    valid = {
        "pins": state.positions[[0]],
        "soft_pins": state.positions[[8]],
        "body_poses": state.body_poses,
        "forces": torch.zeros_like(state.positions),
    }
    control = dc.Control(**{field: with_last(valid[field], value)})
    with refused(f"control.{field}", value, r" at \["):
        sim.step(state, control)


PARAMETERS = [f.name for f in dataclasses.fields(dc.Parameters) if not f.name.startswith("_")]


@pytest.mark.parametrize("field", [name for name in PARAMETERS if name != "poisson"])
def test_a_parameter_of_absurd_size_is_refused(moved_sim, field):
    sim = moved_sim
    parameters = sim.default_parameters()
    bad = parameters.replace(**{field: with_last(getattr(parameters, field), 1e300)})
    with pytest.raises(
        dc.InvalidInput, match=rf"^step: `parameters\.{field}` must be at most 1e\+30 in size"
    ):
        sim.step(sim.initial_state(), None, bad)


@pytest.mark.parametrize(
    "field",
    ["stretch", "density", "barrier_stiffness", "barrier_distance", "slip_velocity"],
)
def test_a_parameter_that_vanishes_is_refused(sim, field):
    bad = sim.default_parameters().replace(**{field: torch.tensor(1e-200, dtype=F64)})
    with pytest.raises(
        dc.InvalidInput, match=rf"^step: `parameters\.{field}` must be at least 1e-30"
    ):
        sim.step(sim.initial_state(), None, bad)


# Quaternions, and the text about their length in the error.
@pytest.mark.parametrize(
    ("quaternion", "text"),
    [
        ([1e155, 0, 0, 0], "at most"),
        ([1e308, 1e308, 0, 0], "at most"),
        ([1e-200, 0, 0, 0], "non-zero length"),
        ([0, 0, 1e-155, 1e-155], "non-zero length"),
        ([0, 0, 0, 0], "non-zero length"),
    ],
)
@pytest.mark.parametrize("where", ["state.body_poses", "control.body_poses", "pose"])
def test_a_quaternion_that_cannot_be_normalized_is_refused(sim, where, quaternion, text):
    state = sim.initial_state()
    poses = state.body_poses.clone()
    poses[0, 3:] = torch.tensor(quaternion, dtype=F64)
    use = {
        "state.body_poses": lambda: sim.step(state.replace(body_poses=poses)),
        "control.body_poses": lambda: sim.step(state, dc.Control(body_poses=poses)),
        "pose": lambda: dc.RigidBody.box(1.0, pose=poses[0]),
    }[where]
    with pytest.raises(dc.InvalidInput, match=rf"`{where}` .*{text}"):
        use()


@pytest.mark.parametrize("length", [1e-5, 1e-2, 1e6, 1e29])
def test_a_quaternion_of_any_other_length_is_the_same_rotation(sim, length):
    state = sim.initial_state()
    turned = torch.tensor([0.0, 0.0, -0.2, 0.98, 0.1, 0.1, 0.05], dtype=F64)[None]
    scaled = turned * torch.tensor([1.0] * 3 + [length] * 4, dtype=F64)
    expected = sim.step(state.replace(body_poses=turned))
    after = sim.step(state.replace(body_poses=scaled))
    torch.testing.assert_close(after.positions, expected.positions, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "make",
    [
        lambda v: dc.Material(stretch=v),
        lambda v: dc.Material(density=[0.1, v]),
        lambda v: dc.ContactOptions(slip_velocity=v),
        lambda v: dc.SolverOptions(tolerance=v),
        lambda v: dc.Simulator(dc.Scene([dc.Cloth.grid(2, 2)]), v),
        lambda v: dc.RigidBody.sphere(v),
        lambda v: dc.RigidBody.box([1.0, 1.0, v]),
        lambda v: dc.Scene([dc.Cloth.grid(2, 2)], gravity=[0, 0, v]),
        lambda v: dc.Cloth([[0, 0, 0], [1, 0, 0], [0, v, 0]], [[0, 1, 2]]),
    ],
)
def test_absurd_sizes_are_refused_where_scenes_are_made(make):
    with pytest.raises(dc.InvalidInput, match=r"at most 1e\+30 in size.* got 1e\+200"):
        make(1e200)


@pytest.mark.parametrize("size", [1e-31, 1e-60, 1e-150])
def test_a_mesh_whose_squares_vanish_is_refused(size):
    cloth = dc.Cloth.grid(2, 2)
    with pytest.raises(dc.InvalidInput, match="sides of at least 1e-30 m in `vertices`"):
        dc.Cloth(size * np.array(cloth.vertices), cloth.faces)


# Accepted forces and velocities move the cloth, or the step reports the reason.
@pytest.mark.parametrize("size", [1e3, 1e6, 1e12, 1e20, 1e29])
@pytest.mark.parametrize("what", ["velocities", "forces"])
def test_large_velocities_and_forces_are_followed_or_refused(sim, what, size):
    state = sim.initial_state()
    rows = torch.zeros_like(state.positions)
    rows[1:, 2] = size
    control = dc.Control(forces=rows) if what == "forces" else None
    start = state.replace(velocities=rows) if what == "velocities" else state
    try:
        after = sim.step(start, control)
    except dc.SimulationError:
        return
    assert torch.isfinite(after.positions).all()
    assert (after.positions - start.positions)[1:, 2].max() > 0.1
