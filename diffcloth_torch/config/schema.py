"""The schema of configurations, against which files are checked before anything runs."""

from __future__ import annotations

import difflib
import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeAlias

from annotated_types import Ge, Gt, Interval, Le, Len, Lt
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    create_model,
    model_validator,
)

from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.options import COUPLINGS, ELASTIC_SOLVERS, METRICS, SCHEMES
from diffcloth_torch.model.quantities import PARAMETERS
from diffcloth_torch.viewers.look import Camera, Pictures

__all__ = [
    "BodySection",
    "BoxSelection",
    "ClothSection",
    "ContactSection",
    "JointKeyframe",
    "MaterialSection",
    "MeshFile",
    "OutputSection",
    "PictureSection",
    "PoseSection",
    "Positive",
    "RobotSection",
    "RotationSection",
    "RunConfig",
    "SceneSection",
    "Section",
    "Selection",
    "SimulationSection",
    "SolverSection",
    "Vector3",
]

Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]
Vector3 = Annotated[list[float], Len(3, 3)]
Actuation = Literal["position", "velocity", "torque", "pd"]
if TYPE_CHECKING:
    Scheme: TypeAlias = str
    Metric: TypeAlias = str
    ElasticSolver: TypeAlias = str
    Coupling: TypeAlias = str
else:
    Scheme, Metric = Literal[SCHEMES], Literal[METRICS]
    ElasticSolver, Coupling = Literal[ELASTIC_SOLVERS], Literal[COUPLINGS]
Lengths2 = Positive | Annotated[list[Positive], Len(2, 2)]
Lengths3 = Positive | Annotated[list[Positive], Len(3, 3)]


def _limits(parameter: str) -> Interval:
    """Range of a parameter's values, as a configuration's schema has it."""
    accepted = PARAMETERS[parameter].accepted
    low = None if math.isinf(accepted.low) else accepted.low
    high = None if math.isinf(accepted.high) else accepted.high
    return Interval(ge=low, le=high) if accepted.closed else Interval(gt=low, lt=high)


Color = Annotated[str, Field(pattern="^#[0-9a-fA-F]{6}$")]
"""A color as "#rrggbb"."""


class Section(BaseModel):
    """A mapping of a configuration; unknown keys are refused."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, protected_namespaces=()
    )

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, given: Any) -> Any:
        if not isinstance(given, Mapping):
            return given
        for key in given:
            if key not in cls.model_fields:
                close = difflib.get_close_matches(str(key), cls.model_fields, n=1)
                hint = f" (did you mean `{close[0]}`?)" if close else ""
                accepted = ", ".join(cls.model_fields)
                raise ValueError(f"has no key `{key}`{hint}; its keys are {accepted}")
        return given


# --- shapes and poses ---------------------------------------------------------------------------


class RotationSection(Section):
    """A rotation: `degrees` about `axis`, or a `quaternion` (w, x, y, z); none by default."""

    axis: Vector3 | None = None
    degrees: float | None = None
    quaternion: Annotated[list[float], Len(4, 4)] | None = None

    @model_validator(mode="after")
    def _check_rotation(self) -> RotationSection:
        if (self.axis is None) != (self.degrees is None):
            raise ValueError("must give `axis` and `degrees` together")
        if self.axis is not None and self.quaternion is not None:
            raise ValueError("must give `axis` and `degrees`, or `quaternion`, not both")
        for name in ("axis", "quaternion"):
            value = getattr(self, name)
            if value is not None and not any(value):
                raise ValueError(f"must have an `{name}` that is not zero")
        return self


class PoseSection(RotationSection):
    """A pose: a rotation about the origin, then a translation to `position` [m]."""

    position: Vector3 = [0.0, 0.0, 0.0]


class PoseKeyframe(PoseSection):
    """Pose of a body at a time [s]."""

    time: NonNegative


class PinKeyframe(RotationSection):
    """Motion of pins at a time [s], relative to their start.

    A rotation about the mean of their starting positions, then a translation by `displacement` [m].
    """

    time: NonNegative
    displacement: Vector3 = [0.0, 0.0, 0.0]


class MeshFile(Section):
    """A mesh file; `scale` is meters per unit of the file."""

    kind: Literal["load"]
    path: str
    scale: Positive = 1.0


class ClothFile(MeshFile):
    """A mesh file of a cloth, and a second one of its stress-free shape if that differs."""

    rest: str | None = None


class Grid(Section):
    """Rectangle in the xy-plane with `rows` x `columns` vertices; columns run along x."""

    kind: Literal["grid"]
    rows: Annotated[int, Ge(2)]
    columns: Annotated[int, Ge(2)]
    size: Lengths2 = 1.0


class Disk(Section):
    """Round sheet in the xy-plane on an unstructured mesh with edges of about `edge_length` [m]."""

    kind: Literal["disk"]
    radius: Positive
    edge_length: Positive


class Strip(Section):
    """Strip along x, bent downwards by `bend` degrees about an axis along y, at the origin.

    Its `width` [m] is one number, or one for each of its two ends. The middle of the bend is at the
    fraction `middle` of its length.
    """

    kind: Literal["strip"]
    length: Positive
    width: Lengths2
    rows: Annotated[int, Ge(2)]
    columns: Annotated[int, Ge(2)]
    bend: Annotated[float, Ge(0), Le(180)] = 0.0
    radius: Positive = 0.1
    middle: Annotated[float, Gt(0), Lt(1)] = 0.5


class Box(Section):
    """Cuboid with sides of `size` [m]."""

    kind: Literal["box"]
    size: Lengths3


class Sphere(Section):
    """Sphere."""

    kind: Literal["sphere"]
    radius: Positive
    subdivisions: Annotated[int, Ge(0), Le(6)] = 3


class Capsule(Section):
    """Cylinder along z of `length` [m] with half spheres on its ends."""

    kind: Literal["capsule"]
    radius: Positive
    length: Positive


class Cylinder(Section):
    """Cylinder along z of `length` [m]."""

    kind: Literal["cylinder"]
    radius: Positive
    length: Positive


class Plane(Section):
    """Rectangle at z = 0 that faces up."""

    kind: Literal["plane"]
    size: Lengths2


class Chair(Section):
    """Chair that stands on z = 0 and faces -y; lengths in meters, `height` is that of the seat."""

    kind: Literal["chair"]
    width: Positive = 0.44
    depth: Positive = 0.44
    height: Positive = 0.46
    back_height: Positive = 0.42
    thickness: Positive = 0.04
    edge_length: Positive = 0.12


# --- the scene ----------------------------------------------------------------------------------


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
        _require_one(self, ("vertices", "box", "nearest"))
        return self


_LIMITED: dict[str, Any] = {
    field.name: (Annotated[float, _limits(field.name)] | None, None) for field in fields(Material)
}
_MaterialFields: Any = create_model("_MaterialFields", __base__=Section, **_LIMITED)


class MaterialSection(_MaterialFields):  # type: ignore[misc]  # its fields are those of Material
    """Properties of a cloth, in the units of `Material`, with its defaults."""


class ClothSection(Section):
    """A cloth."""

    name: str
    shape: Annotated[Grid | Disk | Strip | ClothFile, Discriminator("kind")]
    pose: PoseSection = PoseSection()
    material: MaterialSection = MaterialSection()
    pins: dict[str, Selection] = {}
    soft_pins: dict[str, Selection] = {}
    pin_stiffness: Annotated[float, _limits("pin_stiffness")] | None = None
    pin_trajectories: dict[str, Annotated[list[PinKeyframe], Len(1)]] = {}
    bending_model: Literal["patch", "hinge"] | None = None
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
            _require_increasing(f"pin_trajectories.{name}", keyframes)
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
    friction: Annotated[float, _limits("friction")] | None = None
    thickness: Annotated[float, _limits("thickness")] | None = None
    density: Positive | None = None
    mass: Positive | None = None
    center: Vector3 | None = None
    inertia: Annotated[list[Vector3], Len(3, 3)] | None = None
    nodal_contact: bool | None = None
    color: Color | None = None

    @model_validator(mode="after")
    def _check_trajectory(self) -> BodySection:
        _require_increasing("trajectory", self.trajectory)
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


class RobotSection(Section):
    """A robot, from the URDF file at `path`, or a known one by its name `model`.

    Its fields are those of `Robot.load`. With a `trajectory` its base is kinematic and starts at
    `pose` at time 0. Joints without a trajectory hold.
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
    friction: ForAll | None = None
    thickness: ForAll | None = None
    edge_length: Positive | None = None
    ignore_contact: list[Names] = []
    trajectory: list[PoseKeyframe] = []
    joint_trajectories: dict[str, Annotated[list[JointKeyframe], Len(1)]] = {}
    color: Color | None = None

    @model_validator(mode="after")
    def _check_robot(self) -> RobotSection:
        _require_one(self, ("path", "model"))
        if self.mesh_root is not None and self.path is None:
            raise ValueError("has a `mesh_root` and must have a `path` for it")
        _require_increasing("trajectory", self.trajectory)
        if self.trajectory and self.base != "kinematic":
            raise ValueError("has a `trajectory` and must have `base: kinematic` for it")
        for name, keyframes in self.joint_trajectories.items():
            _require_increasing(f"joint_trajectories.{name}", keyframes)
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
        _require_one(self, ("vertices", "box", "nearest", "points"))
        return self

    def selection(self) -> Selection:
        """What is selected of a cloth."""
        return Selection(vertices=self.vertices, box=self.box, nearest=self.nearest)


class WeightKeyframe(JointKeyframe):
    """Weight of an attachment at a time [s], between 0 (released) and 1."""

    value: Annotated[float, Ge(0), Le(1)]


class AttachmentSection(Section):
    """Springs between two ends, or between `a` and targets, as in `Attachment`.

    Without `b` there are targets; they start where `a` is and move by `target_trajectory`. Weights
    are one where `weight_trajectory` says nothing.
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
        _require_increasing("target_trajectory", self.target_trajectory)
        _require_increasing("weight_trajectory", self.weight_trajectory)
        return self


class SceneSection(Section):
    """Cloths, bodies, robots and gravity. Without cloths, a body or a robot must be dynamic."""

    gravity: Vector3 | None = None
    cloths: list[ClothSection] = []
    bodies: list[BodySection] = []
    robots: list[RobotSection] = []
    attachments: list[AttachmentSection] = []
    ignore_contact: list[Names] = []

    @model_validator(mode="after")
    def _check_cloths(self) -> SceneSection:
        if not (self.cloths or self.robots or any(b.motion == "dynamic" for b in self.bodies)):
            raise ValueError("must have a cloth in `cloths` unless a body or a robot is dynamic")
        return self


# --- the run ------------------------------------------------------------------------------------


class ContactSection(Section):
    """Options of contact, as in `ContactOptions`."""

    barrier_distance: Annotated[float, _limits("barrier_distance")] | None = None
    barrier_stiffness: Annotated[float, _limits("barrier_stiffness")] | None = None
    friction_iterations: Annotated[int, Ge(1)] | None = None
    slip_velocity: Annotated[float, _limits("slip_velocity")] | None = None
    self_contact: bool | None = None


class SolverSection(Section):
    """Options of the solver, as in `SolverOptions`."""

    tolerance: Positive | None = None
    max_iterations: Annotated[int, Ge(1)] | None = None
    throw: bool | None = None
    metric: Metric | None = None
    elastic: ElasticSolver | None = None


class SimulationSection(Section):
    """Time step [s], number of steps, scheme and options."""

    dt: Positive
    steps: Annotated[int, Ge(1)]
    scheme: Scheme = SCHEMES[0]
    coupling: Coupling = COUPLINGS[0]
    contact: ContactSection = ContactSection()
    solver: SolverSection = SolverSection()


class CameraSection(Section):
    """View of the pictures, as in `Camera`."""

    azimuth: float = Camera.azimuth
    elevation: Annotated[float, Gt(-90), Lt(90)] = Camera.elevation
    zoom: Positive = Camera.zoom
    target: Vector3 | None = None
    distance: Positive | None = None
    position: Vector3 | None = None
    up: Vector3 = list(Camera.up)
    field_of_view: Annotated[float, Gt(0), Lt(180)] = Camera.field_of_view


class PictureSection(Section):
    """Pictures and the animation, as in `Pictures`; `size` is divisible by 2 for the video."""

    size: Annotated[list[Annotated[int, Ge(64), Le(4096)]], Len(2, 2)] = list(Pictures.size)
    fps: Annotated[float, Gt(0), Le(240)] | None = None
    video: Literal["mp4", "gif", "none"] = Pictures.video
    frames: bool = Pictures.frames
    sheet: Annotated[int, Ge(0), Le(12)] = Pictures.sheet
    labels: bool = Pictures.labels
    contact_forces: bool = Pictures.contact_forces
    ground: float | Literal["auto"] | None = Pictures.ground
    camera: CameraSection = CameraSection()

    @model_validator(mode="after")
    def _check_even(self) -> PictureSection:
        if any(length % 2 for length in self.size):
            raise ValueError(f"must have a `size` of two even numbers, got {self.size}")
        return self


class OutputSection(Section):
    """Output of a run: a frame for each of the `viewers` after `every` so many steps."""

    viewers: list[Literal["record", "meshes", "web"]] = ["record", "meshes"]
    every: Annotated[int, Ge(1)] = 1
    pictures: PictureSection = PictureSection()


class RunConfig(Section):
    """The keys that every configuration has.

    `root` is the folder, relative to the configuration, that mesh files must lie under; by
    default the folder of the configuration. Tasks add keys of their own.
    """

    task: str
    root: str = "."
    simulation: SimulationSection
    scene: SceneSection
    output: OutputSection = OutputSection()


def _require_one(section: Section, names: Iterable[str]) -> None:
    given = [name for name in names if getattr(section, name) is not None]
    if len(given) != 1:
        raise ValueError(
            f"must have exactly one of {', '.join(names)}, got {', '.join(given) or 'none'}"
        )


def _require_increasing(
    name: str, keyframes: Iterable[PoseKeyframe | PinKeyframe | JointKeyframe]
) -> None:
    times = [keyframe.time for keyframe in keyframes]
    if any(b <= a for a, b in itertools.pairwise(times)):
        raise ValueError(f"must have increasing times in `{name}`, got {times}")
