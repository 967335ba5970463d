"""Actions from which learning begins: they move the sheet, tool or cube, in both frames."""

from __future__ import annotations

import pytest
import torch

from diffcloth_torch import envs

NAMES = tuple(envs.TASKS)
HANDS = ("LiftCloth", "GraspCloth", "HangCloth")
SHEETS = {"FoldCloth", "FoldClothDiagonal", "SpreadCloth", "DropCloth", "FlingCloth"}


def held(name, frame, steps=3):
    """Environments before and after the first action."""
    options = {"opens_at": -1.0, "reach": 0.1} if name in SHEETS else {}
    env = envs.make(name, 2, size=4, frame=frame, **options)
    env.reset(seed=0)
    before = env.env_state
    action = torch.tensor(env.task.first_action).expand(2, -1).clone().requires_grad_()
    total = 0.0
    for _ in range(steps):
        total = total + env.step(action)[1].sum()
    (slope,) = torch.autograd.grad(total, action)
    return before, env.env_state, slope


@pytest.mark.parametrize("name", NAMES)
def test_first_actions_are_inside_of_the_range(name):
    task = envs.TASKS[name](size=4)
    assert len(task.first_action) == task.action_size
    assert all(-1 < value < 1 for value in task.first_action)


@pytest.mark.parametrize("name", ["FoldCloth", "LiftCloth", "TwoCloths"])
def test_rewards_have_gradients_there(name):
    _, _, slope = held(name, "task")
    assert bool((slope.abs().amax(dim=1) > 0).all())


@pytest.mark.parametrize("frame", envs.env.FRAMES)
def test_a_sheet_that_pushes_keeps_its_height(frame):
    before, after, _ = held("PushCube", frame, steps=1)
    pins = [4 * 3, 4 * 4 - 1]  # the upper corners
    moved = (after.state.positions - before.state.positions)[:, pins]
    assert bool((moved[..., :2].norm(dim=-1) > 0.001).all())
    assert bool((moved[..., 2].abs() < 1e-9).all())


@pytest.mark.parametrize("frame", envs.env.FRAMES)
@pytest.mark.parametrize("name", ["FoldCloth", "LiftCloth", "PushCube"])
def test_tools_rise_or_come_nearer(name, frame):
    before, after, _ = held(name, frame)
    if name == "FoldCloth":
        assert bool((after.tools["points"] > before.tools["points"] + 0.01)[..., 2].all())
        assert torch.equal(after.tools["held"], before.drawn["picked"])
    elif name == "LiftCloth":
        rise = (after.state.base_poses - before.state.base_poses)[:, 0, :3]
        assert bool((rise[:, 2] > 0.003).all())
        assert bool((rise[:, :2].abs() < 1e-9).all())
    else:
        cube = before.state.body_poses[:, :1, :2]
        away = [
            (env.state.positions[..., :2] - cube).norm(dim=-1).amin(dim=1)
            for env in (before, after)
        ]
        assert bool((away[1] < away[0] - 0.005).all())
