"""Commands killed at random moments, once or twice, resume with the same bits."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import signal
import time

import numpy as np
import pytest
import torch
from processes import PATIENCE
from test_checkpoint import CONFIGS, SMALL_HIT

from diffcloth_torch.cli import main

TRAIN = """
task: train
environment:
  name: FoldCloth
  options: {size: 5, horizon: 4}
trainer: {horizon: 4, hidden: [8], critic_epochs: 1}
num_envs: 2
chunk: 1
updates: 4
evaluate_every: 1
episodes: 1
selection_episodes: 1
report_episodes: 1
viewers: []
"""
TRYOUT = "tryout: {seeds: [0, 1], updates: 2}\n"
# Each of the stages takes seconds, so that kills hit both.
STAGES = """
task: train
environment:
  name: FoldCloth
  options: {size: 5, horizon: 4, opens_at: -1.0, reach: 0.06}
stages:
  - {kind: imitate, rounds: 2, episodes: 2, iterations: 60}
  - {kind: apg, updates: 6}
trainer: {horizon: 4, hidden: [8], plan_knots: 3, held_out: 2, check_every: 2}
num_envs: 2
chunk: 1
evaluate_every: 1
episodes: 1
selection_episodes: 1
report_episodes: 1
viewers: []
"""
FIT = """
task: identify
simulation: {dt: 0.01, steps: 4}
scene:
  cloths:
    - name: sheet
      shape: {kind: grid, rows: 4, columns: 4, size: 0.2}
      pose: {axis: [1, 0, 0], degrees: 90}
      material: {stretch: 40, density: 0.3}
      pins: {top: {box: {lower: [-1, -1, 0.09], upper: [1, 1, 0.11]}}}
output: {viewers: []}
fit:
  variables: {stretch: {value: 20}}
  starts: 2
  trajectories:
    - {name: a, steps: [4], noise: 1e-3, synthetic: {values: {stretch: 40}}}
"""
RUN = """
task: drape
simulation: {dt: 0.01, steps: 12}
scene:
  cloths: [{name: sheet, shape: {kind: grid, rows: 6, columns: 6}, pins: {c: {vertices: [0]}}}]
output: {viewers: [meshes]}
"""
CASES = {
    "run": (RUN, []),
    "optimize": (None, [*SMALL_HIT, "--set=output.viewers=[]", "--set=optimizer.iterations=6"]),
    "fit": (FIT, []),
    "train": (TRAIN, []),
    "train with a tryout": (TRAIN + TRYOUT, []),
    "train with stages": (STAGES, []),
}
UNCERTAIN = (
    "seconds",
    "forward_seconds",
    "backward_seconds",
    "phase_seconds",
    "cpu_seconds",
    "minutes",
)


def called(arguments):
    """Run the command in a separate process with all imports preloaded."""
    torch.set_num_threads(1)
    with open(os.devnull, "w") as null:  # noqa: PTH123
        os.dup2(null.fileno(), 1)
        os.dup2(null.fileno(), 2)
        main(arguments)


@pytest.fixture(scope="module")
def context():
    """Processes that start in milliseconds, so that most of their time is the command's."""
    found = multiprocessing.get_context("forkserver")
    found.set_forkserver_preload(
        ["diffcloth_torch.cli.train", "diffcloth_torch.cli.fit", "diffcloth_torch.cli.optimize",
         "torchrl.objectives.value.functional", "torch.utils.tensorboard",
         "matplotlib.figure", "matplotlib.backends.backend_agg", "matplotlib.ticker",
         "scipy.optimize", "test_killed_runs"]
    )  # fmt: skip
    return found


def process(context, arguments):
    found = context.Process(target=called, args=([*map(str, arguments)],))
    found.start()
    return found


def without_times(value):
    if isinstance(value, dict):
        return {k: without_times(v) for k, v in value.items() if k not in UNCERTAIN}
    return [without_times(v) for v in value] if isinstance(value, list) else value


def bits(command, out):
    """Results that must not depend on interruptions."""
    if command == "train":
        kept = torch.load(out / "policy.pt", weights_only=True)
        numbers = [kept["policy"][name].numpy().tobytes() for name in sorted(kept["policy"])]
        record = json.loads((out / "train.json").read_text())
        names = ("evaluations", "tried", "starts", "stages", "best", "report")
        return numbers, without_times([record[name] for name in names])
    if command == "fit":
        return without_times(json.loads((out / "fit.json").read_text()))
    metrics = without_times(json.loads((out / "metrics.json").read_text()))
    metrics.pop("iterations_per_second", None)
    if command == "optimize":
        with np.load(out / "actions.npz") as arrays:
            return metrics, {name: arrays[name].tobytes() for name in arrays}
    return metrics, {f.name: f.read_bytes() for f in (out / "meshes").iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("number", ["SIGKILL", "SIGTERM", "SIGINT"])
@pytest.mark.parametrize("case", list(CASES))
def test_killed_commands_go_on_with_the_same_bits(context, tmp_path, case, number):
    text, changes = CASES[case]
    command = case.split()[0]
    config = CONFIGS / "hit_cloth.yaml"
    if text is not None:
        config = tmp_path / "config.yaml"
        config.write_text(text)
    begin = [command, config, *changes, "--overwrite", "--out"]
    process(context, [*begin, tmp_path / "first"]).join(PATIENCE)  # whatever is imported late
    start = time.monotonic()
    whole = process(context, [*begin, tmp_path / "whole"])
    whole.join(PATIENCE)
    seconds = time.monotonic() - start
    assert whole.exitcode == 0
    expected = bits(command, tmp_path / "whole")
    generator = random.Random(7)
    killed = []  # whether an evaluation was on disk, which follows the stages before updates
    for trial in range(10):
        out = tmp_path / f"out_{trial}"
        for _ in range(generator.choice([1, 2])):
            resumed = command != "run" and (out / "resume.pt").exists()
            last = [command, "--resume", out] if resumed else [*begin, out]
            running = process(context, last)
            time.sleep(generator.uniform(0, seconds))
            if running.is_alive():
                killed.append((out / "train.json").exists())
                os.kill(running.pid, signal.Signals[number])
            running.join(PATIENCE)
            assert running.exitcode is not None
        resumed = command != "run" and (out / "resume.pt").exists()
        last = process(context, [command, "--resume", out] if resumed else [*begin, out])
        last.join(PATIENCE)
        assert last.exitcode == 0
        assert bits(command, out) == expected
        assert not [f for f in out.rglob("*") if f.name.endswith((".part", ".lock"))]
    assert len(killed) >= 5
    if "stages" in case:
        assert {*killed} == {False, True}
    print(f"{case}, {number}: {len(killed)} killed, {sum(killed)} late, {seconds:.2f} s alone")
