"""The examples run as a reader would run them, and reach their stated results."""

from __future__ import annotations

import math
import os
import re
import runpy
import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from public_data import public

import diffcloth_torch as dc

ROOT = Path(__file__).resolve().parents[1]

# The barrier must not throw the cloth in start states.
pytestmark = pytest.mark.filterwarnings(
    "error::diffcloth_torch.BarrierStartWarning", "error:Cloth.grid:FutureWarning"
)


@pytest.fixture
def own_mesh(tmp_path):
    """File of an unstructured sheet, tilted so that one side lands first."""
    grid = dc.Cloth.grid((8, 7), (0.3, 0.35))
    x, y = grid.vertices[:, 0], grid.vertices[:, 1]
    jitter = np.random.default_rng(0).uniform(-0.008, 0.008, grid.vertices.shape)
    vertices = np.stack([x, y, 0.02 * x + 0.01 * np.sin(9 * y)], axis=-1) + jitter
    lines = [f"v {a:.9f} {b:.9f} {c:.9f}\n" for a, b, c in vertices]
    lines += [f"f {a} {b} {c}\n" for a, b, c in grid.faces + 1]
    path = tmp_path / "shirt.obj"
    path.write_text("".join(lines))
    return path


def example_of_the_readme():
    """The longest Python block of the README."""
    return max(
        re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL), key=len
    )


def check_throw(names):
    """In contact, farther with a faster throw, less far with more friction."""
    assert names["end"].report.contact_count > 0
    assert 0 < names["loss"].item() < 20 * 0.01 * 0.5  # less than without friction [m]
    gradient = [*names["throw"].grad.tolist(), names["friction"].grad.item()]
    assert all(map(math.isfinite, gradient))
    assert gradient[0] > 0.01
    assert gradient[-1] < -0.01


def test_a_picker_folds_a_sheet():
    distances = runpy.run_path(str(ROOT / "examples/pick_and_place.py"))["distances"]
    assert distances[0] > 0.05
    assert distances[-1] < 0.2 * distances[0]


def test_a_finger_feels_a_pen_through_a_cloth(tmp_path, monkeypatch, capsys):
    path = tmp_path / "image.png"
    monkeypatch.setattr(sys, "argv", ["tactile_image.py", str(path)])
    names = runpy.run_path(str(ROOT / "examples/tactile_image.py"), run_name="__main__")
    image, force = names["image"].numpy(), float(names["pressing"].normal_forces.sum())
    # At rest, the drive's effort is the pressing force; little of it is beyond the pad.
    assert force == pytest.approx(names["EFFORT"], rel=0.1)
    assert image.sum() * names["PIXEL"] ** 2 == pytest.approx(force, rel=0.2)
    # The points of highest pressure, row by row, form a line with the slope of the pen.
    rows = image.max(axis=1) > 0.3 * image.max()
    z, x = np.flatnonzero(rows), image.argmax(axis=1)[rows]
    assert len(z) > 20
    degrees = np.degrees(np.arctan(np.polyfit(z, x, 1)[0]))
    assert abs(degrees) == pytest.approx(25, abs=5)
    assert path.stat().st_size > 100
    assert f"press with {force:.2f} N" in capsys.readouterr().out


def test_a_motor_lifts_within_its_limits(capsys):
    names = runpy.run_path(str(ROOT / "examples/joint_limits.py"))
    angles, state = names["angles"][-1], names["state"].detach()
    assert (angles[:3] > 0.9).all()
    assert names["fastest"][1] < 1.01  # of the slow one
    assert names["fastest"][0] > 3.9
    # The weak arm hangs at the angle at which the moment of its weight, W cos q, is at its limit.
    assert float(state.joint_efforts[3]) == pytest.approx(0.5, abs=2e-3)
    slope = 1.0 / (0.5 * math.tan(-float(angles[3])))
    assert float(names["limits"].grad[3]) == pytest.approx(slope, rel=0.1)
    assert "with friction" in capsys.readouterr().out


@pytest.mark.slow
def test_a_figure_walks_under_a_sheet(capsys):
    names = runpy.run_path(str(ROOT / "examples/walker.py"))
    states, simulator = names["states"], names["simulator"]
    figure = states[-1].positions[simulator.slices["walker"]]
    # The draped sheet has moved with the figure, and reaches below its trunk.
    assert names["mean"][0].item() == pytest.approx(figure[:, 0].mean().item(), abs=0.02)
    assert names["mean"][0] > 0.4
    assert names["cloth"][:, 2].min() < 0.43
    assert all(state.report.converged for state in states)
    weight = float(simulator.vertex_masses().sum()) * 9.81
    forces = [state.report.contacts["walker", "sheet"].force[2] for state in states[40:]]
    assert float(sum(forces)) / len(forces) == pytest.approx(weight, rel=0.1)
    assert math.isfinite(names["stride"].grad.item())
    assert "N upwards" in capsys.readouterr().out


def test_own_mesh(own_mesh, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["own_mesh.py", str(own_mesh)])
    check_throw(runpy.run_path(str(ROOT / "examples/own_mesh.py")))
    assert "gradient: throw" in capsys.readouterr().out


def test_script_says_no_more_than_it_prints(own_mesh):
    """Objects of the core live until the end of a script; nanobind once reported leaks."""
    command = [sys.executable, str(ROOT / "examples/own_mesh.py"), str(own_mesh)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    result = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert result.stderr == ""


def test_example_of_the_readme(own_mesh, monkeypatch):
    code = example_of_the_readme()
    monkeypatch.chdir(own_mesh.parent)
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    check_throw(names)


@pytest.mark.slow
def test_example_of_the_readme_on_meshes_of_any_size():
    """Meshes of 30 cm to 70 m fall onto the floor, stay, and slide less with more friction."""
    code = example_of_the_readme()
    meshes = sorted(public("cloth").glob("*.obj"))
    assert len(meshes) >= 5
    for mesh in meshes:
        names = {}
        exec(compile(code.replace('"shirt.obj"', repr(str(mesh))), "README.md", "exec"), names)
        assert names["end"].report.contact_count > 0, mesh
        assert 0 < names["loss"].item() < 20 * 0.01 * 0.5, mesh
        assert names["throw"].grad[0] > 0.01, mesh
        assert names["friction"].grad < -1e-4, mesh
        # The barrier does not push the cloth away.
        assert names["end"].velocities[:, 2].mean() < 0.01, mesh


def test_example_of_the_readme_is_the_script():
    code = example_of_the_readme()
    script = (ROOT / "examples/own_mesh.py").read_text()
    body = script[script.index("import sys") :].replace("import sys\n\n", "")
    assert body.replace("sys.argv[1]", '"shirt.obj"') == code


@pytest.mark.rounding
def test_optimize_push(capsys):
    names = runpy.run_path(str(ROOT / "examples/optimize_push.py"))
    assert abs(names["error"].item()) < 1e-3  # [m], from 44 mm
    assert capsys.readouterr().out.count("speed") == 8


@pytest.mark.rounding
def test_fit_friction():
    names = runpy.run_path(str(ROOT / "examples/fit_friction.py"))
    # The value of the data, up to the error of the time step; the first guess is 0.1.
    assert names["friction"] == pytest.approx(names["FRICTION"], rel=0.1)
    assert names["found"].best.loss < 1e-3 * names["found"].first.loss


@pytest.mark.slow
@pytest.mark.rounding
def test_fit_foreign():
    """Drag, speed and delay of a foreign simulator; the time step alone moves them farther."""
    names = runpy.run_path(str(ROOT / "examples/fit_foreign.py"), run_name="__main__")
    found, truth = names["limit"], names["truth"]
    assert found["speed"] == pytest.approx(truth.speed, rel=0.04)
    assert found["delay"] == pytest.approx(truth.delay, abs=1e-3)
    assert found["normal_drag"] == pytest.approx(truth.normal_drag, rel=0.04)
    assert names["fit"].rms < 1.2
    assert names["fit"].held_out[0] < 2.0


@pytest.mark.rounding
def test_optimize_batch():
    found = runpy.run_path(str(ROOT / "examples/optimize_batch.py"))["found"]
    assert found.best_losses.max() < 5e-3  # [m], each from its own guess
    first = found.history[0]["environment_losses"]
    assert min(first) > 0.03


@pytest.fixture
def plan_grasp():
    try:
        dc.robots.panda()
    except ImportError:
        pytest.skip("the Panda is in the extra `robots`")
    return ROOT / "examples/plan_grasp.py"


def test_gradients_flow_through_a_plan_and_its_motion(plan_grasp):
    names = runpy.run_path(str(plan_grasp))
    way = torch.tensor([0.0, 0.0, 0.03], dtype=torch.float64, requires_grad=True)
    states = names["carry_out"]({"way": way})
    names["distance"](states).backward()
    assert states[-1].positions[:, 2].max() > 0.64  # lifted
    direction = torch.tensor([0.5, 0.7, -0.5], dtype=torch.float64)
    losses = []
    for step in (1e-5, -1e-5):
        with torch.no_grad():
            moved = names["carry_out"]({"way": way.detach() + step * direction})
            losses.append(names["distance"](moved).item())
    difference = (losses[0] - losses[1]) / 2e-5
    assert abs(difference) > 0.05
    assert (way.grad @ direction).item() == pytest.approx(difference, rel=1e-4)


@pytest.mark.slow
def test_plan_grasp(plan_grasp, capsys):
    losses = runpy.run_path(str(plan_grasp), run_name="__main__")["found"].metrics()["losses"]
    assert min(losses) < 0.5 * losses[0]
    assert capsys.readouterr().out.count("mm from the goal") == len(losses)


@pytest.mark.filterwarnings("ignore:.*dropped .* faces")
@pytest.mark.quick("allegro")
@pytest.mark.parametrize("name", ["allegro", "panda", "ur5", "tiago", "talos"])
def test_a_cloth_falls_on_public_robots(name):
    names = runpy.run_path(str(ROOT / "examples/public_robots.py"))
    assert name in names["ROBOTS"]
    pose = names["ROBOTS"][name]
    try:
        names["find"](pose.file)
    except PackageNotFoundError:
        pytest.skip("the robots are in the extra `robots`")
    _, states = names["simulate"](pose, cells=8)
    moved = states[-1].joint_positions - states[0].joint_positions
    assert moved.abs().max().item() == pytest.approx(max(pose.move.values()))
    assert states[-1].report.contact_count > 0


def test_drape_own_mesh(own_mesh, tmp_path):
    body, out = tmp_path / "ball.obj", tmp_path / "draped.obj"
    # The sheet hangs lowest at its corners, 2 cm at most: the ball below is clear of the sheet.
    ball = dc.RigidBody.sphere(0.1, subdivisions=2)
    lines = [f"v {a} {b} {c - 0.14}\n" for a, b, c in ball.vertices]
    lines += [f"f {a} {b} {c}\n" for a, b, c in ball.faces + 1]
    body.write_text("".join(lines))
    arguments = [str(own_mesh), str(body), "--height", "0.01", "--steps", "15", "--out", str(out)]
    main = runpy.run_path(str(ROOT / "examples/drape_own_mesh.py"), run_name="example")["main"]
    result = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    contacts = int(re.search(r"(\d+) contacts", result.output)[1])
    assert contacts > 0
    assert len(dc.Cloth.load(out).vertices) == 7 * 8
