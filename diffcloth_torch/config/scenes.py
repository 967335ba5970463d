"""The scene, the simulator and the prescribed motion of a configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import cpu, fabrics, robots
from diffcloth_torch.config import shapes
from diffcloth_torch.config.attachments import attachment, attachment_motions
from diffcloth_torch.config.documents import resolve_path, resolve_relative
from diffcloth_torch.config.keyframes import moved, quaternion, select_vertices, values_at
from diffcloth_torch.config.scene_schema import (
    BodySection,
    ClothSection,
    MaterialSection,
    RobotSection,
)
from diffcloth_torch.config.schema import RunConfig, SimulationSection
from diffcloth_torch.config.section import Section
from diffcloth_torch.config.shape_schema import PoseSection
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.meshes import read_file_mesh, read_mesh
from diffcloth_torch.geometry.poses import transform
from diffcloth_torch.geometry.rotation import interpolate_poses
from diffcloth_torch.geometry.shapes import strip
from diffcloth_torch.geometry.texture import flat_rest_mesh
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.options import ContactOptions, SolverOptions
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.model.robot import Robot
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.records.controls import Control
from diffcloth_torch.sim.simulator import Simulator

__all__ = [
    "Motions",
    "PerStep",
    "Trajectories",
    "build_scene",
    "build_simulator",
    "pose_array",
    "prescribed_motions",
    "prescribed_poses",
    "quaternion",
    "select_vertices",
    "steady_wind",
    "step_control",
]


def build_scene(config: RunConfig, source: Path) -> Scene:
    """Make the scene of a configuration that was read from the file `source`."""
    _require_unique_names(config)
    cloths = [_cloth(section, config.root, source) for section in config.scene.cloths]
    bodies = [_body(section, config.root, source) for section in config.scene.bodies]
    robots = [_robot(section, config.root, source) for section in config.scene.robots]
    options = config.scene.model_dump(include={"gravity", "ignore_contact"}, exclude_none=True)
    if config.scene.air.density is not None:
        options["air_density"] = config.scene.air.density
    attachments = [attachment(section, cloths) for section in config.scene.attachments]
    return Scene(cloths, bodies, robots, attachments=attachments, **options)


def build_simulator(scene: Scene, section: SimulationSection) -> Simulator:
    """Make the simulator of a scene; options that the configuration leaves out have defaults."""
    return Simulator(
        scene,
        section.dt,
        scheme=section.scheme,
        coupling=section.coupling,
        integrator=section.integrator,
        contact=ContactOptions(**_given(section.contact)),
        solver=SolverOptions(**_given(section.solver)),
    )


def _given(section: Section) -> dict[str, Any]:
    return section.model_dump(exclude_none=True)


def _require_unique_names(config: RunConfig) -> None:
    names = [cloth.name for cloth in config.scene.cloths]
    names += [body.name for body in config.scene.bodies]
    names += [robot.name for robot in config.scene.robots]
    for name in names:
        if names.count(name) > 1:
            raise InvalidInput(f"`scene`: the name {name!r} must be given once, got it twice")


def pose_array(section: PoseSection) -> NDArray[np.float64]:
    """Pose [px, py, pz, qw, qx, qy, qz] of a section."""
    return np.concatenate([section.position, quaternion(section)])


def _cloth(section: ClothSection, root: str, source: Path) -> Cloth:
    shape = section.shape
    rest: NDArray[np.float64]
    faces: NDArray[np.integer[Any]]
    rest_faces: NDArray[np.integer[Any]] | None = None
    if shape.kind == "grid":
        sheet = Cloth.grid((shape.columns, shape.rows), shape.size)
        rest, faces = sheet.vertices, sheet.faces
        start = rest
    elif shape.kind == "disk":
        rest, start, faces = _generated(section.name, shapes.disk, _given(shape))
    elif shape.kind == "strip":
        rest, start, faces = _generated(section.name, strip, _given(shape))
    else:
        path = resolve_path(source, root, shape.path)
        start, faces, texture = read_file_mesh(path, f"{section.name}: `path`")
        start = rest = shape.scale * start
        if shape.rest == "uv" and shape.rest_scale is not None:
            rest, rest_faces = flat_rest_mesh(f"{path}", faces, texture, shape.rest_scale)
        elif shape.rest is not None:
            other = resolve_path(source, root, shape.rest)
            rest = shape.scale * read_mesh(other, f"{section.name}: `rest`")[0]
    vertices = transform(start, pose_array(section.pose))
    options: dict[str, Any] = section.model_dump(
        include={"pin_stiffness", "bending_model", "directions"}, exclude_none=True
    )
    for kind in ("pins", "soft_pins"):
        options[kind] = {
            name: select_vertices(f"{section.name}.{kind}.{name}", selection, vertices)
            for name, selection in getattr(section, kind).items()
        }
    return Cloth(
        vertices,
        faces,
        material=_material(section.material),
        rest_positions=rest,
        rest_faces=rest_faces,
        name=section.name,
        **options,
    )


def _material(section: MaterialSection) -> Material:
    values = _given(section)
    fabric = values.pop("fabric", None)
    return Material(**values) if fabric is None else fabrics.material(fabric, **values)


def _generated(name: str, generate: Any, arguments: dict[str, Any]) -> Any:
    del arguments["kind"]
    try:
        return generate(**arguments)
    except ValueError as error:
        raise InvalidInput(f"`scene`: the shape of {name!r} cannot be made: {error}") from error


def _body(section: BodySection, root: str, source: Path) -> RigidBody:
    shape = section.shape
    keywords = {
        "motion": section.motion,
        "pose": pose_array(section.pose),
        "name": section.name,
        **section.model_dump(include=_BODY_OPTIONS, exclude_none=True),
    }
    if shape.kind == "load":
        path = resolve_path(source, root, shape.path)
        return RigidBody.load(path, scale=shape.scale, **keywords)
    if shape.kind == "chair":
        return RigidBody(*_generated(section.name, shapes.chair, _given(shape)), **keywords)
    arguments = _given(shape)
    del arguments["kind"]
    return _MAKERS[shape.kind](**arguments, **keywords)


_BODY_OPTIONS = {
    "friction",
    "thickness",
    "density",
    "mass",
    "center",
    "inertia",
    "nodal_contact",
}
_MAKERS: dict[str, Callable[..., RigidBody]] = {
    "box": RigidBody.box,
    "sphere": RigidBody.sphere,
    "capsule": RigidBody.capsule,
    "cylinder": RigidBody.cylinder,
    "plane": RigidBody.plane,
}


def _robot(section: RobotSection, root: str, source: Path) -> Robot:
    path, mesh_root = _robot_file(section, root, source)
    return Robot.load(
        path,
        mesh_root=mesh_root,
        pose=pose_array(section.pose),
        **section.model_dump(include=_ROBOT_OPTIONS, exclude_none=True),
    )


def _robot_file(section: RobotSection, root: str, source: Path) -> tuple[Path, Path | None]:
    """The file of a robot, and the folder that must contain its meshes; None for any folder."""
    if section.model is not None:
        return robots.panda() if section.model == "panda" else (robots.GRIPPER, None)
    assert section.path is not None  # the schema requires one of the two
    path = resolve_path(source, root, section.path)
    allowed = resolve_relative(source, root)
    if section.mesh_root is None:
        return path, allowed
    folder = resolve_relative(source, section.mesh_root)
    if not folder.is_relative_to(allowed):
        raise InvalidInput(
            f"{source}: the folder {section.mesh_root!r} must lie under the root {str(allowed)!r}"
        )
    return path, folder


_ROBOT_OPTIONS = {
    "base",
    "joint_positions",
    "actuation",
    "stiffness",
    "damping",
    "effort_limits",
    "velocity_limits",
    "joint_friction",
    "friction",
    "thickness",
    "edge_length",
    "smooth",
    "ignore_contact",
    "name",
}


# --- prescribed motion --------------------------------------------------------------------------


def prescribed_poses(section: BodySection | RobotSection, dt: float, steps: int) -> Tensor:
    """Poses of a body, or of the base of a robot, after each step, shape [steps, 7]."""
    keyframes = [(0.0, pose_array(section.pose))]
    if section.trajectory and section.trajectory[0].time == 0:
        keyframes = []
    keyframes += [(keyframe.time, pose_array(keyframe)) for keyframe in section.trajectory]
    return interpolate_poses(
        cpu.tensor([time for time, _ in keyframes]),
        cpu.tensor(np.array([pose for _, pose in keyframes])),
        _step_times(dt, steps),
    )


class PerStep(Protocol):
    """Values after each step: a tensor of all of them, or an object that makes them on request."""

    def __getitem__(self, k: int, /) -> Tensor:
        """Return the values of step k."""
        ...


Motions = dict[str, dict[str, PerStep]]
"""Field of a control -> name -> values after each step."""


Trajectories = dict[str, dict[str, Tensor]]
"""Motions known from the start, shape [steps, ..]."""


def prescribed_motions(config: RunConfig, scene: Scene, steps: int) -> Trajectories:
    """Prescribed motions of pins, bodies, bases, joints and attachments with trajectories."""
    dt = config.simulation.dt
    poses: Trajectories = {"body_poses": {}, "base_poses": {}}
    for body in config.scene.bodies:
        if body.trajectory:
            poses["body_poses"][body.name] = prescribed_poses(body, dt, steps)
    for robot in config.scene.robots:
        if robot.trajectory:
            poses["base_poses"][robot.name] = prescribed_poses(robot, dt, steps)
    times = _step_times(dt, steps)
    motions = _pin_motions(config, scene, times) | poses | _joint_motions(config, scene, times)
    return motions | attachment_motions(config.scene.attachments, scene, times)


def steady_wind(config: RunConfig) -> Tensor | None:
    """Velocity of the air in every step, shape [3]."""
    wind = config.scene.air.wind
    return None if wind is None else cpu.tensor(wind)


def step_control(
    motions: Mapping[str, Mapping[str, PerStep]], k: int, wind: Tensor | None
) -> Control:
    """Return the control of step k from motions of all steps, and from the wind."""
    fields: dict[str, Any] = {
        field: {name: values[k] for name, values in named.items()}
        for field, named in motions.items()
        if named
    }
    return Control(**fields, wind=wind)


def _pin_motions(config: RunConfig, scene: Scene, times: Tensor) -> Trajectories:
    motions: Trajectories = {"pins": {}, "soft_pins": {}}
    for section, cloth in zip(config.scene.cloths, scene.cloths, strict=True):
        for name, keyframes in section.pin_trajectories.items():
            field = "pins" if name in cloth.pins else "soft_pins"
            start = cpu.tensor(cloth.vertices[getattr(cloth, field)[name]])
            motions[field][f"{section.name}/{name}"] = moved(start, keyframes, times)
    return motions


def _joint_motions(config: RunConfig, scene: Scene, times: Tensor) -> Trajectories:
    motions: Trajectories = {field: {} for field in _JOINT_FIELDS.values()}
    for section, robot in zip(config.scene.robots, scene.robots, strict=True):
        for name, keyframes in section.joint_trajectories.items():
            field, start = _joint_field(section.name, name, robot)
            values = values_at(keyframes, start, times)
            motions[field][f"{section.name}/{name}"] = values
    return motions


_JOINT_FIELDS = {
    "position": "joint_positions",
    "pd": "joint_positions",
    "velocity": "joint_velocities",
    "torque": "joint_efforts",
}


def _joint_field(robot_name: str, joint: str, robot: Robot) -> tuple[str, float]:
    """Field of a control that a joint's trajectory sets, and the value at its start."""
    names = robot.joint_names
    if joint not in names:
        raise InvalidInput(
            f"`scene.robots`: `joint_trajectories` of {robot_name!r} may name its joints "
            f"{', '.join(map(repr, names)) or 'none, it has none'}; got {joint!r}"
        )
    index = names.index(joint)
    field = _JOINT_FIELDS[robot.mechanism.actuation[index]]
    return field, float(robot.joint_positions[index]) if field == "joint_positions" else 0.0


def _step_times(dt: float, steps: int) -> Tensor:
    return dt * cpu.arange(1, steps + 1, dtype=torch.float64)
