"""Plans by gradients: iterates, scales of gradients, workers, files and refusals."""

from __future__ import annotations

import functools
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from public_calls import Inline

from diffcloth_torch import envs
from diffcloth_torch.checkpoint import write_checkpoint
from diffcloth_torch.envs import env as env_module
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.learn import Jobs, Plans, Processes, plan
from diffcloth_torch.learn import plans as plans_module
from diffcloth_torch.learn.plans import Improved, hats, improve, knots_of

SOFT = {"opens_at": -1.0, "reach": 0.06}
MAKE = functools.partial(envs.make, "FoldCloth", size=5, horizon=5, **SOFT)
FEW = {"episodes": 3, "attempts": 2, "knots": 3, "iterations": 3, "seed": 4}
FIELDS = ("actions", "returns", "success", "seeds")


@pytest.fixture(scope="module")
def found():
    return plan(MAKE, **FEW)


def assert_same(a, b):
    for name in FIELDS:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def followed(make, plans):
    """Replay plans by the interface of gymnasium; return returns and successes."""
    env = make(num_envs=len(plans), autoreset_mode="Disabled")
    env.reset(seed=plans.seeds.tolist())
    total = torch.zeros(len(plans))
    for k in range(env.task.horizon):
        _, reward, _, _, info = env.step(plans.actions[:, k])
        total += reward
    return total, info["success"]


def begun(count=2):
    env = MAKE(num_envs=count)
    env.reset(seed=list(range(count)))
    first = torch.tensor(env.task.first_action, dtype=torch.float64).atanh()
    return env, env.env_state.detach(), first.repeat(count, 3, 1)


def improved_of(knots):
    """Iterates whose knots, actions and returns are these numbers; above -1 they succeed."""
    each = knots.reshape(-1, 1, 1)
    return Improved(each, each, knots.reshape(-1), knots.reshape(-1) > -1)


class Counted:
    """Environments that observe the number of the start."""

    def reset(self, seed):
        return torch.tensor([[float(seed[0])]]), {}


def searching(count):
    """A search for starts 7, 8, .. without simulations, and its stages: seeds, knots, updates.

    Updates change nothing. Plans of the start `search.stubborn` never succeed.
    """
    stages = []

    def stage(pieces):
        stages.append([(p.seeds, p.knots.flatten().tolist(), p.iterations) for p in pieces])
        found = improved_of(torch.cat([piece.knots for piece in pieces]))
        seeds = [seed for piece in pieces for seed in piece.seeds]
        fails = torch.tensor([seed == getattr(search, "stubborn", None) for seed in seeds])
        return Improved(found.knots, found.actions, found.returns, found.success & ~fails)

    seeds = list(range(7, 7 + count))
    search = plans_module._Search(stage, lambda *_: Counted(), seeds, 6, None)
    return search, stages


class TestPlan:
    def test_a_plan_replays_in_environments(self, found):
        assert len(found) == 3
        assert found.actions.shape == (3, 5, 8)
        returns, success = followed(MAKE, found)
        torch.testing.assert_close(returns, found.returns.float(), atol=1e-5, rtol=0)
        assert torch.equal(success, found.success)
        assert len(set(found.seeds.tolist())) == 3

    def test_a_plan_has_the_same_bits_from_pickled_pieces(self, found):
        assert_same(plan(MAKE, workers=Jobs(Inline()), **FEW), found)

    @pytest.mark.slow
    def test_a_plan_has_the_same_bits_in_processes(self, found):
        workers = Processes(2)
        try:
            assert_same(plan(MAKE, workers=workers, **FEW), found)
        finally:
            workers.close()

    def test_a_plan_has_the_same_bits_for_any_threads_and_draws(self, found):
        before = torch.get_num_threads()
        torch.set_num_threads(2)
        torch.manual_seed(5)
        drawn = torch.random.get_rng_state()
        try:
            assert_same(plan(MAKE, **FEW), found)
            assert torch.get_num_threads() == 2
        finally:
            torch.set_num_threads(before)
        assert torch.equal(torch.random.get_rng_state(), drawn)

    def test_another_seed_has_other_starts(self, found):
        other = plan(MAKE, **(FEW | {"seed": 5, "iterations": 1, "attempts": 1}))
        assert not set(other.seeds.tolist()) & set(found.seeds.tolist())

    def test_planning_begins_on_a_coarser_sheet(self, monkeypatch):
        sizes = []

        def make(num_envs, size=5):
            sizes.append(size)
            return MAKE(num_envs=num_envs, size=size)

        plans = plan(make, coarse=4, **FEW)
        assert set(sizes) == {4, 5}
        returns, _ = followed(MAKE, plans)
        torch.testing.assert_close(returns, plans.returns.float(), atol=1e-5, rtol=0)

    def test_attempts_begin_with_the_best_draw(self):
        """Returns are the first knots: attempt 0 continues from draw 1, attempt 1 from draw 0."""
        search, stages = searching(2)
        drawn = torch.tensor([[-1.0, 2.0], [1.0, -2.0]], dtype=torch.float64)[:, :, None, None]
        found = search.attempts(drawn)
        replays, improved = stages
        assert replays == [([7, 7, 8, 8], [-1.0, 2.0, 1.0, -2.0], 0)]
        assert improved == [([7, 8], [2.0, 1.0], 6)]
        assert found.knots.flatten().tolist() == [2.0, 1.0]

    def test_a_start_without_success_continues_from_near_plans_and_a_linear_function(self):
        """Starts observe 0, 1, .. 5, where knots of .0, .1, .. .5 succeed; start 3 has none."""
        search, stages = searching(6)
        knots = 0.1 * torch.arange(6.0, dtype=torch.float64)
        knots[3] = -2.0
        found = search.solved_from(improved_of(knots))
        (again, _, last, _) = stages
        pairs = [pair for seeds, each, _ in again for pair in zip(seeds, each, strict=True)]
        tried = [knot for seed, knot in pairs if seed == 10]
        assert tried[0] == -2.0
        assert sorted(tried[1:4]) == pytest.approx([0.1, 0.2, 0.4])
        assert tried[4] == pytest.approx(0.3, abs=0.03)  # the ridge penalty is small
        assert found.success.all()
        assert sum(len(piece[0]) for piece in last) == 6 * 5

    def test_starts_with_success_are_searched_again_only_at_last(self, monkeypatch):
        monkeypatch.setattr(plans_module, "_ROUNDS", 3)
        search, stages = searching(3)
        knots = torch.tensor([1.0, -5.0, 2.0], dtype=torch.float64)
        search.stubborn = 8
        found = search._chained(improved_of(knots))
        improvements = [pieces for pieces in stages if pieces[0][2]]
        seeds = [[seed for piece in pieces for seed in piece[0]] for pieces in improvements]
        assert seeds == [[8]] * 3 + [[7, 8, 9]]
        assert found.success.tolist() == [True, False, True]


def test_a_linear_function_is_fitted_to_knots():
    seen = torch.randn(9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    knots = (seen @ torch.arange(6.0, dtype=torch.float64).reshape(3, 2))[:, :, None] + 1.0
    wanted = seen[:2]
    found = plans_module._fitted(seen, knots, wanted)
    assert float((found - knots[:2]).abs().max()) < 0.2 * float((knots[:2] - 1).abs().max())
    alone = plans_module._fitted(seen[:1], knots[:1], wanted)
    torch.testing.assert_close(alone, knots[:1].expand(2, -1, -1))


class TestImprove:
    def test_the_gradient_of_each_start_is_divided_by_its_norm(self, monkeypatch):
        """Powers of two that scale the gradient of a start, by iterate, change no bit."""
        env, start, knots = begun()
        expected = improve(env, start, knots, 3, rate=2e-3)
        outcome, calls = type(env.task).outcome, []

        def louder(task, place):
            reward = outcome(task, place)
            calls.append(None)
            scale = torch.tensor([1.0, 2.0 ** (10 * ((len(calls) - 1) // 5))], dtype=torch.float64)
            return reward.detach() + scale * (reward - reward.detach())

        monkeypatch.setattr(type(env.task), "outcome", louder)
        found = improve(env, start, knots, 3, rate=2e-3)
        assert torch.equal(found.knots, expected.knots)
        assert not torch.equal(found.knots, knots)

    def test_returns_improve(self):
        env, start, knots = begun()
        found, tried = (improve(env, start, knots, count, rate=2e-3) for count in (3, 0))
        assert bool((found.returns > tried.returns).all())

    def test_the_best_iterate_is_kept(self):
        """With a learning rate too large for so short an episode, the first iterate is best."""
        env, start, knots = begun()
        found = improve(env, start, knots, 3, rate=0.1)
        assert torch.equal(found.knots, knots)
        torch.testing.assert_close(found.actions, (hats(5, 3) @ knots).tanh())

    @pytest.mark.parametrize("succeeds", [False, True])
    def test_the_last_rewards_count_more_until_a_plan_succeeds(self, monkeypatch, succeeds):
        """The rewards of the last two of five transitions count four times."""
        env, start, knots = begun()
        task = type(env.task)
        monkeypatch.setattr(task, "holds", 2)
        monkeypatch.setattr(task, "succeeded", lambda _, place: (place.held >= 0) & succeeds)
        found = improve(env, start, knots, 1, rate=2e-3)
        outcome = task.outcome
        monkeypatch.setattr(plans_module, "LAST_WEIGHT", 0.0)
        if not succeeds:
            monkeypatch.setattr(
                task, "outcome", lambda t, p: outcome(t, p) * (1 + 3 * (p.elapsed > 3))
            )
        expected = improve(env, start, knots, 1, rate=2e-3)
        torch.testing.assert_close(found.knots, expected.knots, atol=1e-9, rtol=0)
        assert not torch.equal(found.knots, knots)

    def test_success_is_preferred_to_return(self):
        one = torch.ones(2, 1, 1, dtype=torch.float64)
        returns = torch.tensor([2.0, 1.0], dtype=torch.float64)
        old = Improved(one, one, returns, torch.tensor([False, True]))
        new = Improved(2 * one, 2 * one, returns.flip(0), torch.tensor([True, False]))
        assert old.better(new).knots.flatten().tolist() == [2.0, 1.0]
        assert old.better(new).success.all()
        assert new.best() == 0
        assert old.best() == 1

    def test_a_failed_simulation_changes_no_other_plan(self, monkeypatch):
        env, start, knots = begun()
        expected = improve(env, start, knots, 2)
        failures, calls = env_module.failures, []

        def failing(state):
            calls.append(None)
            found = failures(state)
            found[1] |= len(calls) % 5 == 3
            return found

        monkeypatch.setattr(env_module, "failures", failing)
        found = improve(env, start, knots, 2)
        assert torch.equal(found.knots[0], expected.knots[0])
        assert bool(torch.isfinite(found.knots).all())
        assert found.returns[1] < expected.returns[1] - 1
        assert not found.success[1]

    def test_plans_continue_from_the_middle_of_an_episode(self):
        env, start, knots = begun()
        whole = improve(env, start, knots, 0)
        place = start
        for k in range(2):
            place = env.task.transition(place, whole.actions[:, k])
        rest = improve(env, place.detach(), knots, 0)
        assert torch.equal(rest.actions, whole.actions[:, 2:])
        assert bool((rest.returns.abs() < whole.returns.abs()).all())

    def test_gradients_that_are_not_finite_are_refused(self, monkeypatch):
        env, start, knots = begun()
        reward = type(env.task).reward
        monkeypatch.setattr(
            type(env.task),
            "reward",
            lambda task, place: reward(task, place) + (0 * place.tools["points"][:, 0, 0]).sqrt(),
        )
        message = (
            r"plan: the gradient of iteration 0 of FoldCloth is not finite in environments \[0"
        )
        with pytest.raises(SimulationError, match=message):
            improve(env, start, knots, 2)


def test_hat_functions_are_a_partition():
    shares = hats(7, 4)
    torch.testing.assert_close(shares.sum(dim=1), torch.ones(7, dtype=torch.float64))
    torch.testing.assert_close(shares[[0, 2, 4, 6]], torch.eye(4, dtype=torch.float64))
    knots = torch.linspace(-1, 1, 4 * 2, dtype=torch.float64).reshape(1, 4, 2)
    torch.testing.assert_close(knots_of((shares @ knots).tanh(), 4), knots)


class TestFiles:
    def test_plans_load(self, found, tmp_path):
        found.save(tmp_path / "plans.pt")
        assert_same(Plans.load(tmp_path / "plans.pt"), found)
        assert torch.load(tmp_path / "plans.pt", weights_only=True).keys() == set(FIELDS)

    def test_other_files_are_refused(self, found, tmp_path):
        path = tmp_path / "plans.pt"
        write_checkpoint(path, "trainer", {})
        with pytest.raises(InvalidInput, match=r"^Plans\.load: .* must be a checkpoint of a plans"):
            Plans.load(path)
        write_checkpoint(path, "plans", {"actions": found.actions})
        with pytest.raises(InvalidInput, match=r"must have the keys actions, returns, success"):
            Plans.load(path)
        kept = {name: getattr(found, name) for name in FIELDS}
        write_checkpoint(path, "plans", kept | {"seeds": found.seeds[:2]})
        with pytest.raises(InvalidInput, match="`seeds` must be of 3 starts, got 2"):
            Plans.load(path)
        found.save(path)
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
        with pytest.raises(InvalidInput, match="its digest differs"):
            Plans.load(path)
        with pytest.raises(InvalidInput, match=r"Plans\.load: `path` must be a file"):
            Plans.load(tmp_path / "none.pt")
        with pytest.raises(InvalidInput, match=r"Plans\.save: the folder of `path` must exist"):
            found.save(tmp_path / "none" / "plans.pt")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"actions": None}, TypeError, r"`actions` must be a tensor \[E, T, A\], got NoneType"),
        ({"actions": torch.zeros(2, 3)}, InvalidInput, r"must be a tensor \[E, T, A\] of torch\.f"),
        ({"actions": torch.full((1, 1, 1), 2.0).double()}, InvalidInput, "between -1 and 1"),
        ({"returns": torch.tensor([torch.nan]).double()}, InvalidInput, "`returns` must be finite"),
        ({"success": torch.tensor([1])}, InvalidInput, r"`success` must be a tensor \[E\] of tor"),
        ({"seeds": torch.tensor([-1])}, InvalidInput, "`seeds` must be between 0 and 4294967295"),
        ({"seeds": torch.tensor([1, 2])}, InvalidInput, "`seeds` must be of 1 starts, got 2"),
    ],
)
def test_bad_plans_are_refused(change, error, message):
    accepted = {
        "actions": torch.zeros(1, 2, 3, dtype=torch.float64),
        "returns": torch.zeros(1, dtype=torch.float64),
        "success": torch.tensor([True]),
        "seeds": torch.tensor([3]),
    }
    assert len(Plans(**accepted)) == 1
    with pytest.raises(error, match=f"^Plans: .*{message}"):
        Plans(**(accepted | change))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"make": 3}, TypeError, "`make` must be a function that makes environments, got 3"),
        ({"episodes": 0}, InvalidInput, "`episodes` must be at least 1, got 0"),
        ({"attempts": 0}, InvalidInput, "`attempts` must be at least 1, got 0"),
        ({"knots": 1}, InvalidInput, "`knots` must be at least 2, got 1"),
        ({"iterations": 1.5}, TypeError, "`iterations` must be an integer, got float"),
        ({"seed": 2**32}, InvalidInput, "`seed` must be at most 4294967295, got 4294967296"),
        ({"workers": 2}, TypeError, "`workers` must have `map`, as .* got 2"),
        ({"workers": ThreadPoolExecutor(1)}, InvalidInput, "`workers` must be processes"),
        ({"coarse": 3}, InvalidInput, "`coarse` must be at least 4, got 3"),
        (
            {"make": lambda num_envs: MAKE(num_envs=num_envs), "workers": Processes(1)},
            InvalidInput,
            "with `workers`, `make` must be a function of a module",
        ),
        (
            {"make": lambda num_envs, size=5: MAKE(num_envs=num_envs, horizon=size), "coarse": 4},
            InvalidInput,
            "`coarse` must leave the task's horizon as it is, 5, got 4 at 4",
        ),
    ],
)
def test_plan_refuses_bad_arguments(change, error, message):
    arguments = {"make": MAKE} | FEW | change
    with pytest.raises(error, match=f"^plan: {message}"):
        plan(**arguments)
