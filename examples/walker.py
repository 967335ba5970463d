"""A sheet drapes over a walking figure: a body with prescribed deformation.

    python examples/walker.py

The figure is one mesh: a trunk and two legs, which a skeleton of two hips moves (linear blend
skinning). Its vertices are a torch function of time and of the length of its strides, so the final
position of the sheet has a gradient by the stride.
"""

from __future__ import annotations

import numpy as np
import torch

import diffcloth_torch as dc
from diffcloth_torch.geometry import shapes

F64 = torch.float64
DT, STEPS = 0.01, 100
SPEED = 0.6  # [m/s]
HIP = torch.tensor([0.0, 0.0, 0.45], dtype=F64)

# The trunk lies along y above the hips, from which the legs hang. Parts of the mesh overlap.
trunk, trunk_faces = shapes.capsule(0.07, 0.2, rings=4, rows=4)
leg, leg_faces = shapes.capsule(0.04, 0.35, rings=3, rows=8)
parts = [
    (trunk[:, [0, 2, 1]] * [1, -1, 1] + HIP.numpy() + [0, 0, 0.05], trunk_faces),
    (leg + HIP.numpy() + [0, -0.06, -0.2], leg_faces),
    (leg + HIP.numpy() + [0, 0.06, -0.2], leg_faces),
]
starts = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
bind = torch.from_numpy(np.concatenate([vertices for vertices, _ in parts]))
faces = np.concatenate([f + start for (_, f), start in zip(parts, starts, strict=False)])
side = torch.zeros(len(bind), dtype=F64)  # leg of a vertex: -1, 1; 0 for the trunk
side[starts[1] : starts[2]], side[starts[2] :] = -1.0, 1.0
# Share of the hip's rotation that moves a vertex: zero at the hip, one 10 cm below.
share = side.abs() * ((HIP[2] - bind[:, 2]) / 0.1).clamp(0, 1)


def figure(time: float, stride: torch.Tensor) -> torch.Tensor:
    """Vertices at a time [s], from the angle [rad] by which the legs swing."""
    angle = side * share * stride * np.sin(2 * np.pi * time / 0.8)
    x, y, z = (bind - HIP).unbind(-1)
    turned = torch.stack(
        [angle.cos() * x + angle.sin() * z, y, angle.cos() * z - angle.sin() * x], dim=-1
    )
    way = SPEED * (time**2 if time < 0.5 else time - 0.25)  # at full speed after half a second
    bounce = 0.01 * np.sin(4 * np.pi * time / 0.8) ** 2
    return turned + HIP + torch.tensor([way, 0.0, bounce], dtype=F64)


walker = dc.DeformingBody(bind, faces, friction=0.6, name="walker")
sheet = dc.Cloth.grid(
    (15, 15), 0.42, pose=[0, 0, 0.59, 1, 0, 0, 0], material=dc.Material(friction=0.6), name="sheet"
)
simulator = dc.Simulator(dc.Scene([sheet], [walker]), DT)


def walk(stride: torch.Tensor) -> dc.Trajectory:
    """The states while the figure walks under the sheet."""

    def control(k: int, state: dc.State) -> dc.Control:
        return dc.Control(body_vertices={"walker": figure(DT * (k + 1), stride)})

    return simulator.rollout(simulator.initial_state(), control, steps=STEPS)


stride = torch.tensor(0.5, dtype=F64, requires_grad=True)
states = walk(stride)
cloth = states[-1].positions[simulator.slices["sheet"]]
mean = cloth.mean(dim=0)
mean[0].backward()
contact = states[-1].report.contacts["walker", "sheet"]
x, y, z = mean.tolist()
print(f"after {float(states[-1].time):.2f} s the sheet is at ({x:.3f}, {y:.3f}, {z:.3f}) m")
print(f"{contact.count} contacts, {contact.force[2]:.3f} N upwards")
print(f"gradient of its x by the stride: {stride.grad.item():.6f} m/rad")
