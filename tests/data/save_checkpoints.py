"""Save one of each kind of file to go on from, with the version that is installed.

    python tests/data/save_checkpoints.py tests/data/checkpoints_0_1.tar.xz

wrote the archive with commit 1426a16, from an empty folder. It has folders of results of three
commands, each of which was interrupted; the policy of a task whose observations have changed since;
and a trajectory.
"""

import functools
import os
import sys
import tarfile
import tempfile
from pathlib import Path

import torch
from click.testing import CliRunner

import diffcloth_torch as dc
from diffcloth_torch import envs
from diffcloth_torch.cli import main as command
from diffcloth_torch.learn import Trainer, TrainerOptions
from diffcloth_torch.optimize.problem import Problem

TRAIN = """
task: train
environment: {name: TwoCloths, options: {size: 4, horizon: 2}}
trainer: {algorithm: apg, horizon: 1, hidden: [2], actor_rate: 0.004, deviation: 0.05}
num_envs: 1
updates: 2
evaluate_every: 1
episodes: 1
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
  max_evaluations: 4
  trajectories:
    - {name: fall, steps: [1], noise: 1e-3, synthetic: {values: {stretch: 10}}}
"""
OPTIMIZE = """
task: hit_cloth
simulation: {dt: 0.01, steps: 2, scheme: coupled}
scene:
  cloths:
    - name: sheet
      shape: {kind: grid, rows: 3, columns: 3, size: 1.0}
      pose: {position: [0, 0, 1.0], axis: [1, 0, 0], degrees: 90}
      material: {stretch: 550, bending: 1e-4, density: 0.124, damping: 0.002, friction: 0.4}
      pins: {top: {box: {lower: [-1, -0.01, 1.49], upper: [1, 0.01, 1.51]}}}
  bodies:
    - name: cuboid
      shape: {kind: box, size: [1.1, 0.04, 0.86]}
      motion: kinematic
      pose: {position: [0, -0.06, 0.9]}
      friction: 0.4
target:
  cloth: sheet
  pose: {position: [0, 0.5, 1.5], axis: [1, 0, 0], degrees: 180}
actions: {body: cuboid, interval: 1, linear: [[0, 1.5, 0.35]], angular: [[0.8, 0, 0]]}
loss: {steps: 1}
optimizer: {iterations: 2, learning_rates: {linear: 1.0, angular: 1.0}, momentum: 0.5}
output: {viewers: []}
"""


def interrupted(owner, name, calls):
    """Let a method raise KeyboardInterrupt in place of its last call."""
    method, count = getattr(owner, name), iter(range(calls))

    @functools.wraps(method)
    def call(*arguments, **options):
        if next(count, None) is None:
            raise KeyboardInterrupt
        return method(*arguments, **options)

    setattr(owner, name, call)


def run(name: str, config: str) -> None:
    """Run a command until it is interrupted; its results are in the folder `name`."""
    Path(f"{name}.yaml").write_text(config)
    result = CliRunner().invoke(command, [name, f"{name}.yaml", "--out", name])
    assert result.exit_code == 130, result.output


def write_policy(path: str) -> None:
    """The policy of a task whose observations have changed."""
    make = functools.partial(envs.make, "FoldCloth", size=4, horizon=2)
    Trainer(make, TrainerOptions("apg", horizon=1, hidden=(2,)), num_envs=1).save(path)


def write_trajectory(path: str) -> None:
    """Two states of a sheet that falls."""
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(3, 3, 0.1, name="sheet")]), 0.01)
    sim.rollout(sim.initial_state(), steps=2).save(path)


def main(archive: Path) -> None:
    """Write the archive."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        interrupted(Trainer, "update", 1)
        interrupted(Problem, "jacobian", 1)
        run("train", TRAIN)
        run("fit", FIT)
        from diffcloth_torch.optimize import descent

        interrupted(descent, "evaluate", 1)
        run("optimize", OPTIMIZE)
        write_policy("fold.pt")
        write_trajectory("trajectory.pt")
        with tarfile.open(archive, "w:xz") as files:
            for path in sorted(Path().rglob("*")):
                if path.is_file() and "events" not in path.parts and path.suffix != ".npz":
                    files.add(path)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
