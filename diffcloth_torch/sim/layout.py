"""What the rows of a scene's tensors stand for, and which of them a control may set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.dynamics.kinematics import Tree
from diffcloth_torch.dynamics.limits import ZONE
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.mechanism import Mechanism
from diffcloth_torch.model.quantities import CONTROL, PARAMETERS, STATE, Shape, shape_of
from diffcloth_torch.model.scene import Assembly

__all__ = ["MODES", "Layout"]

MODES: Mapping[str, tuple[str, ...]] = {
    "joint_positions": ("position", "pd"),
    "joint_velocities": ("velocity", "pd"),
    "joint_efforts": ("torque", "pd"),
}
"""Field of a control -> actuations of the joints that it sets."""

_MOTIONS = {"fixed": "static", "kinematic": "kinematic", "floating": "dynamic"}


class Layout:
    """Rows by name, and what moves them. Immutable.

    Attributes:
        assembly: Arrays of the scene.
        state_shapes: Shape of each field of a state that a step looks at.
        state_fields: Those that anything is computed with, beside the time.
        control_shapes: Shape of each field of a control.
        control_fields: Likewise.
        zeros: Field of a control -> what it is where it is not set and always the same, one
            environment for all. Nobody edits it.
        parameter_shapes: Accepted shapes of each parameter.
        pins: Vertices that are pinned, shape [P].
        bodies: Mechanism of each of the K bodies.
        robots: Mechanism of each of the R robots.
        trees: Kinematics of each robot.
        shaped_links: Which of the L links have a shape, in the order of the surfaces.
        rigid_vertices: Name of a body, or "robot/link" -> its rows among the V vertices.
        kinematic_bodies: Indices of the bodies on prescribed poses.
        is_dynamic: Whether forces move anything but the cloths.
        groups: Field of a control -> name -> rows.
        kept: "body_poses" or "base_poses" -> why each row must be the state's, or "".
        unforced: "body_wrenches" or "base_wrenches" -> why each row must be zero, or "".
        joint_names: "robot/joint" of each of the J joints.
        actuation: Of each joint, length J.
        driven: Which joints have a pd drive, shape [J].
        settable: Field of a control -> which joints it sets, shape [J].
        massive: "body" or "link" -> which of them have mass and are moved by forces, [K] or [L].
        lower: Lower limits [rad or m], shape [J].
        upper: Upper limits, likewise.
        farthest: Ends of the zones beyond the limits of joints that forces move, infinite for
            others; the lower, then the upper ones, shape [2, J].
    """

    def __init__(self, assembly: Assembly) -> None:
        self.assembly = assembly
        sizes = assembly.sizes
        looked_at = {name: q for name, q in STATE.items() if not q.ignored}
        self.state_shapes = {name: shape_of(q.axes[0], sizes) for name, q in looked_at.items()}
        self.control_shapes = {name: shape_of(q.axes[0], sizes) for name, q in CONTROL.items()}
        self.parameter_shapes = {
            name: [shape_of(axes, sizes) for axes in q.axes] for name, q in PARAMETERS.items()
        }
        self.pins = torch.from_numpy(assembly.pins.astype(np.int64))
        self.bodies = assembly.mechanisms[: assembly.body_count]
        self.robots = assembly.mechanisms[assembly.body_count :]
        self.trees = tuple(Tree(robot) for robot in self.robots)
        first_links = np.cumsum([0, *(robot.link_count for robot in self.robots)])
        of_robots = assembly.surface_mechanism >= assembly.body_count
        owners = assembly.surface_mechanism[of_robots] - assembly.body_count
        self.shaped_links = torch.from_numpy(first_links[owners] + assembly.surface_link[of_robots])
        starts = assembly.body_vertex_start.tolist()
        self.rigid_vertices = {
            name: slice(*ends)
            for name, ends in zip(
                assembly.surface_names[assembly.cloth_count :], pairwise(starts), strict=True
            )
        }
        kinematic = [k for k, body in enumerate(self.bodies) if body.base == "kinematic"]
        self.kinematic_bodies = torch.tensor(kinematic, dtype=torch.int64)
        self.is_dynamic = any(mechanism.is_dynamic for mechanism in assembly.mechanisms)
        self.state_fields = tuple(
            name for name, q in looked_at.items() if self.has_coordinates or q.core is not None
        )
        self.control_fields = tuple(
            name for name, q in CONTROL.items() if self.has_coordinates or q.core is not None
        )
        self.zeros = {
            name: torch.zeros(1, *shape, dtype=torch.float64)
            for name, shape in self.control_shapes.items()
            if CONTROL[name].source == "zero" or (name == "pins" and 0 in shape)
        }
        self.joint_names = tuple(
            f"{r.name}/{joint}" for r in self.robots for joint in r.joint_names
        )
        self.actuation = tuple(mode for robot in self.robots for mode in robot.actuation)
        self.driven = torch.tensor([mode == "pd" for mode in self.actuation], dtype=torch.bool)
        self.lower = _joined([robot.lower for robot in self.robots])
        self.upper = _joined([robot.upper for robot in self.robots])
        reach = np.where(np.isinf(self.upper - self.lower), 0.0, ZONE * (self.upper - self.lower))
        self.farthest = np.where(
            assembly.forced, [self.lower - reach, self.upper + reach], [[-np.inf], [np.inf]]
        )
        body_motions = [f"the body {b.name!r} is {_MOTIONS[b.base]}" for b in self.bodies]
        base_motions = [f"the base of the robot {r.name!r} is {r.base}" for r in self.robots]
        self.kept = {
            "body_poses": _unless("kinematic", self.bodies, body_motions),
            "base_poses": _unless("kinematic", self.robots, base_motions),
        }
        self.unforced = {
            "body_wrenches": _unless("floating", self.bodies, body_motions),
            "base_wrenches": _unless("floating", self.robots, base_motions),
        }
        self.settable = {
            field: np.array([mode in modes for mode in self.actuation], dtype=bool)
            for field, modes in MODES.items()
        }
        self.massive = {"body": _massive(self.bodies), "link": _massive(self.robots)}
        rows = {
            "K": _single_rows([body.name for body in self.bodies]),
            "R": _single_rows([robot.name for robot in self.robots]),
            "J": _single_rows(self.joint_names),
        }
        self.groups: Mapping[str, Mapping[str, slice]] = {
            "pins": assembly.pin_groups,
            "soft_pins": assembly.soft_pin_groups,
            **{
                name: rows[letter]
                for name, quantity in CONTROL.items()
                if isinstance(letter := quantity.axes[0][0], str) and letter in rows
            },
        }

    @property
    def has_coordinates(self) -> bool:
        """Whether the scene has more than cloths and bodies on prescribed poses."""
        return self.is_dynamic or bool(self.robots)

    def entry_shape(self, field: str, name: str) -> Shape:
        """Shape of what a control's mapping holds under a full name."""
        rows = self.groups[field][name]
        shape: Shape = tuple(n for n in CONTROL[field].axes[0][1:] if isinstance(n, int))
        return (rows.stop - rows.start, *shape) if field in ("pins", "soft_pins") else shape

    def full_name(self, field: str, key: str) -> str:
        """Find the full name, "owner/name", of a name in a control's mapping.

        Raises:
            InvalidInput: If there is none, there are several, or the field sets no such joint.
        """
        groups = self.groups[field]
        full = [key] if key in groups else [g for g in groups if g.partition("/")[2] == key]
        if len(full) != 1:
            problem = "is the name of several" if full else "is none of them"
            accepted = ", ".join(map(repr, groups)) or "none, the scene has nothing of the kind"
            shorter = " (or the part behind '/' where it is unique)" if "/" in accepted else ""
            raise InvalidInput(
                f"control: `{field}` has the names {accepted}{shorter}; {key!r} {problem}"
            )
        if field in MODES:
            actuation = self.actuation[groups[full[0]].start]
            if actuation not in MODES[field]:
                raise InvalidInput(
                    f"control: `{field}` sets joints whose actuation is "
                    f"{' or '.join(map(repr, MODES[field]))}; that of {full[0]!r} is {actuation!r}"
                )
        return full[0]


def _joined(arrays: Sequence[FloatArray]) -> FloatArray:
    joined: FloatArray = np.concatenate([np.empty(0), *arrays])
    return joined


def _massive(mechanisms: Sequence[Mechanism]) -> NDArray[np.bool_]:
    parts = [(m.mass > 0.0) & m.is_dynamic for m in mechanisms]
    return np.concatenate([np.empty(0, dtype=bool), *parts])


def _unless(base: str, mechanisms: Sequence[Mechanism], why: Sequence[str]) -> list[str]:
    return ["" if m.base == base else text for m, text in zip(mechanisms, why, strict=True)]


def _single_rows(names: Sequence[str]) -> dict[str, slice]:
    return {name: slice(i, i + 1) for i, name in enumerate(names)}
