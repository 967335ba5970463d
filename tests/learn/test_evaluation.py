"""`evaluate`: seeds of starts, costs of failures, intervals, and equal bits for all workers."""

from __future__ import annotations

import functools
import pickle

import pytest
import torch
from processes import threads

import diffcloth_torch as dc
from diffcloth_torch.envs import env as env_module
from diffcloth_torch.envs.fold_cloth import FoldCloth
from diffcloth_torch.learn import Episodes, Policy, Processes, TrainerOptions, evaluate
from diffcloth_torch.learn import evaluation as module
from diffcloth_torch.learn.evaluation import acting
from diffcloth_torch.learn.starts import PURPOSES, episode_seeds, purpose_seed
from diffcloth_torch.learn.trainer import Trainer

ROWS = ("returns", "success", "ever", "failed", "blocked")
make = functools.partial(dc.envs.make, "FoldCloth", size=5, horizon=4, opens_at=-1.0, reach=0.06)


@pytest.fixture(scope="module")
def policy():
    """A policy whose actions depend on observations."""
    torch.manual_seed(0)
    policy = Policy(make(num_envs=1), TrainerOptions(plan_knots=3, hidden=(16, 8)))
    with torch.no_grad():
        policy.actor.layers[-1].weight.mul_(100.0)
    return policy


class Pickling:
    """Workers in this process that pickle functions, items and results."""

    def map(self, function, items):
        sent = [pickle.loads(pickle.dumps((function, item))) for item in items]
        return [pickle.loads(pickle.dumps(call(item))) for call, item in sent]


def assert_same_episodes(a, b):
    for name in ROWS:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def first(episodes, count):
    rows = {name: getattr(episodes, name)[:count] for name in ROWS}
    return Episodes(**rows, steps=0, seeds=episodes.seeds[:count])


class TestEpisodes:
    def test_an_episode_does_not_depend_on_their_number_and_chunk(self, policy, monkeypatch):
        many = evaluate(make, policy, 5, 3)
        assert len(many) == 5
        assert many.steps == 5 * 4
        assert len({float(value) for value in many.returns}) == 5
        for chunk, count, outside in ((8, 2, 2), (2, 5, 1), (1, 3, 2)):
            monkeypatch.setattr(module, "_CHUNK", chunk)
            with threads(outside):
                found = evaluate(make, policy, count, 3)
            assert_same_episodes(found, first(many, count))
            assert found.seeds == many.seeds[:count]

    def test_actions_do_not_depend_on_other_episodes(self, policy):
        """Rounding of matrix products depends on the number of rows."""
        seen = torch.randn(8, policy.observations, generator=torch.Generator().manual_seed(0))
        act = acting("evaluate", make(num_envs=1), policy)
        with torch.no_grad():
            assert torch.equal(act(seen), torch.cat([act(row[None]) for row in seen]))

    def test_episodes_begin_by_their_seeds(self, policy):
        found = evaluate(make, policy, 2, 7)
        env = make(num_envs=2)
        observation, _ = env.reset(seed=found.seeds)
        returns = torch.zeros(2)
        for _ in range(4):
            with torch.no_grad():
                observation, reward, *_ = env.step(policy(observation))
            returns += reward
        torch.testing.assert_close(returns, found.returns)
        assert not torch.equal(evaluate(make, policy, 2, 8).returns, found.returns)

    def test_episodes_of_workers_have_the_same_bits(self, policy):
        for acts in (policy, "scripted"):
            found = evaluate(make, acts, 2, 3, workers=Pickling())
            assert_same_episodes(found, evaluate(make, acts, 2, 3))

    @pytest.mark.slow
    def test_episodes_of_processes_have_the_same_bits(self, policy):
        workers = Processes(2)
        try:
            found = evaluate(make, policy, 10, 3, workers=workers)
        finally:
            workers.close()
        assert_same_episodes(found, evaluate(make, policy, 10, 3))

    def test_a_trainer_evaluates_the_same_episodes(self, policy):
        trainer = Trainer(make, policy.options, num_envs=2)
        mean, success, states = trainer.evaluate(3, seed=5)
        env = make(num_envs=3)
        observation, _ = env.reset(seed=5)
        total = torch.zeros(3)
        for _ in range(4):
            observation, reward, *_ = env.step(trainer.act(observation))
            total += reward
        assert mean == float(total.mean())
        assert success == 0.0
        assert len(states) == 4

    def test_episodes_count_successes_blocked_motions_and_failures(self, monkeypatch):
        """A temporary success, a blocked motion, and a simulation that fails in step 3."""
        calls = []

        def failures(state):
            calls.append(state)
            return torch.tensor([False, len(calls) == 3 * make(num_envs=1).task.substeps])

        real = FoldCloth.transition

        def transition(task, env, actions, parameters=None):
            after = real(task, env, actions, parameters)
            blocked = torch.tensor([True, False]) & (after.elapsed == 2)
            held = torch.where(after.elapsed < 4, 5, 0) * torch.tensor([1, 0])
            return env_module.replace(after, blocked=blocked, held=held)

        monkeypatch.setattr(env_module, "failures", failures)
        monkeypatch.setattr(FoldCloth, "transition", transition)
        found = evaluate(make, "scripted", 2)
        assert found.success.tolist() == [False, False]
        assert found.ever.tolist() == [True, False]
        assert found.blocked.tolist() == [True, False]
        assert found.failed.tolist() == [False, True]
        assert found.steps == 4 + 3
        # The failed step 3 and the remaining step 4 each cost the worst reward.
        assert float(found.returns[1]) < 2 * FoldCloth.worst + 2

    def test_the_repr_of_episodes_has_three_lines(self):
        flags = torch.arange(64) < 48
        none = torch.zeros(64, dtype=torch.bool)
        found = Episodes(torch.ones(64), flags, flags, none, none, 640, tuple(range(64)))
        assert repr(found).splitlines()[0].startswith("Episodes(success=48 of 64 (63% to 84%), ")
        assert len(repr(found).splitlines()) <= 3


@pytest.mark.parametrize(("count", "of"), [(0, 7), (7, 7), (14, 16), (59, 64), (1, 1)])
def test_the_interval_agrees_with_wilson(count, of):
    from scipy.stats import binomtest

    flags = torch.arange(of) < count
    found = Episodes(torch.zeros(of), flags, flags, flags, flags, 0, tuple(range(of)))
    expected = binomtest(count, of).proportion_ci(0.95, method="wilson")
    assert found.interval == pytest.approx(tuple(expected), abs=1e-12)
    assert found.success_rate == pytest.approx(count / of)


@pytest.mark.parametrize("seed", [0, 1, 10_000])
def test_starts_of_different_purposes_are_different(seed):
    own = [set(episode_seeds(purpose_seed(seed, purpose), 64)) for purpose in PURPOSES]
    own.append(set(episode_seeds(seed, 64)))
    assert len(set.union(*own)) == 64 * len(own)
    assert episode_seeds(seed, 3) == episode_seeds(seed, 64)[:3]


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"policy": "random"}, dc.InvalidInput, "evaluate: `policy` must be one of 'scripted'"),
        ({"policy": Policy}, TypeError, "evaluate: `policy` must be a function of observations"),
        ({"policy": lambda o: o}, dc.InvalidInput, "actions of `policy` must have shape"),
        (
            {"policy": lambda o: torch.full((1, 8), torch.nan)},
            dc.InvalidInput,
            "actions of `policy` must be finite",
        ),
        ({"episodes": 0}, dc.InvalidInput, "evaluate: `episodes` must be at least 1"),
        ({"seed": -1}, dc.InvalidInput, "evaluate: `seed` must be at least 0"),
        ({"workers": 2}, TypeError, "evaluate: `workers` must have `map`"),
        ({"make": "FoldCloth"}, TypeError, "evaluate: `make` must be a function"),
    ],
)
def test_evaluate_refuses_bad_arguments(change, error, message):
    with pytest.raises(error, match=message):
        evaluate(**({"make": make, "policy": "scripted", "episodes": 1} | change))


def test_functions_without_a_name_are_refused_with_workers():
    with pytest.raises(dc.InvalidInput, match="evaluate: with `workers`, `policy` must be"):
        evaluate(make, lambda observation: observation, 1, workers=Processes(1))


def test_a_policy_of_other_sizes_is_refused(policy):
    lift = functools.partial(dc.envs.make, "LiftCloth", size=4)
    with pytest.raises(dc.InvalidInput, match=r"`policy` must be for \d+ observations, as the env"):
        evaluate(lift, policy, 1)
