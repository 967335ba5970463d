"""Scenes of the benchmarks: a square sheet of 1 m, with bodies, robots or other sheets.

Sheets are jittered in their plane, because exact grids are at kinks of the contact energy. Each
scene approaches its regime in untimed steps. `SCENES` are the ordinary ones; in `BUCKLING` cloth
buckles in many places at once, which requires many iterations; scenes of `FURTHER` have a
potential, a body or a robot that the others lack. The stiffnesses of `woven-sphere` differ so
little from each other that its steps equal the steps of `sphere`: the additional time is the cost
of the orthotropic kernels. Older versions timed by `benchmarks.compare` know `rest_positions` of
cloths only by its earlier name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import diffcloth_torch as dc

DT = 0.01  # [s]
TURN = 2 * np.pi  # of the ends of a sheet that is twisted [rad/s]


@dataclass(frozen=True)
class Scene:
    """A benchmark scene with its start and motion.

    Attributes:
        scene: Cloth and bodies.
        approach: Number of steps until the regime is reached.
        speed: Velocity of the cloth at the start [m/s].
        body_speed: Constant velocity of the bodies [m/s].
        carry: Function from pinned vertices to their velocities [m/s]; None: pins rest.
        joint_target: Target of the drives of all joints [m]; None without a robot.
    """

    scene: dc.Scene
    approach: int
    speed: tuple[float, float, float] = (0.0, 0.0, 0.0)
    body_speed: tuple[float, float, float] = (0.0, 0.0, 0.0)
    carry: Callable[[Tensor], Tensor] | None = None
    joint_target: float | None = None

    def control(self, state: dc.State) -> dc.Control:
        """Control that moves pins and bodies by one step, in new leaves without history."""
        if self.joint_target is not None:
            return dc.Control(
                joint_positions=torch.full_like(state.joint_positions, self.joint_target)
            )
        if self.carry is not None:
            pinned = [v for name in self.scene.cloths[0].pins.values() for v in name]
            held = state.positions.detach()[..., pinned, :]
            return dc.Control(pins=held + DT * self.carry(held))
        if state.body_poses.shape[-2] == 0:
            return dc.Control()
        shift = torch.tensor([*self.body_speed, 0, 0, 0, 0], dtype=torch.float64)
        return dc.Control(body_poses=state.body_poses.detach() + DT * shift)


def sheet(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [n * n, 3] of a jittered sheet in the xy-plane, and faces; row by row along y."""
    grid = dc.Cloth.grid(n, n)
    vertices = np.array(grid.vertices)
    jitter = np.random.default_rng(n).uniform(-0.1, 0.1, (n, n, 2)) / (n - 1)
    jitter[[0, -1], :, 1] = 0.0
    jitter[:, [0, -1], 0] = 0.0
    vertices[:, :2] += jitter.reshape(-1, 2)
    return vertices, np.array(grid.faces)


def _gap(n: int) -> float:
    """Distance at which the default barrier begins, about [m]."""
    return 0.1 / (n - 1)


def _upright(n: int, **keywords: object) -> dc.Cloth:
    vertices, faces = sheet(n)
    placed = np.stack([vertices[:, 0], np.zeros(n * n), 1.0 + vertices[:, 1]], axis=-1)
    return dc.Cloth(placed, faces, rest_positions=vertices, **keywords)


def hanging(n: int, **material: float) -> Scene:
    """Swing down from the horizontal, held by two corners: free of contact."""
    vertices, faces = sheet(n)
    pins = {"corners": [n * (n - 1), n * n - 1]}
    cloth = dc.Cloth(vertices, faces, pins=pins, material=dc.Material(**material))
    return Scene(dc.Scene([cloth]), approach=10)


def air(n: int) -> Scene:
    """Swing down like `hanging`, through air."""
    return hanging(n, normal_drag=1.5, tangential_drag=0.03)


def damped(n: int) -> Scene:
    """Swing down like `hanging`, damped as the sheets of the configurations are."""
    return hanging(n, damping=0.01)


def stiff(n: int) -> Scene:
    """Hang upright by two corners without contact, so stiff that the sheet buckles."""
    pins = {"corners": [n * (n - 1), n * n - 1]}
    cloth = _upright(n, pins=pins, material=dc.Material(stretch=1e4))
    return Scene(dc.Scene([cloth]), approach=10)


def plane(n: int) -> Scene:
    """Slide on a floor: every vertex in contact."""
    vertices, faces = sheet(n)
    vertices[:, 2] = _gap(n)
    floor = dc.RigidBody.plane(4.0)
    scene = dc.Scene([dc.Cloth(vertices, faces)], [floor])
    return Scene(scene, approach=12, speed=(0.8, 0.3, 0.0))


def sphere(
    n: int,
    material: dc.Material = dc.Material(),  # noqa: B008  # immutable
    **shape: bool,
) -> Scene:
    """Drape over a sphere: some vertices are in contact, with folds between them."""
    vertices, faces = sheet(n)
    vertices += (0.02, 0.03, _gap(n))
    ball = dc.RigidBody.sphere(0.2, pose=[0, 0, -0.2, 1, 0, 0, 0], **shape)
    cloth = dc.Cloth(vertices, faces, material=material)
    return Scene(dc.Scene([cloth], [ball]), approach=20)


def smooth_sphere(n: int) -> Scene:
    """Drape over a smooth sphere with an analytic surface."""
    return sphere(n, smooth=True)


def damped_sphere(n: int) -> Scene:
    """Drape over a sphere, damped."""
    return sphere(n, dc.Material(damping=0.01))


def woven_sphere(n: int) -> Scene:
    """Drape woven cloth over a sphere."""
    stretch, bending = dc.Material().stretch, dc.Material().bending
    woven = dc.Material(
        stretch_weft=0.99 * stretch,
        stretch_shear=0.98 * stretch,
        bending_weft=0.99 * bending,
        bending_twill=0.98 * bending,
    )
    return sphere(n, woven)


def gripper(n: int, **bounds: float) -> Scene:
    """Lower a hand onto a sheet held at two edges, while its drives close its fingers."""
    vertices, faces = sheet(n)
    edges = [*range(n), *range(n * (n - 1), n * n)]
    hand = dc.Robot.load(
        dc.robots.GRIPPER,
        base="floating",
        stiffness=200.0,
        damping=5.0,
        pose=[0.013, 0.007, 0.1, 0, 1, 0, 0],  # turned over: its fingers end 1 cm above the sheet
        **bounds,
    )
    scene = dc.Scene([dc.Cloth(vertices, faces, pins={"edges": edges})], robots=[hand])
    return Scene(scene, approach=12, joint_target=0.01)


def limited_gripper(n: int) -> Scene:
    """The gripper with joint friction, and drives at the limits of their efforts and speeds."""
    return gripper(n, effort_limits=2.0, velocity_limits=0.05, joint_friction=0.2)


def self_contact(n: int) -> Scene:
    """Lay one half of a folded sheet on the other, which hangs between two pinned rows."""
    vertices, faces = sheet(n)
    gap = 0.5 / (n - 1)
    s = vertices[:, 1]  # along the sheet; the upper half is folded back over the lower one
    lower = s < 0.0
    folded = np.stack([vertices[:, 0], np.where(lower, s, -s), np.where(lower, 0.0, gap)], axis=-1)
    last = int(lower.reshape(n, n)[:, 0].sum()) - 1
    pins = {"edge": range(n), "fold": range(last * n, (last + 1) * n)}
    cloth = dc.Cloth(folded, faces, rest_positions=vertices, pins=pins)
    return Scene(dc.Scene([cloth]), approach=14)


def two_sheets(n: int) -> Scene:
    """Drop a rotated sheet on another sheet with held edges."""
    vertices, faces = sheet(n)
    rim = np.abs(vertices[:, :2]).max(axis=1) > 0.5 - 1e-9
    lower = dc.Cloth(vertices, faces, pins={"rim": np.flatnonzero(rim).tolist()})
    c, s = np.cos(0.3), np.sin(0.3)
    turned = 0.6 * vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    turned[:, 2] += 0.5 / (n - 1)
    return Scene(dc.Scene([lower, dc.Cloth(turned, faces)]), approach=14)


def moving_body(n: int) -> Scene:
    """Push a box into a sheet that hangs by its upper edge."""
    cloth = _upright(n, pins={"edge": range(n * (n - 1), n * n)})
    box = dc.RigidBody.box(0.4, motion="kinematic", pose=[0.03, -0.22, 0.95, 1, 0, 0, 0])
    return Scene(dc.Scene([cloth], [box]), approach=22, body_speed=(0.0, 0.5, 0.1))


def twist(n: int) -> Scene:
    """Rotate two opposite edges against each other, while their distance decreases."""
    vertices, faces = sheet(n)
    pins = {"left": range(n), "right": range(n * (n - 1), n * n)}

    def carry(held: Tensor) -> Tensor:
        x, y, z = held.unbind(-1)
        turn = TURN * y.sign()
        return torch.stack([turn * z, -0.4 * y.sign(), -turn * x], dim=-1)

    return Scene(dc.Scene([dc.Cloth(vertices, faces, pins=pins)]), approach=20, carry=carry)


def crumple(n: int) -> Scene:
    """Draw eight points of the rim together, until the sheet lies on itself."""
    vertices, faces = sheet(n)
    half, last = n // 2, n - 1
    rim = [
        (0, 0),
        (0, half),
        (0, last),
        (half, 0),
        (half, last),
        (last, 0),
        (last, half),
        (last, last),
    ]
    pins = {"rim": [n * i + j for i, j in rim]}

    def carry(held: Tensor) -> Tensor:
        return -2.0 * held

    return Scene(dc.Scene([dc.Cloth(vertices, faces, pins=pins)]), approach=20, carry=carry)


def impact(n: int) -> Scene:
    """Shoot a sheet at the tip of a cone."""
    vertices, faces = sheet(n)
    vertices += (0.02, 0.03, _gap(n))
    sides = 12
    angles = 2 * np.pi * np.arange(sides) / sides
    rim = np.stack([0.1 * np.cos(angles), 0.1 * np.sin(angles), np.full(sides, -0.3)], axis=-1)
    mantle = [(0, 1 + k, 1 + (k + 1) % sides) for k in range(sides)]
    base = [(sides + 1, 1 + (k + 1) % sides, 1 + k) for k in range(sides)]
    cone = dc.RigidBody(np.vstack([[0.0, 0.0, 0.0], rim, [0.0, 0.0, -0.3]]), mantle + base)
    return Scene(dc.Scene([dc.Cloth(vertices, faces)], [cone]), approach=0, speed=(0.0, 0.0, -30.0))


SCENES: dict[str, Callable[[int], Scene]] = {
    "hanging": hanging,
    "stiff": stiff,
    "plane": plane,
    "sphere": sphere,
    "self-contact": self_contact,
    "two-sheets": two_sheets,
    "moving-body": moving_body,
}

FURTHER: dict[str, Callable[[int], Scene]] = {
    "damped": damped,
    "damped-sphere": damped_sphere,
    "air": air,
    "woven-sphere": woven_sphere,
    "smooth-sphere": smooth_sphere,
    "gripper": gripper,
    "limited-gripper": limited_gripper,
}

BUCKLING: dict[str, Callable[[int], Scene]] = {
    "twist": twist,
    "crumple": crumple,
    "impact": impact,
}


def in_regime(
    simulator: dc.Simulator, scene: Scene, batch: int, kept: Path | None = None
) -> dc.State:
    """State of the scene in its regime; the environments of a batch differ slightly.

    With `kept`, the state is read from this file, or written to the file if it does not exist.
    """
    state = simulator.initial_state(batch or None)
    if kept is not None and kept.exists():
        return state.replace(**torch.load(kept, weights_only=True))
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(state.positions.shape, generator=generator, dtype=torch.float64)
    speed = torch.tensor(scene.speed, dtype=torch.float64)
    state = state.replace(velocities=speed + 0.003 * noise)
    with torch.no_grad():
        for _ in range(scene.approach):
            state = simulator.step(state, scene.control(state))
    if kept is not None:
        fields = ("positions", "velocities", "body_poses")
        torch.save({name: getattr(state, name) for name in fields}, kept)
    return state


def kept_file(folder: Path, name: str, size: int, batch: int) -> Path:
    """File in which `in_regime` stores a state for other runs that start there."""
    return folder / f"{name}-{size}-{batch}.pt"
