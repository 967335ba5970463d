"""The cost of a robot's step is independent of the length of the rollout, also with a graph."""

import time

import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.robots import GRIPPER
from diffcloth_torch.sim.solve import engine

STEPS = 200
WINDOW = 20


def rollout(base, steps, **options):
    """A gripper whose fingers swing in the air, and the states of a rollout with a graph."""
    hand = dc.Robot.load(GRIPPER, base=base, actuation="pd", stiffness=50.0, damping=0.5)
    contact = dc.ContactOptions(barrier_distance=1e-3)
    sim = dc.Simulator(dc.Scene([], robots=[hand]), 0.01, contact=contact)
    parameters = sim.default_parameters()
    parameters = parameters.replace(link_mass=parameters.link_mass.requires_grad_())
    control = sim.control(joint_positions=[0.03, 0.02])
    states = sim.rollout(sim.initial_state(), [control] * steps, parameters, **options)
    return parameters.link_mass, states


@pytest.fixture
def solves(monkeypatch):
    """CPU times of this thread at its calls of the core [s], in order."""
    times, solve = [], engine.take_step

    def timed(*args, **keywords):
        times.append(time.thread_time())
        return solve(*args, **keywords)

    monkeypatch.setattr(engine, "take_step", timed)
    return times


@pytest.mark.quick("30-*")
@pytest.mark.parametrize("base", ["fixed", "floating"])
@pytest.mark.parametrize("checkpoint_every", [None, STEPS, 30])
@pytest.mark.slow
def test_the_last_step_of_a_rollout_takes_the_time_of_the_first(base, checkpoint_every, solves):
    rollout(base, WINDOW, checkpoint_every=checkpoint_every)  # warm-up of torch
    rollouts = []
    for _ in range(3):
        solves.clear()
        rollout(base, STEPS, checkpoint_every=checkpoint_every)
        assert len(solves) == STEPS
        rollouts.append(torch.tensor(solves, dtype=torch.float64).diff())
    # The fastest of three is free of whatever else the machine had to do.
    steps = torch.stack(rollouts).amin(0)
    first, last = steps[:WINDOW].median(), steps[-WINDOW:].median()
    assert last < 2 * first


def test_backward_repeats_a_step_with_a_checkpoint_once(solves):
    mass, states = rollout("fixed", WINDOW, checkpoint_every=7)
    states[-1].joint_velocities.sum().backward()
    assert mass.grad.any()
    assert len(solves) == 2 * WINDOW
