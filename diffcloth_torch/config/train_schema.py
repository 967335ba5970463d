"""The schema of configurations that train a policy."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen

from diffcloth_torch.config.schema import PictureSection
from diffcloth_torch.config.section import Count, Section, Seed, Updates
from diffcloth_torch.processes import DEADLINE, LARGEST_WORKERS, LONGEST_DEADLINE

__all__ = ["EnvironmentSection", "TrainConfig", "TryoutSection", "WorkersSection"]

Episodes = Annotated[int, Ge(1), Le(10**6)]
"""A count of episodes: a day has fewer."""


class EnvironmentSection(Section):
    """Name and options of a task, as in `dc.envs.make`."""

    name: str
    options: dict[str, Any] = {}


class WorkersSection(Section):
    """Workers for rollouts: this process, others, actors of Ray, or the ranks of torchrun.

    `deadline` is the longest time of a rollout of a chunk [s].
    """

    kind: Literal["none", "processes", "ray", "ranks"] = "none"
    count: Annotated[int, Ge(1), Le(LARGEST_WORKERS)] = 1
    threads: Annotated[int, Ge(1), Le(LARGEST_WORKERS)] = 1
    deadline: Annotated[float, Gt(0), Lt(LONGEST_DEADLINE)] = DEADLINE


class TryoutSection(Section):
    """Seeds that each learn for a few updates; training continues with the best of them."""

    seeds: Annotated[list[Seed], MinLen(2)]
    updates: Updates


class TrainConfig(Section):
    """Environments, the options of `TrainerOptions`, and the length of training.

    The policy is evaluated at first, after each `evaluate_every` updates and at the end, in
    `episodes` episodes of their own. At most five of these policies are compared, in
    `selection_episodes` others, by their success and then by their return; the best is kept, and at
    the end reported in `report_episodes` fresh ones. With `until_success` training ends before its
    last update, as soon as that share of `episodes` succeeds. With `tryout` the seed of `trainer`
    is the one with the largest return after the updates there, which count as the first ones.
    """

    task: Literal["train"]
    environment: EnvironmentSection
    trainer: dict[str, Any] = {}
    num_envs: Count = 4
    chunk: Count | None = None
    updates: Updates = 100
    evaluate_every: Count = 10
    episodes: Count = 8
    selection_episodes: Episodes = 16
    report_episodes: Episodes = 64
    until_success: Annotated[float, Ge(0), Le(1)] | None = None
    tryout: TryoutSection | None = None
    workers: WorkersSection = WorkersSection()
    viewers: list[Literal["record", "web"]] = ["record"]
    pictures: PictureSection = PictureSection()
