"""Scripts of tasks: the paths of their pickers, and where the obstacles of their hands lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloth_torch import envs
from diffcloth_torch.envs.env import lengths
from diffcloth_torch.envs.sheets import at, follow
from diffcloth_torch.geometry.poses import transform

SMALL = 4


def begun(name, num_envs):
    env = envs.make(name, num_envs, size=SMALL)
    env.reset(seed=0)
    return env.task, env.env_state


def assert_held_at(task, state, elapsed, wanted):
    """After `elapsed` transitions the script holds closed pickers at points [2, 2, 3]."""
    there = replace(
        state,
        elapsed=torch.full((2,), elapsed),
        tools=state.tools | {"points": wanted},
    )
    moves, grasp = task.scripted(there).reshape(2, 2, 4).split([3, 1], dim=-1)
    torch.testing.assert_close(moves, torch.zeros_like(moves), rtol=0, atol=1e-9)
    assert bool((grasp == 1).all())


def test_a_path_reaches_each_of_its_points_in_time_and_stays_at_the_last():
    _, state = begun("FoldCloth", 6)
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(3, 6, 2, 3, generator=generator, dtype=torch.float64)
    state = replace(state, elapsed=torch.tensor([1, 2, 3, 5, 7, 20]))
    wanted, grasps = follow(state, [2, 4, 8], list(points), [-1.0, 1.0, 0.5])
    shares = torch.tensor(
        [[1, 0, 0], [0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5], [0, 0, 1], [0, 0, 1]],
        dtype=torch.float64,
    )
    expected = (shares.T[:, :, None, None] * points).sum(dim=0)
    torch.testing.assert_close(wanted, expected)
    assert grasps.tolist() == [[g, g] for g in (-1.0, 1.0, 1.0, 0.5, 0.5, 0.5)]


@pytest.mark.parametrize(("elapsed", "share"), [(3, 0.5), (10, 0.5), (14, 1.0), (16, 1.0)])
def test_the_script_of_a_drop_moves_level_until_the_edge_is_over_its_goal(elapsed, share):
    """It halts halfway, so that the sheet swings less."""
    task, state = begun("DropCloth", 2)
    edge, held = state.drawn["goal"][:, [0, 2]], state.drawn["start"][:, [3, 15]]
    wanted = held.clone()
    wanted[..., :2] += share * (edge - held)[..., :2]
    assert float(lengths(wanted - held).min()) > 0.005
    assert_held_at(task, state, elapsed, wanted)


def test_pleats_lie_across_the_way_of_the_pickers():
    """For both directions: lengths along the pleats are kept, and pickers begin at their edges."""
    task, state = begun("SpreadCloth", 2)
    drawn = {name: state.drawn[name] for name in ("turn", "steepness", "phase", "shift")}
    drawn = {name: value[:1].repeat(2, *[1] * (value.dim() - 1)) for name, value in drawn.items()}
    drawn["across"] = torch.tensor([0, 1])
    sheet = task.posed(task.shape(drawn), drawn).reshape(2, SMALL, SMALL, 3)
    along = task.along(replace(state, drawn=drawn))[:, 0]
    assert float((along[0] * along[1]).sum()) == pytest.approx(0, abs=1e-12)
    for row, axis in enumerate((1, 0)):  # of the vertices along x in the first axis
        pleated = sheet[row].movedim(axis, 0)
        widths = lengths(pleated[1:] - pleated[:-1])
        kept = lengths(pleated[:, 1:] - pleated[:, :-1])
        torch.testing.assert_close(kept, torch.full_like(kept, 0.1))
        assert float(widths.max()) < 0.1
        picked = sheet[row].reshape(-1, 3)[task.picked(drawn)[row]]
        way = picked[1] - picked[0]
        assert float(way @ along[row]) == pytest.approx(float(lengths(way[:2])))


@pytest.mark.parametrize(("elapsed", "share"), [(7, 0.0), (21, 1.0)])
def test_the_script_of_a_spread_pulls_raised_edges(elapsed, share):
    """Edges that are pulled along the table stay turned under the sheet."""
    task, state = begun("SpreadCloth", 2)
    held = at(state.drawn["start"], state.drawn["picked"])
    sides = task.along(state) * torch.tensor([[-0.15], [0.15]], dtype=torch.float64)
    wanted = held + share * (held.mean(dim=1, keepdim=True) + sides - held)
    wanted[..., 2] = 0.05
    assert_held_at(task, state, elapsed, wanted)


def test_the_script_of_a_fling_follows_corners_until_its_pickers_are_closed():
    task, state = begun("FlingCloth", 2)
    moved = state.state.positions + torch.tensor([0.01, 0.0, 0.0], dtype=torch.float64)
    there = replace(state, state=state.state.replace(positions=moved))
    for elapsed, follows in ((3, True), (8, True), (9, False), (20, False)):
        late = torch.full((2,), elapsed)
        plain, shifted = (task.scripted(replace(s, elapsed=late)) for s in (state, there))
        assert torch.equal(plain, shifted) != follows


def test_pegs_lie_across_the_way_of_the_hand():
    task, state = begun("HangCloth", 1)
    scene = task.simulator.scene
    for peg in task.obstacles:
        pose = state.state.body_poses[0, scene.body_names.index(peg.name)].numpy()
        lying = np.ptp(transform(peg.vertices, pose), axis=0)
        x, y, z = np.ptp(peg.vertices, axis=0)  # a capsule along z
        assert z > 1.5 * y
        np.testing.assert_allclose(lying, [x, z, y])
