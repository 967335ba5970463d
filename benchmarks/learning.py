"""Policies by gradients beside PPO and SAC of Stable-Baselines3: returns against steps and time."""

from __future__ import annotations

import json
import math
import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
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

CONFIGS = {
    "FoldCloth": "configs/train_fold.yaml",
    "PushCube": "configs/train_push.yaml",
    "LiftCloth": "configs/train_lift.yaml",
}
# What the other algorithm has in place of the configuration's.
APG = {"algorithm": "apg", "discount": 1.0}
SHAC = {"algorithm": "shac", "horizon": 16, "discount": 0.99, "actor_rate": 1e-3}
ALGORITHMS = ("plan", "apg", "shac", "ppo", "sac")
KNOTS, PLAN_RATE = 10, 0.02  # of a plan: actions that last a tenth of an episode
_EPISODES = 8  # of an evaluation


@click.command()
@click.option("--tasks", multiple=True, default=("FoldCloth",), type=click.Choice(list(CONFIGS)))
@click.option("--algorithms", multiple=True, default=ALGORITHMS, type=click.Choice(ALGORITHMS))
@click.option("--seeds", default=3, show_default=True, type=click.IntRange(1))
@click.option("--steps", default=7000, show_default=True, help="Environment steps of a run.")
@click.option("--free-steps", default=7000, show_default=True, help="The same of PPO and SAC.")
@click.option("--evaluations", default=12, show_default=True, type=click.IntRange(2))
@click.option("--jobs", default=2, show_default=True, help="Runs at once, one core each.")
@click.option("--json", "file", type=click.Path(path_type=Path), help="Also write the curves.")
@click.option("--plot", type=click.Path(path_type=Path), help="Also draw them.")
def main(
    tasks: Sequence[str],
    algorithms: Sequence[str],
    seeds: int,
    steps: int,
    free_steps: int,
    evaluations: int,
    jobs: int,
    file: Path | None,
    plot: Path | None,
) -> None:
    """Train with each algorithm and seed, and evaluate without noise on the way.

    `plan` is no policy: it optimizes the actions of one episode, whose return it is.

    Prints the median over seeds of the best mean return, how many environment steps and seconds
    each needed to reach the best that PPO reached, and the share of successes at the end. The time
    of evaluations does not count.
    """
    work = [
        (task, algorithm, seed, free_steps if algorithm in ("ppo", "sac") else steps, evaluations)
        for task in tasks
        for algorithm in algorithms
        for seed in range(seeds)
    ]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        curves = list(pool.map(_run, work))
    runs = [
        {"task": t, "algorithm": a, "seed": s, "curve": curve}
        for (t, a, s, *_), curve in zip(work, curves, strict=True)
    ]
    for task in tasks:
        _print(task, [run for run in runs if run["task"] == task])
    if file is not None:
        file.write_text(json.dumps(runs, indent=1))
    if plot is not None:
        draw(runs, plot)


def _print(task: str, runs: Sequence[dict[str, Any]]) -> None:
    goals = [_best(run) for run in runs if run["algorithm"] == "ppo"]
    goal = statistics.median(goals) if goals else math.nan
    print(f"{task}: goal {goal:.2f}, the median of PPO's best")
    print("algorithm   first     best      last  success   steps to goal  seconds to goal  seconds")
    for algorithm in ALGORITHMS:
        mine = [run for run in runs if run["algorithm"] == algorithm]
        if not mine:
            continue
        columns = [
            statistics.median(values)
            for values in zip(*[_summary(run["curve"], goal) for run in mine], strict=True)
        ]
        first, best, last, success, at, after, seconds = columns
        print(
            f"{algorithm:9}{first:8.2f} {best:8.2f} {last:9.2f} {success:8.0%} {at:15.0f} "
            f"{after:16.0f} {seconds:8.0f}"
        )


def _best(run: dict[str, Any]) -> float:
    return max(point["return"] for point in run["curve"])


def _summary(curve: Sequence[dict[str, float]], goal: float) -> list[float]:
    reached = [point for point in curve if point["return"] >= goal]
    at, after = (reached[0]["steps"], reached[0]["seconds"]) if reached else (math.inf, math.inf)
    best = max(point["return"] for point in curve)
    end = curve[-1]
    return [curve[0]["return"], best, end["return"], end["success"], at, after, end["seconds"]]


def _run(work: tuple[str, str, int, int, int]) -> list[dict[str, float]]:
    torch.set_num_threads(1)
    task, algorithm, seed, steps, evaluations = work
    document = read_document(Path(CONFIGS[task]))
    make = partial(envs.make, task, **document["environment"].get("options", {}))
    every = steps / (evaluations - 1)
    first = document["trainer"].get("first_action")
    if algorithm == "plan":
        return _plan(make, first, seed, steps)
    if algorithm in ("ppo", "sac"):
        return _free(make, algorithm, seed, steps, every, first)
    given = dict(document["trainer"])
    if given["algorithm"] != algorithm:
        given |= APG if algorithm == "apg" else SHAC
    options = {n: tuple(v) if isinstance(v, list) else v for n, v in given.items()}
    trainer = Trainer(
        make, TrainerOptions(**{**options, "seed": seed}), num_envs=document["num_envs"]
    )
    curve = _Curve(make, trainer.act)
    curve.add(0)
    while trainer.steps < steps:
        trainer.update()
        if trainer.steps >= every * len(curve.points):
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
    begin = time.perf_counter()
    while not points or points[-1]["steps"] < steps:
        env.reset(seed=1000 + seed)
        total = torch.zeros(())
        for k in range(horizon):
            _, reward, _, _, info = env.step(plan[None, k * KNOTS // horizon])
            total = total + reward.sum()
        points.append(
            {
                "steps": float(horizon * (len(points) + 1)),
                "seconds": time.perf_counter() - begin,
                "return": float(total.detach()),
                "success": float(info["final_info"]["success"]),
            }
        )
        adam.zero_grad()
        (-total).backward()
        adam.step()
        with torch.no_grad():
            plan.clamp_(-1, 1)
    return points


class _Curve:
    """Returns of evaluations; their own time does not count."""

    def __init__(self, make: Callable[..., Any], act: Callable[[torch.Tensor], Any]) -> None:
        self.points: list[dict[str, float]] = []
        self._env, self._act = make(num_envs=_EPISODES), act
        self._start = time.perf_counter()

    def add(self, steps: int) -> None:
        begin = time.perf_counter()
        env = self._env
        observation, _ = env.reset(seed=1000)
        total = torch.zeros(_EPISODES)
        running = torch.ones(_EPISODES, dtype=torch.bool)
        success = torch.zeros(_EPISODES, dtype=torch.bool)
        with torch.no_grad():
            while bool(running.any()):
                actions = torch.as_tensor(self._act(observation))
                observation, reward, terminated, truncated, info = env.step(actions)
                total += torch.where(running, reward, 0.0)
                success = torch.where(running, info.get("final_info", info)["success"], success)
                running = running & ~(terminated | truncated)
        point = {
            "steps": float(steps),
            "seconds": begin - self._start,
            "return": float(total.mean()),
            "success": float(success.float().mean()),
        }
        self.points.append(point)
        self._start += time.perf_counter() - begin


def _free(
    make: Callable[..., Any],
    algorithm: str,
    seed: int,
    steps: int,
    every: float,
    first: Sequence[float] | None,
) -> list[dict[str, float]]:
    """PPO or SAC with their usual options, on as many environments, from the same first action."""
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.callbacks import BaseCallback

    from diffcloth_torch.envs.stable_baselines import StableBaselinesEnv

    class Begun(StableBaselinesEnv):
        def step_async(self, actions: Any) -> None:
            super().step_async(begun(actions))

    def begun(actions: Any) -> Any:
        return actions if first is None else np.clip(actions + np.float32(first), -1, 1)

    env = Begun(make(num_envs=4, seed=seed))
    if algorithm == "ppo":
        model: Any = PPO("MlpPolicy", env, n_steps=128, batch_size=64, seed=seed, device="cpu")
    else:
        model = SAC(
            "MlpPolicy", env, learning_starts=400, gradient_steps=-1, seed=seed, device="cpu"
        )
    curve = _Curve(make, lambda seen: begun(model.predict(seen.numpy(), deterministic=True)[0]))
    curve.add(0)

    class Evaluate(BaseCallback):  # type: ignore[misc]
        def _on_step(self) -> bool:
            if self.num_timesteps >= every * len(curve.points):
                curve.add(self.num_timesteps)
            return True

    model.learn(steps, callback=Evaluate())
    return curve.points


def draw(runs: Sequence[dict[str, Any]], path: Path) -> None:
    """Returns against environment steps and against time: medians, and the range of the seeds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    tasks = list(dict.fromkeys(run["task"] for run in runs))
    figure, axes = plt.subplots(len(tasks), 2, figsize=(9, 3.2 * len(tasks)), squeeze=False)
    for row, task in zip(axes, tasks, strict=True):
        for axis, (key, label) in zip(
            row, (("steps", "environment steps"), ("seconds", "seconds on one core")), strict=True
        ):
            for k, algorithm in enumerate(ALGORITHMS):
                curves = [
                    r["curve"] for r in runs if r["task"] == task and r["algorithm"] == algorithm
                ]
                if not curves:
                    continue
                end = min(curve[-1][key] for curve in curves)
                at = np.linspace(0, end, 60)
                returns = np.array(
                    [np.interp(at, [p[key] for p in c], [p["return"] for p in c]) for c in curves]
                )
                axis.plot(at, np.median(returns, axis=0), color=f"C{k}", label=algorithm.upper())
                axis.fill_between(at, returns.min(0), returns.max(0), color=f"C{k}", alpha=0.15)
            axis.set(xlabel=label, ylabel="return", title=task)
            axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


if __name__ == "__main__":
    main()
