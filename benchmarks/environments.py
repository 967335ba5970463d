"""Environments for learning: transitions a second, and what policies made by hand get."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import click
import torch

from diffcloth_torch import envs

SIZES, BATCHES = (8, 12, 24), (1, 4, 8, 32)
POLICIES = ("zero", "random", "scripted")
_WARM_UP = 4  # transitions: pickers close


@click.command()
@click.option("--task", default="FoldCloth", show_default=True, type=click.Choice(list(envs.TASKS)))
@click.option(
    "--sizes", default=SIZES, multiple=True, type=click.IntRange(4), help="Vertices a side."
)
@click.option("--batches", default=BATCHES, multiple=True, type=click.IntRange(1))
@click.option("--threads", default=(1, 2), multiple=True, type=click.IntRange(1))
@click.option("--steps", default=20, show_default=True, type=click.IntRange(1))
@click.option("--returns", is_flag=True, help="What policies get instead, in all tasks.")
@click.option("--episodes", default=8, show_default=True, help="Of each policy, for --returns.")
def main(
    task: str,
    sizes: Sequence[int],
    batches: Sequence[int],
    threads: Sequence[int],
    steps: int,
    returns: bool,
    episodes: int,
) -> None:
    """Environment steps a second, without and with gradients, under the scripted policy.

    With gradients, the sum of the rewards of ten steps at a time is differentiated by the actions.
    `python` is the share of the time without gradients that is not spent in the core. Memory is
    the largest of the process so far.
    """
    if returns:
        print_returns(episodes)
        return
    print(f"{task}, environment steps a second")
    print("size  batch  threads   forward  with gradients   python   memory [MiB]")
    for size in sizes:
        for batch in batches:
            for count in threads:
                torch.set_num_threads(count)
                env = envs.make(task, batch, size=size, horizon=10**6)
                forward, python = _forward(env, steps)
                backward = _backward(env, steps)
                peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
                print(
                    f"{size:4d} {batch:6d} {count:8d} {batch * forward:9.1f} "
                    f"{batch * backward:15.1f} {python:8.1%} {peak:14.0f}"
                )
                sys.stdout.flush()


def _forward(env: envs.ClothVectorEnv, steps: int) -> tuple[float, float]:
    """Steps a second, and the share of the time that the core does not need."""
    script = _script(env, steps)
    core = 0.0
    step = env.task.simulator.step

    def timed(*given: Any) -> Any:
        nonlocal core
        state = step(*given)
        # The phases of all environments add up to the time of all threads.
        seconds = sum(float(t.sum()) for t in state.report.seconds.values())
        core += seconds / min(torch.get_num_threads(), env.num_envs)
        return state

    env.task.simulator.step = timed
    try:
        start = time.perf_counter()
        for actions in script:
            env.step(actions)
        seconds = time.perf_counter() - start
    finally:
        env.task.simulator.step = step
    return steps / seconds, max(1 - core / seconds, 0.0)


def _backward(env: envs.ClothVectorEnv, steps: int) -> float:
    """Steps a second with the gradient of the rewards of ten at a time."""
    script = _script(env, steps)
    start = time.perf_counter()
    for first in range(0, steps, 10):
        leaves = [actions.clone().requires_grad_() for actions in script[first : first + 10]]
        env.clear_grad()
        total = sum(env.step(leaf)[1].sum() for leaf in leaves)
        torch.autograd.grad(total, leaves)
    env.clear_grad()
    return steps / (time.perf_counter() - start)


def _script(env: envs.ClothVectorEnv, steps: int) -> list[torch.Tensor]:
    """Scripted actions from a start, to which the environments are then brought back."""
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
    return script


def print_returns(episodes: int) -> None:
    """What zero, random and scripted policies get in each task."""
    print(f"Mean return of {episodes} episodes, and how many end in success, at size 12")
    print(f"{'task':18}" + "".join(f"{policy:>18}" for policy in POLICIES))
    for name in envs.TASKS:
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
