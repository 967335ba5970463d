"""Kinematics, mass matrix and forces of trees of links, against Pinocchio."""

import numpy as np
import pytest
import torch
from mechanisms import (
    TREES,
    Judge,
    frame_of,
    inertia_of,
    make,
    random_configuration,
    tensor,
)
from reference import slope, wrenches_of_forces
from tree_in_torch import (
    DifferentialKinematics,
    Motion,
    generalized_force,
    mass_matrix,
    momentum,
    root_frame,
)

from diffcloth_torch.geometry.rotation import quaternion_matrix, rotation_exp

pin = pytest.importorskip("pinocchio", reason="Pinocchio is in the extra `test`")

G = np.array([0.3, -0.2, -9.81])
# Numbers of order one, summed over a few links in float64.
CLOSE = {"rtol": 1e-12, "atol": 1e-12}


@pytest.fixture(params=[(t, b) for t in TREES for b in ("fixed", "floating")], ids=str)
def judge(request):
    name, base = request.param
    if (name, base) == ("body", "fixed"):
        pytest.skip("nothing moves")
    kinds, parents = TREES[name]
    mimic = {5: (4, -0.7, 0.3)} if name == "branched" else None
    rng = np.random.default_rng(list(TREES).index(name))
    return Judge(pin, make(kinds, parents, base=base, rng=rng, mimic=mimic))


def state(judge, seed=1):
    """Pose, joints, velocities; Pinocchio's q and velocities; C with our nu = C (theirs)."""
    pose, joints, nu = random_configuration(judge.mechanism, np.random.default_rng(seed))
    if not judge.free:  # Pinocchio's fixed roots are at the origin
        pose = tensor([[0, 0, 0, 1, 0, 0, 0]])
    q = judge.configuration(pose[0].numpy(), joints[0].numpy())
    C = judge.to_ours(quaternion_matrix(pose[:, 3:])[0].numpy())
    ours = nu[0].numpy() if judge.free else nu[0, 6:].numpy()
    return pose, joints, nu, q, judge.from_joints() @ np.linalg.solve(C, ours), C


def motion_at(judge, pose, joints):
    return Motion.at(judge.tree, inertia_of(judge.mechanism), frame_of(pose), joints)


def own_rows(judge, values):
    """Values without the six rows of a root that does not move."""
    return values if judge.free else values[..., 6:]


def test_frames_agree_with_pinocchio(judge):
    pose, joints, _, q, _, _ = state(judge)
    got = motion_at(judge, pose, joints).frames.poses[0].numpy()
    pin.forwardKinematics(judge.model, judge.data, q)
    for l, (joint, place) in judge.place.items():
        expected = (judge.data.oMi[joint] * place).homogeneous
        np.testing.assert_allclose(got[l], expected, **CLOSE)


def test_the_mass_matrix_agrees_with_pinocchio(judge):
    pose, joints, _, q, _, C = state(judge)
    got = mass_matrix(motion_at(judge, pose, joints), inertia_of(judge.mechanism))[0].numpy()
    got = own_rows(judge, own_rows(judge, got).T).T
    M = pin.crba(judge.model, judge.data, q)
    M = np.triu(M) + np.triu(M, 1).T
    S = judge.from_joints()
    np.testing.assert_allclose(C.T @ got @ C, S.T @ M @ S, **CLOSE)


def test_armature_adds_to_the_joints():
    mechanism = make(*TREES["chain"], rng=np.random.default_rng(0))
    judge = Judge(pin, mechanism)
    pose, joints, _, _, _, _ = state(judge)
    motion = motion_at(judge, pose, joints)
    more = inertia_of(mechanism, [0.1, 0.2, 0.3])
    added = mass_matrix(motion, more) - mass_matrix(motion, inertia_of(mechanism))
    torch.testing.assert_close(added[0], torch.diag(tensor([0] * 6 + [0.1, 0.2, 0.3])), **CLOSE)


def bias(judge, pose, joints, nu):
    """dp/dt - dT/dq - gravity at constant nu; the first along the motion, by autograd."""
    inertia = inertia_of(judge.mechanism)
    local = inertia.center[:, judge.mechanism.root]
    rotation = quaternion_matrix(pose[:, 3:])
    center = (rotation @ local[..., None])[..., 0] + pose[:, :3]

    def momentum_at(t):
        turned = rotation_exp(t * nu[:, 3:6]) @ rotation
        root = root_frame(center + t * nu[:, :3], turned, local)
        motion = Motion.at(judge.tree, inertia, root, joints + t * nu[:, 6:])
        return momentum(motion, inertia, nu)

    rate = torch.autograd.functional.jacobian(momentum_at, torch.zeros((), dtype=torch.float64))
    motion = motion_at(judge, pose, joints)
    weights = inertia.mass[..., None] * tensor(np.concatenate([G, np.zeros(3)]))
    return rate - slope(judge.tree, motion, nu) - generalized_force(motion, weights)


def test_the_bias_agrees_with_pinocchio(judge):
    """Velocity products and gravity, from the rate of the momentum and the slope."""
    pose, joints, nu, q, v, C = state(judge)
    judge.model.gravity.linear = G
    expected = judge.from_joints().T @ pin.nonLinearEffects(judge.model, judge.data, q, v)

    got = own_rows(judge, bias(judge, pose, joints, nu)[0].numpy())
    if judge.free:  # at constant velocities of Pinocchio ours change by d(C)/dt v
        rotation = quaternion_matrix(pose[:, 3:])[0].numpy()
        center = judge.mechanism.center[judge.mechanism.root]
        rate = np.zeros(len(got))
        rate[:3] = rotation @ np.cross(v[3:6], v[:3] + np.cross(v[3:6], center))
        M = mass_matrix(motion_at(judge, pose, joints), inertia_of(judge.mechanism))[0].numpy()
        got = got + M @ rate
    np.testing.assert_allclose(C.T @ got, expected, **CLOSE)


def test_forces_at_points(judge):
    pose, joints, _, q, _, C = state(judge)
    rng = np.random.default_rng(3)
    count = judge.mechanism.link_count
    links = np.repeat(np.arange(count), 3)
    points, forces = rng.normal(size=(2, len(links), 3))
    motion = motion_at(judge, pose, joints)
    wrenches = wrenches_of_forces(
        motion.frames, torch.from_numpy(links), tensor(points), tensor(forces)[None]
    )
    got = own_rows(judge, generalized_force(motion, wrenches)[0].numpy())

    pin.computeJointJacobians(judge.model, judge.data, q)
    expected = np.zeros(judge.model.nv)
    for l, y, f in zip(links, points, forces, strict=True):
        joint, place = judge.place[l]
        if joint == 0:
            continue
        J = pin.getJointJacobian(judge.model, judge.data, joint, pin.WORLD)
        x = judge.data.oMi[joint].act(place.act(y))
        expected += J.T @ np.concatenate([f, np.cross(x, f)])
    np.testing.assert_allclose(C.T @ got, judge.from_joints().T @ expected, **CLOSE)


def test_acceleration_without_mimic():
    """M qdd + bias = tau + J^T f, against the articulated-body algorithm."""
    judge = Judge(pin, make(*TREES["sliding"], rng=np.random.default_rng(5)))
    pose, joints, nu, q, v, _ = state(judge)
    judge.model.gravity.linear = G
    tau = np.array([0.7, -1.1, 0.4])
    M = mass_matrix(motion_at(judge, pose, joints), inertia_of(judge.mechanism))[0, 6:, 6:]
    got = torch.linalg.solve(M, tensor(tau) - bias(judge, pose, joints, nu)[0, 6:])
    expected = pin.aba(judge.model, judge.data, q, v, tau)
    np.testing.assert_allclose(got.numpy(), expected, **CLOSE)


def test_second_derivatives():
    kinds, parents = TREES["branched"]
    mechanism = make(kinds, parents, base="floating", rng=np.random.default_rng(2))
    tree, inertia = DifferentialKinematics(mechanism), inertia_of(mechanism)
    pose, joints, nu = random_configuration(mechanism, np.random.default_rng(4))

    def both(joints, nu, mass, center):
        own = inertia._replace(mass=mass, center=center)
        motion = Motion.at(tree, own, frame_of(pose), joints)
        return momentum(motion, own, nu), slope(tree, motion, nu)

    inputs = [t.clone().requires_grad_() for t in (joints, nu, inertia.mass, inertia.center)]
    assert torch.autograd.gradcheck(both, inputs, rtol=1e-7, atol=1e-8)
    assert torch.autograd.gradgradcheck(both, inputs, rtol=1e-6, atol=1e-7)


def test_the_slope_is_that_of_the_kinetic_energy(judge):
    pose, joints, nu, _, _, _ = state(judge)
    if not judge.mechanism.joint_count:
        pytest.skip("no joints")
    inertia = inertia_of(judge.mechanism)
    joints.requires_grad_()
    motion = Motion.at(judge.tree, inertia, frame_of(pose), joints)
    energy = (momentum(motion, inertia, nu) * nu).sum() / 2
    (expected,) = torch.autograd.grad(energy, joints)
    got = slope(judge.tree, motion, nu)[:, 6:]
    torch.testing.assert_close(got, expected, **CLOSE)
