"""Simulation of a task, one state after the other."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from tqdm import tqdm

from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.task import Actions, ConfiguredTask

__all__ = ["simulate"]


def simulate(task: ConfiguredTask, actions: Actions | None = None) -> Iterator[State]:
    """Yield the initial state and the state after each step.

    Args:
        task: The task.
        actions: Actions with the keys and shapes of `task.actions()`, which is the default.

    Raises:
        SimulationError: If a step fails.
    """
    with torch.no_grad():
        controller = task.controller(task.actions() if actions is None else actions)
        state = task.initial_state()
    yield state
    # disable=None: quiet if the output is not a terminal.
    for k in tqdm(range(task.steps), desc="simulate", unit="step", disable=None):
        with torch.no_grad():
            state = task.simulator.step(state, controller(k, state))
        yield state
