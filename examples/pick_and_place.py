"""Fold a sheet with a picker: grasp a corner, carry it over, release it; the path by gradient.

    python examples/pick_and_place.py

The picker is an attachment whose target and weight are controls. The gradient of the final
positions of the corner and its neighbors optimizes a few points of the picker's path.
"""

from __future__ import annotations

import math

import torch

import diffcloth_torch as dc

F64 = torch.float64
DT, CARRY, REST = 0.02, 40, 20  # [s], steps of carrying the corner, and of lying free
SIZE = 9
CORNER, OPPOSITE = 0, SIZE * SIZE - 1

cloth = dc.Cloth.grid(
    (SIZE, SIZE),
    0.3,
    name="sheet",
    pose=[0, 0, 0.004, 1, 0, 0, 0],
    material=dc.Material(friction=0.6),
)
picker = dc.Attachment(("sheet", CORNER), stiffness=50.0, name="picker")
scene = dc.Scene([cloth], [dc.RigidBody.plane(2.0, friction=0.6)], attachments=[picker])
simulator = dc.Simulator(scene, DT, contact=dc.ContactOptions(barrier_distance=4e-3))
start = simulator.initial_state()
here, there = start.positions[CORNER], start.positions[OPPOSITE]


def path(knots: torch.Tensor) -> torch.Tensor:
    """Targets of the picker [CARRY, 3]: a Bezier curve from the corner through knots [3, 3]."""
    points = torch.cat([here[None], knots])
    t = torch.linspace(0.0, 1.0, CARRY + 1, dtype=F64)[1:, None]
    weights = [math.comb(3, k) * t**k * (1 - t) ** (3 - k) for k in range(4)]
    return torch.stack([w * p for w, p in zip(weights, points, strict=True)]).sum(0)


def fold(knots: torch.Tensor) -> dc.State:
    """The state after the picker has carried and released the corner."""
    state = start
    for target in path(knots):
        state = simulator.step(state, dc.Control(attachments={"picker": target[None]}))
    for _ in range(REST):
        state = simulator.step(state)  # no target: released
    return state


def loss(state: dc.State) -> torch.Tensor:
    """Squared distance of the corner from its mirror image, in the plane [m^2]."""
    off = state.positions[CORNER, :2] - there[:2]
    return (off**2).sum()


lift = torch.tensor([0.0, 0.0, 0.18], dtype=F64)
knots = torch.stack([here + lift, 0.7 * there + 0.3 * here + lift, 0.8 * there + 0.2 * here])
knots[-1, 2] = 0.03
knots = knots.clone().requires_grad_()
optimizer = torch.optim.Adam([knots], lr=0.01)
distances = []  # [m]
for _ in range(6):
    optimizer.zero_grad()
    value = loss(fold(knots))
    value.backward()
    optimizer.step()
    distances.append(value.item() ** 0.5)
    print(f"the corner ends {distances[-1]:.4f} m from the opposite one")
