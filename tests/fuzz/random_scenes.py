"""Random scenes: sizes, materials, bodies, pins and motions over the range that the package is for.

A scene is a function of two integers. What is drawn is plain numbers in a description, from which
the simulator, the start and the controls are made.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

import diffcloth_torch as dc

F64 = torch.float64
G = 9.81
LAYOUTS = ("drop", "hang", "fold", "stack")
BODIES = ("box", "sphere", "capsule", "plane")


@dataclass(frozen=True)
class RandomScene:
    """A scene, its start, and what happens in each step.

    Attributes:
        description: What was drawn, as plain numbers.
        simulator: Of the scene.
        start: With random velocities.
        steps: How many to take.
        body_velocities: Linear [m/s] and angular [rad/s] velocity of each body, shape [K, 6].
        pin_velocity: Of the pins [m/s], shape [3].
        masses: Of the cloth vertices [kg].
    """

    description: dict[str, Any]
    simulator: dc.Simulator
    start: dc.State
    steps: int
    body_velocities: np.ndarray
    pin_velocity: np.ndarray
    masses: np.ndarray

    def control(self, state: dc.State) -> dc.Control:
        dt = self.simulator.dt
        poses = state.body_poses.detach().clone()
        for k, velocity in enumerate(self.body_velocities):
            if not velocity.any():
                continue
            poses[k, :3] += dt * torch.from_numpy(velocity[:3])
            poses[k, 3:] = torch.from_numpy(turned(poses[k, 3:].numpy(), dt * velocity[3:]))
        pins = self.simulator._assembly.pins
        held = state.positions.detach()[torch.from_numpy(pins.astype(np.int64))]
        return dc.Control(body_poses=poses, pins=held + dt * torch.from_numpy(self.pin_velocity))


def turned(q: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Quaternion wxyz turned by a rotation vector in the world."""
    angle = np.linalg.norm(rotation)
    half = 0.5 * np.sinc(angle / (2 * np.pi)) * rotation
    w, v = np.cos(0.5 * angle), half
    return np.concatenate(
        [[w * q[0] - v @ q[1:]], w * q[1:] + q[0] * v + np.cross(v, q[1:])]
    ) / np.linalg.norm(q)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def maybe(rng: np.random.Generator, probability: float, value: float) -> float:
    """The value with some probability, else zero."""
    return value if rng.random() < probability else 0.0


def draw(seed: int, index: int) -> RandomScene:
    rng = np.random.default_rng([seed, index])
    d: dict[str, Any] = {
        "size": log_uniform(rng, 5e-3, 10.0),
        "dt": log_uniform(rng, 1e-3, 0.05),
        "layout": str(rng.choice(LAYOUTS)),
        "rows": int(rng.integers(5, 15)),
        "columns": int(rng.integers(5, 15)),
        "jitter": float(rng.uniform(0.02, 0.2)),
        "scheme": "split" if rng.random() < 0.2 else "coupled",
        "friction_iterations": int(rng.integers(1, 4)),
        "gravity": maybe(rng, 0.9, G),
        "steps": int(rng.integers(3, 7)),
    }
    cloths, clearance = _cloths(rng, d)
    bodies, velocities = _bodies(rng, d, clearance)
    simulator = dc.Simulator(
        dc.Scene(cloths, bodies, gravity=(0.0, 0.0, -d["gravity"])),
        d["dt"],
        scheme=d["scheme"],
        contact=dc.ContactOptions(friction_iterations=d["friction_iterations"]),
    )
    start = simulator.initial_state()
    speed = np.sqrt(G * d["size"])  # of a fall through the cloth's own size
    d["speed"] = speed * rng.uniform(0, 2)
    d["noise"] = speed * log_uniform(rng, 1e-3, 1.0)
    drift = rng.normal(size=3)
    v = d["speed"] * drift / np.linalg.norm(drift) + d["noise"] * rng.normal(
        size=start.positions.shape
    )
    pinned = bool(len(simulator._assembly.pins))
    return RandomScene(
        description=d,
        simulator=simulator,
        start=start.replace(velocities=torch.from_numpy(v)),
        steps=d["steps"],
        body_velocities=velocities,
        pin_velocity=speed * rng.normal(size=3) * maybe(rng, 0.5, 0.5) * pinned,
        masses=_masses(cloths),
    )


def _material(rng: np.random.Generator, edge: float) -> dc.Material:
    return dc.Material(
        stretch=log_uniform(rng, 30.0, 3e4),
        bending=log_uniform(rng, 1e-7, 1e-4),
        poisson=float(rng.uniform(0.0, 0.45)),
        density=log_uniform(rng, 0.03, 1.0),
        damping=maybe(rng, 0.3, log_uniform(rng, 1e-4, 1e-1)),
        friction=maybe(rng, 0.8, rng.uniform(0.05, 1.2)),
        thickness=maybe(rng, 0.4, 0.05 * edge * rng.uniform(0.2, 1.0)),
    )


def _cloths(rng: np.random.Generator, d: dict[str, Any]) -> tuple[list[dc.Cloth], float]:
    """The cloths, all above z = 0 by the clearance that is returned."""
    rows, columns, size = d["rows"], d["columns"], d["size"]
    edge = size / (max(rows, columns) - 1)
    grid = dc.Cloth.grid(rows, columns, size=(edge * (columns - 1), edge * (rows - 1)))
    flat = np.array(grid.vertices)
    flat[:, :2] += d["jitter"] * edge * rng.uniform(-1, 1, (len(flat), 2))
    clearance = edge * rng.uniform(0.11, 0.5)
    material = _material(rng, edge)
    d["material"] = {k: getattr(material, k) for k in material.__dataclass_fields__}
    keywords: dict[str, Any] = {"material": material}
    if d["layout"] == "fold":
        placed = _folded(flat, 0.15 * edge)
    else:
        tilt = rng.uniform(0, 0.3 if d["layout"] == "drop" else 0.02)
        placed = _tilted(flat, rng.normal(size=2), tilt)
        if d["layout"] == "hang":
            placed = placed[:, [0, 2, 1]]
    placed[:, 2] += clearance - placed[:, 2].min()
    d["pins"] = _pins(rng, d["layout"], placed, rows, columns)
    if d["pins"]:
        keywords["pins"] = {"held": d["pins"]}
    cloths = [dc.Cloth(placed, grid.faces, rest_vertices=flat, **keywords)]
    if d["layout"] == "stack":
        upper = np.array(flat)
        upper[:, :2] += edge * rng.uniform(-0.5, 0.5, 2)
        upper[:, 2] = placed[:, 2].max() + edge * rng.uniform(0.11, 0.3)
        cloths.append(
            dc.Cloth(upper, grid.faces, rest_vertices=flat, material=_material(rng, edge))
        )
    return cloths, clearance


def _pins(
    rng: np.random.Generator, layout: str, placed: np.ndarray, rows: int, columns: int
) -> list[int]:
    kind = rng.choice(["none", "corner", "corners", "edge"])
    if layout == "hang":
        kind = rng.choice(["corners", "edge"])
    last = rows * columns - columns
    return {
        "none": [],
        "corner": [last],
        "corners": [last, rows * columns - 1],
        "edge": list(range(last, rows * columns)),
    }[str(kind)]


def _folded(flat: np.ndarray, radius: float) -> np.ndarray:
    """Over itself, around a cylinder along y."""
    s = flat[:, 0]
    turn = np.pi * radius
    phi = np.clip(s, 0, turn) / radius
    placed = np.array(flat)
    placed[:, 0] = np.where(s < 0, s, radius * np.sin(phi) - np.maximum(s - turn, 0))
    placed[:, 2] = radius * (1 - np.cos(phi))
    return placed


def _tilted(flat: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    x, y = axis / np.linalg.norm(axis)
    k = np.array([[0, 0, y], [0, 0, -x], [-y, x, 0]])
    return flat @ (np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k).T


def _bodies(
    rng: np.random.Generator, d: dict[str, Any], clearance: float
) -> tuple[list[dc.RigidBody], np.ndarray]:
    """One or two bodies below z = 0, standing still or moving."""
    size = d["size"]
    kinds = [str(rng.choice(BODIES))]
    if rng.random() < 0.3:
        kinds.append("plane")
    bodies, velocities, depth = [], [], 0.0
    for kind in kinds:
        moving = rng.random() < 0.4
        s = size * rng.uniform(0.15, 0.6)
        surface = {
            "motion": "kinematic" if moving else "static",
            "friction": maybe(rng, 0.8, rng.uniform(0.05, 1.2)),
            "thickness": maybe(rng, 0.2, 0.3 * clearance),
        }
        q = rng.normal(size=4) if kind != "plane" else np.array([1.0, 0.0, 0.0, 0.0])
        top, make = {
            "box": (0.87 * s, lambda **k: dc.RigidBody.box(s, **k)),  # noqa: B023 - called below
            "sphere": (0.5 * s, lambda **k: dc.RigidBody.sphere(0.5 * s, subdivisions=2, **k)),  # noqa: B023
            "capsule": (0.8 * s, lambda **k: dc.RigidBody.capsule(0.3 * s, s, **k)),  # noqa: B023
            "plane": (0.0, lambda **k: dc.RigidBody.plane(3 * size, **k)),
        }[kind]
        shift = 0.2 * size * rng.uniform(-1, 1, 2)
        pose = [*shift, -depth - top, *q]
        bodies.append(make(pose=pose, **surface))
        speed = np.sqrt(G * size)
        linear = speed * rng.uniform(0, 1) * rng.normal(size=3)
        angular = rng.uniform(0, 1) * rng.normal(size=3) * speed / size
        velocities.append(np.concatenate([linear, angular]) * moving)
        depth += 2 * top + clearance
    d["bodies"], d["moving"] = kinds, [bool(v.any()) for v in velocities]
    return bodies, np.array(velocities)


def _masses(cloths: list[dc.Cloth]) -> np.ndarray:
    parts = []
    for cloth in cloths:
        a, b, c = (cloth.rest_vertices[cloth.faces[:, k]] for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        third = np.repeat(cloth.material.density * area / 3, 3)
        parts.append(np.bincount(cloth.faces.ravel(), third, minlength=len(cloth.vertices)))
    return np.concatenate(parts)
