"""The command `diffcloth train`: train a policy, and resume a training."""

from __future__ import annotations

import copy
import shutil
import time
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from diffcloth_torch import envs
from diffcloth_torch.checkpoint import check_like, refusing_damage
from diffcloth_torch.cli.results import (
    check_folder,
    clear,
    read_resume,
    results_folder,
    resume_file,
    resumed_folder,
    write_metrics,
    write_resume,
)
from diffcloth_torch.cli.stages import Stages
from diffcloth_torch.config.documents import read_document, set_values
from diffcloth_torch.config.train_schema import (
    TrainConfig,
    TryoutSection,
    UpdateStage,
    WorkersSection,
)
from diffcloth_torch.config.validation import validate
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn import imitation
from diffcloth_torch.learn.evaluation import evaluate, follow, noise_of_success
from diffcloth_torch.learn.options import TrainerOptions, name_now
from diffcloth_torch.learn.policy import Policy
from diffcloth_torch.learn.starts import PURPOSES, episode_seeds, purpose_seed
from diffcloth_torch.learn.trainer import Trainer, record_of, restore
from diffcloth_torch.learn.workers import Processes, Ranks, RayActors
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.viewers.look import Camera, Pictures, marker
from diffcloth_torch.viewers.record import Record
from diffcloth_torch.viewers.show import show

__all__ = ["resume_training", "train"]

# Files in a folder of results; TensorBoard reads the files of a folder.
_RESULT, _POLICY, _EVENTS = "train.json", "policy.pt", "events"
_VIDEO = "evaluation"
_MARKER = 0.01  # radius of a point of the goal in pictures [m]
_EVALUATION = {"updates": 0, "steps": 0, "return": 0.0, "success": 0.0, "seconds": 0.0}
_BEST = {"updates": 0, "success": 0.0, "return": 0.0}
_REPORT = {
    "episodes": 0, "success": 0.0, "interval": [0.0, 0.0], "ever": 0.0, "failed": 0.0,
    "blocked": 0.0, "return": 0.0, "steps": 0, "minutes": 0.0,
}  # fmt: skip
_UPDATES = 100  # by default
_LOOKS = 5  # at policies, of which the best one is kept
_SHAPE = ("plan_knots", "hidden", "init_std")  # options that shape a policy
_NOT_THERE = ("num_envs", "seed", "autoreset_mode")  # set by the trainer

_Workers = Processes | RayActors | Ranks | None


def train(
    config: Path,
    assignments: Iterable[str] = (),
    out: Path | None = None,
    *,
    overwrite: bool = False,
) -> str:
    """Train the policy of a configuration.

    Arguments and errors are as for `run`.
    """
    section = _check(set_values(read_document(config), assignments), config)
    workers = _workers(section.workers)
    if not _writes(workers):
        return _Job(section, config, workers).run(check_folder(config, out, True), [])
    check_folder(config, out, overwrite, "train")
    job = _Job(section, config, workers)
    with results_folder(config, out, overwrite, "train") as folder:
        clear(folder)
        if (folder / _EVENTS).is_dir():
            shutil.rmtree(folder / _EVENTS)
        job.keep(folder, [])
        return job.run(folder, [])


def resume_training(folder: Path) -> str:
    """Resume a training that was interrupted; it continues with the same bits.

    Args:
        folder: Folder of its results.

    Raises:
        InvalidInput: If the folder has no such results, or another process uses it.
    """
    kept = read_resume(folder, "train")
    workers = _workers(_check(kept["config"], kept["source"]).workers)
    if not _writes(workers):
        return _resumed(folder, kept, workers)
    with resumed_folder(folder, "train") as kept:
        return _resumed(folder, kept, workers)


def _resumed(folder: Path, kept: dict[str, Any], workers: _Workers) -> str:
    job = _Job(_check(kept["config"], kept["source"]), kept["source"], workers)
    with refusing_damage("--resume", resume_file(folder, "train")):
        evaluations = job.restore(kept)
    return job.run(folder, evaluations)


def _check(document: dict[str, Any], source: Path) -> TrainConfig:
    if document.get("task") != "train":
        raise InvalidInput(
            f"{source}: `task` must be train to train something, got {document.get('task')!r}"
        )
    return validate(TrainConfig, document, source)


class _Job:
    """A training: its trainer, its workers, and its results so far."""

    def __init__(self, section: TrainConfig, source: Path, workers: _Workers) -> None:
        self.section, self._source = section, source.resolve()
        self._options = _named(f"{source}: `trainer`", TrainerOptions, _options(section))
        self._workers = workers
        self.writes = _writes(workers)
        self._updates = _updates(section)
        self.trainer = self._make(self._options)
        before = [stage for stage in section.stages if not isinstance(stage, UpdateStage)]
        self._stages = Stages(before, self._make_env, self._options, workers)
        self._tried: list[dict[str, Any]] = []
        self._best: dict[str, Any] | None = None
        self._report: dict[str, Any] | None = None

    def _make(self, options: TrainerOptions, init: Policy | None = None) -> Trainer:
        section, env = self.section, self.section.environment
        for name in _NOT_THERE:
            if name in env.options:
                raise InvalidInput(
                    f"{self._source.name}: `environment.options` may not have {name!r}: "
                    "`num_envs` and the seed of `trainer` say it"
                )
        self._make_env = partial(envs.make, env.name, **env.options)
        return Trainer(
            self._make_env,
            options,
            num_envs=section.num_envs,
            chunk=section.chunk,
            workers=self._workers,
            threads=section.workers.threads,
            init=init,
        )

    def keep(
        self,
        out: Path,
        evaluations: list[dict[str, Any]],
        trainer: dict[str, Any] | None = None,
    ) -> None:
        """Write the file that `--resume` reads.

        Args:
            out: Folder of the results.
            evaluations: Evaluations so far.
            trainer: State of the trainer, None before its first evaluation.
        """
        document = self.section.model_dump(mode="json", exclude_unset=True)
        found = {
            "evaluations": evaluations,
            "tried": self._tried,
            "trainer": trainer,
            "best": self._best,
            "report": self._report,
            "stages": self._stages.record(),
        }
        write_resume(out, "train", document, self._source, **found)

    def restore(self, kept: dict[str, Any]) -> list[dict[str, Any]]:
        """Continue from the content of a file of `keep`; return the evaluations so far.

        Raises:
            InvalidInput: If it does not belong to this training.
        """
        for name, example in (("evaluations", _EVALUATION), ("tried", {"seed": 0, **_EVALUATION})):
            for k, entry in enumerate(kept[name]):
                check_like(f"`{name}[{k}]`", entry, example)
        evaluations: list[dict[str, Any]] = kept["evaluations"]
        if kept.get("stages") is not None:
            self._stages.restore(kept["stages"], copy.deepcopy(self.trainer.policy))
            self._begin_at_stages()
        if kept["trainer"] is not None:
            updates = kept["trainer"]["counts"][1]
            if not evaluations or evaluations[-1]["updates"] != updates:
                raise InvalidInput(f"the last of `evaluations` must be after {updates} updates")
            restore(self.trainer, kept["trainer"])
        elif evaluations:
            raise InvalidInput("`evaluations` must be empty where no trainer is kept")
        self._tried = kept["tried"]
        if kept.get("best") is not None:
            like: dict[str, Any] = {**_BEST, "policy": dict(self.trainer.policy.state_dict())}
            check_like("`best`", kept["best"], like)
            self._best = kept["best"]
        if kept.get("report") is not None:
            check_like("`report`", kept["report"], _REPORT)
            self._report = kept["report"]
        return evaluations

    def run(self, out: Path, evaluations: list[dict[str, Any]]) -> str:
        """Learn until the end, and write the results."""
        if self._report is not None:
            return f"nothing is left to do: {self.trainer.updates} updates are done"
        spent = evaluations[-1]["seconds"] if evaluations else self._stages.seconds
        before = time.perf_counter() - spent
        try:
            if not evaluations:
                self._stages.run(partial(self._keep_stages, out))
                self._begin_at_stages()
            if self.section.tryout is not None:
                evaluations = self._try_out(out, self.section.tryout, before)
            self._learn(self._updates, evaluations, before, out / _EVENTS, out)
            self._report = self._reported(evaluations)
        except KeyboardInterrupt as error:
            kept = evaluations[-1]["updates"] if evaluations else 0
            raise KeyboardInterrupt(
                f"after {self.trainer.updates} updates, of which {kept} are kept: go on with  "
                f"diffcloth train --resume {out}"
            ) from error
        finally:
            if self._workers is not None:
                self._workers.close()
        if self.writes:
            self._write(out, evaluations)
            self._film(out)
        found = self._report
        low, high = found["interval"]
        seeds = [each["seed"] for each in self._tried]
        best = f"seed {self.trainer.options.seed}, the best of {seeds}: " if seeds else ""
        return best + (
            f"success {found['success']:.0%} ({low:.0%} to {high:.0%}) in {found['episodes']} "
            f"fresh episodes, return {found['return']:.4g}, {found['steps']} environment steps, "
            f"{found['minutes']:.1f} minutes; results are in {out}"
        )

    def _begin_at_stages(self) -> None:
        """Replace the trainer by one that begins at the policy of the stages, if there is one."""
        if self._stages.policy is not None:
            self.trainer = self._make(self._options, self._stages.policy)

    def _keep_stages(self, out: Path) -> None:
        if self.writes:
            self.keep(out, [])

    def _try_out(self, out: Path, tryout: TryoutSection, before: float) -> list[dict[str, Any]]:
        """Train each seed for a while; this object then trains the best one.

        Returns:
            All evaluations of the best one.
        """
        found = []
        for seed in tryout.seeds:
            self.trainer, self._best = self._make(replace(self._options, seed=seed)), None
            evaluations: list[dict[str, Any]] = []
            updates = min(tryout.updates, self._updates)
            self._learn(updates, evaluations, before, out / _EVENTS / f"seed_{seed}")
            self._tried.append({"seed": seed, **evaluations[-1]})
            found.append((self.trainer, self._best, evaluations))
            if self._succeeds(evaluations):
                break
        # The first one among equals.
        self.trainer, self._best, evaluations = max(found, key=lambda each: each[2][-1]["return"])
        trained = {**self.section.trainer, "seed": self.trainer.options.seed}
        self.section = self.section.model_copy(update={"trainer": trained, "tryout": None})
        if self.writes:
            self._write(out, evaluations)
        return evaluations

    def _learn(
        self,
        updates: int,
        evaluations: list[dict[str, Any]],
        before: float,
        log: Path,
        out: Path | None = None,
    ) -> None:
        """Learn until a number of updates is done or enough episodes succeed.

        Args:
            updates: Total number of updates at the end.
            evaluations: Evaluations so far; more are appended.
            before: Start time of the training.
            log: Folder of TensorBoard's events.
            out: Folder in which each evaluation and the best policy are kept.
        """
        from torch.utils.tensorboard import SummaryWriter

        trainer, section = self.trainer, self.section
        events: Any = SummaryWriter(log, purge_step=trainer.steps) if self.writes else None
        bar = tqdm(
            total=updates,
            initial=trainer.updates,
            desc="train" if section.tryout is None else f"seed {trainer.options.seed}",
            disable=None if self.writes else True,
        )
        try:
            while not evaluations or (
                trainer.updates < updates and not self._succeeds(evaluations)
            ):
                if evaluations:
                    scalars = trainer.update()
                    bar.update()
                    for name, value in scalars.items() if events else ():
                        events.add_scalar(name, value, trainer.steps)
                    if trainer.updates == self._updates:
                        trainer.check()
                    is_last = trainer.updates == updates
                    if trainer.updates % section.evaluate_every and not is_last:
                        continue
                found = self._evaluate()
                if self._is_looked_at([*evaluations, found]):
                    self._look()
                evaluations.append(found | {"seconds": time.perf_counter() - before})
                bar.set_postfix({"return": f"{found['return']:.4g}"})
                for name in ("return", "success") if events else ():
                    events.add_scalar(f"evaluation/{name}", found[name], trainer.steps)
                if self.writes and out is not None:
                    self._write(out, evaluations)
        finally:
            bar.close()
            if events:
                events.close()

    def _succeeds(self, evaluations: list[dict[str, Any]]) -> bool:
        enough = self.section.until_success
        return enough is not None and bool(evaluations[-1]["success"] >= enough)

    def _evaluate(self) -> dict[str, Any]:
        value, success, _ = self.trainer.evaluate(self.section.episodes)
        counts = {"updates": self.trainer.updates, "steps": self.trainer.steps}
        return counts | {"return": value, "success": success}

    def _is_looked_at(self, evaluations: list[dict[str, Any]]) -> bool:
        """Return whether an evaluated policy is compared with the best one.

        These are the last one, the first one of each share of the updates, and a policy of stages.
        """
        begins = len(evaluations) == 1 and bool(self.section.stages)
        if begins or self._succeeds(evaluations):
            return True
        updates = [each["updates"] for each in evaluations[-2:]]
        looks = _LOOKS - bool(self.section.stages)
        shares = [looks * count // max(self._updates, 1) for count in updates]
        return bool(shares[-1] > shares[0])

    def _look(self) -> None:
        """Keep the policy if it is better than the best one so far."""
        trainer, seed = self.trainer, purpose_seed(self.trainer.options.seed, "selection")
        found = evaluate(
            self._make_env,
            trainer.policy,
            self.section.selection_episodes,
            seed,
            workers=self._workers,
        )
        value = {"success": found.success_rate, "return": found.mean_return}
        if self._best is None or _is_better(value, self._best, len(found)):
            weights = {name: t.clone() for name, t in trainer.policy.state_dict().items()}
            self._best = {"updates": trainer.updates, **value, "policy": weights}

    def _policy(self) -> Policy:
        """The best policy so far, or the present one before the first look."""
        policy = copy.deepcopy(self.trainer.policy)
        if self._best is not None:
            policy.load_state_dict(self._best["policy"])
        return policy

    def _reported(self, evaluations: list[dict[str, Any]]) -> dict[str, Any]:
        """Evaluate the best policy at starts that were not used before."""
        seed = purpose_seed(self.trainer.options.seed, "report")
        found = evaluate(
            self._make_env,
            self._policy(),
            self.section.report_episodes,
            seed,
            workers=self._workers,
        )
        shares = {
            name: float(getattr(found, name).float().mean())
            for name in ("success", "ever", "failed", "blocked")
        }
        return {
            "episodes": len(found),
            **shares,
            "interval": list(found.interval),
            "return": found.mean_return,
            "steps": self._stages.steps + self.trainer.steps,
            "minutes": evaluations[-1]["seconds"] / 60,
        }

    @property
    def _starts(self) -> dict[str, list[int]]:
        """Seeds of the starts of each purpose."""
        seed, section = self.trainer.options.seed, self.section
        counts = (
            self.trainer.options.held_out or 0, section.selection_episodes, section.report_episodes
        )  # fmt: skip
        return {
            purpose: episode_seeds(purpose_seed(seed, purpose), count)
            for purpose, count in zip(PURPOSES, counts, strict=True)
        }

    def _write(self, out: Path, evaluations: list[dict[str, Any]]) -> None:
        config = self.section.model_dump(mode="json")
        best = None if self._best is None else {name: self._best[name] for name in _BEST}
        result = {
            "config": config,
            "evaluations": evaluations,
            "tried": self._tried,
            "starts": self._starts,
            "stages": self._stages.done,
            "best": best,
            "report": self._report,
        }
        write_metrics(out / _RESULT, result)
        self._policy().save(out / _POLICY)
        self.keep(out, evaluations, record_of(self.trainer))

    def _film(self, out: Path) -> None:
        """Show the best policy in the first episode of the report, or in the browser in several."""
        if not self.section.viewers:
            return
        seeds = self._starts["report"][: self.section.episodes]
        env = self._make_env(num_envs=len(seeds))
        env.reset(seed=seeds)
        points = env.task.goals(env.env_state)
        of_first = [] if points is None else [marker(p, _MARKER) for p in points[0].numpy()]
        _, _, states = follow(env, self._policy(), seeds)
        task, options = self.trainer.task, self.section.pictures.model_dump()
        scene: Scene = task.simulator.scene
        camera = Camera(**options["camera"])
        if "record" in self.section.viewers:
            pictures = Pictures(**{**options, "camera": camera})
            fps = 1 / (task.simulator.dt * task.substeps)
            with Record(
                out, scene, fps=fps, pictures=pictures, goals=of_first, name=_VIDEO
            ) as record:
                for state in states:
                    record.show(state[0])
        if "web" in self.section.viewers:
            show(scene, states, out / f"{_VIDEO}.html", camera=camera)


def _is_better(found: Mapping[str, Any], best: Mapping[str, Any], episodes: int) -> bool:
    """Return whether a policy has more success, or, equal up to chance, a larger return."""
    gain = found["success"] - best["success"]
    if abs(gain) > noise_of_success(episodes, found["success"], best["success"]):
        return bool(gain > 0)
    return bool(found["return"] > best["return"])


def _options(section: TrainConfig) -> dict[str, Any]:
    """Return the options of the trainer by their names; stages have others by default."""
    given = dict(section.trainer)
    if section.seed is not None:
        given["seed"] = section.seed
    if not section.stages:
        return given
    shape = {name: getattr(imitation.OPTIONS, name) for name in _SHAPE}
    last = section.stages[-1]
    algorithm = last.kind if isinstance(last, UpdateStage) else imitation.OPTIONS.algorithm
    return {**shape, "algorithm": algorithm, **given}


def _updates(section: TrainConfig) -> int:
    """Return the number of updates of the policy by the trainer."""
    if not section.stages:
        return _UPDATES if section.updates is None else section.updates
    last = section.stages[-1]
    return last.updates if isinstance(last, UpdateStage) else 0


def _writes(workers: _Workers) -> bool:
    return not isinstance(workers, Ranks) or workers.rank == 0


def _workers(section: WorkersSection) -> _Workers:
    deadline = section.deadline
    if section.kind == "processes":
        return Processes(section.count, deadline=deadline)
    if section.kind == "ray":
        return RayActors(section.count, cores=section.threads, deadline=deadline)
    return Ranks(deadline=deadline) if section.kind == "ranks" else None


def _named(where: str, options: type[TrainerOptions], given: dict[str, Any]) -> TrainerOptions:
    """Make options from a mapping, with lists as tuples."""
    accepted = [field.name for field in fields(options)]
    for name in given:
        if name not in accepted:
            raise InvalidInput(
                f"{where} may have {', '.join(accepted)}; got {name!r}{name_now(name)}"
            )
    values: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in given.items()}
    return options(**values)
