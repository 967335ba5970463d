"""Threads start with the most expensive environments, and no result depends on the order."""

import numpy as np
import pytest
import torch
from processes import threads

import diffcloth_torch as dc

CHEAP = 5  # environments


@pytest.fixture
def uneven():
    """A simulator and a batch: the last environment's sheet meets a body, the others hang."""
    n = 10
    sheet = dc.Cloth.grid(n, n, pins={"corners": [0, n - 1]})
    ball = dc.RigidBody.sphere(0.2, pose=[0.01, 0.02, -0.25, 1, 0, 0, 0])
    simulator = dc.Simulator(dc.Scene([sheet], [ball]), 0.01)
    state = simulator.initial_state(batch_size=CHEAP + 1)
    poses = state.body_poses.clone()
    poses[:-1, :, 2] -= 5.0
    velocities = torch.zeros_like(state.velocities)
    velocities[-1, 2 * n :, 2] = -15.0
    return simulator, state.replace(body_poses=poses, velocities=velocities)


def places(simulator):
    return [place for place, _ in simulator._core.last_turns]


def values(simulator, state):
    before = state.detach()
    x, v = before.positions.requires_grad_(), before.velocities.requires_grad_()
    after = simulator.step(before)
    after.positions.square().sum().backward()
    return [after.positions.detach(), after.velocities.detach(), x.grad, v.grad]


def same(a, b):
    return all(torch.equal(p, q) for p, q in zip(a, b, strict=True))


def test_the_slowest_environment_begins_the_next_step(uneven):
    simulator, state = uneven
    with threads(1), torch.no_grad():
        after = simulator.step(state)
        assert places(simulator) == list(range(CHEAP + 1))
        assert (after.report.contact_count > 0).tolist() == [False] * CHEAP + [True]
        seconds = [taken for _, taken in simulator._core.last_turns]
        simulator.step(state)
        # Ties and noise decide between the cheap ones.
        assert places(simulator) == np.argsort(np.argsort(seconds)[::-1]).tolist()
        assert places(simulator)[-1] == 0
        simulator.step(state[-1])  # another batch, without recorded times
        simulator.step(state)
        assert places(simulator) == list(range(CHEAP + 1))


def test_derivatives_of_environments_with_contacts_begin(uneven):
    simulator, state = uneven
    with threads(1):
        values(simulator, state)
        assert places(simulator) == [*range(1, CHEAP + 1), 0]
        # Nine losses of an environment are processed as eight and one.
        before = state.detach()
        x = before.positions.requires_grad_()
        after = simulator.step(before)
        losses = torch.eye(9, dtype=torch.float64)[..., None, None, None] * torch.ones_like(x)
        losses = losses.sum(1)
        torch.autograd.grad(after.positions, x, losses, is_grads_batched=True)
        large = [k for k, place in enumerate(places(simulator)) if place <= CHEAP]
        assert large == [2 * e for e in range(CHEAP + 1)]
        assert places(simulator)[2 * CHEAP] == 0


def test_the_order_changes_no_bit(uneven):
    simulator, state = uneven
    with threads(1):
        expected = values(simulator, state)
        first = places(simulator)
    for count in (1, 2, 3):
        with threads(count):
            for _ in range(3):
                assert same(values(simulator, state), expected)
    with threads(1):
        for e, environment in enumerate(state):
            alone = values(simulator, environment)
            assert same(alone, [value[e] for value in expected])
    assert first[-1] == 0


def test_a_failure_of_an_environment_that_begins_early_leaves_the_others(uneven):
    simulator, state = uneven
    poses = state.body_poses.clone()
    poses[-1, :, 2] += 0.2  # through the sheet
    failing = state.replace(body_poses=poses)
    with torch.no_grad():
        with threads(1):
            expected = simulator.step(state)
        for count in (1, 2):
            with threads(count):
                with pytest.raises(dc.IntersectingState, match=rf"environments \[{CHEAP}\]"):
                    simulator.step(failing)
                after = simulator.step(state)
            assert torch.equal(after.positions, expected.positions)
