"""Policies by gradients beside PPO and SAC of Stable-Baselines3: returns against steps and time."""

from __future__ import annotations

import json
import math
import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch

from diffcloth_torch import envs
from diffcloth_torch.config.documents import read_document
from diffcloth_torch.learn import Trainer, TrainerOptions


@dataclass(frozen=True)
class Job:
    """A task: its configuration, vertices per side, and environment steps of a run.

    Attributes:
        free_steps: Environment steps of PPO and SAC, which need more.
    """

    config: str
    size: int
    steps: int
    free_steps: int


JOBS = {
    # An odd size, so that a row of vertices lies on the fold line; otherwise no policy succeeds.
    "FoldCloth": Job("configs/train_fold_gradients.yaml", 9, 1400, 10_000),
    "PushCube": Job("configs/train_push_gradients.yaml", 8, 640, 1600),
    "LiftCloth": Job("configs/train_lift_gradients.yaml", 6, 600, 1500),
}
FIRST_ORDER, FREE = ("planned", "apg", "shac", "sapo"), ("ppo", "sac")
ALGORITHMS = ("scripted", "plan", *FIRST_ORDER, *FREE)
# Variants for FoldCloth only: a plan with hard grasps, APG with gradients through observations, and
# a planned policy with one scale for each tensor.
VARIANTS = ("hard", "feedback", "scaled")
# Options for all tasks: APG uses whole episodes, the others halves with a critic's final value.
COMMON: dict[str, Any] = {"betas": (0.9, 0.99), "init_std": 0.05, "target_entropy": -2.0}
APG: dict[str, Any] = {"discount": 1.0, "learning_rate": 4e-3}
PLANNED: dict[str, Any] = APG | {
    "plan_knots": 12,
    "plan_learning_rate": 0.03,
    "learning_rate": 6e-4,
}
SCALED: dict[str, Any] = PLANNED | {
    "scale": "tensor",
    "plan_learning_rate": 0.02,
    "learning_rate": 3e-4,
}
WITH_CRITIC = {"discount": 0.99, "learning_rate": 2e-3}
NUM_ENVS, FREE_ENVS = 2, 4
LABELS = {"plan": "plan", "planned": "APG, planned"}
KNOTS, PLAN_RATE = 10, 0.02  # of a plan: actions that last a tenth of an episode
EPISODES = 4  # of an evaluation


@click.command()
@click.option("--tasks", multiple=True, default=tuple(JOBS), type=click.Choice(list(JOBS)))
@click.option(
    "--algorithms",
    multiple=True,
    default=(*ALGORITHMS, *VARIANTS),
    type=click.Choice((*ALGORITHMS, *VARIANTS)),
)
@click.option("--seeds", default=3, show_default=True, type=click.IntRange(1))
@click.option("--share", default=1.0, show_default=True, help="Of the steps of all runs.")
@click.option("--evaluations", default=6, show_default=True, type=click.IntRange(2))
@click.option("--jobs", default=2, show_default=True, help="Runs at once, one core each.")
@click.option("--json", "file", type=click.Path(path_type=Path), help="File that keeps the runs.")
@click.option("--plot", type=click.Path(path_type=Path), help="Also draw them.")
@click.option("--only-show", is_flag=True, help="Run nothing: show what the file has.")
def main(
    tasks: Sequence[str],
    algorithms: Sequence[str],
    seeds: int,
    share: float,
    evaluations: int,
    jobs: int,
    file: Path | None,
    plot: Path | None,
    only_show: bool,
) -> None:
    """Train with each algorithm and seed, and evaluate without noise during training.

    `plan` is no policy: it optimizes the actions of one episode and reports its return. `planned`
    is APG with a policy that consists of a plan, a linear function of the observation and a
    network; `apg` has only the network. `scripted` is the handmade policy. FoldCloth has three
    more: `hard`, a plan with hard grasps, `feedback`, APG with gradients through observations, and
    `scaled`, `planned` with the scale "tensor". A file stores completed runs, which are not
    repeated.

    Prints the median over seeds of the best mean return, the environment steps and seconds of one
    core that each algorithm needed to reach PPO's best return, and the share of successes at the
    end. The time of evaluations does not count.
    """
    runs: list[dict[str, Any]] = []
    if file is not None and file.exists():
        runs = json.loads(file.read_text())
    have = {(r["task"], r["algorithm"], r["seed"]) for r in runs}
    work = [
        (task, algorithm, seed, share, evaluations)
        for seed in range(seeds)
        for task in tasks
        for algorithm in algorithms
        if (task, algorithm, seed) not in have and not only_show
        if task == "FoldCloth" or algorithm not in VARIANTS
    ]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for work_of_one in as_completed([pool.submit(_run, one) for one in work]):
            runs.append(work_of_one.result())
            if file is not None:
                file.write_text(_document(runs))
    for task in tasks:
        _print(task, [run for run in runs if run["task"] == task])
    if plot is not None:
        draw(runs, plot)


def _document(runs: Sequence[dict[str, Any]]) -> str:
    """JSON text with one run per line, in a fixed order."""
    order = (*ALGORITHMS, *VARIANTS)
    rows = sorted(runs, key=lambda r: (r["task"], order.index(r["algorithm"]), r["seed"]))
    return "[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n"


def _print(task: str, runs: Sequence[dict[str, Any]]) -> None:
    goals = [max(p["return"] for p in run["curve"]) for run in runs if run["algorithm"] == "ppo"]
    goal = statistics.median(goals) if goals else math.nan
    print(f"{task}: goal {goal:.2f}, the median of PPO's best")
    print(
        "algorithm  seeds   first     best      last  success  steps to goal  seconds to it  steps"
    )
    for algorithm in (*ALGORITHMS, *VARIANTS):
        mine = [run for run in runs if run["algorithm"] == algorithm]
        if not mine:
            continue
        columns = [
            statistics.median(values)
            for values in zip(*[_summary(run["curve"], goal) for run in mine], strict=True)
        ]
        first, best, last, success, at, after, steps = columns
        print(
            f"{algorithm:9}{len(mine):6d}{first:8.2f}{best:8.2f}{last:8.2f} {success:7.0%} "
            f"{at:14.0f} {after:14.1f} {steps:6.0f}"
        )


def _summary(curve: Sequence[dict[str, float]], goal: float) -> list[float]:
    reached = [point for point in curve if point["return"] >= goal]
    at, after = (reached[0]["steps"], reached[0]["seconds"]) if reached else (math.inf, math.inf)
    best = max(point["return"] for point in curve)
    end = curve[-1]
    return [curve[0]["return"], best, end["return"], end["success"], at, after, end["steps"]]


def _run(work: tuple[str, str, int, float, int]) -> dict[str, Any]:
    torch.set_num_threads(1)
    task, algorithm, seed, share, evaluations = work
    job = JOBS[task]
    document = read_document(Path(job.config))
    given = document["environment"].get("options", {}) | {"size": job.size}
    make = partial(envs.make, task, **given)
    first = document["trainer"].get("first_action")
    steps = round(share * (job.free_steps if algorithm in FREE else job.steps))
    # Evaluations are denser at first, when returns change most; none follows the last.
    due = [steps * (k / (evaluations - 1)) ** 2 for k in range(evaluations)] + [math.inf]
    if algorithm == "scripted":
        curve = _scripted(make)
    elif algorithm == "plan":
        curve = _plan(make, first, seed, steps)
    elif algorithm == "hard":
        hard = {n: v for n, v in given.items() if n not in ("opens_at", "reach")}
        curve = _plan(partial(envs.make, task, **hard), first, seed, steps)
    elif algorithm in FREE:
        curve = _free(make, algorithm, seed, steps, due, first)
    else:
        curve = _first_order(make, algorithm, seed, steps, due, first)
    return {"task": task, "algorithm": algorithm, "seed": seed, "curve": curve}


def _point(steps: int, seconds: float, value: float, success: float) -> dict[str, float]:
    return {
        "steps": steps,
        "seconds": round(seconds, 2),
        "return": round(value, 4),
        "success": success,
    }


def _scripted(make: Callable[..., Any]) -> list[dict[str, float]]:
    curve = _Curve(make, None)
    curve.add(0)
    return curve.points


def _first_order(
    make: Callable[..., Any],
    algorithm: str,
    seed: int,
    steps: int,
    due: Sequence[float],
    first: Sequence[float] | None,
) -> list[dict[str, float]]:
    """A policy by gradients, of which the learning rate falls to half."""
    episode = make(num_envs=1).task.horizon
    has_critic = algorithm in ("shac", "sapo")
    horizon = episode // 2 if has_critic else episode
    of_apg = {"planned": PLANNED, "scaled": SCALED}.get(algorithm, APG)
    options = TrainerOptions(
        algorithm=algorithm if has_critic else "apg",
        feedback=algorithm == "feedback",
        horizon=horizon,
        decay_updates=2 * steps // (NUM_ENVS * horizon),
        first_action=None if first is None else tuple(first),
        seed=seed,
        **COMMON,
        **(WITH_CRITIC if has_critic else of_apg),
    )
    trainer = Trainer(make, options, num_envs=NUM_ENVS)
    curve = _Curve(make, trainer.act)
    curve.add(0)
    while trainer.steps < steps:
        trainer.update()
        if trainer.steps >= due[len(curve.points)]:
            curve.add(trainer.steps)
    return curve.points


def _plan(
    make: Callable[..., Any], first: Sequence[float] | None, seed: int, steps: int
) -> list[dict[str, float]]:
    """The actions of one episode, by Adam."""
    env = make(num_envs=1)
    horizon = env.task.horizon
    start = torch.zeros(env.task.action_size) if first is None else torch.tensor(first)
    plan = start.repeat(KNOTS, 1).requires_grad_()
    adam = torch.optim.Adam([plan], lr=PLAN_RATE)
    points: list[dict[str, float]] = []
    begin = time.process_time()
    while not points or points[-1]["steps"] < steps:
        env.reset(seed=1000 + seed)
        total = torch.zeros(())
        for k in range(horizon):
            _, reward, _, _, info = env.step(plan[None, k * KNOTS // horizon])
            total = total + reward.sum()
        success = float(info["final_info"]["success"])
        at = horizon * (len(points) + 1)
        points.append(_point(at, time.process_time() - begin, float(total.detach()), success))
        adam.zero_grad()
        (-total).backward()
        adam.step()
        with torch.no_grad():
            plan.clamp_(-1, 1)
    return points


class _Curve:
    """Returns of evaluations; their own time does not count."""

    def __init__(self, make: Callable[..., Any], act: Callable[[torch.Tensor], Any] | None) -> None:
        """Evaluate the policy `act`, or the handmade one for None."""
        self.points: list[dict[str, float]] = []
        self._env, self._act = make(num_envs=EPISODES), act
        self._start = time.process_time()

    def add(self, steps: int) -> None:
        begin = time.process_time()
        env = self._env
        observation, _ = env.reset(seed=1000)
        total = torch.zeros(EPISODES)
        running = torch.ones(EPISODES, dtype=torch.bool)
        success = torch.zeros(EPISODES, dtype=torch.bool)
        with torch.no_grad():
            while bool(running.any()):
                scripted = env.scripted_actions() if self._act is None else None
                actions = scripted if self._act is None else self._act(observation)
                observation, reward, terminated, truncated, info = env.step(actions)
                total += torch.where(running, reward, 0.0)
                success = torch.where(running, info.get("final_info", info)["success"], success)
                running = running & ~(terminated | truncated)
        seconds = begin - self._start
        self.points.append(
            _point(steps, seconds, float(total.mean()), float(success.float().mean()))
        )
        self._start += time.process_time() - begin


def _free(
    make: Callable[..., Any],
    algorithm: str,
    seed: int,
    steps: int,
    due: Sequence[float],
    first: Sequence[float] | None,
) -> list[dict[str, float]]:
    """PPO or SAC from the same first action.

    Options have their usual values, except that PPO learns every 256 steps and starts with less
    noise: with 2048 steps and a deviation of 1 it learns nothing in so few steps.
    """
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.callbacks import BaseCallback

    from diffcloth_torch.envs.stable_baselines import StableBaselinesEnv

    class Begun(StableBaselinesEnv):
        def step_async(self, actions: Any) -> None:
            super().step_async(begun(actions))

    def begun(actions: Any) -> Any:
        return actions if first is None else np.clip(actions + np.float32(first), -1, 1)

    env = Begun(make(num_envs=FREE_ENVS, seed=seed))
    if algorithm == "ppo":
        model: Any = PPO(
            "MlpPolicy",
            env,
            n_steps=64,
            policy_kwargs={"log_std_init": -1.0},
            seed=seed,
            device="cpu",
        )
    else:
        model = SAC(
            "MlpPolicy", env, learning_starts=400, gradient_steps=-1, seed=seed, device="cpu"
        )
    curve = _Curve(make, lambda seen: begun(model.predict(seen.numpy(), deterministic=True)[0]))
    curve.add(0)

    class Evaluate(BaseCallback):  # type: ignore[misc]
        def _on_step(self) -> bool:
            if self.num_timesteps >= due[len(curve.points)]:
                curve.add(self.num_timesteps)
            return True

    model.learn(steps, callback=Evaluate())
    return curve.points


def draw(runs: Sequence[dict[str, Any]], path: Path) -> None:
    """Returns against environment steps and against time: medians, and the range of the seeds."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "learning"})
    import matplotlib.pyplot as plt

    tasks = [task for task in JOBS if any(run["task"] == task for run in runs)]
    figure, axes = plt.subplots(len(tasks), 2, figsize=(9, 3.0 * len(tasks)), squeeze=False)
    for row, task in zip(axes, tasks, strict=True):
        for axis, key in zip(row, ("steps", "seconds"), strict=True):
            _draw_task(axis, key, [run for run in runs if run["task"] == task])
            label = "environment steps" if key == "steps" else "seconds of one core"
            axis.set(xlabel=label, ylabel="return", title=task)
            axis.set_xscale("symlog", linthresh=100 if key == "steps" else 1)
            axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].legend(frameon=False, fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_task(axis: Any, key: str, runs: Sequence[dict[str, Any]]) -> None:
    for k, algorithm in enumerate(ALGORITHMS):
        curves = [r["curve"] for r in runs if r["algorithm"] == algorithm]
        if not curves:
            continue
        if algorithm == "scripted":
            axis.axhline(curves[0][0]["return"], color="0.5", ls=":", label="scripted")
            continue
        end = min(curve[-1][key] for curve in curves)
        at = np.linspace(0, end, 40)
        returns = np.array(
            [np.interp(at, [p[key] for p in c], [p["return"] for p in c]) for c in curves]
        )
        label = LABELS.get(algorithm, algorithm.upper())
        axis.plot(at, np.median(returns, axis=0), color=f"C{k}", label=label)
        axis.fill_between(at, returns.min(0), returns.max(0), color=f"C{k}", alpha=0.15)


if __name__ == "__main__":
    main()
