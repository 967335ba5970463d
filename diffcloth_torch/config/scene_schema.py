"""The schema of scenes in configurations: cloths, bodies, robots, attachments."""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le, Len
from pydantic import Discriminator, create_model, model_validator

from diffcloth_torch.config.section import (
    Actuation,
    Color,
    NonNegative,
    Positive,
    Section,
    Vector3,
    limits,
    require_increasing,
    require_one,
)
from diffcloth_torch.config.shape_schema import (
    Box,
    Capsule,
    Chair,
    ClothFile,
    Cylinder,
    Disk,
    Grid,
    MeshFile,
    PinKeyframe,
    Plane,
    PoseKeyframe,
    PoseSection,
    Sphere,
    Strip,
)
from diffcloth_torch.model.materials import Material

__all__ = [
    "AirSection",
    "AttachmentSection",
    "BodySection",
    "BoxSelection",
    "ClothSection",
    "EndSection",
    "ForAll",
    "JointKeyframe",
    "MaterialSection",
    "Names",
    "RobotSection",
    "SceneSection",
    "Selection",
    "WeightKeyframe",
]


class BoxSelection(Section):
    """An axis-aligned box in world axes [m]."""

    lower: Vector3
    upper: Vector3


class Selection(Section):
    """Vertices by index, inside a box at the start, or nearest to points at the start."""

    vertices: Annotated[list[Annotated[int, Ge(0)]], Len(1)] | None = None
    box: BoxSelection | None = None
    nearest: Annotated[list[Vector3], Len(1)] | None = None

    @model_validator(mode="after")
    def _check_one(self) -> Selection:
        require_one(self, ("vertices", "box", "nearest"))
        return self


_LIMITED: dict[str, Any] = {
    field.name: (Annotated[float, limits(field.name)] | None, None) for field in fields(Material)
}
_MaterialFields: Any = create_model("_MaterialFields", __base__=Section, **_LIMITED)


Fabric = Literal[
    "denim",
    "trouser_cloth",
    "tablecloth",
    "windbreaker",
    "blanket",
    "ponte",
    "interlock",
    "rib_knit",
]


class MaterialSection(_MaterialFields):  # type: ignore[misc]  # its fields are those of Material
    """Properties of a cloth, in the units of `Material`, with its defaults.

    With a `fabric`, properties default to the numbers of `dc.fabrics`.
    """

    fabric: Fabric | None = None


class ClothSection(Section):
    """A cloth."""

    name: str
    shape: Annotated[Grid | Disk | Strip | ClothFile, Discriminator("kind")]
    pose: PoseSection = PoseSection()
    material: MaterialSection = MaterialSection()
    pins: dict[str, Selection] = {}
    soft_pins: dict[str, Selection] = {}
    pin_stiffness: Annotated[float, limits("pin_stiffness")] | None = None
    pin_trajectories: dict[str, Annotated[list[PinKeyframe], Len(1)]] = {}
    bending_model: Literal["patch", "hinge"] | None = None
    directions: Vector3 | None = None
    color: Color | None = None
    back_color: Color | None = None

    @model_validator(mode="after")
    def _check_trajectories(self) -> ClothSection:
        names = [*self.pins, *self.soft_pins]
        for name, keyframes in self.pin_trajectories.items():
            if name not in names:
                accepted = ", ".join(names) or "none"
                raise ValueError(
                    f"moves the pins `{name}` in `pin_trajectories`, but its pins are: {accepted}"
                )
            require_increasing(f"pin_trajectories.{name}", [frame.time for frame in keyframes])
        return self


class BodySection(Section):
    """A rigid body. With a `trajectory` it is kinematic and starts at `pose` at time 0.

    A dynamic body has a `density` [kg/m^3] or a `mass` [kg].
    """

    name: str
    shape: Annotated[
        Box | Sphere | Capsule | Cylinder | Plane | Chair | MeshFile,
        Discriminator("kind"),
    ]
    pose: PoseSection = PoseSection()
    motion: Literal["static", "kinematic", "dynamic"] = "static"
    trajectory: list[PoseKeyframe] = []
    friction: Annotated[float, limits("friction")] | None = None
    thickness: Annotated[float, limits("thickness")] | None = None
    density: Positive | None = None
    mass: Positive | None = None
    center: Vector3 | None = None
    inertia: Annotated[list[Vector3], Len(3, 3)] | None = None
    nodal_contact: bool | None = None
    color: Color | None = None

    @model_validator(mode="after")
    def _check_trajectory(self) -> BodySection:
        require_increasing("trajectory", [frame.time for frame in self.trajectory])
        if self.trajectory and self.motion != "kinematic":
            raise ValueError("has a `trajectory` and must have `motion: kinematic` for it")
        return self


class JointKeyframe(Section):
    """Target or effort of a joint at a time [s].

    The `value` is a position target under position or pd actuation, a velocity target under
    velocity actuation, and an effort under torque actuation.
    """

    time: NonNegative
    value: float


Names = Annotated[list[str], Len(2, 2)]
ForAll = float | dict[str, float]
"""One value for all, or name -> value."""
Bounds = Literal[False] | float | dict[str, Literal[False] | float]
"""Likewise; false means none."""


class RobotSection(Section):
    """A robot, from the URDF file at `path`, or a known one by its name `model`.

    Its fields are the arguments of `Robot.load`. With a `trajectory` its base is kinematic and
    starts at `pose` at time 0. Joints without a trajectory hold.
    """

    name: str
    path: str | None = None
    model: Literal["gripper", "panda"] | None = None
    mesh_root: str | None = None
    base: Literal["fixed", "kinematic", "floating"] = "fixed"
    pose: PoseSection = PoseSection()
    joint_positions: ForAll | None = None
    actuation: Actuation | dict[str, Actuation] | None = None
    stiffness: ForAll | None = None
    damping: ForAll | None = None
    effort_limits: Bounds | None = None
    velocity_limits: Bounds | None = None
    joint_friction: Bounds | None = None
    friction: ForAll | None = None
    thickness: ForAll | None = None
    edge_length: Positive | None = None
    smooth: bool | dict[str, bool] = False
    ignore_contact: list[Names] | Literal["overlapping"] = []
    trajectory: list[PoseKeyframe] = []
    joint_trajectories: dict[str, Annotated[list[JointKeyframe], Len(1)]] = {}
    color: Color | None = None

    @model_validator(mode="after")
    def _check_robot(self) -> RobotSection:
        require_one(self, ("path", "model"))
        if self.mesh_root is not None and self.path is None:
            raise ValueError("has a `mesh_root` and must have a `path` for it")
        require_increasing("trajectory", [frame.time for frame in self.trajectory])
        if self.trajectory and self.base != "kinematic":
            raise ValueError("has a `trajectory` and must have `base: kinematic` for it")
        for name, keyframes in self.joint_trajectories.items():
            require_increasing(f"joint_trajectories.{name}", [frame.time for frame in keyframes])
        return self


class EndSection(Section):
    """Points of an attachment: selected vertices of a cloth, or `points` in a body's frame [m].

    The `surface` is the name of a cloth or body, or robot/link.
    """

    surface: str
    vertices: Annotated[list[Annotated[int, Ge(0)]], Len(1)] | None = None
    box: BoxSelection | None = None
    nearest: Annotated[list[Vector3], Len(1)] | None = None
    points: Annotated[list[Vector3], Len(1)] | None = None

    @model_validator(mode="after")
    def _check_one(self) -> EndSection:
        require_one(self, ("vertices", "box", "nearest", "points"))
        return self

    def selection(self) -> Selection:
        """The selection of vertices of a cloth."""
        return Selection(vertices=self.vertices, box=self.box, nearest=self.nearest)


class WeightKeyframe(JointKeyframe):
    """Weight of an attachment at a time [s], between 0 (released) and 1."""

    value: Annotated[float, Ge(0), Le(1)]


class AttachmentSection(Section):
    """Springs between two ends, or between `a` and targets, as in `Attachment`.

    Without `b` there are targets; they start at the points of `a` and move by `target_trajectory`.
    Weights are one outside of `weight_trajectory`.
    """

    name: str
    a: EndSection
    b: EndSection | None = None
    stiffness: Positive
    rest_length: NonNegative = 0.0
    target_trajectory: list[PinKeyframe] = []
    weight_trajectory: list[WeightKeyframe] = []

    @model_validator(mode="after")
    def _check_trajectories(self) -> AttachmentSection:
        if self.b is not None and self.target_trajectory:
            raise ValueError("has `b` and must have no `target_trajectory`")
        if self.b is None and "/" in self.a.surface:
            raise ValueError("must have `b`, as `a` is on a link")
        require_increasing("target_trajectory", [frame.time for frame in self.target_trajectory])
        require_increasing("weight_trajectory", [frame.time for frame in self.weight_trajectory])
        return self


class AirSection(Section):
    """Density of the air [kg/m^3], and its steady velocity [m/s], for cloths with drag."""

    density: Annotated[float, limits("air_density")] | None = None
    wind: Vector3 | None = None


class SceneSection(Section):
    """Cloths, bodies, robots, gravity, air. Without cloths, a body or a robot must be dynamic."""

    gravity: Vector3 | None = None
    air: AirSection = AirSection()
    cloths: list[ClothSection] = []
    bodies: list[BodySection] = []
    robots: list[RobotSection] = []
    attachments: list[AttachmentSection] = []
    ignore_contact: list[Names] | Literal["overlapping"] = []

    @model_validator(mode="after")
    def _check_cloths(self) -> SceneSection:
        if not (self.cloths or self.robots or any(b.motion == "dynamic" for b in self.bodies)):
            raise ValueError("must have a cloth in `cloths` unless a body or a robot is dynamic")
        if self.air.wind is not None and not self.cloths:
            raise ValueError("has `air.wind` and must have a cloth in `cloths` that feels it")
        return self
