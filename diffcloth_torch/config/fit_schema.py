"""The schema of fits in configurations: variables and observations."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Len, Lt
from pydantic import model_validator

from diffcloth_torch.config.scene_schema import Selection
from diffcloth_torch.config.schema import RunConfig
from diffcloth_torch.config.section import (
    Count,
    Positive,
    Section,
    Seed,
    Updates,
    Vector3,
    require_one,
)
from diffcloth_torch.processes import DEADLINE, LARGEST_WORKERS, LONGEST_DEADLINE

__all__ = ["FitConfig", "FitSection", "SyntheticSection", "TrajectorySection", "VariableSection"]

Numbers = float | list[float]


class VariableSection(Section):
    """A variable of a fit, as in `Variable`."""

    value: Numbers
    bounds: Annotated[list[float], Len(2, 2)] | None = None
    scale: Literal["log", "linear"] | None = None
    free: bool = True
    spread: Annotated[float, Gt(1)] = 3.0
    prior: Annotated[list[Numbers], Len(2, 2)] | None = None


class SyntheticSection(Section):
    """Observations from another simulation, to test a fit with known values.

    `changes` are assignments to the configuration, as after `--set`: a finer mesh, a smaller time
    step. `values` are the true values of the variables; the noise has the standard deviation of the
    trajectory.
    """

    values: dict[str, Numbers]
    changes: list[str] = []
    seed: Seed = 0


class TrajectorySection(Section):
    """Observations of one motion, or of one equilibrium.

    `changes` are assignments to the configuration that define this motion, as after `--set`. The
    cloth is observed after each of `steps`, or once at `equilibrium`. `file` is an .npz with the
    `positions` [T, m, 3] of the `markers` (NaN for markers that were not visible), or with the
    `outlines` [T, n, 2] of silhouettes seen from above, around `center`, about which they may be
    `turned`.
    """

    name: str
    changes: list[str] = []
    kind: Literal["markers", "outline"] = "markers"
    steps: Annotated[list[Count], Len(1)] | None = None
    equilibrium: bool = False
    velocity: Vector3 | None = None
    markers: Selection | None = None
    center: Annotated[list[float], Len(2, 2)] = [0.0, 0.0]
    directions: Annotated[int, Ge(3)] = 72
    turned: bool = False
    noise: Positive
    file: str | None = None
    synthetic: SyntheticSection | None = None
    hold_out: bool = False

    @model_validator(mode="after")
    def _check_trajectory(self) -> TrajectorySection:
        require_one(self, ("file", "synthetic"))
        if self.equilibrium == (self.steps is not None):
            raise ValueError("must have `steps`, or `equilibrium: true`, not both")
        if self.steps is not None and sorted(set(self.steps)) != self.steps:
            raise ValueError(f"must have increasing `steps`, got {self.steps}")
        if self.kind == "outline" and self.markers is not None:
            raise ValueError("has the kind `outline` and must have no `markers`")
        return self


class FitSection(Section):
    """Variables by name, trajectories, and the options of `fit`.

    `extrapolate` fits residuals that are extrapolated to a time step of zero, from the time steps
    dt and dt / 2. Otherwise `step_check` estimates the bias of the time step after the fit.
    """

    variables: Annotated[dict[str, VariableSection], Len(1)]
    trajectories: Annotated[list[TrajectorySection], Len(1)]
    starts: Annotated[int, Ge(1), Le(10**6)] = 1
    seed: Seed = 0
    workers: Annotated[int, Ge(0), Le(LARGEST_WORKERS)] = 0
    deadline: Annotated[float, Gt(0), Lt(LONGEST_DEADLINE)] = DEADLINE
    method: Literal["least_squares", "L-BFGS-B"] = "least_squares"
    loss: Literal["linear", "soft_l1", "huber", "cauchy", "arctan"] = "linear"
    loss_scale: Positive = 1.0
    max_evaluations: Updates = 100
    tolerance: Positive = 1e-8
    covariance: Literal["auto", "white", "robust"] = "auto"
    extrapolate: bool = False
    step_check: bool = True

    @model_validator(mode="after")
    def _check_trajectories(self) -> FitSection:
        if all(trajectory.hold_out for trajectory in self.trajectories):
            raise ValueError("must have a trajectory without `hold_out` in `trajectories`")
        return self

    @model_validator(mode="after")
    def _check_extrapolation(self) -> FitSection:
        if self.extrapolate and all(trajectory.equilibrium for trajectory in self.trajectories):
            raise ValueError("has `extrapolate: true` and must have a trajectory with `steps`")
        if self.extrapolate and any(t.kind != "markers" for t in self.trajectories):
            raise ValueError(
                "has `extrapolate: true`, so that all `trajectories` must be of the kind "
                "`markers`: residuals of an `outline` are not linear in positions"
            )
        return self


class FitConfig(RunConfig):
    """A scene, and a fit of its variables."""

    fit: FitSection
