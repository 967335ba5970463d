"""The stiffness of weight: a second derivative, and its bound in other configurations."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from mechanisms import F64, inertia_of, make, random_configuration
from tree_in_torch import DifferentialKinematics, root_frame

from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.dynamics.robots import Gains, RobotControl, RobotDynamics, RobotState
from diffcloth_torch.geometry.products import product
from diffcloth_torch.geometry.rotation import quaternion_matrix, rotation_exp

TREES = {
    "chain": (["fixed", *["revolute"] * 4], [-1, 0, 1, 2, 3], None),
    "branches": (["fixed", *["revolute"] * 4], [-1, 0, 1, 1, 0], None),
    "mimic": (["fixed", *["revolute"] * 3], [-1, 0, 1, 2], {3: (1, -1.5, 0.2)}),
    "slide": (["fixed", "revolute", "prismatic"], [-1, 0, 1], None),
}
GRAVITY = torch.tensor([[1.0, -2.0, -9.0]], dtype=F64)


# A step [s] so long that the metric M / h^2 + K of a step at rest is K, to rounding.
LONG = 1e8


class Configuration(NamedTuple):
    """Pose of the root [1, 7] and values of the joints [1, J]."""

    pose: torch.Tensor
    joints: torch.Tensor


def stiffness(mechanism, weight, at):
    none, joints = torch.zeros(1, 6, dtype=F64), torch.zeros_like(at.joints)
    points = torch.zeros(0, 3, dtype=F64)
    robot = RobotDynamics(mechanism, LONG, torch.zeros(0, dtype=torch.int64), points, weight)
    prediction = robot.predict(
        RobotState(at.pose, none, at.joints, joints),
        RobotControl(at.pose, none, joints, joints, joints),
        inertia_of(mechanism),
        Gains(joints, joints, joints),
        GRAVITY,
    )
    return prediction.metric[0].numpy()


def energy(mechanism, at, x):
    """Potential energy of the weight after a motion x of the root and the joints."""
    inertia = inertia_of(mechanism)
    local = inertia.center[:, mechanism.root]
    rotation = quaternion_matrix(at.pose[:, 3:])
    center = at.pose[:, :3] + times(rotation, local) + x[:, :3]
    root = root_frame(center, product(rotation_exp(x[:, 3:6]), rotation), local)
    tree = DifferentialKinematics(mechanism)
    centers = tree.frames(root, at.joints + x[:, 6:], inertia.center).centers
    return -(inertia.mass[..., None] * centers * GRAVITY[:, None]).sum()


def configuration(mechanism, rng):
    pose, joints, _ = random_configuration(mechanism, rng)
    return Configuration(pose, joints)


@pytest.mark.parametrize("name", TREES)
def test_the_stiffness_is_the_second_derivative_of_the_energy(name):
    kinds, parents, mimic = TREES[name]
    rng = np.random.default_rng(4)
    mechanism = make(kinds, parents, base="floating", rng=rng, mimic=mimic)
    at = configuration(mechanism, rng)
    found = stiffness(mechanism, "exact", at)
    n = len(found)

    def value(x):
        return energy(mechanism, at, torch.as_tensor(x, dtype=F64)[None]).item()

    h = 1e-4
    unit = h * np.eye(n)
    expected = [
        [(value(a + b) - value(a - b) - value(b - a) + value(-a - b)) / (4 * h * h) for b in unit]
        for a in unit
    ]
    np.testing.assert_allclose(found, expected, atol=2e-6 * np.abs(found).max())


@pytest.mark.parametrize("name", TREES)
def test_the_bound_is_above_the_stiffness_in_all_configurations(name):
    """Sliding joints are an exception: the bound uses their present values."""
    kinds, parents, mimic = TREES[name]
    rng = np.random.default_rng(5)
    mechanism = make(kinds, parents, base="floating", rng=rng, mimic=mimic)
    first = configuration(mechanism, rng)
    bound = stiffness(mechanism, "bounded", first)
    slides = torch.tensor([kind == "prismatic" for kind in kinds if kind != "fixed"])
    largest = 0.0
    for _ in range(200):
        other = configuration(mechanism, rng)
        if name == "slide":
            other = other._replace(joints=torch.where(slides, first.joints, other.joints))
        exact = stiffness(mechanism, "exact", other)
        assert np.linalg.eigvalsh(bound - exact).min() > -1e-9 * bound.max()
        largest = max(largest, np.linalg.eigvalsh(exact).max())
    assert largest > 0.05 * bound.max()  # the bound is not far too large


def test_the_bound_knows_how_far_links_are_from_the_center_of_the_root():
    """A root rotates about its center of mass, here far from its origin and the other link."""
    rng = np.random.default_rng(6)
    mechanism = make(["fixed", "revolute"], [-1, 0], base="floating", rng=rng)
    center = np.array([[5.0, 0.0, 0.0], [0.05, 0.0, 0.0]])
    mechanism = replace(mechanism, center=center, mass=np.array([0.01, 2.0]))
    bound = stiffness(mechanism, "bounded", configuration(mechanism, rng))
    for _ in range(50):
        exact = stiffness(mechanism, "exact", configuration(mechanism, rng))
        assert np.linalg.eigvalsh(bound - exact).min() > -1e-9 * bound.max()
