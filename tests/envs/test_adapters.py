"""Adapters of the environments for reinforcement-learning libraries."""

from __future__ import annotations

import pytest
import torch

import diffcloth_torch.envs as envs
from diffcloth_torch.errors import InvalidInput

SMALL = 6


@pytest.mark.filterwarnings("ignore")
class TestTorchRL:
    @pytest.fixture(scope="class")
    def adapter(self):
        pytest.importorskip("torchrl")
        from diffcloth_torch.envs.torchrl import TorchRLEnv

        env = envs.make("FoldCloth", 2, size=SMALL, horizon=5, autoreset_mode="Disabled")
        return TorchRLEnv(env)

    def test_specs(self, adapter):
        from torchrl.envs.utils import check_env_specs

        check_env_specs(adapter)

    def test_gradients_are_those_of_the_environment(self, adapter):
        weights = torch.linspace(-0.3, 0.3, 8).requires_grad_()

        def policy(tensordict):
            return tensordict.set("action", weights.tanh().expand(2, -1))

        adapter.set_seed(4)
        rollout = adapter.rollout(3, policy, auto_reset=True)
        (found,) = torch.autograd.grad(rollout["next", "reward"].sum(), weights)
        raw = envs.make("FoldCloth", 2, size=SMALL, horizon=5)
        raw.reset(seed=4)
        total = sum(raw.step(weights.tanh().expand(2, -1))[1].sum() for _ in range(3))
        (expected,) = torch.autograd.grad(total, weights)
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)
        assert bool((expected != 0).any())

    def test_environments_that_begin_anew_are_refused(self):
        pytest.importorskip("torchrl")
        from diffcloth_torch.envs.torchrl import TorchRLEnv

        with pytest.raises(InvalidInput, match="autoreset_mode='Disabled'"):
            TorchRLEnv(envs.make("FoldCloth", 1, size=SMALL))


@pytest.mark.filterwarnings("ignore")
def test_stable_baselines_learns():
    sb3 = pytest.importorskip("stable_baselines3")
    from diffcloth_torch.envs.stable_baselines import StableBaselinesEnv

    with pytest.raises(InvalidInput, match="StableBaselinesEnv: `env` must begin anew"):
        StableBaselinesEnv(envs.make("FoldCloth", 2, size=SMALL, autoreset_mode="Disabled"))
    env = StableBaselinesEnv(envs.make("FoldCloth", 2, size=SMALL, horizon=4))
    env.seed(3)
    first = env.reset()
    assert first.shape == (2, env.observation_space.shape[0])
    for _ in range(4):
        _, reward, ended, infos = env.step(env.action_space.sample()[None].repeat(2, 0))
    assert ended.tolist() == [True, True]
    assert infos[0]["TimeLimit.truncated"]
    assert infos[0]["terminal_observation"].shape == env.observation_space.shape
    model = sb3.PPO("MlpPolicy", env, n_steps=4, batch_size=8, n_epochs=1, device="cpu")
    model.learn(8)
    assert reward.shape == (2,)


def test_rsl_rl_finds_its_interface():
    pytest.importorskip("tensordict")
    from diffcloth_torch.envs.rsl_rl import RslRlEnv

    with pytest.raises(InvalidInput, match="RslRlEnv: `env` must begin anew"):
        RslRlEnv(envs.make("FoldCloth", 2, size=SMALL, autoreset_mode="Disabled"))
    env = RslRlEnv(envs.make("FoldCloth", 2, size=SMALL, horizon=2), seed=0)
    assert env.get_observations()["policy"].shape[0] == env.num_envs == 2
    for _ in range(2):
        observations, reward, ended, extras = env.step(torch.zeros(2, env.num_actions))
    assert ended.tolist() == [1, 1]
    assert extras["time_outs"].tolist() == [True, True]
    assert env.episode_length_buf.tolist() == [0, 0]
    assert observations["policy"].shape[0] == reward.shape[0] == 2
    # Runners may begin with episodes of random lengths.
    env.episode_length_buf = torch.tensor([1, 0])
    assert env.step(torch.zeros(2, env.num_actions))[2].tolist() == [1, 0]


class TestFailures:
    """Environment 1 fails in its first step: every adapter charges the rest of the episode."""

    @pytest.fixture
    def failing(self, monkeypatch):
        from diffcloth_torch.envs import env as module

        def make(**options):
            env = envs.make("FoldCloth", 2, size=SMALL, horizon=5, **options)
            monkeypatch.setattr(module, "failures", lambda state: torch.tensor([False, True]))
            return env

        return make

    CHARGE = 5 * envs.TASKS["FoldCloth"].worst

    @pytest.mark.filterwarnings("ignore")
    def test_torchrl(self, failing):
        pytest.importorskip("torchrl")
        from diffcloth_torch.envs.torchrl import TorchRLEnv

        adapter = TorchRLEnv(failing(autoreset_mode="Disabled"))
        start = adapter.reset()
        after = adapter.step(start.set("action", torch.zeros(2, 8)))["next"]
        assert float(after["reward"][1]) == self.CHARGE
        assert after["terminated"].flatten().tolist() == [False, True]

    @pytest.mark.filterwarnings("ignore")
    def test_stable_baselines(self, failing):
        pytest.importorskip("stable_baselines3")
        from diffcloth_torch.envs.stable_baselines import StableBaselinesEnv

        env = StableBaselinesEnv(failing())
        env.reset()
        _, reward, ended, infos = env.step(torch.zeros(2, 8).numpy())
        assert float(reward[1]) == self.CHARGE
        assert ended.tolist() == [False, True]
        assert infos[1]["failed"]
        assert not infos[1]["TimeLimit.truncated"]
        assert infos[0]["blocked"] is False

    def test_rsl_rl(self, failing):
        pytest.importorskip("tensordict")
        from diffcloth_torch.envs.rsl_rl import RslRlEnv

        env = RslRlEnv(failing())
        _, reward, ended, extras = env.step(torch.zeros(2, 8))
        assert float(reward[1]) == self.CHARGE
        assert ended.tolist() == [0, 1]
        assert not extras["time_outs"].any()
        assert float(extras["log"]["failed"]) == 0.5
