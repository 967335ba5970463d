"""From a configuration to a scene, a simulator and the motion that the configuration prescribes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import robots
from diffcloth_torch.config import shapes
from diffcloth_torch.config.documents import resolve_path
from diffcloth_torch.config.schema import (
    BodySection,
    ClothSection,
    JointKeyframe,
    PinKeyframe,
    PoseSection,
    RobotSection,
    RotationSection,
    RunConfig,
    Section,
    Selection,
    SimulationSection,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.meshes import read_mesh
from diffcloth_torch.geometry.poses import transform
from diffcloth_torch.geometry.rotation import interpolate_poses, rotate
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.options import ContactOptions, SolverOptions
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.model.robot import Robot
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.controls import Control
from diffcloth_torch.sim.simulator import Simulator

__all__ = [
    "Motions",
    "build_scene",
    "build_simulator",
    "pose_array",
    "prescribed_motions",
    "prescribed_poses",
    "quaternion",
    "select_vertices",
    "step_controls",
]


def build_scene(config: RunConfig, source: Path) -> Scene:
    """Make the cloths and bodies of a configuration that was read from the file `source`."""
    _require_unique_names(config)
    cloths = [_cloth(section, config.root, source) for section in config.scene.cloths]
    bodies = [_body(section, config.root, source) for section in config.scene.bodies]
    robots = [_robot(section, config.root, source) for section in config.scene.robots]
    options = config.scene.model_dump(include={"gravity", "ignore_contact"}, exclude_none=True)
    return Scene(cloths, bodies, robots, **options)


def build_simulator(scene: Scene, section: SimulationSection) -> Simulator:
    """Make the simulator of a scene; what the configuration leaves out takes its default."""
    return Simulator(
        scene,
        section.dt,
        scheme=section.scheme,
        coupling=section.coupling,
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


def quaternion(section: RotationSection) -> NDArray[np.float64]:
    """Unit quaternion (w, x, y, z) of a rotation."""
    if section.axis is not None and section.degrees is not None:
        half = np.radians(section.degrees) / 2
        axis = np.array(section.axis) / np.linalg.norm(section.axis)
        return np.concatenate([[np.cos(half)], np.sin(half) * axis])
    given = np.array(section.quaternion or [1.0, 0.0, 0.0, 0.0])
    unit: NDArray[np.float64] = given / np.linalg.norm(given)
    return unit


def pose_array(section: PoseSection) -> NDArray[np.float64]:
    """Pose [px, py, pz, qw, qx, qy, qz] of a section."""
    return np.concatenate([section.position, quaternion(section)])


def _cloth(section: ClothSection, root: str, source: Path) -> Cloth:
    shape = section.shape
    rest: NDArray[np.float64]
    faces: NDArray[np.integer[Any]]
    if shape.kind == "grid":
        sheet = Cloth.grid(shape.rows, shape.columns, shape.size)
        rest, faces = sheet.vertices, sheet.faces
        start = rest
    elif shape.kind == "disk":
        rest, faces = _generated(section.name, shapes.disk, _given(shape))
        start = rest
    elif shape.kind == "strip":
        rest, start, faces = _generated(section.name, shapes.strip, _given(shape))
    else:
        start, faces = read_mesh(resolve_path(source, root, shape.path))
        start = rest = shape.scale * start
        if shape.rest is not None:
            rest = shape.scale * read_mesh(resolve_path(source, root, shape.rest))[0]
    vertices = transform(start, pose_array(section.pose))
    options: dict[str, Any] = section.model_dump(
        include={"pin_stiffness", "bending_model"}, exclude_none=True
    )
    for kind in ("pins", "soft_pins"):
        options[kind] = {
            name: select_vertices(f"{section.name}.{kind}.{name}", selection, vertices)
            for name, selection in getattr(section, kind).items()
        }
    return Cloth(
        vertices,
        faces,
        material=Material(**_given(section.material)),
        rest_vertices=rest,
        name=section.name,
        **options,
    )


def _generated(name: str, generate: Any, arguments: dict[str, Any]) -> Any:
    del arguments["kind"]
    try:
        return generate(**arguments)
    except ValueError as error:
        raise InvalidInput(f"`scene`: the shape of {name!r} cannot be made: {error}") from error


def select_vertices(
    name: str, selection: Selection, vertices: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Vertices that a selection names, in increasing order but for a list, which keeps its own."""
    if selection.vertices is not None:
        return np.array(selection.vertices)
    if selection.nearest is not None:
        points = np.array(selection.nearest)
        distances = np.linalg.norm(vertices[None] - points[:, None], axis=-1)
        return np.unique(distances.argmin(axis=1))
    box = selection.box
    assert box is not None  # the schema requires one of the three
    inside = (vertices >= box.lower) & (vertices <= box.upper)
    chosen = np.flatnonzero(inside.all(axis=1))
    if chosen.size == 0:
        low, high = vertices.min(axis=0).round(4), vertices.max(axis=0).round(4)
        raise InvalidInput(
            f"the box of {name} must hold a vertex; the cloth lies between "
            f"{low.tolist()} and {high.tolist()}"
        )
    return chosen


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
    """The file that describes a robot, and the folder of its meshes, None for that of the file."""
    if section.model is not None:
        return robots.panda() if section.model == "panda" else (robots.GRIPPER, None)
    assert section.path is not None  # the schema requires one of the two
    path = resolve_path(source, root, section.path)
    if section.mesh_root is None:
        return path, None
    folder = (source.resolve().parent / section.mesh_root).resolve()
    allowed = (source.resolve().parent / root).resolve()
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
    "friction",
    "thickness",
    "edge_length",
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
        torch.tensor([time for time, _ in keyframes], dtype=torch.float64),
        torch.tensor(np.array([pose for _, pose in keyframes])),
        _step_times(dt, steps),
    )


Motions = dict[str, dict[str, Tensor]]
"""Field of a control -> name -> values after each step."""


def prescribed_motions(config: RunConfig, scene: Scene, steps: int) -> Motions:
    """What pins, bodies, bases and joints that have trajectories do."""
    dt = config.simulation.dt
    poses: Motions = {"body_poses": {}, "base_poses": {}}
    for body in config.scene.bodies:
        if body.trajectory:
            poses["body_poses"][body.name] = prescribed_poses(body, dt, steps)
    for robot in config.scene.robots:
        if robot.trajectory:
            poses["base_poses"][robot.name] = prescribed_poses(robot, dt, steps)
    times = _step_times(dt, steps)
    return _pin_motions(config, scene, times) | poses | _joint_motions(config, scene, times)


def step_controls(motions: Motions, steps: int) -> list[Control]:
    """Controls of each step from what is moved throughout."""
    controls = []
    for k in range(steps):
        fields: dict[str, Any] = {
            field: {name: values[k] for name, values in named.items()}
            for field, named in motions.items()
            if named
        }
        controls.append(Control(**fields))
    return controls


def _pin_motions(config: RunConfig, scene: Scene, times: Tensor) -> Motions:
    motions: Motions = {"pins": {}, "soft_pins": {}}
    for section, cloth in zip(config.scene.cloths, scene.cloths, strict=True):
        for name, keyframes in section.pin_trajectories.items():
            field = "pins" if name in cloth.pins else "soft_pins"
            start = torch.tensor(cloth.vertices[getattr(cloth, field)[name]])
            motions[field][f"{section.name}/{name}"] = _moved(start, keyframes, times)
    return motions


def _joint_motions(config: RunConfig, scene: Scene, times: Tensor) -> Motions:
    motions: Motions = {field: {} for field in _JOINT_FIELDS.values()}
    for section, robot in zip(config.scene.robots, scene.robots, strict=True):
        for name, keyframes in section.joint_trajectories.items():
            field, start = _joint_field(section.name, name, robot)
            values = _joint_values(keyframes, start, times)
            motions[field][f"{section.name}/{name}"] = values
    return motions


_JOINT_FIELDS = {
    "position": "joint_positions",
    "pd": "joint_positions",
    "velocity": "joint_velocities",
    "torque": "joint_efforts",
}


def _joint_field(robot_name: str, joint: str, robot: Robot) -> tuple[str, float]:
    """Field of a control that a joint's trajectory is for, and where it starts."""
    names = robot.joint_names
    if joint not in names:
        raise InvalidInput(
            f"`scene.robots`: `joint_trajectories` of {robot_name!r} may name its joints "
            f"{', '.join(map(repr, names)) or 'none, it has none'}; got {joint!r}"
        )
    index = names.index(joint)
    field = _JOINT_FIELDS[robot.mechanism.actuation[index]]
    return field, float(robot.joint_positions[index]) if field == "joint_positions" else 0.0


def _joint_values(keyframes: Sequence[JointKeyframe], start: float, times: Tensor) -> Tensor:
    """Values [n] at some times, on straight lines between keyframes."""
    given = [(frame.time, frame.value) for frame in keyframes]
    given = given if given[0][0] == 0 else [(0.0, start), *given]
    at, values = np.array(given).T
    return torch.from_numpy(np.interp(times.numpy(), at, values))


def _step_times(dt: float, steps: int) -> Tensor:
    return dt * torch.arange(1, steps + 1, dtype=torch.float64)


def _moved(start: Tensor, keyframes: Sequence[PinKeyframe], times: Tensor) -> Tensor:
    """Positions [n, p, 3] of pins [p, 3] at some times: turned about their mean and displaced."""
    frames = [(0.0, [0.0, 0.0, 0.0], np.array([1.0, 0.0, 0.0, 0.0]))]
    if keyframes[0].time == 0:
        frames = []
    frames += [(frame.time, frame.displacement, quaternion(frame)) for frame in keyframes]
    poses = interpolate_poses(
        torch.tensor([time for time, _, _ in frames], dtype=torch.float64),
        torch.tensor(np.array([[*move, *turn] for _, move, turn in frames])),
        times,
    )
    center = start.mean(dim=0)
    turned = rotate(poses[:, None, 3:], (start - center).expand(len(times), -1, 3))
    return turned + center + poses[:, None, :3]
