"""Success of each method on each task, at starts that it was not trained on.

    python -m benchmarks.learning                     # all tasks, methods and seeds
    python -m benchmarks.learning FoldCloth --method imitate --seed 0
    python -m benchmarks.learning --only-show --page docs/learning.md

Each task, size, method, seed and budget is a line of JSON in docs/learning_methods.jsonl. Existing
lines are not repeated: a run continues where an earlier run ended, also on another machine. Rows
that inform most come first: methods that learn nothing, imitation, then six methods that learn from
rewards, all with the first seed; then other sizes and other seeds; plans at the end.

`return` and `success` are means over the episodes, `interval` is the Wilson interval of the success
at 95 %, `steps` the environment steps of learning, `minutes` its processor time. The success of
`plan` refers to the starts for which it plans, because it returns no policy.

The methods are described in `benchmarks/learning_methods.py`. Methods that learn from rewards have
30,000 environment steps on FoldCloth, LiftCloth, PushCube and HitCloth, and on the other tasks
10,000 and only the first seed.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import torch

from benchmarks.environments import roll_out
from benchmarks.learning_methods import FROM_REWARDS, METHODS, UNLEARNED, Job, learned
from benchmarks.learning_tables import listing, with_tables
from diffcloth_torch import envs
from diffcloth_torch.envs.env import steps_made
from diffcloth_torch.learn import Plans
from diffcloth_torch.learn.evaluation import wilson

LONG = ("FoldCloth", "LiftCloth", "PushCube", "HitCloth")  # tasks with the larger budget
BUDGETS = 30_000, 10_000
_FRESH = 10_000  # seed of the starts of evaluations


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.argument("tasks", nargs=-1, type=click.Choice(list(envs.TASKS)))
@click.option("--method", "methods", multiple=True, default=METHODS, type=click.Choice(METHODS))
@click.option("--seed", "seeds", multiple=True, default=(0, 1, 2), type=click.IntRange(0))
@click.option("--size", default=7, show_default=True, type=click.IntRange(4))
@click.option("--episodes", default=64, show_default=True, type=click.IntRange(1))
@click.option("--rounds", type=click.IntRange(1), help="Of `imitate`.")
@click.option("--starts", type=click.IntRange(1), help="Episodes of a round, or plans.")
@click.option("--steps", type=click.IntRange(1), help="Of methods that learn from rewards.")
@click.option(
    "--transfer",
    "others",
    multiple=True,
    default=(9, 12),
    show_default=True,
    type=click.IntRange(4),
    help="Sizes at which the policy of `imitate` is evaluated, too.",
)
@click.option(
    "--results",
    default="docs/learning_methods.jsonl",
    show_default=True,
    type=click.Path(dir_okay=False, path_type=Path),
)
@click.option(
    "--policies",
    default="results/learning",
    show_default=True,
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder of policies of `imitate`, which `transfer` evaluates.",
)
@click.option(
    "--page",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Where to write tables, such as docs/learning.md.",
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
    steps: int | None,
    others: Sequence[int],
    results: Path,
    policies: Path,
    page: Path | None,
    only_show: bool,
) -> None:
    torch.set_num_threads(1)
    given = {"rounds": rounds, "episodes": starts}
    changed = {name: value for name, value in given.items() if value is not None}
    rows = read(results)
    have = {key_of(row) for row in rows}
    work = jobs(tasks or tuple(envs.TASKS), methods, seeds, size, others, steps, changed, policies)
    for job in work:
        if only_show or job.key in have:
            continue
        row = measured(job, episodes)
        results.parent.mkdir(parents=True, exist_ok=True)
        with results.open("a") as file:
            file.write(json.dumps(row) + "\n")
        rows.append(row)
    print(listing(rows))
    if page is not None:
        page.write_text(with_tables(page.read_text(), rows))


def jobs(
    tasks: Sequence[str],
    methods: Sequence[str],
    seeds: Sequence[int],
    size: int,
    others: Sequence[int],
    steps: int | None,
    changed: Mapping[str, int],
    policies: Path,
) -> list[Job]:
    """All jobs, those that inform most first."""
    found = []
    for seed in seeds:
        for task in tasks:
            for method in methods:
                budget = 0
                if method in FROM_REWARDS:
                    budget = steps or BUDGETS[task not in LONG]
                    if task not in LONG and seed != seeds[0]:
                        continue
                if method == "transfer" and seed != seeds[0]:
                    continue
                found += [
                    Job(task, each, method, seed, budget, size, changed, policies)
                    for each in (others if method == "transfer" else [size])
                ]
    return sorted(found, key=lambda job: (_phase(job, seeds[0]), methods.index(job.method)))


def _phase(job: Job, first_seed: int) -> int:
    """Number of the part of the benchmark to which a job belongs."""
    if job.method == "plan":
        return 9
    if job.method in FROM_REWARDS and job.task not in LONG:
        return 8
    if job.method == "transfer":
        return 3
    phase = 0 if job.method in UNLEARNED else 1 if job.method == "imitate" else 2
    return phase if job.seed == first_seed else phase + 4


def key_of(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return task, size, method, seed and budget, which identify a row."""
    return tuple(row[name] for name in ("task", "size", "method", "seed", "budget"))


def read(path: Path) -> list[dict[str, Any]]:
    """Rows of a file of results; the end of a line that was cut off is left out."""
    if not path.exists():
        return []
    text = path.read_text()
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        path.write_text(whole)
    return [json.loads(line) for line in whole.splitlines()]


def measured(job: Job, episodes: int) -> dict[str, Any]:
    """The row of a job."""
    steps, seconds = steps_made(), time.process_time()
    found = learned(job)
    steps, seconds = steps_made() - steps, time.process_time() - seconds
    if isinstance(found, Plans):
        returns, success = found.returns, found.success
    else:
        env = job.make(num_envs=episodes, autoreset_mode="Disabled")
        with torch.no_grad():
            returns, success, _ = roll_out(env, found(env), _FRESH + job.seed)
    count, done = len(success), int(success.sum())
    return {
        **dict(zip(("task", "size", "method", "seed", "budget"), job.key, strict=True)),
        "episodes": count,
        "return": round(float(returns.mean()), 4),
        "success": done / count,
        "interval": [round(bound, 4) for bound in wilson(done, count)],
        "steps": steps,
        "minutes": round(seconds / 60, 3),
        "options": job.options,
        "given": dict(job.changed),
        "revision": _revision(),
    }


def _revision() -> str:
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    here = Path(__file__).parent
    return subprocess.run(
        command, cwd=here, capture_output=True, text=True, check=True
    ).stdout.strip()


if __name__ == "__main__":
    main()
