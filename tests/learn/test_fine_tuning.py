"""Trainings that begin at a policy: its weights, bounded updates, checks at held-out starts."""

from __future__ import annotations

import copy
import functools
from dataclasses import replace

import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.checkpoint import write_checkpoint
from diffcloth_torch.learn import Policy, PolicySizes, Trainer, TrainerOptions, load_policy
from diffcloth_torch.learn import trainer as trainer_module
from diffcloth_torch.learn.evaluation import Episodes
from diffcloth_torch.learn.trainer import record_of

SOFT = {"opens_at": -1.0, "reach": 0.06}
make = functools.partial(dc.envs.make, "FoldCloth", size=5, horizon=4, **SOFT)
HOLD = (0.0, 0.0, 0.1, 0.9, 0.0, 0.0, 0.1, 0.9)
OPTIONS = TrainerOptions("apg", horizon=3, hidden=(8,), first_action=HOLD, plan_knots=2)


@pytest.fixture(scope="module")
def begun():
    """A policy after one update."""
    trainer = Trainer(make, OPTIONS, num_envs=2)
    trainer.update()
    return trainer.policy


def weights(policy):
    return {name: tensor.detach().clone() for name, tensor in policy.state_dict().items()}


def assert_same_bits(a, b):
    assert a.keys() == b.keys()
    for name, tensor in a.items():
        assert torch.equal(tensor, b[name]), name


def successes(monkeypatch, *rates):
    """Replace evaluations at held-out starts by given shares of successes, in order."""
    left = list(rates)

    def evaluate(owner, make_env, policy, seeds, *, workers):
        flags = torch.arange(len(seeds)) < left.pop(0) * len(seeds)
        return Episodes(torch.zeros(len(seeds)), flags, flags, flags, flags, 0, tuple(seeds))

    monkeypatch.setattr(trainer_module, "evaluate_starts", evaluate)
    return left


class TestInit:
    @pytest.mark.parametrize("algorithm", ["apg", "shac", "sapo"])
    def test_training_begins_at_the_weights(self, begun, algorithm):
        """Algorithm, rate, horizon, number of environments and length of episodes may differ."""
        options = replace(OPTIONS, algorithm=algorithm, learning_rate=1e-4, horizon=2, held_out=0)
        longer = functools.partial(dc.envs.make, "FoldCloth", size=5, horizon=6, **SOFT)
        trainer = Trainer(longer, options, num_envs=3, init=begun)
        observation, _ = longer(num_envs=2).reset(seed=0)
        with torch.no_grad():
            torch.testing.assert_close(trainer.act(observation), begun(observation))
        before = weights(begun)
        trainer.update()
        assert_same_bits(weights(begun), before)

    def test_a_policy_from_a_file_begins_a_training(self, begun, tmp_path):
        begun.save(tmp_path / "policy.pt")
        trainer = Trainer(make, num_envs=2, init=load_policy(tmp_path / "policy.pt"))
        assert trainer.options == replace(OPTIONS, max_change=0.02, held_out=16)
        assert_same_bits(weights(trainer.policy), weights(begun))
        assert len(set(trainer.held_out)) == 16

    def test_explicit_bounds_stay(self, begun):
        options = replace(OPTIONS, max_change=0.3, held_out=2)
        assert Trainer(make, options, num_envs=2, init=begun).options == options
        assert Trainer(make, OPTIONS, num_envs=2).options == OPTIONS

    @pytest.mark.parametrize(
        ("init", "message"),
        [
            (lambda p: Policy(PolicySizes(9, 8, 0), OPTIONS), r"`init` must be for \d+ observatio"),
            (
                lambda p: Policy(p.sizes, replace(OPTIONS, hidden=(9,))),
                r"`init` has TrainerOptions\(hidden=\(9,\)\), but `options` has hidden=\(8,\)",
            ),
        ],
    )
    def test_other_shapes_are_refused_by_name(self, begun, init, message):
        with pytest.raises(dc.InvalidInput, match=message):
            Trainer(make, OPTIONS, num_envs=2, init=init(begun))

    def test_init_must_be_a_policy(self):
        with pytest.raises(TypeError, match="`init` must be a Policy, got dict"):
            Trainer(make, OPTIONS, num_envs=2, init={})


class TestTrustRegion:
    def changes(self, trainer, monkeypatch):
        """Update; return the change of actions at the observations of the rollout, and the log."""
        seen = []
        real = trainer._rollouts

        def rollouts():
            found = real()
            seen.extend(r.seen for r in found)
            return found

        monkeypatch.setattr(trainer, "_rollouts", rollouts)
        before = Policy(trainer.policy.sizes, trainer.policy.options)
        before.load_state_dict(weights(trainer.policy))
        log = trainer.update()
        with torch.no_grad():
            rows = torch.cat([s.flatten(0, 1) for s in seen])
            return float((trainer.policy(rows) - before(rows)).square().mean().sqrt()), log

    def test_the_change_of_actions_is_bounded(self, begun, monkeypatch):
        bounded = replace(
            OPTIONS, learning_rate=0.05, plan_learning_rate=0.2, max_change=0.01, held_out=0
        )
        change, log = self.changes(Trainer(make, bounded, num_envs=2, init=begun), monkeypatch)
        # Bisection is exact to 1e-6 of the update.
        assert 0.0099 < change <= 0.01
        assert log["change"] == pytest.approx(change)
        assert 0 < log["step_share"] < 0.5
        wide = replace(bounded, max_change=2.0)
        change, log = self.changes(Trainer(make, wide, num_envs=2, init=begun), monkeypatch)
        assert change > 0.02
        assert log["step_share"] == 1.0

    def test_an_update_within_the_bound_is_unchanged(self, begun):
        found = []
        for options in (OPTIONS, replace(OPTIONS, max_change=2.0)):
            trainer = Trainer(make, options, num_envs=2)
            trainer.update()
            found.append(weights(trainer.policy))
        assert_same_bits(*found)


class TestChecks:
    OPTIONS = replace(OPTIONS, held_out=4, check_every=1)

    def test_a_policy_that_succeeds_less_is_undone(self, begun, monkeypatch):
        left = successes(monkeypatch, 0.5, 0.75, 0.25, 0.25, 0.75)
        trainer = Trainer(make, self.OPTIONS, num_envs=2, init=begun)
        log = trainer.update()
        assert (log["held_out"], log["undone"]) == (0.75, 0.0)
        better = weights(trainer.policy)
        moments = copy.deepcopy(trainer._actor_steps.state_dict()["state"][0])
        for undone in (1, 2):
            log = trainer.update()
            assert (log["held_out"], log["undone"], trainer.undone) == (0.25, 1.0, undone)
            assert_same_bits(weights(trainer.policy), better)
            assert_same_bits(trainer._actor_steps.state_dict()["state"][0], moments)
        log = trainer.update()
        assert log["undone"] == 0.0
        assert any(not torch.equal(t, better[n]) for n, t in weights(trainer.policy).items())
        assert (left, trainer.updates) == ([], 4)

    def test_a_training_never_ends_below_its_beginning(self, begun, monkeypatch):
        successes(monkeypatch, 0.5, 0.25, 0.0, 0.25)
        options = replace(self.OPTIONS, check_every=2)
        trainer = Trainer(make, options, num_envs=2, init=begun)
        for _ in range(3):
            trainer.update()
        assert trainer.check() == {"held_out": 0.0, "undone": 1.0}
        assert_same_bits(weights(trainer.policy), weights(begun))
        assert trainer.undone == 1

    def test_a_fall_that_chance_may_cause_is_undone_at_the_end_only(self, begun, monkeypatch):
        """Two standard errors of .75 among 4 starts are .43."""
        successes(monkeypatch, 0.75, 0.5, 0.5, 0.5)
        trainer = Trainer(make, self.OPTIONS, num_envs=2, init=begun)
        for _ in range(2):
            log = trainer.update()
            assert (log["held_out"], log["undone"]) == (0.5, 0.0)
            assert any(
                not torch.equal(t, weights(begun)[n]) for n, t in weights(trainer.policy).items()
            )
        assert trainer.check() == {"held_out": 0.5, "undone": 1.0}
        assert_same_bits(weights(trainer.policy), weights(begun))

    def test_checks_have_starts_of_their_own(self, begun, monkeypatch):
        trainer = Trainer(make, self.OPTIONS, num_envs=2, init=begun)
        found = trainer.check()
        assert found == {"held_out": 0.0, "undone": 0.0}
        assert Trainer(make, OPTIONS, num_envs=2).check() == {}
        again = Trainer(make, self.OPTIONS, num_envs=2)
        assert again.held_out == trainer.held_out
        other = Trainer(make, replace(self.OPTIONS, seed=1), num_envs=2)
        assert not {*other.held_out} & {*trainer.held_out}

    def test_checks_continue_with_the_same_bits(self, begun, monkeypatch, tmp_path):
        """Interruption while the last good policy differs from the present policy."""
        options = replace(self.OPTIONS, check_every=2)
        rates = 1.0, 0.75, 0.75
        left = successes(monkeypatch, *rates)
        one = Trainer(make, options, num_envs=2, init=begun)
        for _ in range(3):
            one.update()
        one.save(tmp_path / "trainer.pt")
        again = Trainer(make, one.options, num_envs=2)  # without `init`
        again.load(tmp_path / "trainer.pt")
        assert len(left) == 1
        logs = []
        for trainer in (one, again):
            left[:] = rates[2:]
            logs.append([trainer.update() for _ in range(2)])
            left[:] = rates[2:]
        assert logs[0] == logs[1]
        assert one.undone == again.undone == 2
        assert_same_bits(weights(one.policy), weights(again.policy))

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"success": 1.5}, r"success in \[0, 1\]"),
            ({"updates": 3}, "at most 1 updates"),
            ({"steps": {}}, "must have the keys"),
            ({"weights": {}}, "must have the keys"),
            ({"more": 1}, "must have the keys"),
        ],
    )
    def test_files_are_checked(self, begun, monkeypatch, tmp_path, change, message):
        successes(monkeypatch, 0.5, 0.5)
        trainer = Trainer(make, self.OPTIONS, num_envs=2, init=begun)
        trainer.update()
        content = record_of(trainer)
        content["kept"] |= change
        write_checkpoint(tmp_path / "t.pt", "trainer", content)
        with pytest.raises(dc.InvalidInput, match=message):
            trainer.load(tmp_path / "t.pt")

    def test_files_without_checks_load(self, tmp_path):
        trainer = Trainer(make, OPTIONS, num_envs=2)
        trainer.update()
        content = record_of(trainer)
        for name in ("undone", "kept"):
            del content[name]
        for name in ("max_change", "held_out", "check_every"):
            del content["options"][name]
        write_checkpoint(tmp_path / "t.pt", "trainer", content)
        again = Trainer(make, OPTIONS, num_envs=2)
        again.load(tmp_path / "t.pt")
        assert_same_bits(weights(again.policy), weights(trainer.policy))
        assert_same_bits(weights(load_policy(tmp_path / "t.pt")), weights(trainer.policy))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_change": 0.0}, "`max_change` must be positive"),
        ({"max_change": float("inf")}, "`max_change` must be positive and below"),
        ({"held_out": -1}, "`held_out` must be at least 0"),
        ({"check_every": 0}, "`check_every` must be at least 1"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(dc.InvalidInput, match=message):
        TrainerOptions(**options)
