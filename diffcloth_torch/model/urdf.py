"""URDF files, read safely.

A file is first reduced to the elements and attributes of `urdf_document`, which are checked and
completed by defaults. The description is made from these alone, and must be a tree of links.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.sax import ContentHandler, SAXParseException
from xml.sax.xmlreader import AttributesImpl

import defusedxml.sax
import numpy as np

from diffcloth_torch.checks import FloatArray, texts
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import read_regular_file
from diffcloth_torch.model.refusals import Refusals
from diffcloth_torch.model.urdf_document import reduced

__all__ = ["Joint", "Link", "RobotDescription", "Shape", "describe_urdf", "read_urdf"]

# Files of robots with a thousand links have a few MB.
_LARGEST_FILE = 16 * 2**20  # bytes

_COUNTS = {2: "two", 3: "three"}

# A shorter axis is treated as zero.
_SHORTEST_AXIS = 1e-9


@dataclass(frozen=True, eq=False)
class Shape:
    """A collision shape of a link.

    Attributes:
        kind: "box", "cylinder", "sphere", "capsule" or "mesh".
        frame: Frame of the shape in the link's frame, shape [4, 4].
        size: Lengths of a box; radius and length of a cylinder, or of the cylinder in a capsule;
            radius of a sphere [m]; scale of a mesh along its axes [-].
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
        name: Name of the link.
        mass: Mass [kg].
        center: Center of mass in the link's frame [m], shape [3].
        inertia: Inertia about the center, in the link's axes [kg m^2], shape [3, 3].
        shapes: Collision shapes of the link.
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
        name: Name of the joint.
        type: "fixed", "revolute", "continuous" or "prismatic".
        parent: Name of the link that carries the joint.
        child: Name of the link that the joint carries.
        frame: Frame of the joint in the parent's frame, shape [4, 4].
        axis: Axis of unit length in the joint's frame, shape [3].
        lower: Lower limit [rad or m], -infinity without one.
        upper: Upper limit [rad or m], infinity without one.
        viscosity: Damping of the joint [N m s/rad or N s/m].
        effort: Largest effort of the joint's drive [N m or N], infinity without a limit.
        velocity: Largest speed [rad/s or m/s], infinity without a limit.
        friction: Coulomb friction of the joint [N m or N].
        mimic: Name of the followed joint, multiplier and offset of its value; or None.
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
        """True if the joint moves and does not mimic another joint."""
        return self.type != "fixed" and self.mimic is None


@dataclass(frozen=True, eq=False)
class RobotDescription:
    """The description of a robot in a file: a tree of links.

    Attributes:
        name: Name of the robot.
        links: Links in the order of the file.
        joints: Joints in the order of the file.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]


def read_urdf(path: Path) -> RobotDescription:
    """Read a URDF file.

    Raises:
        InvalidInput: If the file is not safe or well-formed XML, an element or value is not
            accepted, or its links do not form a tree. The message has every reason, with the file
            and the element.
        OSError: If the file cannot be read.
    """
    refusals = Refusals()
    description = describe_urdf(path, refusals)
    refusals.raise_any(f"{path}: ")
    return description


def describe_urdf(path: Path, refusals: Refusals) -> RobotDescription:
    """Describe the accepted parts of a URDF file.

    Args:
        path: The file.
        refusals: Collects the reasons against refused parts. Without a reason, the links form a
            tree.

    Raises:
        InvalidInput: If the file is not safe or well-formed XML, or describes no robot.
        OSError: If the file cannot be read.
    """
    document = _parsed(path, read_regular_file(path, _LARGEST_FILE))
    if document.tag != "robot":
        raise InvalidInput(f"{path}: the root element must be <robot>, got <{document.tag}>")
    if document.find("link") is None:
        raise InvalidInput(f"{path}: a robot must have a <link>, got none")
    robot = reduced(f"{path}: ", document, refusals)
    file = str(path)
    links = tuple(_link(link) for link in robot.iter("link"))
    joints: list[Joint] = []
    for joint in robot.iter("joint"):
        with refusals.collected():
            joints.append(_joint(file, joint))
    for kind, named in (("link", links), ("joint", joints)):
        _check_names(file, kind, [part.name for part in named], refusals)
    if not refusals:
        _check_tree(file, [link.name for link in links], joints, refusals)
        _check_mimics(file, joints, refusals)
    return RobotDescription(robot.get("name", ""), links, tuple(joints))


class _Builder(ContentHandler):
    """Builds a tree of elements; as in urdfdom, a prefix is a part of a name and needs no URI."""

    def __init__(self) -> None:
        super().__init__()
        self.tree = TreeBuilder()

    def startElement(self, name: str, attributes: AttributesImpl) -> None:
        self.tree.start(name, dict(attributes))

    def endElement(self, name: str) -> None:
        self.tree.end(name)


def _parsed(path: Path, data: bytes) -> Element:
    builder = _Builder()
    try:
        defusedxml.sax.parseString(data, builder, forbid_dtd=True)
    except defusedxml.DefusedXmlException as error:
        raise InvalidInput(
            f"{path}: a URDF file must have no DOCTYPE and no entities of its own: {error}"
        ) from error
    except SAXParseException as error:
        place = f"line {error.getLineNumber()}, column {error.getColumnNumber()}"
        raise InvalidInput(f"{path}: not well-formed XML: {error.getMessage()}: {place}") from error
    except (ValueError, LookupError) as error:  # unknown or wrong encoding
        raise InvalidInput(f"{path}: not well-formed XML: {error}") from error
    return builder.tree.close()


def _check_names(file: str, kind: str, names: Sequence[str], refusals: Refusals) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            with refusals.collected():
                raise InvalidInput(
                    f"{file}: {_COUNTS.get(count, count)} <{kind}> have the name {name!r}; "
                    "it must be one"
                )


def _numbers(element: Element, attribute: str) -> FloatArray:
    return np.array([float(word) for word in element.attrib[attribute].split()])


def _number(element: Element | None, attribute: str) -> float:
    """A number of an element, zero if the element is missing."""
    return 0.0 if element is None else float(element.attrib[attribute])


def _frame(owner: Element | None) -> FloatArray:
    """Frame [4, 4] of the <origin>: rotation about the fixed axes x, then y, then z."""
    frame = np.eye(4)
    origin = None if owner is None else owner.find("origin")
    if origin is None:
        return frame
    roll, pitch, yaw = _numbers(origin, "rpy")
    turn = np.eye(3)
    for (i, j), angle in (((1, 2), roll), ((2, 0), pitch), ((0, 1), yaw)):
        about = np.eye(3)
        about[i, i] = about[j, j] = math.cos(angle)
        about[j, i] = math.sin(angle)
        about[i, j] = -about[j, i]
        turn = about @ turn
    frame[:3, :3], frame[:3, 3] = turn, _numbers(origin, "xyz")
    return frame


def _link(link: Element) -> Link:
    inertial = link.find("inertial")
    frame = _frame(inertial)
    moments = None if inertial is None else inertial.find("inertia")
    rows = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
    inertia = np.array([[_number(moments, name) for name in row] for row in rows])
    rotation = frame[:3, :3]
    return Link(
        name=link.attrib["name"],
        mass=0.0 if inertial is None else _number(inertial.find("mass"), "value"),
        center=frame[:3, 3],
        inertia=rotation @ inertia @ rotation.T,
        shapes=tuple(_shape(collision) for collision in link.iter("collision")),
    )


def _shape(collision: Element) -> Shape:
    (shape,) = collision.iterfind("geometry/*")
    # The reduced document has attributes in the order of the grammar.
    fields = [field for field in shape.attrib if field != "filename"]
    return Shape(
        kind=shape.tag,
        frame=_frame(collision),
        size=tuple(float(x) for field in fields for x in _numbers(shape, field)),
        filename=shape.get("filename", ""),
    )


def _joint(file: str, joint: Element) -> Joint:
    name, kind = joint.attrib["name"], joint.attrib["type"]
    where = f"{file}: <joint name={name!r}>"
    given = {tag: joint.find(tag) for tag in ("axis", "limit", "dynamics", "mimic")}
    axis, limit, mimic = given["axis"], given["limit"], given["mimic"]
    direction = np.array([1.0, 0.0, 0.0]) if axis is None else _numbers(axis, "xyz")
    length = float(np.linalg.norm(direction))
    if kind != "fixed" and length < _SHORTEST_AXIS:
        raise InvalidInput(
            f"{where} <axis>: `xyz` must have a length of at least {_SHORTEST_AXIS:g}, "
            f"got {length:g}"
        )
    lower, upper = -math.inf, math.inf
    needs_limit = kind not in ("fixed", "continuous")
    if needs_limit and not (limit is None and mimic is not None):
        if limit is None:
            raise InvalidInput(
                f"{where} of type {kind!r} must have a <limit>; a joint that turns without "
                "limits has type 'continuous'"
            )
        lower, upper = _number(limit, "lower"), _number(limit, "upper")
        if lower > upper:
            raise InvalidInput(
                f"{where} <limit>: `lower` must not be above `upper`, got {lower:g} and {upper:g}"
            )
    follows = None
    if mimic is not None and kind != "fixed":
        follows = mimic.attrib["joint"], _number(mimic, "multiplier"), _number(mimic, "offset")
    parent, child = (joint.find(tag) for tag in ("parent", "child"))
    assert parent is not None  # the grammar requires both
    assert child is not None
    return Joint(
        name=name,
        type=kind,
        parent=parent.attrib["link"],
        child=child.attrib["link"],
        frame=_frame(joint),
        axis=np.zeros(3) if kind == "fixed" else direction / length,
        lower=lower,
        upper=upper,
        viscosity=_number(given["dynamics"], "damping"),
        # URDF files use 0 for no limit.
        effort=_number(limit, "effort") or math.inf,
        velocity=_number(limit, "velocity") or math.inf,
        friction=_number(given["dynamics"], "friction"),
        mimic=follows,
    )


def _check_tree(
    file: str, links: Sequence[str], joints: Sequence[Joint], refusals: Refusals
) -> None:
    """Require that the joints connect all links to one tree."""
    before = len(refusals)
    holder: dict[str, str] = {}  # link -> the joint that carries it
    children: dict[str, list[str]] = {link: [] for link in links}
    for joint in joints:
        with refusals.collected():
            for end, link in (("parent", joint.parent), ("child", joint.child)):
                if link not in children:
                    raise InvalidInput(
                        f"{file}: <joint name={joint.name!r}>: its {end} must be a <link> of the "
                        f"file, got {link!r}"
                    )
            if joint.child in holder:
                raise InvalidInput(
                    f"{file}: <link name={joint.child!r}> must be the child of one joint, "
                    f"got {holder[joint.child]!r} and {joint.name!r}"
                )
            holder[joint.child] = joint.name
            children[joint.parent].append(joint.child)
    if len(refusals) == before:
        with refusals.collected():
            _check_connected(file, links, children)


def _check_connected(
    file: str, links: Sequence[str], children: Mapping[str, Sequence[str]]
) -> None:
    carried = {child for of_link in children.values() for child in of_link}
    reached = [link for link in links if link not in carried]
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


def _check_mimics(file: str, joints: Sequence[Joint], refusals: Refusals) -> None:
    """Require that every chain of mimicking joints ends at a joint that moves on its own."""
    by_name = {joint.name: joint for joint in joints}
    for joint in joints:
        with refusals.collected():
            _check_mimic(f"{file}: <joint name={joint.name!r}> <mimic>", joint, by_name)


def _check_mimic(where: str, joint: Joint, by_name: Mapping[str, Joint]) -> None:
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
