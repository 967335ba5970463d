"""A batch of environments with unequal costs, on two threads.

Sheets hang by points of their rim, and some are crumpled by moving these points together; the
crumpled ones are last in the batch. The time of each environment on one thread determines the time
of two threads that start in the order of the batch, with the slowest of the previous step (as the
core does), and in the best order; the ratios are relative to one thread. Other programs on the same
cores therefore do not count. `measured` is the ratio of measured wall-clock times.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Sequence
from itertools import combinations
from statistics import median

import click
import numpy as np
import torch

import diffcloth_torch as dc
from benchmarks.scenes import DT, crumple

THREADS = 2


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option("--size", default=24, show_default=True, type=click.IntRange(8))
@click.option("--environments", default=8, show_default=True, type=click.IntRange(2, 16))
@click.option("--crumpled", default=1, show_default=True, type=click.IntRange(1))
@click.option("--steps", default=6, show_default=True, type=click.IntRange(1))
def main(size: int, environments: int, crumpled: int, steps: int) -> None:
    scene = crumple(size)
    simulator = dc.Simulator(scene.scene, DT)
    state = simulator.initial_state(batch_size=environments)
    ratios: dict[str, list[float]] = {"batch": [], "cost": [], "best": [], "measured": []}
    before: list[float] = []
    for k in range(scene.approach + steps):
        moved, resting = scene.control(state).pins, state.positions[..., _held(scene.scene), :]
        pins = torch.cat([resting[:-crumpled], moved[-crumpled:]])
        seconds, walls = [], []
        with torch.no_grad():
            for count in (1, THREADS):
                torch.set_num_threads(count)
                start = time.perf_counter()
                after = simulator.step(state, dc.Control(pins=pins))
                walls.append(time.perf_counter() - start)
                if count == 1:
                    seconds = [taken for _, taken in simulator._core.last_turns]
        if k >= scene.approach:
            orders = {"batch": range(environments), "cost": np.argsort(before)[::-1]}
            for name, order in orders.items():
                ratios[name].append(sum(seconds) / makespan([seconds[e] for e in order]))
            ratios["best"].append(sum(seconds) / best_makespan(seconds))
            ratios["measured"].append(walls[0] / walls[1])
        state, before = after, seconds
    print("environments [ms]:", *(f"{1e3 * value:.1f}" for value in before))
    print(
        *(f"{name}: {median(found):.2f}, from {min(found):.2f}" for name, found in ratios.items()),
        sep="\n",
    )


def _held(scene: dc.Scene) -> list[int]:
    return [v for name in scene.cloths[0].pins.values() for v in name]


def makespan(seconds: Sequence[float]) -> float:
    """Time of threads that process environments in this order, each as soon as it is idle."""
    ends = [0.0] * THREADS
    for value in seconds:
        heapq.heapreplace(ends, ends[0] + value)
    return max(ends)


def best_makespan(seconds: Sequence[float]) -> float:
    """Smallest possible time of two threads, over all partitions."""
    everything = sum(seconds)
    parts = [
        sum(part) for count in range(len(seconds) + 1) for part in combinations(seconds, count)
    ]
    return min(max(part, everything - part) for part in parts)


if __name__ == "__main__":
    main()
