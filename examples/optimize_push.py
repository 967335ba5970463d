"""Optimize the push of a cube into a hanging cloth, in 40 lines and without a configuration.

    python examples/optimize_push.py

The cube moves along y on prescribed poses. Gradient descent finds the speed for which the middle of
the cloth ends 0.15 m from its start.
"""

from __future__ import annotations

import torch

import diffcloth_torch as dc

STEPS, DT = 20, 0.02
WANTED = 0.15  # [m]

# A sheet in the xz-plane, held by its upper edge, and a cube just behind its middle.
upright = [0, 0, 1, 0.5**0.5, 0.5**0.5, 0, 0]
cloth = dc.Cloth.grid((12, 12), (0.6, 0.6), pose=upright, pins={"edge": range(132, 144)})
cube = dc.RigidBody.box(0.15, motion="kinematic", pose=[0, -0.1, 1, 1, 0, 0, 0])
simulator = dc.Simulator(dc.Scene([cloth], [cube]), dt=DT)

start = simulator.initial_state()
middle = 6 * 12 + 6
speed = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)  # [m/s]
descent = torch.optim.SGD([speed], lr=3.0)

for iteration in range(8):
    travel = speed * DT * torch.arange(1, STEPS + 1)
    along_y = torch.tensor([0.0, 1, 0, 0, 0, 0, 0], dtype=torch.float64)
    controls = [dc.Control(body_poses=start.body_poses + y * along_y) for y in travel]
    end = simulator.rollout(start, controls)[-1]
    error = end.positions[middle, 1] - WANTED
    loss = error.square()
    descent.zero_grad()
    loss.backward()
    print(f"{iteration}: speed {speed.item():.4f} m/s, off by {1000 * error.item():+.2f} mm")
    descent.step()
