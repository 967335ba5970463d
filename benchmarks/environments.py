"""Environments for learning: transitions a second, and what policies made by hand get."""

from __future__ import annotations

import os
import resource
import sys
import time
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import click
import torch

from diffcloth_torch import envs
from diffcloth_torch.sim.solve import step as core_step

SIZES, BATCHES = (8, 12, 24), (1, 4, 8, 32)
POLICIES = ("zero", "random", "scripted")
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
@click.option("--episodes", default=8, show_default=True, help="Of each policy, for --returns.")
def main(
    tasks: Sequence[str],
    sizes: Sequence[int],
    batches: Sequence[int],
    threads: Sequence[int],
    steps: int,
    returns: bool,
    episodes: int,
) -> None:
    """Environment steps a second, without and with gradients, under the scripted policy.

    FoldCloth by default, and for --returns all tasks. With gradients, the sum of the rewards of ten
    steps at a time is differentiated by the actions. Memory is the largest of the process so far.

    Rates are by what processors do, so that other programs do not count: seconds outside of the
    core, and of those in the core the part of one thread. `python` is the share of the former, and
    `waiting` how much longer it took than that, in shares of the time that passed: threads that
    wait for the last of them, and for other programs.
    """
    if returns:
        print_returns(tasks or tuple(envs.TASKS), episodes)
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
    """Steps a second, the share of Python in the time that is needed, and that of waiting."""
    in_core = 0.0  # of this thread, in calls of the core
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
    """Steps a second with the gradient of the rewards of ten at a time.

    The share of Python is taken to be that of steps without gradients.
    """
    start = time.process_time()
    for first in range(0, len(script), 10):
        leaves = [actions.clone().requires_grad_() for actions in script[first : first + 10]]
        env.clear_grad()
        total = sum(env.step(leaf)[1].sum() for leaf in leaves)
        torch.autograd.grad(total, leaves)
    env.clear_grad()
    spent = time.process_time() - start
    # Of a second that is needed, all threads spend this: what is in the core counts for each.
    threads = min(torch.get_num_threads(), env.num_envs)
    return len(script) * (python + (1 - python) * threads) / spent


def _script(env: envs.ClothVectorEnv, steps: int) -> tuple[list[torch.Tensor], envs.EnvState]:
    """Scripted actions, and where they begin; the environments are there again."""
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


def print_returns(tasks: Sequence[str], episodes: int) -> None:
    """What zero, random and scripted policies get in some tasks."""
    print(f"Mean return of {episodes} episodes, and how many end in success, at size 12")
    print(f"{'task':18}" + "".join(f"{policy:>18}" for policy in POLICIES))
    for name in tasks:
        env = envs.make(name, episodes, autoreset_mode="Disabled")
        line = f"{name:18}"
        for policy in POLICIES:
            total, success = _episode(env, policy)
            line += f"{total:10.2f} {success:3d}/{episodes:<3d}"
        print(line)
        sys.stdout.flush()


def _episode(env: envs.ClothVectorEnv, policy: str) -> tuple[float, int]:
    env.reset(seed=100)
    noise = torch.Generator().manual_seed(0)
    shape = (env.num_envs, env.task.action_size)
    act: dict[str, Callable[[], torch.Tensor]] = {
        "zero": lambda: torch.zeros(shape),
        "random": lambda: 2 * torch.rand(shape, generator=noise) - 1,
        "scripted": env.scripted_actions,
    }
    total = torch.zeros(env.num_envs)
    success = torch.zeros(env.num_envs, dtype=torch.bool)
    running = ~success
    for _ in range(env.task.horizon):
        _, reward, terminated, truncated, info = env.step(act[policy]())
        total += torch.where(running, reward, 0.0)
        success = torch.where(running, info["success"], success)
        running = running & ~(terminated | truncated)
        if not bool(running.any()):
            break
    return float(total.mean()), int(success.sum())


if __name__ == "__main__":
    main()
