"""The benchmark runs, and its scenes are what their names say. No test judges a time."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Output and records of the quick form, in a process of its own: it sets torch's threads."""
    out = tmp_path_factory.mktemp("benchmarks") / "step.json"
    command = [sys.executable, "-m", "benchmarks.step", "--quick", "--json", str(out)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout, json.loads(out.read_text())


def test_every_scene_is_timed_alone_and_in_batches(quick):
    text, records = quick
    assert len(records["timings"]) == 5 * (2 + 2)
    for timing in records["timings"]:
        assert timing["scene"] in text
        for field in ("forward", "backward", "reference"):
            spread = timing[field]
            assert 0 < spread["lower"] <= spread["median"] <= spread["upper"]
        assert all(milliseconds >= 0 for milliseconds in timing["phases"].values())
        assert timing["forward_in_ef"] == pytest.approx(
            timing["forward"]["median"] / timing["reference"]["median"]
        )
        assert timing["iterations"] >= 1
        assert 0 <= timing["residual"] < 1e-6  # the default tolerance [m/s]


def test_scenes_are_in_their_regimes(quick):
    _, records = quick
    for timing in records["timings"]:
        share, contacts = timing["contact_share"], timing["contacts"]
        if timing["scene"] == "hanging":
            assert contacts == share == 0
        else:
            assert contacts > 0
            assert share > 0
        if timing["scene"] == "plane":
            assert share == 1


def test_threads_do_not_change_what_is_solved(quick):
    _, records = quick
    for scene in {timing["scene"] for timing in records["timings"]}:
        one, two = (t for t in records["timings"] if t["scene"] == scene and t["batch"] > 0)
        assert (one["threads"], two["threads"]) == (1, 2)
        for field in ("iterations", "residual", "contacts", "contact_share"):
            assert one[field] == two[field]


def test_summaries(quick):
    _, records = quick
    for summary in ("exponents", "batch_scaling"):
        assert len(records[summary]) == 5
        for row in records[summary].values():
            assert all(math.isfinite(number) for number in row.values())


def test_two_packages_are_compared_on_the_same_steps(tmp_path):
    out = tmp_path / "compare.json"
    command = [
        sys.executable,
        "-m",
        "benchmarks.compare",
        "--against",
        str(ROOT),
        "--json",
        str(out),
    ]
    command += ["--scene", "plane", "--size", "6", "--steps", "2"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    rows = json.loads(out.read_text())
    assert [(row["batch"], row["threads"]) for row in rows] == [(0, 1), (8, 1), (8, 2)]
    for row in rows:
        assert row["this"]["iterations"] == row["other"]["iterations"] >= 1
        for side in ("this", "other"):
            assert row[side]["forward"] > 0 < row[side]["backward"]
            assert row[side]["unconverged"] == 0


def test_a_folder_without_a_package_is_refused(tmp_path):
    command = [sys.executable, "-m", "benchmarks.compare", "--against", str(tmp_path)]
    command += ["--scene", "hanging", "--size", "6", "--no-batch"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert f"{tmp_path} has no diffcloth_torch" in result.stderr


def test_every_factorization_is_timed():
    command = [sys.executable, "-m", "benchmarks.factorization", "--quick"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    for name in ("hanging", "self-contact"):
        assert result.stdout.count(f"\n{name}, ") == 2
    for method in ("multifrontal (portable)", "eigen"):
        assert result.stdout.count(method) >= 4


def test_what_moves_by_forces_is_timed_beside_what_is_given():
    command = [sys.executable, "-m", "benchmarks.coupling", "--quick"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    rows = [line.split() for line in result.stdout.splitlines()]
    assert [row[0] for row in rows[1:]] == ["free", "gripper"]
    assert all(float(row[-1]) >= 1 for row in rows[1:])  # steps in contact


def test_the_baseline_is_timed_with_both_elastic_solvers():
    command = [sys.executable, "-m", "benchmarks.projective", "--quick"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    rows = [line.split() for line in result.stdout.splitlines()]
    assert [row[0] for row in rows[1:]] == 2 * ["newton", "projective"]
    assert all(int(row[2]) > 0 for row in rows[1:])  # vertices in contact
