"""Cost and speedup of workers: updates of a policy in this process, in processes and on Ray."""

from __future__ import annotations

import hashlib
import os
import pickle
import statistics
import time
from functools import partial
from typing import Any

import click
import torch

from diffcloth_torch import envs
from diffcloth_torch.learn import Processes, RayActors, Trainer, TrainerOptions
from diffcloth_torch.learn.rollouts import Piece, roll_out

_REPEATS = 50
HOLD = (0.0, 0.0, 0.2, 0.95, 0.0, 0.0, 0.2, 0.95)


@click.command()
@click.option("--size", default=12, show_default=True, help="Vertices along a side.")
@click.option("--chunks", default=4, show_default=True, type=click.IntRange(2))
@click.option("--chunk", default=2, show_default=True, type=click.IntRange(1))
@click.option("--updates", default=5, show_default=True, type=click.IntRange(1))
@click.option("--workers", default=2, show_default=True, type=click.IntRange(1))
@click.option("--ray/--no-ray", default=True, help="Whether to start Ray.")
def main(size: int, chunks: int, chunk: int, updates: int, workers: int, ray: bool) -> None:
    """Time updates of APG on FoldCloth, 16 steps per rollout, and the messages of an update.

    All kinds of workers make equal updates; the first update, in which workers start, is omitted.
    `of n` is the speedup over this process with one core per worker, by wall-clock time. `on idle
    cores` is the speedup by processor time: C / (S + C / n), where C is the time of an update here
    and S the trainer's own time during an update by workers. At the end: the time of an update with
    more workers of one chunk each, if all messages pass through the trainer one by one.
    """
    torch.set_num_threads(1)
    make = partial(envs.make, "FoldCloth", size=size, opens_at=-1.0, reach=0.06)
    options = TrainerOptions(algorithm="apg", horizon=16, first_action=HOLD)

    def trainer(kind: Any) -> Trainer:
        return Trainer(make, options, num_envs=chunks * chunk, chunk=chunk, workers=kind)

    kinds: list[tuple[str, Any]] = [("here", None), (f"{workers} processes", Processes(workers))]
    if ray:
        start = time.perf_counter()
        kinds.append((f"{workers} actors of Ray", RayActors(workers)))
        print(f"Ray started in {time.perf_counter() - start:.1f} s")
    made = [(name, kind, trainer(kind)) for name, kind in kinds]
    times: dict[str, list[tuple[float, float]]] = {name: [] for name, _ in kinds}
    # Alternate between kinds, so that other load of the machine slows all of them.
    for k in range(updates + 1):
        for name, _, one in made:
            start, start_of_core = time.perf_counter(), time.process_time()
            one.update()
            spent = time.perf_counter() - start, time.process_time() - start_of_core
            if k:
                times[name].append(spent)
            else:
                print(f"{name}: first update {spent[0]:.2f} s")
    bits = {_bits(one) for _, _, one in made}
    print(f"{chunks} chunks of {chunk} environments, {size} x {size}; "
          f"{'the same bits' if len(bits) == 1 else 'BITS DIFFER'}")  # fmt: skip
    print(f"load of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print("                      s per update     of n  on idle cores   environment steps a second")
    here, core = (statistics.median(part) for part in zip(*times["here"], strict=True))
    for name, spent in times.items():
        middle, mine = (statistics.median(part) for part in zip(*spent, strict=True))
        idle = 1.0 if name == "here" else core / (mine + core / workers)
        rate = 16 * chunks * chunk / middle
        print(f"{name:20} {middle:12.3f} {here / middle:9.2f} {idle:14.2f} {rate:20.1f}")
    _messages(made[0][2], core / chunks)
    for _, kind, _ in made:
        if kind is not None:
            kind.close()


def _bits(trainer: Trainer) -> str:
    tensors = trainer.policy.state_dict().values()
    return hashlib.sha256(b"".join(t.numpy().tobytes() for t in tensors)).hexdigest()


def _messages(trainer: Trainer, chunk_seconds: float) -> None:
    """Print sizes and times of messages, and the extrapolation to more workers."""
    pieces: list[Piece] = trainer._pieces()
    piece, result = pieces[0], roll_out(trainer._env, pieces[0])
    seconds = 0.0
    for name, thing in (("piece", piece), ("result", result)):
        start = time.process_time()
        for _ in range(_REPEATS):
            data = pickle.dumps(thing)
            pickle.loads(data)
        spent = (time.process_time() - start) / _REPEATS
        seconds += spent
        print(f"{name}: {len(data) / 1024:.0f} KiB, {1e3 * spent:.2f} ms")
    print("workers   s per update  efficiency, if messages pass one by one")
    for count in (2, 4, 8, 16, 32, 64, 128):
        update = chunk_seconds + count * seconds
        print(f"{count:7d} {update:13.3f} {chunk_seconds / update:12.0%}")


if __name__ == "__main__":
    main()
