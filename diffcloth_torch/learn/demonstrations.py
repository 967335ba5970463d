"""Data sets of episodes, in the format of Minari."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.extras import from_extra
from diffcloth_torch.files import PART, as_path, writing
from diffcloth_torch.learn.evaluation import Acts, Episodes, Step, evaluate_starts, seeds_of
from diffcloth_torch.learn.rollouts import MakeEnv
from diffcloth_torch.operations import called

__all__ = ["record"]

_FLAGS = ("success", "failed", "blocked")


@called("record")
def record(
    make: MakeEnv,
    policy: Acts,
    episodes: int = 100,
    path: str | Path = "demos/",
    *,
    seed: int = 0,
) -> Episodes:
    """Write episodes of a policy as a data set of Minari; requires the extra "data".

    `minari.MinariDataset(path)` reads it. Observations are float32 [T + 1, O], actions float32
    [T, A] within [-1, 1], `infos` "success", "failed" and "blocked" bool [T + 1]. The metadata
    contains the seed of the start of each episode, for `env.reset(seed=[...])`, and the name of the
    task.

    Args:
        make: Makes environments, as for `evaluate`.
        policy: A function of observations, or "scripted", as for `evaluate`.
        episodes: Number of episodes.
        path: Folder of the data set, which must not exist or must be empty. It is created
            completely, after all episodes, or not at all.
        seed: Seed of the starts.

    Returns:
        Results of the episodes.

    Raises:
        InvalidInput: If an argument is not accepted, or Minari is not installed.
        OSError: If the folder cannot be written.
    """
    seeds = seeds_of("record", seed, episodes)
    folder = as_path("record: `path`", path)
    if not folder.parent.is_dir():
        raise InvalidInput(f"record: the folder of `path` must exist, got {str(path)!r}")
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InvalidInput(f"record: `path` must not exist, or be an empty folder, got {folder}")
    for module in ("minari", "h5py"):
        from_extra(module, "data", f"record needs {module}")
    part = folder.with_name(folder.name + PART)
    shutil.rmtree(part, ignore_errors=True)
    try:
        with writing(folder):
            data = _DataSet(part)
            found = evaluate_starts("record", make, policy, seeds, note=data.take)
            part.replace(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return found


class _DataSet:
    """Writer of a data set."""

    def __init__(self, path: Path) -> None:
        self._path, self._count = path, 0
        self._storage: Any = None

    def take(self, env: Any, seeds: tuple[int, ...], steps: list[Step]) -> None:
        """Write the first episode of each environment."""
        from minari.data_collector.episode_buffer import EpisodeBuffer

        if self._storage is None:
            self._storage = self._begun(env)
        running = torch.stack([step.running for step in steps])
        buffers = []
        for i, seed in enumerate(seeds):
            # The running steps of an environment are a prefix of all steps.
            own = steps[: int(running[:, i].sum())]

            def rows(name: str, own: list[Step] = own, i: int = i) -> Any:
                return torch.stack([getattr(step, name)[i] for step in own]).numpy()

            buffers.append(
                EpisodeBuffer(
                    id=self._count + i,
                    seed=np.uint64(seed),
                    observations=_float32([own[0].seen[i], *(step.after[i] for step in own)]),
                    actions=_float32([step.actions[i].clamp(-1, 1) for step in own]),
                    rewards=rows("reward"),
                    terminations=rows("terminated"),
                    truncations=rows("truncated"),
                    infos={
                        name: np.array([False, *(bool(step.flags[name][i]) for step in own)])
                        for name in _FLAGS
                    },
                )
            )
        self._count += len(seeds)
        self._storage.update_episodes(buffers)

    def _begun(self, env: Any) -> Any:
        import minari
        from minari.dataset.minari_storage import MinariStorage

        storage: Any = MinariStorage.new(
            self._path,
            observation_space=env.single_observation_space,
            action_space=env.single_action_space,
            data_format="hdf5",
        )
        name = env.task.name
        storage.update_metadata(
            {
                "dataset_id": f"diffcloth/{name}-v0",
                "minari_version": minari.__version__,
                "description": f"Episodes of the task {name} of diffcloth_torch",
            }
        )
        return storage


def _float32(rows: list[Tensor]) -> Any:
    return torch.stack(rows).to(torch.float32).numpy()
