"""Random towers: bodies and robots that forces move, above, below and between cloths, or alone.

Objects of any shape and orientation are stacked with gaps. Nothing overlaps at the start, and
falling, thrown or driven objects meet within a few steps.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from random_air import NO_AIR, draw_air
from random_attachments import draw_attachments
from random_draws import log_uniform, maybe
from random_scenes import (
    BODIES,
    PINS,
    SHAPES,
    Drives,
    G,
    RandomScene,
    draw_bodies,
    draw_cloths,
    draw_throw,
    sheet_masses,
    smooth,
)

import diffcloth_torch as dc

COUPLINGS = ("monolithic", "rigid_to_cloth", "cloth_to_rigid")
METRICS = ("energy", "elastic", "mass", "identity")
MODES = ("pd", "position", "velocity", "torque")
BASES = ("fixed", "kinematic", "floating")
OPENING = (1e-3, 0.0385)  # of the gripper's fingers, within their limits [m]
GRIPPER_MASS = 0.46  # [kg]
ROUND_GRIPPER = Path(__file__).resolve().parents[1] / "data" / "round_gripper.urdf"


class Tower:
    """Places objects above and below an occupied slab, each with a gap to the previous one."""

    def __init__(self, low: float, high: float, gap: float) -> None:
        self._ends, self._gap = {-1: low, 1: high}, gap

    def place(self, rng: np.random.Generator, vertices: np.ndarray, side: int) -> float:
        """Height of an object's origin, above (1) or below (-1) all others, from its vertices."""
        near, far = vertices[:, 2].min(), vertices[:, 2].max()
        if side < 0:
            near, far = far, near
        height = self._ends[side] - near + side * self._gap * rng.uniform(1.0, 3.0)
        self._ends[side] = height + far
        return float(height)


def draw_tower(seed: int, index: int) -> RandomScene:
    rng = np.random.default_rng([seed, index])
    has_cloths, has_robot = rng.random() < 0.75, rng.random() < 0.35
    # The gripper has a fixed size.
    size = log_uniform(rng, 0.05, 0.25) if has_robot else log_uniform(rng, 5e-3, 10.0)
    d: dict[str, Any] = {
        "size": size,
        "dt": log_uniform(rng, 1e-3, 0.02 if has_robot else 0.05),
        "layout": str(rng.choice(("drop", "hang", "fold", "stack"))) if has_cloths else "none",
        "rows": int(rng.integers(4, 10)),
        "columns": int(rng.integers(4, 10)),
        "jitter": float(rng.uniform(0.02, 0.2)),
        "friction_iterations": int(rng.integers(1, 4)),
        "gravity": maybe(rng, 0.8, G),
        "steps": int(rng.integers(3, 7)),
    }
    _choose_scheme(rng, d, has_cloths)
    # A separate random stream, as for attachments, keeps all other draws of a scene unchanged.
    air = draw_air(np.random.default_rng([seed, index, 3]), d) if has_cloths else NO_AIR
    cloths, clearance = [], 0.03 * size
    if has_cloths:
        cloths, clearance = draw_cloths(rng, d, air, (*PINS, "rim"))
    heights = np.concatenate([[0.0] if not cloths else [], *(c.vertices[:, 2] for c in cloths)])
    tower = Tower(heights.min(), heights.max(), clearance)
    mass = float(sheet_masses(cloths).sum())
    bodies: list[dc.RigidBody] = []
    velocities = np.zeros((0, 6))
    robots: list[dc.Robot] = []
    drives = None
    if d["scheme"] == "projective":
        bodies, velocities = draw_bodies(rng, d, clearance)
    else:
        kinds: list[str] = []
        for _ in range(int(rng.integers(1, 4 - has_robot))):
            bodies.append(_body(rng, d, tower, mass, kinds))
        if has_robot:
            robots, drives, held = _gripper(rng, d, tower, kinds)
            bodies += held
        # Prescribed bodies come last, at the bottom.
        for _ in range(int(rng.random() < 0.7)):
            bodies.append(_prescribed(rng, d, tower, kinds))
        velocities = np.array([_velocity(rng, d, body) for body in bodies])
        d["bodies"] = kinds
    gravity = (0.0, 0.0, -d["gravity"])
    drawn = dc.Scene(cloths, bodies, robots, gravity=gravity, air_density=air.density)
    drawn, pulls = draw_attachments(seed, index, d, drawn)
    simulator = dc.Simulator(
        drawn,
        d["dt"],
        scheme=d["scheme"],
        coupling=d["coupling"],
        contact=dc.ContactOptions(
            friction_iterations=d["friction_iterations"],
            barrier_distance=None if cloths else 0.3 * clearance,
        ),
        solver=dc.SolverOptions(metric=d["metric"], elastic=d["elastic"]),
    )
    dynamic = np.array([body.motion == "dynamic" for body in bodies], dtype=bool)[:, None]
    moved = velocities * ~dynamic
    options = {"drives": drives, "pulls": pulls, "air": air}
    scene = draw_throw(rng, d, simulator, cloths, moved, pin_speed=0.3, **options)
    if dynamic.any():
        start = scene.start.replace(body_velocities=torch.from_numpy(velocities * dynamic))
        scene = replace(scene, start=start)
    return scene


def _choose_scheme(rng: np.random.Generator, d: dict[str, Any], has_cloths: bool) -> None:
    """Choose a scheme and its options: `split` needs a staggered coupling, `projective` cloths."""
    d["coupling"] = str(rng.choice(COUPLINGS, p=[0.5, 0.25, 0.25]))
    d["scheme"], d["metric"], d["elastic"] = "coupled", None, "newton"
    kind = rng.random()
    if not has_cloths:
        d["coupling"] = "monolithic"
    elif kind < 0.1:
        d["scheme"], d["coupling"] = "projective", "monolithic"
        d["elastic"] = str(rng.choice(["newton", "projective"]))
    elif kind < 0.4 and d["coupling"] != "monolithic":
        d["scheme"] = "split"
        d["metric"] = str(rng.choice(METRICS))
        d["elastic"] = str(rng.choice(["newton", "projective"], p=[0.7, 0.3]))


def _surface(rng: np.random.Generator) -> dict[str, Any]:
    return {"friction": maybe(rng, 0.7, rng.uniform(0.05, 1.2))}


def _shape(rng: np.random.Generator, kind: str, s: float, **keywords: Any) -> dc.RigidBody:
    if kind == "box":
        return dc.RigidBody.box(s * rng.uniform(0.3, 1.0, 3), **keywords)
    return SHAPES[kind](s, **keywords)


def _body(
    rng: np.random.Generator,
    d: dict[str, Any],
    tower: Tower,
    cloth_mass: float,
    kinds: list[str],
    *,
    size: float | None = None,
    at: np.ndarray | None = None,
) -> dc.RigidBody:
    """A dynamic body above or below the tower, or at a given place."""
    kind = str(rng.choice([name for name in BODIES if name != "plane"]))
    s = d["size"] * rng.uniform(0.1, 0.5) if size is None else size
    if cloth_mass and rng.random() < 0.5:
        weight = {"mass": cloth_mass * log_uniform(rng, 0.1, 300.0)}
    else:
        weight = {"density": log_uniform(rng, 30.0, 3000.0)}
    keywords = {"motion": "dynamic", **weight, **_surface(rng)}
    q = rng.normal(size=4)
    shape_seed = int(rng.integers(2**31))
    side = 1 if rng.random() < 0.7 else -1
    kinds.append(f"dynamic {kind} {next(iter(weight))} {next(iter(weight.values())):.3g}")

    keywords |= smooth(kind, float(q[0]))

    def make(pose: list[float]) -> dc.RigidBody:
        return _shape(np.random.default_rng(shape_seed), kind, s, pose=pose, **keywords)

    if at is None:
        shift = 0.2 * d["size"] * rng.uniform(-1, 1, 2)
        about = make([0.0, 0.0, 0.0, *q])
        at = np.array([*shift, tower.place(rng, _turned_vertices(about), side)])
    return make([*at, *q])


def _prescribed(
    rng: np.random.Generator, d: dict[str, Any], tower: Tower, kinds: list[str]
) -> dc.RigidBody:
    kind = str(rng.choice(["plane", *BODIES]))
    motion = "kinematic" if rng.random() < 0.4 else "static"
    kinds.append(f"{motion} {kind}")
    s = 3 * d["size"] if kind == "plane" else d["size"] * rng.uniform(0.3, 1.0)
    keywords = {"motion": motion, **_surface(rng)}
    q = rng.normal(size=4) if kind != "plane" else np.array([1.0, 0.0, 0.0, 0.0])
    keywords |= smooth(kind, float(q[0]))
    about = SHAPES[kind](s, pose=[0.0, 0.0, 0.0, *q], **keywords)
    height = tower.place(rng, _turned_vertices(about), -1)
    return SHAPES[kind](s, pose=[0.0, 0.0, height, *q], **keywords)


def _gripper(
    rng: np.random.Generator, d: dict[str, Any], tower: Tower, kinds: list[str]
) -> tuple[list[dc.Robot], Drives, list[dc.RigidBody]]:
    """The package's gripper in a random orientation, sometimes with a body between its fingers.

    In half of the scenes the fingers have additional round tips.
    """
    base = str(rng.choice(BASES))
    modes = [str(mode) for mode in rng.choice(MODES, 2)]
    hold = rng.random() < 0.5
    start = rng.uniform(OPENING[0], 0.01 if hold else 0.03, 2)
    side = 1 if rng.random() < 0.7 else -1
    # Fingers towards the middle, more or less.
    facing = np.array([0.0, 1.0, 0.0, 0.0] if side > 0 else [1.0, 0.0, 0.0, 0.0])
    q = facing + rng.uniform(0, 0.3) * rng.normal(size=4)
    q /= np.linalg.norm(q)
    options: dict[str, Any] = {
        "base": base,
        "actuation": modes,
        "joint_positions": start,
        "stiffness": log_uniform(rng, 10.0, 2000.0),
        "damping": log_uniform(rng, 0.1, 30.0),
        "friction": maybe(rng, 0.8, rng.uniform(0.1, 1.2)),
        "name": "hand",
    }
    bounds = _bounds(*rng.spawn(1))  # other draws remain unchanged
    options |= bounds
    file, round_tips = dc.robots.GRIPPER, bool(q[2] > 0)
    if round_tips:
        file, options["smooth"] = ROUND_GRIPPER, True
    hand = dc.Robot.load(file, pose=[0.0, 0.0, 0.0, *q], **options)
    frames = hand.forward_kinematics(torch.from_numpy(start)).values()
    vertices = np.concatenate(
        [
            surface.vertices @ frame[:3, :3].numpy().T + frame[:3, 3].numpy()
            for surface, frame in zip(hand.surfaces, frames, strict=True)
        ]
    )
    shift = 0.1 * d["size"] * rng.uniform(-1, 1, 2)
    at = np.array([*shift, tower.place(rng, vertices, side)])
    d["robot"] = {"base": base, "actuation": modes, "holds": hold, "round": round_tips, **bounds}
    hand = dc.Robot.load(file, pose=[*at, *q], **options)
    held = []
    if hold:
        # The body's half diagonal is below half of the fingers' opening.
        middle = at + _rotated(np.array([0.0, 0.0, 0.056]), q)
        size = rng.uniform(0.01, 0.024)
        held.append(_body(rng, d, tower, 0.0, kinds, size=size, at=middle))
    speed = np.sqrt(G * d["size"])
    velocity = np.zeros(6)
    if base == "kinematic":
        velocity[:3] = speed * rng.uniform(0, 0.5) * rng.normal(size=3)
        velocity[3:] = rng.uniform(0, 3.0) * rng.normal(size=3)
    wrench = np.zeros(6)
    if base == "floating":
        wrench[2] = GRIPPER_MASS * d["gravity"] * rng.uniform(0, 2)
        wrench[3:] = 0.01 * rng.normal(size=3)
    drives = Drives(
        start=start,
        ends=rng.uniform(*OPENING, 2),
        efforts=rng.choice([-1.0, 1.0], 2) * log_uniform(rng, 0.1, 20.0),
        base_velocity=velocity,
        base_wrench=wrench,
    )
    return [hand], drives, held


def _bounds(rng: np.random.Generator) -> dict[str, Any]:
    """Random limits and friction of the fingers, absent in some scenes."""
    ends = {
        "effort_limits": (0.1, 30.0),
        "velocity_limits": (0.02, 2.0),
        "joint_friction": (0.01, 5.0),
    }
    drawn = {name: log_uniform(rng, *range_of) for name, range_of in ends.items()}
    return {name: value if rng.random() < 0.5 else False for name, value in drawn.items()}


def _velocity(rng: np.random.Generator, d: dict[str, Any], body: dc.RigidBody) -> np.ndarray:
    """Velocity towards the tower's middle plus noise; a spin of some 0.1 rad per step."""
    if body.motion == "static":
        return np.zeros(6)
    speed = np.sqrt(G * d["size"])
    reach = np.linalg.norm(np.ptp(body.vertices, axis=0)) / 2
    linear = 0.4 * speed * rng.uniform(0, 1) * rng.normal(size=3)
    linear[2] -= np.sign(body.pose[2]) * speed * rng.uniform(0, 2)
    if body.motion == "kinematic":
        linear *= 0.5
    angular = rng.normal(size=3) * min(speed / reach, 0.3 / d["dt"]) * rng.uniform(0, 1)
    return np.concatenate([linear, angular])


def _rotated(vector: np.ndarray, q: np.ndarray) -> np.ndarray:
    w, u = q[0], q[1:]
    return vector + 2 * np.cross(u, np.cross(u, vector) + w * vector)


def _turned_vertices(body: dc.RigidBody) -> np.ndarray:
    q = np.array(body.pose[3:]) / np.linalg.norm(body.pose[3:])
    return np.stack([_rotated(v, q) for v in body.vertices])
