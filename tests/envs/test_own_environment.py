"""The recipe of docs/environments.md, followed as by a user, yields a working environment."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
import torch

import diffcloth_torch as dc

PAGE = Path(__file__).parents[2] / "docs" / "environments.md"


@pytest.fixture
def recipe(tmp_path, monkeypatch):
    """The class of the recipe, imported from a file."""
    text = PAGE.read_text().partition("## Write a task")[2].partition("\n## ")[0]
    (module,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (tmp_path / "lift_corner.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    return importlib.import_module("lift_corner").LiftCorner


def test_the_recipe_of_an_environment_has_a_name_rewards_and_gradients(recipe, monkeypatch):
    monkeypatch.setitem(dc.envs.TASKS, recipe.name, recipe)
    env = dc.envs.make("LiftCorner", num_envs=2, size=6, reach=0.06, opens_at=-1.0)
    env.reset(seed=0)
    close_and_rise = torch.tensor([[0.0, 0.0, 0.5, 1.0] * 2] * 2).requires_grad_()
    before = env.task.height(env.env_state)
    for _ in range(4):
        _, reward, _, _, _ = env.step(close_and_rise)
    after = env.task.height(env.env_state)
    assert (after > before + 0.01).all()
    assert reward.tolist() == pytest.approx((-(10 * after - 1).abs().tanh()).tolist(), abs=1e-7)
    (gradient,) = torch.autograd.grad(reward.sum(), close_and_rise)
    # Higher pickers, higher corner: the reward grows with the first picker's rise.
    assert (gradient[:, 2] > 0).all()
