"""The weight of a robot as a spring, for steps that lead to an equilibrium.

The potential energy of the weight, V(x) = -sum_l m_l g . c_l(x), is not quadratic in the
coordinates x of a robot. Near x_n it is V(x_n) - Q . d + 1/2 d^T K d, with d = x - x_n and the
generalized weight Q. A step that ends where it began, d = 0, ends in an equilibrium for any K, and
its derivatives by all inputs are those of the equilibrium if K is the second derivative of V.

Far from an equilibrium the second derivative may be too small: Q then leads across it. With a K
that is at least as large everywhere, each step lowers the energy (majorization and minimization).

References:
    Lange, "MM Optimization Algorithms", SIAM 2016.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks

from diffcloth_torch import cpu
from diffcloth_torch.autograd.torch_private import saved_tensor_hooks_are_allowed
from diffcloth_torch.autograd.transforms import outside_transforms, plain
from diffcloth_torch.dynamics.inertia import Inertia, Motion, generalized_force
from diffcloth_torch.dynamics.jacobians import ROOT, DifferentialKinematics, Frames, root_frame
from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.geometry.products import product
from diffcloth_torch.geometry.rotation import quaternion_matrix, rotation_exp
from diffcloth_torch.model.kinematics import constant

__all__ = ["Configuration", "WeightSpring"]


class Configuration(NamedTuple):
    """Center of mass [B, 3] and orientation [B, 3, 3] of the root link, joints [B, J]."""

    center: Tensor
    rotation: Tensor
    joints: Tensor

    @staticmethod
    def of(pose: Tensor, center: Tensor, joints: Tensor) -> Configuration:
        """Make one from the pose of the root's frame [B, 7] and its center in that [B or 1, 3]."""
        rotation = quaternion_matrix(torch.nn.functional.normalize(pose[..., 3:], dim=-1))
        return Configuration(pose[..., :3] + times(rotation, center), rotation, joints)


class WeightSpring:
    """K of a robot's weight: the second derivative of its energy, or a bound of it."""

    def __init__(self, kinematics: DifferentialKinematics, *, is_bound: bool) -> None:
        """Prepare the constants.

        Args:
            kinematics: The robot.
            is_bound: Whether K is to be at least the second derivative everywhere.
        """
        self._kinematics = kinematics
        self._bound = _WeightBound(kinematics) if is_bound else None

    def stiffness(self, at: Configuration, inertia: Inertia, gravity: Tensor) -> Tensor:
        """K without a graph, for the velocities of the root and the joints.

        Args:
            at: A configuration.
            inertia: Masses of the links.
            gravity: [B or 1, 3] m/s^2.

        Returns:
            [B, 6 + J, 6 + J].
        """
        inertia, at = Inertia(*map(plain, inertia)), Configuration(*map(plain, at))
        gravity = plain(gravity)

        def pull(x: Tensor) -> Tensor:
            motion = self.motion(_moved(self._kinematics, at, x), inertia)
            weights = torch.nn.functional.pad(gravity, (0, 3))[..., None, :]
            return generalized_force(motion, inertia.mass[..., None] * weights)

        with torch.no_grad(), outside_transforms():
            if self._bound is not None:
                frames = self.motion(at, inertia).frames
                return torch.diag_embed(self._bound.stiffness(frames, inertia, gravity))
            still = at.joints.new_zeros(len(at.joints), ROOT + at.joints.shape[-1])
            slopes = _jacobian(pull, still)
            # The moments of a turn are those of its rotation vector but for a skew part.
            return -(slopes + slopes.transpose(-1, -2)) / 2

    def motion(self, at: Configuration, inertia: Inertia) -> Motion:
        """The links in a configuration."""
        local = inertia.center[..., self._kinematics.root, :]
        root = root_frame(at.center, at.rotation, local)
        return Motion.at(self._kinematics, inertia, root, at.joints)


def _moved(
    kinematics: DifferentialKinematics, start: Configuration, shift: Tensor
) -> Configuration:
    """Configuration after a shift of the root's center and a turn about it, and of the joints."""
    joints = start.joints + shift[..., ROOT:]
    if kinematics.mechanism.base == "fixed":
        return start._replace(joints=joints)
    turn = rotation_exp(shift[..., 3:ROOT])
    return Configuration(start.center + shift[..., :3], product(turn, start.rotation), joints)


class _WeightBound:
    """Bounds the second derivative of the energy of a robot's weight, however its joints turn.

    Joints that shift count with their present values.

    A turn moves the center of a link by at most its way from the axis along the links between, r.
    The second derivative by two turns is at most the smaller r of both; by a turn and a shift it
    is at most one, and by two shifts it is zero.
    """

    def __init__(self, kinematics: DifferentialKinematics) -> None:
        """Find the links between each link and each axis."""
        mechanism = kinematics.mechanism
        count = mechanism.link_count
        path = np.eye(count, dtype=bool)  # path[l, k]: link k lies between the root and link l
        for link in mechanism.order[1:]:
            path[link] |= path[mechanism.parent[link]]
        path[:, mechanism.root] = False
        below = path.T[kinematics.moving]  # [A, L], with the moving link itself
        below[np.arange(len(kinematics.moving)), kinematics.moving] = False
        axes = np.concatenate([np.repeat(path[None], 3, axis=0), path & below[:, None, :]])
        self._between = constant(axes)  # [3 + A, L, L]
        self._carried = torch.cat([cpu.ones(3, count), kinematics.reach.T])
        self._turns = torch.cat([cpu.ones(3), kinematics.revolute[:, 0]])
        leaders = kinematics.leaders[0].abs()
        self._sizes = cpu.zeros(3 + leaders.shape[0], 3 + leaders.shape[1])
        self._sizes[:3, :3] = cpu.eye(3)
        self._sizes[3:, 3:] = leaders
        parent = torch.from_numpy(np.array(mechanism.parent)).long()
        self._parent = torch.where(parent < 0, cpu.arange(count), parent)
        self._root = mechanism.root

    def stiffness(self, frames: Frames, inertia: Inertia, gravity: Tensor) -> Tensor:
        """A diagonal that is at least K, for the velocities of the root and the joints.

        Args:
            frames: Links in a configuration.
            inertia: Masses of the links.
            gravity: [B or 1, 3] m/s^2.

        Returns:
            [B, 6 + J].
        """
        origins = frames.poses[..., :3, 3]
        steps = (origins - origins[..., self._parent, :]).norm(dim=-1)  # [B, L]
        arms = (frames.centers - origins).norm(dim=-1)
        way = (self._between * steps[..., None, None, :]).sum(-1) + arms[..., None, :]
        way = torch.cat([way[..., :3, :] + arms[..., None, self._root, None], way[..., 3:, :]], -2)
        weights = inertia.mass * gravity.norm(dim=-1, keepdim=True)
        turns = self._turns[:, None] * self._turns
        mixed = self._turns[:, None] + self._turns - 2 * turns
        smaller = torch.minimum(way[..., :, None, :], way[..., None, :, :])
        both = self._carried[:, None, :] * self._carried
        curved = both * (turns[..., None] * smaller + mixed[..., None])
        bound = (curved * weights[..., None, None, :]).sum(-1)  # [B, 3 + A, 3 + A]
        rows = times(bound, self._sizes.sum(-1))
        return torch.nn.functional.pad(times(self._sizes.T, rows), (3, 0))


def _jacobian(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Derivative of a function without a graph, [B, row, column], at x [B, n].

    The n copies of x each give one row, in one backward.
    """
    n = x.shape[-1]
    with torch.enable_grad(), _without_hooks():
        copies = x.detach().expand(n, *x.shape).clone().requires_grad_()
        rows = function(copies).diagonal(dim1=0, dim2=-1).sum()
        (gradient,) = torch.autograd.grad(rows, copies)
    return gradient.movedim(0, -2)


def _without_hooks() -> AbstractContextManager[None]:
    """Save tensors as they are: they are used at once, and a checkpoint's hooks repeat its steps.

    Reverse-mode transforms of `torch.func` forbid hooks, and so there are none inside them.
    """
    if saved_tensor_hooks_are_allowed():
        return saved_tensors_hooks(_same, _same)
    return nullcontext()


def _same(tensor: Tensor) -> Tensor:
    return tensor
