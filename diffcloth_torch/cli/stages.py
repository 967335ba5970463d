"""Stages of a training before the updates: plans, and policies that imitate a teacher."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from diffcloth_torch.checkpoint import check_like
from diffcloth_torch.config.train_schema import ImitateStage, PlanStage
from diffcloth_torch.envs.env import steps_made
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn import Plans, Policy, TrainerOptions, imitate, plan
from diffcloth_torch.learn.rollouts import MakeEnv
from diffcloth_torch.learn.workers import Workers

__all__ = ["Stages"]


class Stages:
    """Completed stages of a training, and their results.

    An interrupted stage is repeated with the same bits, which its seed determines.

    Attributes:
        done: Kind, environment steps and duration [s] of each completed stage; also the success of
            plans.
        policy: Policy of the last stage of the kind "imitate"; None before.
    """

    def __init__(
        self,
        stages: Sequence[PlanStage | ImitateStage],
        make: MakeEnv,
        options: TrainerOptions,
        workers: Workers | None,
    ) -> None:
        """Prepare the stages.

        Args:
            stages: Stages of the configuration, without the updates of a trainer.
            make: Makes environments.
            options: Options of the trainer, which define the policy; all stages use their seed.
            workers: Workers that compute plans; None for this process.
        """
        self._stages, self._make, self._workers = stages, make, workers
        # The bounds of fine-tuning do not affect the networks of a policy.
        self._options = replace(options, max_change=None, held_out=None)
        self._plans: Plans | None = None
        self.done: list[dict[str, Any]] = []
        self.policy: Policy | None = None

    @property
    def steps(self) -> int:
        """Environment steps of the completed stages."""
        return int(sum(each["steps"] for each in self.done))

    @property
    def seconds(self) -> float:
        """Duration of the completed stages [s]."""
        return float(sum(each["seconds"] for each in self.done))

    def run(self, keep: Callable[[], None]) -> None:
        """Run the remaining stages.

        Args:
            keep: Function that is called after each stage, to save results.
        """
        for stage in self._stages[len(self.done) :]:
            before, steps = time.perf_counter(), steps_made()
            found: dict[str, Any] = {"kind": stage.kind}
            if isinstance(stage, PlanStage):
                self._plans = self._planned(stage)
                found["success"] = float(self._plans.success.float().mean())
            else:
                self.policy = self._imitated(stage)
            found["steps"] = steps_made() - steps
            self.done.append(found | {"seconds": time.perf_counter() - before})
            keep()

    def record(self) -> dict[str, Any]:
        """Return all results, in types that `torch.load` reads with `weights_only`."""
        plans, policy = self._plans, self.policy
        return {
            "done": self.done,
            "plans": None if plans is None else dict(vars(plans)),
            "policy": None if policy is None else dict(policy.state_dict()),
        }

    def restore(self, kept: Any, untrained: Policy) -> None:
        """Continue after the stages of a record.

        Args:
            kept: Result of `record`.
            untrained: Policy of the same sizes and options; its weights are replaced by the
                weights of the record, if the record has a policy.

        Raises:
            InvalidInput: If `kept` is no record of these stages.
        """
        if not isinstance(kept, dict) or kept.keys() != self.record().keys():
            raise InvalidInput("`stages` must have the keys done, plans, policy")
        kinds = [stage.kind for stage in self._stages]
        for k, (each, kind) in enumerate(zip(kept["done"], kinds, strict=False)):
            example: dict[str, Any] = {"kind": "", "steps": 0, "seconds": 0.0}
            if kind == "plan":
                example["success"] = 0.0
            check_like(f"`stages`.done[{k}]", each, example)
            if each["kind"] != kind:
                raise InvalidInput(f"`stages`.done[{k}] must be {kind!r}, got {each['kind']!r}")
        done = kinds[: len(kept["done"])]
        for name, kind in (("plans", "plan"), ("policy", "imitate")):
            if len(kept["done"]) > len(kinds) or (kept[name] is None) == (kind in done):
                raise InvalidInput(
                    f"`stages` must have {name} if a stage of the kind {kind} is done"
                )
        plans = None if kept["plans"] is None else Plans(**kept["plans"])
        policy = None
        if kept["policy"] is not None:
            check_like("`stages`.policy", kept["policy"], dict(untrained.state_dict()))
            untrained.load_state_dict(kept["policy"])
            policy = untrained
        self.done, self._plans, self.policy = kept["done"], plans, policy

    def _planned(self, stage: PlanStage) -> Plans:
        given = stage.model_dump(exclude={"kind"})
        return plan(self._make, **given, seed=self._options.seed, workers=self._workers)

    def _imitated(self, stage: ImitateStage) -> Policy:
        given = stage.model_dump(exclude={"kind", "teacher"})
        teacher: Any = self._plans if stage.teacher == "plans" else stage.teacher
        seed = self._options.seed
        return imitate(self._make, teacher, **given, seed=seed, options=self._options)
