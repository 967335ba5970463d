"""A cloth, a dynamic box that slides on it, and a gripper that holds its edge."""

from functools import cache

import numpy as np
import scenes
import torch

import diffcloth_torch as dc
from diffcloth_torch.robots import GRIPPER

F64 = torch.float64
DT = 0.01
COUPLINGS = ("monolithic", "rigid_to_cloth", "cloth_to_rigid")
BASES = ("fixed", "floating")
GRAVITY = np.array([0.4, -0.3, -9.81])
WARM_UP = 3  # steps before a scene is in contact
WEIGHT = 0.46 * 9.81  # of the gripper [N]

# Orientation of the gripper: fingers point along -x and close along z.
_FACING = [0.5, -0.5, -0.5, 0.5]

# Velocity limit of the fingers, which their drives would exceed, by coupling and base [m/s].
_FASTEST = {
    "monolithic": {"fixed": 0.012, "floating": 0.004, "kinematic": 0.012},
    "rigid_to_cloth": {"fixed": 0.012, "floating": 0.004, "kinematic": 0.02},
    "cloth_to_rigid": {"fixed": 0.004, "floating": 0.0025, "kinematic": 0.03},
}

# Staggered couplings need bodies that are heavy against the cloth; less gravity keeps their weight.
_HEAVIER = {"monolithic": 1.0, "rigid_to_cloth": 10.0, "cloth_to_rigid": 10.0}


def simulator(coupling, base, integrator="implicit_euler", **options):
    vertices, faces = scenes.grid(5, 5, edge=0.06, seed=3)
    vertices = scenes.turned(vertices - vertices.mean(axis=0), (0.3, 1, 0), 0.04)
    cloth = dc.Cloth(
        vertices,
        faces,
        material=scenes.material(faces, stretch=200.0),
        soft_pins={"rim": [0, 1, 2, 3, 4, 5, 10, 15, 20]},
        pin_stiffness=60.0,
    )
    heavier = _HEAVIER[coupling]
    box = dc.RigidBody.box(
        [0.07, 0.09, 0.05],
        motion="dynamic",
        mass=0.05 * heavier,
        pose=[-0.02, 0.01, 0.033, 1, 0.02, 0.02, 0.2],
        name="box",
    )
    edge = vertices[np.argmax(vertices[:, 0])]
    hand = dc.Robot.load(
        GRIPPER,
        base=base,
        pose=[edge[0] + 0.061, 0.013, edge[2] + 0.001, *_FACING],
        joint_positions=0.035,
        actuation=("position", "pd") if base == "kinematic" else "pd",
        stiffness=400.0,
        damping=3.0,
        friction=0.6,
        name="hand",
    )
    given = {"barrier_distance": 0.01, "barrier_stiffness": 60.0, "slip_velocity": 0.02}
    return dc.Simulator(
        dc.Scene([cloth], [box], [hand], gravity=GRAVITY / heavier),
        DT,
        coupling=coupling,
        integrator=integrator,
        contact=dc.ContactOptions(**{**given, **options}),
        solver=dc.SolverOptions(tolerance=1e-12, max_iterations=2000),
    )


def parameters(sim):
    """Parameters of the scene; the fingers are heavier by the same factor as the box.

    The fingers have friction, drives near their effort limits and speeds near their limits.
    """
    given = sim.default_parameters()
    heavier = _HEAVIER[sim.coupling]
    fastest = _FASTEST[sim.coupling][sim.scene.robots[0].mechanism.base]
    return given.replace(
        link_mass=heavier * given.link_mass,
        link_inertia=heavier * given.link_inertia,
        joint_viscosity=given.joint_viscosity + 1.0,
        joint_armature=given.joint_armature + 0.02,
        joint_effort_limits=torch.tensor([1.5, 1.05], dtype=F64),
        joint_velocity_limits=torch.full((2,), fastest, dtype=F64),
        joint_friction=torch.tensor([0.1, 0.08], dtype=F64),
        joint_slip_rates=torch.tensor([0.006, 0.02], dtype=F64),
    )


def control(sim):
    """Fingers that close, a base that is held against gravity, and pushes on everything."""
    state = sim.initial_state()
    base = sim.scene.robots[0].mechanism.base
    lift = WEIGHT * (base == "floating")
    return dc.Control(
        forces=scenes.tensor_noise(state.positions.shape, 0.002, 5),
        soft_pins=state.soft_pin_targets + scenes.tensor_noise((9, 3), 0.002, 6),
        body_wrenches=torch.tensor([[0.02, 0.03, -0.1, 1e-3, 2e-3, 3e-3]], dtype=F64),
        joint_positions=torch.tensor([0.0385, 0.038], dtype=F64),
        joint_velocities=torch.tensor([0.02, 0.01], dtype=F64),
        joint_efforts=torch.tensor([0.1, -0.05], dtype=F64),
        base_poses=state.base_poses if base == "kinematic" else None,
        base_wrenches=torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]], dtype=F64) * lift,
    )


def controls(sim, first, steps, start=0):
    """`first` for each step; prescribed joints and bases keep moving.

    A step without prescribed motion may find another minimum than a step with such motion.
    """
    if sim.scene.robots[0].mechanism.base != "kinematic":
        return [first] * steps
    way = torch.tensor([[3e-4, 2e-4, -3e-4, 3e-3, 2e-3, 0.0, -3e-3]], dtype=F64)
    return [
        first.replace(
            base_poses=first.base_poses + k * way, joint_positions=first.joint_positions - k * 2e-4
        )
        for k in range(start + 1, start + 1 + steps)
    ]


@cache
def in_contact(coupling, base):
    """A simulator, and a state in which the box slides on the cloth and the gripper holds it."""
    sim = simulator(coupling, base)
    state = sim.initial_state()
    slide = torch.tensor([[0.18, 0.063, -0.018, 0.45, 0.0, 0.9]], dtype=F64)
    state = state.replace(body_velocities=slide)
    with torch.no_grad():
        given = controls(sim, control(sim), WARM_UP), parameters(sim)
        state = sim.rollout(state, *given)[-1]
    return sim, state.detach()


def cloth_masses(sim):
    """A third of the mass of each adjacent face, shape [N] [kg]."""
    if not sim.scene.cloths:
        return torch.zeros(0, dtype=F64)
    (cloth,) = sim.scene.cloths
    faces = torch.tensor(np.array(cloth.faces, dtype=np.int64))
    a, b, c = torch.tensor(np.array(cloth.rest_positions))[faces].unbind(1)
    share = sim.default_parameters().density * torch.linalg.cross(b - a, c - a).norm(dim=1) / 6
    masses = torch.zeros(len(cloth.vertices), dtype=F64)
    return masses.index_add(0, faces.flatten(), share.repeat_interleave(3))


def matrices(poses):
    """Homogeneous matrices of poses [.., 7]."""
    w, u = torch.split(torch.nn.functional.normalize(poses[..., 3:], dim=-1), [1, 3], dim=-1)
    eye = torch.eye(3, dtype=F64).expand(*poses.shape[:-1], 3, 3)
    K = torch.linalg.cross(u[..., None, :].expand_as(eye), eye).mT
    frames = torch.eye(4, dtype=F64).repeat(*poses.shape[:-1], 1, 1)
    frames[..., :3, :3] = eye + 2 * w[..., None] * K + 2 * K @ K
    frames[..., :3, 3] = poses[..., :3]
    return frames
