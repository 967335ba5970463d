"""`diffcloth train`: results, going on after an interruption, and messages."""

from __future__ import annotations

import json

import pytest
import torch
from click.testing import CliRunner

from diffcloth_torch.cli import main
from diffcloth_torch.learn import Trainer

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
pictures: {video: none, size: [64, 64], sheet: 2}
"""


@pytest.fixture
def config(tmp_path):
    file = tmp_path / "short.yaml"
    file.write_text(SHORT)
    return file


def call(*arguments):
    return CliRunner().invoke(main, ["train", *map(str, arguments)])


def policy(folder):
    return torch.load(folder / "policy.pt", weights_only=True)


def test_results(config, tmp_path):
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
    a, b = policy(whole), policy(cut)
    assert a["counts"] == b["counts"] == [32, 4]
    for name, tensor in a["policy"].items():
        assert torch.equal(tensor, b["policy"][name]), name
    records = [json.loads((f / "train.json").read_text())["evaluations"] for f in (whole, cut)]
    assert [e["return"] for e in records[0]] == [e["return"] for e in records[1]]
    assert "nothing is left" in call("--resume", cut).output


def test_a_page_shows_all_episodes_of_the_evaluation(config, tmp_path):
    out = tmp_path / "out"
    result = call(config, "--out", out, "--viewer", "web", "--set", "updates=1")
    assert result.exit_code == 0, result.output
    assert (out / "evaluation.html").stat().st_size > 10_000
    assert not (out / "evaluation.png").exists()


def test_success_ends_it(config, tmp_path):
    result = call(config, "--out", tmp_path / "out", "--set", "until_success=0.0")
    assert result.exit_code == 0, result.output
    record = json.loads((tmp_path / "out" / "train.json").read_text())
    assert [e["updates"] for e in record["evaluations"]] == [0]


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("task=drape", "`task` must be train"),
        ("environment.name=Fold", "`task` must be one of"),
        ("environment.options.bend=1", "an option of FoldCloth must be one of"),
        ("trainer.speed=1", "`trainer` may have algorithm"),
        ("trainer.horizon=0", "`horizon` must be"),
        ("workers.kind=dask", "workers.kind"),
        ("workers.kind=ranks", "under torchrun"),
        ("updates=0", "updates"),
    ],
)
def test_bad_configurations(config, tmp_path, assignment, message):
    result = call(config, "--out", tmp_path / "out", "--set", assignment)
    assert result.exit_code == 2, result.output
    assert message in result.output
    assert not (tmp_path / "out").exists()


def test_resume_needs_results(tmp_path):
    result = call("--resume", tmp_path)
    assert result.exit_code == 2
    assert "must hold what `diffcloth train` wrote" in result.output
    (tmp_path / "resume.json").write_text("{}")
    assert "is not what `diffcloth train` wrote" in call("--resume", tmp_path).output
    assert call().exit_code == 2
