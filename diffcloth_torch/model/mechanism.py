"""A tree of rigid links: a robot or a single rigid body, as the dynamics and the core use it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch import _core
from diffcloth_torch.checks import FloatArray, IndexArray
from diffcloth_torch.saved import saved

__all__ = ["FORCED", "JOINT_KINDS", "Mechanism"]

FORCED = ("torque", "pd")
"""Actuations in which forces determine the motion of a joint."""

JOINT_KINDS = tuple(_core.joint_kinds)
"""Kinds of joints, in the order of their numbers in the core: see csrc/bodies/joint_kind.cpp."""


@saved
@dataclass(frozen=True, eq=False)
class Mechanism:
    """Links and joints, in float64. A rigid body is a mechanism of one link.

    The pose of a link l follows from the pose of its parent p and its joint's value:

        T_l = T_p offset_l motion(axis_l, multiplier_l q[dof_l] + constant_l),

    with a motion that rotates about the axis, translates along the axis, or does both. Links are in
    the order of the file, in which a parent may follow its children. Arrays are not marked
    read-only, because torch accepts no views of read-only arrays.

    Attributes:
        name: Name of the robot or body.
        base: "fixed", "kinematic" (the root link follows prescribed poses), or "floating".
        link_names: Names of the L links.
        parent: Index of each link's parent, -1 for the root; shape [L].
        kind: Kind of each link's joint to its parent, of `JOINT_KINDS`; "fixed" for the root;
            length L.
        offset: Frame of that joint in the parent's frame, shape [L, 4, 4].
        axis: Unit axis in the joint's frame, zero for a fixed joint; shape [L, 3].
        dof: Index among the J joints of the joint that moves each link, -1 for a fixed joint; shape
            [L].
        multiplier: Factor of that joint's value, 1 unless the link's joint mimics; shape [L].
        constant: Offset added to that product [rad or m], shape [L].
        joint_names: Names of the J joints that move and do not mimic, in the order of the file.
        lower: Lower limits of the joints [rad or m], -infinity without one; shape [J].
        upper: Upper limits, likewise.
        actuation: "position", "velocity", "torque" or "pd" of each joint; length J.
        mass: Mass of each link [kg], shape [L].
        center: Centers of mass in the links' frames [m], shape [L, 3].
        inertia: Inertia about the centers, in the links' axes [kg m^2], shape [L, 3, 3].
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
        """True for joints that forces move, shape [J]; the motion of the others is prescribed."""
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
        """For each link, the link nearest to the root that fixed joints connect it to; [L]."""
        group = np.arange(self.link_count, dtype=np.int32)
        for link in self.order[1:]:
            if self.kind[link] == "fixed":
                group[link] = group[self.parent[link]]
        return group

    @property
    def adjacent_links(self) -> tuple[tuple[str, str], ...]:
        """Pairs of names of links connected by fixed joints and at most one moving joint."""
        group = self.rigid_group
        # For each link's group, the group that carries the group's first link; -1 at the root.
        above = np.where(self.parent[group] >= 0, group[self.parent[group]], -1)
        return tuple(
            (self.link_names[a], self.link_names[b])
            for a, b in combinations(range(self.link_count), 2)
            if group[a] == group[b] or above[a] == group[b] or above[b] == group[a]
        )

    @property
    def turning(self) -> NDArray[np.bool_]:
        """True for links that a joint rotates when its value changes, shape [L]."""
        return np.array([_core.joint_kinds[kind][0] != 0.0 for kind in self.kind], dtype=bool)

    @property
    def is_dynamic(self) -> bool:
        """True if forces move the root or any joint."""
        return self.base == "floating" or bool(self.forced.any())
