"""Rows of a scene's tensors that a control may set, and their limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import FloatArray, refuse_gradient
from diffcloth_torch.dynamics.limits import ZONE
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.assembly import Assembly
from diffcloth_torch.model.mechanism import Mechanism
from diffcloth_torch.model.robot_tree import moves_by_forces
from diffcloth_torch.operations import label

__all__ = ["Permissions"]

_MODES: Mapping[str, tuple[str, ...]] = {
    "joint_positions": ("position", "pd"),
    "joint_velocities": ("velocity", "pd"),
    "joint_efforts": ("torque", "pd"),
}
"""Field of a control -> actuations of the joints that it sets."""

_MOTIONS = {"fixed": "static", "kinematic": "kinematic", "floating": "dynamic"}


class Permissions:
    """Rows that must keep the state's values, with reasons, and limits of the others. Immutable.

    Attributes:
        kept: "body_poses" or "base_poses" -> for each row the reason to equal the state's, or "".
        unforced: "body_wrenches" or "base_wrenches" -> for each row the reason to be zero, or "".
        actuation: Actuation of each joint, length J.
        driven: Mask of joints with a pd drive, shape [J].
        at_rates: Mask of joints with prescribed velocities, shape [J].
        at_positions: Mask of joints with prescribed positions, shape [J].
        floating: Mask of robots with a floating base, shape [R].
        settable: Field of a control -> mask of joints that it can set, shape [J].
        moved: "body" or "link" -> mask of those that forces move, [K] or [L].
        massive: "body" or "link" -> mask of dynamic ones with mass, likewise.
        lower: Lower limits [rad or m], shape [J].
        upper: Upper limits, likewise.
        farthest: Ends of the zones beyond the limits of joints under torque or pd, infinite for
            others; first the lower, then the upper ends, shape [2, J].
    """

    def __init__(self, assembly: Assembly) -> None:
        bodies, robots = assembly.bodies, assembly.robots
        body_motions = [f"the body {b.name!r} is {_MOTIONS[b.base]}" for b in bodies]
        base_motions = [f"the base of the robot {r.name!r} is {r.base}" for r in robots]
        self.kept = {
            "body_poses": _unless("kinematic", bodies, body_motions),
            "base_poses": _unless("kinematic", robots, base_motions),
        }
        self.unforced = {
            "body_wrenches": _unless("floating", bodies, body_motions),
            "base_wrenches": _unless("floating", robots, base_motions),
        }
        self.actuation = tuple(mode for robot in robots for mode in robot.actuation)
        self.driven = cpu.tensor([mode == "pd" for mode in self.actuation], dtype=torch.bool)
        self.at_rates = cpu.tensor([m == "velocity" for m in self.actuation], dtype=torch.bool)
        self.at_positions = cpu.tensor([m == "position" for m in self.actuation], dtype=torch.bool)
        self.floating = cpu.tensor([r.base == "floating" for r in robots], dtype=torch.bool)
        self.settable = {
            field: np.array([mode in modes for mode in self.actuation], dtype=bool)
            for field, modes in _MODES.items()
        }
        self.moved = {"body": _moved(bodies), "link": _moved(robots)}
        self.massive = {"body": _massive(bodies), "link": _massive(robots)}
        self.lower = _joined([robot.lower for robot in robots])
        self.upper = _joined([robot.upper for robot in robots])
        reach = np.where(np.isinf(self.upper - self.lower), 0.0, ZONE * (self.upper - self.lower))
        self.farthest = np.where(
            assembly.forced, [self.lower - reach, self.upper + reach], [[-np.inf], [np.inf]]
        )

    def check_settable(self, field: str, joint: int, name: str) -> None:
        """Refuse a joint that a field of a control cannot set."""
        if field in _MODES and self.actuation[joint] not in _MODES[field]:
            raise InvalidInput(
                f"{label('control', field)} sets joints whose actuation is "
                f"{' or '.join(map(repr, _MODES[field]))}; that of {name!r} is "
                f"{self.actuation[joint]!r}"
            )

    def refuse_unused(self, field: str, values: Tensor) -> None:
        """Refuse to differentiate by a field that no joint of the scene uses."""
        if field in _MODES and len(self.actuation) and not self.settable[field].any():
            modes = " or ".join(map(repr, _MODES[field]))
            remedy = f"have a joint of the actuation {modes}, or pass a detached tensor"
            refuse_gradient(label("control", field), values, remedy)


def _joined(arrays: Sequence[FloatArray]) -> FloatArray:
    joined: FloatArray = np.concatenate([np.empty(0), *arrays])
    return joined


def _moved(mechanisms: Sequence[Mechanism]) -> NDArray[np.bool_]:
    moved = [moves_by_forces(m, link) for m in mechanisms for link in range(m.link_count)]
    return np.array(moved, dtype=bool)


def _massive(mechanisms: Sequence[Mechanism]) -> NDArray[np.bool_]:
    parts = [(m.mass > 0.0) & m.is_dynamic for m in mechanisms]
    return np.concatenate([np.empty(0, dtype=bool), *parts])


def _unless(base: str, mechanisms: Sequence[Mechanism], why: Sequence[str]) -> list[str]:
    return ["" if m.base == base else text for m, text in zip(mechanisms, why, strict=True)]
