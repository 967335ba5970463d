"""Frames, velocities and forces of links, against Pinocchio, Jacobians in torch and the core."""

import numpy as np
import pytest
import torch
from mechanisms import TREES, Judge, frame_of, inertia_of, make, random_configuration, tensor
from tree_in_torch import Motion, generalized_force, link_momenta, mass_matrix, momentum

from diffcloth_torch import _core
from diffcloth_torch.dynamics.inertia import rigid_totals
from diffcloth_torch.dynamics.totals import about_origin
from diffcloth_torch.model.kinematics import Links, core_tree

pin = pytest.importorskip("pinocchio", reason="Pinocchio is in the extra `test`")

# Numbers of order one, summed over a few links in float64.
CLOSE = {"rtol": 1e-12, "atol": 1e-12}
GRAVITY = tensor([[0.4, -0.3, -9.81]])


@pytest.fixture(params=TREES)
def judge(request):
    kinds, parents = TREES[request.param]
    mimic = {5: (4, -0.7, 0.3)} if request.param == "branched" else None
    rng = np.random.default_rng(list(TREES).index(request.param))
    return Judge(pin, make(kinds, parents, base="floating", rng=rng, mimic=mimic))


def three(mechanism):
    """Frames of the root, joints and velocities nu in three environments."""
    drawn = [random_configuration(mechanism, np.random.default_rng(seed)) for seed in range(3)]
    pose, joints, nu = (torch.cat(parts) for parts in zip(*drawn, strict=True))
    return pose, frame_of(pose), joints, nu


def test_frames_are_those_of_pinocchio(judge):
    pose, root, joints, _ = three(judge.mechanism)
    found = Links(judge.mechanism).frames(root, joints).numpy()
    for e in range(3):
        q = judge.configuration(pose[e].numpy(), joints[e].numpy())
        pin.forwardKinematics(judge.model, judge.data, q)
        for link, (joint, place) in judge.place.items():
            expected = (judge.data.oMi[joint] * place).homogeneous
            np.testing.assert_allclose(found[e, link], expected, **CLOSE)


def test_velocities_and_forces_are_those_of_jacobians(judge):
    mechanism = judge.mechanism
    _, root, joints, nu = three(mechanism)
    inertia = inertia_of(mechanism)
    motion = Motion.at(judge.tree, inertia, root, joints)
    links, at = Links(mechanism), (root, joints, inertia.center)
    found = links.velocities(*at, nu[:, :6], nu[:, 6:])
    torch.testing.assert_close(found, (motion.jacobian @ nu[:, None, :, None])[..., 0], **CLOSE)
    forces = tensor(np.random.default_rng(1).normal(size=(3, mechanism.link_count, 3)))
    expected = generalized_force(motion, torch.nn.functional.pad(forces, (0, 3)))[:, 6:]
    torch.testing.assert_close(links.efforts(*at, forces), expected, **CLOSE)
    alone = links.efforts(root[:1], joints[:1], inertia.center, forces)
    torch.testing.assert_close(alone[0], expected[0], **CLOSE)


def test_totals_are_those_of_the_mass_matrix(judge):
    mechanism = judge.mechanism
    _, root, joints, nu = three(mechanism)
    inertia = inertia_of(mechanism)
    motion = Motion.at(judge.tree, inertia, root, joints)
    links = Links(mechanism)
    velocities = links.velocities(root, joints, inertia.center, nu[:, :6], nu[:, 6:])
    found = rigid_totals(links.frames(root, joints), velocities, *inertia[:3], GRAVITY)
    M = mass_matrix(motion, inertia)
    kinetic = (nu[:, None] @ M @ nu[..., None])[:, 0, 0] / 2
    torch.testing.assert_close(found.kinetic_energy, kinetic, **CLOSE)
    h = about_origin(motion.frames.centers, link_momenta(motion, nu)).sum(1)
    torch.testing.assert_close(found.momentum, h, **CLOSE)
    torch.testing.assert_close(found.momentum[:, :3], momentum(motion, inertia, nu)[:, :3], **CLOSE)
    weights = inertia.mass[..., None] * GRAVITY[:, None]
    expected = -(weights * motion.frames.centers).sum((1, 2))
    torch.testing.assert_close(found.gravity_energy, expected, **CLOSE)


def test_derivatives_are_those_that_the_core_records(judge):
    """Derivatives computed in Python from frames and twists equal the core's, in both modes."""
    mechanism = judge.mechanism
    if not mechanism.joint_count:
        pytest.skip("no joints")
    _, _, joints, nu = three(mechanism)
    links, rates = Links(mechanism), nu[:, 6:]
    core, given = _core.link_frames(core_tree(mechanism)), {"joints": joints.numpy()}
    expected = core.tangents(given, {"joints": rates.numpy()[None]}, 1, 1)
    _, tangents = torch.func.jvp(links.local, (joints,), (rates,))
    for name, tangent in zip(("frames", "twists"), tangents, strict=True):
        np.testing.assert_allclose(tangent.numpy(), expected[name][0], **CLOSE)
    g = torch.Generator().manual_seed(0)
    cotangents = [torch.randn(t.shape, dtype=t.dtype, generator=g) for t in tangents]
    _, pull_back = torch.func.vjp(links.local, joints)
    (gradient,) = pull_back(tuple(cotangents))
    named = dict(zip(("frames", "twists"), (c.numpy()[None] for c in cotangents), strict=True))
    expected = core.gradients(given, named, 1, ["joints"], 1)["joints"].reshape(joints.shape)
    np.testing.assert_allclose(gradient.numpy(), expected, **CLOSE)


def test_derivatives_of_any_order_and_in_every_mode():
    kinds, parents = TREES["branched"]
    rng = np.random.default_rng(2)
    mechanism = make(kinds, parents, base="floating", rng=rng, mimic={5: (4, -0.7, 0.3)})
    links = Links(mechanism)
    _, _, joints, _ = three(mechanism)
    x = joints[:1].clone().requires_grad_()
    assert torch.autograd.gradcheck(
        links.local,
        x,
        check_forward_ad=True,
        check_batched_grad=True,
        check_batched_forward_grad=True,
    )
    options = {"check_fwd_over_rev": True, "check_rev_over_rev": True, "fast_mode": True}
    assert torch.autograd.gradgradcheck(links.local, x, **options)

    def value(q):
        frames, twists = links.local(q[None])
        return (frames**2 * torch.arange(16.0).reshape(4, 4)).sum() + (twists**3).sum()

    func = torch.func
    at = joints[0]
    hessian = torch.autograd.functional.hessian(value, at)
    for outer in (func.jacfwd, func.jacrev):
        for inner in (func.jacfwd, func.jacrev):
            torch.testing.assert_close(outer(inner(value))(at), hessian, rtol=1e-10, atol=1e-10)
    third = func.jacfwd(func.jacrev(func.jacrev(value)))(at)
    torch.testing.assert_close(third, func.jacrev(func.jacfwd(func.jacfwd(value)))(at))
    rows = func.vmap(lambda q: links.local(q[None])[0][0])(joints)
    assert torch.equal(rows, links.local(joints)[0])


def test_the_bits_do_not_depend_on_the_batch():
    kinds, parents = TREES["branched"]
    mechanism = make(kinds, parents, base="floating", rng=np.random.default_rng(2))
    links, inertia = Links(mechanism), inertia_of(mechanism)
    _, root, joints, nu = three(mechanism)
    many = [t.repeat(50, *[1] * (t.ndim - 1)) for t in (root, joints)]
    moving = [nu[:, :6].repeat(50, 1), nu[:, 6:].repeat(50, 1)]
    found = links.velocities(*many, inertia.center, *moving)
    for e in range(3):
        own = links.velocities(
            root[e, None], joints[e, None], inertia.center, nu[e, None, :6], nu[e, None, 6:]
        )
        assert torch.equal(own[0], found[147 + e])


def test_no_environments_have_no_frames():
    mechanism = make(*TREES["chain"], rng=np.random.default_rng(0))
    root, joints = torch.zeros(0, 4, 4, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.float64)
    assert Links(mechanism).frames(root, joints).shape == (0, 4, 4, 4)
