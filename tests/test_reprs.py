"""Reprs of public objects: a few lines with the present fields."""

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.sim.records.contacts import Contacts

F64 = torch.float64
FEW = 10  # lines, of at most the width of a terminal
WIDTH = 100


@pytest.fixture(scope="module")
def simulator():
    cloth = dc.Cloth.grid(
        24, 24, pins={"edge": range(24)}, pose=[0, 0, 1, 1, 0, 0, 0], name="sheet"
    )
    bodies = [
        dc.RigidBody.sphere(0.2, motion="dynamic", mass=1.0, pose=[0, 0, -1, 1, 0, 0, 0]),
        dc.RigidBody.plane(4.0, pose=[0, 0, -2, 1, 0, 0, 0], name="floor"),
    ]
    hand = dc.Robot.load(dc.robots.GRIPPER, pose=[0, 0, 3, 1, 0, 0, 0], actuation="torque")
    return dc.Simulator(dc.Scene([cloth], bodies, [hand]), 0.01)


@pytest.fixture(scope="module")
def state(simulator):
    with torch.no_grad():
        return simulator.step(simulator.initial_state())


def lines(record):
    text = repr(record).splitlines()
    assert len(text) <= FEW, repr(record)
    assert max(map(len, text)) <= WIDTH, repr(record)
    assert "tensor(" not in repr(record)
    return " ".join(line.strip() for line in text)


def test_a_state_says_time_shapes_and_how_the_step_went(simulator, state):
    text = lines(state)
    assert text.startswith("State(time=0.01, positions=float64[576, 3], velocities=float64[576, 3]")
    assert "body_poses=float64[2, 7]" in text
    assert "joint_positions=[" in text
    assert f"report=Report(converged=True, iterations={state.report.iterations}, ...))" in text
    assert "soft_pin_targets" not in text  # the scene has no soft pins
    assert "report=None" in lines(simulator.initial_state())


def test_a_batch_says_so(simulator):
    text = lines(simulator.initial_state(64))
    assert text.startswith("State(batch_size=64, time=float64[64], positions=float64[64, 576, 3]")
    one = lines(simulator.initial_state(1))
    assert one.startswith("State(batch_size=1, time=[0]")


def test_parameters_say_numbers_and_shapes(simulator):
    given = simulator.default_parameters()
    text = lines(given)
    assert text.startswith("Parameters(stretch=550, bending=1e-05, poisson=0.3, density=0.124")
    assert "gravity=[0, 0, -9.81]" in text
    assert "rest_positions=float64[576, 3]" in text
    assert "None" not in text
    assert "pin_stiffness" not in text
    faces = torch.full((1058,), 2.0, dtype=F64, requires_grad=True)
    asked = given.replace(stretch=faces, bending=torch.tensor(0.5, requires_grad=True))
    assert "stretch=float64[1058] (grad), bending=0.5 (grad)" in lines(asked)
    assert repr(dc.Parameters()) == "Parameters()"


def test_a_control_shows_its_set_fields(simulator):
    assert repr(dc.Control()) == "Control()"
    named = dc.Control(pins={"sheet/edge": torch.zeros(24, 3)}, joint_efforts=[0.5, 1.0])
    assert repr(named) == "Control(pins={'sheet/edge': float32[24, 3]}, joint_efforts=[0.5, 1.0])"


@pytest.mark.filterwarnings("ignore:The PyTorch API of nested tensors")
def test_reprs_show_fields_that_are_no_cpu_tensors(state):
    """Nothing checks the fields of a record before a step does."""
    nested = torch.nested.nested_tensor([torch.zeros(2), torch.zeros(3)])
    for value, text in (
        (None, "velocities=None"),
        (torch.zeros(2, device="meta"), "velocities=float32[2]"),
        (torch.zeros(2, 2).to_sparse(), "velocities=float32[2, 2]"),
        (nested, "velocities=float32[nested]"),
        (np.zeros((0, 3)), "velocities=float64[0, 3]"),
        (np.ones(2), "velocities=[1, 1]"),
        ([0.0] * 1000, "velocities=[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, ...]"),
    ):
        assert text in lines(state.replace(velocities=value))


def test_a_report_says_its_numbers(state):
    text = lines(state.report)
    assert text.startswith(
        f"Report(converged=True, iterations={state.report.iterations}, residual="
    )
    assert "seconds={detection: " in text
    counted = [f"{name}: {count}" for name, count in state.report.counts.items() if count]
    assert text.endswith(f"counts={{{', '.join(counted)}}})")
    assert "sticking" not in text  # never happened


def test_a_report_of_a_batch_shows_the_range_of_its_numbers(simulator):
    falling = simulator.initial_state(2)
    velocities = falling.velocities.clone()
    velocities[1] += 0.1 * torch.randn(velocities[1].shape, generator=torch.Generator(), dtype=F64)
    with torch.no_grad():
        report = simulator.step(falling.replace(velocities=velocities)).report
    low, high = sorted(report.iterations.tolist())
    assert low < high
    assert f"converged=True, iterations={low} .. {high}, residual=" in lines(report)
    mixed = dc.Report(**{**vars(report), "converged": torch.tensor([True, False]), "counts": {}})
    assert lines(mixed).startswith("Report(converged=1 of 2, ")
    assert lines(mixed).endswith("counts={})")


def test_a_scene_shows_its_parts(simulator):
    cloth, hand = simulator.scene.cloths[0], simulator.scene.robots[0]
    ball, floor = simulator.scene.bodies
    assert repr(cloth) == "Cloth('sheet', 576 vertices, 1058 faces)"
    assert repr(floor) == "RigidBody('floor', static, 2 faces)"
    assert repr(ball) == f"RigidBody(dynamic, {len(ball.faces)} faces)"
    assert repr(hand) == "Robot(fixed base, 2 joints, 3 links)"
    scene = f"Scene(cloths=[{cloth!r}], bodies=[{ball!r}, {floor!r}], robots=[{hand!r}])"
    assert repr(simulator.scene) == scene
    assert repr(simulator) == f"Simulator({scene}, dt=0.01, scheme='coupled')"
    with_faces = dc.Material(stretch=np.linspace(1, 2, 1058), friction=0.25)
    assert lines(with_faces) == (
        "Material(stretch=float64[1058], bending=1e-05, poisson=0.3, density=0.124, damping=0, "
        "friction=0.25, thickness=0, normal_drag=0, tangential_drag=0)"
    )


def test_a_coupling_that_was_chosen_is_said(simulator):
    other = dc.Simulator(simulator.scene, 0.01, coupling="rigid_to_cloth")
    assert repr(other).endswith("scheme='coupled', coupling='rigid_to_cloth')")


def line_residuals(parameters, values):
    grid = torch.linspace(0, 1, 9, dtype=F64)
    return values["slope"] * grid + values["offset"] - 2 * grid - 1 + 0 * values["many"].sum()


def test_a_fit_and_its_parts_show_numbers_and_shapes():
    variables = {
        "slope": dc.Variable(1.0),
        "offset": dc.Variable(0.0, scale="linear"),
        "many": dc.Variable(np.zeros(100), scale="linear", free=False),
    }
    assert "value=float64[100]" in lines(variables["many"])
    fit = dc.fit(variables, line_residuals)
    text = lines(fit)
    assert text.startswith("Fit: rms ")
    assert "slope 2, between 2 and 2" in text
    assert "history" not in text
    assert "first={'slope': 1, 'offset': 0, 'many': float64[100]}" in lines(fit.starts[0])
    assert lines(fit.history[0]).startswith("Trial(start=0, stage=0, cost=10.5938, ")


def test_a_descent_shows_its_best_loss_and_how_many_records_there_are():
    def simulate(given):
        start = falling.initial_state()
        return [falling.step(start.replace(velocities=given["v"].expand(9, 3)))]

    falling = dc.Simulator(dc.Scene([dc.Cloth.grid((3, 3))]), 0.01)
    variables = {"v": torch.zeros(3, dtype=F64, requires_grad=True)}
    found = dc.descend(
        simulate,
        lambda states: states[0].positions.mean(),
        variables,
        lambda given: torch.optim.SGD(given, lr=0.1),
        iterations=2,
    )
    text = lines(found)
    assert "best=Evaluation(...)" in text
    assert "history=[2 dict]" in text
    assert "states=[1 State]" in lines(found.best)


def test_a_state_of_environments_shows_shapes():
    env = dc.envs.make("FoldCloth", num_envs=2, size=4)
    env.reset(seed=0)
    text = lines(env.env_state)
    assert text.startswith("EnvState(state=State(...), tools={'points': float64[2, 2, 3], ")
    assert "and 5 more}" in text
    lines(env.task.simulator.solver)
    assert "learning_rate=0.002" in lines(dc.learn.TrainerOptions())


def test_contacts_of_many_surfaces_are_counted_in_the_end():
    names = [f"body {k}" for k in range(12)]
    pairs = [(0, k, 1, (0.0, 0.0, 1.0)) for k in range(1, 12)]
    rows = [np.zeros((0, 14))]
    contacts = Contacts.of([pairs], rows, names, batched=False)
    assert lines(contacts).startswith("Contacts(('body 0', 'body 1'): 1, ('body 0', 'body 2'): 1")
    assert lines(contacts).endswith("and 3 more pairs)")
