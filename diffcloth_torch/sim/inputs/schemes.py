"""Capabilities of each scheme, and errors for unsupported combinations."""

from __future__ import annotations

from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.options import (
    ABILITIES,
    CERTIFY,
    COUPLINGS,
    INTEGRATORS,
    SCHEMES,
    SolverOptions,
)
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.inputs.layout import Layout

__all__ = ["check_scheme"]


def check_scheme(
    scheme: str,
    coupling: str,
    integrator: str,
    scene: Scene,
    layout: Layout,
    solver: SolverOptions,
) -> None:
    """Refuse options, motion and contact that a scheme does not support.

    Args:
        scheme: One of `SCHEMES`.
        coupling: One of `COUPLINGS`.
        integrator: One of `INTEGRATORS`.
        scene: The scene.
        layout: Layout of its rows.
        solver: Solver options.

    Raises:
        InvalidInput: If something is not accepted.
    """
    abilities = ABILITIES[scheme]
    if scene.deforming_bodies and (scheme != SCHEMES[0] or coupling != COUPLINGS[0]):
        raise InvalidInput(
            f"Simulator: bodies that deform by prescription need scheme {SCHEMES[0]!r} and "
            f"coupling {COUPLINGS[0]!r}, got {scheme!r} and {coupling!r}"
        )
    _check_attachments(scheme, coupling, layout)
    if integrator != INTEGRATORS[0]:
        _check_second_order(scheme, coupling, integrator, layout)
    # Other schemes measure inertia in the masses, as "mass", formerly the default, states.
    if not abilities["metrics"] and solver.metric not in (None, "mass"):
        raise InvalidInput(
            f"Simulator: `solver.metric` {solver.metric!r} needs scheme {_able('metrics')}, "
            f"got {scheme!r}"
        )
    if solver.certify != CERTIFY[0] and scheme != SCHEMES[0]:
        raise InvalidInput(
            f"Simulator: `solver.certify` {solver.certify!r} needs scheme {SCHEMES[0]!r}, "
            f"got {scheme!r}"
        )
    if not abilities["elastic_stage"]:
        _check_one_stage(scheme, scene, solver)
    if not abilities["barrier"]:
        _check_without_barrier(scheme, scene)
    elif not abilities["moves_bodies"] and coupling == COUPLINGS[0] and layout.is_dynamic:
        raise InvalidInput(
            f"Simulator: scheme {scheme!r} takes prescribed bodies and the staggered couplings "
            f"{' and '.join(map(repr, COUPLINGS[1:]))}; the scene has a dynamic body or robot "
            f"and `coupling` is {coupling!r}"
        )


def _check_attachments(scheme: str, coupling: str, layout: Layout) -> None:
    """Refuse attachments to bodies and links unless one solve moves everything."""
    assembly = layout.assembly
    if not assembly.cloth_count:
        return
    for name in assembly.springs.surfaces:
        row = assembly.surface_names.index(name) - assembly.cloth_count
        is_moved = assembly.mechanisms[assembly.surface_mechanism[row]].is_dynamic
        if scheme != SCHEMES[0]:
            raise InvalidInput(
                f"Simulator: scheme {scheme!r} takes attachments of cloths to cloths and targets, "
                f"got one to {name!r}; use scheme {SCHEMES[0]!r}"
            )
        if is_moved and coupling != COUPLINGS[0]:
            raise InvalidInput(
                f"Simulator: an attachment to {name!r}, which is dynamic, needs coupling "
                f"{COUPLINGS[0]!r}, got {coupling!r}"
            )


def _check_second_order(scheme: str, coupling: str, integrator: str, layout: Layout) -> None:
    """Require a single solve for everything, and springs to prescribed motion alone."""
    start = f"Simulator: `integrator` {integrator!r} needs"
    if scheme != SCHEMES[0]:
        raise InvalidInput(f"{start} scheme {SCHEMES[0]!r}, got {scheme!r}")
    if coupling != COUPLINGS[0]:
        raise InvalidInput(f"{start} coupling {COUPLINGS[0]!r}, got {coupling!r}")
    assembly = layout.assembly
    for name in assembly.springs.surfaces if assembly.cloth_count else ():
        row = assembly.surface_names.index(name) - assembly.cloth_count
        if assembly.mechanisms[assembly.surface_mechanism[row]].is_dynamic:
            raise InvalidInput(
                f"{start} attachments of cloths to cloths, targets, and bodies or links whose "
                f"motion is given, got one to {name!r}, which is dynamic"
            )


def _able(ability: str) -> str:
    """Names of the schemes that have an ability."""
    return " or ".join(repr(name) for name, able in ABILITIES.items() if able[ability])


def _check_one_stage(scheme: str, scene: Scene, solver: SolverOptions) -> None:
    if solver.elastic == "projective":
        raise InvalidInput(
            "Simulator: `solver.elastic` 'projective' needs a scheme with an elastic stage of "
            f"its own, {_able('elastic_stage')}; {scheme!r} has none"
        )
    for name, body in zip(scene.body_names, scene.bodies, strict=True):
        if body.nodal_contact:
            raise InvalidInput(
                f"Simulator: scheme {scheme!r} has no contact at nodes, which body "
                f"{name!r} asks for by `nodal_contact`; use scheme {_able('elastic_stage')}"
            )


def _check_without_barrier(scheme: str, scene: Scene) -> None:
    for name in scene.robot_names:
        raise InvalidInput(f"Simulator: scheme {scheme!r} takes no robots, got {name!r}")
    for name, body in zip(scene.body_names, scene.bodies, strict=True):
        if body.motion == "dynamic":
            raise InvalidInput(
                f"Simulator: scheme {scheme!r} takes static and kinematic bodies, got the "
                f"dynamic body {name!r}"
            )
        if body.primitive is None:
            raise InvalidInput(
                f"Simulator: scheme {scheme!r} takes bodies made by box, sphere, capsule or "
                f"plane, got the mesh or cylinder {name!r}"
            )
