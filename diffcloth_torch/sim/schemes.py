"""What each scheme can take: combinations that a simulator refuses by name."""

from __future__ import annotations

from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.options import SolverOptions
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.layout import Layout

__all__ = ["check_scheme"]


def check_scheme(
    scheme: str, coupling: str, scene: Scene, layout: Layout, solver: SolverOptions
) -> None:
    """Refuse options that a scheme has no meaning for, and what it cannot move or touch.

    Args:
        scheme: "coupled", "split" or "projective".
        coupling: "monolithic", "rigid_to_cloth" or "cloth_to_rigid".
        scene: What is simulated.
        layout: Its rows, and what moves them.
        solver: Solver options.

    Raises:
        InvalidInput: If something is not accepted.
    """
    # The other schemes measure inertia in the masses; "mass", once the default, says just that.
    if scheme != "split" and solver.metric not in (None, "mass"):
        raise InvalidInput(
            f"Simulator: `solver.metric` {solver.metric!r} needs scheme 'split', got {scheme!r}"
        )
    if scheme == "coupled":
        _check_coupled(scene, solver)
    if scheme == "split" and coupling == "monolithic" and layout.is_dynamic:
        raise InvalidInput(
            "Simulator: scheme 'split' takes prescribed bodies and the staggered couplings "
            "'rigid_to_cloth' and 'cloth_to_rigid'; the scene has something that forces move and "
            "`coupling` is 'monolithic'"
        )
    if scheme == "projective":
        _check_projective(scene)


def _check_coupled(scene: Scene, solver: SolverOptions) -> None:
    if solver.elastic == "projective":
        raise InvalidInput(
            "Simulator: `solver.elastic` 'projective' needs a scheme with an elastic stage of "
            "its own, 'split' or 'projective'; 'coupled' has none"
        )
    for name, body in zip(scene.body_names, scene.bodies, strict=True):
        if body.nodal_contact:
            raise InvalidInput(
                "Simulator: scheme 'coupled' has no contact at nodes, which body "
                f"{name!r} asks for by `nodal_contact`; use scheme 'split' or 'projective'"
            )


def _check_projective(scene: Scene) -> None:
    for name in scene.robot_names:
        raise InvalidInput(f"Simulator: scheme 'projective' takes no robots, got {name!r}")
    for name, body in zip(scene.body_names, scene.bodies, strict=True):
        if body.motion == "dynamic":
            raise InvalidInput(
                "Simulator: scheme 'projective' takes static and kinematic bodies, got the "
                f"dynamic body {name!r}"
            )
        if body.primitive is None:
            raise InvalidInput(
                "Simulator: scheme 'projective' takes bodies made by box, sphere, capsule or "
                f"plane, got the mesh or cylinder {name!r}"
            )
