"""The recipe of docs/tasks.md, followed as by a user, yields a working task and configuration."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from diffcloth_torch.cli import main
from diffcloth_torch.tasks.registry import TASKS

PAGE = Path(__file__).parents[2] / "docs" / "tasks.md"


@pytest.fixture
def recipe(tmp_path, monkeypatch):
    """The module and the configuration of the recipe as files; the task is registered."""
    text = PAGE.read_text().partition("## A task of your own")[2]
    (module,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (config,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    (tmp_path / "blow.py").write_text(module)
    (tmp_path / "blow.yaml").write_text(config)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(TASKS, "blow", importlib.import_module("blow").Blow)
    monkeypatch.chdir(tmp_path)
    return CliRunner()


def test_the_recipe_of_a_task_is_optimized_by_the_command_line(recipe):
    result = recipe.invoke(main, ["optimize", "blow.yaml"])
    assert result.exit_code == 0, result.output
    metrics = json.loads(Path("results/blow/metrics.json").read_text())
    assert metrics["best_loss"] < 0.1 * metrics["losses"][0]


def test_the_recipe_of_a_task_runs_and_refuses_unknown_keys(recipe):
    assert recipe.invoke(main, ["run", "blow.yaml"]).exit_code == 0
    refused = recipe.invoke(main, ["run", "blow.yaml", "--set", "distanc=1", "--out", "x"])
    assert refused.exit_code == 2
    assert "has no key `distanc` (did you mean `distance`?)" in refused.stderr
