"""Small scenes in known regimes of contact, each with one step.

Meshes are jittered: exact grids are at kinks of the contact energy. Stiffnesses are low enough for
finite differences. Every scene is warmed up until it is in the regime of its name, so that lagged
friction acts in the step; `test_step_gradients` asserts the properties of each regime.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import torch

import diffcloth_torch as dc
from diffcloth_torch.geometry.poses import transform

F64 = torch.float64
DT = 0.01
EDGE = 0.1  # [m], of all cloths but the folded one
TOLERANCE = 1e-11
WIND = torch.tensor([1.1, -0.7, 0.4], dtype=F64)  # [m/s]

STATE = ("positions", "velocities", "body_poses", "soft_pin_targets")
CONTROL = ("pins", "soft_pins", "body_poses", "forces", "wind")


@dataclass(frozen=True)
class Case:
    """One step: a simulator, a state, and replaced controls and parameters.

    `control` and `parameters` map names to tensors.
    """

    sim: dc.Simulator
    state: dc.State
    control: Mapping[str, torch.Tensor] = field(default_factory=dict)
    parameters: Mapping[str, torch.Tensor] = field(default_factory=dict)

    def step(self, values: Mapping[str, torch.Tensor] | None = None) -> dc.State:
        """Take the step, with some inputs replaced; names as in `inputs`."""
        given = {**self.inputs(), **(values or {})}
        state = self.state.replace(
            **{name: given[f"state.{name}"] for name in STATE if f"state.{name}" in given}
        )
        control = {name: given[f"control.{name}"] for name in self.control}
        parameters = {k[11:]: v for k, v in given.items() if k.startswith("parameters.")}
        return self.sim.step(
            state, dc.Control(**control), self.sim.default_parameters().replace(**parameters)
        )

    def inputs(self) -> dict[str, torch.Tensor]:
        """All differentiable inputs of the step by name: state.*, control.*, parameters.*."""
        tensors = {f"state.{name}": getattr(self.state, name) for name in STATE}
        tensors |= {f"control.{name}": tensor for name, tensor in self.control.items()}
        names = [
            n for n, t in vars(self.sim.default_parameters()).items() if isinstance(t, torch.Tensor)
        ]
        defaults = self.sim.default_parameters()
        for name in names:
            tensors[f"parameters.{name}"] = self.parameters.get(name, getattr(defaults, name))
        return {name: t.detach() for name, t in tensors.items() if t.numel()}

    def where(self, **changes: Any) -> "Case":
        return replace(self, **changes)


def noise(shape, scale, seed=0):
    return scale * np.random.default_rng(seed).uniform(-1.0, 1.0, shape)


def tensor_noise(shape, scale, seed=0):
    return torch.from_numpy(noise(tuple(shape), scale, seed))


def grid(rows, columns, edge=EDGE, seed=0, jitter=0.15):
    """Vertices of a jittered flat sheet in the plane z = 0, and its faces."""
    sheet = dc.Cloth.grid(rows, columns, size=(edge * (columns - 1), edge * (rows - 1)))
    vertices = np.array(sheet.vertices)
    vertices[:, :2] += noise((len(vertices), 2), jitter * edge, seed)
    return vertices, np.array(sheet.faces)


def turned(vertices, axis, angle):
    axis = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    K = np.cross(axis, np.eye(3)).T
    return vertices @ (np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K).T


def material(
    faces,
    seed=0,
    *,
    friction=0.5,
    thickness=0.0,
    damping=0.002,
    stretch=300.0,
    drag=0.0,
    woven=False,
):
    """Material with different values per face, to detect gradients that are wrongly spread.

    `drag` is relative to the drag of a sheet in air; zero by default, which conserves momentum.
    """
    rng = np.random.default_rng(seed)

    def spread(value):
        return value * rng.uniform(0.8, 1.2, len(faces))

    plain = dc.Material(
        stretch=spread(stretch),
        bending=spread(1e-3),
        poisson=spread(0.25),
        density=spread(0.2),
        damping=spread(damping),
        friction=friction,
        thickness=thickness,
        normal_drag=spread(1.5 * drag),
        tangential_drag=spread(0.3 * drag),
    )
    if not woven:
        return plain
    return replace(
        plain,
        stretch_weft=spread(0.6 * stretch),
        stretch_shear=spread(0.15 * stretch),
        bending_weft=spread(6e-4),
        bending_twill=spread(9e-4),
    )


def warp(faces, woven, seed=21):
    """Different directions per face; None if the cloth is not woven."""
    return noise((len(faces), 3), 1.0, seed) * [1.0, 1.0, 0.1] if woven else None


def simulator(
    cloths,
    bodies=(),
    *,
    scheme="coupled",
    metric=None,
    gravity=(0.4, -0.3, -9.81),
    tolerance=TOLERANCE,
    integrator="implicit_euler",
    **contact,
):
    options = {
        "barrier_distance": 0.01,
        "barrier_stiffness": 20.0,
        "slip_velocity": 0.02,
        **contact,
    }
    return dc.Simulator(
        dc.Scene(cloths, bodies, gravity=gravity),
        DT,
        scheme=scheme,
        contact=dc.ContactOptions(**options),
        solver=dc.SolverOptions(tolerance=tolerance, metric=metric),
        integrator=integrator,
    )


def settled(sim, state, steps, control=None, *, velocity=None, hold=None):
    """The state after some steps; `velocity` is then set on free vertices."""
    with torch.no_grad():
        for _ in range(steps):
            state = sim.step(state, control)
    if velocity is not None:
        v = torch.as_tensor(velocity, dtype=F64) + 0.05 * tensor_noise(state.velocities.shape, 1.0)
        state = state.replace(velocities=v)
    return state.detach()


# --- Free flight ---------------------------------------------------------------------------------


def hanging(curved=False, model="patch", woven=False, **options):
    """A sheet in the air with hard and soft pins; its rest shape is flat, or a shallow bowl."""
    vertices, faces = grid(6, 6)
    placed = turned(vertices, (1, 0.3, 0.2), 1.1)
    rest = vertices
    if curved:
        rest = np.array(vertices)
        rest[:, 2] = 0.8 * rest[:, 0] ** 2 + 0.4 * rest[:, 0] * rest[:, 1]
    cloth = dc.Cloth(
        placed,
        faces,
        rest_positions=rest,
        material=material(faces, drag=1.0, woven=woven),
        pins={"corner": [0, 5]},
        soft_pins={"row": [30, 32, 35]},
        pin_stiffness=200.0,
        bending_model=model,
        directions=warp(faces, woven),
    )
    sim = simulator([cloth], **options)
    state = sim.initial_state()
    state = state.replace(
        positions=state.positions + tensor_noise(state.positions.shape, 0.01, 1),
        velocities=tensor_noise(state.positions.shape, 1.0, 2),
        soft_pin_targets=state.soft_pin_targets + tensor_noise((3, 3), 0.02, 3),
    )
    pins = state.positions[[0, 5]] + tensor_noise((2, 3), 0.01, 4)
    control = {"pins": pins, "forces": tensor_noise(state.positions.shape, 0.02, 5)}
    return Case(sim, state, control | {"wind": WIND})


# --- A sheet on a box ----------------------------------------------------------------------------


def on_box(
    friction,
    velocity,
    *,
    thickness=0.0,
    pins=None,
    steps=6,
    above=0.008,
    moving=False,
    woven=False,
    **options,
):
    """A sheet that lies on a box, slightly tilted, with its rim in the air."""
    vertices, faces = grid(6, 6, seed=3)
    pose = [0.01, -0.02, 0.0, 1.3, 0.02, 0.03, 0.2]  # the quaternion is not normalized
    lifted = vertices + np.array([0.0, 0.0, 0.2 + above + 1.2 * thickness])
    placed = transform(lifted, np.array(pose))
    box = dc.RigidBody.box(
        (0.34, 0.29, 0.4),
        motion="kinematic",
        pose=pose,
        friction=friction,
        thickness=thickness,
    )
    cloth = dc.Cloth(
        placed,
        faces,
        material=material(
            faces, drag=1.0, friction=friction, thickness=1.4 * thickness, woven=woven
        ),
        directions=warp(faces, woven),
        pins=pins,
        soft_pins={"free": [35]},
        pin_stiffness=2.0,
    )
    sim = simulator([cloth], [box], **options)
    state = settled(sim, sim.initial_state(), steps, velocity=velocity)
    forces = tensor_noise(state.positions.shape, 0.002, 5)
    control = {"forces": forces, "soft_pins": state.soft_pin_targets + 0.01, "wind": WIND}
    if pins:
        control["pins"] = state.positions[[i for g in pins.values() for i in g]].clone()
        control["pins"] += tensor_noise(control["pins"].shape, 5e-4, 6)
    if moving:
        poses = state.body_poses.clone()
        poses[0] += torch.tensor([4e-3, -3e-3, 5e-3, 0.02, 0.004, -0.006, 0.01], dtype=F64)
        control["body_poses"] = poses
    return Case(sim, state, control)


def sticking(**options):
    return on_box(2.0, (0.0, 0.0, 0.0), **{"slip_velocity": 0.5, **options})


def sliding(**options):
    return on_box(0.3, (1.2, 0.7, -0.1), **options)


def separating(**options):
    return on_box(0.5, (0.3, 0.1, 0.12), **options)


def landing(**options):
    """No contact before the step, contact after: friction begins in the second iteration."""
    return on_box(0.5, (0.5, 0.2, -0.5), steps=0, above=0.011, **options)


def leaving(**options):
    """Contact before the step, none afterwards."""
    return on_box(0.5, (0.3, 0.1, 1.5), **options)


def thick(**options):
    return on_box(0.5, (0.4, 0.3, -0.05), thickness=0.004, **options)


def pushing(**options):
    """A box that rises and rotates under the sheet, and drags the sheet."""
    return on_box(0.6, (0.2, 0.1, 0.0), moving=True, **options)


def pinned(held=False, **options):
    """Pins move (or hold) a sheet in contact; one pinned vertex is itself in contact."""
    case = on_box(0.6, (0.3, -0.2, 0.0), moving=True, pins={"a": [0, 14], "b": [33]}, **options)
    if held:
        case = case.where(control={k: v for k, v in case.control.items() if k == "forces"})
    return case


def poking(**options):
    """A corner of a box turns into a pinned sheet, by several portions of its motion."""
    vertices, faces = grid(6, 6, seed=17)
    up = [0.0, 0.0, 0.0, 0.87, 0.28, -0.36, 0.05]  # a corner on top
    box = dc.RigidBody.box(0.2, motion="kinematic", pose=up, friction=0.5)
    top = transform(np.array(box.vertices), np.array(up))
    corner = top[np.argmax(top[:, 2])]
    cloth = dc.Cloth(
        vertices + corner + [0.013, 0.017, 0.007],
        faces,
        rest_positions=vertices,
        material=material(faces, drag=1.0, friction=0.5),
        pins={"rim": [0, 5, 30, 35]},
        soft_pins={"free": [14]},
        pin_stiffness=2.0,
    )
    sim = simulator([cloth], [box], **options)
    state = settled(sim, sim.initial_state(), 3)
    poses = state.body_poses.clone()
    half = np.radians(25.0) / 2
    w, x, y, z = up[3:]
    about_z = [
        np.cos(half) * w - np.sin(half) * z,
        np.cos(half) * x - np.sin(half) * y,
        np.cos(half) * y + np.sin(half) * x,
        np.cos(half) * z + np.sin(half) * w,
    ]
    poses[0, 3:] = -1.4 * torch.tensor(about_z, dtype=F64)  # the other sign is the same rotation
    poses[0, 2] += 4e-3
    return Case(sim, state, {"body_poses": poses})


# --- Cloth against cloth -------------------------------------------------------------------------


def folded(thickness=0.0, **options):
    """A strip folded over itself: two layers a little apart, rest shape flat."""
    rows, columns, edge = 5, 11, 0.08
    vertices, faces = grid(rows, columns, edge, seed=7)
    radius = 0.0045 + 0.5 * thickness
    s = vertices[:, 0] - 0.04  # distance from the beginning of the fold
    turn = np.pi * radius
    phi = np.clip(s, 0.0, turn) / radius
    over = np.maximum(s - turn, 0.0)
    placed = np.array(vertices)
    placed[:, 0] = np.where(s < 0, s, radius * np.sin(phi) - over)
    placed[:, 2] = radius * (1 - np.cos(phi))
    placed[:, 2] += 0.05 * placed[:, 1] ** 2 + noise(len(placed), 5e-4, 8)
    cloth = dc.Cloth(
        placed,
        faces,
        rest_positions=vertices,
        material=material(faces, drag=1.0, friction=0.5, thickness=thickness),
        pins={"end": [0, 11, 22, 33, 44]},
        soft_pins={"middle": [29]},
        pin_stiffness=20.0,
    )
    sim = simulator([cloth], **options)
    state = settled(sim, sim.initial_state(), 4)
    v = 0.1 * tensor_noise(state.velocities.shape, 1.0, 9)
    upper = torch.from_numpy(s > turn)
    v[upper] += torch.tensor([0.6, 0.3, -0.2], dtype=F64)
    return Case(sim, state.replace(velocities=v), {"forces": tensor_noise(v.shape, 0.001, 5)})


def stacked(dragged=False, woven=False, **options):
    """A cloth slides on a softly pinned cloth; densities and thicknesses differ.

    If `dragged`, pins move the upper cloth over the lower one. The lower one may be woven.
    """
    lower, faces = grid(6, 6, seed=11)
    upper, upper_faces = grid(5, 5, edge=0.09, seed=12)
    upper = turned(turned(upper, (0, 0, 1), 0.03), (1, 0.5, 0), 0.006)
    cloths = [
        dc.Cloth(
            lower,
            faces,
            material=material(faces, drag=1.0, friction=0.4, thickness=0.004, woven=woven),
            directions=warp(faces, woven),
            soft_pins={"all": range(36)},
            pin_stiffness=100.0,
        ),
        dc.Cloth(
            upper + np.array([0.02, 0.01, 0.013]),
            upper_faces,
            material=dc.Material(
                stretch=250.0,
                bending=2e-3,
                density=0.5,
                damping=0.001,
                friction=0.6,
                thickness=0.006,
                normal_drag=1.0,
                tangential_drag=0.2,
            ),
            soft_pins={"one": [12]},
            pin_stiffness=3.0,
            pins={"grip": [7, 8]} if dragged else None,
        ),
    ]
    sim = simulator(cloths, **options)
    state = settled(sim, sim.initial_state(), 4)
    v = 0.05 * tensor_noise(state.velocities.shape, 1.0, 9)
    v[36:] += torch.tensor([0.5, -0.3, -0.1], dtype=F64)
    control = {"forces": tensor_noise(v.shape, 0.001, 5)}
    if dragged:
        way = torch.tensor([0.004, -0.002, -0.001], dtype=F64)
        control["pins"] = state.positions[[36 + 7, 36 + 8]] + way
    return Case(sim, state.replace(velocities=v), control)


def on_sphere(friction=0.4, rows=6, body_friction=None, **options):
    """A sheet over a sphere, which slides off to one side."""
    vertices, faces = grid(rows, rows, edge=0.5 / (rows - 1), seed=13)
    ball = dc.RigidBody.sphere(
        0.2, motion="kinematic", friction=friction, pose=[0, 0, 0, 1, 0.2, 0.1, 0.3]
    )
    cloth = dc.Cloth(
        turned(vertices, (0.2, 1, 0), 0.05) + np.array([0.05, 0.02, 0.207]),
        faces,
        rest_positions=vertices,
        material=material(faces, drag=1.0, friction=friction),
    )
    sim = simulator([cloth], [ball], **options)
    state = settled(sim, sim.initial_state(), 4, velocity=(0.4, 0.1, 0.0))
    return Case(sim, state, {"forces": tensor_noise(state.positions.shape, 0.001, 5)})


REGIMES = {
    "hanging": hanging,
    "curved": lambda **o: hanging(curved=True, **o),
    "hinge": lambda **o: hanging(model="hinge", **o),
    "sticking": sticking,
    "sliding": sliding,
    "separating": separating,
    "landing": landing,
    "leaving": leaving,
    "thick": thick,
    "pushing": pushing,
    "pinned": pinned,
    "held": lambda **o: pinned(held=True, **o),
    "folded": folded,
    "folded_thick": lambda **o: folded(thickness=0.003, **o),
    "stacked": stacked,
    "dragged": lambda **o: stacked(dragged=True, **o),
    "sphere": on_sphere,
    "poking": poking,
    "woven": lambda **o: hanging(curved=True, woven=True, **o),
    "woven_flat": lambda **o: hanging(woven=True, **o),
    "woven_pinned": lambda **o: pinned(woven=True, **o),
    "woven_stacked": lambda **o: stacked(woven=True, **o),
}


@cache
def regime(name, scheme="coupled", metric=None, friction_iterations=2, integrator="implicit_euler"):
    """A scene by name, cached."""
    return REGIMES[name](
        scheme=scheme,
        metric=metric,
        friction_iterations=friction_iterations,
        integrator=integrator,
    )
