"""Trainings and fits with worker processes whose main process is killed or interrupted."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest
from processes import PATIENCE, await_that, children, lives

TRAIN = """
task: train
environment:
  name: FoldCloth
  options: {size: 6, horizon: 5, opens_at: -1.0, reach: 0.06}
trainer: {horizon: 4}
num_envs: 2
chunk: 1
updates: 100000
evaluate_every: 100000
episodes: 1
workers: {kind: processes, count: 2}
viewers: []
"""
FIT = """
task: identify
simulation: {dt: 0.01, steps: 400}
scene:
  cloths:
    - name: sheet
      shape: {kind: grid, rows: 9, columns: 9, size: 0.2}
      pose: {axis: [1, 0, 0], degrees: 90}
      material: {stretch: 40, density: 0.3}
      pins: {top: {box: {lower: [-1, -1, 0.09], upper: [1, 1, 0.11]}}}
output: {viewers: []}
fit:
  variables: {stretch: {value: 20}, bending: {value: 1e-5}, damping: {value: 0.01}}
  starts: 4
  workers: 2
  trajectories:
    - {name: a, steps: [400], noise: 1e-3, synthetic: {values: {stretch: 40}}}
"""


def begun(command, tmp_path):
    """Start a main process; return it and its workers once all are computing."""
    config = tmp_path / "config.yaml"
    config.write_text({"train": TRAIN, "fit": FIT}[command])
    out = tmp_path / "out"
    arguments = [sys.executable, "-m", "diffcloth_torch", command, config, "--out", out]
    with (tmp_path / "output").open("w") as output:
        main = subprocess.Popen(arguments, stdout=output, stderr=output)
    written = "train.json" if command == "train" else "evaluations/start_1.pt"
    await_that(lambda: main.poll() is not None or (out / written).exists())
    await_that(lambda: main.poll() is not None or len(children(main.pid)) >= 2)
    assert main.poll() is None, (tmp_path / "output").read_text()
    return main, children(main.pid)


@pytest.mark.slow
@pytest.mark.parametrize("number", ["SIGTERM", "SIGKILL", "SIGHUP", "SIGSEGV"])
@pytest.mark.parametrize("command", ["train", "fit"])
def test_workers_end_with_a_killed_command(tmp_path, command, number):
    main, workers = begun(command, tmp_path)
    main.send_signal(signal.Signals[number])
    begin = time.monotonic()
    main.wait(PATIENCE)
    await_that(lambda: not any(map(lives, workers)))
    print(f"{command} {number}: {time.monotonic() - begin:.2f} s")


@pytest.mark.slow
@pytest.mark.parametrize("command", ["train", "fit"])
def test_an_interrupted_command_prints_how_to_resume(tmp_path, command):
    main, workers = begun(command, tmp_path)
    main.send_signal(signal.SIGINT)
    begin = time.monotonic()
    assert main.wait(PATIENCE) == 130
    print(f"{command}: {time.monotonic() - begin:.2f} s")
    assert not any(map(lives, workers))
    text = (tmp_path / "output").read_text()
    assert "Traceback" not in text
    assert f"go on with  diffcloth {command} --resume {tmp_path / 'out'}" in text
