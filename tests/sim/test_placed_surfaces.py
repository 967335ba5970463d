"""Surfaces placed at a state: correct, and equal for meshes, pictures and wrenches."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import diffcloth_torch as dc
from diffcloth_torch.robots import GRIPPER
from diffcloth_torch.sim.records.surfaces import place

F64 = torch.float64


@pytest.fixture(scope="module")
def state():
    cloths = [
        dc.Cloth.grid(3, 4, 0.3, name="a"),
        dc.Cloth.grid(2, 3, 0.2, pose=[0, 0, 1, 1, 0, 0, 0], name="b"),
    ]
    box = dc.RigidBody.box(0.2, motion="kinematic", pose=[0, 2, 0, 1, 0.3, 0.2, 0], name="box")
    pose = [3, 0, 1, 1, 0, 0.4, 0]
    hand = dc.Robot.load(GRIPPER, pose=pose, actuation="position", name="hand")
    sim = dc.Simulator(dc.Scene(cloths, [box], [hand]), dt=0.01)
    state = sim.initial_state()
    lower, upper = (np.array(getattr(hand.mechanism, n)) for n in ("lower", "upper"))
    joints = torch.tensor(0.3 * lower + 0.7 * upper, dtype=F64)
    return sim, state.replace(joint_positions=joints)


def placed(vertices, frame):
    return np.array([frame[:3, :3] @ v + frame[:3, 3] for v in vertices])


def expected(sim, state):
    """Name -> vertices in the world: a quaternion by SciPy, links by their public frames."""
    found, first = {}, 0
    for name, cloth in zip(sim.scene.cloth_names, sim.scene.cloths, strict=True):
        rows = slice(first, first := first + len(cloth.vertices))
        found[name] = state.positions[rows].numpy()
    (body,), pose = sim.scene.bodies, state.body_poses[0].numpy()
    turned = Rotation.from_quat(np.roll(pose[3:], -1)).apply(np.array(body.vertices))
    found["box"] = turned + pose[:3]
    (robot,), poses = sim.scene.robots, sim.link_poses(state)
    for link, mesh in zip(robot.link_names, robot.surfaces, strict=True):
        if mesh is not None:
            found[f"hand/{link}"] = placed(mesh.vertices, poses[f"hand/{link}"].numpy())
    return found


def test_every_surface_is_placed_in_the_order_of_the_simulator(state):
    sim, now = state
    meshes = now._surfaces.meshes(vars(now))
    assert tuple(meshes) == sim.surfaces
    for name, vertices in expected(sim, now).items():
        np.testing.assert_allclose(meshes[name][0].numpy(), vertices, rtol=0, atol=1e-14)


def test_a_batch_has_the_bits_of_its_environments(state):
    _, now = state
    other = now.replace(joint_positions=0.5 * now.joint_positions, positions=now.positions + 1)
    both = dc.stack([now, other])
    meshes = both._surfaces.meshes(vars(both))
    for i, one in enumerate((now, other)):
        for name, (vertices, _) in one._surfaces.meshes(vars(one)).items():
            assert torch.equal(meshes[name][0][i], vertices)


def test_wrenches_act_at_the_placed_vertices(state):
    sim, now = state
    generator = torch.Generator().manual_seed(0)
    forces = torch.rand(now.body_forces.shape, dtype=F64, generator=generator)
    loaded = now.replace(body_forces=forces)
    where, wrenches = expected(sim, now), sim.contact_wrenches(loaded)
    frames = now._surfaces.frames(vars(now))
    for name, rows in list(sim.slices.items())[2:]:
        arms = where[name] - frames[name][:3, 3].numpy()
        torque = np.cross(arms, forces[rows].numpy()).sum(0)
        found = wrenches[name].numpy()
        np.testing.assert_allclose(found, [*forces[rows].sum(0).tolist(), *torque], atol=1e-13)


def test_wrenches_of_forces_on_other_vertices_are_refused(state):
    sim, now = state
    for forces in (now.body_forces[1:], now.body_forces[:, :2], now.body_forces[None]):
        with pytest.raises(dc.InvalidInput, match=r"`state\.body_forces`"):
            sim.contact_wrenches(now.replace(body_forces=forces))


def test_placing_is_differentiable():
    vertices = torch.rand(5, 3, dtype=F64)
    frames = torch.eye(4, dtype=F64).repeat(2, 1, 1) + 0.1 * torch.rand(2, 4, 4, dtype=F64)
    assert torch.autograd.gradcheck(lambda f: place(vertices, f), frames.requires_grad_())
