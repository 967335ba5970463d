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

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.dynamics.inertia import Inertia
from diffcloth_torch.dynamics.jacobians import DifferentialKinematics, Frames
from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.model.kinematics import constant

__all__ = ["WeightBound"]


class WeightBound:
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
        self._carried = torch.cat([torch.ones(3, count), kinematics.reach.T]).double()
        self._turns = torch.cat([torch.ones(3), kinematics.revolute[:, 0]]).double()
        leaders = kinematics.leaders[0].abs()
        self._sizes = torch.zeros(3 + leaders.shape[0], 3 + leaders.shape[1], dtype=torch.float64)
        self._sizes[:3, :3] = torch.eye(3)
        self._sizes[3:, 3:] = leaders
        parent = torch.from_numpy(np.array(mechanism.parent)).long()
        self._parent = torch.where(parent < 0, torch.arange(count), parent)
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
