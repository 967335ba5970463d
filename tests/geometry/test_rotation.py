"""Rotations as matrices: the exponential at zero, near pi, and the work of moments."""

import math

import numpy as np
import pytest
import torch

from diffcloth_torch.geometry.rotation import (
    quaternion_exp,
    quaternion_log,
    quaternion_matrix,
    rotation_exp,
)

F64 = torch.float64


def tensor(values):
    return torch.as_tensor(np.asarray(values), dtype=F64)


AXIS = tensor([2.0, -1.0, 2.0]) / 3
ANGLES = [0.0, 1e-9, 1e-3, 0.0999999, 0.1000001, 1.0, 3.0, math.pi - 1e-6]


@pytest.mark.parametrize("angle", ANGLES)
def test_the_exponential_agrees_with_rodrigues(angle):
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


def test_matrices_of_quaternions_are_rotations():
    rng = np.random.default_rng(0)
    q = torch.nn.functional.normalize(tensor(rng.normal(size=(20, 4))), dim=-1)
    M = quaternion_matrix(q)
    torch.testing.assert_close(M @ M.mT, torch.eye(3, dtype=F64).expand(20, 3, 3))
    torch.testing.assert_close(torch.linalg.det(M), torch.ones(20, dtype=F64))
    torch.testing.assert_close(quaternion_matrix(-q), M, rtol=0, atol=0)
