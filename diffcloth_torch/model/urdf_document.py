"""The elements and attributes of URDF files that are read, each with its accepted values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from diffcloth_torch.checks import ANY_NUMBER, LARGEST, NON_NEGATIVE, Range, check_choice
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.refusals import Refusals

__all__ = ["JOINT_TYPES", "SHAPES", "reduced"]

JOINT_TYPES = ("fixed", "revolute", "continuous", "prismatic")
SHAPES = ("box", "cylinder", "sphere", "capsule", "mesh")

_LONGEST_WORD = 1000


class _Attribute(NamedTuple):
    """The accepted text of an attribute; an attribute without a default is required."""

    numbers: int = 0  # number of numbers; 0: a word
    default: str | None = None
    accepted: Range = ANY_NUMBER
    words: tuple[str, ...] = ()  # accepted words; empty: all


class _Child(NamedTuple):
    element: _Element
    required: bool = False
    many: bool = False


class _Element(NamedTuple):
    attributes: dict[str, _Attribute]
    children: dict[str, _Child]


_NAME = _Attribute()
_NUMBER = _Attribute(1)
_SIZE = _Attribute(1, accepted=Range(0.0))
_ORIGIN = _Child(
    _Element({"xyz": _Attribute(3, "0 0 0"), "rpy": _Attribute(3, "0 0 0")}, {}),
)
_GEOMETRY = _Element(
    {},
    {
        "box": _Child(_Element({"size": _Attribute(3, accepted=Range(0.0))}, {})),
        "cylinder": _Child(_Element({"radius": _SIZE, "length": _SIZE}, {})),
        "sphere": _Child(_Element({"radius": _SIZE}, {})),
        "capsule": _Child(_Element({"radius": _SIZE, "length": _SIZE}, {})),
        "mesh": _Child(_Element({"filename": _NAME, "scale": _Attribute(3, "1 1 1")}, {})),
    },
)
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_LINK = _Element(
    {"name": _NAME},
    {
        "inertial": _Child(
            _Element(
                {},
                {
                    "origin": _ORIGIN,
                    "mass": _Child(
                        _Element({"value": _Attribute(1, accepted=NON_NEGATIVE)}, {}), required=True
                    ),
                    "inertia": _Child(_Element(dict.fromkeys(_MOMENTS, _NUMBER), {})),
                },
            )
        ),
        "collision": _Child(
            _Element({}, {"origin": _ORIGIN, "geometry": _Child(_GEOMETRY, required=True)}),
            many=True,
        ),
    },
)
_JOINT = _Element(
    {"name": _NAME, "type": _Attribute(words=JOINT_TYPES)},
    {
        "origin": _ORIGIN,
        "parent": _Child(_Element({"link": _NAME}, {}), required=True),
        "child": _Child(_Element({"link": _NAME}, {}), required=True),
        "axis": _Child(_Element({"xyz": _Attribute(3, "1 0 0")}, {})),
        "limit": _Child(
            _Element(
                dict.fromkeys(("lower", "upper"), _Attribute(1, "0"))
                | dict.fromkeys(("effort", "velocity"), _Attribute(1, "0", NON_NEGATIVE)),
                {},
            )
        ),
        "dynamics": _Child(
            _Element(
                {
                    "damping": _Attribute(1, "0", NON_NEGATIVE),
                    "friction": _Attribute(1, "0", NON_NEGATIVE),
                },
                {},
            )
        ),
        "mimic": _Child(
            _Element(
                {
                    "joint": _NAME,
                    "multiplier": _Attribute(1, "1"),
                    "offset": _Attribute(1, "0"),
                },
                {},
            )
        ),
    },
)
_ROBOT = _Element(
    {"name": _Attribute(0, "robot")},
    {"link": _Child(_LINK, many=True), "joint": _Child(_JOINT, many=True)},
)


def reduced(
    file: str,
    node: Element,
    refusals: Refusals,
    grammar: _Element = _ROBOT,
    above: Sequence[str] = (),
) -> Element:
    """Copy and check the parts of an element that the grammar contains; the rest is ignored.

    Args:
        file: Start of messages.
        node: The element.
        refusals: Collects every reason against the element and its contents.
        grammar: Grammar of the element.
        above: The enclosing elements, from the outside.

    Returns:
        The copy, without the children that are not accepted.
    """
    name = node.get("name")
    here = (*above, f"<{node.tag}>" if name is None else f"<{node.tag} name={name!r}>")
    where = file + " ".join(here[1:] or here)  # <robot> is implied
    copy = Element(node.tag)
    for key, attribute in grammar.attributes.items():
        with refusals.collected():
            text = node.get(key, attribute.default)
            copy.set(key, _checked(f"{where}: `{key}`", text, attribute))
    found = [child for child in node if child.tag in grammar.children]
    for tag, rule in grammar.children.items():
        count = sum(child.tag == tag for child in found)
        if (count == 0 and rule.required) or (count > 1 and not rule.many):
            with refusals.collected():
                raise InvalidInput(f"{where} must have one <{tag}>, got {count}")
    for child in found:
        before = len(refusals)
        part = reduced(file, child, refusals, grammar.children[child.tag].element, here)
        if len(refusals) == before:
            copy.append(part)
    if grammar is _GEOMETRY and len(found) != 1:
        got = ", ".join(f"<{child.tag}>" for child in node) or "none"
        accepted = ", ".join(f"<{kind}>" for kind in SHAPES)
        with refusals.collected():
            raise InvalidInput(f"{where} must hold one of {accepted}, got {got}")
    return copy


def _checked(label: str, text: str | None, attribute: _Attribute) -> str:
    if text is None:
        raise InvalidInput(f"{label} must be given")
    if attribute.words:
        return check_choice(label, text, attribute.words)
    if attribute.numbers == 0:
        return _checked_word(label, text)
    what = "a number" if attribute.numbers == 1 else f"{attribute.numbers} numbers"
    accepted = f"{what} {attribute.accepted}" if attribute.accepted != ANY_NUMBER else what
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != attribute.numbers:
        raise InvalidInput(f"{label} must be {accepted}, got {text!r}")
    values = np.array(numbers)
    outside = attribute.accepted.outside(values) | ~(np.abs(values) <= LARGEST)
    if outside.any():
        raise InvalidInput(f"{label} must be {accepted}, at most {LARGEST:g} in size, got {text!r}")
    return " ".join(repr(number) for number in numbers)


def _checked_word(label: str, text: str) -> str:
    if not 0 < len(text) <= _LONGEST_WORD or not text.isprintable():
        raise InvalidInput(
            f"{label} must be printable and have 1 to {_LONGEST_WORD} characters, "
            f"got {text[:_LONGEST_WORD]!r}"
        )
    return text
