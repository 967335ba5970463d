"""Options of contact and of the solver."""

from __future__ import annotations

from dataclasses import dataclass

from diffcloth_torch import _core
from diffcloth_torch.checks import POSITIVE, check_bool, check_choice, check_count, check_number
from diffcloth_torch.model.quantities import check_parameter
from diffcloth_torch.reprs import dataclass_text
from diffcloth_torch.saved import saved

__all__ = [
    "ABILITIES",
    "CERTIFY",
    "COUPLINGS",
    "ELASTIC_SOLVERS",
    "INTEGRATORS",
    "METRICS",
    "SCHEMES",
    "ContactOptions",
    "SolverOptions",
]

ABILITIES = _core.schemes
"""Capabilities of each scheme; the default is first."""
SCHEMES = tuple(ABILITIES)
INTEGRATORS = tuple(_core.integrators)
METRICS = tuple(_core.metrics)
ELASTIC_SOLVERS = tuple(_core.elastic_solvers)
CERTIFY = ("always", "gradients")
"""Solves that end with a factor of the exact Hessian: all, or only the differentiated ones."""
COUPLINGS = ("monolithic", "rigid_to_cloth", "cloth_to_rigid")
"""Coupling of cloths and dynamic bodies: solved together, or one after the other."""


@saved
@dataclass(frozen=True, eq=False)
class ContactOptions:
    """Options of contact and friction.

    Attributes:
        barrier_distance: Gap below which surfaces repel each other [m], > 0; None derives a
            distance from the cloths when the simulator is made.
        barrier_stiffness: Stiffness of the barrier of all pairs of surfaces [Pa], > 0; None derives
            a value for each pair from its cloths and from its free bodies.
        friction_iterations: Solves per step, each with updated friction forces, >= 1.
        slip_velocity: Velocity at which sticking turns into sliding [m/s], > 0. For joints
            with friction, in scenes without contact too: the velocity of the parts they move.
        self_contact: Whether a cloth collides with itself.
    """

    barrier_distance: float | None = None
    barrier_stiffness: float | None = None
    friction_iterations: int = 2
    slip_velocity: float = 1e-5
    self_contact: bool = True

    __repr__ = dataclass_text

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


@saved
@dataclass(frozen=True, eq=False)
class SolverOptions:
    """Tolerance, limits and methods of the solver.

    Attributes:
        tolerance: Largest step with the exact Hessian that counts as converged, as a velocity
            [m/s], > 0. For Projective Dynamics: largest change of velocity of a vertex
            by the residual force in a time step.
        max_iterations: Largest number of Newton iterations in a step, over all its solves, >= 1.
            Between 5 and 40 is common; single steps of a whipping sheet need some hundreds.
            Projective Dynamics may need 50 times as many iterations, which are cheaper by about the
            same factor.
        throw: Whether a step that fails in any environment raises `NotConverged`,
            `InfeasibleMotion` or `TurnedTooFar`. Otherwise `report.status` shows which environments
            failed. Their state is the last feasible iterate: bodies, joints and pins are where the
            motion ended (in staggered couplings, where it began). Backward raises the error if a
            loss depends on them.
        metric: Definition of "nearest" in the contact stage of the scheme "split": "energy" (the
            energy of inertia and elasticity), or a norm: "elastic" (the mass matrix plus h^2 times
            the constant matrix of Projective Dynamics), "mass", or "identity" (the paper's Eq. 22).
            None means "energy" for "split". Other schemes accept only None.
        elastic: Method for the elastic stage of the schemes "split" and "projective": "newton", or
            "projective", the local/global iterations of Projective Dynamics. Both find the same
            positions.
        max_seconds: Longest wall-clock time of a step of one environment [s], > 0; None sets no
            limit. A step that exceeds the limit ends like a step whose iterations are used up,
            after a few more factorizations. Which steps exceed the limit depends on the machine and
            its load: with a limit, the same input yields the same bits only if every step ends in
            time. The limit applies to each solve of a staggered coupling, and to each step in the
            search for an equilibrium. Backward has no limit.
        certify: Solves that end with a factor of the exact Hessian, which shows that forces balance
            at a minimum. "always": every solve. "gradients": a Newton or chord step below the
            tolerance may also end a solve of the scheme "coupled"; `report.certified` is then
            False. The result is the same with and without gradients. Backward and tangents
            of such a step certify its end first, with further Newton steps where the end is not
            accurate enough, or raise `SimulationError`. `equilibrium` always certifies.
    """

    tolerance: float = 1e-6
    max_iterations: int = 1000
    throw: bool = True
    metric: str | None = None
    elastic: str = "newton"
    max_seconds: float | None = None
    certify: str = "always"

    __repr__ = dataclass_text

    def __post_init__(self) -> None:
        tolerance = check_number("SolverOptions: `tolerance`", self.tolerance, POSITIVE)
        object.__setattr__(self, "tolerance", tolerance)
        iterations = check_count("SolverOptions: `max_iterations`", self.max_iterations, 1)
        object.__setattr__(self, "max_iterations", iterations)
        if self.max_seconds is not None:
            seconds = check_number("SolverOptions: `max_seconds`", self.max_seconds, POSITIVE)
            object.__setattr__(self, "max_seconds", seconds)
        object.__setattr__(self, "throw", check_bool("SolverOptions: `throw`", self.throw))
        check_choice("SolverOptions: `elastic`", self.elastic, ELASTIC_SOLVERS)
        if self.metric is not None:
            check_choice("SolverOptions: `metric`", self.metric, METRICS)
        check_choice("SolverOptions: `certify`", self.certify, CERTIFY)
