"""Optimize a pull from several guesses at once: a batch with one control per environment.

    python examples/optimize_batch.py

A sheet hangs by two corners; forces on its lower corners must move its middle to a goal. Each
environment of the batch starts from a different guess, and Adam optimizes each independently: the
best one counts. An environment whose step fails goes back half way to its best forces.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import torch

import diffcloth_torch as dc

F64 = torch.float64
ENVIRONMENTS, STEPS, DT = 4, 15, 0.02

cloth = dc.Cloth.grid((6, 6), 0.3, pose=[0, 0, 1, 0.5**0.5, 0.5**0.5, 0, 0], pins={"top": [30, 35]})
simulator = dc.Simulator(dc.Scene([cloth]), DT, solver=dc.SolverOptions(throw=False))
start = simulator.initial_state(ENVIRONMENTS)
corners = [0, 5]
goal = start.positions[0].mean(dim=0) + torch.tensor([0.0, 0.08, 0.02], dtype=F64)


def simulate(variables: Mapping[str, torch.Tensor]) -> list[dc.State]:
    """Pull at the lower corners with one force for each environment."""
    pull = torch.zeros(len(cloth.vertices), 1, dtype=F64)
    pull[corners] = 1.0
    control = dc.Control(forces=pull * variables["force"][:, None])
    return simulator.rollout(start, [control] * STEPS)


def distances(states: list[dc.State]) -> torch.Tensor:
    """Final distance of the middle of each sheet from the goal [m]."""
    return (states[-1].positions.mean(dim=1) - goal).norm(dim=1)


guesses = 0.02 * torch.randn(ENVIRONMENTS, 3, dtype=F64, generator=torch.Generator().manual_seed(1))
found = dc.descend(
    simulate,
    distances,
    {"force": guesses.requires_grad_()},
    partial(torch.optim.Adam, lr=0.01),
    iterations=30,
    per_environment=["force"],
)

for i, distance in enumerate(found.best_losses.tolist()):
    force = ", ".join(f"{1000 * f:.0f}" for f in found.best_rows["force"][i].tolist())
    print(f"environment {i}: {1000 * distance:.1f} mm from the goal with ({force}) mN")
