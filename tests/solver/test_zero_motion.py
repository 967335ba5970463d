"""Prescribed motions of exactly zero and of nearly zero have the same result.

Plans that begin at zero, and policies whose last layer is zero, start without motion. If the solver
used another path for a motion of exactly zero than for a small motion, the gradient would not match
`(loss(e) - loss(0)) / e`. The scenes buckle: another path ends in another minimum, millimeters
away.
"""

from functools import cache

import numpy as np
import pytest
import scenes
import torch

import diffcloth_torch as dc
from diffcloth_torch.robots import GRIPPER

F64 = torch.float64
DT = 0.01
SMALL = 1e-11  # [m], [rad], [m/s] or [-]
STEPS = 12
# In these scenes positions change by less than a hundred times the change of a prescribed value.
CLOSE = 100 * SMALL


def rock(radius, height, jitter, seed):
    """Vertices of a jittered ellipsoid about its center, and faces."""
    ball = dc.RigidBody.sphere(radius)
    vertices = np.array(ball.vertices)
    vertices[:, 2] *= height
    return vertices + scenes.noise(vertices.shape, jitter, seed), np.array(ball.faces)


def sheet(n, width, over, seed):
    """Vertices of a jittered sheet whose middle is at `over`, and faces."""
    vertices, faces = scenes.grid(n, n, width / (n - 1), seed)
    vertices[:, :2] -= vertices[:, :2].mean(axis=0)
    return vertices + np.asarray(over), faces


@cache
def simulator(scheme, coupling):
    """A damped sheet over a rock and the back of a hand, with all that can be prescribed."""
    vertices, faces = sheet(13, 0.42, (0.01, 0.02, 0.21), seed=5)
    corners = {"tip": [0], "loose": [12]}
    nodal = scheme == "projective"
    material = dc.Material(damping=0.01, normal_drag=1.2, tangential_drag=0.05)
    cloth = dc.Cloth(
        vertices,
        faces,
        material=material,
        pins={"tip": corners["tip"]},
        soft_pins={"loose": corners["loose"]},
        name="sheet",
    )
    if nodal:
        body = dc.RigidBody.sphere(0.18, motion="kinematic", nodal_contact=True, name="rock")
        scene = dc.Scene([cloth], [body], attachments=[picker()])
        return dc.Simulator(scene, DT, scheme=scheme, solver=dc.SolverOptions(tolerance=1e-9))
    shape, triangles = rock(0.12, 1.6, 0.002, seed=1)
    body = dc.RigidBody(shape, triangles, motion="kinematic", name="rock")
    hand = dc.Robot.load(
        GRIPPER,
        base="kinematic",
        pose=[0.16, -0.1, 0.1, 1, 0, 0, 0],
        joint_positions=0.02,
        actuation="position",
        name="hand",
    )
    bodies = [body]
    if (scheme, coupling) != ("split", "monolithic"):  # the scheme supports no dynamic bodies
        pose = [-0.15, 0.1, 0.1, 1, 0, 0, 0]
        box = dc.RigidBody.box([0.05, 0.06, 0.04], motion="dynamic", mass=0.2, pose=pose)
        bodies.append(box)
    return dc.Simulator(
        dc.Scene([cloth], bodies, robots=[hand], attachments=[picker()]),
        DT,
        scheme=scheme,
        coupling=coupling,
        solver=dc.SolverOptions(tolerance=1e-10),
    )


def picker():
    return dc.Attachment(("sheet", 156), stiffness=40.0, name="picker")


WAYS = [
    ("coupled", "monolithic"),
    ("coupled", "rigid_to_cloth"),
    ("coupled", "cloth_to_rigid"),
    ("split", "monolithic"),
    ("split", "rigid_to_cloth"),
    ("split", "cloth_to_rigid"),
    ("projective", "monolithic"),
]


@cache
def states(scheme, coupling):
    sim = simulator(scheme, coupling)
    state, result = sim.initial_state(), []
    with torch.no_grad():
        for _ in range(STEPS):
            state = sim.step(state)
            result.append(state)
    return result


def along(like, seed):
    return scenes.tensor_noise(like.shape, SMALL, seed)


def prescribed(name, sim, state, moved):
    """A control that holds all positions; if `moved`, the quantity `name` is slightly changed."""
    target = torch.tensor([[-0.21, 0.22, 0.22]], dtype=F64)
    fields = {
        "pins": state.positions[[0]],
        "soft_pins": state.soft_pin_targets,
        "body_poses": state.body_poses,
        "base_poses": state.base_poses,
        "joint_positions": state.joint_positions,
        "attachments": {"picker": state.positions[[156]]},
        "attachment_weights": {"picker": torch.zeros(1, dtype=F64)},
        "wind": torch.zeros(3, dtype=F64),
    }
    control = {}
    if name == "attachments":
        control["attachment_weights"] = {"picker": torch.ones(1, dtype=F64)}
    if name == "attachment_weights":
        control["attachments"] = {"picker": target}
    value = fields[name]
    if moved:
        if isinstance(value, dict):
            value = {key: v + along(v, 3).abs() for key, v in value.items()}
        elif name == "body_poses":
            change = along(value, 3)
            change[1:] = 0.0  # the row of a dynamic body is the state's
            value = value + change
        else:
            value = value + along(value, 3)
    return dc.Control(**control, **{name: value})


QUANTITIES = (
    "pins",
    "soft_pins",
    "body_poses",
    "base_poses",
    "joint_positions",
    "attachments",
    "attachment_weights",
    "wind",
)


CASES = [
    (*way, quantity)
    for way in WAYS
    for quantity in QUANTITIES
    if way[0] != "projective"
    or quantity not in ("base_poses", "joint_positions")  # the scheme supports no robots
]


@pytest.mark.quick(
    "coupled-monolithic-*",
    "split-rigid_to_cloth-joint_positions",
    "coupled-cloth_to_rigid-soft_pins",
    "split-monolithic-body_poses",
    "projective-*",
)
@pytest.mark.parametrize(("scheme", "coupling", "quantity"), CASES)
def test_a_quantity_at_zero_is_the_limit_of_small_ones(scheme, coupling, quantity):
    sim = simulator(scheme, coupling)
    with torch.no_grad():
        for state in states(scheme, coupling)[2:]:
            at_zero = sim.step(state, prescribed(quantity, sim, state, moved=False))
            beside = sim.step(state, prescribed(quantity, sim, state, moved=True))
            apart = (beside.positions - at_zero.positions).norm(dim=-1).max().item()
            assert apart < CLOSE
