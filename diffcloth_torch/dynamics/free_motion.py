"""Velocities over a step without contact, found by the core.

The equation of a robot is in `robots`, which gives the root its derivative. Bodies turn by a
series, which has a derivative of its own.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import _core
from diffcloth_torch.dynamics.inertia import Inertia
from diffcloth_torch.dynamics.linear import times
from diffcloth_torch.model.mechanism import JOINT_KINDS, Mechanism
from diffcloth_torch.transforms import is_differentiated, numbers_of

__all__ = ["free_turns", "robot_motion", "solve_motion"]


def robot_motion(mechanism: Mechanism, solved: Tensor, dt: float) -> _core.FreeMotion:
    """The equation of a robot.

    Args:
        mechanism: Links and joints of the robot.
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


def free_turns(inertia: Tensor, momentum: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Turns of free bodies over a step, by Euler's equations to rounding.

    There is no second derivative.

    Args:
        inertia: J in the bodies' axes, [B or 1, K, 3, 3] kg m^2.
        momentum: Angular momentum in the axes at the start, [B, K, 3] kg m^2/s.
        dt: h [s].

    Returns:
        Quaternions of Q in R Q, in the bodies' axes, [B, K, 4]; and which bodies have a finite and
        plausible speed, [B, K].
    """
    shape = momentum.shape[:-1]
    given = torch.cat([inertia.expand(*shape, 3, 3).flatten(-2), momentum], dim=-1)
    with_rates = is_differentiated((given,))
    numbers = numbers_of(given)
    J, l = (np.ascontiguousarray(part) for part in (numbers[..., :9], numbers[..., 9:]))
    turns, rates, found = _core.free_turns(J, l, dt, with_rates)
    turn = torch.from_numpy(turns).reshape(*shape, 4)
    if with_rates:
        # Adds zero, with the derivative from the core.
        turn = turn + times(torch.from_numpy(rates).reshape(*shape, 4, 12), given - given.detach())
    return turn, torch.from_numpy(found).reshape(shape)


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
        inertia: Masses and inertias of links and joints.
        start: Center of mass [B, 3] and orientation [B, 3, 3] of the root link, joints [B, J].
        known: nu if it is prescribed, zero elsewhere; [B, 6 + J].
        given: Right side of the equation, shape [B, 6 + J].

    Returns:
        The unknown velocities [B, n], and which environments have converged [B].
    """
    values = (np.ascontiguousarray(numbers_of(t)) for t in (*inertia, *start, known, given))
    velocities, found = motion.solve(*values)
    return torch.from_numpy(velocities), torch.from_numpy(found)
