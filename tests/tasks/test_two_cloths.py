"""Two cloths that are pulled apart, and control points."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from short_tasks import CONFIGS, TWO, Short, controls_of

import diffcloth_torch as dc
from diffcloth_torch.tasks.registry import load_task
from diffcloth_torch.tasks.simulation import simulate


def test_the_shipped_forces_are_those_on_the_ends_of_two_hooked_cloths():
    task = load_task(CONFIGS / "two_cloths.yaml")
    control = controls_of(task, task.actions())[0]
    forces = control.forces.detach()
    blue, red = (forces[task.simulator.slices[name]] for name in ("blue", "red"))
    torch.testing.assert_close(red.sum(dim=0), torch.tensor([0.3, 0, 0.047], dtype=torch.float64))
    torch.testing.assert_close(blue.sum(dim=0), torch.tensor([-0.3, 0, 0.047], dtype=torch.float64))
    for name, part in (("blue", blue), ("red", red)):
        pulled = part.abs().sum(dim=1) > 0
        ends = task.scene.cloths[task.scene.cloth_names.index(name)].rest_positions[:, 0]
        np.testing.assert_array_equal(pulled.numpy(), np.isclose(np.abs(ends), 0.2))


def test_the_distance_of_a_cloth_is_that_of_its_center():
    task = TWO.load("target.position=[0.3, 0.4, 0.5]")
    start = task.initial_state()
    rows = task.simulator.slices["blue"]
    moved = start.positions.clone()
    moved[rows] -= moved[rows].mean(dim=0) - torch.tensor([0.0, 0.0, 0.5])
    state = start.replace(positions=moved)
    assert task.distance(state, "distance").item() == pytest.approx(0.5)
    (goal,) = task.goals()
    np.testing.assert_allclose(goal.vertices.mean(axis=0), [0.3, 0.4, 0.5], atol=1e-12)


CUBE = Short(
    "cloth_on_cube.yaml",
    (
        "scene.cloths.cloth.shape={kind: grid, rows: 7, columns: 7, size: 0.5}",
        "scene.cloths.cloth.soft_pins={corner_0: {vertices: [0]}, corner_1: {vertices: [6]}, "
        "corner_2: {vertices: [42, 43]}, corner_3: {vertices: [48]}}",
        "simulation.dt=0.1",
        "simulation.steps=12",
    ),
)


def test_control_points_are_followed_to_their_last_targets():
    task = CUBE.load("scene.cloths.cloth.pin_trajectories.corner_0=[{time: 9}]")
    start = task.initial_state()
    ends = torch.tensor([0.0, 0.5, 0.5, 0.5], dtype=torch.float64)
    torch.testing.assert_close(task.distances(start), ends)
    # The position of a group is the mean of its vertices.
    turned = start.positions.clone()
    turned[42] += torch.tensor([0.0, 0.0, 0.1])
    turned[43] -= torch.tensor([0.0, 0.0, 0.1])
    torch.testing.assert_close(task.distances(start.replace(positions=turned)), ends)
    centers = np.array([goal.vertices.mean(axis=0) for goal in task.goals()])
    expected = start.positions.numpy()[[0, 6, 42, 48]]
    expected[2] = start.positions.numpy()[[42, 43]].mean(axis=0)
    expected[1:, 2] -= 0.5
    np.testing.assert_allclose(centers, expected, atol=1e-12)


def test_control_points_reach_their_targets_as_far_as_the_cloth_lets_them():
    task = CUBE.load()
    states = list(simulate(task))
    assert all(state.report.converged for state in states[1:])
    distances = task.distances(states[-1])
    assert 0.01 < distances.max() < 0.1  # from half a meter
    assert max(state.report.contact_count for state in states[1:]) > 0


def test_control_points_are_soft_pins():
    with pytest.raises(dc.InvalidInput, match="must have `soft_pins`"):
        CUBE.load("scene.cloths.cloth.soft_pins={}", "scene.cloths.cloth.pin_trajectories={}")


def test_the_shipped_tie_is_the_one_of_the_paper():
    task = load_task(CONFIGS / "tie.yaml")
    (tie,) = task.scene.cloths
    assert np.ptp(tie.rest_positions[:, 0]) == pytest.approx(1.4)
    assert {name: len(rows) for name, rows in tie.soft_pins.items()} == {"narrow": 5, "wide": 5}
