"""Default values of the parameters, from a scene and its options."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import LARGEST, FloatArray
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.mesh_checks import unique_edges
from diffcloth_torch.model.assembly import Assembly
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.options import ABILITIES, ContactOptions
from diffcloth_torch.model.orthotropy import WOVEN_GROUPS
from diffcloth_torch.model.quantities import FACE_QUANTITIES
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.model.scene import Scene

__all__ = [
    "check_barrier",
    "choose_barrier_distance",
    "has_barrier",
    "has_contact",
    "scene_parameters",
    "surface_thickness",
]

# The barrier distance, as fractions of the median cloth edge and of the smallest distance between
# elements of the rest mesh that are not neighbors. Beyond one half of the latter, the surface would
# repel itself at rest.
_PART_OF_EDGE = 0.1
_PART_OF_NONADJACENT = 0.45
_LARGEST_PART_OF_NONADJACENT = 0.5
# Elements that are not neighbors touch if their distance allows less than this share of the barrier
# distance that follows from the edges.
_TOUCHING = 1e-6


def _elastic(scene: Scene) -> tuple[Cloth, ...]:
    """The cloths without the deforming bodies, which are the last entries."""
    return scene.cloths[: len(scene.cloths) - len(scene.deforming_bodies)]


def has_contact(scene: Scene, contact: ContactOptions) -> bool:
    """Return whether any two surfaces of the scene may touch."""
    return len(scene.surface_names) > 1 or (contact.self_contact and len(scene.cloths) > 0)


def has_barrier(scene: Scene, contact: ContactOptions, scheme: str) -> bool:
    """Return whether the barrier keeps any two surfaces of the scene apart."""
    if not ABILITIES[scheme]["barrier"]:
        return False
    nodal = sum(body.nodal_contact for body in scene.bodies)
    if len(scene.surface_names) - nodal > 1 or (contact.self_contact and len(scene.cloths) > 0):
        return True
    return nodal > 0 and scene.is_dynamic


def scene_parameters(scene: Scene, assembly: Assembly, contact: bool) -> dict[str, Tensor]:
    """All parameters of the scene except the barrier's, each in its smallest shape.

    Args:
        scene: The scene.
        assembly: Arrays of the scene.
        contact: Whether any two surfaces of the scene may touch.
    """
    values: dict[str, FloatArray] = {}
    if scene.cloths:
        values = {field: _material_values(scene, field) for field in FACE_QUANTITIES}
        if all(cloth.bending_model == "hinge" for cloth in _elastic(scene)):
            del values["poisson"]  # hinges have no Poisson effect
        materials = [cloth.material for cloth in _elastic(scene)]
        for group in WOVEN_GROUPS:
            if all(getattr(m, field) is None for m in materials for field in group):
                for field in group:
                    del values[field]
        values["rest_positions"] = assembly.rest_positions
        values["air_density"] = np.array(scene.air_density)
    if contact:
        friction = _surface_values(scene, "friction")
        values["friction"] = np.sqrt(friction[:, None] * friction)
        values["thickness"] = surface_thickness(scene)
    if len(assembly.soft_pins):
        values["pin_stiffness"] = _shortest([cloth.pin_stiffness for cloth in scene.cloths])
    if len(assembly.springs):
        values["attachment_stiffness"] = assembly.springs.stiffness
    values["gravity"] = scene.gravity
    values |= _rigid_values(assembly)
    return {name: torch.from_numpy(np.array(value)) for name, value in values.items()}


def surface_thickness(scene: Scene) -> FloatArray:
    """Full thickness of every surface [m], shape [S]."""
    return _surface_values(scene, "thickness")


def _surface_values(scene: Scene, field: str) -> FloatArray:
    """A property of every surface: of cloths, bodies, and links that have collision shapes."""
    owners: list[Material | RigidBody] = [cloth.material for cloth in scene.cloths]
    values = [getattr(owner, field) for owner in [*owners, *scene.bodies]]
    for robot in scene.robots:
        links = zip(robot.surfaces, getattr(robot, field), strict=True)
        values += [value for surface, value in links if surface is not None]
    return np.array(values)


def _rigid_values(assembly: Assembly) -> dict[str, FloatArray]:
    """Masses of bodies and links, and properties of joints; zero unless dynamic."""
    bodies = assembly.mechanisms[: assembly.body_count]
    robots = assembly.mechanisms[assembly.body_count :]
    values: dict[str, FloatArray] = {}
    for owner, mechanisms in (("body", bodies), ("link", robots)):
        if any(mechanism.is_dynamic for mechanism in mechanisms):
            for field in ("mass", "center", "inertia"):
                rows = [m.is_dynamic * getattr(m, field) for m in mechanisms]
                values[f"{owner}_{field}"] = np.concatenate(rows)
    forced = assembly.forced
    if forced.any():
        values["joint_stiffness"] = assembly.stiffness
        values["joint_damping"] = assembly.damping
        values["joint_viscosity"] = forced * assembly.joint_viscosity
        values["joint_armature"] = forced * assembly.joint_armature
        for field in ("joint_effort_limits", "joint_velocity_limits"):
            limits = np.where(forced, getattr(assembly, field), np.inf)
            values[field] = np.minimum(limits, LARGEST)  # finite even without a limit
        values["joint_friction"] = forced * assembly.joint_friction
    return values


def _material_values(scene: Scene, field: str) -> FloatArray:
    """One value if all cloths agree, one per cloth if each is uniform, else one per face."""
    values = [cloth.material.per_face(field) for cloth in _elastic(scene)]
    # A deforming body has an entry as every cloth has; its value is not used.
    values += [float(np.mean(values[0]))] * len(scene.deforming_bodies)
    numbers = [value for value in values if isinstance(value, float)]
    if len(numbers) == len(values):
        return _shortest(numbers)
    counts = [len(cloth.faces) for cloth in scene.cloths]
    parts = [np.broadcast_to(v, n) for v, n in zip(values, counts, strict=True)]
    return np.concatenate(parts)


def _shortest(values: list[float]) -> FloatArray:
    return np.array(values if len(set(values)) > 1 else values[0], dtype=np.float64)


def choose_barrier_distance(
    scene: Scene, nonadjacent_distance: float, contact: ContactOptions
) -> float:
    """Barrier distance [m] from the cloths alone, so that a distant body does not change it."""
    if not scene.cloths:
        raise InvalidInput(
            "Simulator: `contact.barrier_distance` must be given for a scene without cloths"
        )
    edges = [
        np.linalg.norm(
            np.diff(cloth.rest_positions[unique_edges(cloth.rest_faces)[0]], axis=1), axis=-1
        )
        for cloth in _elastic(scene)
    ]
    distance = _PART_OF_EDGE * float(np.median(np.concatenate(edges)))
    if not contact.self_contact:
        return distance
    thickness = max(cloth.material.thickness for cloth in _elastic(scene))
    limit = _PART_OF_NONADJACENT * nonadjacent_distance - thickness
    if limit <= 0:
        _refuse_coincident(scene)
        raise InvalidInput(
            f"Simulator: `material.thickness` of a cloth must be below {_PART_OF_NONADJACENT} of "
            "the smallest distance between elements of its rest mesh that are not neighbors, "
            f"{_PART_OF_NONADJACENT * nonadjacent_distance:g} m, got {thickness:g}"
        )
    if limit < _TOUCHING * distance:
        raise InvalidInput(
            f"Simulator: elements of the rest mesh of a cloth that are not neighbors are "
            f"{nonadjacent_distance:.3g} m apart: they touch or cross; move them apart, or give "
            "`rest_positions` in which they do not"
        )
    return min(distance, limit)


def _refuse_coincident(scene: Scene) -> None:
    """Refuse cloths with two vertices at one place: two cut edges instead of a seam."""
    for name, cloth in zip(scene.cloth_names, _elastic(scene), strict=False):
        _, first, inverse = np.unique(
            cloth.rest_embedding, axis=0, return_index=True, return_inverse=True
        )
        twins = np.flatnonzero(first[inverse.reshape(-1)] != np.arange(len(inverse.reshape(-1))))
        if len(twins):
            twin = int(twins[0])
            raise InvalidInput(
                f"Simulator: vertices {first[inverse.reshape(-1)[twin]]} and {twin} of cloth "
                f"{name!r} are at one place in its rest mesh, and self-contact keeps them apart; "
                "merge vertices of a file that coincide before you load it"
            )


def check_barrier(
    owner: str,
    distance: FloatArray,
    cloth_thickness: FloatArray,
    nonadjacent_distance: float,
) -> None:
    """Require that a cloth at rest does not repel itself.

    Args:
        owner: Opens the message.
        distance: Barrier distance [m], shape [nb, 1].
        cloth_thickness: Thickness of the cloths [m], shape [nb, C].
        nonadjacent_distance: Smallest distance between elements of a rest mesh that are not
            neighbors [m].
    """
    reach = float((distance + cloth_thickness).max())
    limit = _LARGEST_PART_OF_NONADJACENT * nonadjacent_distance
    if reach >= limit:
        raise InvalidInput(
            f"{owner}: `barrier_distance` plus the thickness of a cloth must be below half the "
            "smallest distance between elements of the rest mesh that are not neighbors, "
            f"{limit:g} m, got {reach:g}"
        )
