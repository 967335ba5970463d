"""`diffcloth train`: results, continuation after an interruption, and messages."""

from __future__ import annotations

import functools
import json
from dataclasses import replace

import pytest
import torch
from click.testing import CliRunner

from diffcloth_torch import envs
from diffcloth_torch.cli import main
from diffcloth_torch.cli import train as train_module
from diffcloth_torch.learn import Trainer, evaluate, load_policy
from diffcloth_torch.learn.starts import episode_seeds, purpose_seed

SHORT = """
task: train
environment:
  name: FoldCloth
  options: {size: 6, horizon: 5, opens_at: -1.0, reach: 0.06}
trainer: {algorithm: shac, horizon: 4, first_action: [0, 0, 0.1, 0.9, 0, 0, 0.1, 0.9]}
num_envs: 2
updates: 4
evaluate_every: 2
episodes: 2
selection_episodes: 2
report_episodes: 3
pictures: {video: none, size: [64, 64], sheet: 2}
"""


MAKE = functools.partial(envs.make, "FoldCloth", size=6, horizon=5, opens_at=-1.0, reach=0.06)


@pytest.fixture
def config(tmp_path):
    file = tmp_path / "short.yaml"
    file.write_text(SHORT)
    return file


def call(*arguments):
    return CliRunner().invoke(main, ["train", *map(str, arguments)])


def policy(folder):
    return torch.load(folder / "policy.pt", weights_only=True)["policy"]


def record_of(folder):
    return json.loads((folder / "train.json").read_text())


def test_a_training_writes_its_results(config, tmp_path):
    result = call(config, "--out", tmp_path / "out", "--debug")
    assert result.exit_code == 0, result.output
    assert "32 environment steps" in result.output
    record = json.loads((tmp_path / "out" / "train.json").read_text())
    assert [e["steps"] for e in record["evaluations"]] == [0, 16, 32]
    assert record["config"]["environment"]["name"] == "FoldCloth"
    assert (tmp_path / "out" / "evaluation.png").stat().st_size > 100
    assert not (tmp_path / "out" / "evaluation.html").exists()
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path / "out" / "events")).Reload()
    assert [e.step for e in events.Scalars("gradient_norm")] == [8, 16, 24, 32]
    assert len(events.Scalars("evaluation/return")) == 3


@pytest.mark.slow
def test_an_interrupted_training_goes_on_with_the_same_bits(config, tmp_path, monkeypatch):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert call(config, "--out", whole).exit_code == 0
    real, calls = Trainer.update, []

    def update(trainer):
        calls.append(trainer.updates)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return real(trainer)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "update", update)
        result = call(config, "--out", cut)
    assert result.exit_code == 130
    assert "after 3 updates, of which 2 are kept" in result.output
    result = call("--resume", cut)
    assert result.exit_code == 0, result.output
    assert same_policies(whole, cut)
    records = [record_of(folder) for folder in (whole, cut)]
    evaluations = [record["evaluations"] for record in records]
    assert [e["steps"] for e in evaluations[0]] == [0, 16, 32]
    assert [e["return"] for e in evaluations[0]] == [e["return"] for e in evaluations[1]]
    for record in records:
        del record["report"]["minutes"]
    for name in ("starts", "best", "report"):
        assert records[0][name] == records[1][name]
    assert "nothing is left" in call("--resume", cut).output


@pytest.fixture
def looks(monkeypatch):
    """Lists of success and return to report at each selection, and of the weights at each."""
    given, at = [], []
    real = train_module.evaluate

    def found(make_env, policy, episodes, seed, *, workers):
        episodes = real(make_env, policy, episodes, seed, workers=workers)
        if seed == purpose_seed(0, "selection"):
            success, value = given.pop(0)
            at.append({name: t.clone() for name, t in policy.state_dict().items()})
            flags = torch.full_like(episodes.success, success)
            returns = torch.full_like(episodes.returns, value)
            return replace(episodes, success=flags, returns=returns)
        return episodes

    monkeypatch.setattr(train_module, "evaluate", found)
    return given, at


def test_the_best_policy_is_kept_and_reported(config, tmp_path, looks):
    """Best by success, then return, at five of seven evaluations; the first in a tie."""
    given, at = looks
    given[:] = [(False, 3.0), (True, 1.0), (True, 2.0), (True, 2.0), (False, 9.0)]
    out = tmp_path / "out"
    changes = ("updates=6", "evaluate_every=1", "viewers=[]")
    result = call(config, "--out", out, *(f"--set={change}" for change in changes))
    assert result.exit_code == 0, result.output
    assert (given, len(at)) == ([], 5)
    assert all(torch.equal(tensor, at[2][name]) for name, tensor in policy(out).items())
    assert not torch.equal(at[2]["actor.log_deviation"], at[4]["actor.log_deviation"])
    record = record_of(out)
    assert len(record["evaluations"]) == 7
    assert record["best"] == {"updates": 4, "success": 1.0, "return": 2.0}
    fresh = evaluate(MAKE, load_policy(out / "policy.pt"), 3, purpose_seed(0, "report"))
    report = record["report"]
    assert report["return"] == fresh.mean_return
    assert report["interval"] == list(fresh.interval)
    low, high = fresh.interval
    line = (
        f"success 0% ({low:.0%} to {high:.0%}) in 3 fresh episodes, return {report['return']:.4g}"
    )
    steps = "48 environment steps"
    assert f"{line}, {steps}, {report['minutes']:.1f} minutes" in result.output
    assert record["starts"] == {
        "undo": [],
        "selection": episode_seeds(purpose_seed(0, "selection"), 2),
        "report": list(fresh.seeds),
    }


@pytest.mark.parametrize(
    ("found", "best", "better"),
    [
        ((0.8125, 31.0), (0.9375, 30.0), True),  # two successes of 16 may be chance
        ((0.8125, 30.0), (0.9375, 30.0), False),
        ((0.625, 40.0), (0.9375, 30.0), False),  # five are not
        ((0.9375, 5.0), (0.625, 10.0), True),
        ((0.875, 31.0), (1.0, 30.0), True),
        ((0.75, 40.0), (1.0, 30.0), False),
        ((0.25, -60.0), (0.0, -50.0), True),
        ((0.0, -40.0), (0.0, -50.0), True),
    ],
)
def test_differences_of_success_that_chance_may_cause_are_settled_by_return(found, best, better):
    pairs = [dict(zip(("success", "return"), each, strict=True)) for each in (found, best)]
    assert train_module._is_better(*pairs, 16) == better


def test_the_last_policy_is_checked_at_held_out_starts(config, tmp_path, monkeypatch):
    calls = []

    def checked(trainer, *, final):
        calls.append((trainer.updates, final))
        return {}

    monkeypatch.setattr(Trainer, "_checked", checked)
    held_out = "trainer.held_out=2", "trainer.check_every=2", "updates=3", "viewers=[]"
    result = call(config, "--out", tmp_path / "out", *(f"--set={change}" for change in held_out))
    assert result.exit_code == 0, result.output
    assert calls[-2:] == [(2, False), (3, True)]
    assert len(record_of(tmp_path / "out")["starts"]["undo"]) == 2


def test_a_page_shows_all_episodes_of_the_evaluation(config, tmp_path):
    out = tmp_path / "out"
    result = call(config, "--out", out, "--viewer", "web", "--set", "updates=1")
    assert result.exit_code == 0, result.output
    assert (out / "evaluation.html").stat().st_size > 10_000
    assert not (out / "evaluation.png").exists()


def test_success_ends_the_training(config, tmp_path):
    result = call(config, "--out", tmp_path / "out", "--set", "until_success=0.0")
    assert result.exit_code == 0, result.output
    record = json.loads((tmp_path / "out" / "train.json").read_text())
    assert [e["updates"] for e in record["evaluations"]] == [0]


TRYOUT = ("--set", "tryout={seeds: [0, 1, 2], updates: 2}")


def same_policies(a, b):
    a, b = policy(a), policy(b)
    return all(torch.equal(tensor, b[name]) for name, tensor in a.items())


@pytest.mark.slow
def test_the_best_of_several_seeds_goes_on_as_if_it_had_been_alone(config, tmp_path):
    out = tmp_path / "out"
    result = call(config, "--out", out, *TRYOUT)
    assert result.exit_code == 0, result.output
    record = json.loads((out / "train.json").read_text())
    tried = record["tried"]
    assert [(each["seed"], each["updates"]) for each in tried] == [(0, 2), (1, 2), (2, 2)]
    best = max(tried, key=lambda each: each["return"])
    assert f"seed {best['seed']}, the best of [0, 1, 2]" in result.output
    assert [e["updates"] for e in record["evaluations"]] == [0, 2, 4]
    assert record["evaluations"][1]["return"] == best["return"]
    for seed in range(3):
        alone = tmp_path / f"alone_{seed}"
        assert call(config, "--out", alone, "--set", f"trainer.seed={seed}").exit_code == 0
        evaluations = json.loads((alone / "train.json").read_text())["evaluations"]
        assert evaluations[1]["return"] == tried[seed]["return"]
        assert same_policies(out, alone) == (seed == best["seed"])
    assert {f.name for f in (out / "events").iterdir() if f.is_dir()} == {
        "seed_0", "seed_1", "seed_2"
    }  # fmt: skip
    assert call(config, "--out", out, "--overwrite").exit_code == 0
    assert not [f for f in (out / "events").iterdir() if f.is_dir()]


@pytest.mark.quick("while seeds are tried")
@pytest.mark.parametrize("at", [3, 8], ids=["while seeds are tried", "after that"])
@pytest.mark.slow
def test_an_interrupted_tryout_goes_on_with_the_same_bits(config, tmp_path, monkeypatch, at):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert call(config, "--out", whole, *TRYOUT).exit_code == 0
    real, calls = Trainer.update, []

    def update(trainer):
        calls.append(trainer.updates)
        if len(calls) == at:
            raise KeyboardInterrupt
        return real(trainer)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "update", update)
        result = call(config, "--out", cut, *TRYOUT)
    assert result.exit_code == 130
    assert f"of which {0 if at == 3 else 2} are kept" in result.output
    result = call("--resume", cut)
    assert result.exit_code == 0, result.output
    assert same_policies(whole, cut)
    tried = [json.loads((f / "train.json").read_text())["tried"] for f in (whole, cut)]
    assert [e["return"] for e in tried[0]] == [e["return"] for e in tried[1]]


def test_a_seed_that_succeeds_is_the_last_one(config, tmp_path):
    out = tmp_path / "out"
    result = call(config, "--out", out, "--set", "until_success=0.0", *TRYOUT)
    assert result.exit_code == 0, result.output
    record = json.loads((out / "train.json").read_text())
    assert [each["seed"] for each in record["tried"]] == [0]
    assert [e["updates"] for e in record["evaluations"]] == [0]
    assert "nothing is left" in call("--resume", out).output


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("task=drape", "`task` must be train"),
        ("environment.name=Fold", "`task` must be one of"),
        ("environment.options.bend=1", "an option of FoldCloth must be one of"),
        ("trainer.speed=1", "`trainer` may have algorithm"),
        ("trainer.target_rate=0.5", "got 'target_rate'; since 0.2.0 its name is `tau`"),
        ("trainer.horizon=0", "`horizon` must be"),
        ("workers.kind=dask", "workers.kind"),
        ("workers.kind=ranks", "under torchrun"),
        ("updates=0", "updates"),
        ("tryout={seeds: [1], updates: 2}", "tryout.seeds"),
        ("tryout={seeds: [1, -1], updates: 2}", "tryout.seeds"),
    ],
)
def test_bad_configurations_are_refused(config, tmp_path, assignment, message):
    result = call(config, "--out", tmp_path / "out", "--set", assignment)
    assert result.exit_code == 2, result.output
    assert message in result.output
    assert not (tmp_path / "out").exists()


def test_resume_needs_results(tmp_path):
    result = call("--resume", tmp_path)
    assert result.exit_code == 2
    assert "must hold what `diffcloth train` wrote" in result.output
    (tmp_path / "resume.json").write_text("{}")
    assert (
        "resume.json is damaged, its content raises KeyError" in call("--resume", tmp_path).output
    )
    assert call().exit_code == 2
