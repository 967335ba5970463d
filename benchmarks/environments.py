"""Environments for learning: transitions per second, and returns of handmade policies."""

from __future__ import annotations

import os
import resource
import sys
import time
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import click
import torch

from benchmarks.pages import around, share
from diffcloth_torch import envs
from diffcloth_torch.sim.solve import step as core_step

SIZES, BATCHES = (8, 12, 24), (1, 4, 8, 32)
POLICIES = ("zero", "random", "scripted", "replayed")
_MARKS = "<!-- returns -->\n", "<!-- end of returns -->\n"  # around the table on a page
_SEEDS = 1000, 2000  # seeds of the evaluated episodes and of the replayed one
_WARM_UP = 4  # transitions: pickers close


@click.command()
@click.option("--task", "tasks", multiple=True, type=click.Choice(list(envs.TASKS)))
@click.option(
    "--sizes", default=SIZES, multiple=True, type=click.IntRange(4), help="Vertices a side."
)
@click.option("--batches", default=BATCHES, multiple=True, type=click.IntRange(1))
@click.option("--threads", default=(1, 2), multiple=True, type=click.IntRange(1))
@click.option("--steps", default=20, show_default=True, type=click.IntRange(1))
@click.option("--returns", is_flag=True, help="What policies get instead.")
@click.option("--episodes", default=64, show_default=True, help="Of each policy, for --returns.")
@click.option("--size", default=7, show_default=True, help="Vertices a side, for --returns.")
@click.option(
    "--page",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Where to write the table of --returns, such as docs/environments.md.",
)
def main(
    tasks: Sequence[str],
    sizes: Sequence[int],
    batches: Sequence[int],
    threads: Sequence[int],
    steps: int,
    returns: bool,
    episodes: int,
    size: int,
    page: Path | None,
) -> None:
    """Environment steps a second, without and with gradients, under the scripted policy.

    FoldCloth by default, and for --returns all tasks. With gradients, the sum of the rewards of ten
    steps at a time is differentiated by the actions. Memory is the largest of the process so far.

    Rates use processor time, which excludes other programs: time outside of the core, plus the
    core's time divided by the threads. `python` is the share outside of the core. `waiting` is the
    share of wall-clock time beyond this sum: threads that wait for the last one, or for other
    programs.
    """
    if returns:
        print_returns(tasks or tuple(envs.TASKS), episodes, size, page)
        return
    print("environment steps a second; load of the machine", end=" ")
    print(f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print("task         size  batch  threads   forward  with gradients  python  waiting   MiB")
    for task, size, batch, count in product(tasks or ("FoldCloth",), sizes, batches, threads):
        torch.set_num_threads(count)
        env = envs.make(task, batch, size=size, horizon=10**6)
        script, start = _script(env, steps)
        forward, python, waiting = _forward(env, script)
        env.env_state = start
        backward = _backward(env, script, python)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(
            f"{task:12} {size:4d} {batch:6d} {count:8d} {batch * forward:9.1f} "
            f"{batch * backward:15.1f} {python:7.1%} {waiting:8.1%} {peak:5.0f}"
        )
        sys.stdout.flush()


def _forward(
    env: envs.ClothVectorEnv, script: Sequence[torch.Tensor]
) -> tuple[float, float, float]:
    """Steps per second, the share of Python in the required time, and the share of waiting."""
    in_core = 0.0  # time of this thread in calls of the core [s]
    call = core_step._forward

    def timed(*given: Any, **named: Any) -> Any:
        nonlocal in_core
        start = time.thread_time()
        result = call(*given, **named)
        in_core += time.thread_time() - start
        return result

    core_step._forward = timed
    try:
        before = time.perf_counter(), time.process_time(), time.thread_time()
        for actions in script:
            env.step(actions)
        after = time.perf_counter(), time.process_time(), time.thread_time()
    finally:
        core_step._forward = call
    seconds, all_threads, this_thread = (b - a for a, b in zip(before, after, strict=True))
    python = this_thread - in_core
    needed = python + (all_threads - python) / min(torch.get_num_threads(), env.num_envs)
    return len(script) / needed, python / needed, max(1 - needed / seconds, 0.0)


def _backward(env: envs.ClothVectorEnv, script: Sequence[torch.Tensor], python: float) -> float:
    """Steps per second with the gradient of the rewards of ten steps at a time.

    The share of Python is assumed to equal the share of steps without gradients.
    """
    start = time.process_time()
    for first in range(0, len(script), 10):
        leaves = [actions.clone().requires_grad_() for actions in script[first : first + 10]]
        env.clear_grad()
        total = sum(env.step(leaf)[1].sum() for leaf in leaves)
        torch.autograd.grad(total, leaves)
    env.clear_grad()
    spent = time.process_time() - start
    # Processor time per required second: time in the core counts for each thread.
    threads = min(torch.get_num_threads(), env.num_envs)
    return len(script) * (python + (1 - python) * threads) / spent


def _script(env: envs.ClothVectorEnv, steps: int) -> tuple[list[torch.Tensor], envs.EnvState]:
    """Scripted actions and their start, to which the environments are reset."""
    env.reset(seed=0)
    with torch.no_grad():
        for _ in range(_WARM_UP):
            env.step(env.scripted_actions())
        start = env.env_state
        script = []
        for _ in range(steps):
            script.append(env.scripted_actions())
            env.step(script[-1])
    env.env_state = start
    return script, start


def print_returns(tasks: Sequence[str], episodes: int, size: int, page: Path | None = None) -> None:
    """Print mean returns and success rates [%] of zero, random, scripted and replayed policies.

    Intervals are Wilson's, at 95 %. With a page the rows are also written there, between the lines
    `_MARKS`, where the row of a task replaces the former one.
    """
    print("| task | " + " | ".join(POLICIES) + " |")
    print("|---" * (1 + len(POLICIES)) + "|")
    for name in tasks:
        cells = []
        env = envs.make(name, episodes, size=size, autoreset_mode="Disabled")
        for policy in POLICIES:
            total, success = _episodes(env, policy)
            cells.append(f"{total:.1f}, {share(success, episodes)}")
        row = f"| `{name}` | " + " | ".join(cells) + " |"
        print(row)
        sys.stdout.flush()
        if page is not None:
            page.write_text(with_row(page.read_text(), row))


def with_row(text: str, row: str) -> str:
    """The text of a page with the row of a task in its table of returns."""
    begin, end = _MARKS
    before, table, after = around(text, begin, end)
    task = row.split("|")[1]
    rows = table.rstrip("\n").split("\n")
    places = [k for k, each in enumerate(rows) if each.split("|")[1:2] == [task]]
    rows[places[0] if places else len(rows) :] = [row, *(rows[places[0] + 1 :] if places else [])]
    return begin.join([before, "\n".join(rows) + "\n" + end]) + after


def _episodes(env: envs.ClothVectorEnv, policy: str) -> tuple[float, int]:
    """Mean return, and number of episodes that succeed, of one episode each."""
    shape = (env.num_envs, env.task.action_size)
    noise = torch.Generator().manual_seed(0)
    if policy == "replayed":
        one = envs.make(env.task.name, 1, size=env.task.side, autoreset_mode="Disabled")
        script = roll_out(one, lambda k: one.scripted_actions(), seed=_SEEDS[1])[2]
    act: dict[str, Callable[[int], torch.Tensor]] = {
        "zero": lambda k: torch.zeros(shape),
        "random": lambda k: 2 * torch.rand(shape, generator=noise) - 1,
        "scripted": lambda k: env.scripted_actions(),
        "replayed": lambda k: script[k].expand(shape),
    }
    total, success, _ = roll_out(env, act[policy], seed=_SEEDS[0])
    return float(total.mean()), int(success.sum())


def roll_out(
    env: envs.ClothVectorEnv, act: Callable[[int], torch.Tensor], seed: int
) -> tuple[torch.Tensor, torch.Tensor, list[torch.Tensor]]:
    """Returns [B], successes [B] and actions of one episode of each environment."""
    env.reset(seed=seed)
    total = torch.zeros(env.num_envs)
    success = torch.zeros(env.num_envs, dtype=torch.bool)
    running = ~success
    made = []
    for k in range(env.task.horizon):
        made.append(act(k))
        _, reward, terminated, truncated, info = env.step(made[-1])
        total += torch.where(running, reward, 0.0)
        success = torch.where(running, info["success"], success)
        running = running & ~(terminated | truncated)
        if not bool(running.any()):
            break
    return total, success, made


if __name__ == "__main__":
    main()
