"""Inputs of a step besides the state: targets for its end, forces, and physical parameters."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any

from torch import Tensor

from diffcloth_torch.model.quantities import CONTROL, PARAMETERS
from diffcloth_torch.reprs import field_text, record_text
from diffcloth_torch.saved import saved
from diffcloth_torch.sim.records.state import check_field_names
from diffcloth_torch.sim.records.trees import register_record

__all__ = ["Control", "Parameters", "tensors_of"]


@saved
@dataclass(frozen=True, eq=False)
class Control:
    """Targets for the end of a step, and forces during it. A target that is None holds.

    Every tensor may have a leading batch axis; without one it applies to all environments.
    A control is a pytree of torch: its leaves are the tensors that are set.

    Attributes:
        pins: Positions of the pinned vertices [m], shape [P, 3], or "cloth/pin" (or "pin" if
            unique) -> positions; pins that are not named stay in place.
        soft_pins: Positions to which the soft pins pull [m], shape [Q, 3], or likewise by name.
        body_poses: [px, py, pz, qw, qx, qy, qz] of each body, shape [K, 7], or body -> pose [7];
            the row of a body that is not kinematic must equal the row of the state.
        forces: Forces on the cloth vertices [N], shape [N, 3]; none by default.
        body_wrenches: Force at the center of mass of each dynamic body, then torque, in world axes
            [N, N m], shape [K, 6], or body -> wrench [6]; must be zero for a body that is not
            dynamic.
        joint_positions: Targets of position and pd joints [rad or m], shape [J], or "robot/joint"
            (or "joint" if unique) -> number; rows of other joints are ignored, here and in the next
            two, and pd joints that are not named keep their last target.
        joint_velocities: Targets of velocity and pd joints [rad/s or m/s], shape [J], or likewise
            by name; zero by default.
        joint_efforts: Efforts of torque joints, and efforts added to the efforts of pd drives
            [N m or N], shape [J], or likewise by name; zero by default. Efforts are clamped to the
            limits of a joint.
        base_poses: Frames of the robots' root links, shape [R, 7], or robot -> pose [7]; the row of
            a robot whose base is not kinematic must equal the row of the state.
        base_wrenches: Force at the center of mass of each floating root link, then torque, in world
            axes [N, N m], shape [R, 6], or robot -> wrench [6]; must be zero for a base that is not
            floating.
        attachments: Targets of the attachments to targets [m], shape [U, 3], or attachment ->
            targets [n, 3]. Attachments without a target are released.
        attachment_weights: Share of the stiffness with which the springs of attachments pull [-],
            between 0 (released) and 1, shape [A], or attachment -> weights [n]; 1 by default, and 0
            if a target is not set.
        wind: Velocity of the air around the cloths [m/s], shape [3]; none by default. Faces whose
            material has drag feel it.
        body_vertices: Positions of the vertices of deforming bodies [m], shape [D, 3], or body ->
            positions [n, 3]; bodies that are not named hold.
    """

    pins: Tensor | Mapping[str, Tensor] | None = None
    soft_pins: Tensor | Mapping[str, Tensor] | None = None
    body_poses: Tensor | Mapping[str, Tensor] | None = None
    forces: Tensor | None = None
    body_wrenches: Tensor | Mapping[str, Tensor] | None = None
    joint_positions: Tensor | Mapping[str, Tensor] | None = None
    joint_velocities: Tensor | Mapping[str, Tensor] | None = None
    joint_efforts: Tensor | Mapping[str, Tensor] | None = None
    base_poses: Tensor | Mapping[str, Tensor] | None = None
    base_wrenches: Tensor | Mapping[str, Tensor] | None = None
    attachments: Tensor | Mapping[str, Tensor] | None = None
    attachment_weights: Tensor | Mapping[str, Tensor] | None = None
    wind: Tensor | None = None
    body_vertices: Tensor | Mapping[str, Tensor] | None = None

    def __repr__(self) -> str:
        return _text(self, CONTROL)

    def replace(self, **changes: Any) -> Control:
        """Return a copy with some fields replaced."""
        check_field_names("Control.replace", self, changes)
        return replace(self, **changes)


@saved
@dataclass(frozen=True, eq=False)
class Parameters:
    """Physical parameters. A field that is None has the values of the scene.

    Each may have a leading batch axis [B]. The friction and the barrier stiffness of a pair of
    surfaces are the mean of its two entries.

    A field at faces may have one value per cloth vertex, [N]: a face then has the mean of its
    corners. Such a tensor is refused if there are as many vertices as faces.

    Fields with rows may be set by names, as {"shirt": 300.0}: fields per cloth or face by cloths,
    `thickness` by surfaces, `attachment_stiffness` by attachments, all others by bodies, by
    "robot/link" or by "robot/joint" (or the part after the slash if unique, or a robot for all of
    its rows). Rows that are not named keep the values of the scene.

    Parameters are a pytree of torch: their leaves are the tensors that are set.

    Attributes:
        stretch: Membrane stiffness [N/m], > 0; shape [], [C], [N] or [F].
        bending: Bending stiffness [N m], >= 0; shape [], [C], [N] or [F].
        poisson: Poisson ratio of bending [-], between -1 and 0.5; shape [], [C], [N] or [F].
        density: Mass per rest area [kg/m^2], > 0; shape [], [C], [N] or [F].
        damping: Time over which strain rates are damped [s], >= 0; shape [], [C], [N] or [F].
        friction: Friction coefficient [-], >= 0; shape [] or [S, S], or pair of names of surfaces,
            in either order, -> number, as {("cloth", "table"): 0.4}; pairs that are not named keep
            the values of the scene.
        thickness: Full thickness of each surface [m], >= 0; shape [S].
        barrier_stiffness: Stiffness of the barrier [Pa], > 0; shape [] or [S, S].
        barrier_distance: Distance at which the barrier begins [m], > 0; shape [].
        slip_velocity: Velocity at which sticking turns into sliding [m/s], > 0; shape [].
        pin_stiffness: Stiffness of the soft pins [N/m], > 0; shape [] or [C].
        gravity: Acceleration of gravity [m/s^2], shape [3].
        rest_positions: Vertices of the rest meshes of the cloths [m], shape [M, 3]; M = N without
            seams.
        attachment_stiffness: Stiffness of the springs of attachments [N/m], > 0, shape [A].
        normal_drag: Coefficient of the pressure of air across faces [-], >= 0; shape [], [C], [N]
            or [F].
        tangential_drag: Coefficient of the friction of air along faces [-], >= 0; shape [], [C],
            [N] or [F].
        air_density: Density of the air [kg/m^3], >= 0; shape [].
        body_mass: Mass of each body [kg], >= 0, > 0 if it is dynamic; shape [K]. This and the next
            two are ignored for bodies that are not dynamic.
        body_center: Center of mass of each body, in its frame [m], shape [K, 3].
        body_inertia: Inertia of each body about that center, in the axes of its frame [kg m^2].
            Only the symmetric part is used, which must be positive definite; shape [K, 3, 3].
        link_mass: Mass of each link [kg], >= 0, shape [L].
        link_center: Center of mass of each link, in its frame [m], shape [L, 3].
        link_inertia: Inertia of each link about that center, in the axes of its frame [kg m^2].
            Only the symmetric part is used; shape [L, 3, 3].
        joint_stiffness: Stiffness of pd drives [N m/rad or N/m], >= 0, shape [J].
        joint_damping: Damping of pd drives [N m s/rad or N s/m], >= 0, shape [J].
        joint_viscosity: Damping of the joints themselves [N m s/rad or N s/m], >= 0, shape [J].
        joint_armature: Inertia of the drives, seen at the joints [kg m^2 or kg], >= 0, shape [J].
        stretch_weft: Membrane stiffness of woven cloth along its weft [N/m], > 0; shape [], [C],
            [N] or [F]. This and the next three exist if a material sets such a stiffness. `stretch`
            and `bending` are then the stiffnesses along the warp; isotropic cloths of the scene
            have their own values here.
        stretch_shear: Membrane stiffness of woven cloth in shear [N/m], > 0; shape [], [C], [N] or
            [F].
        bending_weft: Bending stiffness of woven cloth along its weft [N m], >= 0; shape [], [C],
            [N] or [F]; > 0 where `bending` is.
        bending_twill: Bending stiffness of woven cloth at 45 degrees [N m], >= 0; shape [], [C],
            [N] or [F]; at least (bending + bending_weft + 2 poisson sqrt(bending bending_weft)) /
            4.
        joint_effort_limits: Largest efforts of pd drives, and largest efforts applied to torque
            joints [N m or N], > 0, shape [J]; 1e30 if there is no limit.
        joint_velocity_limits: Largest speeds of pd and torque joints [rad/s or m/s], > 0, shape
            [J]; 1e30 if there is no limit.
        joint_friction: Coulomb friction of these joints [N m or N], >= 0, shape [J].
        joint_slip_rates: Speeds at which sticking joints turn into sliding ones [rad/s or m/s],
            > 0, shape [J]. By default, the joint then moves its load with
            `ContactOptions.slip_velocity` at the radius of gyration about its axis.
    """

    stretch: Tensor | None = None
    bending: Tensor | None = None
    poisson: Tensor | None = None
    density: Tensor | None = None
    damping: Tensor | None = None
    friction: Tensor | Mapping[tuple[str, str], Tensor] | None = None
    thickness: Tensor | None = None
    barrier_stiffness: Tensor | None = None
    barrier_distance: Tensor | None = None
    slip_velocity: Tensor | None = None
    pin_stiffness: Tensor | None = None
    gravity: Tensor | None = None
    rest_positions: Tensor | None = None
    attachment_stiffness: Tensor | None = None
    normal_drag: Tensor | None = None
    tangential_drag: Tensor | None = None
    air_density: Tensor | None = None
    body_mass: Tensor | None = None
    body_center: Tensor | None = None
    body_inertia: Tensor | None = None
    link_mass: Tensor | None = None
    link_center: Tensor | None = None
    link_inertia: Tensor | None = None
    joint_stiffness: Tensor | None = None
    joint_damping: Tensor | None = None
    joint_viscosity: Tensor | None = None
    joint_armature: Tensor | None = None
    stretch_weft: Tensor | None = None
    stretch_shear: Tensor | None = None
    bending_weft: Tensor | None = None
    bending_twill: Tensor | None = None
    joint_effort_limits: Tensor | None = None
    joint_velocity_limits: Tensor | None = None
    joint_friction: Tensor | None = None
    joint_slip_rates: Tensor | None = None
    # Fields from a simulator, without a batch axis: their [C] or [F] is never read as [B].
    _unbatched: tuple[str, ...] = field(default=(), repr=False)

    def __repr__(self) -> str:
        return _text(self, PARAMETERS)

    def replace(self, **changes: Any) -> Parameters:
        """Return a copy with some fields replaced."""
        check_field_names("Parameters.replace", self, changes)
        unbatched = tuple(name for name in self._unbatched if name not in changes)
        return replace(self, **changes, _unbatched=unbatched)


def _set_fields(record: Control | Parameters, names: Iterable[str]) -> dict[str, Any]:
    """Fields that a record sets; mappings become dicts, which are pytrees."""
    values = {name: getattr(record, name) for name in names}
    return {
        name: dict(value) if isinstance(value, Mapping) else value
        for name, value in values.items()
        if value is not None
    }


def _parameter_branches(record: Parameters) -> tuple[dict[str, Any], dict[str, Any]]:
    fields = _set_fields(record, PARAMETERS)
    return fields, {name: fields[name].shape for name in record._unbatched}


def _restored_parameters(fields: dict[str, Any], shapes: dict[str, Any]) -> Parameters:
    """Restore parameters; fields of another shape than the simulator's may have a batch axis."""
    unbatched = (n for n, shape in shapes.items() if getattr(fields[n], "shape", None) == shape)
    return Parameters(**fields, _unbatched=tuple(unbatched))


register_record(
    Control,
    lambda record: (_set_fields(record, CONTROL), None),
    lambda fields, _: Control(**fields),
)
register_record(Parameters, _parameter_branches, _restored_parameters)


def _text(record: Control | Parameters, names: Iterable[str]) -> str:
    """Describe the fields that a record sets."""
    values = ((name, getattr(record, name)) for name in names)
    parts = (field_text(name, value) for name, value in values if value is not None)
    return record_text(type(record).__name__, parts)


def tensors_of(record: Any) -> Iterator[Tensor]:
    """Iterate over the tensors of a State, Control or Parameters; anything else has none."""
    if not is_dataclass(record):
        return
    for value in vars(record).values():
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, Mapping):
            yield from (entry for entry in value.values() if isinstance(entry, Tensor))
