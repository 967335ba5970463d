"""The schema of configurations; files are checked against it before anything runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from annotated_types import Ge, Gt, Le, Len, Lt
from pydantic import model_validator

from diffcloth_torch.config.scene_schema import SceneSection
from diffcloth_torch.config.section import (
    Count,
    Positive,
    Section,
    Updates,
    Vector3,
    limits,
)
from diffcloth_torch.model.options import (
    CERTIFY,
    COUPLINGS,
    ELASTIC_SOLVERS,
    INTEGRATORS,
    METRICS,
    SCHEMES,
)
from diffcloth_torch.viewers.look import Camera, Pictures

__all__ = [
    "CameraSection",
    "ContactSection",
    "OptimizerSection",
    "OutputSection",
    "PictureSection",
    "RunConfig",
    "SimulationSection",
    "SolverSection",
]

if TYPE_CHECKING:
    Scheme: TypeAlias = str
    Metric: TypeAlias = str
    ElasticSolver: TypeAlias = str
    Certify: TypeAlias = str
    Integrator: TypeAlias = str
    Coupling: TypeAlias = str
else:
    Scheme, Metric = Literal[SCHEMES], Literal[METRICS]
    ElasticSolver, Coupling = Literal[ELASTIC_SOLVERS], Literal[COUPLINGS]
    Certify, Integrator = Literal[CERTIFY], Literal[INTEGRATORS]


class ContactSection(Section):
    """Options of contact, as in `ContactOptions`."""

    barrier_distance: Annotated[float, limits("barrier_distance")] | None = None
    barrier_stiffness: Annotated[float, limits("barrier_stiffness")] | None = None
    friction_iterations: Count | None = None
    slip_velocity: Annotated[float, limits("slip_velocity")] | None = None
    self_contact: bool | None = None


class SolverSection(Section):
    """Options of the solver, as in `SolverOptions`."""

    tolerance: Positive | None = None
    max_iterations: Count | None = None
    max_seconds: Positive | None = None
    throw: bool | None = None
    metric: Metric | None = None
    elastic: ElasticSolver | None = None
    certify: Certify | None = None


class SimulationSection(Section):
    """Time step [s], number of steps, scheme and options."""

    dt: Positive
    steps: Count
    scheme: Scheme = SCHEMES[0]
    coupling: Coupling = COUPLINGS[0]
    integrator: Integrator = INTEGRATORS[0]
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
    """Output of a run: a frame for each of the `viewers` after every `every` steps."""

    viewers: list[Literal["record", "meshes", "web"]] = ["record", "meshes"]
    every: Count = 1
    pictures: PictureSection = PictureSection()


class OptimizerSection(Section):
    """Stochastic gradient descent.

    `learning_rates` has one entry for each tensor of actions. `clip` limits the norm of the
    gradient of each tensor; by default nothing is clipped. With `restart`, momentum is reset to
    zero whenever the loss has risen, so that it does not swing across a narrow valley. `failures`
    is the number of successive attempts that may fail. `stop_below` is the loss below which the
    loop ends.
    """

    iterations: Updates
    learning_rates: dict[str, Annotated[float, Gt(0)]]
    momentum: Annotated[float, Ge(0), Lt(1)] = 0.0
    nesterov: bool = False
    restart: bool = False
    clip: Positive | None = None
    failures: Annotated[int, Ge(0), Le(10**7)] = 6
    checkpoint_every: Count | None = None
    stop_below: Positive | None = None


class RunConfig(Section):
    """The keys that every configuration has.

    `root` is the folder, relative to the configuration, that must contain mesh files; by default
    the folder of the configuration. Tasks add keys of their own.
    """

    task: str
    root: str = "."
    simulation: SimulationSection
    scene: SceneSection
    output: OutputSection = OutputSection()
