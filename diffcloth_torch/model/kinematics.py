"""Frames and velocities of the links of a mechanism, computed in the core.

The core returns the frames F_l of all links in the root's frame, and the twists S_l of their
joints as matrices. A change dq of the coordinate of joint l moves link l and all links that it
carries, and the twists of their joints, by

    dF = dq S_l F,   dS = dq (S_l S - S S_l).

The derivatives contain only F and S. Derivatives of every order are therefore products of these
matrices, for every kind of joint.
"""

from __future__ import annotations

import math
from inspect import signature
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from diffcloth_torch import _core, cpu
from diffcloth_torch._exit import note_caller
from diffcloth_torch.autograd.core_function import as_array
from diffcloth_torch.autograd.torch_private import with_tangents
from diffcloth_torch.checks import FloatArray
from diffcloth_torch.geometry.products import product
from diffcloth_torch.geometry.rotation import quaternion_matrix
from diffcloth_torch.model.mechanism import JOINT_KINDS, Mechanism

__all__ = ["Links", "constant", "core_tree", "link_frames", "pose_frame"]


def core_tree(mechanism: Mechanism) -> _core.Tree:
    """Links and joints of a mechanism for functions of the core."""
    return _core.tree(
        parent=mechanism.parent.tolist(),
        order=list(mechanism.order),
        kind=[JOINT_KINDS.index(kind) for kind in mechanism.kind],
        offset=np.array(mechanism.offset),
        axis=np.array(mechanism.axis),
        dof=mechanism.dof.tolist(),
        multiplier=np.array(mechanism.multiplier),
        constant=np.array(mechanism.constant),
        joint_count=mechanism.joint_count,
    )


class Links:
    """Forward kinematics of a mechanism: from its root and its joints to its links. Immutable.

    All results are differentiable any number of times.

    Attributes:
        mechanism: The mechanism.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism
        self._place = _core.link_frames(core_tree(mechanism))
        carried = np.eye(mechanism.link_count)
        for link in mechanism.order[1:]:
            carried[link] += carried[mechanism.parent[link]]
        moving = np.flatnonzero(mechanism.dof >= 0)
        rates = np.zeros((mechanism.link_count, mechanism.joint_count))
        rates[moving, mechanism.dof[moving]] = 1.0
        # The first axis counts environments: in one product over all environments, rounding would
        # depend on their number.
        self._carried, self._rates = constant(carried)[None], constant(rates)[None]

    def frames(self, root: Tensor, joints: Tensor) -> Tensor:
        """Frames of all links.

        Args:
            root: Frames of the root link, shape [..., 4, 4].
            joints: Values of the joints [rad or m], shape [..., J]; the leading axes of both
                arguments are broadcast.

        Returns:
            Frames, shape [..., L, 4, 4].
        """
        shape = np.broadcast_shapes(root.shape[:-2], joints.shape[:-1])
        count = math.prod(shape)
        rows = joints.expand(*shape, joints.shape[-1]).reshape(count, joints.shape[-1])
        local, _ = self.local(rows)
        root = root.expand(*shape, 4, 4).reshape(count, 1, 4, 4)
        return product(root, local).reshape(*shape, *local.shape[1:])

    def local(self, joints: Tensor) -> tuple[Tensor, Tensor]:
        """F and S in the root's frame, both [N, L, 4, 4], at joints [N, J]."""
        found: tuple[Tensor, Tensor] = _Local.apply(self, joints)  # type: ignore[no-untyped-call]
        return found

    def velocities(
        self, root: Tensor, joints: Tensor, centers: Tensor, velocity: Tensor, rates: Tensor
    ) -> Tensor:
        """Velocities of the links' centers of mass, then angular ones, in world axes; [N, L, 6].

        Args:
            root: Frames of the root link, shape [N, 4, 4].
            joints: Values of the joints [rad or m], shape [N, J].
            centers: Centers of mass in the links' frames [m], shape [N or 1, L, 3].
            velocity: Velocity of the root's center of mass, then angular velocity, [N or 1, 6].
            rates: Velocities of the joints, [N or 1, J].
        """
        frames, twists = self.local(joints)
        of_links = self.push_forward(twists, rates)
        points = product(frames, _homogeneous(centers))[..., :3, :]
        own = centers[..., self.mechanism.root, None, :, None]
        slid = product(of_links[..., :3, :3], points)[..., 0] + of_links[..., :3, 3]
        parts = torch.stack([(points - own)[..., 0], slid, _axial(of_links)], dim=-1)
        arms, slid, turned = product(root[..., None, :3, :3], parts).unbind(-1)
        linear, angular = velocity[..., None, :3], velocity[..., None, 3:].expand_as(arms)
        moved = linear + torch.linalg.cross(angular, arms) + slid
        return torch.cat([moved, angular + turned], dim=-1)

    def efforts(self, root: Tensor, joints: Tensor, centers: Tensor, forces: Tensor) -> Tensor:
        """Efforts [N, J] of the joints that equal forces at the links' centers of mass in work.

        Args:
            root: Frames of the root link, shape [N, 4, 4].
            joints: Values of the joints [rad or m], shape [N, J].
            centers: Centers of mass in the links' frames [m], shape [N or 1, L, 3].
            forces: Forces at the centers of mass [N], shape [N or 1, L, 3].
        """
        frames, twists = self.local(joints)
        local = product(root[..., None, :3, :3].mT, forces[..., None])
        points = product(frames, _homogeneous(centers))
        work = torch.nn.functional.pad(product(local, points.mT), (0, 0, 0, 1))
        return self.pull_back(twists, work)

    def push_forward(self, twists: Tensor, rates: Tensor) -> Tensor:
        """Twists of the links [N, L, 4, 4], from twists S of the joints and rates [N or 1, J]."""
        own = product(self._rates, rates[..., None])[..., None] * twists
        return product(self._carried, _rows(own)).reshape(own.shape)

    def pull_back(self, twists: Tensor, moments: Tensor) -> Tensor:
        """Transpose of `push_forward`: [N, J] from cotangents [N, L, 4, 4] of the links' twists."""
        carried = product(self._carried.mT, _rows(moments)).reshape(moments.shape)
        along = (carried * twists).sum((-2, -1))
        return product(self._rates.mT, along[..., None])[..., 0]


class _Local(torch.autograd.Function):
    @staticmethod
    def forward(links: Links, joints: Tensor) -> Any:
        count = links.mechanism.link_count
        if not len(joints):
            return cpu.zeros(0, count, 4, 4), cpu.zeros(0, count, 4, 4)
        note_caller()
        found = links._place.values({"joints": as_array(joints)}, 1)
        return torch.from_numpy(found["frames"]), torch.from_numpy(found["twists"])

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.links, joints = inputs
        # Derivatives recompute the outputs from the joints; saved outputs would be constants.
        ctx.save_for_backward(joints)
        ctx.save_for_forward(joints)

    @staticmethod
    def vmap(info: Any, in_dims: Any, links: Links, joints: Tensor) -> Any:
        rows = joints.movedim(in_dims[1], 0)
        found = links.local(rows.flatten(0, 1))
        return tuple(t.reshape(*rows.shape[:2], *t.shape[1:]) for t in found), (0, 0)

    @staticmethod
    def jvp(ctx: Any, _: Any, change: Tensor) -> Any:
        # torch disables tangents inside `jvp`; a tangent of a tangent needs them.
        with with_tangents():
            unpack: Any = forward_ad.unpack_dual
            F, S = ctx.links.local(unpack(*ctx.saved_tensors).primal)
            moved = ctx.links.push_forward(S, change)
            return product(moved, F), product(moved, S) - product(S, moved)

    @staticmethod
    def backward(ctx: Any, F_bar: Tensor, S_bar: Tensor) -> Any:
        F, S = ctx.links.local(*ctx.saved_tensors)
        moments = product(F_bar, F.mT) + product(S_bar, S.mT) - product(S.mT, S_bar)
        return None, ctx.links.pull_back(S, moments)


# torch reads the signature in every call; inspect would compute it anew each time.
_Local.forward.__signature__ = signature(_Local.forward)  # type: ignore[attr-defined]


def link_frames(mechanism: Mechanism, root_frame: Tensor, joint_positions: Tensor) -> Tensor:
    """Frames of all links, [..., L, 4, 4]: see `Links.frames`."""
    return Links(mechanism).frames(root_frame, joint_positions)


def pose_frame(pose: Tensor) -> Tensor:
    """Frames [..., 4, 4] of poses [..., 7], whose quaternions are normalized."""
    quaternion = pose[..., 3:] / torch.linalg.vector_norm(pose[..., 3:], dim=-1, keepdim=True)
    top = torch.cat([quaternion_matrix(quaternion), pose[..., :3, None]], dim=-1)
    return torch.cat([top, _LAST_ROW.expand(*top.shape[:-2], 1, 4)], dim=-2)


def constant(array: FloatArray) -> Tensor:
    """Copy an array of any real numbers into a float64 tensor."""
    return torch.from_numpy(np.array(array, dtype=np.float64))


def _rows(matrices: Tensor) -> Tensor:
    """Rows [..., 16] of matrices [..., 4, 4]; vmap of older torch does not support `flatten`."""
    return matrices.reshape(*matrices.shape[:-2], 16)


def _homogeneous(points: Tensor) -> Tensor:
    """Columns [..., 4, 1] of points [..., 3]."""
    return torch.nn.functional.pad(points, (0, 1), value=1.0)[..., None]


def _axial(matrices: Tensor) -> Tensor:
    """Angular velocities [..., 3] of twists [..., 4, 4]."""
    return torch.stack([matrices[..., 2, 1], matrices[..., 0, 2], matrices[..., 1, 0]], dim=-1)


_LAST_ROW = cpu.tensor([[0.0, 0.0, 0.0, 1.0]])
