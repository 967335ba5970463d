"""Rotations and poses: exponential, logarithm, integration, interpolation."""

from __future__ import annotations

import math

import pytest
import torch

from diffcloth_torch.geometry.rotation import (
    integrate_poses,
    interpolate_poses,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
    rotate,
)


@pytest.fixture
def rng():
    return torch.Generator().manual_seed(0)


def random(rng, *shape):
    return torch.randn(*shape, dtype=torch.float64, generator=rng)


def matrix_of(rotation_vector):
    """Rotation by the exponential of a matrix: a reference without quaternions."""
    x, y, z = rotation_vector.tolist()
    return torch.linalg.matrix_exp(
        torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    )


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-4, 0.0999999, 0.1000001, 1.0, 3.1, 5.0])
def test_the_exponential_is_that_of_the_rotation_matrix(rng, angle):
    axis = torch.nn.functional.normalize(random(rng, 3), dim=0)
    point = random(rng, 3)
    got = rotate(quaternion_exp(angle * axis), point)
    torch.testing.assert_close(got, matrix_of(angle * axis) @ point, rtol=0, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.05, 0.0999, 0.1001, 2.0])
def test_the_exponential_has_the_right_gradient(rng, angle):
    w = angle * torch.nn.functional.normalize(random(rng, 3), dim=0)
    assert torch.autograd.gradcheck(quaternion_exp, w.requires_grad_(), rtol=1e-8, atol=1e-9)


def test_the_exponential_is_smooth_where_its_branches_meet():
    axis = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64)
    below, above = quaternion_exp(axis * torch.tensor([[0.1 - 1e-15], [0.1 + 1e-15]]))
    torch.testing.assert_close(below, above, rtol=0, atol=3e-15)


def test_products_compose_rotations(rng):
    a, b, point = random(rng, 3), random(rng, 3), random(rng, 3)
    product = quaternion_multiply(quaternion_exp(a), quaternion_exp(b))
    expected = matrix_of(a) @ matrix_of(b) @ point
    torch.testing.assert_close(rotate(product, point), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-10, 0.3, 3.0])
def test_the_logarithm_undoes_the_exponential(rng, angle):
    w = angle * torch.nn.functional.normalize(random(rng, 3), dim=0)
    q = quaternion_exp(w)
    for same in (q, -q):
        torch.testing.assert_close(quaternion_log(same), w, rtol=0, atol=1e-14)


def test_a_constant_twist_moves_along_a_screw():
    pose = torch.tensor([1.0, 2, 3, 1, 0, 0, 0], dtype=torch.float64)
    twist = torch.tensor([0.1, -0.2, 0.3, 0, 0, math.pi], dtype=torch.float64)
    poses = integrate_poses(pose, twist.expand(50, 6), dt=0.01)
    # After half a second: half the displacement of a second, and a quarter of a turn about z.
    expected = [1.05, 1.9, 3.15, math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)]
    torch.testing.assert_close(poses[-1], torch.tensor(expected, dtype=torch.float64))
    torch.testing.assert_close(poses[:, 3:].norm(dim=1), torch.ones(50, dtype=torch.float64))


def test_integrated_poses_have_the_right_gradient(rng):
    pose = torch.tensor([0.0, 0, 0, 0.6, 0, 0.8, 0], dtype=torch.float64)
    twists = random(rng, 4, 6).requires_grad_()
    assert torch.autograd.gradcheck(lambda t: integrate_poses(pose, t, 0.1), twists)


def test_keyframes_are_met_and_held_outside():
    identity, turned = [0.0, 0, 0, 1, 0, 0, 0], [1.0, 0, 0, math.sqrt(0.5), 0, 0, math.sqrt(0.5)]
    poses = torch.tensor([identity, turned], dtype=torch.float64)
    times = torch.tensor([1.0, 3.0], dtype=torch.float64)
    got = interpolate_poses(times, poses, torch.tensor([0.0, 1, 2, 3, 9], dtype=torch.float64))
    torch.testing.assert_close(got[[0, 1, 3, 4]], poses[[0, 0, 1, 1]])
    halfway = [0.5, 0, 0, math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]
    torch.testing.assert_close(got[2], torch.tensor(halfway, dtype=torch.float64))
