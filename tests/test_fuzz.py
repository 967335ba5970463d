"""A few random scenes in the tests; `scripts/fuzz` runs more of them for as long as one likes."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("ipctk")

ROOT = Path(__file__).resolve().parents[1]


def fuzz(*arguments):
    command = [sys.executable, "tests/fuzz", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def numbers(text):
    """What does not depend on the clock."""
    return re.sub(r" in \d+ s", "", text)


def test_nothing_is_wrong_with_a_few_random_scenes():
    result = fuzz("--scenes", "4", "--seed", "1")
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.startswith("4 scenes, ")
    assert "intersection 0, path 0, report 0, momentum 0, not finite 0, error 0" in result.stdout


def test_a_scene_is_a_function_of_its_seed_and_index():
    first, again = (fuzz("--only", "2", "--seed", "1") for _ in range(2))
    assert numbers(first.stdout) == numbers(again.stdout)
    assert first.stdout.startswith("1 scenes, ")


def test_the_extent_of_a_run_must_be_given():
    result = fuzz()
    assert result.returncode == 2
    assert "--minutes, --scenes or --only" in result.stderr
