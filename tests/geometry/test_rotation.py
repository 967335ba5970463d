"""Rotations as matrices: the exponential at zero, near pi, and the work of moments."""

import math

import numpy as np
import pytest
import torch

from diffcloth_torch.geometry.rotation import (
    nearer_quaternion,
    quaternion_exp,
    quaternion_log,
    quaternion_matrix,
    rotation_exp,
    torque_from_moment,
)

F64 = torch.float64


def tensor(values):
    return torch.as_tensor(np.asarray(values), dtype=F64)


AXIS = tensor([2.0, -1.0, 2.0]) / 3
ANGLES = [0.0, 1e-9, 1e-3, 0.0999999, 0.1000001, 1.0, 3.0, math.pi - 1e-6]


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential(angle):
    K = torch.linalg.cross(AXIS.expand(3, 3), torch.eye(3, dtype=F64)).T
    expected = torch.eye(3, dtype=F64) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K
    torch.testing.assert_close(rotation_exp(angle * AXIS), expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 0.05, 0.0999, 2.0])
def test_second_derivatives_of_the_exponential(angle):
    w = (angle * AXIS).requires_grad_()
    assert torch.autograd.gradcheck(rotation_exp, w, rtol=1e-8, atol=1e-9)
    assert torch.autograd.gradgradcheck(rotation_exp, w, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("angle", ANGLES)
def test_logarithm_is_the_inverse(angle):
    w = (angle * AXIS).requires_grad_()
    torch.testing.assert_close(quaternion_log(quaternion_exp(w)), w, rtol=1e-14, atol=1e-15)
    jacobian = torch.autograd.functional.jacobian(lambda w: quaternion_log(quaternion_exp(w)), w)
    torch.testing.assert_close(jacobian, torch.eye(3, dtype=F64), rtol=0, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.0999999, 0.1000001, 1.0, 3.0, 5.0])
def test_torque_does_the_work_of_a_moment(angle):
    """Against the left Jacobian by differentiation: exp(w + dw) = exp(J dw) exp(w)."""
    w, moment = angle * AXIS, tensor([0.3, 1.0, -0.5])
    derivative = torch.autograd.functional.jacobian(rotation_exp, w)  # [3, 3, dw]
    turns = torch.einsum("ijk,lj->ilk", derivative, rotation_exp(w))
    J = torch.stack([turns[2, 1], turns[0, 2], turns[1, 0]])
    torque = torque_from_moment(w, moment)
    torch.testing.assert_close(J.T @ torque, moment, rtol=0, atol=1e-13)
    inputs = (w.clone().requires_grad_(), moment.clone().requires_grad_())
    assert torch.autograd.gradcheck(torque_from_moment, inputs, rtol=1e-7, atol=1e-9)


def test_matrices_of_quaternions_are_rotations():
    rng = np.random.default_rng(0)
    q = torch.nn.functional.normalize(tensor(rng.normal(size=(20, 4))), dim=-1)
    M = quaternion_matrix(q)
    torch.testing.assert_close(M @ M.mT, torch.eye(3, dtype=F64).expand(20, 3, 3))
    torch.testing.assert_close(torch.linalg.det(M), torch.ones(20, dtype=F64))
    torch.testing.assert_close(quaternion_matrix(-q), M, rtol=0, atol=0)


def test_the_nearer_of_two_signs():
    q = torch.nn.functional.normalize(
        tensor([[0.1, 0.2, -0.3, 0.9], [0.5, 0.5, 0.5, -0.5]]), dim=-1
    )
    torch.testing.assert_close(nearer_quaternion(-q, q + 0.01), q, rtol=0, atol=0)
    torch.testing.assert_close(nearer_quaternion(q, q + 0.01), q, rtol=0, atol=0)
