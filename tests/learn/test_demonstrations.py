"""`record`: a data set that Minari reads and that can be replayed, and refusals."""

from __future__ import annotations

import functools
import sys

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.envs import env as env_module
from diffcloth_torch.learn import evaluate, record

make = functools.partial(dc.envs.make, "FoldCloth", size=5, horizon=4, opens_at=-1.0, reach=0.06)


def act(observation):
    return torch.full((1, 8), 0.3) + 0.1 * observation[:, :8].sin()


def test_minari_reads_recorded_episodes(tmp_path, monkeypatch):
    """Nine episodes in two chunks; the simulation of the second episode fails in step 3."""
    minari = pytest.importorskip("minari", reason="minari is in the extra `data`")
    pytest.importorskip("h5py", reason="h5py is in the extra `data`")
    calls, real = [], env_module.failures

    def failures(state):
        calls.append(state)
        failed = real(state)
        failed[1:2] |= len(calls) == 3 * make(num_envs=1).task.substeps
        return failed

    with monkeypatch.context() as patch:
        patch.setattr(env_module, "failures", failures)
        found = record(make, act, 9, tmp_path / "demos", seed=4)
    assert len(found) == 9
    data = minari.MinariDataset(tmp_path / "demos")
    assert (data.total_episodes, data.total_steps) == (9, found.steps) == (9, 8 * 4 + 3)
    env = make(num_envs=1)
    assert data.observation_space == env.single_observation_space
    assert data.action_space == env.single_action_space
    assert data.id == "diffcloth/FoldCloth-v0"
    seeds = [entry["seed"] for entry in data.storage.get_episode_metadata(range(9))]
    assert tuple(seeds) == found.seeds
    for i, episode in enumerate(data.iterate_episodes()):
        assert float(episode.rewards.sum()) == pytest.approx(float(found.returns[i]), abs=1e-6)
        length = 3 if i == 1 else 4
        assert episode.actions.shape == (length, 8)
        assert episode.terminations.tolist() == [False] * (length - 1) + [i == 1]
        assert episode.truncations.tolist() == [False] * (length - 1) + [i != 1]
        assert episode.infos["failed"].tolist() == [False] * length + [i == 1]
        observation, _ = env.reset(seed=[seeds[i]])
        np.testing.assert_array_equal(episode.observations[0], observation[0])
        for t in range(2):
            _, reward, _, _, info = env.step(torch.tensor(episode.actions[t])[None])
            # Stored actions are float32.
            seen = info["obs_before_reset"][0]
            np.testing.assert_allclose(episode.observations[t + 1], seen, atol=1e-5)
            assert episode.rewards[t] == pytest.approx(float(reward), abs=1e-5)
    assert torch.equal(evaluate(make, act, 1, 4).returns, found.returns[:1])
    assert [file.name for file in tmp_path.iterdir()] == ["demos"]


def test_an_interrupted_recording_leaves_no_files(tmp_path):
    pytest.importorskip("minari", reason="minari is in the extra `data`")
    pytest.importorskip("h5py", reason="h5py is in the extra `data`")
    calls = []

    def interrupted(observation):
        calls.append(observation)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return act(observation)

    record(make, interrupted, 1, tmp_path / "demos")
    with pytest.raises(KeyboardInterrupt):
        record(make, interrupted, 1, tmp_path / "more")
    assert [file.name for file in tmp_path.iterdir()] == ["demos"]


def test_record_refuses_bad_arguments(tmp_path, monkeypatch):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    for path, message in (
        (tmp_path / "full", "`path` must not exist, or be an empty folder"),
        (tmp_path / "no" / "demos", "the folder of `path` must exist"),
    ):
        with pytest.raises(dc.InvalidInput, match=f"record: {message}"):
            record(make, "scripted", 1, path)
    with pytest.raises(dc.InvalidInput, match="record: `episodes` must be at least 1"):
        record(make, "scripted", 0, tmp_path / "demos")
    with pytest.raises(TypeError, match="record: `path` must be a string or a Path"):
        record(make, "scripted", 1, 3)
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(dc.InvalidInput, match=r"record needs minari: run .*torch\[data\]"):
        record(make, "scripted", 1, tmp_path / "demos")
