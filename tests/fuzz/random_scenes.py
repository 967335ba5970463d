"""Random scenes: sizes, materials, bodies, pins and motions over the package's intended range.

Forces move only cloth in these scenes; `random_towers` draws bodies and robots moved by forces.

A scene is a function of two integers. The draws are plain numbers in a description, from which the
simulator, the start and the controls are made.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from random_air import NO_AIR, Air, draw_air
from random_attachments import Pull, controlled, draw_attachments
from random_draws import log_uniform, maybe

import diffcloth_torch as dc

F64 = torch.float64
G = 9.81
LAYOUTS = ("drop", "hang", "fold", "stack")
BODIES = ("box", "sphere", "capsule", "plane")
PINS = ("none", "corner", "corners", "edge")
SHAPES: dict[str, Callable[..., dc.RigidBody]] = {
    "box": dc.RigidBody.box,
    "sphere": lambda s, **k: dc.RigidBody.sphere(0.5 * s, subdivisions=2, **k),
    "capsule": lambda s, **k: dc.RigidBody.capsule(0.3 * s, s, **k),
    "plane": dc.RigidBody.plane,
}


def smooth(kind: str, drawn: float) -> dict[str, bool]:
    """Choose if a body is smooth, by a number drawn anyway: all other draws remain unchanged."""
    return {"smooth": drawn > 0} if kind in ("sphere", "capsule") else {}


@dataclass(frozen=True)
class Drives:
    """Controls of the joints and the base of the only robot.

    Attributes:
        start: Joint positions at the start [m], shape [J].
        ends: Joint targets at the end [m], shape [J].
        efforts: Efforts at torque and pd joints [N], shape [J].
        base_velocity: Linear [m/s] and angular [rad/s] velocity of a kinematic base, shape [6].
        base_wrench: Wrench on a floating base [N, N m], shape [6].
    """

    start: np.ndarray
    ends: np.ndarray
    efforts: np.ndarray
    base_velocity: np.ndarray
    base_wrench: np.ndarray


@dataclass(frozen=True)
class RandomScene:
    """A scene, its start, and the controls of each step.

    Attributes:
        description: The draws, as plain numbers.
        simulator: Simulator of the scene.
        start: Start state, with random velocities.
        steps: Number of steps.
        body_velocities: Linear [m/s] and angular [rad/s] velocity of each body, shape [K, 6].
        pin_velocity: Velocity of the pins [m/s], shape [3].
        masses: Masses of the cloth vertices [kg].
        drives: Controls of the robot, if there is one.
        pulls: Controls of the attachments.
        air: Air around the cloths.
    """

    description: dict[str, Any]
    simulator: dc.Simulator
    start: dc.State
    steps: int
    body_velocities: np.ndarray
    pin_velocity: np.ndarray
    masses: np.ndarray
    drives: Drives | None = None
    pulls: tuple[Pull, ...] = ()
    air: Air = NO_AIR

    def control(self, state: dc.State, k: int) -> dc.Control:
        """Control of step k."""
        dt = self.simulator.dt
        poses = state.body_poses.detach().clone()
        for pose, velocity in zip(poses, self.body_velocities, strict=True):
            pose[:] = _moved(pose, dt * velocity)
        pins = self.simulator._assembly.pins
        held = state.positions.detach()[torch.from_numpy(pins.astype(np.int64))]
        control = dc.Control(body_poses=poses, pins=held + dt * torch.from_numpy(self.pin_velocity))
        control = controlled(control, self.pulls, k, dt)
        if (wind := self.air.wind_at(k)) is not None:
            control = control.replace(wind=torch.from_numpy(wind))
        return control if self.drives is None else self._driven(control, self.drives, state, k)

    def _driven(self, control: dc.Control, drives: Drives, state: dc.State, k: int) -> dc.Control:
        dt = self.simulator.dt
        way = drives.ends - drives.start
        base = self.simulator.scene.robots[0].mechanism.base
        bases = state.base_poses.detach().clone()
        bases[0] = _moved(bases[0], dt * drives.base_velocity)
        return control.replace(
            joint_positions=torch.from_numpy(drives.start + (k + 1) / self.steps * way),
            joint_velocities=torch.from_numpy(way / (self.steps * dt)),
            joint_efforts=torch.from_numpy(drives.efforts),
            base_poses=bases if base == "kinematic" else None,
            base_wrenches=torch.from_numpy(drives.base_wrench[None])
            if base == "floating"
            else None,
        )


def _moved(pose: torch.Tensor, way: np.ndarray) -> torch.Tensor:
    """A pose [7] after a shift and a rotation in the world [6]; unchanged bits for zero motion."""
    if not way.any():
        return pose
    moved = pose.clone()
    moved[:3] += torch.from_numpy(way[:3])
    moved[3:] = torch.from_numpy(turned(pose[3:].numpy(), way[3:]))
    return moved


def turned(q: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Quaternion wxyz turned by a rotation vector in the world."""
    angle = np.linalg.norm(rotation)
    half = 0.5 * np.sinc(angle / (2 * np.pi)) * rotation
    w, v = np.cos(0.5 * angle), half
    return np.concatenate(
        [[w * q[0] - v @ q[1:]], w * q[1:] + q[0] * v + np.cross(v, q[1:])]
    ) / np.linalg.norm(q)


def draw_cloth_scene(seed: int, index: int) -> RandomScene:
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
    # A separate random stream, as for attachments, keeps all other draws of a scene unchanged.
    air = draw_air(np.random.default_rng([seed, index, 3]), d)
    cloths, clearance = draw_cloths(rng, d, air)
    bodies, velocities = draw_bodies(rng, d, clearance)
    scene = dc.Scene(cloths, bodies, gravity=(0.0, 0.0, -d["gravity"]), air_density=air.density)
    scene, pulls = draw_attachments(seed, index, d, scene)
    simulator = dc.Simulator(
        scene,
        d["dt"],
        scheme=d["scheme"],
        contact=dc.ContactOptions(friction_iterations=d["friction_iterations"]),
    )
    return draw_throw(rng, d, simulator, cloths, velocities, pin_speed=0.5, pulls=pulls, air=air)


def draw_throw(
    rng: np.random.Generator,
    d: dict[str, Any],
    simulator: dc.Simulator,
    cloths: list[dc.Cloth],
    body_velocities: np.ndarray,
    pin_speed: float,
    **options: Any,
) -> RandomScene:
    """A scene whose cloths start with random velocities and whose pins sometimes move."""
    start = simulator.initial_state()
    speed = float(np.sqrt(G * d["size"]))  # speed of a fall through the cloth's own size
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
        body_velocities=body_velocities,
        pin_velocity=speed * rng.normal(size=3) * maybe(rng, 0.5, pin_speed) * pinned,
        masses=sheet_masses(cloths),
        **options,
    )


def _material(rng: np.random.Generator, edge: float, air: Air) -> dc.Material:
    return dc.Material(
        stretch=log_uniform(rng, 30.0, 3e4),
        bending=log_uniform(rng, 1e-7, 1e-4),
        poisson=float(rng.uniform(0.0, 0.45)),
        density=log_uniform(rng, 0.03, 1.0),
        damping=maybe(rng, 0.3, log_uniform(rng, 1e-4, 1e-1)),
        friction=maybe(rng, 0.8, rng.uniform(0.05, 1.2)),
        thickness=maybe(rng, 0.4, 0.05 * edge * rng.uniform(0.2, 1.0)),
        normal_drag=air.normal_drag,
        tangential_drag=air.tangential_drag,
    )


def _woven(rng: np.random.Generator, material: dc.Material) -> dc.Material:
    """Half of the time with stiffnesses of the weft, shear and bias that differ from the warp's."""
    if rng.random() < 0.5:
        return material
    D, weft = material.bending, material.bending * log_uniform(rng, 0.1, 10.0)
    least = (D + weft + 2 * material.poisson * np.sqrt(D * weft)) / 4
    return replace(
        material,
        stretch_weft=material.stretch * log_uniform(rng, 0.05, 20.0),
        stretch_shear=material.stretch * log_uniform(rng, 0.01, 2.0),
        bending_weft=weft,
        bending_twill=least * log_uniform(rng, 1.0001, 4.0),
    )


def draw_cloths(
    rng: np.random.Generator, d: dict[str, Any], air: Air, pins: tuple[str, ...] = PINS
) -> tuple[list[dc.Cloth], float]:
    """The cloths, all above z = 0 by the clearance that is returned."""
    rows, columns, size = d["rows"], d["columns"], d["size"]
    edge = size / (max(rows, columns) - 1)
    grid = dc.Cloth.grid(rows, columns, size=(edge * (columns - 1), edge * (rows - 1)))
    flat = np.array(grid.vertices)
    flat[:, :2] += d["jitter"] * edge * rng.uniform(-1, 1, (len(flat), 2))
    clearance = edge * rng.uniform(0.11, 0.5)
    # A separate random stream for woven cloth keeps all other draws of a scene unchanged.
    of_weave = np.random.default_rng(rng.bit_generator.seed_seq.spawn(1)[0])
    material = _woven(of_weave, _material(rng, edge, air))
    d["material"] = {k: getattr(material, k) for k in material.__dataclass_fields__}
    warp = {"directions": [*of_weave.normal(size=2), 0.0]}
    keywords: dict[str, Any] = {"material": material, **warp}
    if d["layout"] == "fold":
        placed = _folded(flat, 0.15 * edge)
    else:
        tilt = rng.uniform(0, 0.3 if d["layout"] == "drop" else 0.02)
        placed = _tilted(flat, rng.normal(size=2), tilt)
        if d["layout"] == "hang":
            placed = placed[:, [0, 2, 1]]
    placed[:, 2] += clearance - placed[:, 2].min()
    d["pins"] = _pins(rng, d["layout"], pins, rows, columns)
    if d["pins"]:
        keywords["pins"] = {"held": d["pins"]}
    cloths = [dc.Cloth(placed, grid.faces, rest_positions=flat, **keywords)]
    if d["layout"] == "stack":
        upper = np.array(flat)
        upper[:, :2] += edge * rng.uniform(-0.5, 0.5, 2)
        upper[:, 2] = placed[:, 2].max() + edge * rng.uniform(0.11, 0.3)
        cloths.append(
            dc.Cloth(
                upper,
                grid.faces,
                rest_positions=flat,
                material=_woven(of_weave, _material(rng, edge, air)),
                **warp,
            )
        )
    return cloths, clearance


def _pins(
    rng: np.random.Generator, layout: str, kinds: tuple[str, ...], rows: int, columns: int
) -> list[int]:
    kind = rng.choice(kinds)
    if layout == "hang":
        kind = rng.choice(["corners", "edge"])
    last = rows * columns - columns
    return {
        "none": [],
        "corner": [last],
        "corners": [last, rows * columns - 1],
        "edge": list(range(last, rows * columns)),
        "rim": [
            i
            for i in range(rows * columns)
            if i // columns in (0, rows - 1) or i % columns in (0, columns - 1)
        ],
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


def draw_bodies(
    rng: np.random.Generator, d: dict[str, Any], clearance: float
) -> tuple[list[dc.RigidBody], np.ndarray]:
    """One or two static or moving bodies below z = 0."""
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
        top = {"box": 0.87 * s, "sphere": 0.5 * s, "capsule": 0.8 * s, "plane": 0.0}[kind]
        extent = 3 * size if kind == "plane" else s
        shift = 0.2 * size * rng.uniform(-1, 1, 2)
        pose = [*shift, -depth - top, *q]
        surface |= smooth(kind, float(q[0]))
        bodies.append(SHAPES[kind](extent, pose=pose, **surface))
        speed = np.sqrt(G * size)
        linear = speed * rng.uniform(0, 1) * rng.normal(size=3)
        angular = rng.uniform(0, 1) * rng.normal(size=3) * speed / size
        velocities.append(np.concatenate([linear, angular]) * moving)
        depth += 2 * top + clearance
    d["bodies"], d["moving"] = kinds, [bool(v.any()) for v in velocities]
    return bodies, np.array(velocities)


def sheet_masses(cloths: list[dc.Cloth]) -> np.ndarray:
    parts = [np.zeros(0)]
    for cloth in cloths:
        a, b, c = (cloth.rest_positions[cloth.faces[:, k]] for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        third = np.repeat(cloth.material.density * area / 3, 3)
        parts.append(np.bincount(cloth.faces.ravel(), third, minlength=len(cloth.vertices)))
    return np.concatenate(parts)
