"""Chains of pytorch-kinematics: made from a mechanism, and converted to a robot's description."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import FloatArray, check_finite, check_shape, float_array, texts
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.mesh_checks import Surface, body_arrays
from diffcloth_torch.model.mechanism import Mechanism
from diffcloth_torch.model.urdf import Joint, Link, RobotDescription

__all__ = ["chain_positions", "describe_chain", "link_surfaces", "make_chain"]

_OWNER = "Robot.from_chain"
_DETACHED = "pass a detached tensor"

# Chains have single precision by default, so rotations are orthogonal only up to this error.
_ROTATION_TOLERANCE = 1e-5

Limits = Mapping[str, Sequence[float]]
Inertials = Mapping[str, Sequence[Any]]
Surfaces = Mapping[str, Sequence[Any]]


# --- Of a mechanism -------------------------------------------------------------------------------


def make_chain(mechanism: Mechanism) -> Any:
    """Make a `pytorch_kinematics.Chain` of the links in their order, in float64."""
    from pytorch_kinematics.chain import Chain
    from pytorch_kinematics.frame import Frame

    frames = [Frame(name) for name in mechanism.link_names]
    for i, (frame, name) in enumerate(zip(frames, _joint_names(mechanism), strict=True)):
        frame.link.name = frame.name
        frame.joint = _joint_of_chain(mechanism, i, name)
    for frame, parent in zip(frames, mechanism.parent.tolist(), strict=True):
        if parent >= 0:
            frames[parent].add_child(frame)
    return Chain(frames[mechanism.root], dtype=torch.float64)


def _joint_of_chain(mechanism: Mechanism, i: int, name: str) -> Any:
    from pytorch_kinematics.frame import Joint as ChainJoint
    from pytorch_kinematics.transforms import Transform3d

    j, limits = int(mechanism.dof[i]), None
    if j >= 0:
        ends = np.array([mechanism.lower[j], mechanism.upper[j]])
        if np.isfinite(ends).any():
            moved = np.sort(mechanism.multiplier[i] * ends + mechanism.constant[i])
            limits = tuple(moved.tolist())
    return ChainJoint(
        name=name,
        offset=Transform3d(matrix=cpu.tensor(mechanism.offset[i])),
        joint_type=mechanism.kind[i],
        axis=cpu.tensor(mechanism.axis[i]) if j >= 0 else None,
        dtype=torch.float64,
        limits=limits,
    )


def _joint_names(mechanism: Mechanism) -> list[str]:
    """Name of the joint that carries each link; unique for moving joints."""
    names: list[str] = []
    own = set(mechanism.joint_names)
    named: set[int] = set()
    for i, link in enumerate(mechanism.link_names):
        j, law = int(mechanism.dof[i]), (mechanism.multiplier[i], mechanism.constant[i])
        if j < 0:
            names.append(f"{link}_fixed")
        elif j in named or law != (1.0, 0.0):
            name = f"{mechanism.joint_names[j]}/{link}"
            while name in own:  # names in files may contain "/"
                name += "/"
            own.add(name)
            names.append(name)
        else:
            names.append(mechanism.joint_names[j])
            named.add(j)
    return names


def chain_positions(mechanism: Mechanism, joint_positions: Tensor) -> dict[str, Tensor]:
    """Positions of all joints of the chain by name, from the positions [.., J] of a robot."""
    laws = zip(mechanism.multiplier.tolist(), mechanism.constant.tolist(), strict=True)
    rows = zip(_joint_names(mechanism), mechanism.dof.tolist(), laws, strict=True)
    return {name: a * joint_positions[..., j] + b for name, j, (a, b) in rows if j >= 0}


# --- For a robot ----------------------------------------------------------------------------------


def describe_chain(chain: Any, inertials: Inertials, limits: Limits) -> RobotDescription:
    """Describe a chain as `read_urdf` describes a file, with the inertias and limits that it lacks.

    Raises:
        InvalidInput: If an argument is not accepted, or the chain does not consist of rigid links.
        TypeError: If `chain` is not a chain.
    """
    from pytorch_kinematics.chain import Chain

    if not isinstance(chain, Chain):
        raise TypeError(
            f"{_OWNER}: `chain` must be a pytorch_kinematics.Chain, got {type(chain).__name__}"
        )
    _check_mapping("inertials", inertials)
    _check_mapping("limits", limits)
    frames = list(_frames(chain._root, None))
    links = [frame.name for frame, _ in frames]
    joints = [_joint(frame, parent, limits) for frame, parent in frames[1:]]
    _check_names("frame", links)
    moving = [joint.name for joint in joints if joint.moves]
    _check_names("joint", moving)
    _check_root(chain._root)
    for field, given, accepted in (
        ("inertials", inertials, links),
        ("limits", limits, moving),
    ):
        for name in given:
            if name not in accepted:
                raise InvalidInput(
                    f"{_OWNER}: `{field}` has the names {texts(accepted)}; got {name!r}"
                )
    return RobotDescription(
        name="robot",
        links=tuple(_link(name, inertials.get(name)) for name in links),
        joints=tuple(joints),
    )


def link_surfaces(links: Sequence[str], given: Surfaces) -> list[Surface | None]:
    """Surface of each link from name -> (vertices, faces); None for links without one."""
    _check_mapping("surfaces", given)
    for name in given:
        if name not in links:
            raise InvalidInput(f"{_OWNER}: `surfaces` has the names {texts(links)}; got {name!r}")
    surfaces: list[Surface | None] = []
    for name in links:
        owner = f"{_OWNER}: `surfaces[{name!r}]`"
        if name not in given:
            surfaces.append(None)
            continue
        _check_length(owner, given[name], "(vertices, faces)", 2)
        surface = body_arrays(owner, *given[name], instead=_DETACHED)
        surfaces.append(Surface(surface.vertices, surface.faces))
    return surfaces


def _check_mapping(field: str, given: object) -> None:
    if not isinstance(given, Mapping):
        raise TypeError(f"{_OWNER}: `{field}` must be by name, got {type(given).__name__}")


def _frames(frame: Any, parent: Any) -> Iterator[tuple[Any, Any]]:
    yield frame, parent
    for child in frame.children:
        yield from _frames(child, frame)


def _joint(frame: Any, parent: Any, limits: Limits) -> Joint:
    joint = frame.joint
    label = f"{_OWNER}: the joint {joint.name!r}"
    moves = joint.joint_type != "fixed"
    lower, upper = _limits(label, joint, limits) if moves else (-math.inf, math.inf)
    axis = np.zeros(3)
    if moves:
        given = float_array(f"{label}: `axis`", joint.axis, instead=_DETACHED)
        axis = given / np.linalg.norm(given)
    return Joint(
        name=joint.name,
        type=joint.joint_type,
        parent=parent.name,
        child=frame.name,
        frame=_offset(frame),
        axis=axis,
        lower=lower,
        upper=upper,
        viscosity=0.0,
        effort=_largest(label, "effort_limits", joint),
        velocity=_largest(label, "velocity_limits", joint),
        friction=0.0,
        mimic=None,
    )


def _largest(label: str, field: str, joint: Any) -> float:
    """The largest effort or speed of a chain's joint, which stores (-limit, limit) or None."""
    given = getattr(joint, field)
    if given is None:
        return math.inf
    _check_length(f"{label}: `{field}`", given, "(-limit, limit)", 2)
    lower, upper = (float(end) for end in given)
    if not -lower == upper >= 0.0:
        raise InvalidInput(
            f"{label}: `{field}` must be (-limit, limit) with a limit >= 0, got ({lower:g}, "
            f"{upper:g}); change it in the chain"
        )
    return upper or math.inf  # 0 means no limit, as in URDF files


def _limits(label: str, joint: Any, limits: Limits) -> tuple[float, float]:
    given: Any = limits.get(joint.name, joint.limits)
    if given is None:
        return -math.inf, math.inf
    _check_length(f"{label}: `limits`", given, "(lower, upper)", 2)
    lower, upper = (float(end) for end in given)
    if not lower < upper:
        raise InvalidInput(
            f"{label}: limits must leave it a range, got {lower:g} and {upper:g}; a chain has 0 "
            f"for both where a file has none: give `limits={{{joint.name!r}: (lower, upper)}}`"
        )
    return lower, upper


def _offset(frame: Any) -> FloatArray:
    """Frame [4, 4] of a joint in its parent's, as the chain composes it, made orthonormal."""
    label = f"{_OWNER}: the offset of the frame {frame.name!r}"
    offset = np.eye(4)
    for part in (frame.link.offset, frame.joint.offset):
        if part is not None:
            matrix = float_array(label, part.get_matrix(), instead=_DETACHED)
            check_shape(label, matrix.shape, [(1, 4, 4)])
            offset = offset @ matrix[0]
    check_finite(label, offset)
    u, _, v = np.linalg.svd(offset[:3, :3])
    rotation = u @ v  # the nearest one
    if np.abs(rotation - offset[:3, :3]).max() > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise InvalidInput(f"{label} must be a rotation and a displacement")
    offset[:3, :3] = rotation
    return offset


def _link(name: str, given: Any) -> Link:
    if given is None:
        return Link(name, 0.0, np.zeros(3), np.zeros((3, 3)), ())
    label = f"{_OWNER}: `inertials[{name!r}]`"
    _check_length(label, given, "(mass, center, inertia)", 3)
    mass, center, inertia = (float_array(label, part, instead=_DETACHED) for part in given)
    for part, shape in ((mass, ()), (center, (3,)), (inertia, (3, 3))):
        check_shape(label, part.shape, [shape])
        check_finite(label, part)
    if mass < 0:
        raise InvalidInput(f"{label} must have a mass >= 0, got {float(mass):g}")
    return Link(name, float(mass), center, inertia, ())


def _check_length(label: str, given: Any, content: str, count: int) -> None:
    if not isinstance(given, Sequence) or len(given) != count:
        raise InvalidInput(f"{label} must be {content}")


def _check_names(kind: str, names: Sequence[Any]) -> None:
    for name in names:
        if not isinstance(name, str) or not name:
            raise InvalidInput(f"{_OWNER}: a {kind} must have a name, got {name!r}")
        if names.count(name) > 1:
            raise InvalidInput(
                f"{_OWNER}: each {kind} must have a name of its own, got {name!r} twice"
            )


def _check_root(root: Any) -> None:
    if root.joint.joint_type != "fixed":
        raise InvalidInput(
            f"{_OWNER}: the joint of the root {root.name!r} must be fixed, "
            f"got {root.joint.joint_type!r}"
        )
    if not np.array_equal(_offset(root), np.eye(4)):
        raise InvalidInput(
            f"{_OWNER}: the root {root.name!r} must have no offset: place the robot by `pose`"
        )
