"""Pictures of environments, single environments of gymnasium, and recorders of videos."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch import envs

SMALL = 6


def test_pictures_follow_the_state():
    pytest.importorskip("pyvista")
    env = envs.make("DropCloth", 2, size=SMALL, render_mode="rgb_array")
    with pytest.raises(dc.InvalidInput, match=r"render: call reset\(\) first"):
        env.render()
    env.reset(seed=0)
    first = env.render()
    assert len(first) == 2
    assert first[0].shape == (360, 480, 3)
    assert first[0].dtype == np.uint8
    assert first[0].std() > 10  # no blank picture
    again = env.render()
    assert np.array_equal(first[0], again[0])
    for _ in range(3):
        env.step(torch.tensor([[1.0, 0, -1.0, 1.0] * 2] * 2))
    assert (first[0] != env.render()[0]).any(axis=-1).mean() > 0.005
    env.close()
    env.close()


def test_no_pictures_without_a_mode():
    env = envs.make("DropCloth", size=SMALL)
    env.reset(seed=0)
    assert env.render() is None
    with pytest.raises(dc.InvalidInput, match="make: `render_mode` must be"):
        envs.make("DropCloth", size=SMALL, render_mode="human")


@pytest.mark.parametrize("name", envs.TASKS)
def test_gymnasium_makes_single_environments(name):
    env = gymnasium.make(f"diffcloth/{name}-v0", size=SMALL)
    observation, info = env.reset(seed=3)
    assert isinstance(observation, np.ndarray)
    assert observation in env.observation_space
    vector = envs.make(name, 1, size=SMALL)
    expected, _ = vector.reset(seed=3)
    assert np.array_equal(observation, expected[0].numpy())
    action = env.unwrapped.scripted_action()
    assert action.shape == env.action_space.shape
    observation, reward, terminated, truncated, info = env.step(action)
    expected = vector.step(action[None])
    assert np.array_equal(observation, expected[0][0].numpy())
    assert reward == float(expected[1][0])
    assert (terminated, truncated) == (False, False)
    assert info == {"success": False, "failed": False, "blocked": False, "elapsed": 1}
    assert env.unwrapped.metadata["render_fps"] == 25


@pytest.mark.filterwarnings("ignore:.*infinity")
def test_gymnasium_checks_a_single_environment():
    from gymnasium.utils.env_checker import check_env

    env = gymnasium.make("diffcloth/FoldCloth-v0", size=SMALL, horizon=3)
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=1)
    ends = [env.step(env.action_space.sample())[3] for _ in range(3)]
    assert ends == [False, False, True]


def test_options_of_single_environments_are_checked():
    with pytest.raises(dc.InvalidInput, match="make_single: an option of FoldCloth must be one of"):
        envs.make_single("FoldCloth", bend=1)
    with pytest.raises(dc.InvalidInput, match="ClothEnv: `render_mode` must be"):
        envs.ClothEnv(envs.TASKS["FoldCloth"](size=SMALL), render_mode="human")


@pytest.mark.slow
def test_record_video_of_gymnasium(tmp_path):
    pytest.importorskip("pyvista")
    pytest.importorskip("moviepy")
    from gymnasium.wrappers import RecordVideo

    env = gymnasium.make("diffcloth/DropCloth-v0", size=SMALL, horizon=4, render_mode="rgb_array")
    env = RecordVideo(env, str(tmp_path / "videos"), episode_trigger=lambda episode: True)
    env.reset(seed=0)
    truncated = False
    while not truncated:
        _, _, _, truncated, _ = env.step(env.unwrapped.scripted_action())
    env.close()
    (video,) = tmp_path.rglob("*.mp4")
    assert video.stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_vec_video_recorder_of_stable_baselines(tmp_path):
    pytest.importorskip("pyvista")
    pytest.importorskip("moviepy")
    recorders = pytest.importorskip("stable_baselines3.common.vec_env")
    from diffcloth_torch.envs.stable_baselines import StableBaselinesEnv

    env = StableBaselinesEnv(envs.make("DropCloth", 2, size=SMALL, render_mode="rgb_array"))
    env = recorders.VecVideoRecorder(
        env, str(tmp_path), record_video_trigger=lambda step: step == 0, video_length=3
    )
    env.reset()
    for _ in range(4):
        env.step(np.zeros((2, 8), dtype=np.float32))
    env.close()
    (video,) = tmp_path.rglob("*.mp4")
    assert video.stat().st_size > 1000
