"""Imitation: actions by teacher and policy, labels, visited states, and refusals."""

from __future__ import annotations

import functools

import pytest
import torch

from diffcloth_torch import envs
from diffcloth_torch.envs.fold_cloth import FoldCloth
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn import Policy, Trainer, TrainerOptions, imitate, imitation, plan
from diffcloth_torch.learn.imitation import fit
from diffcloth_torch.learn.plans import hats, improve
from diffcloth_torch.learn.replanning import Replanning
from diffcloth_torch.learn.starts import part_seeds

MAKE = functools.partial(envs.make, "FoldCloth", size=4, horizon=5)
SOFT = functools.partial(MAKE, opens_at=-1.0, reach=0.06)
OPTIONS = TrainerOptions("apg", plan_knots=3, hidden=(16,), init_std=0.05)
FEW = {"rounds": 2, "episodes": 2, "seed": 3, "iterations": 40, "options": OPTIONS}


def constant(observation, env):
    return torch.full((env.num_envs, env.task.action_size), 0.5)


class Recorder:
    """A teacher that records the observations it receives."""

    def __init__(self):
        self.seen = []

    def __call__(self, observation, env):
        self.seen.append(observation.clone())
        assert torch.equal(env.task.observation(env.env_state).float(), observation)
        return env.scripted_actions()


def test_the_script_is_imitated():
    policies = [imitate(MAKE, "scripted", **(FEW | {"iterations": n})) for n in (1, 150)]
    env = MAKE(num_envs=4)
    observation, _ = env.reset(seed=0)
    errors = []
    for policy in policies:
        with torch.no_grad():
            errors.append(float((policy(observation) - env.scripted_actions()).abs().mean()))
    assert errors[1] < 0.5 * errors[0]


def test_a_function_is_imitated():
    policy = imitate(MAKE, constant, **(FEW | {"iterations": 100}))
    observation, _ = MAKE(num_envs=3).reset(seed=9)
    # Errors of the fit are below .01 at its 20 rows, and a little larger at other starts.
    assert float((policy(observation).detach() - 0.5).abs().max()) < 0.05


def test_the_first_round_follows_plans_and_later_rounds_plan_again():
    """The first round follows the plans; later rounds begin from new starts."""
    env = SOFT(num_envs=2)
    draws = torch.Generator().manual_seed(0)
    plans = plan(SOFT, episodes=3, attempts=1, knots=3, iterations=1)
    policy = imitate(SOFT, "scripted", **(FEW | {"rounds": 1}))
    lessons = Replanning(SOFT, env, plans, 3, draws)
    seen, shown = lessons.round(policy, 0)
    assert torch.equal(shown, plans.actions.float().flatten(0, 1))
    first, _ = SOFT(num_envs=3).reset(seed=plans.seeds.tolist())
    assert torch.equal(seen[::5], first)
    with torch.no_grad():
        seen, shown = lessons.round(policy, 1)
    first, _ = env.reset(seed=part_seeds(3, 1, 2))
    assert torch.equal(seen[:10:5], first)
    # The second round replans at the start, and at up to two later times of five transitions.
    assert len(seen) == len(shown) > 10
    assert len(lessons._knots) == len(lessons._seen) >= 3 + 2 * 2
    # New plans begin from the nearest plans or the actions of the policy, the better ones; five
    # steps of .03 bound the distance.
    env.reset(seed=part_seeds(3, 1, 2))
    start = env.env_state.detach()
    near = torch.cdist(policy.scale(first), policy.scale(lessons._seen[:3, 0])).argmin(dim=1)
    with torch.no_grad():
        own = lessons._continued(start, policy)
    nearest, continued = (improve(env, start, each, 0) for each in (lessons._knots[near], own))
    begun = nearest.better(continued)
    assert float((lessons._knots[3:5] - begun.knots).abs().max()) < 0.2
    new = improve(env, start, lessons._knots[3:5], 0)
    assert bool((new.returns >= begun.returns).all())


def test_the_actions_of_a_policy_are_continued_from_the_middle_of_an_episode():
    env = SOFT(num_envs=2)
    env.reset(seed=[1, 2])
    place = env.env_state.detach()
    policy = imitate(SOFT, "scripted", **(FEW | {"rounds": 1}))
    plans = plan(SOFT, episodes=1, attempts=1, knots=3, iterations=1)
    lessons = Replanning(SOFT, env, plans, 3, torch.Generator().manual_seed(0))
    with torch.no_grad():
        for k in range(2):
            place = env.task.transition(place, 0.1 * plans.actions[:, k].expand(2, -1))
        knots = lessons._continued(place, policy)
        actions = (hats(5, 12)[2:] @ knots).tanh()
        expected = policy(env.task.observation(place).float()).double()
    torch.testing.assert_close(actions[:, 0], expected, atol=1e-5, rtol=0)


def test_a_policy_learns_from_plans_with_the_same_bits():
    plans = plan(SOFT, episodes=2, attempts=1, knots=3, iterations=1)
    policies = [imitate(SOFT, plans, **FEW).state_dict() for _ in range(2)]
    assert all(torch.equal(value, policies[1][name]) for name, value in policies[0].items())


def test_weight_decay_shrinks_all_weights_except_knots_and_deviations():
    """A trainer that begins at the policy has the noise of the options."""
    env = SOFT(num_envs=2)
    options = TrainerOptions("apg", plan_knots=3, hidden=(8,), first_action=(0.5,) * 8)
    seen, shown = torch.zeros(4, Policy(env, options).observations), torch.full((4, 8), 0.5)

    def fitted(decay):
        torch.manual_seed(0)
        policy = Policy(env, options)
        fit(policy, seen, shown, 30, torch.Generator().manual_seed(0), decay)
        return policy.actor

    kept, shrunk = fitted(0.0), fitted(20.0)
    sizes = [float(actor.layers[0].weight.detach().norm()) for actor in (kept, shrunk)]
    assert sizes[1] < 0.5 * sizes[0]
    torch.testing.assert_close(shrunk.plan.knots, kept.plan.knots, atol=0.1, rtol=0)
    deviations = shrunk.log_deviation.detach().exp()
    torch.testing.assert_close(deviations, torch.full((8,), options.init_std))


def test_plans_are_imitated_with_weight_decay(monkeypatch):
    decays = []
    monkeypatch.setattr(imitation, "fit", lambda *given: decays.append(given[5]))
    plans = plan(SOFT, episodes=1, attempts=1, knots=2, iterations=1)
    imitate(SOFT, plans, rounds=1, episodes=1)
    imitate(SOFT, "scripted", rounds=1, episodes=1)
    assert decays[0] > 0
    assert decays[1] == 0


def test_plans_of_other_episodes_are_refused():
    plans = plan(SOFT, episodes=1, attempts=1, knots=2, iterations=1)
    make = functools.partial(SOFT, horizon=4)
    message = r"imitate: `teacher` must have plans \[E, 4, 8\], got \[1, 5, 8\]"
    with pytest.raises(InvalidInput, match=message):
        imitate(make, plans, **FEW)


def test_the_teacher_labels_the_states_that_the_policy_visits():
    """The second round has new starts and follows the policy of the first round."""
    teacher = Recorder()
    imitate(MAKE, teacher, **FEW)
    first = imitate(MAKE, "scripted", **(FEW | {"rounds": 1}))
    env = MAKE(num_envs=2)
    observation, _ = env.reset(seed=part_seeds(3, 1, 2))
    assert len(teacher.seen) == 2 * 5
    for seen in teacher.seen[5:]:
        assert torch.equal(seen, observation)
        with torch.no_grad():
            observation, *_ = env.step(first(observation))


def test_the_scale_of_observations_comes_from_the_first_round():
    teacher = Recorder()
    policy = imitate(MAKE, teacher, **FEW)
    rows = torch.cat(teacher.seen[:5])
    assert float(policy.scale.count) == len(rows)
    torch.testing.assert_close(policy.scale.mean, rows.mean(dim=0))


def test_bits_depend_on_the_seed_but_not_on_threads_and_other_draws():
    expected = imitate(MAKE, "scripted", **FEW).state_dict()
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    torch.manual_seed(1)
    drawn = torch.random.get_rng_state()
    try:
        found = imitate(MAKE, "scripted", **FEW).state_dict()
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(value, found[name]) for name, value in expected.items())
    assert torch.equal(torch.random.get_rng_state(), drawn)
    other = imitate(MAKE, "scripted", **(FEW | {"seed": 4})).state_dict()
    assert not torch.equal(other["scale.mean"], expected["scale.mean"])


def test_a_trainer_of_the_same_options_has_the_same_networks():
    policy = imitate(MAKE, constant, **FEW)
    trainer = Trainer(MAKE, OPTIONS, num_envs=2)
    trainer.policy.load_state_dict(policy.state_dict())
    observation, _ = MAKE(num_envs=2).reset(seed=0)
    torch.testing.assert_close(trainer.act(observation), policy(observation).detach())


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"make": 3}, TypeError, "`make` must be a function that makes environments, got 3"),
        (
            {"teacher": "script"},
            InvalidInput,
            "`teacher` must be 'scripted', Plans or a .* got 'script'",
        ),
        ({"teacher": 3}, TypeError, "`teacher` must be 'scripted', Plans or a .* got 3"),
        ({"rounds": 0}, InvalidInput, "`rounds` must be at least 1, got 0"),
        ({"episodes": 0}, InvalidInput, "`episodes` must be at least 1, got 0"),
        ({"iterations": 0}, InvalidInput, "`iterations` must be at least 1, got 0"),
        ({"seed": -1}, InvalidInput, "`seed` must be at least 0, got -1"),
        ({"options": 3}, TypeError, "`options` must be TrainerOptions, got int"),
        (
            {"teacher": lambda *_: torch.zeros(2, 7)},
            InvalidInput,
            r"actions of `teacher` must have shape \[2, 8\]",
        ),
        (
            {"teacher": lambda *_: torch.full((2, 8), torch.nan)},
            InvalidInput,
            "actions of `teacher` must be finite, those of environment 0 are not",
        ),
    ],
)
def test_imitate_refuses_bad_arguments(change, error, message):
    arguments = {"make": MAKE, "teacher": "scripted"} | FEW | change
    with pytest.raises(error, match=f"^imitate: {message}"):
        imitate(**arguments)


def test_a_task_without_a_script_has_no_scripted_teacher(monkeypatch):
    monkeypatch.delattr(FoldCloth, "scripted")
    with pytest.raises(InvalidInput, match="FoldCloth: it has no scripted policy"):
        imitate(MAKE, "scripted", **FEW)
