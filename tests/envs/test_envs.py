"""Environments for learning: interfaces, gradients, failures, seeds and observations."""

from __future__ import annotations

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch

import diffcloth_torch as dc
import diffcloth_torch.envs as envs
from diffcloth_torch.envs.env import Task
from diffcloth_torch.envs.spread_cloth import covered_area

NAMES = tuple(envs.TASKS)
SMALL = 6  # vertices along a side

# The barrier must not throw the cloth in start states.
pytestmark = pytest.mark.filterwarnings("error::diffcloth_torch.BarrierStartWarning")


def make(name, num_envs=2, **options):
    return envs.make(name, num_envs, size=SMALL, **options)


def actions_of(env, seed, scale=1.0):
    noise = torch.Generator().manual_seed(seed)
    shape = (env.num_envs, env.task.action_size)
    return scale * (2 * torch.rand(shape, generator=noise) - 1)


@pytest.mark.parametrize("name", NAMES)
def test_shapes_and_spaces(name):
    env = make(name)
    observation, info = env.reset(seed=3)
    assert env.observation_space.contains(observation.numpy())
    assert env.action_space.contains(env.action_space.sample())
    assert (
        sum(s.stop - s.start for s in env.task.observation_slices.values())
        == (observation.shape[1])
    )
    observation, reward, terminated, truncated, info = env.step(actions_of(env, 0, 0.2))
    assert env.observation_space.contains(observation.numpy())
    assert reward.dtype == torch.float32
    assert bool(torch.isfinite(reward).all())
    assert terminated.dtype == truncated.dtype == torch.bool
    for value in (reward, terminated, truncated, *(info[k] for k in ("success", "failed"))):
        assert value.shape == (2,)
    assert not observation.requires_grad
    assert not reward.requires_grad
    assert env.scripted_actions().shape == env.action_space.shape


def test_gymnasium_finds_tasks():
    env = gymnasium.make_vec("diffcloth/FoldCloth-v0", num_envs=3, size=SMALL)
    assert env.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    assert env.reset(seed=0)[0].shape == (3, env.single_observation_space.shape[0])
    assert env.spec.id == "diffcloth/FoldCloth-v0"
    assert {f"diffcloth/{name}-v0" for name in NAMES} <= set(gymnasium.registry)


@pytest.mark.parametrize("name", ["FoldCloth", "SpreadCloth", "PushCube", "LiftCloth", "HitCloth"])
def test_gradients_of_a_return_are_those_of_differences(name):
    env = make(name, 1)
    sim = env.task.simulator
    exact = dc.SolverOptions(throw=False, tolerance=1e-10)
    env.task.simulator = dc.Simulator(sim.scene, sim.dt, contact=sim.contact, solver=exact)
    env.reset(seed=1)
    start = env.env_state
    script = []
    with torch.no_grad():
        for _ in range(7):  # past the moment in which pickers and hands close
            script.append(0.9 * env.scripted_actions().double())
            env.step(script[-1])

    def total(actions):
        state, value = start, torch.zeros(())
        for action in actions:
            state = env.task.transition(state, action)
            # Weights, as returns of some tasks are flat at first.
            value = value + env.task.reward(state).sum() + 0.1 * env.task.observation(state).mean()
        return value

    leaf = torch.stack(script).requires_grad_()
    (gradient,) = torch.autograd.grad(total(leaf), leaf)
    noise = torch.Generator().manual_seed(0)
    direction = torch.randn(leaf.shape, generator=noise, dtype=torch.float64)
    # Actions beyond their limits are clipped; differences must not reach the limits.
    direction = direction * (leaf.detach().abs() < 0.95)
    expected = float((gradient * direction).sum())
    errors = []
    with torch.no_grad():
        for eps in (1e-6, 1e-7):  # kinks want smaller steps, rounding wants larger ones
            ahead, behind = (total(leaf + sign * eps * direction) for sign in (1, -1))
            errors.append(abs(float(ahead - behind) / (2 * eps) - expected))
    assert min(errors) < max(2e-4 * abs(expected), 1e-7)
    assert float(gradient.norm()) > 0


def test_steps_keep_the_graph_until_it_is_cleared():
    env = make("FoldCloth", 2)
    env.reset(seed=0)
    first, second = (actions_of(env, k, 0.3).requires_grad_() for k in (1, 2))
    env.step(first)
    reward = env.step(second)[1]
    gradients = torch.autograd.grad(reward.sum(), [first, second], retain_graph=True)
    assert all(bool((g != 0).any()) for g in gradients)
    observation = env.initialize_trajectory()
    assert not observation.requires_grad
    third = actions_of(env, 3, 0.3).requires_grad_()
    reward = env.step(third)[1]
    (only,) = torch.autograd.grad(reward.sum(), [third])
    assert bool((only != 0).any())


def test_a_parameter_has_a_gradient():
    env = make("DropCloth", 2)
    env.reset(seed=0)
    density = env.task.simulator.default_parameters().density.requires_grad_()
    env.parameters = env.task.simulator.default_parameters().replace(density=density)
    for _ in range(3):
        reward = env.step(env.scripted_actions())[1]
    (gradient,) = torch.autograd.grad(reward.sum(), density)
    assert bool((gradient != 0).all())


@pytest.mark.parametrize("name", NAMES)
def test_starts_depend_on_the_seed_and_the_environment_alone(name):
    few, many = make(name, 1), make(name, 3)
    one, _ = few.reset(seed=7)
    three, _ = many.reset(seed=7)
    assert torch.equal(one[0], three[0])
    assert not torch.equal(three[0], three[1])
    again, _ = many.reset(seed=7)
    assert torch.equal(three, again)
    other, _ = many.reset(seed=8)
    assert not torch.equal(three, other)


@pytest.mark.parametrize("name", ["FoldCloth", "SpreadCloth", "LiftCloth"])
def test_threads_and_batches_change_no_bit(name):
    results = []
    threads = torch.get_num_threads()
    try:
        for count, num_envs in ((1, 2), (2, 2), (1, 3)):
            torch.set_num_threads(count)
            env = make(name, num_envs)
            env.reset(seed=5)
            for k in range(6):
                observation, reward, *_ = env.step(actions_of(make_like(num_envs, env), k))
            results.append((observation[:2], reward[:2]))
    finally:
        torch.set_num_threads(threads)
    for observation, reward in results[1:]:
        assert torch.equal(observation, results[0][0])
        assert torch.equal(reward, results[0][1])


def make_like(num_envs, env):
    """The first rows of the same actions for any number of environments."""

    class Rows:
        task = env.task

    Rows.num_envs = num_envs
    return Rows


def test_an_episode_ends_at_its_horizon_and_begins_again_in_the_same_step():
    env = make("FoldCloth", 2, horizon=3)
    env.reset(seed=0)
    for k in range(3):
        actions = actions_of(env, k, 0.3).requires_grad_()
        observation, _, terminated, truncated, info = env.step(actions)
        assert truncated.tolist() == [k == 2] * 2
        assert not bool(terminated.any())
    assert info["_final_obs"].tolist() == [True, True]
    assert not torch.equal(info["final_obs"], observation)
    assert info["final_obs"].requires_grad
    (gradient,) = torch.autograd.grad(observation.sum(), actions)
    assert bool((gradient == 0).all())  # the new start depends on nothing
    assert torch.equal(info["final_obs"], info["obs_before_reset"])
    assert env.env_state.elapsed.tolist() == [0, 0]
    assert info["final_info"]["elapsed"].tolist() == [3, 3]


def test_resets_by_mask_leave_the_others_alone():
    env = make("FoldCloth", 3, horizon=2, autoreset_mode="Disabled")
    env.reset(seed=0)
    for k in range(2):
        observation, _, _, truncated, _ = env.step(actions_of(env, k))
    assert bool(truncated.all())
    mask = torch.tensor([True, False, True])
    after, info = env.reset(options={"reset_mask": mask})
    assert torch.equal(after[1], observation[1])
    assert not torch.equal(after[0], observation[0])
    assert info["elapsed"].tolist() == [0, 2, 0]


def test_no_environment_begins_as_one_of_the_next_seed():
    env = make("FoldCloth", 2)
    first, second = (env.reset(seed=seed)[0] for seed in (3, 4))
    assert not torch.equal(first[1], second[0])
    assert not torch.equal(first[0], first[1])


def test_a_failure_at_the_horizon_ends_an_episode_once(monkeypatch):
    from diffcloth_torch.envs import env as module

    monkeypatch.setattr(module, "failures", lambda state: torch.tensor([False, True]))
    env = make("FoldCloth", 2, horizon=1)
    env.reset(seed=0)
    _, _, terminated, truncated, info = env.step(actions_of(env, 0))
    assert terminated.tolist() == [False, True]
    assert truncated.tolist() == [True, False]
    assert info["_final_obs"].tolist() == [True, True]


def test_the_next_start_of_an_environment_does_not_depend_on_those_of_others():
    starts = []
    for resets in ([0, 0], [0], []):  # of environment 0, before one of environment 1
        env = make("FoldCloth", 2)
        env.reset(seed=0)
        for i in [*resets, 1]:
            mask = torch.arange(2) == i
            observation, _ = env.reset(options={"reset_mask": mask})
        starts.append(observation[1])
    assert torch.equal(starts[0], starts[1])
    assert torch.equal(starts[0], starts[2])


def test_failure_changes_no_bit_of_the_others(monkeypatch):
    """Environment 1 fails in its third step and is reset."""
    from diffcloth_torch.envs import env as module

    results = []
    for fails in (False, True):
        env = make("LiftCloth", 3)
        env.reset(seed=0)
        actions = actions_of(env, 0, 0.1).requires_grad_()
        total = 0.0
        for k in range(4):
            now = torch.tensor([False, fails and k == 2, False])
            monkeypatch.setattr(module, "failures", lambda state, now=now: now)
            observation, reward, _, _, info = env.step(actions)
            total = total + reward + observation.sum(-1)
            if now[1]:
                assert info["_final_obs"].tolist() == [False, True, False]
                assert info["final_info"]["failed"].tolist() == [False, True, False]
                assert env.env_state.elapsed[1] == 0
        (gradient,) = torch.autograd.grad(total.sum(), actions)
        results.append((total, gradient))
    for whole, part in zip(*results, strict=True):
        assert torch.equal(whole[[0, 2]], part[[0, 2]])
        assert bool(torch.isfinite(part).all())


def test_a_kept_state_goes_on_with_the_same_bits():
    env = make("FoldCloth", 2, horizon=4)
    env.reset(seed=0)
    for k in range(3):
        env.step(actions_of(env, k))
    kept = env.env_state, env.generator_states()
    other = make("FoldCloth", 2, horizon=4)
    other.resume(*kept)
    with pytest.raises(dc.InvalidInput, match="`generator_states` must be of 2 environments, got"):
        other.resume(kept[0], kept[1][:1])
    for k in range(3, 6):  # past a new start
        expected = env.step(actions_of(env, k))
        found = other.step(actions_of(other, k))
        assert all(torch.equal(a, b) for a, b in zip(expected[:4], found[:4], strict=True))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: envs.make("Fold"), "`task` must be"),
        (lambda: envs.make("FoldCloth", 0), "`num_envs` must be"),
        (lambda: make("FoldCloth", observation="images"), "`observation` must be"),
        *(
            (partial(envs.make, name, size=3), "^make: `size` must be at least 4, got 3")
            for name in NAMES
        ),
        (lambda: make("FoldCloth", autoreset_mode="NextStep"), "'SameStep', 'Disabled'"),
        (lambda: make("FoldCloth", autoreset_mode="never"), "`autoreset_mode` must be"),
        (lambda: make("FoldCloth", seed=-1), "make: `seed` must be at least 0, got -1"),
        (lambda: make("FoldCloth", reach=-1.0), "`reach` must be finite and >= 0"),
        (lambda: make("FoldCloth", reach=float("nan")), "`reach` must be"),
        (lambda: make("FoldCloth", opens_at=1.0), r"`opens_at` must be in \[-1, 1\)"),
        (lambda: make("FoldCloth").step(torch.zeros(2, 8)), r"call reset\(\) first"),
        (lambda: make("FoldCloth").clear_grad(), r"clear_grad: call reset\(\) first"),
        (lambda: make("FoldCloth").scripted_actions(), r"scripted_actions: call reset\(\) first"),
        (lambda: begun().step(torch.zeros(2, 7)), r"must have shape \[2, 8\], got \[2, 7\]"),
        (lambda: begun().step(torch.full((2, 8), torch.nan)), "environment 0 are not"),
        (lambda: begun().reset(options={"mask": 1}), "only reset_mask"),
        (lambda: begun().reset(options={"reset_mask": [True]}), r"booleans \[2\]"),
        (lambda: begun().reset(seed=[1]), "must have 2 numbers"),
        (lambda: begun().reset(seed=-3), "reset: `seed` must be at least 0, got -3"),
        (lambda: begun().reset(seed=[1, -1]), r"`seed\[1\]` must be at least 0, got -1"),
    ],
)
def test_bad_arguments_are_refused(call, message):
    with pytest.raises(dc.InvalidInput, match=message):
        call()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: envs.make(3), "`task` must be a name or a Task, got int"),
        (lambda: envs.make(envs.TASKS["FoldCloth"]), "must be a name or a Task, got FoldCloth"),
        (lambda: begun().step("up"), "^step: `actions` must hold real numbers, got the text 'up'"),
        (lambda: begun().step(None), "^step: `actions` must hold real numbers .*object"),
        (
            lambda: begun().step(torch.zeros(2, 8) * 1j),
            "^step: `actions` must be a tensor of real numbers",
        ),
    ],
)
def test_input_of_other_types(call, message):
    with pytest.raises(TypeError, match=message):
        call()


@pytest.mark.parametrize("seed", ["a", "12", 1.5, True])
def test_seeds_are_integers(seed):
    with pytest.raises(TypeError, match="`seed` must be an integer"):
        make("FoldCloth", seed=seed)
    with pytest.raises(TypeError, match="`seed` must be an integer"):
        begun().reset(seed=seed)


def begun():
    env = make("FoldCloth")
    env.reset(seed=0)
    return env


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("reward", torch.tensor(1.0), r"`reward` must give finite floats \['?B'?\], got"),
        ("reward", torch.zeros(1, 1), r"got torch.float32 \[1, 1\] for B = 1"),
        ("reward", torch.tensor([torch.nan]), "with NaN or infinity"),
        ("reward", torch.tensor([True]), "got torch.bool"),
        ("reward", None, "got NoneType"),
        ("success", torch.zeros(1), r"`success` must give booleans \[B\], got torch.float32"),
        ("terminal", torch.zeros(2) > 1, "`terminal` must give booleans"),
        ("features", torch.zeros(1), "`features` must be a mapping of names to tensors"),
        ("features", {"x": torch.zeros(1)}, r"`features\['x'\]` must give finite floats \[B, n\]"),
        ("features", {"x": torch.full((1, 2), torch.inf)}, "with NaN or infinity"),
        ("scripted", torch.zeros(1, 3), r"`scripted` must give finite floats \[B, 8\]"),
    ],
)
def test_outputs_of_a_task_are_checked(name, value, message):
    wrong = type("Wrong", (envs.TASKS["FoldCloth"],), {"name": "Wrong", name: lambda s, e: value})
    with pytest.raises(dc.InvalidInput, match=message):
        envs.make(wrong(size=SMALL))


def test_a_reward_that_becomes_nan_is_named():
    class Late(envs.TASKS["FoldCloth"]):
        name = "Late"

        def reward(self, env):
            late = (env.elapsed > 1) & (torch.arange(len(env)) == 1)
            return super().reward(env) + torch.where(late, torch.nan, 0.0)

    env = envs.make(Late(size=SMALL), 2)
    env.reset(seed=0)
    env.step(np.zeros((2, 8)))
    with pytest.raises(dc.SimulationError, match="Late: the reward of environment 1 is nan"):
        env.step(np.zeros((2, 8)))


def test_a_task_needs_a_name_and_no_script():
    class Plain(envs.TASKS["FoldCloth"]):
        name = "Plain"
        scripted = Task.scripted

    env = envs.make(Plain(size=SMALL), 2)
    env.reset(seed=0)
    with pytest.raises(dc.InvalidInput, match="Plain: it has no scripted policy"):
        env.scripted_actions()
    Plain.name = None
    with pytest.raises(dc.InvalidInput, match="Plain: a task must have a `name`"):
        Plain(size=SMALL)


def test_a_task_of_ones_own():
    class Lift(envs.TASKS["FoldCloth"]):
        name = "Lift"

        def reward(self, env):
            return env.state.positions[..., 2].mean(dim=-1)

    assert issubclass(Lift, Task)
    env = envs.make(Lift(size=SMALL), 2)
    env.reset(seed=0)
    assert env.step(np.zeros((2, 8)))[1].tolist() == pytest.approx([4e-3] * 2, rel=0.1)


def test_an_environment_takes_an_integrator():
    env = dc.envs.make("FoldCloth", 2, size=6, integrator="second_order")
    env.reset(seed=0)
    with torch.no_grad():
        *_, info = env.step(env.scripted_actions())
    assert env.task.simulator.integrator == "second_order"
    assert not info["blocked"].any()
    assert not env.env_state.failed.any()


@pytest.mark.parametrize("axis", [0, 1])
def test_covered_area_of_two_patches_adds_only_where_they_lie_apart(axis):
    line = 0.05 * torch.arange(4, dtype=torch.float64) - 0.1
    x, y = torch.meshgrid(line, line, indexing="ij")
    patch = torch.stack([x, y, torch.zeros_like(x)], dim=-1).reshape(1, -1, 3)
    away = torch.zeros(3, dtype=torch.float64)
    away[axis] = 0.4
    spacing = torch.full((1,), 0.05, dtype=torch.float64)
    one = covered_area(patch, spacing)
    apart = covered_area(torch.cat([patch, patch + away], dim=1), spacing)
    above = covered_area(torch.cat([patch, patch + torch.tensor([0.0, 0.0, 0.1])], dim=1), spacing)
    assert apart.item() == pytest.approx(2 * one.item(), rel=1e-3)
    assert one.item() < above.item() < 1.3 * one.item()
