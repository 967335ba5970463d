"""The optimization of a task, on one without a simulation."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.config.schema import OptimizerSection
from diffcloth_torch.tasks.optimization import optimize


@dataclass
class Bowl:
    """Minimize |a|^2; rollouts of |a| beyond `reach` fail."""

    optimizer: OptimizerSection
    steps: int = 1
    start: float = 1.0
    reach: float = math.inf
    error: type[Exception] = dc.InfeasibleMotion

    def __post_init__(self):
        self.simulator = SimpleNamespace(rollout=self.rollout)

    def initial_state(self):
        return None

    def actions(self):
        return {"a": torch.tensor([self.start], dtype=torch.float64, requires_grad=True)}

    def controller(self, actions):
        return lambda k, state: actions["a"]

    def rollout(self, state, control_at, *, steps, checkpoint_every):
        value = control_at(0, state)
        if value.abs().item() > self.reach:
            raise self.error("too far")
        report = dc.Report(
            converged=True,
            iterations=1,
            residual=0.0,
            minimum_distance=math.inf,
            contact_count=0,
            motion_fraction=1.0,
            seconds={"all": 0.0},
        )
        return [dc.State(*[value] * 6, report=report)]

    def loss(self, states):
        return states[-1].positions.square().sum()


def descend(rate=0.25, **options):
    return OptimizerSection(iterations=5, learning_rates={"a": rate}, **options)


def test_the_loop_is_gradient_descent():
    # a <- a - 0.25 * 2 a halves a each time.
    found = optimize(Bowl(descend()))
    assert found.metrics()["losses"] == pytest.approx([0.25**k for k in range(5)])
    assert found.best.variables["a"].item() == pytest.approx(0.5**4)
    assert found.metrics()["minimum_distance"] is None


def test_momentum_and_clipping_are_those_of_torch():
    losses = optimize(Bowl(descend(momentum=0.5, clip=0.1))).metrics()["losses"]
    a, velocity, expected = 1.0, 0.0, []
    for _ in range(5):
        expected.append(a * a)
        velocity = 0.5 * velocity + math.copysign(min(abs(2 * a), 0.1), a)
        a -= 0.25 * velocity
    assert losses == pytest.approx(expected, rel=1e-5)


def test_momentum_starts_anew_where_the_loss_rises():
    losses = optimize(Bowl(descend(momentum=0.9, restart=True))).metrics()["losses"]
    a, velocity, expected = 1.0, 0.0, []
    for _ in range(5):
        if expected and a * a > expected[-1]:
            velocity = 0.0
        expected.append(a * a)
        velocity = 0.9 * velocity + 2 * a
        a -= 0.25 * velocity
    assert losses == pytest.approx(expected, rel=1e-5)
    assert any(b > a for a, b in itertools.pairwise(losses))


def test_the_loop_stops_below_a_loss():
    assert len(optimize(Bowl(descend(stop_below=0.1))).history) == 3


@pytest.mark.parametrize("error", [dc.InfeasibleMotion, dc.NotConverged])
def test_a_failed_attempt_goes_back_half_way(error):
    # The first step leads from 1 to -9, beyond the reach of 2: -4 fails as well, -1.5 is tried.
    found = optimize(Bowl(descend(rate=5.0), reach=2.0, error=error))
    assert found.metrics()["losses"][:2] == pytest.approx([1.0, 1.5**2])
    assert found.metrics()["failed_attempts"] >= 2
    assert found.failures[0] == {"iteration": 1, "error": f"{error.__name__}: too far"}


def test_the_loop_gives_up_after_too_many_failures():
    with pytest.raises(dc.InfeasibleMotion, match="too far"):
        optimize(Bowl(descend(rate=50.0, failures=2), reach=1.0))


def test_initial_actions_that_fail_end_the_loop():
    with pytest.raises(dc.InfeasibleMotion, match="too far"):
        optimize(Bowl(descend(), start=3.0, reach=2.0))


def test_another_error_is_not_swallowed():
    with pytest.raises(ZeroDivisionError):
        optimize(Bowl(descend(rate=5.0), reach=2.0, error=ZeroDivisionError))


def test_an_infinite_loss_is_an_error():
    with pytest.raises(dc.SimulationError, match="the loss is inf"):
        optimize(Bowl(descend(), start=1e200))


def test_learning_rates_must_name_the_actions():
    options = OptimizerSection(iterations=1, learning_rates={"b": 1.0})
    with pytest.raises(dc.InvalidInput, match="must have the keys a, got b"):
        optimize(Bowl(options))
