"""Tasks whose scenes are built from the options that all eleven tasks have."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import ArrayLike, check_choice, check_count
from diffcloth_torch.envs.actuators import Actuator
from diffcloth_torch.envs.depth_camera import DepthCamera, Sight
from diffcloth_torch.envs.env import EnvState, Task
from diffcloth_torch.envs.frames import points_in, poses_in
from diffcloth_torch.envs.key_points import KeyPoints
from diffcloth_torch.envs.randomization import Ranges
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.options import ContactOptions, SolverOptions
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.simulator import Simulator

__all__ = ["DT", "BuiltTask", "with_material"]

DT = 0.02  # [s]
OF_CAMERA = ("depth", "points")
OBSERVATIONS = ("keypoints", "particles", *OF_CAMERA)


class BuiltTask(Task):
    """A task that builds its scene; subclasses define `build`.

    Attributes:
        side: Number of vertices along a side of a sheet.
        sees: "keypoints", "particles", "depth" or "points": how the cloth is observed.
        seen: Points of the cloth that are observed without a camera.
        camera: The camera of "depth" and "points"; None with the others.
        view: The camera of the task, unless another is passed; a task may have none.
        of_cloth: Names of the features that are known from the vertices of cloths alone: "depth"
            and "points" are observed in their place.
    """

    steps: ClassVar[int]  # default number of transitions of an episode
    view: ClassVar[DepthCamera | None] = None
    of_cloth: ClassVar[tuple[str, ...]] = ("positions", "velocities", "contact_forces")

    def __init__(
        self,
        *,
        size: int = 12,
        horizon: int | None = None,
        substeps: int = 2,
        observation: str = "keypoints",
        camera: DepthCamera | None = None,
        material: Material | None = None,
        contact: ContactOptions | None = None,
        solver: SolverOptions | None = None,
        integrator: str = "implicit_euler",
        frame: str = "task",
        randomize: Ranges = False,
    ) -> None:
        """Build the scene.

        Args:
            size: Vertices along a side of a sheet, >= 4.
            horizon: Transitions of an episode; by default a fifth more than the script needs.
            substeps: Time steps of a transition, of .02 s each.
            observation: Observation of the cloth: "keypoints" for material points that do not
                depend on the size, "particles" for all vertices, "depth" for an image or "points"
                for a point cloud of a depth camera.
            camera: Camera of "depth" and "points"; None means the camera of the task.
            material: Material of the cloths; None means the material of the task.
            contact: Options of contact; None means the options of the task.
            solver: Options of the solver; a step that fails never raises here.
            integrator: As for `Simulator`.
            frame: Axes of observations and actions: "task", fixed at the start of an episode, or
                "world".
            randomize: Whether to draw physical parameters at each start, or their ranges by name:
                "stretch", "bending", "density", "friction", "drag", "mass", and "scale", the scale
                of the sheet, in tasks with a sheet on a table.
        """
        owner = operation(self.name)
        self.side = check_count(f"{owner}: `size`", size, 4)
        self.sees = check_choice(f"{owner}: `observation`", observation, OBSERVATIONS)
        for name, value, kind in (
            ("material", material, Material),
            ("camera", camera, DepthCamera),
            ("contact", contact, ContactOptions),
            ("solver", solver, SolverOptions),
        ):
            if value is not None and not isinstance(value, kind):
                raise TypeError(
                    f"{owner}: `{name}` must be {kind.__name__} or None, got {type(value).__name__}"
                )
        if camera is not None and self.sees not in OF_CAMERA:
            raise InvalidInput(
                f"{owner}: `camera` must be None with `observation` {self.sees!r}, which is not of "
                "a camera"
            )
        scene, actuator = self.build(material)
        self.seen = self.key_points()
        self.camera, self._sight = None, None
        if self.sees in OF_CAMERA:
            self.camera = self.view if camera is None else camera
            if self.camera is None:
                raise InvalidInput(
                    f"{owner}: `camera` must be a DepthCamera with `observation` {self.sees!r}, as "
                    "the task has none"
                )
            self._sight = Sight(self.camera, scene)
        simulator = Simulator(
            scene,
            DT,
            contact=self.contact() if contact is None else contact,
            solver=replace(SolverOptions() if solver is None else solver, throw=False),
            integrator=integrator,
        )
        super().__init__(
            simulator,
            actuator,
            horizon=self.steps if horizon is None else horizon,
            substeps=substeps,
            frame=frame,
            randomize=randomize,
        )

    @abstractmethod
    def build(self, material: Material | None) -> tuple[Scene, Actuator]:
        """The scene, and its actuator."""

    def key_points(self) -> KeyPoints:
        """Points of the cloth that `features` observe: by default of one square sheet."""
        if self.sees == "particles":
            return KeyPoints.at(cpu.arange(self.side**2))
        return KeyPoints.on_grid((self.side, self.side))

    def contact(self) -> ContactOptions:
        """Options of contact, unless others are given."""
        return ContactOptions()

    def observed(self, env_time: Tensor) -> Tensor:
        """The share of the horizon that has passed, [B, 1]."""
        return env_time.double()[:, None] / self.horizon

    def sensed(self, env: EnvState) -> Mapping[str, Tensor]:
        """Features; with a camera, its view replaces the features of the cloth.

        A depth image [m], by rows, and the pose of the camera [B, 7]; or points [m], one behind the
        other. Pose and points are in the frame of the task.
        """
        features = self.features(env)
        if self._sight is None or self.camera is None:
            return features
        others = {name: f for name, f in features.items() if name not in self.of_cloth}
        if self.sees == "points":
            return {
                "points": points_in(env.drawn, self._sight.points(env.state)).flatten(1)
            } | others
        pose = cpu.tensor(self.camera.pose).expand(len(env), -1)
        depths = self._sight.depths(env.state).flatten(1)
        return {"depth": depths, "camera": poses_in(env.drawn, pose)} | others


def with_material(cloth: Cloth, material: Material | None) -> Cloth:
    """The cloth with another material, if there is one."""
    if material is None:
        return cloth
    pins: Mapping[str, ArrayLike] = dict(cloth.pins)
    return Cloth(
        cloth.vertices,
        cloth.faces,
        material=material,
        pins=pins,
        soft_pins=dict(cloth.soft_pins),
        pin_stiffness=cloth.pin_stiffness,
        rest_positions=cloth.rest_positions,
        rest_faces=cloth.rest_faces,
        bending_model=cloth.bending_model,
        name=cloth.name,
        directions=cloth.directions if material.is_orthotropic else None,
    )
