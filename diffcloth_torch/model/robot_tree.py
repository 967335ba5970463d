"""From the description of a robot in a file to its mechanism, checked for its actuation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from diffcloth_torch.checks import FloatArray, IndexArray
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.mass_properties import check_inertia, check_part_of_inertia
from diffcloth_torch.model.mechanism import FORCED, Mechanism
from diffcloth_torch.model.refusals import Refusals
from diffcloth_torch.model.urdf import Joint, RobotDescription

__all__ = ["JointBounds", "joint_bounds", "make_mechanism", "moves_by_forces"]


def make_mechanism(
    file: Path | str,
    description: RobotDescription,
    base: str,
    actuation: Sequence[str | None],
    refusals: Refusals,
) -> Mechanism:
    """Make the mechanism of a robot.

    Args:
        file: File of the robot, or the function that made the description; starts messages.
        description: Contents of the file.
        base: "fixed", "kinematic" or "floating".
        actuation: Actuation of the joints that move and do not mimic, in their order. None means
            "pd" if the limits allow the joint a range, and "position" otherwise.
        refusals: Collects a reason if limits allow a joint no position, or if a part that forces
            move has no mass or an impossible inertia.
    """
    links, joints = description.links, description.joints
    carrier = {joint.child: joint for joint in joints}
    index = {link.name: i for i, link in enumerate(links)}
    leaders = [joint for joint in joints if joint.moves]
    dof = {joint.name: j for j, joint in enumerate(leaders)}
    by_name = {joint.name: joint for joint in joints}
    above = [carrier.get(link.name) for link in links]  # None for the root
    parent, followed = [], []
    for joint in above:
        parent.append(-1 if joint is None else index[joint.parent])
        moves = joint is not None and joint.type != "fixed"
        followed.append(_follow(joint, by_name, dof) if joint and moves else (-1, 1.0, 0.0))
    lower, upper = _limits(file, joints, by_name, dof, refusals)
    modes = _modes(file, list(dof), lower, upper, actuation, refusals)
    mechanism = Mechanism(
        name=description.name,
        base=base,
        link_names=tuple(link.name for link in links),
        parent=_indices(parent),
        kind=tuple("fixed" if joint is None else _kind(joint.type) for joint in above),
        offset=_stack([np.eye(4) if joint is None else joint.frame for joint in above]),
        axis=_stack([np.zeros(3) if joint is None else joint.axis for joint in above]),
        dof=_indices([j for j, _, _ in followed]),
        multiplier=_stack([m for _, m, _ in followed]),
        constant=_stack([c for _, _, c in followed]),
        joint_names=tuple(joint.name for joint in leaders),
        lower=lower,
        upper=upper,
        actuation=modes,
        mass=_stack([link.mass for link in links]),
        center=_stack([link.center for link in links]),
        inertia=_stack([(link.inertia + link.inertia.T) / 2 for link in links]),
    )
    _check_masses(file, mechanism, refusals)
    return mechanism


def _kind(joint_type: str) -> str:
    return "revolute" if joint_type == "continuous" else joint_type


def _stack(values: Sequence[object]) -> FloatArray:
    return np.array(values, dtype=np.float64)


def _indices(values: Sequence[int]) -> IndexArray:
    return np.array(values, dtype=np.int32)


def _follow(
    joint: Joint, by_name: Mapping[str, Joint], dof: Mapping[str, int]
) -> tuple[int, float, float]:
    """The joint j at the end of a chain of mimics, and m, c such that the value is m q_j + c."""
    multiplier, constant = 1.0, 0.0
    while joint.mimic is not None:
        name, factor, shift = joint.mimic
        constant += multiplier * shift
        multiplier *= factor
        joint = by_name[name]
    return dof[joint.name], multiplier, constant


def _limits(
    file: Path | str,
    joints: Sequence[Joint],
    by_name: Mapping[str, Joint],
    dof: Mapping[str, int],
    refusals: Refusals,
) -> tuple[FloatArray, FloatArray]:
    """Limits of the joints, narrowed by the limits of the joints that mimic them."""
    lower, upper = np.full(len(dof), -np.inf), np.full(len(dof), np.inf)
    for joint in joints:
        if joint.type == "fixed":
            continue
        j, multiplier, constant = _follow(joint, by_name, dof)
        limits = np.array([joint.lower, joint.upper])
        if multiplier == 0.0:
            with refusals.collected():
                if not limits[0] <= constant <= limits[1]:
                    raise InvalidInput(
                        f"{file}: <joint name={joint.name!r}> <mimic>: `offset` must be between "
                        f"its limits {limits[0]:g} and {limits[1]:g}, got {constant:g}"
                    )
            continue
        ends = np.sort((limits - constant) / multiplier)
        lower[j], upper[j] = max(lower[j], ends[0]), min(upper[j], ends[1])
    for name, j in dof.items():
        with refusals.collected():
            if lower[j] > upper[j]:
                raise InvalidInput(
                    f"{file}: <joint name={name!r}>: its limits and those of the joints that mimic "
                    f"it must leave it a position, got none from {lower[j]:g} to {upper[j]:g}"
                )
    return lower, upper


def _modes(
    file: Path | str,
    names: Sequence[str],
    lower: FloatArray,
    upper: FloatArray,
    actuation: Sequence[str | None],
    refusals: Refusals,
) -> tuple[str, ...]:
    """Actuation of the joints, with defaults where the caller sets none."""
    modes = []
    for j, (name, mode) in enumerate(zip(names, actuation, strict=True)):
        has_one_position = lower[j] == upper[j]
        with refusals.collected():
            if has_one_position and mode in FORCED:
                raise InvalidInput(
                    f"{file}: <joint name={name!r}>: limits of a joint under {mode!r} must leave "
                    f"it a range, got {lower[j]:g} for both; make its type 'fixed', or prescribe "
                    "its position"
                )
        modes.append(mode or ("position" if has_one_position else "pd"))
    return tuple(modes)


class JointBounds(NamedTuple):
    """Limits and friction of the J joints of a robot, including the joints that mimic them.

    Attributes:
        efforts: Largest efforts of drives [N m or N], infinity without a limit; shape [J].
        velocities: Largest speeds [rad/s or m/s], likewise.
        friction: Coulomb friction [N m or N], shape [J].
    """

    efforts: FloatArray
    velocities: FloatArray
    friction: FloatArray


def joint_bounds(joints: Sequence[Joint]) -> JointBounds:
    """Bounds of the joints that move and do not mimic.

    A mimicking joint moves m times as fast as the joint that it follows. By virtual work, its
    efforts and friction count |m| times at the followed joint, and its limit of speed counts 1/|m|
    times. If a mimicking joint has a finite effort limit, its drive adds to the followed joint's;
    without a limit it has no drive of its own.
    """
    by_name = {joint.name: joint for joint in joints}
    leaders = [joint for joint in joints if joint.moves]
    dof = {joint.name: j for j, joint in enumerate(leaders)}
    efforts = _stack([joint.effort for joint in leaders])
    velocities = _stack([joint.velocity for joint in leaders])
    friction = _stack([joint.friction for joint in leaders])
    for joint in joints:
        if joint.mimic is None:
            continue
        j, multiplier, _ = _follow(joint, by_name, dof)
        size = abs(multiplier)
        if size == 0.0:
            continue
        if np.isfinite(joint.effort):
            efforts[j] += size * joint.effort
        velocities[j] = min(velocities[j], joint.velocity / size)
        friction[j] += size * joint.friction
    return JointBounds(efforts, velocities, friction)


def _check_masses(file: Path | str, mechanism: Mechanism, refusals: Refusals) -> None:
    """Require a mass and an inertia of every body that forces move.

    Links connected by fixed joints are one body, so single links may have no mass or no extent.
    """
    group = mechanism.rigid_group
    for first in mechanism.order:
        if group[first] != first or not moves_by_forces(mechanism, first):
            continue
        where = f"{file}: <link name={mechanism.link_names[first]!r}> <inertial>"
        members = np.flatnonzero(group == first).tolist()
        joined = " with that of the links that fixed joints join to it" if len(members) > 1 else ""
        for link in members if joined else ():
            with refusals.collected():
                check_part_of_inertia(
                    f"{file}: <link name={mechanism.link_names[link]!r}> <inertial>: `inertia`",
                    mechanism.inertia[link],
                )
        with refusals.collected():
            if mechanism.mass[members].sum() == 0.0:
                raise InvalidInput(
                    f"{where}: `mass` must be > 0 for a link that moves by forces, or for one that "
                    "a fixed joint joins to it, got 0"
                )
            check_inertia(f"{where}: `inertia`{joined}", _common_inertia(mechanism, first, members))


def _common_inertia(mechanism: Mechanism, first: int, members: Sequence[int]) -> FloatArray:
    """Inertia [3, 3] about their common center of links that fixed joints connect to the first."""
    frames = {first: np.eye(4)}
    for link in mechanism.order:
        if link in members and link not in frames:
            frames[link] = frames[int(mechanism.parent[link])] @ mechanism.offset[link]
    mass = mechanism.mass[members]
    rotations = np.array([frames[link][:3, :3] for link in members])
    offsets = np.array([frames[link][:3, 3] for link in members])
    centers = np.einsum("lij,lj->li", rotations, mechanism.center[members]) + offsets
    arms = centers - mass @ centers / mass.sum()
    inertia = rotations @ mechanism.inertia[members] @ rotations.transpose(0, 2, 1)
    spread = np.einsum("l,li,lj->ij", mass, arms, arms)
    about: FloatArray = inertia.sum(axis=0) + np.trace(spread) * np.eye(3) - spread
    return about


def moves_by_forces(mechanism: Mechanism, link: int) -> bool:
    """Return whether a floating base, or a torque or pd joint, is between the world and a link."""
    while mechanism.parent[link] >= 0:
        j = mechanism.dof[link]
        if j >= 0 and mechanism.forced[j]:
            return True
        link = int(mechanism.parent[link])
    return mechanism.base == "floating"
