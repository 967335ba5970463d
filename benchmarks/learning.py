"""Success of each method on each task, at starts that it was not trained on.

    python -m benchmarks.learning FoldCloth --method imitate --seed 0
    python -m benchmarks.learning                     # all tasks and methods, seeds 0, 1 and 2
    python -m benchmarks.learning --only-show

Each task, method and seed is a line of JSON in the file of results; existing lines are not
repeated. `return` and `success` are means over the episodes, `interval` is the Wilson interval of
the success at 95 %, `steps` the environment steps of learning, `minutes` its processor time.

`zero`, `random` and `script` learn nothing; `replay` repeats the actions of one scripted episode.
`imitate` is `dc.learn.imitate` of the script. `plan` is `dc.learn.plan`: its success refers to the
starts for which it plans, because it returns no policy.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import click
import torch

from benchmarks.environments import roll_out
from diffcloth_torch import envs
from diffcloth_torch.learn import imitate, plan
from diffcloth_torch.learn.evaluation import wilson

METHODS = ("zero", "random", "script", "replay", "imitate", "plan")
SOFT = {"opens_at": -1.0, "reach": 0.06}  # grasps with gradients
SHEETS = ("FoldCloth", "FoldClothDiagonal", "SpreadCloth", "DropCloth", "FlingCloth")
_FRESH = 10_000  # seed of the starts of evaluations
_REPLAYED = 20_000  # and of the episode that is replayed

Result = tuple[torch.Tensor, torch.Tensor, int, float]
"""Returns [n], successes [n], environment steps and seconds of learning."""


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.argument("tasks", nargs=-1, type=click.Choice(list(envs.TASKS)))
@click.option("--method", "methods", multiple=True, default=METHODS, type=click.Choice(METHODS))
@click.option("--seed", "seeds", multiple=True, default=(0, 1, 2), type=click.IntRange(0))
@click.option("--size", default=7, show_default=True, type=click.IntRange(4))
@click.option("--episodes", default=64, show_default=True, type=click.IntRange(1))
@click.option("--rounds", type=click.IntRange(1), help="Of `imitate`.")
@click.option("--starts", type=click.IntRange(1), help="Episodes of a round, or plans.")
@click.option(
    "--results",
    default="results/learning.jsonl",
    show_default=True,
    type=click.Path(dir_okay=False, path_type=Path),
)
@click.option("--only-show", is_flag=True, help="Run nothing: show what the file has.")
def main(
    tasks: Sequence[str],
    methods: Sequence[str],
    seeds: Sequence[int],
    size: int,
    episodes: int,
    rounds: int | None,
    starts: int | None,
    results: Path,
    only_show: bool,
) -> None:
    torch.set_num_threads(1)
    rows = read(results)
    have = {key_of(row) for row in rows}
    given = {"rounds": rounds, "episodes": starts}
    changed = {name: value for name, value in given.items() if value is not None}
    for task in tasks or tuple(envs.TASKS):
        for method in methods:
            for seed in seeds:
                if only_show or (task, size, method, seed) in have:
                    continue
                row = measured(task, size, method, seed, episodes, changed)
                results.parent.mkdir(parents=True, exist_ok=True)
                with results.open("a") as file:
                    file.write(json.dumps(row) + "\n")
                rows.append(row)
    show(rows)


def key_of(row: dict[str, Any]) -> tuple[str, int, str, int]:
    """Return task, size, method and seed, which identify a row."""
    return row["task"], row["size"], row["method"], row["seed"]


def read(path: Path) -> list[dict[str, Any]]:
    """Rows of a file of results; the end of a line that was cut off is left out."""
    if not path.exists():
        return []
    text = path.read_text()
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        path.write_text(whole)
    return [json.loads(line) for line in whole.splitlines()]


def show(rows: Sequence[dict[str, Any]]) -> None:
    """Print the rows as a table."""
    print("| task | size | method | seed | return | success | steps | minutes |")
    print("|---" * 8 + "|")
    for row in sorted(rows, key=lambda r: (r["task"], METHODS.index(r["method"]), r["seed"])):
        low, high = row["interval"]
        share = f"{row['success']:.0%} ({low:.0%} to {high:.0%})".replace("%", " %")
        print(
            f"| `{row['task']}` | {row['size']} | {row['method']} | {row['seed']} | "
            f"{row['return']:.1f} | {share} of {row['episodes']} | {row['steps']} | "
            f"{row['minutes']:.1f} |"
        )
    sys.stdout.flush()


def measured(
    task: str, size: int, method: str, seed: int, episodes: int, changed: dict[str, int]
) -> dict[str, Any]:
    """The row of a task, a method and a seed."""
    make = partial(envs.make, task, size=size)
    run = {"imitate": _imitate, "plan": _plan}.get(method, partial(_unlearned, method))
    returns, success, steps, seconds = run(make, seed, episodes, changed)
    count, done = len(success), int(success.sum())
    return {
        "task": task,
        "size": size,
        "method": method,
        "seed": seed,
        "episodes": count,
        "return": round(float(returns.mean()), 4),
        "success": done / count,
        "interval": [round(bound, 4) for bound in wilson(done, count)],
        "steps": steps,
        "minutes": round(seconds / 60, 3),
        "given": changed,
    }


def _imitate(make: Callable[..., Any], seed: int, episodes: int, changed: dict[str, int]) -> Result:
    with _counted() as learned:
        policy = imitate(make, "scripted", seed=seed, **changed)
    env = make(num_envs=episodes, autoreset_mode="Disabled")
    with torch.no_grad():
        returns, success, _ = roll_out(
            env, lambda _: policy(env.initialize_trajectory()), _FRESH + seed
        )
    return returns, success, *learned


def _plan(make: Callable[..., Any], seed: int, _: int, changed: dict[str, int]) -> Result:
    soft = SOFT if make(num_envs=1).task.name in SHEETS else {}
    given = {name: value for name, value in changed.items() if name != "rounds"}
    with _counted() as learned:
        plans = plan(partial(make, **soft), seed=seed, **given)
    return plans.returns, plans.success, *learned


def _unlearned(
    method: str, make: Callable[..., Any], seed: int, episodes: int, _: dict[str, int]
) -> Result:
    env = make(num_envs=episodes, autoreset_mode="Disabled")
    shape = episodes, env.task.action_size
    noise = torch.Generator().manual_seed(seed)
    script: list[torch.Tensor] = []
    if method == "replay":
        one = make(num_envs=1, autoreset_mode="Disabled")
        script = roll_out(one, lambda _: one.scripted_actions(), _REPLAYED + seed)[2]
    act: dict[str, Callable[[int], torch.Tensor]] = {
        "zero": lambda _: torch.zeros(shape),
        "random": lambda _: 2 * torch.rand(shape, generator=noise) - 1,
        "script": lambda _: env.scripted_actions(),
        "replay": lambda k: script[k].expand(shape),
    }
    returns, success, _made = roll_out(env, act[method], _FRESH + seed)
    return returns, success, 0, 0.0


@contextmanager
def _counted() -> Iterator[list[Any]]:
    """Environment steps and processor seconds of a block; known after it."""
    counts: list[Any] = []
    transition, steps, begin = envs.Task.transition, 0, time.process_time()

    def counting(task: envs.Task, env: envs.EnvState, *given: Any) -> envs.EnvState:
        nonlocal steps
        steps += len(env)
        return transition(task, env, *given)

    envs.Task.transition = counting  # type: ignore[method-assign]
    try:
        yield counts
    finally:
        envs.Task.transition = transition  # type: ignore[method-assign]
        counts += [steps, time.process_time() - begin]


if __name__ == "__main__":
    main()
