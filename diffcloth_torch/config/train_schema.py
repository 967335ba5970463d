"""The schema of configurations that train a policy."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import Discriminator, model_validator

from diffcloth_torch.config.schema import PictureSection
from diffcloth_torch.config.section import Count, Section, Seed, Updates
from diffcloth_torch.processes import DEADLINE, LARGEST_WORKERS, LONGEST_DEADLINE

__all__ = [
    "EnvironmentSection",
    "ImitateStage",
    "PlanStage",
    "TrainConfig",
    "TryoutSection",
    "UpdateStage",
    "WorkersSection",
]

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


class PlanStage(Section):
    """Plans for some starts, by gradients: arguments of `dc.learn.plan`."""

    kind: Literal["plan"]
    episodes: Episodes = 8
    attempts: Episodes = 4
    knots: Annotated[int, Ge(2), Le(10**6)] = 12
    iterations: Episodes = 45
    coarse: Annotated[int, Ge(4)] | None = None


class ImitateStage(Section):
    """A policy that imitates the script of the task or plans: arguments of `dc.learn.imitate`.

    `teacher: plans` needs a stage `plan` before.
    """

    kind: Literal["imitate"]
    teacher: Literal["scripted", "plans"] = "scripted"
    rounds: Episodes = 6
    episodes: Episodes = 24
    iterations: Episodes = 1000


class UpdateStage(Section):
    """Updates of the policy by a trainer; the last stage."""

    kind: Literal["apg", "shac", "sapo"]
    updates: Updates


Stage = Annotated[PlanStage | ImitateStage | UpdateStage, Discriminator("kind")]


class TrainConfig(Section):
    """Environments, the options of `TrainerOptions`, and the length of training.

    The policy is evaluated at first, after each `evaluate_every` updates and at the end, in
    `episodes` episodes of their own. At most five of these policies are compared, in
    `selection_episodes` others, by their success and then by their return; the best is kept, and at
    the end reported in `report_episodes` fresh ones. With `until_success` training ends before its
    last update, as soon as that share of `episodes` succeeds. With `tryout` the seed of `trainer`
    is the one with the largest return after the updates there, which count as the first ones.
    `updates` is 100 by default.

    With `stages` a policy begins at plans or at a teacher; the last stage may be updates by a
    trainer, which are bounded and checked, see `Trainer`. `seed` is the seed of the trainer and of
    all stages.
    """

    task: Literal["train"]
    seed: Seed | None = None
    environment: EnvironmentSection
    stages: list[Stage] = []
    trainer: dict[str, Any] = {}
    num_envs: Count = 4
    chunk: Count | None = None
    updates: Updates | None = None
    evaluate_every: Count = 10
    episodes: Count = 8
    selection_episodes: Episodes = 16
    report_episodes: Episodes = 64
    until_success: Annotated[float, Ge(0), Le(1)] | None = None
    tryout: TryoutSection | None = None
    workers: WorkersSection = WorkersSection()
    viewers: list[Literal["record", "web"]] = ["record"]
    pictures: PictureSection = PictureSection()

    @model_validator(mode="after")
    def _check_stages(self) -> TrainConfig:
        kinds = [stage.kind for stage in self.stages]
        if self.seed is not None and "seed" in self.trainer:
            raise ValueError("`seed` and `trainer.seed` are the same: leave out one of them")
        if kinds:
            if self.tryout is not None:
                raise ValueError("`tryout` and `stages` exclude each other")
            if "imitate" not in kinds:
                raise ValueError("`stages` must have one of the kind imitate, which makes a policy")
            if "algorithm" in self.trainer or self.updates is not None:
                raise ValueError("with `stages`, the last stage has the algorithm and the updates")
        for k, stage in enumerate(self.stages):
            if isinstance(stage, UpdateStage) and k < len(kinds) - 1:
                raise ValueError(f"`stages[{k}]`: {stage.kind} must be the last stage")
            needs_plans = isinstance(stage, ImitateStage) and stage.teacher == "plans"
            if needs_plans and "plan" not in kinds[:k]:
                raise ValueError(f"`stages[{k}]`: teacher plans needs a stage plan before")
        return self
