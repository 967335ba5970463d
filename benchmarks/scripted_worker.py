"""One side of `benchmarks.scripted`: records, repeats or times steps of an environment.

The script reads a job as JSON from the first line of its input. It uses only the public interface
of the package, so that versions with different internals can be compared.
"""

from __future__ import annotations

import json
import os
import pickle
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
WARM_UP = 4  # transitions: tools close


def main() -> None:
    job = json.loads(sys.stdin.readline())
    os.sched_setaffinity(0, job["cores"])
    sys.path[0] = str(ROOT)
    from benchmarks.worker import use_package

    use_package(Path(job["package"]))
    import torch

    torch.set_num_threads(1)
    if job["does"] == "record":
        record(job)
        print(json.dumps({}), flush=True)
    elif job["does"] == "transitions":
        print(json.dumps(time_transitions(job)), flush=True)
    else:
        steps = timed_steps(job)
        print(json.dumps(next(steps)), flush=True)  # ready
        for _ in sys.stdin:
            print(json.dumps(next(steps)), flush=True)


def begun(job: dict[str, Any]) -> Any:
    """An environment some transitions after its start."""
    import torch

    from diffcloth_torch import envs

    env = envs.make(job["task"], job["batch"], size=job["size"], horizon=10**6)
    env.reset(seed=0)
    with torch.no_grad():
        for _ in range(WARM_UP):
            env.step(env.scripted_actions())
    return env


def record(job: dict[str, Any]) -> None:
    """Save the simulator of an environment, and states and controls of its scripted steps."""
    import torch

    env = begun(job)
    simulator = env.task.simulator
    taken: list[tuple[Any, Any]] = []
    kind = type(simulator)
    step = kind.step

    def recorded(self: Any, state: Any, control: Any = None, *rest: Any) -> Any:
        if self is simulator:
            taken.append((state.detach(), control))
        return step(self, state, control, *rest)

    kind.step = recorded
    with torch.no_grad():
        while len(taken) < job["steps"]:
            env.step(env.scripted_actions())
    # A file for the workers of this run: both versions read each other's objects.
    kept = {"simulator": simulator, "taken": taken[: job["steps"]]}
    Path(job["file"]).write_bytes(pickle.dumps(kept))


def timed_steps(job: dict[str, Any]) -> Any:
    """Repeat the recorded steps, without and with gradients; yield times and ends."""
    saved = pickle.loads(Path(job["file"]).read_bytes())
    simulator, taken = saved["simulator"], saved["taken"]
    if job["certify"] != "always":
        simulator = with_certify(simulator, job["certify"])
    timed_step(simulator, *taken[0])  # warm-up: caches fill, and the first backward imports modules
    yield {}
    while True:
        for state, control in taken:
            yield timed_step(simulator, state, control)


def timed_step(simulator: Any, state: Any, control: Any) -> dict[str, Any]:
    """Numbers of one step without and with gradients."""
    import torch

    count = len(torch.as_tensor(state.time).reshape(-1))
    with torch.no_grad():
        start = time.process_time()
        after = simulator.step(state, control)
        forward = time.process_time() - start
    report = after.report
    positions = state.positions.clone().requires_grad_()
    velocities = state.velocities.clone().requires_grad_()
    begin = state.replace(positions=positions, velocities=velocities)
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(positions.shape, generator=generator, dtype=positions.dtype)] * 2
    start = time.process_time()
    end = simulator.step(begin, control)
    torch.autograd.backward([end.positions, end.velocities], weights)
    both = time.process_time() - start

    def mean(values: Any) -> float:
        return torch.as_tensor(values).double().mean().item()

    return {
        "forward": forward / count,
        "with_gradients": both / count,
        "core": sum(mean(value) for value in report.seconds.values()),
        "iterations": mean(report.iterations),
        "contacts": mean(report.contact_count),
        "phases": {name: mean(value) for name, value in report.seconds.items()},
        "counts": {name: mean(value) for name, value in report.counts.items()},
        "end": after.positions.flatten().tolist(),
    }


def with_certify(simulator: Any, certify: str) -> Any:
    """Return a copy of a simulator with another value of `SolverOptions.certify`."""
    from dataclasses import replace

    return type(simulator)(
        simulator.scene,
        simulator.dt,
        scheme=simulator.scheme,
        contact=simulator.contact,
        solver=replace(simulator.solver, certify=certify),
        coupling=simulator.coupling,
    )


def time_transitions(job: dict[str, Any]) -> dict[str, float]:
    """Median wall-clock times of transitions, and of the part outside of the core [s]."""
    from statistics import median

    import torch

    env = begun(job)
    kind = type(env.task.simulator)
    step = kind.step
    core, calls = 0.0, 0
    totals, outside = [], []

    def counted(self: Any, *given: Any, **named: Any) -> Any:
        nonlocal core, calls
        after = step(self, *given, **named)
        core += sum(float(torch.as_tensor(s).sum()) for s in after.report.seconds.values())
        calls += 1
        return after

    kind.step = counted
    with torch.no_grad():
        for _ in range(job["steps"]):
            actions = env.scripted_actions()
            before, start = core, time.perf_counter()
            env.step(actions)
            totals.append(time.perf_counter() - start)
            outside.append(totals[-1] - (core - before))
    return {
        "transition": median(totals),
        "outside": median(outside),
        "steps": calls / job["steps"],
    }


if __name__ == "__main__":
    main()
