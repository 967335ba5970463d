"""Updates that move actions: gradients, moves, fits, drawn plans, and checkpoints."""

from __future__ import annotations

import copy
import functools
from dataclasses import replace

import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn import Trainer, TrainerOptions
from diffcloth_torch.learn.action_steps import fit_moved_actions, moved_actions
from diffcloth_torch.learn.rollouts import LAST_WEIGHT, roll_out
from diffcloth_torch.learn.trainer import record_of, restore

SOFT = {"opens_at": -1.0, "reach": 0.06}
HOLD = (0.0, 0.0, 0.1, 0.9, 0.0, 0.0, 0.1, 0.9)
OPTIONS = TrainerOptions(
    "apg", horizon=6, discount=1.0, hidden=(16,), first_action=HOLD, plan_knots=3, init_std=0.02,
    action_step=0.05,
)  # fmt: skip


def make(num_envs, **options):
    """Environments with a solver tolerance of 1e-10, for comparison with differences."""
    solver = dc.SolverOptions(throw=False, tolerance=1e-10)
    options = {"size": 5, "horizon": 6, "solver": solver, **SOFT, **options}
    return dc.envs.make("FoldCloth", num_envs=num_envs, **options)


def weights(trainer):
    return {name: t.detach().clone() for name, t in trainer.policy.state_dict().items()}


def assert_same_bits(a, b):
    for name, tensor in a.items():
        assert torch.equal(tensor, b[name]), name


def returns(start, actions, weight):
    """Sum of rewards [B], with an additional weight of the last five ones, of fixed actions."""
    env = make(actions.shape[1])
    env.resume(*start)
    total = torch.zeros(actions.shape[1])
    for t, each in enumerate(actions):
        reward = env.step(each)[1]
        total = total + (1.0 + weight * (t >= len(actions) - env.task.holds)) * reward
    return total


def test_slopes_agree_with_differences_of_weighted_returns():
    """An episode without success ends with the rollout: its last five rewards count four times."""
    trainer = Trainer(make, OPTIONS, num_envs=2)
    start = trainer._places[0]
    (piece,) = trainer._pieces(learns=True)
    rollout = roll_out(make(2), piece)
    assert not bool(rollout.success[-1].any())
    assert bool(rollout.ended[-1].all())
    with torch.no_grad():
        actions = torch.stack(
            [
                trainer.policy(seen, noise)
                for seen, noise in zip(rollout.seen, piece.noise, strict=True)
            ]
        ).double()
        toward = rollout.slopes.double()
        step = 1e-4 / toward.norm()
        ends = [
            returns(start, actions + side * step * toward, LAST_WEIGHT).double() for side in (1, -1)
        ]
    found = (ends[0] - ends[1]) / (2 * step)
    expected = toward.square().sum(dim=(0, 2))
    assert found.tolist() == pytest.approx(expected.tolist(), rel=0.02)


def test_rewards_of_a_successful_episode_have_equal_weights(monkeypatch):
    monkeypatch.setattr("diffcloth_torch.envs.env.Task.succeeded", lambda _, e: e.elapsed > 0)
    trainer = Trainer(make, OPTIONS, num_envs=1)
    (piece,) = trainer._pieces(learns=True)
    found = roll_out(make(1), piece)
    assert bool(found.success[-1].all())
    monkeypatch.setattr("diffcloth_torch.learn.rollouts.LAST_WEIGHT", 0.0)
    assert torch.equal(found.slopes, roll_out(make(1), piece).slopes)


def test_each_environment_moves_by_the_step_along_its_gradient():
    draws = torch.Generator().manual_seed(0)
    actions = 0.2 * torch.randn(7, 3, 4, generator=draws)
    slopes = torch.rand(7, 3, 4, generator=draws) * torch.tensor([1e-4, 0.0, 1e4])[:, None]
    moves = moved_actions(actions, slopes, 0.05, 0.3) - actions
    assert moves.square().mean(dim=(0, 2)).sqrt().tolist() == pytest.approx([0.05, 0.0, 0.05])
    along = (moves * slopes).sum(dim=(0, 2)) / slopes.norm(dim=(0, 2)).clamp(min=1e-30)
    assert along.tolist() == pytest.approx(moves.norm(dim=(0, 2)).tolist(), rel=1e-5)


def test_moved_actions_remain_within_their_range_and_near():
    """A gradient that concentrates on one number moves it by the largest move."""
    actions = torch.tensor([0.99, -0.99, 0.0, 0.0, 0.0, 0.0])[:, None, None]
    slopes = torch.tensor([1.0, 100.0, 0.0, 0.0, 0.0, 0.0])[:, None, None]
    moved = moved_actions(actions, slopes, 0.1, 0.2).flatten().tolist()
    assert moved == pytest.approx([0.99 + 0.1 * 6**0.5 / 10001**0.5, -0.99 + 0.2, 0, 0, 0, 0])
    assert float(moved_actions(actions, slopes.roll(-1, 0), 0.5, 0.2).max()) == pytest.approx(0.995)


def test_a_fit_moves_new_actions_and_retains_former_ones():
    """Without the former observations the same update changes their actions several times more."""
    trainer = Trainer(make, OPTIONS, num_envs=2)
    draws = torch.Generator().manual_seed(1)
    width = trainer.policy.observations
    seen, former = (torch.randn(6, 2, width, generator=draws) for _ in range(2))
    slopes = torch.randn(6, 2, 8, generator=draws)
    changes = []
    for retained in ([former.flatten(0, 1)], []):
        policy = copy.deepcopy(trainer.policy)
        optimizer = torch.optim.Adam(policy.actor.parameters(), lr=3e-4)
        with torch.no_grad():
            before = policy(former.flatten(0, 1))
        change = fit_moved_actions(policy, seen, slopes, retained, 0.05, 0.3, 200, optimizer, draws)
        assert 0.02 < change < 0.06
        with torch.no_grad():
            changes.append(float((policy(former.flatten(0, 1)) - before).square().mean().sqrt()))
    assert changes[0] < 0.5 * changes[1]


def test_an_update_moves_actions_along_the_gradients():
    trainer = Trainer(make, replace(OPTIONS, fit_iterations=50), num_envs=2)
    before, noise = copy.deepcopy(trainer.policy), trainer._noise.get_state()
    (piece,) = trainer._pieces(learns=True)
    rollout = roll_out(make(2), piece)
    trainer._noise.set_state(noise)
    log = trainer.update()
    before.scale.load_state_dict(trainer.policy.scale.state_dict())
    with torch.no_grad():
        moves = trainer.policy(rollout.seen.flatten(0, 1)) - before(rollout.seen.flatten(0, 1))
    assert float(moves.square().mean().sqrt()) == pytest.approx(log["change"], rel=1e-4)
    assert 0.01 < log["change"] < 0.06
    cosine = torch.nn.functional.cosine_similarity
    directions = rollout.slopes / rollout.slopes.norm(dim=(0, 2), keepdim=True)
    assert float(cosine(moves.flatten(), directions.flatten(), dim=0)) > 0.5
    assert torch.equal(trainer.policy.actor.log_deviation, before.actor.log_deviation)


def test_an_untouched_sheet_moves_no_actions():
    """Where all gradients are zero, the policy remains as it is."""
    options = replace(OPTIONS, first_action=(0.0, 0.0, 0.9, -0.9) * 2, init_std=1e-6)
    trainer = Trainer(functools.partial(make, opens_at=0.0, reach=0.001), options, num_envs=2)
    log = trainer.update()
    assert log["gradient_norm"] == 0.0
    assert log["change"] < 1e-6


@pytest.mark.parametrize("algorithm", ["apg", "shac"])
def test_a_training_that_is_loaded_goes_on_with_the_same_bits(tmp_path, algorithm):
    options = replace(OPTIONS, algorithm=algorithm, horizon=3, draws=2, decay_updates=4)
    one = Trainer(make, options, num_envs=4, chunk=2)
    one.update()
    one.update()
    assert one.steps == (2 + 2) * 3 * 4
    one.save(tmp_path / "trainer.pt")
    other = Trainer(make, options, num_envs=4, chunk=2)
    other.load(tmp_path / "trainer.pt")
    assert [one.update() for _ in range(2)] == [other.update() for _ in range(2)]
    assert_same_bits(weights(one), weights(other))


def test_updates_have_the_same_bits_for_any_workers():
    options = replace(OPTIONS, horizon=3, draws=2)
    one = Trainer(make, options, num_envs=2, chunk=1)
    other = Trainer(make, options, num_envs=2, chunk=1, workers=dc.learn.Processes(2))
    assert [one.update() for _ in range(2)] == [other.update() for _ in range(2)]
    assert_same_bits(weights(one), weights(other))
    other._workers.close()


@pytest.mark.parametrize("retained", [1, 3])
def test_a_file_needs_the_observations_of_the_last_rollouts(retained):
    options = replace(OPTIONS, horizon=2, retained_rollouts=retained)
    trainer = Trainer(make, options, num_envs=1)
    seen = []
    for _ in range(retained + 1):
        noise = trainer._noise.get_state()
        (piece,) = trainer._pieces(learns=True)
        seen.append(roll_out(make(1), piece).seen.flatten(0, 1))
        trainer._noise.set_state(noise)
        trainer.update()
    record = record_of(trainer)
    assert torch.equal(torch.stack(record["former"]), torch.stack(seen[-retained:]))
    record["former"].pop()
    before = weights(trainer)
    with pytest.raises(InvalidInput, match=rf"\['former'\] must be a list of {retained}"):
        restore(trainer, record)
    assert_same_bits(before, weights(trainer))


def test_training_begins_at_the_best_of_drawn_plans():
    trainer = Trainer(make, replace(OPTIONS, draws=6), num_envs=2)
    values = []
    rollouts = trainer._rollouts

    def watched(learns=True):
        found = rollouts(learns)
        if not learns:
            plan = trainer.policy.actor.plan.knots.detach().clone()
            values.append((float(found[0].rewards.mean()), plan))
        return found

    trainer._rollouts = watched
    trainer._draw_plan()
    assert len(values) == 6
    assert trainer.steps == 6 * 6 * 2
    best = max(values, key=lambda each: each[0])
    assert torch.equal(trainer.policy.actor.plan.knots, best[1])
    first = torch.tensor(HOLD).atanh().expand(3, -1)
    assert torch.equal(values[0][1], first)
    assert all(not torch.equal(plan, first) for _, plan in values[1:])


def test_a_failure_while_plans_are_drawn_changes_nothing(tmp_path):
    trainer = Trainer(make, replace(OPTIONS, draws=3), num_envs=2)
    before, rollouts = weights(trainer), trainer._rollouts
    calls = []

    def failing(learns=True):
        calls.append(learns)
        if len(calls) in (2, 6):
            raise RuntimeError("killed")
        return rollouts(learns)

    trainer._rollouts = failing
    with pytest.raises(RuntimeError, match="killed"):
        trainer.update()
    assert_same_bits(before, weights(trainer))
    assert trainer.steps == 0
    with pytest.raises(RuntimeError, match="killed"):  # after all draws
        trainer.update()
    drawn = weights(trainer)
    trainer.save(tmp_path / "trainer.pt")
    other = Trainer(make, replace(OPTIONS, draws=3), num_envs=2)
    other.load(tmp_path / "trainer.pt")
    assert_same_bits(drawn, weights(other))
    trainer.update()
    assert trainer.steps == (3 + 1) * 6 * 2
    assert calls == [False] * 5 + [True] * 2


def test_fine_tuning_bounds_the_change_of_actions():
    begun = Trainer(make, OPTIONS, num_envs=2)
    begun.update()
    options = replace(OPTIONS, action_step=0.2, held_out=0, max_change=0.01)
    trainer = Trainer(make, options, num_envs=2, init=begun.policy)
    scale = trainer.policy.scale.mean.clone()
    log = trainer.update()
    assert log["change"] <= 0.01 * (1 + 1e-6)
    assert log["step_share"] < 1
    assert torch.equal(trainer.policy.scale.mean, scale)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"action_step": 0.0}, r"`action_step` must be in \(0, 1\], got 0.0"),
        ({"action_step": 0.1, "feedback": True}, "must be None with `feedback` and with the"),
        ({"action_step": 0.1, "algorithm": "sapo"}, "must be None with `feedback` and with the"),
        ({"max_move": 0.0}, "`max_move` must be positive"),
        ({"fit_iterations": 0}, "`fit_iterations` must be"),
        ({"draws": -1}, "`draws` must be"),
        ({"draws": 4, "plan_knots": 0}, "`draws` must be 0 without `plan_knots`, got 4"),
    ],
)
def test_bad_options_are_refused(changed, message):
    with pytest.raises(InvalidInput, match=message):
        replace(OPTIONS, **changed)
