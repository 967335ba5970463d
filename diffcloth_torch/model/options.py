"""How a simulator treats contact and how far it solves."""

from __future__ import annotations

from dataclasses import dataclass

from diffcloth_torch.checks import POSITIVE, check_bool, check_choice, check_count, check_number
from diffcloth_torch.model.quantities import check_parameter

__all__ = ["COUPLINGS", "ELASTIC_SOLVERS", "METRICS", "SCHEMES", "ContactOptions", "SolverOptions"]

SCHEMES = ("coupled", "split", "projective")
METRICS = ("energy", "elastic", "mass", "identity")
ELASTIC_SOLVERS = ("newton", "projective")
COUPLINGS = ("monolithic", "rigid_to_cloth", "cloth_to_rigid")


@dataclass(frozen=True, eq=False)
class ContactOptions:
    """Contact and friction.

    Attributes:
        barrier_distance: Gap below which surfaces repel each other [m], > 0; None chooses it from
            the cloths when the simulator is made.
        barrier_stiffness: Stiffness of the barrier of all pairs of surfaces [Pa], > 0; None chooses
            each pair's from its cloths and from what is heavy of the two.
        friction_iterations: Solves per step in which the friction force is updated, >= 1.
        slip_velocity: Velocity at which sticking turns into sliding [m/s], > 0.
        self_contact: Whether a cloth collides with itself.
    """

    barrier_distance: float | None = None
    barrier_stiffness: float | None = None
    friction_iterations: int = 2
    slip_velocity: float = 1e-3
    self_contact: bool = True

    def __post_init__(self) -> None:
        for field in ("barrier_distance", "barrier_stiffness", "slip_velocity"):
            value = getattr(self, field)
            if value is None and field != "slip_velocity":
                continue
            object.__setattr__(self, field, check_parameter("ContactOptions", field, value))
        iterations = check_count(
            "ContactOptions: `friction_iterations`", self.friction_iterations, 1
        )
        object.__setattr__(self, "friction_iterations", iterations)
        self_contact = check_bool("ContactOptions: `self_contact`", self.self_contact)
        object.__setattr__(self, "self_contact", self_contact)


@dataclass(frozen=True, eq=False)
class SolverOptions:
    """How far a step is solved, and by what.

    Attributes:
        tolerance: Largest step with the exact Hessian that counts as converged, as a velocity
            [m/s], > 0. Of Projective Dynamics the largest change of velocity that the residual
            force gives a vertex in a time step.
        max_iterations: Newton iterations that a step may take over all its solves, >= 1. Common are
            5 to 40; single steps of a sheet that whips take some hundreds. Projective Dynamics may
            take 50 times as many of its own, which cost about as much less.
        throw: Whether a step that fails in any environment raises `NotConverged` or
            `InfeasibleMotion`. Otherwise `report.status` says which failed, and their state is the
            last feasible iterate: bodies, joints and pins are where the motion ended (in staggered
            couplings, where it began). Backward raises the error where a loss depends on them.
        metric: What "nearest" means in the contact stage of the scheme "split": "energy" (inertia
            and elasticity, as they are), or a norm: "elastic" (the masses plus h^2 times the
            constant matrix of Projective Dynamics), "mass", or "identity" (the paper's Eq. 22).
            None means "energy" for "split"; the others have no choice.
        elastic: What solves the elastic stage of the schemes "split" and "projective": "newton", or
            "projective", the local/global iterations of Projective Dynamics. Both find the same
            positions.
    """

    tolerance: float = 1e-6
    max_iterations: int = 1000
    throw: bool = True
    metric: str | None = None
    elastic: str = "newton"

    def __post_init__(self) -> None:
        tolerance = check_number(
            "SolverOptions: `tolerance`", self.tolerance, POSITIVE, instead="pass a plain number"
        )
        object.__setattr__(self, "tolerance", tolerance)
        iterations = check_count("SolverOptions: `max_iterations`", self.max_iterations, 1)
        object.__setattr__(self, "max_iterations", iterations)
        object.__setattr__(self, "throw", check_bool("SolverOptions: `throw`", self.throw))
        check_choice("SolverOptions: `elastic`", self.elastic, ELASTIC_SOLVERS)
        if self.metric is not None:
            check_choice("SolverOptions: `metric`", self.metric, METRICS)
