"""The command line: what it writes, and how it ends."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import diffcloth_torch as dc
from diffcloth_torch.cli import main
from diffcloth_torch.sim.simulator import Simulator

CONFIGS = Path(__file__).parent.parent / "configs"

SHEET = """
task: drape
simulation: {dt: 0.01, steps: 3}
scene:
  cloths:
    - name: sheet
      shape: {kind: grid, rows: 4, columns: 4}
      pins: {corner: {vertices: [0]}}
output: {viewers: [meshes]}
"""

SMALL_HIT = [
    "--set=scene.cloths.sheet.shape={kind: grid, rows: 4, columns: 4}",
    "--set=simulation.steps=4",
    "--set=loss.steps=1",
    "--set=optimizer.iterations=2",
    "--set=output.viewers=[meshes]",
]


@pytest.fixture
def call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sheet.yaml").write_text(SHEET, encoding="utf-8")

    def run(*arguments):
        return CliRunner().invoke(main, [str(a) for a in arguments])

    return run


def test_run_writes_metrics_and_meshes(call, tmp_path):
    result = call("run", "sheet.yaml")
    assert result.exit_code == 0, result.output
    folder = tmp_path / "results" / "sheet"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["steps"] == metrics["converged_steps"] == 3
    assert [step["time"] for step in metrics["per_step"]] == pytest.approx([0.01, 0.02, 0.03])
    assert metrics["error"] is None
    assert metrics["config"]["simulation"]["steps"] == 3
    assert len(list((folder / "meshes").glob("*.obj"))) == 4


def test_set_and_out_are_used(call, tmp_path):
    result = call(
        "run", "sheet.yaml", "--set", "simulation.steps=5", "--set", "output.every=5", "--out", "x"
    )
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "x/metrics.json").read_text())["steps"] == 5
    assert len(list((tmp_path / "x/meshes").glob("*.obj"))) == 2


def test_optimize_writes_metrics_actions_and_a_curve(call, tmp_path):
    result = call("optimize", CONFIGS / "hit_cloth.yaml", *SMALL_HIT, "--out", "out")
    assert result.exit_code == 0, result.output
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert len(metrics["losses"]) == 2
    assert metrics["best_loss"] == min(metrics["losses"])
    assert len(metrics["per_step_of_best"]) == 4
    assert (tmp_path / "out/loss.png").stat().st_size > 1000
    saved = torch.load(tmp_path / "out/actions.pt")
    with np.load(tmp_path / "out/actions.npz") as arrays:
        for name in ("linear", "angular"):
            np.testing.assert_array_equal(saved["best"][name].numpy(), arrays[name])
    assert len(list((tmp_path / "out/meshes").glob("*.obj"))) == 5


def test_a_task_without_a_loss_cannot_be_optimized(call):
    result = call("optimize", "sheet.yaml")
    assert result.exit_code == 2
    assert "tasks that have are hit_cloth" in result.stderr


def one_sentence(result):
    assert "Traceback" not in result.output
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        pytest.param("simulation.stps=3", "no key `stps`", id="unknown-key"),
        pytest.param("simulation.dt=-1", "`simulation.dt` must be greater than 0", id="range"),
        pytest.param("scene.cloths.sheet.pins.corner.vertices=[99]", "99", id="in-the-package"),
        pytest.param("nonsense", "key=value", id="no-assignment"),
    ],
)
def test_bad_input_ends_with_2_and_one_sentence(call, assignment, message):
    result = call("run", "sheet.yaml", "--set", assignment)
    assert result.exit_code == 2
    assert message in one_sentence(result)


def test_a_missing_configuration_ends_with_2(call):
    result = call("run", "nowhere.yaml")
    assert result.exit_code == 2
    assert one_sentence(result) == "Error: nowhere.yaml: there is no such file"


def test_a_failed_simulation_ends_with_1_and_keeps_what_there_is(call, tmp_path, monkeypatch):
    real = Simulator.step
    taken = []

    def step(self, *args):
        if len(taken) == 2:
            raise dc.InfeasibleMotion("the bodies close on the cloth")
        taken.append(1)
        return real(self, *args)

    monkeypatch.setattr(Simulator, "step", step)
    result = call("run", "sheet.yaml", "--out", "out")
    assert result.exit_code == 1
    assert "close on the cloth (after step 2)" in one_sentence(result)
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["steps"] == 2
    assert metrics["error"] == "the bodies close on the cloth"
    assert len(list((tmp_path / "out/meshes").glob("*.obj"))) == 3


def test_debug_shows_the_error_itself(call):
    result = call("run", "nowhere.yaml", "--debug")
    assert isinstance(result.exception, dc.InvalidInput)


def test_info_names_what_was_built(call):
    result = call("info")
    assert result.exit_code == 0
    assert "drape, hit_cloth" in result.output
    for name in dc.build_info():
        assert f"core: {name}" in result.output


def test_the_module_runs_and_imports_nothing_heavy():
    code = (
        "import sys; import diffcloth_torch.cli; "
        "heavy = {'pyvista', 'matplotlib', 'trimesh', 'imageio'} & set(sys.modules); "
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    command = [sys.executable, "-m", "diffcloth_torch", "--help"]
    shown = subprocess.run(command, check=True, capture_output=True, text=True)
    assert shown.stdout.startswith("Usage: diffcloth ")
