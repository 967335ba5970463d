"""Pressure of a pen through a cloth on the pad of a finger, as a tactile image.

    python examples/tactile_image.py [IMAGE.png]

The fingers of a gripper close on a cloth that hangs in front of a fixed, tilted pen. The tactile
image of a finger consists of its contacts: their points in the finger's frame and normal forces.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from matplotlib.image import imsave

import diffcloth_torch as dc

F64 = torch.float64
STEPS, EFFORT = 40, 4.0  # time steps of 10 ms, and the closing force of each finger [N]
FINGER = "gripper/left_finger"
WIDTH, LENGTH = 0.02, 0.05  # size of the finger's pad, along x and z of its frame [m]
PIXEL, BLUR = 5e-4, 1e-3  # size of a pixel, and depth of the pad's skin [m]

top = range(21 * 24, 21 * 25)
cloth = dc.Cloth.grid(
    (21, 25),
    (0.06, 0.072),
    pose=[0, 0.008, 0.07, np.sqrt(0.5), np.sqrt(0.5), 0, 0],  # upright, between pen and finger
    pins={"top": top},
    material=dc.Material(stretch=200, bending=1e-5, damping=0.01, thickness=5e-4),
    name="cloth",
)
tilt = np.radians(25) / 2
pen = dc.RigidBody.capsule(
    0.003, 0.08, pose=[0, 0.003, 0.06, np.cos(tilt), 0, np.sin(tilt), 0], name="pen"
)
gripper = dc.Robot.load(dc.robots.GRIPPER, actuation="torque", name="gripper")
scene = dc.Scene([cloth], [pen], [gripper], gravity=(0, 0, -9.81))
simulator = dc.Simulator(scene, dt=0.01)


def tactile_image(state: dc.State) -> torch.Tensor:
    """Pressure on the pad of the finger [Pa], a pixel for each row along z and column along x."""
    contacts = simulator.contacts(state).on(FINGER)
    frame = simulator.link_poses(state)[FINGER]
    points = (contacts.points[contacts.mask, 1] - frame[:3, 3]) @ frame[:3, :3]
    x = torch.arange(-WIDTH / 2 + PIXEL / 2, WIDTH / 2, PIXEL, dtype=F64)
    z = torch.arange(PIXEL / 2, LENGTH, PIXEL, dtype=F64)
    # Skin spreads a force over its depth; the spread weights add up to one.
    spread = [
        torch.exp(-0.5 * ((axis - points[:, k, None]) / BLUR) ** 2) / (BLUR * (2 * np.pi) ** 0.5)
        for axis, k in ((z, 2), (x, 0))
    ]
    return torch.einsum("m,mi,mj->ij", contacts.normal_forces[contacts.mask], *spread)


def shades(image: torch.Tensor) -> str:
    """The image as text, its top row first."""
    rows = image.reshape(len(image) // 4, 4, -1, 2).mean(dim=(1, 3)).flip(0)
    levels = (9 * (rows / rows.max()).clamp(0, 1)).round().long()
    return "\n".join("".join(" .:-=+*#%@"[level] for level in row) for row in levels.tolist())


efforts = torch.full((2,), EFFORT, dtype=F64)
state = simulator.initial_state()
for _ in range(STEPS):
    state = simulator.step(state, simulator.control(joint_efforts=efforts))
image = tactile_image(state)
pressing = simulator.contacts(state).on(FINGER)
print(shades(image))
print(f"{int(pressing.mask.sum())} contacts press with {float(pressing.normal_forces.sum()):.2f} N")

if __name__ == "__main__" and len(sys.argv) > 1:
    imsave(sys.argv[1], image.clamp(min=0).numpy(), origin="lower", cmap="inferno")
