"""A tree of rigid links: what a robot, or a single rigid body, is to dynamics and to the core."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray, IndexArray

__all__ = ["FORCED", "JOINT_KINDS", "Mechanism"]

FORCED = ("torque", "pd")
"""Actuations that leave a joint's motion to forces."""

JOINT_KINDS = ("fixed", "revolute", "prismatic")
"""Joints of links to their parents, in the order of their numbers in the core."""


@dataclass(frozen=True, eq=False)
class Mechanism:
    """Links and joints, in float64. A rigid body is a mechanism of one link.

    The pose of a link l follows from that of its parent p and its joint's value:

        T_l = T_p offset_l motion(axis_l, multiplier_l q[dof_l] + constant_l),

    where motion turns about, or shifts along, the axis. Links are in the order of the file, parents
    not necessarily first. Arrays are not marked read-only: torch takes no views of such.

    Attributes:
        name: Of the robot or body.
        base: "fixed", "kinematic" (the root link moves on prescribed poses), or "floating".
        link_names: Names of the L links.
        parent: Index of each link's parent, -1 for the root; shape [L].
        kind: Joint to the parent: "fixed" (the root's too), "revolute" or "prismatic"; length L.
        offset: Frame of that joint in the parent's frame, shape [L, 4, 4].
        axis: Unit axis in the joint's frame, zero where it is fixed; shape [L, 3].
        dof: Which of the J joints moves it, -1 where it is fixed; shape [L].
        multiplier: Of that joint's value, 1 where it does not mimic; shape [L].
        constant: Added to it [rad or m], shape [L].
        joint_names: Names of the J joints that move and do not mimic, in the order of the file.
        lower: Lower limits [rad or m], -infinity where there are none; shape [J].
        upper: Upper limits, likewise.
        actuation: "position", "velocity", "torque" or "pd" of each joint; length J.
        mass: Of each link [kg], shape [L].
        center: Centers of mass in the links' frames [m], shape [L, 3].
        inertia: About the centers, in the links' axes [kg m^2], shape [L, 3, 3].
    """

    name: str
    base: str
    link_names: tuple[str, ...]
    parent: IndexArray
    kind: tuple[str, ...]
    offset: FloatArray
    axis: FloatArray
    dof: IndexArray
    multiplier: FloatArray
    constant: FloatArray
    joint_names: tuple[str, ...]
    lower: FloatArray
    upper: FloatArray
    actuation: tuple[str, ...]
    mass: FloatArray
    center: FloatArray
    inertia: FloatArray

    @property
    def link_count(self) -> int:
        """Number of links, L."""
        return len(self.link_names)

    @property
    def joint_count(self) -> int:
        """Number of joints that move and do not mimic, J."""
        return len(self.joint_names)

    @property
    def forced(self) -> NDArray[np.bool_]:
        """Which joints forces move; the motion of the others is prescribed. Shape [J]."""
        return np.array([mode in FORCED for mode in self.actuation], dtype=bool)

    @property
    def root(self) -> int:
        """Index of the root link."""
        return int(np.flatnonzero(self.parent < 0)[0])

    @property
    def order(self) -> tuple[int, ...]:
        """Indices of all links, parents before their children."""
        order = [self.root]
        for link in order:
            order += np.flatnonzero(self.parent == link).tolist()
        return tuple(order)

    @property
    def rigid_group(self) -> IndexArray:
        """Of each link, the first link (nearest to the root) that fixed joints join it to; [L]."""
        group = np.arange(self.link_count, dtype=np.int32)
        for link in self.order[1:]:
            if self.kind[link] == "fixed":
                group[link] = group[self.parent[link]]
        return group

    @property
    def adjacent_links(self) -> tuple[tuple[str, str], ...]:
        """Pairs of names of links that are rigidly joined, or joined by a single moving joint."""
        group = self.rigid_group
        # Of each group, that which its first link hangs on.
        above = np.where(self.parent[group] >= 0, group[self.parent[group]], -1)
        return tuple(
            (self.link_names[a], self.link_names[b])
            for a, b in combinations(range(self.link_count), 2)
            if group[a] == group[b] or above[a] == group[b] or above[b] == group[a]
        )

    @property
    def is_dynamic(self) -> bool:
        """Whether anything here moves by forces."""
        return self.base == "floating" or bool(self.forced.any())
