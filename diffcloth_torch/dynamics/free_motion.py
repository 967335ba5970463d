"""Velocities over a step without contact, found by the core.

The core solves; what the equation is, and how its root depends on everything, stands in `chain` and
`bodies`, which give the root its derivative.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import _core
from diffcloth_torch.dynamics.inertia import Inertia
from diffcloth_torch.dynamics.kinematics import ROOT
from diffcloth_torch.model.mechanism import JOINT_KINDS, Mechanism

__all__ = ["body_motion", "robot_motion", "solve_motion"]


def robot_motion(mechanism: Mechanism, solved: Tensor, dt: float) -> _core.FreeMotion:
    """The equation of a robot.

    Args:
        mechanism: Its links and joints.
        solved: Indices of the unknown velocities among nu.
        dt: h [s].
    """
    return _core.FreeMotion(
        parent=mechanism.parent.tolist(),
        order=list(mechanism.order),
        kind=[JOINT_KINDS.index(kind) for kind in mechanism.kind],
        offset=np.array(mechanism.offset),
        axis=np.array(mechanism.axis),
        dof=mechanism.dof.tolist(),
        multiplier=np.array(mechanism.multiplier),
        constant=np.array(mechanism.constant),
        joint_count=mechanism.joint_count,
        solved=solved.tolist(),
        root_moves=mechanism.base != "fixed",
        dt=dt,
    )


@lru_cache(maxsize=16)
def body_motion(dt: float) -> _core.FreeMotion:
    """The equation of the rotation of one body about its center."""
    return _core.FreeMotion(
        parent=[-1],
        order=[0],
        kind=[0],
        offset=np.eye(4),
        axis=np.zeros(3),
        dof=[-1],
        multiplier=np.ones(1),
        constant=np.zeros(1),
        joint_count=0,
        solved=list(range(3, ROOT)),
        root_moves=True,
        dt=dt,
    )


def solve_motion(
    motion: _core.FreeMotion,
    inertia: Inertia,
    start: tuple[Tensor, Tensor, Tensor],
    known: Tensor,
    given: Tensor,
) -> tuple[Tensor, Tensor]:
    """Solve p(q_mid, nu) - h/2 s(q_mid, nu) = given, without a graph.

    Args:
        motion: The equation.
        inertia: What links and joints weigh.
        start: Center of mass [B, 3] and orientation [B, 3, 3] of the root link, joints [B, J].
        known: nu where it is prescribed, zero elsewhere; [B, 6 + J].
        given: Shape [B, 6 + J].

    Returns:
        The unknown velocities [B, n], and which environments have found theirs [B].
    """
    values = (np.ascontiguousarray(t.detach().numpy()) for t in (*inertia, *start, known, given))
    velocities, found = motion.solve(*values)
    return torch.from_numpy(velocities), torch.from_numpy(found)
