"""Counts beyond memory or a day are refused by their names, before anything is allocated."""

from __future__ import annotations

from functools import partial

import pytest
from click.testing import CliRunner

from diffcloth_torch import envs
from diffcloth_torch.cli import main
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn import Trainer, TrainerOptions
from diffcloth_torch.memory import check_memory

RUN = """
task: drape
simulation: {dt: 0.01, steps: 3}
scene: {cloths: [{name: sheet, shape: {kind: grid, rows: 9, columns: 9}}]}
output: {viewers: []}
"""
TRAIN = """
task: train
environment: {name: FoldCloth, options: {size: 6, horizon: 5}}
trainer: {horizon: 2}
viewers: []
"""
FIT = """
task: identify
simulation: {dt: 0.02, steps: 1}
scene:
  cloths:
    - name: sheet
      shape: {kind: grid, rows: 2, columns: 2, size: 0.2}
      pins: {top: {vertices: [0, 1]}}
output: {viewers: []}
fit:
  variables: {stretch: {value: 4}}
  trajectories:
    - {name: fall, steps: [1], noise: 1e-3, synthetic: {values: {stretch: 10}}}
"""


@pytest.mark.parametrize(
    ("command", "assignment", "name"),
    [
        ("run", "simulation.steps=1e12", "`simulation.steps` must be a valid integer"),
        ("run", f"simulation.steps={10**12}", "`simulation.steps` must be less than or equal to"),
        ("run", f"simulation.steps={10**400}", "`simulation.steps` must be less than or equal to"),
        ("run", f"simulation.steps={10**8}", "`simulation.steps` must be at most"),
        ("run", f"scene.cloths.sheet.shape.rows={10**9}", "at most"),
        ("run", f"output.every={10**30}", "`output.every`"),
        ("fit", f"simulation.steps={10**8}", "`simulation.steps` must be at most"),
        ("fit", f"fit.starts={10**12}", "`fit.starts`"),
        ("fit", f"fit.workers={10**6}", "`fit.workers`"),
        ("fit", f"fit.seed={10**30}", "`fit.seed`"),
        ("fit", f"fit.max_evaluations={10**12}", "`fit.max_evaluations`"),
        ("fit", "fit.deadline=1e300", "`fit.deadline`"),
        ("train", f"num_envs={10**8}", "`num_envs` must be at most"),
        ("train", f"num_envs={10**400}", "`num_envs`"),
        ("train", f"episodes={10**8}", "`episodes` must be at most"),
        ("train", f"selection_episodes={10**7}", "`selection_episodes` must be"),
        ("train", f"report_episodes={10**7}", "`report_episodes` must be"),
        ("train", f"updates={10**8}", "`updates`"),
        ("train", f"evaluate_every={10**30}", "`evaluate_every`"),
        ("train", f"workers.count={10**6}", "`workers.count`"),
        ("train", f"workers.threads={10**6}", "`workers.threads`"),
        ("train", "trainer.hidden=[100000000]", "`hidden` and `critics` must be at most"),
        ("train", f"trainer.hidden=[{10**400}]", "`hidden[0]` must be at most"),
        ("train", "trainer={algorithm: sapo, critics: 1000000}", "`hidden` and `critics`"),
        ("train", f"trainer.horizon={10**7}", "`horizon` must be at most"),
        ("train", f"trainer.critic_epochs={10**9}", "`critic_epochs` must be at most"),
        ("train", "trainer.plan_knots=1000000000", "`plan_knots` must be at most"),
        ("train", f"environment.options.size={10**6}", "at most"),
        ("train", f"environment.options.horizon={10**30}", "`horizon` must be at most"),
    ],
)
def test_absurd_numbers_of_configurations(tmp_path, command, assignment, name):
    config = tmp_path / "config.yaml"
    config.write_text({"run": RUN, "fit": FIT, "train": TRAIN}[command])
    arguments = [command, str(config), "--out", str(tmp_path / "out"), "--set", assignment]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2, result.output
    assert len(result.stderr.strip().splitlines()) == 1
    assert name in result.stderr


def test_absurd_numbers_of_trainers():
    make = partial(envs.make, "FoldCloth", size=6, horizon=5)
    with pytest.raises(InvalidInput, match="Trainer: `num_envs` must be at most"):
        Trainer(make, TrainerOptions(horizon=2), num_envs=10**8, chunk=1)
    trainer = Trainer(make, TrainerOptions(horizon=2))
    with pytest.raises(InvalidInput, match=r"Trainer\.evaluate: `episodes` must be at most"):
        trainer.evaluate(10**8)


def test_memory_is_that_of_the_machine():
    assert check_memory("n", 1000, 1000, "a thing") == 1000
    with pytest.raises(InvalidInput, match="n must be at most 0, as a thing takes"):
        check_memory("n", 1, 1 << 60, "a thing")
