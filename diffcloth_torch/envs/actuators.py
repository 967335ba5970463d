"""Actuators: actions move pickers, pins, rigid bodies and hands, or set forces."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import (
    ANY_NUMBER,
    LARGEST_COUNT,
    NON_NEGATIVE,
    POSITIVE,
    check_count,
    check_number,
    index_array,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.rotation import quaternion_exp, quaternion_multiply
from diffcloth_torch.model.attachment import Attachment
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.sim.records.controls import Control
from diffcloth_torch.sim.records.state import State

__all__ = ["Actuator", "Forces", "Hand", "Pickers", "Tools", "Twist", "Velocities", "path_of"]

Tools = dict[str, Tensor]
"""State of an actuator between transitions, [B, ...] each."""

_NOTHING = -1  # index of the vertex held by an open picker


class Actuator(ABC):
    """Converts actions between -1 and 1 to controls.

    Attributes:
        size: A, the length of an action.
        vectors: Indices in an action at which the three components of a vector begin, which is
            expressed in the frame of the task.
    """

    size: int
    vectors: tuple[int, ...] = ()

    @abstractmethod
    def act(
        self, tools: Tools, state: State, actions: Tensor, substeps: int
    ) -> tuple[list[Control], Tools]:
        """Controls of the time steps of a transition, and the tools after the transition.

        Args:
            tools: Tools before the transition.
            state: State before the transition.
            actions: Actions [B, A].
            substeps: Number of time steps of the transition.
        """


class Pickers(Actuator):
    """Grippers without a body, as in SoftGym: points that move and hold a vertex.

    An action has four numbers for each picker: its displacement, in shares of `stride` along each
    axis, and its grasp. A picker whose grasp is above `opens_at` closes on the nearest vertex
    within `reach`, and holds the vertex until its grasp is at or below `opens_at`. A spring pulls
    the vertex; its stiffness grows linearly with the grasp, from zero at `opens_at` to the full
    stiffness at 1, so a closed picker has a gradient with respect to its grasp. With `opens_at=-1`
    a picker with action zero is half closed, and gradients show a policy whether to hold the vertex
    or to release it.

    Attributes:
        count: P, the number of pickers.
        attachments: Springs between each vertex and each picker, for the scene.
        stride: Longest displacement along an axis in a transition [m].
        reach: Largest distance at which a picker closes on a vertex [m].
        floor: Lowest height of a picker [m].
        opens_at: The largest grasp of an open picker.
    """

    def __init__(
        self,
        cloth: Cloth,
        count: int = 2,
        *,
        stiffness: float = 50.0,
        stride: float = 0.025,
        reach: float = 0.03,
        floor: float = 0.004,
        opens_at: float = 0.0,
    ) -> None:
        """Make pickers for a cloth that has a name.

        Args:
            cloth: Cloth that the pickers hold.
            count: Number of pickers.
            stiffness: Stiffness of the spring of a closed picker [N/m].
            stride: Longest displacement along an axis in a transition [m].
            reach: Largest distance at which a picker closes on a vertex [m].
            floor: Lowest height of a picker [m].
            opens_at: The largest grasp of an open picker, at least -1 and below 1.

        Raises:
            InvalidInput: If a value is not accepted.
        """
        self.opens_at = check_number("Pickers: `opens_at`", opens_at, ANY_NUMBER)
        if not -1.0 <= self.opens_at < 1.0:
            raise InvalidInput(f"Pickers: `opens_at` must be in [-1, 1), got {opens_at}")
        self.count = check_count("Pickers: `count`", count, 1)
        self.size = 4 * count
        self.vectors = tuple(range(0, self.size, 4))
        self.stride = check_number("Pickers: `stride`", stride, POSITIVE)
        self.reach = check_number("Pickers: `reach`", reach, NON_NEGATIVE)
        self.floor = check_number("Pickers: `floor`", floor, ANY_NUMBER)
        given: object = cloth
        if not isinstance(given, Cloth):
            raise TypeError(f"Pickers: `cloth` must be a Cloth, got {type(given).__name__}")
        stiffness = check_number("Pickers: `stiffness`", stiffness, POSITIVE)
        self._vertices = len(cloth.vertices)
        self._indices = cpu.arange(self._vertices)
        self._lowest = cpu.tensor([-math.inf, -math.inf, self.floor])
        self._names = [f"picker_{p}" for p in range(self.count)]
        self.attachments = tuple(
            Attachment((str(cloth.name), range(self._vertices)), stiffness=stiffness, name=name)
            for name in self._names
        )

    def start(self, points: Tensor, held: Tensor | None = None) -> Tools:
        """Pickers at points [B, P, 3], open, or closed on vertices [B, P] at these points."""
        if held is None:
            held = cpu.full(points.shape[:2], _NOTHING, dtype=torch.int64)
        return {
            "points": points,
            "held": held,
            "offsets": torch.zeros_like(points),
            "grasp": (held != _NOTHING).to(points.dtype),
        }

    def act(
        self, tools: Tools, state: State, actions: Tensor, substeps: int
    ) -> tuple[list[Control], Tools]:
        """Close or open, then move in equal parts; see `Actuator`."""
        actions = actions.reshape(-1, self.count, 4)
        moves = actions[..., :3]
        grasp = ((actions[..., 3] - self.opens_at) / (1 - self.opens_at)).clamp(min=0)
        before = tools["points"]
        held, offsets = self._close(tools, state.positions, grasp)
        after = before + self.stride * moves
        after = torch.where(after < self._lowest, self._lowest, after)
        chosen = held[..., None] == self._indices  # all False for an open picker
        weights = dict(zip(self._names, (grasp[..., None] * chosen).unbind(dim=1), strict=True))
        controls = []
        for k in range(1, substeps + 1):
            points = before + (k / substeps) * (after - before) + offsets
            targets = points[..., None, :].expand(-1, -1, self._vertices, -1).unbind(dim=1)
            attachments = dict(zip(self._names, targets, strict=True))
            controls.append(Control(attachments=attachments, attachment_weights=weights))
        return controls, {"points": after, "held": held, "offsets": offsets, "grasp": grasp}

    def _close(self, tools: Tools, positions: Tensor, grasp: Tensor) -> tuple[Tensor, Tensor]:
        """Vertex held by each picker, and the offset of the vertex from the picker."""
        closed = grasp > 0
        goes_on = closed & (tools["held"] != _NOTHING)
        away = positions[:, None] - tools["points"][:, :, None]  # [B, P, N, 3]
        distances = away.detach().square().sum(dim=-1)
        nearest = distances.argmin(dim=-1)
        is_near = distances.gather(-1, nearest[..., None])[..., 0] <= self.reach**2
        found = torch.where(closed & is_near, nearest, _NOTHING)
        held = torch.where(goes_on, tools["held"], found)
        here = away.gather(2, nearest[..., None, None].expand(-1, -1, 1, 3))[:, :, 0]
        starts = (~goes_on & (held != _NOTHING))[..., None]
        offsets = torch.where(starts, here, tools["offsets"] * goes_on[..., None])
        return held, offsets


class Velocities(Actuator):
    """Groups of pins; each group translates with a velocity set by the action.

    Attributes:
        speed: Largest velocity along an axis [m/s].
    """

    def __init__(self, pins: Mapping[str, Sequence[int]], *, dt: float, speed: float) -> None:
        """Choose the pins.

        Args:
            pins: "cloth/pin" -> indices of the vertices in `State.positions`.
            dt: Time step [s].
            speed: Largest velocity along an axis [m/s].
        """
        given: object = pins
        if not isinstance(given, Mapping):
            raise TypeError(f"Velocities: `pins` must be by name, got {type(given).__name__}")
        self._pins = {
            name: index_array(f"Velocities: `pins[{name!r}]`", indices, LARGEST_COUNT).tolist()
            for name, indices in pins.items()
        }
        self._dt = check_number("Velocities: `dt`", dt, POSITIVE)
        self.speed = check_number("Velocities: `speed`", speed, NON_NEGATIVE)
        self.size = 3 * len(self._pins)
        self.vectors = tuple(range(0, self.size, 3))

    def act(
        self, tools: Tools, state: State, actions: Tensor, substeps: int
    ) -> tuple[list[Control], Tools]:
        """Move the pins; see `Actuator`."""
        velocities = self.speed * actions.reshape(-1, len(self._pins), 3)
        starts = {name: state.positions[:, indices] for name, indices in self._pins.items()}
        controls = []
        for k in range(1, substeps + 1):
            moved = {
                name: start + (k * self._dt) * velocities[:, None, g]
                for g, (name, start) in enumerate(starts.items())
            }
            controls.append(Control(pins=moved))
        return controls, tools


class Forces(Actuator):
    """Forces on groups of vertices; the vertices of a group share its force evenly.

    Attributes:
        largest: Force along an axis at an action of 1 [N].
        steady: Additional constant forces on the vertices [N], shape [N, 3].
    """

    def __init__(self, groups: Sequence[Sequence[int]], steady: Tensor, *, largest: float) -> None:
        """Choose the vertices, by their indices in `State.positions`."""
        self._groups = [list(group) for group in groups]
        self.steady, self.largest = steady, largest
        self.size = 3 * len(self._groups)
        self.vectors = tuple(range(0, self.size, 3))

    def act(
        self, tools: Tools, state: State, actions: Tensor, substeps: int
    ) -> tuple[list[Control], Tools]:
        """Apply a force that is constant in the transition; see `Actuator`."""
        forces = self.steady.expand_as(state.positions).clone()
        for g, group in enumerate(self._groups):
            share = self.largest / len(group) * actions[:, None, 3 * g : 3 * g + 3]
            forces[:, group] = forces[:, group] + share
        return [Control(forces=forces)] * substeps, tools


class Twist(Actuator):
    """The velocity of a kinematic body: linear, then angular, in world axes.

    Attributes:
        speeds: Velocities at actions of 1 [m/s, rad/s], [6].
    """

    size = 6
    vectors = (0, 3)

    def __init__(self, body: str, row: int, *, dt: float, speed: float, spin: float) -> None:
        """Choose the body, by its name and its row in `State.body_poses`."""
        self._body, self._row, self._dt = body, row, dt
        self.speeds = cpu.tensor([speed] * 3 + [spin] * 3)

    def act(
        self, tools: Tools, state: State, actions: Tensor, substeps: int
    ) -> tuple[list[Control], Tools]:
        """Move the body; see `Actuator`."""
        poses = path_of(state.body_poses[:, self._row], self._dt * self.speeds * actions, substeps)
        return [Control(body_poses={self._body: pose}) for pose in poses], tools


class Hand(Actuator):
    """A gripper on a kinematic base: its velocity as in `Twist`, then the effort of its joints.

    Attributes:
        speeds: Velocities of the base at actions of 1 [m/s, rad/s], [6].
        effort: Effort of each joint at an action of 1 [N or N m]; negative actions open it.
    """

    size = 7
    vectors = (0, 3)

    def __init__(
        self,
        robot: str,
        joints: Sequence[str],
        *,
        dt: float,
        speed: float = 0.3,
        spin: float = 4.0,
        effort: float = 18.0,
    ) -> None:
        """Choose the only robot of a scene, and the joints of its fingers, by "robot/joint"."""
        self._robot, self._joints, self._dt = robot, list(joints), dt
        self.speeds = cpu.tensor([speed] * 3 + [spin] * 3)
        self.effort = effort

    def act(
        self, tools: Tools, state: State, actions: Tensor, substeps: int
    ) -> tuple[list[Control], Tools]:
        """Move the base and pull at the joints; see `Actuator`."""
        twist = self._dt * self.speeds * actions[:, :6]
        efforts = dict.fromkeys(self._joints, self.effort * actions[:, 6])
        return [
            Control(base_poses={self._robot: pose}, joint_efforts=efforts)
            for pose in path_of(state.base_poses[:, 0], twist, substeps)
        ], tools


def path_of(pose: Tensor, twist: Tensor, steps: int) -> list[Tensor]:
    """Poses [B, 7] after each of some steps of the same displacement.

    Args:
        pose: Poses before the first step [B, 7].
        twist: Displacement of a step: translations [m] and rotation vectors [rad], [B, 6].
        steps: Number of steps.
    """
    shift, turn = twist[:, :3], quaternion_exp(twist[:, 3:])
    position, turned, poses = pose[:, :3], pose[:, 3:], []
    for _ in range(steps):
        position, turned = position + shift, quaternion_multiply(turn, turned)
        poses.append(torch.cat([position, turned], dim=-1))
    return poses
