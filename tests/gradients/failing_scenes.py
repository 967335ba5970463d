"""Scenes in which one of eight environments fails, mostly because of an infeasible motion.

A loose or pinned sheet is squeezed between a moving object and a static one; a ball that falls
beside the sheet involves every coupling. Or forces crumple the sheet, which requires more
iterations than allowed.
"""

import math

import torch

import diffcloth_torch as dc
from diffcloth_torch.robots import GRIPPER

F64 = torch.float64
B, FAILED, DT = 8, 5, 0.01
FLAT = [1.0, 0.0, 0.0, 0.0]

# Moving object -> name of the control.
KINDS = {
    "pins": "pins",
    "body": "body_poses",
    "turning body": "body_poses",
    "joint": "joint_positions",
    "base": "base_poses",
    "forces": "forces",
}
BLOCKED = [kind for kind in KINDS if kind != "forces"]


def status(kind, scheme="coupled", coupling="monolithic"):
    """Status of each environment in the report."""
    # The elastic stage of "split" leaves no iteration to move the ball.
    is_blocked = kind in BLOCKED or (scheme, coupling) == ("split", "rigid_to_cloth")
    failure = "infeasible_motion" if is_blocked else "not_converged"
    return tuple(failure if i == FAILED else "converged" for i in range(B))


# Scheme and coupling; forces move no body in the first.
SOLVES = [
    ("split", "monolithic"),
    ("coupled", "monolithic"),
    ("split", "rigid_to_cloth"),
    ("coupled", "rigid_to_cloth"),
    ("coupled", "cloth_to_rigid"),
]


def simulator(kind, scheme="coupled", coupling="monolithic", **solver):
    """The scene of a kind."""
    ball = dc.RigidBody.sphere(0.01, motion="dynamic", mass=0.01, pose=[0.6, 0.0, 0.5, *FLAT])
    table = dc.RigidBody.box([1.0, 1.0, 0.1], pose=[0.0, 0.0, -0.06, *FLAT])
    bodies, robots, gravity = [table], [], (0.0, 0.0, -1.0)
    is_prescribed = (scheme, coupling) == SOLVES[0]
    if kind in ("joint", "base"):
        # A standing sheet between a finger and a block.
        sheet = dc.Cloth.grid(
            5, 5, size=0.06, pose=[0.0, 0.02, 0.066, math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]
        )
        bodies[0] = dc.RigidBody.box([0.1, 0.02, 0.06], pose=[0.0, 0.0, 0.066, *FLAT])
        right = "position" if is_prescribed else "pd"
        actuation = {"left_finger_joint": "position", "right_finger_joint": right}
        robots = [
            dc.Robot.load(
                GRIPPER,
                base="kinematic" if kind == "base" else "fixed",
                actuation=actuation,
                stiffness=100.0,
                damping=1.0,
                name="hand",
            )
        ]
        gravity = (0.0, 0.0, 0.0)
    else:
        edges = {"edge": [0, 1, 2, 3], "other": [12, 13, 14, 15]}
        pins = {"pins": {"edge": edges["edge"]}, "turning body": edges}.get(kind)
        sheet = dc.Cloth.grid(4, 4, size=0.3, pins=pins, pose=[0.0, 0.0, 0.02, *FLAT])
    if kind == "body":
        bodies.append(
            dc.RigidBody.box(
                [0.5, 0.5, 0.1], motion="kinematic", pose=[0, 0, 0.08, *FLAT], name="plate"
            )
        )
    if kind == "turning body":
        bodies.append(
            dc.RigidBody.box(
                [0.4, 0.2, 0.02], motion="kinematic", pose=[0, 0, 0.07, *FLAT], name="plate"
            )
        )
    if not is_prescribed:
        bodies.append(ball)
    if kind == "forces":
        solver = {"max_iterations": 8} | solver
    scene = dc.Scene([sheet], bodies, robots, gravity=gravity)
    return dc.Simulator(
        scene,
        DT,
        scheme=scheme,
        coupling=coupling,
        contact=dc.ContactOptions(barrier_distance=0.004),
        solver=dc.SolverOptions(**{"throw": False} | solver),
    )


def targets(kind, sim):
    """Prescribed targets at the end of a step, [B, ...]: too far in one environment."""
    state = sim.initial_state(B)
    small = 1e-3 * torch.linspace(0.2, 1.0, B, dtype=F64)
    if kind == "pins":
        pins = state.positions[:, :4].clone()
        pins[..., 2] -= small[:, None]
        pins[FAILED, :, 2] = -0.2
        return pins
    if kind == "forces":
        forces = torch.zeros_like(state.positions)
        forces[..., 2] = small[:, None]
        noise = torch.randn(forces[0].shape, generator=torch.Generator().manual_seed(2), dtype=F64)
        forces[FAILED] = 2.0 * noise
        return forces
    if kind == "joint":
        joints = state.joint_positions.clone()
        joints[:, 0] = small
        joints[FAILED, 0] = 0.037
        return joints
    if kind == "base":
        bases = state.base_poses.clone()
        bases[:, 0, 1] -= small
        angle = 0.3
        turned = torch.tensor([math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)], dtype=F64)
        bases[FAILED, 0, 1] = -0.04
        bases[FAILED, 0, 3:] = turned
        return bases
    poses = state.body_poses[:, 1].clone()  # of the plate
    angle = 4 * small
    if kind == "turning body":
        angle[FAILED] = 1.5
        poses[:, 3], poses[:, 4] = torch.cos(angle / 2), torch.sin(angle / 2)
    else:
        poses[:, 2] -= small
        poses[FAILED, 2] -= 0.05
    return poses


def control(kind, values):
    """The control of such targets."""
    field = KINDS[kind]
    return dc.Control(**{field: {"plate": values} if field == "body_poses" else values})
