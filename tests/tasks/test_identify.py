"""Fits of configurations: shipped ones recover known values, bad ones are refused."""

from __future__ import annotations

import importlib
import json
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import diffcloth_torch as dc
from diffcloth_torch.checkpoint import write_checkpoint
from diffcloth_torch.cli import main
from diffcloth_torch.tasks.registry import load_task, read_config

CONFIGS = Path(__file__).parents[2] / "configs"

# Short forms: fewer vertices and larger steps. Without noise, the remaining error is due to mesh
# and time step, and is at most this share of the true value.
SHORT = {
    "fit_cantilever": (
        [
            "simulation={dt: 0.01, steps: 20, contact: {self_contact: false}}",
            "scene.cloths.strip.shape.rows=11",
            "fit.trajectories.fall.steps=[5, 10, 15, 20]",
            "fit.trajectories.fall.synthetic.changes=[simulation.dt=0.005, simulation.steps=40, "
            "scene.cloths.strip.shape.rows=21, scene.cloths.strip.shape.columns=5]",
        ],
        {"bending": 0.07, "damping": 0.15},
    ),
    "fit_throw": (
        [
            "simulation={dt: 0.005, steps: 32, contact: {self_contact: false}}",
            "fit.trajectories.throw.steps=[8, 16, 24, 32]",
            "fit.trajectories.throw.synthetic.changes=[simulation.dt=0.0025, simulation.steps=64, "
            "scene.cloths.sheet.shape.rows=9, scene.cloths.sheet.shape.columns=33]",
        ],
        {"velocity": 0.01, "bending": 0.05, "damping": 0.1},
    ),
    "fit_drag": (
        [
            "simulation={dt: 0.004, steps: 40, contact: {self_contact: false}}",
            "fit.trajectories.throw.steps=[10, 20, 30, 40]",
            "fit.trajectories.throw.synthetic.changes=[simulation.dt=0.002, simulation.steps=80, "
            "scene.cloths.sheet.shape.rows=5, scene.cloths.sheet.shape.columns=17]",
        ],
        {"velocity": 0.02, "normal_drag": 0.1},
    ),
    "fit_hang": ([], {"stretch": 0.01, "stretch_weft": 0.01}),
    "fit_slope": (
        [
            "simulation.dt=0.005",
            "simulation.steps=76",
            "fit.trajectories.slide.steps=[30, 44, 60, 76]",
            "fit.trajectories.slide.synthetic.changes=[simulation.dt=0.0025, simulation.steps=152, "
            "scene.cloths.sheet.shape.rows=9, scene.cloths.sheet.shape.columns=9]",
        ],
        {"friction": 0.05},
    ),
    "fit_drape": (
        [
            "scene.cloths.disk.shape.edge_length=0.02",
            "fit.trajectories.shadow.synthetic.changes=[scene.cloths.disk.shape.edge_length=0.01]",
        ],
        {"bending": 0.1},
    ),
    "fit_drape_woven": (
        [
            "scene.cloths.disk.shape.edge_length=0.012",
            "fit.trajectories.shadow.synthetic.changes=[scene.cloths.disk.shape.edge_length=0.006]",
        ],
        {"bending": 0.12, "bending_weft": 0.12, "bending_twill": 0.12},
    ),
}


@pytest.mark.quick("fit_cantilever", "fit_hang")
@pytest.mark.rounding
@pytest.mark.parametrize("name", SHORT)
@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.CorrelatedResidualsWarning")
def test_known_values_are_found_on_a_coarser_mesh(name):
    changes, shares = SHORT[name]
    first = read_config(CONFIGS / f"{name}.yaml").fit.trajectories
    quiet = [f"fit.trajectories.{k}.noise=1e-6" for k in range(len(first))]
    task = load_task(CONFIGS / f"{name}.yaml", [*changes, *quiet, "fit.starts=1"])
    found = dc.fit(task.variables(), task.observed, **task.options())
    assert found.success
    for variable, true in first[0].synthetic.values.items():
        value = found.values[variable].numpy()
        assert np.linalg.norm(value - true) < shares[variable] * np.linalg.norm(true), variable


def test_a_drape_is_fitted_wherever_its_folds_are():
    """Observed folds rotated by any angle have the residuals of unrotated folds."""
    changes = ["scene.cloths.disk.shape.edge_length=0.02", "fit.trajectories.shadow.noise=1.0"]
    changes += ["fit.trajectories.shadow.synthetic.changes=[]", "fit.trajectories.0.directions=72"]
    task = load_task(CONFIGS / "fit_drape.yaml", changes)
    trajectory = task.observed.trajectories[0]
    states = trajectory.motion.simulate({"bending": torch.tensor(3e-4, dtype=torch.float64)})
    faces = trajectory.motion.task.scene.cloths[0].faces
    rim = states[0].positions.numpy()[: round(2 * np.pi * 0.15 / 0.02), :2]
    call = {"directions": 24, "faces": faces}
    for degrees in (0.0, 40.0, 77.0, 200.0):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        seen = rim @ np.array([[c, s], [-s, c]])
        found = dc.residuals.outline(states, [seen], turned=True, **call)
        fixed = dc.residuals.outline(states, [seen], **call)
        assert float(found.abs().max()) < 1e-3, degrees
        if degrees:
            assert float(fixed.abs().max()) > 3e-3
    mirrored = dc.residuals.outline(states, [rim * [1, -1]], turned=True, **call)
    assert float(mirrored.abs().max()) < 2e-3  # three equal folds are their own image


HANG = """
task: identify
simulation: {dt: 0.02, steps: 4}
scene:
  cloths:
    - name: sheet
      shape: {kind: grid, rows: 3, columns: 3, size: 0.2}
      pose: {axis: [1, 0, 0], degrees: 90}
      material: {stretch: 40, density: 0.3}
      pins: {top: {box: {lower: [-1, -1, 0.09], upper: [1, 1, 0.11]}}}
fit:
  variables: {stretch: {value: 20}}
  trajectories:
    - {name: rest, equilibrium: true, noise: 1e-3, synthetic: {values: {stretch: 40}}}
"""


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "hang.yaml"
    path.write_text(HANG)
    return path


def test_observations_can_be_sent_to_a_process(config):
    task = load_task(config)
    copy = pickle.loads(pickle.dumps(task.observed))
    given = dc.Parameters(stretch=torch.tensor(30.0, dtype=torch.float64))
    (name,) = task.observed(given)
    assert torch.equal(copy(given)[name], task.observed(given)[name])


def test_observations_of_a_file_are_those_of_the_file(config):
    seen = load_task(config).observed.trajectories[0].seen
    np.savez(config.with_name("seen.npz"), positions=seen)
    change = "fit.trajectories=[{name: rest, equilibrium: true, noise: 1e-3, file: seen.npz}]"
    task = load_task(config, [change])
    np.testing.assert_array_equal(task.observed.trajectories[0].seen, seen)
    found = dc.fit(task.variables(), task.observed)
    low, high = found.intervals["stretch"]
    assert low < 40 < high


FALL = [
    "fit.covariance=white",
    "simulation={dt: 0.01, steps: 16}",
    "scene.cloths.sheet.pins.top={vertices: [0, 1, 2]}",
    "scene.cloths.sheet.pose={}",
    "scene.cloths.sheet.material.normal_drag=2.0",
    "fit.variables={normal_drag: {value: 1.0}}",
    "fit.trajectories=[{name: fall, steps: [4, 8, 12, 16], noise: 1e-4, synthetic: "
    "{values: {normal_drag: 2.0}, changes: [simulation.dt=0.0005, simulation.steps=320]}}]",
]


@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
def test_the_bias_of_the_time_step_is_reported(config, tmp_path):
    sets = [word for change in FALL for word in ("--set", change)]
    out = tmp_path / "out"
    with pytest.warns(dc.StepBiasWarning, match="normal_drag"):
        ran = CliRunner().invoke(main, ["fit", str(config), *sets, "--out", str(out)])
    assert not ran.exception, ran.output
    assert "a time step of zero would move normal_drag by " in ran.output
    record = json.loads((out / "fit.json").read_text())
    (shift,) = record["step_bias"]["normal_drag"]
    low, high = record["intervals"]["normal_drag"]
    assert not low < 2.0 < high
    assert record["values"]["normal_drag"] + shift == pytest.approx(2.0, rel=0.05)


@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
def test_extrapolated_configurations_are_fitted_without_the_bias(config):
    task = load_task(config, [*FALL, "fit.extrapolate=true"])
    found = dc.fit(task.variables(), task.residuals(), **task.options())
    assert float(found.values["normal_drag"]) == pytest.approx(2.0, rel=0.05)
    exact = dc.fit({"normal_drag": dc.Variable(2.0)}, task.residuals()[-1].residuals)
    low, high = exact.intervals["normal_drag"]
    away = float(found.values["normal_drag"] - exact.values["normal_drag"])
    assert abs(away) < 0.1 * (high - low) / 2, "the rough tolerance of extrapolated stages"
    assert not task.checks_step
    assert load_task(config, FALL).checks_step
    assert not load_task(config, [*FALL, "fit.step_check=false"]).checks_step
    assert not load_task(config).checks_step, "an equilibrium has no time step"


@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
def test_the_second_order_step_has_less_bias_and_its_own_order(config):
    task = load_task(config, [*FALL, "simulation.integrator=second_order"])
    found = dc.fit(task.variables(), task.residuals(), **task.options())
    drag = float(found.values["normal_drag"])
    assert drag == pytest.approx(2.0, rel=0.04)
    with pytest.warns(dc.StepBiasWarning, match="normal_drag"):
        shift = found.step_bias(task.finer(task.observed), order=task.order)
    assert drag + float(shift["normal_drag"]) == pytest.approx(2.0, rel=0.01)
    assert task.order == 2.0
    assert load_task(config, FALL).order == 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["fit.extrapolate=true"], "must have a trajectory with `steps`"),
        ([*FALL, "fit.extrapolate=true", "fit.trajectories.fall.kind=outline"], "of the kind"),
    ],
)
def test_configurations_that_cannot_be_extrapolated_are_refused(config, changes, message):
    with pytest.raises(dc.InvalidInput, match=message):
        load_task(config, changes)


def test_an_outline_is_fitted(config):
    """The shadow of a sheet that sags between two held edges narrows by nothing but its stretch."""
    changes = [
        "scene.cloths.sheet.pose={}",
        "scene.cloths.sheet.pins.top={vertices: [1, 4, 7]}",
        "scene.cloths.sheet.material.bending=1e-3",
        "fit.variables={bending: {value: 5e-4}}",
        "fit.trajectories.rest.kind=outline",
        "fit.trajectories.rest.noise=1e-6",
        "fit.trajectories.rest.synthetic.values={bending: 1e-3}",
    ]
    task = load_task(config, changes)
    found = dc.fit(task.variables(), task.observed)
    assert float(found.values["bending"]) == pytest.approx(1e-3, rel=1e-3)


def test_a_velocity_is_that_of_free_fall(config):
    """With the correct start of a throw, positions are v t + g t^2 / 2 at every step."""
    changes = [
        "scene.cloths.sheet.pins={}",
        "fit.variables={velocity: {value: [1.0, 0.0, 2.0]}}",
        "fit.trajectories=[{name: a, steps: [1, 4], noise: 1.0, "
        "synthetic: {values: {velocity: [1.0, 0.0, 2.0]}}}]",
    ]
    task = load_task(config, changes)
    motion = task.observed.trajectories[0].motion
    states = motion.simulate({"velocity": torch.tensor([1.0, 0.0, 2.0], dtype=torch.float64)})
    for state in states:
        t = float(state.time)
        moved = (state.positions - task.initial_state().positions).numpy()
        np.testing.assert_allclose(moved[:, 0], t, atol=1e-9)
        np.testing.assert_allclose(moved[:, 2], 2 * t - 0.5 * 9.81 * t * t, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("fit.variables={drag: {value: 1}}", "may name velocity, stretch"),
        ("fit.variables.stretch.prior=[20]", "prior"),
        ("fit.method=adam", "least_squares"),
        ("fit.trajectories.rest.equilibrium=false", "must have `steps`, or `equilibrium: true`"),
        ("fit.trajectories.rest.hold_out=true", "a trajectory without `hold_out`"),
        ("fit.trajectories.rest.file=seen.npz", "exactly one of file, synthetic"),
        ("fit.trajectories.rest.synthetic.values={drag: 1}", "may name velocity"),
        (
            "fit.trajectories.rest.synthetic.changes=[scene.cloths.sheet.shape.rows=4]",
            "a vertex at each marker",
        ),
        (
            "fit.trajectories=[{name: a, steps: [5], noise: 1, synthetic: {values: {stretch: 1}}}]",
            "at most `simulation.steps`, 4, got 5",
        ),
        (
            "fit.trajectories=[{name: a, steps: [2, 1], noise: 1, synthetic: {values: {}}}]",
            "increasing `steps`",
        ),
        (
            "fit.trajectories=[{name: a, steps: [2], noise: 1, "
            "synthetic: {values: {stretch: 1}, changes: [simulation.dt=0.015]}}]",
            "must divide the time step",
        ),
    ],
)
def test_bad_configurations_are_refused(config, change, message):
    with pytest.raises(dc.InvalidInput, match=message):
        load_task(config, [change])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"places": np.zeros((1, 9, 3))}, "the array `positions`"),
        ({"positions": np.zeros((2, 9, 3))}, r"must have shape \[1, 9, 3\], got \[2, 9, 3\]"),
    ],
)
def test_bad_observations_are_refused(config, arrays, message):
    np.savez(config.with_name("seen.npz"), **arrays)
    change = "fit.trajectories=[{name: rest, equilibrium: true, noise: 1e-3, file: seen.npz}]"
    with pytest.raises(dc.InvalidInput, match=message):
        load_task(config, [change])


def test_the_command_writes_its_results_and_goes_on_with_the_same_bits(config, tmp_path):
    out = tmp_path / "out"
    result = CliRunner().invoke(main, ["fit", str(config), "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "stretch" in result.output
    assert (out / "fit.html").read_text().startswith("<!doctype html>")
    record = (out / "fit.json").read_text()
    low, high = json.loads(record)["intervals"]["stretch"]
    assert low < 40 < high
    evaluations = out / "evaluations/start_0.pt"
    saved = torch.load(evaluations, weights_only=True)
    assert len(saved["records"]) > 3
    cut = saved | {"records": saved["records"][:3]}
    write_checkpoint(evaluations, "fit", cut)  # as if interrupted
    result = CliRunner().invoke(main, ["fit", "--resume", str(out)])
    assert result.exit_code == 0, result.output
    assert (out / "fit.json").read_text() == record
    again = CliRunner().invoke(main, ["fit", str(config), "--out", str(out)])
    assert again.exit_code == 2
    assert "holds results already" in again.output


def test_the_command_refuses_other_tasks_and_folders(config, tmp_path):
    result = CliRunner().invoke(main, ["fit", str(CONFIGS / "drape.yaml")])
    assert result.exit_code == 2
    assert "`task` must be identify" in result.output
    result = CliRunner().invoke(main, ["fit", "--resume", str(tmp_path / "nothing")])
    assert result.exit_code == 2
    assert "must hold what `diffcloth fit` wrote" in result.output
    result = CliRunner().invoke(main, ["fit"])
    assert "Missing argument 'CONFIG'" in result.output


@pytest.mark.quick("option1-*")
@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ([], r"stretch +30 .* [01] of 1 \(\d+% to \d+%\); by the bias 9[45]%\n"),
        (["--places"], r"2 numbers, 2 trajectories\n1 of 1 starts end at the same place"),
        (["--compare"], r"tangents +\d+(.*\n)differences +\d+(.*\n)Adam +100(.*\n)CMA-ES +\d+"),
    ],
)
@pytest.mark.slow
def test_the_benchmark_runs(option, expected):
    if "--compare" in option:
        pytest.importorskip("cma")
    config = CONFIGS / "fit_hang.yaml"
    command = [sys.executable, "-m", "benchmarks.identification", *option, "--seeds", "1", config]
    result = subprocess.run(
        command, cwd=CONFIGS.parent, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    assert re.search(expected, result.stdout), result.stdout


def test_a_biased_share_is_the_count_of_random_intervals(monkeypatch):
    monkeypatch.syspath_prepend(CONFIGS.parent)
    identification = importlib.import_module("benchmarks.identification")
    biased_share, shares = identification.biased_share, identification.shares

    middles = np.random.default_rng(0).standard_normal(100_000)
    for bias in (0.0, -0.5, 1.96):
        counted = np.mean(np.abs(middles + bias) < 1.96)
        assert biased_share(bias, 1.96) == pytest.approx(counted, abs=5e-3)
    assert shares(36, 40) == "36 of 40 (76% to 97%)"
