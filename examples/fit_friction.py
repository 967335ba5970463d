"""Fit the friction of a sheet to its sliding path: an optimizer of torch over a parameter.

    python examples/fit_friction.py

A sheet slides along a table. The data are its path in a simulation with a fifth of the time step.
Friction must stay positive: the optimizer therefore changes its logarithm.
"""

from __future__ import annotations

import math
from functools import partial

import torch

import diffcloth_torch as dc

F64 = torch.float64
DURATION, FRICTION = 0.2, 0.3  # [s], and the value to be found


def thrown(dt: float) -> tuple[dc.Simulator, dc.State]:
    """Make the sheet on the table, sliding at 1 m/s."""
    cloth = dc.Cloth.grid((5, 5), 0.2, pose=[0, 0, 0.002, 1, 0, 0, 0])
    contact = dc.ContactOptions(barrier_distance=0.002)
    simulator = dc.Simulator(dc.Scene([cloth], [dc.RigidBody.plane(4.0)]), dt, contact=contact)
    start = simulator.initial_state()
    velocities = start.velocities + torch.tensor([1.0, 0.0, 0.0], dtype=F64)
    return simulator, start.replace(velocities=velocities)


def middles(states: list[dc.State]) -> torch.Tensor:
    """Position of the middle of the sheet along x in each state [m]."""
    return torch.stack([state.positions[:, 0].mean() for state in states])


fine, start = thrown(dt=0.002)
with torch.no_grad():
    states = fine.rollout(
        start, parameters=dc.Parameters(friction=torch.tensor(FRICTION)), steps=100
    )
measured = middles(states)[4::5]

simulator, start = thrown(dt=0.01)
steps = round(DURATION / simulator.dt)
log_friction = torch.tensor(math.log(0.1), dtype=F64, requires_grad=True)
found = dc.descend(
    lambda v: simulator.rollout(
        start, parameters=dc.Parameters(friction=v["log_friction"].exp()), steps=steps
    ),
    lambda states: (middles(states) - measured).square().mean(),
    {"log_friction": log_friction},
    partial(torch.optim.Adam, lr=0.15),
    iterations=25,
)

friction = found.best.variables["log_friction"].exp().item()
print(f"friction {friction:.3f}, of the data {FRICTION}")
off = [1000 * math.sqrt(evaluation.loss) for evaluation in (found.best, found.first)]
print(f"off by {off[0]:.2f} mm, {off[1]:.1f} mm at first")
