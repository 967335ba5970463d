"""A robot: its mechanism, the surfaces of its links, and the drives of its joints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.autograd.transforms import numbers_of
from diffcloth_torch.checks import (
    ANY_NUMBER,
    NON_NEGATIVE,
    POSITIVE,
    ArrayLike,
    FloatArray,
    Range,
    check_choice,
    check_finite,
    check_ignored_pairs,
    check_name,
    check_number,
    check_range,
    check_shape,
    float_array,
    float_tensor,
    frozen,
    texts,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import as_path
from diffcloth_torch.geometry.mesh_checks import Surface
from diffcloth_torch.geometry.poses import check_quaternions, pose_array
from diffcloth_torch.model.chains import (
    chain_positions,
    describe_chain,
    link_surfaces,
    make_chain,
)
from diffcloth_torch.model.collision_shapes import link_surface, with_round_links
from diffcloth_torch.model.kinematics import link_frames, pose_frame
from diffcloth_torch.model.mechanism import Mechanism
from diffcloth_torch.model.refusals import Refusals
from diffcloth_torch.model.robot_tree import JointBounds, joint_bounds, make_mechanism
from diffcloth_torch.model.round_bodies import ContactSurface
from diffcloth_torch.model.urdf import describe_urdf
from diffcloth_torch.saved import saved

__all__ = ["ACTUATIONS", "BASES", "Robot"]

Actuation = str | Mapping[str, str | None] | Sequence[str | None] | None
"""One mode for all joints, name of a joint -> its mode, or a list of modes."""

ByName = ArrayLike | Mapping[str, float]
"""One number for all joints or links, an array of numbers, or name -> number."""

BASES = ("fixed", "kinematic", "floating")
ACTUATIONS = ("position", "velocity", "torque", "pd")

_DIFFERENTIABLE = {
    "joint_positions": "State.joint_positions or Control.joint_positions",
    "stiffness": "Parameters.joint_stiffness",
    "damping": "Parameters.joint_damping",
    "effort_limits": "Parameters.joint_effort_limits",
    "velocity_limits": "Parameters.joint_velocity_limits",
    "joint_friction": "Parameters.joint_friction",
    "friction": "Parameters.friction",
    "thickness": "Parameters.thickness",
}
_POSE = "differentiate with respect to State.base_poses or Control.base_poses"


@saved
class Robot:
    """Links connected by joints; immutable. `Robot.load` or `Robot.from_chain` makes it.

    Attributes:
        mechanism: The tree of links and joints.
        surfaces: Collision surface of each of the L links in the link's frame, or None; length L.
        skeletons: Name of a smooth link -> its contact surface, in place of the surface in
            `surfaces`, which is then only for display.
        pose: Initial pose of the root link [px, py, pz, qw, qx, qy, qz], shape [7].
        joint_positions: Initial joint positions [rad or m], shape [J].
        stiffness: Stiffness of the drives of "pd" joints [N m/rad or N/m], zero for other joints;
            shape [J].
        damping: Damping of these drives [N m s/rad or N s/m], shape [J].
        viscosity: Damping of the joints themselves [N m s/rad or N s/m], shape [J].
        effort_limits: Largest efforts of the drives of "pd" joints and largest efforts applied to
            "torque" joints [N m or N], infinity without a limit; shape [J].
        velocity_limits: Largest speeds of these joints [rad/s or m/s], likewise.
        joint_friction: Coulomb friction of these joints [N m or N], shape [J].
        friction: Friction coefficient of each link's surface [-], shape [L].
        thickness: Full thickness of each link's surface [m], shape [L].
        ignore_contact: Pairs of names of links that do not collide with each other, or
            "overlapping".
        name: Name in the scene; None means a name chosen by the scene.
    """

    mechanism: Mechanism
    surfaces: tuple[Surface | None, ...]
    skeletons: Mapping[str, ContactSurface]
    pose: FloatArray
    joint_positions: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    viscosity: FloatArray
    effort_limits: FloatArray
    velocity_limits: FloatArray
    joint_friction: FloatArray
    friction: FloatArray
    thickness: FloatArray
    ignore_contact: tuple[tuple[str, str], ...] | str
    name: str | None

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        mesh_root: str | Path | None = None,
        base: str = "fixed",
        pose: ArrayLike | None = None,
        joint_positions: ByName | None = None,
        actuation: Actuation = None,
        stiffness: ByName | None = None,
        damping: ByName | None = None,
        effort_limits: ByName | None = None,
        velocity_limits: ByName | None = None,
        joint_friction: ByName | None = None,
        friction: ByName = 0.4,
        thickness: ByName = 0.0,
        edge_length: float | None = None,
        smooth: bool | Mapping[str, bool] = False,
        ignore_contact: Iterable[Sequence[str]] | str = (),
        name: str | None = None,
    ) -> Robot:
        """Read a URDF file.

        Joints may be fixed, revolute, continuous or prismatic. The J joints are the joints that
        move and do not mimic. Links and joints keep the order of the file. A mapping name -> value
        may omit names, which have the default.

        Args:
            path: URDF file.
            mesh_root: Folder that must contain all mesh files which are not in the packages of
                ROS_PACKAGE_PATH and AMENT_PREFIX_PATH; "package://name/x" means name/x or x in this
                folder. By default these packages and the folders that hold the URDF file are
                searched, and meshes may lie anywhere: set `mesh_root` for files from untrusted
                sources.
            base: "fixed", "kinematic" (the root link follows prescribed poses) or "floating".
            pose: Initial pose of the root link [px, py, pz, qw, qx, qy, qz]; the identity by
                default.
            joint_positions: Initial joint positions [rad or m], within the limits; one value,
                name -> value, or [J]. By default each joint has the position within its limits
                that is nearest to zero.
            actuation: "position" and "velocity" prescribe the motion of a joint; with "torque" and
                "pd" the joint responds to forces. One mode, name -> mode, or J modes. By default
                "pd", but "position" for a joint whose limits leave it one position.
            stiffness: Stiffness of the drives of "pd" joints [N m/rad or N/m], >= 0; one value,
                name -> value, or [J].
            damping: Damping of these drives [N m s/rad or N s/m], >= 0; as `stiffness`.
            effort_limits: Largest efforts of "pd" and "torque" joints [N m or N], > 0. None means
                the limits of the file, where 0 means no limit; False applies no limits. Otherwise
                one value, name -> value or False (the rest as in the file), or [J].
            velocity_limits: Largest speeds of these joints [rad/s or m/s], > 0, likewise.
            joint_friction: Coulomb friction of these joints [N m or N], >= 0, likewise.
            friction: Friction coefficient of the surfaces of links [-], >= 0; one value, or link ->
                value.
            thickness: Full thickness of these surfaces [m], >= 0; one value, or link -> value.
            edge_length: Longest edge of the surfaces of all shapes but meshes [m], > 0. With None a
                box has 12 triangles, a sphere 1280, a capsule 1024 and a cylinder about 400.
            smooth: Whether contact uses spheres and capsules themselves instead of their triangles;
                True or False for all, or link -> True or False. A sphere or capsule beside other
                shapes of its link becomes a link "link/k" of its own, for the k-th shape of the
                link counted from 0. The new link is welded to the link, follows the links of the
                file and has the link's values in mappings.
            ignore_contact: Pairs of names of links that do not collide with each other, or
                "overlapping": the pairs that intersect, touch or are closer than their thickness in
                the initial state of a scene. Links connected rigidly, or by a single moving joint,
                never collide.
            name: Name in the scene.

        Raises:
            InvalidInput: If the file or an argument is not accepted; the message has every reason
                against the file. See docs/robots.md.
            TypeError: If an argument has a wrong type.
            OSError: If the file cannot be read.
        """
        file = as_path("Robot.load: `path`", path)
        check_choice("Robot.load: `base`", base, BASES)
        if edge_length is not None:
            edge_length = check_number("Robot.load: `edge_length`", edge_length, POSITIVE)
        root = None if mesh_root is None else as_path("Robot.load: `mesh_root`", mesh_root)
        refusals = Refusals()
        read = describe_urdf(file, refusals)
        if refusals:  # no tree, but the meshes of the links that are accepted can be checked
            for link in read.links:
                link_surface(link, file, root, edge_length, refusals)
            refusals.raise_any(f"{file}: ")
        round_links = with_round_links(read, smooth)
        description = round_links.description
        names = [link.name for link in description.links]
        pairs = check_ignored_pairs("Robot: `ignore_contact`", ignore_contact, names)
        if not isinstance(pairs, str):
            pairs = tuple(round_links.pairs_with_parts(pairs))
        moving = [joint for joint in description.joints if joint.moves]
        modes = _modes("Robot.load", actuation, [joint.name for joint in moving])
        mechanism = make_mechanism(file, description, base, modes, refusals)
        surfaces = [
            link_surface(link, file, root, edge_length, refusals) for link in description.links
        ]
        refusals.raise_any(f"{file}: ")
        return cls(
            mechanism,
            surfaces,
            np.array([joint.viscosity for joint in moving]),
            joint_bounds(description.joints),
            skeletons=round_links.skeletons,
            pose=pose,
            joint_positions=joint_positions,
            stiffness=stiffness,
            damping=damping,
            effort_limits=effort_limits,
            velocity_limits=velocity_limits,
            joint_friction=joint_friction,
            friction=round_links.with_parts(friction),
            thickness=round_links.with_parts(thickness),
            ignore_contact=pairs,
            name=name,
        )

    @classmethod
    def from_chain(
        cls,
        chain: Any,
        *,
        surfaces: Mapping[str, Sequence[Any]],
        inertials: Mapping[str, Sequence[Any]] | None = None,
        limits: Mapping[str, Sequence[float]] | None = None,
        base: str = "fixed",
        actuation: Actuation = None,
        **options: Any,
    ) -> Robot:
        """Convert a chain of pytorch-kinematics, with surfaces and inertias that chains lack.

        A chain has frames, joints and their limits. It does not keep masses, collision shapes,
        damping and friction of joints, or mimic relations of a file: use `load` if there is a file.
        Frames become links with the same names; offsets in single precision are exact to 1e-7.

        >>> chain = pk.build_chain_from_urdf(Path("arm.urdf").read_bytes())
        >>> hand = dc.RigidBody.box(0.1)
        >>> arm = dc.Robot.from_chain(
        ...     chain, surfaces={"hand": (hand.vertices, hand.faces)}, actuation="position"
        ... )

        Args:
            chain: `pytorch_kinematics.Chain` or `SerialChain`; not changed.
            surfaces: Name of a frame -> vertices in the frame [m], shape [n, 3], and triangles,
                shape [f, 3]; frames that are left out do not collide.
            inertials: Name of a frame -> mass [kg], center of mass in the frame [m], shape [3], and
                inertia about that center [kg m^2], shape [3, 3]; required for links that forces
                move.
            limits: Name of a joint -> lower and upper limit [rad or m], in place of the chain's.
            base: "fixed", "kinematic" or "floating", as in `load`.
            actuation: As in `load`.
            **options: `pose`, `joint_positions`, `stiffness`, `damping`, `effort_limits`,
                `velocity_limits`, `joint_friction`, `friction`, `thickness`, `ignore_contact` and
                `name`, as in `load`.

        Raises:
            InvalidInput: If an argument is not accepted, or a link that forces move has no mass.
            TypeError: If an argument has a wrong type.
        """
        label = "Robot.from_chain"
        check_choice(f"{label}: `base`", base, BASES)
        description = describe_chain(chain, inertials or {}, limits or {})
        moving = [joint.name for joint in description.joints if joint.moves]
        refusals = Refusals()
        modes = _modes(label, actuation, moving)
        mechanism = make_mechanism(label, description, base, modes, refusals)
        refusals.raise_any(f"{label}: ")
        links = [link.name for link in description.links]
        bounds = joint_bounds(description.joints)
        viscosity = np.zeros(len(moving))
        return cls(mechanism, link_surfaces(links, surfaces), viscosity, bounds, **options)

    def __init__(
        self,
        mechanism: Mechanism,
        surfaces: Sequence[Surface | None],
        viscosity: FloatArray,
        bounds: JointBounds,
        *,
        skeletons: Mapping[str, ContactSurface] | None = None,
        pose: ArrayLike | None = None,
        joint_positions: ByName | None = None,
        stiffness: ByName | None = None,
        damping: ByName | None = None,
        effort_limits: ByName | None = None,
        velocity_limits: ByName | None = None,
        joint_friction: ByName | None = None,
        friction: ByName = 0.4,
        thickness: ByName = 0.0,
        ignore_contact: Iterable[Sequence[str]] | str = (),
        name: str | None = None,
    ) -> None:
        self.mechanism = mechanism
        self.surfaces = tuple(surfaces)
        self.skeletons = dict(skeletons or {})
        self.viscosity = frozen(viscosity)
        self.pose = frozen(pose_array("Robot: `pose`", pose, instead=_POSE))
        joints, links = self.joint_names, self.link_names
        nearest = np.clip(0.0, mechanism.lower, mechanism.upper)
        self.joint_positions = _named("joint_positions", joint_positions, joints, nearest)
        _check_limits(mechanism, self.joint_positions)
        driven = np.array([mode == "pd" for mode in mechanism.actuation], dtype=bool)
        self.stiffness = frozen(driven * _named("stiffness", stiffness, joints, 0.0, NON_NEGATIVE))
        self.damping = frozen(driven * _named("damping", damping, joints, 0.0, NON_NEGATIVE))
        efforts, speeds, friction_there = bounds
        self.effort_limits = _bounds("effort_limits", effort_limits, joints, efforts)
        self.velocity_limits = _bounds("velocity_limits", velocity_limits, joints, speeds)
        self.joint_friction = _bounds("joint_friction", joint_friction, joints, friction_there)
        self.friction = _named("friction", friction, links, 0.4, NON_NEGATIVE)
        self.thickness = _named("thickness", thickness, links, 0.0, NON_NEGATIVE)
        self.ignore_contact = check_ignored_pairs("Robot: `ignore_contact`", ignore_contact, links)
        self.name = check_name("Robot: `name`", name)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the J joints that move and do not mimic, in the order of the file."""
        return self.mechanism.joint_names

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of the L links, in the order of the file."""
        return self.mechanism.link_names

    @property
    def contact_surfaces(self) -> tuple[ContactSurface | None, ...]:
        """Contact surface of each link, which is its mesh, its skeleton if smooth, or None."""
        return tuple(
            None
            if mesh is None
            else self.skeletons.get(name, ContactSurface(mesh.vertices, mesh.faces, 0.0))
            for name, mesh in zip(self.link_names, self.surfaces, strict=True)
        )

    @property
    def chain(self) -> Any:
        """A new `pytorch_kinematics.Chain` of the links, for planning.

        Its frames are relative to the root link's frame, in float64, and agree with
        `forward_kinematics` to rounding. Make a `SerialChain` in float64 too, and address joints by
        name: chains have their own order of joints. Joints that mimic others are separate joints of
        the chain.

        >>> serial = pk.SerialChain(robot.chain, "hand", dtype=torch.float64)
        >>> jacobian = serial.jacobian(q)
        """
        with cpu.DEVICE:  # pytorch-kinematics uses torch's default device
            return make_chain(self.mechanism)

    def chain_positions(self, joint_positions: Tensor) -> dict[str, Tensor]:
        """Positions of all joints of `chain`, mimicking joints included.

        Args:
            joint_positions: Joint positions [rad or m], shape [.., J].

        Returns:
            Name of a joint of the chain -> its position, shape [..]: the argument of
            `chain.forward_kinematics`.
        """
        q = self._checked_positions("chain_positions", joint_positions)
        return chain_positions(self.mechanism, q)

    def _checked_positions(self, owner: str, joint_positions: Tensor) -> Tensor:
        q = float_tensor(f"{owner}: `joint_positions`", joint_positions)
        joints = len(self.joint_names)
        if q.shape[-1:] != (joints,):
            raise InvalidInput(
                f"{owner}: `joint_positions` must have shape [.., {joints}], got {list(q.shape)}"
            )
        check_finite(f"{owner}: `joint_positions`", numbers_of(q))
        return q

    def forward_kinematics(
        self, joint_positions: Tensor, base_pose: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Compute the frames of all links, differentiable any number of times; limits are ignored.

        Args:
            joint_positions: Joint positions [rad or m], shape [.., J].
            base_pose: Pose of the root link, shape [.., 7]; `pose` by default. Leading axes of both
                arguments are broadcast.

        Returns:
            Name of a link -> its frame in the world, shape [.., 4, 4].
        """
        q = self._checked_positions("forward_kinematics", joint_positions)
        given = self.pose if base_pose is None else base_pose
        pose = float_tensor("forward_kinematics: `base_pose`", given)
        if pose.shape[-1:] != (7,):
            raise InvalidInput(
                f"forward_kinematics: `base_pose` must have shape [.., 7], got {list(pose.shape)}"
            )
        numbers = numbers_of(pose)
        check_finite("forward_kinematics: `base_pose`", numbers)
        check_quaternions("forward_kinematics: `base_pose`", numbers)
        try:
            np.broadcast_shapes(q.shape[:-1], pose.shape[:-1])
        except ValueError as error:
            raise InvalidInput(
                "forward_kinematics: `joint_positions` and `base_pose` must have leading axes that "
                f"broadcast, got {list(q.shape)} and {list(pose.shape)}"
            ) from error
        frames = link_frames(self.mechanism, pose_frame(pose), q)
        return dict(zip(self.link_names, frames.unbind(-3), strict=True))

    def __repr__(self) -> str:
        name = "" if self.name is None else f"{self.name!r}, "
        return (
            f"Robot({name}{self.mechanism.base} base, {len(self.joint_names)} joints, "
            f"{len(self.link_names)} links)"
        )


def _named(
    field: str,
    given: object,
    names: Sequence[str],
    default: float | FloatArray,
    accepted: Range = ANY_NUMBER,
) -> FloatArray:
    """One value per name, from one value for all, from name -> value, or from an array."""
    label = f"Robot: `{field}`"
    instead = f"differentiate with respect to {_DIFFERENTIABLE[field]}"
    if isinstance(given, Mapping):
        values = np.array(np.broadcast_to(default, len(names)))
        _check_known(field, given, names)
        for key, value in given.items():
            number = float_array(f"{label}[{key!r}]", value, instead=instead)
            check_shape(f"{label}[{key!r}]", number.shape, [()])
            values[names.index(key)] = number
    else:
        values = float_array(label, default if given is None else given, instead=instead)
        check_shape(label, values.shape, [(), (len(names),)])
        values = np.array(np.broadcast_to(values, len(names)))
    check_range(label, values, accepted)
    return frozen(values)


def _bounds(field: str, given: object, names: Sequence[str], of_file: FloatArray) -> FloatArray:
    """One value for each joint: the value of the file unless the caller sets another."""
    none, accepted = (0.0, NON_NEGATIVE) if field == "joint_friction" else (np.inf, POSITIVE)
    if given is None:
        return frozen(np.array(of_file))
    if given is False:
        return frozen(np.full(len(names), none))
    if given is True:
        raise InvalidInput(
            f"Robot: `{field}` must be False (not applied), numbers, or None (as in the file), got "
            "True"
        )
    if not isinstance(given, Mapping):
        return _named(field, given, names, none, accepted)
    off = {name: value for name, value in given.items() if value is False}
    on = {name: value for name, value in given.items() if name not in off}
    _check_known(field, off, names)
    values = np.array(_named(field, on, names, 1.0, accepted))
    listed = np.array([name in on for name in names], dtype=bool)
    unlisted = np.where([name in off for name in names], none, of_file)
    return frozen(np.where(listed, values, unlisted))


def _check_known(field: str, given: Iterable[object], names: Sequence[str]) -> None:
    for key in given:
        if key not in names:
            raise InvalidInput(f"Robot: `{field}` has the names {texts(names)}; got {key!r}")


def _modes(owner: str, given: object, names: Sequence[str]) -> list[str | None]:
    """Actuation of each joint, from one mode for all, from name -> mode, or from a list of modes.

    Without a mode (None), the limits of the joint determine the mode.
    """
    label = f"{owner}: `actuation`"
    modes: list[object]
    if given is None or isinstance(given, str):
        modes = [given] * len(names)
    elif isinstance(given, Mapping):
        unknown = [key for key in given if key not in names]
        if unknown:
            raise InvalidInput(f"{label} has the names {texts(names)}; got {unknown[0]!r}")
        modes = [given.get(name) for name in names]
    elif isinstance(given, Sequence):
        check_shape(label, [len(given)], [(len(names),)])
        modes = list(given)
    else:
        raise TypeError(
            f"{label} must be a word, a dict or a list of words, got {type(given).__name__}"
        )
    return [
        None if mode is None else check_choice(f"{label} of {name!r}", mode, ACTUATIONS)
        for name, mode in zip(names, modes, strict=True)
    ]


def _check_limits(mechanism: Mechanism, positions: FloatArray) -> None:
    outside = (positions < mechanism.lower) | (positions > mechanism.upper)
    if outside.any():
        j = int(np.flatnonzero(outside)[0])
        raise InvalidInput(
            f"Robot: `joint_positions` of {mechanism.joint_names[j]!r} must be between its limits "
            f"{mechanism.lower[j]:g} and {mechanism.upper[j]:g}, got {positions[j]:g} at [{j}]"
        )
