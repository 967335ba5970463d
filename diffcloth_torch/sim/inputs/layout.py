"""The sizes of a scene's tensors, and the meaning of their rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import torch

from diffcloth_torch import cpu
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.assembly import Assembly
from diffcloth_torch.model.kinematics import Links
from diffcloth_torch.model.quantities import CONTROL, PARAMETERS, STATE, Shape, shape_of
from diffcloth_torch.operations import label
from diffcloth_torch.sim.inputs.permissions import Permissions

__all__ = ["SEVERAL", "Layout"]

SEVERAL = ("pins", "soft_pins", "attachments", "attachment_weights", "body_vertices")
"""Fields of a control whose names stand for several rows."""


class Layout:
    """Shapes, and rows by name. Immutable.

    Attributes:
        assembly: Arrays of the scene.
        permissions: Rows that a control may set, and their limits.
        state_shapes: Shape of each field of a state that a step reads.
        state_fields: Names of the fields of a state that enter any computation, except the time.
        control_shapes: Shape of each field of a control.
        control_fields: Names of these fields.
        zeros: Field of a control -> its constant default, one environment for all. Never edited.
        parameter_shapes: Accepted shapes of each parameter.
        pins: Indices of the pinned vertices, shape [P].
        elastic: Number of cloths or of faces -> mask of cloths that are not deforming bodies, or of
            their faces, [1, C] or [1, F].
        body_vertex_rows: Vertices of deforming bodies, shape [D].
        corners: Vertices of the faces of cloths, shape [F, 3].
        robots: Links of each of the R robots.
        shaped_links: Indices of the links with a shape, in the order of the surfaces.
        rigid_vertices: Name of a body or "robot/link" -> its rows among the V vertices.
        kinematic_bodies: Indices of the bodies on prescribed poses.
        is_dynamic: True if a body or a robot is dynamic.
        groups: Field of a control -> name -> its rows.
        cloth_names: Name of each of the C cloths.
        rows_by_name: Letter of an axis -> name -> rows: of surfaces "S", bodies "K", links "L" and
            joints "J", both by robot too, of the rest vertices "M" and faces "F" of cloths, and of
            the springs "A" of attachments.
        joint_names: "robot/joint" of each of the J joints.
        link_names: "robot/link" of each of the L links.
    """

    def __init__(self, assembly: Assembly) -> None:
        self.assembly = assembly
        self.permissions = Permissions(assembly)
        self.is_dynamic = any(mechanism.is_dynamic for mechanism in assembly.mechanisms)
        self.robots = tuple(Links(robot) for robot in assembly.robots)
        self.joint_names = tuple(
            f"{r.name}/{joint}" for r in assembly.robots for joint in r.joint_names
        )
        self.link_names = tuple(
            f"{r.name}/{link}" for r in assembly.robots for link in r.link_names
        )
        self.cloth_names = assembly.surface_names[: assembly.cloth_count]
        self._set_shapes()
        self._set_rows()
        self.rows_by_name = self._rows_by_name()

    def _set_shapes(self) -> None:
        sizes = self.assembly.sizes
        looked_at = {name: q for name, q in STATE.items() if not q.ignored}
        self.state_shapes = {name: shape_of(q.axes[0], sizes) for name, q in looked_at.items()}
        self.control_shapes = {name: shape_of(q.axes[0], sizes) for name, q in CONTROL.items()}
        self.parameter_shapes = {
            name: [shape_of(axes, sizes) for axes in q.axes] for name, q in PARAMETERS.items()
        }
        self.state_fields = tuple(
            name for name, q in looked_at.items() if self.has_coordinates or q.core is not None
        )
        has_deforming = self.assembly.deforming_count > 0
        self.control_fields = tuple(
            name
            for name, q in CONTROL.items()
            if self.has_coordinates or q.core is not None or (q.axes[0][0] == "D" and has_deforming)
        )
        self.zeros = {
            name: cpu.zeros(1, *shape)
            for name, shape in self.control_shapes.items()
            if CONTROL[name].source in ("zero", "released")
            or (name in ("pins", "body_vertices") and 0 in shape)
        }
        # Attachments between points of the scene act unless a control releases them.
        between = self.assembly.springs.targets < 0
        self.zeros["attachment_weights"] = torch.from_numpy(between.astype(np.float64))[None]

    def _set_rows(self) -> None:
        assembly = self.assembly
        self.pins = torch.from_numpy(assembly.pins.astype(np.int64))
        self.body_vertex_rows = torch.from_numpy(assembly.body_vertex_rows.astype(np.int64))
        is_elastic = np.arange(assembly.cloth_count) < (
            assembly.cloth_count - assembly.deforming_count
        )
        of_faces = np.repeat(is_elastic, np.diff(assembly.cloth_face_start))
        self.elastic = {len(mask): torch.from_numpy(mask)[None] for mask in (is_elastic, of_faces)}
        self.corners = torch.from_numpy(assembly.faces.astype(np.int64))
        first_links = np.cumsum([0, *(robot.link_count for robot in assembly.robots)])
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
        kinematic = [k for k, body in enumerate(assembly.bodies) if body.base == "kinematic"]
        self.kinematic_bodies = cpu.tensor(kinematic, dtype=torch.int64)
        rows = {
            "K": _single_rows([body.name for body in assembly.bodies]),
            "R": _single_rows([robot.name for robot in assembly.robots]),
            "J": _single_rows(self.joint_names),
            "D": assembly.deforming_groups,
        }
        self.groups: Mapping[str, Mapping[str, slice]] = {
            "pins": assembly.pin_groups,
            "soft_pins": assembly.soft_pin_groups,
            "attachments": assembly.springs.target_groups,
            "attachment_weights": assembly.springs.groups,
            **{
                name: rows[letter]
                for name, quantity in CONTROL.items()
                if isinstance(letter := quantity.axes[0][0], str) and letter in rows
            },
        }

    def _rows_by_name(self) -> Mapping[str, Mapping[str, slice]]:
        assembly = self.assembly
        starts = {"M": assembly.cloth_rest_start, "F": assembly.cloth_face_start}
        of_cloths = {
            letter: {
                name: slice(*ends)
                for name, ends in zip(self.cloth_names, pairwise(rows.tolist()), strict=True)
            }
            for letter, rows in starts.items()
        }
        return {
            **of_cloths,
            "S": _single_rows(assembly.surface_names),
            "K": _single_rows([body.name for body in assembly.bodies]),
            "L": {**_single_rows(self.link_names), **assembly.link_slices},
            "J": {**_single_rows(self.joint_names), **assembly.joint_slices},
            "A": assembly.springs.groups,
        }

    @property
    def has_coordinates(self) -> bool:
        """Return whether the scene has robots or dynamic bodies."""
        return self.is_dynamic or bool(self.robots)

    def entry_shape(self, field: str, name: str) -> Shape:
        """Shape of the value that a control's mapping has for a full name."""
        rows = self.groups[field][name]
        shape: Shape = tuple(n for n in CONTROL[field].axes[0][1:] if isinstance(n, int))
        return (rows.stop - rows.start, *shape) if field in SEVERAL else shape

    def full_name(self, field: str, key: str) -> str:
        """Return the full name, "owner/name", for a key of a control's mapping.

        Raises:
            InvalidInput: If no or more than one full name matches, or the field cannot set that
                joint.
        """
        groups = self.groups[field]
        full = [key] if key in groups else [g for g in groups if g.partition("/")[2] == key]
        if len(full) != 1:
            problem = "is the name of several" if full else "is none of them"
            accepted = ", ".join(map(repr, groups)) or "none, the scene has nothing of the kind"
            shorter = " (or the part behind '/' where it is unique)" if "/" in accepted else ""
            raise InvalidInput(
                f"{label('control', field)} has the names {accepted}{shorter}; {key!r} {problem}"
            )
        self.permissions.check_settable(field, groups[full[0]].start, full[0])
        return full[0]


def _single_rows(names: Sequence[str]) -> dict[str, slice]:
    return {name: slice(i, i + 1) for i, name in enumerate(names)}
