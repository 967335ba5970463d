"""URDF files: read safely and checked entirely before pytorch-kinematics parses them.

pytorch-kinematics responds to bad files with NaN poses, endless recursion or nothing at all, and
its chains drop inertias and mimicking joints. So a file is first reduced to the elements and
attributes of `urdf_document`, all checked; its parser then reads only these; and what it returns is
checked to be a tree of links.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError, tostring

import defusedxml.ElementTree
import numpy as np

from diffcloth_torch.checks import (
    FloatArray,
    texts,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import read_regular_file
from diffcloth_torch.model.urdf_document import reduced

__all__ = ["Joint", "Link", "RobotDescription", "Shape", "read_urdf"]

# Robots with a thousand links have files of a few MB.
_LARGEST_FILE = 16 * 2**20  # bytes

# An axis shorter than this is taken for zero.
_SHORTEST_AXIS = 1e-9


@dataclass(frozen=True, eq=False)
class Shape:
    """A collision shape of a link.

    Attributes:
        kind: "box", "cylinder", "sphere", "capsule" or "mesh".
        frame: Its frame in the link's frame, shape [4, 4].
        size: Lengths of a box; radius and length of a cylinder, also of that in a capsule; radius
            of a sphere [m]; scale of a mesh along its axes.
        filename: File name of a mesh, as written in the file; empty for other shapes.
    """

    kind: str
    frame: FloatArray
    size: tuple[float, ...]
    filename: str


@dataclass(frozen=True, eq=False)
class Link:
    """A link.

    Attributes:
        name: Its name.
        mass: Its mass [kg].
        center: Center of mass in the link's frame [m], shape [3].
        inertia: Inertia about the center, in the link's axes [kg m^2], shape [3, 3].
        shapes: Its collision shapes.
    """

    name: str
    mass: float
    center: FloatArray
    inertia: FloatArray
    shapes: tuple[Shape, ...]


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint between two links.

    Attributes:
        name: Its name.
        type: "fixed", "revolute", "continuous" or "prismatic".
        parent: Name of the link that carries it.
        child: Name of the link that it carries.
        frame: Its frame in the parent's frame, shape [4, 4].
        axis: Axis of unit length in the joint's frame, shape [3].
        lower: Lower limit [rad or m], -infinity without one.
        upper: Upper limit [rad or m], infinity without one.
        viscosity: Its damping [N m s/rad or N s/m].
        effort: Largest effort of its drive [N m or N], infinity without a limit.
        velocity: Largest speed [rad/s or m/s], infinity without a limit.
        friction: Its Coulomb friction [N m or N].
        mimic: Name of the joint whose value it follows, a multiplier and an offset; or None.
    """

    name: str
    type: str
    parent: str
    child: str
    frame: FloatArray
    axis: FloatArray
    lower: float
    upper: float
    viscosity: float
    effort: float
    velocity: float
    friction: float
    mimic: tuple[str, float, float] | None

    @property
    def moves(self) -> bool:
        """Whether it moves and does not mimic another joint."""
        return self.type != "fixed" and self.mimic is None


@dataclass(frozen=True, eq=False)
class RobotDescription:
    """The description of a robot in a file: a tree of links.

    Attributes:
        name: Name of the robot.
        links: Its links in the order of the file.
        joints: Its joints in the order of the file.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]


def read_urdf(path: Path) -> RobotDescription:
    """Read a URDF file.

    Raises:
        InvalidInput: If the file is not safe or well-formed XML, an element or value is not
            accepted, or its links do not form a tree. The message names the file and the element.
        OSError: If the file cannot be read.
    """
    data = read_regular_file(path, _LARGEST_FILE)
    try:
        document = defusedxml.ElementTree.fromstring(data, forbid_dtd=True)
    except defusedxml.DefusedXmlException as error:
        raise InvalidInput(
            f"{path}: a URDF file must have no DOCTYPE and no entities of its own: {error}"
        ) from error
    except (ParseError, ValueError, LookupError) as error:  # the latter: encodings
        raise InvalidInput(f"{path}: not well-formed XML: {error}") from error
    if document.tag != "robot":
        raise InvalidInput(f"{path}: the root element must be <robot>, got <{document.tag}>")
    checked = reduced(f"{path}: ", document)
    # Imported here: it imports matplotlib.
    from pytorch_kinematics.urdf_parser_py.urdf import URDF

    # Bytes, because its parser refuses text with an XML declaration. Written anew, so that both
    # parsers see the same document whatever the encoding of the file.
    parse: Callable[[bytes], Any] = URDF.from_xml_string
    # That parser refuses types of joints that it does not know.
    types = [joint.attrib["type"] for joint in checked.findall("joint")]
    for joint in checked.findall("joint"):
        joint.set("type", "unknown")
    robot = parse(tostring(checked))
    for joint, kind in zip(robot.joints, types, strict=True):
        joint.type = kind
    return _description(str(path), robot)


def _description(file: str, robot: Any) -> RobotDescription:
    """Describe a robot that the parser of pytorch-kinematics has read."""
    if not robot.links:
        raise InvalidInput(f"{file}: a robot must have a <link>, got none")
    _check_names(file, "link", [link.name for link in robot.links])
    _check_names(file, "joint", [joint.name for joint in robot.joints])
    links = tuple(_link(link) for link in robot.links)
    joints = tuple(_joint(file, joint) for joint in robot.joints)
    _check_tree(file, [link.name for link in links], joints)
    _check_mimics(file, joints)
    return RobotDescription(robot.name, links, joints)


def _check_names(file: str, kind: str, names: Sequence[str]) -> None:
    seen = set()
    for name in names:
        if "/" in name:
            raise InvalidInput(
                f"{file}: a <{kind}> must have a name without '/', which stands between a robot "
                f"and its {kind}s, got {name!r}"
            )
        if name in seen:
            raise InvalidInput(f"{file}: two <{kind}> have the name {name!r}; it must be one")
        seen.add(name)


def _frame(origin: Any) -> FloatArray:
    """Frame [4, 4] of an <origin>: turned about the fixed axes x, then y, then z."""
    frame = np.eye(4)
    if origin is None:
        return frame
    roll, pitch, yaw = origin.rpy
    turn = np.eye(3)
    for (i, j), angle in (((1, 2), roll), ((2, 0), pitch), ((0, 1), yaw)):
        about = np.eye(3)
        about[i, i] = about[j, j] = math.cos(angle)
        about[j, i] = math.sin(angle)
        about[i, j] = -about[j, i]
        turn = about @ turn
    frame[:3, :3], frame[:3, 3] = turn, origin.xyz
    return frame


def _link(link: Any) -> Link:
    inertial = link.inertial
    frame = _frame(inertial and inertial.origin)
    inertia = np.zeros((3, 3))
    if inertial and inertial.inertia:
        inertia = np.array(inertial.inertia.to_matrix())
    rotation = frame[:3, :3]
    return Link(
        name=link.name,
        mass=inertial.mass if inertial else 0.0,
        center=frame[:3, 3],
        inertia=rotation @ inertia @ rotation.T,
        shapes=tuple(_shape(collision) for collision in link.collisions),
    )


_SIZES = {
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "sphere": ("radius",),
    "capsule": ("radius", "length"),
    "mesh": ("scale",),
}


def _shape(collision: Any) -> Shape:
    geometry = collision.geometry
    kind = type(geometry).__name__.lower()
    size = np.hstack([getattr(geometry, field) for field in _SIZES[kind]])
    return Shape(
        kind=kind,
        frame=_frame(collision.origin),
        size=tuple(size.tolist()),
        filename=geometry.filename if kind == "mesh" else "",
    )


def _joint(file: str, joint: Any) -> Joint:
    where = f"{file}: <joint name={joint.name!r}>"
    axis = np.array([1.0, 0.0, 0.0] if joint.axis is None else joint.axis)
    length = float(np.linalg.norm(axis))
    if joint.type != "fixed" and length < _SHORTEST_AXIS:
        raise InvalidInput(
            f"{where} <axis>: `xyz` must have a length of at least {_SHORTEST_AXIS:g}, "
            f"got {length:g}"
        )
    lower, upper = -math.inf, math.inf
    if joint.type not in ("fixed", "continuous"):
        if joint.limit is None:
            raise InvalidInput(
                f"{where} of type {joint.type!r} must have a <limit>; a joint that turns without "
                "limits has type 'continuous'"
            )
        lower, upper = joint.limit.lower, joint.limit.upper
        if lower > upper:
            raise InvalidInput(
                f"{where} <limit>: `lower` must not be above `upper`, got {lower:g} and {upper:g}"
            )
    mimic = joint.mimic
    if mimic is not None and joint.type == "fixed":
        raise InvalidInput(f"{where} of type 'fixed' must have no <mimic>: it does not move")
    return Joint(
        name=joint.name,
        type=joint.type,
        parent=joint.parent,
        child=joint.child,
        frame=_frame(joint.origin),
        axis=np.zeros(3) if joint.type == "fixed" else axis / length,
        lower=lower,
        upper=upper,
        viscosity=joint.dynamics.damping if joint.dynamics else 0.0,
        # Files write 0 where they have no limit.
        effort=(joint.limit and joint.limit.effort) or math.inf,
        velocity=(joint.limit and joint.limit.velocity) or math.inf,
        friction=joint.dynamics.friction if joint.dynamics else 0.0,
        mimic=mimic and (mimic.joint, mimic.multiplier, mimic.offset),
    )


def _check_tree(file: str, links: Sequence[str], joints: Sequence[Joint]) -> None:
    """Require that the joints connect all links to one tree."""
    holder: dict[str, str] = {}  # link -> the joint that carries it
    children: dict[str, list[str]] = {link: [] for link in links}
    for joint in joints:
        for end, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in children:
                raise InvalidInput(
                    f"{file}: <joint name={joint.name!r}>: its {end} must be a <link> of the file, "
                    f"got {link!r}"
                )
        if joint.child in holder:
            raise InvalidInput(
                f"{file}: <link name={joint.child!r}> must be the child of one joint, "
                f"got {holder[joint.child]!r} and {joint.name!r}"
            )
        holder[joint.child] = joint.name
        children[joint.parent].append(joint.child)
    reached = [link for link in links if link not in holder]
    if len(reached) > 1:
        raise InvalidInput(
            f"{file}: one <link> must be no child of a joint, the root; got {texts(reached)}"
        )
    for link in reached:
        reached += children[link]
    if len(reached) < len(links):
        link = min(set(links) - set(reached))
        raise InvalidInput(
            f"{file}: the joints must make a tree, got a cycle that <link name={link!r}> is in or "
            "hangs on"
        )


def _check_mimics(file: str, joints: Sequence[Joint]) -> None:
    """Require that every chain of mimicking joints ends at a joint that moves on its own."""
    by_name = {joint.name: joint for joint in joints}
    for joint in joints:
        where = f"{file}: <joint name={joint.name!r}> <mimic>"
        leader, followed = joint, {joint.name}
        while leader.mimic is not None:
            name = leader.mimic[0]
            if name not in by_name or by_name[name].type == "fixed":
                raise InvalidInput(
                    f"{where}: `joint` must lead to a joint of the file that moves, got {name!r}"
                )
            if name in followed:
                raise InvalidInput(
                    f"{where}: `joint` must lead to a joint that does not mimic, got a cycle "
                    f"through {name!r}"
                )
            followed.add(name)
            leader = by_name[name]
