"""The gradient of a step against bodies of every shape: open, hollow, smooth, slivers, moving."""

import numpy as np
import pytest
import scenes
import torch
import trimesh
from scipy.spatial.transform import Rotation
from test_step_gradients import CONTACT, check, gradients, make_loss

import diffcloth_torch as dc
from diffcloth_torch import _kernels

F64 = torch.float64
GAP = 0.006  # of the barrier's 0.01


def triangle():
    """One triangle below a part of the sheet; an edge and a corner of it press into the cloth."""
    return np.array([[-0.21, -0.16, 0], [0.24, -0.05, 0.002], [0.03, 0.23, 0]]), [[0, 1, 2]]


def terrain():
    """An open sheet with hills and hollows, finer than the cloth, whose border is below it."""
    vertices, faces = scenes.grid(7, 7, edge=0.05, seed=4)
    center = vertices.mean(axis=0)
    bumps = 0.002 * np.random.default_rng(5).uniform(-1, 1, len(vertices))
    return vertices - center + bumps[:, None] * [0, 0, 1], faces


def slivers():
    """A floor that a strip of narrow triangles runs through."""
    x = np.array([-0.5, -0.1, 0.03, 0.0301, 0.2, 0.5])
    u, v = np.meshgrid(x, np.linspace(-0.5, 0.5, 4), indexing="ij")
    corner = (4 * np.arange(5)[:, None] + np.arange(3)).ravel()
    faces = [[corner, corner + 4, corner + 5], [corner, corner + 5, corner + 1]]
    return (
        np.stack([u, v, 0 * u], axis=-1).reshape(-1, 3),
        np.concatenate([np.stack(f, axis=-1) for f in faces]),
    )


def ball(dents):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    scale = 1 + dents * np.random.default_rng(6).uniform(-1, 1, (len(mesh.vertices), 1))
    vertices = mesh.vertices * scale
    return vertices - [0, 0, vertices[:, 2].max()], mesh.faces


BODIES = {
    "triangle": triangle,
    "terrain": terrain,
    "slivers": slivers,
    "ball": lambda: ball(0.0),
    "dented": lambda: ball(0.0025),
}


def smooth_ball(**keywords):
    return dc.RigidBody.sphere(0.6, smooth=True, pose=[0.01, -0.02, -0.6, 1, 0, 0, 0], **keywords)


def smooth_capsule(**keywords):
    """An oblique capsule below the sheet, one end of which is below the sheet's middle."""
    axis = np.array([0.3, 0.7, 0.02]) / np.linalg.norm([0.3, 0.7, 0.02])
    turn = Rotation.align_vectors([axis], [[0, 0, 1]])[0].as_quat()[[3, 0, 1, 2]]
    at = np.array([0.02, 0.03, -0.4]) - 0.15 * axis
    return dc.RigidBody.capsule(0.4, 0.3, smooth=True, pose=[*at, *turn], **keywords)


SMOOTH = {"smooth_ball": smooth_ball, "smooth_capsule": smooth_capsule}


def distance(points, triangles):
    return min(
        np.linalg.norm(
            trimesh.triangles.closest_point(triangles, [p] * len(triangles)) - p, axis=1
        ).min()
        for p in points
    )


def resting(name, *, moving=False, friction_iterations=2, **options):
    """A sheet just above a body that falls and slides onto it."""
    X, cloth_faces = scenes.grid(5, 5, edge=0.06, seed=2)
    X = scenes.turned(X - X.mean(axis=0), [0, 0, 1], 0.4)
    points = X + np.array([0, 0, GAP])
    motion = "kinematic" if moving else "static"
    if name in SMOOTH:
        solid = SMOOTH[name](motion=motion, friction=0.3)
    else:
        vertices, faces = BODIES[name]()
        solid = dc.RigidBody(vertices, np.array(faces), motion=motion, friction=0.3)
        while distance(points, vertices[np.asarray(faces)]) < GAP:
            points[:, 2] += 5e-4
    material = scenes.material(cloth_faces, stretch=200.0, drag=1.0)
    cloth = dc.Cloth(points, cloth_faces, rest_positions=X, material=material)
    sim = scenes.simulator([cloth], [solid], friction_iterations=friction_iterations, **options)
    state = sim.initial_state()
    velocity = torch.tensor([0.15, -0.1, -0.3], dtype=F64) + scenes.tensor_noise(
        state.velocities.shape, 0.02
    )
    state = state.replace(velocities=velocity)
    state = scenes.settled(sim, state, 2)
    # In air at rest, drag is too small for difference quotients.
    control = {"wind": scenes.WIND}
    if moving:
        poses = state.body_poses.clone()
        poses[0, :3] += torch.tensor([2e-3, 1e-3, 1e-3], dtype=F64)
        poses[0, 3:] += torch.tensor([0.0, 2e-3, -3e-3, 4e-3], dtype=F64)
        control["body_poses"] = poses
    return scenes.Case(sim, state, control)


def without_slip(case):
    """Inputs with zero gradient: sliding friction does not depend on the slip velocity."""
    slip = gradients(case, make_loss(case))["parameters.slip_velocity"]
    return () if slip.any() else ("parameters.slip_velocity",)


@pytest.mark.quick(
    "triangle-moving", "slivers-still", "smooth_ball-moving", "smooth_capsule-still", "dented-still"
)
@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("name", [*BODIES, *SMOOTH])
def test_every_gradient_is_that_of_the_step(name, moving):
    # Few contacts stick: differences by slip_velocity (5e-7 N s / m) need forces to 1e-16 N.
    case = resting(name, moving=moving, tolerance=1e-12)
    after = case.step()
    assert after.report.converged
    assert after.report.contact_count >= 5
    assert after.body_forces.sum(dim=0)[:2].norm() > 1e-3  # friction acts
    check(case, CONTACT, zero=without_slip(case))


@pytest.mark.quick("triangle")
@pytest.mark.parametrize("name", ["triangle", "dented", "smooth_capsule"])
def test_every_gradient_of_a_split_step_matches_differences(name):
    case = resting(name, moving=True, scheme="split")
    check(case, CONTACT, zero=without_slip(case))


def test_some_contacts_have_negative_weights():
    """Premise: the terrain tests negative weights only if there are some."""
    case = resting("terrain")
    x = np.concatenate([case.step().positions.numpy(), case.sim.scene.bodies[0].vertices])
    cloth, body = case.sim.scene.cloths[0], case.sim.scene.bodies[0]
    count = len(cloth.vertices)
    potential = _kernels.ContactPotential(
        np.concatenate([cloth.faces, body.faces + count]).astype(np.int32),
        [0] * count + [1] * len(body.vertices),
        1,
        True,
        np.concatenate([cloth.rest_positions, body.vertices]),
        [False] * count + [True] * len(body.vertices),
        0.01,
        2e-4,
        [0.0, 0.0],
        [20.0] * 4,
        [0.4] * 4,
    )
    weight = potential.contacts(x)[2]
    assert (weight < 0).any()
    assert (weight > 0).any()
