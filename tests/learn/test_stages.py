"""Stages of `diffcloth train`: plans, imitation, updates; interruptions and messages."""

from __future__ import annotations

import functools
import json
import re
from dataclasses import replace

import pytest
import torch
from click.testing import CliRunner

from diffcloth_torch import envs
from diffcloth_torch.cli import main
from diffcloth_torch.cli import stages as stages_module
from diffcloth_torch.learn import evaluate, imitate, load_policy
from diffcloth_torch.learn.imitation import OPTIONS
from diffcloth_torch.learn.starts import purpose_seed

CONFIG = """
task: train
seed: 3
environment:
  name: FoldCloth
  options: {size: 5, horizon: 4, opens_at: -1.0, reach: 0.06}
trainer: {horizon: 4, hidden: [16], plan_knots: 3, held_out: 2}
stages: STAGES
num_envs: 2
evaluate_every: 2
episodes: 2
selection_episodes: 2
report_episodes: 3
viewers: []
"""
PLAN = "{kind: plan, episodes: 2, attempts: 1, knots: 3, iterations: 3}"
IMITATE = "{kind: imitate, rounds: 2, episodes: 2, iterations: 20}"
PLANS = "{kind: imitate, teacher: plans, rounds: 2, episodes: 2, iterations: 20}"
UPDATE = "{kind: apg, updates: 2}"
MAKE = functools.partial(envs.make, "FoldCloth", size=5, horizon=4, opens_at=-1.0, reach=0.06)


def call(*arguments):
    return CliRunner().invoke(main, ["train", *map(str, arguments)])


def configured(tmp_path, *stages):
    file = tmp_path / "stages.yaml"
    file.write_text(CONFIG.replace("STAGES", f"[{', '.join(stages)}]"))
    return file


def policy(folder):
    return torch.load(folder / "policy.pt", weights_only=True)["policy"]


def record_of(folder):
    return json.loads((folder / "train.json").read_text())


def test_a_policy_that_only_imitates_is_the_one_of_imitate(tmp_path):
    out = tmp_path / "out"
    result = call(configured(tmp_path, IMITATE), "--out", out, "--debug")
    assert result.exit_code == 0, result.output
    options = replace(OPTIONS, horizon=4, hidden=(16,), plan_knots=3, seed=3)
    expected = imitate(MAKE, "scripted", 2, 2, 3, iterations=20, options=options)
    kept = policy(out)
    for name, tensor in expected.actor.state_dict().items():
        assert torch.equal(kept[f"actor.{name}"], tensor), name
    record = record_of(out)
    assert [each["kind"] for each in record["stages"]] == ["imitate"]
    steps = 2 * 2 * 4  # rounds, episodes, transitions
    assert record["stages"][0]["steps"] == record["report"]["steps"] == steps
    assert f"{steps} environment steps, " in result.output
    fresh = evaluate(MAKE, load_policy(out / "policy.pt"), 3, purpose_seed(3, "report"))
    assert record["report"]["return"] == fresh.mean_return
    assert record["evaluations"][0]["updates"] == record["evaluations"][-1]["updates"] == 0


def test_updates_begin_at_the_policy_of_the_stages(tmp_path):
    alone, both = tmp_path / "alone", tmp_path / "both"
    assert call(configured(tmp_path, PLAN, PLANS), "--out", alone, "--debug").exit_code == 0
    assert call(configured(tmp_path, PLAN, PLANS, UPDATE), "--out", both, "--debug").exit_code == 0
    first, second = record_of(alone), record_of(both)
    assert first["evaluations"][0]["return"] == second["evaluations"][0]["return"]
    assert [e["updates"] for e in second["evaluations"]] == [0, 2]
    assert [each["kind"] for each in second["stages"]] == ["plan", "imitate"]
    assert "success" in second["stages"][0]
    steps = [each["steps"] for each in second["stages"]]
    assert second["report"]["steps"] == sum(steps) + 2 * 2 * 4  # updates, environments, transitions


def test_steps_of_workers_count(tmp_path):
    config = configured(tmp_path, PLAN, PLANS)
    alone, shared = tmp_path / "alone", tmp_path / "shared"
    assert call(config, "--out", alone, "--debug").exit_code == 0
    workers = "workers={kind: processes, count: 1}"
    assert call(config, "--out", shared, "--set", workers, "--debug").exit_code == 0
    steps = [[each["steps"] for each in record_of(out)["stages"]] for out in (alone, shared)]
    assert steps[0] == steps[1]
    assert steps[0][0] >= 4 * 4  # plans are improved three times


@pytest.mark.parametrize("at", [1, 2])
def test_an_interrupted_stage_begins_anew_with_the_same_bits(tmp_path, monkeypatch, at):
    config = configured(tmp_path, PLAN, PLANS, UPDATE)
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert call(config, "--out", whole, "--debug").exit_code == 0
    name = ("plan", "imitate")[at - 1]

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(stages_module, name, interrupted)
        assert call(config, "--out", out).exit_code == 130
    result = call("--resume", out, "--debug")
    assert result.exit_code == 0, result.output
    expected, found = policy(whole), policy(out)
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    assert (
        record_of(out)["evaluations"][-1]["return"] == record_of(whole)["evaluations"][-1]["return"]
    )


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ([PLAN], "must have one of the kind imitate"),
        ([PLANS], r"`stages\[0\]`: teacher plans needs a stage plan before"),
        ([UPDATE, IMITATE], r"`stages\[0\]`: apg must be the last stage"),
        (["{kind: ppo}", IMITATE], "must have as `kind` one of"),
        (["{kind: imitate, rounds: 0}"], r"rounds.* must be greater than or equal to 1"),
    ],
)
def test_stages_that_do_not_fit_are_refused(tmp_path, stages, message):
    result = call(configured(tmp_path, *stages), "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert re.search(message, result.output), result.output


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("trainer.seed=1", "`seed` and `trainer.seed` are the same"),
        ("updates=3", "the last stage has the algorithm and the updates"),
        ("trainer.algorithm=apg", "the last stage has the algorithm and the updates"),
        ("tryout={seeds: [0, 1], updates: 2}", "`tryout` and `stages` exclude each other"),
    ],
)
def test_keys_that_stages_replace_are_refused(tmp_path, assignment, message):
    config = configured(tmp_path, IMITATE)
    result = call(config, "--out", tmp_path / "out", "--set", assignment)
    assert result.exit_code == 2
    assert message in result.output
