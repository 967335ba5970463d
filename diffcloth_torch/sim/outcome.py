"""From the core's diagnostics to a report, or to the exception that a failed step raises."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from diffcloth_torch.errors import (
    InfeasibleMotion,
    IntersectingState,
    NotConverged,
    SimulationError,
)
from diffcloth_torch.sim.report import Report
from diffcloth_torch.sim.step import CONVERGED, DIAGNOSTICS, INFEASIBLE, INTERSECTING, UNCONVERGED

__all__ = ["make_report", "raise_on_failure"]


def _named(prefix: str) -> dict[str, str]:
    """What the core's numbers under a prefix are called in a report -> their full names."""
    return {n.removeprefix(prefix): n for n in DIAGNOSTICS if n.startswith(prefix)}


# What a report says of the core's `status`.
_NAMES = {
    CONVERGED: "converged",
    UNCONVERGED: "not_converged",
    INFEASIBLE: "infeasible_motion",
    INTERSECTING: "intersecting_state",
}
_SECONDS = _named("seconds_")
_COUNTS = _named("count_")


def make_report(diagnostics: dict[str, Any], *, batched: bool) -> Report:
    """Put the core's numbers into a report."""

    def value(numbers: list[Any]) -> Any:
        return torch.from_numpy(np.array(numbers)) if batched else numbers[0]

    names = tuple(_NAMES[status] for status in diagnostics["status"])
    return Report(
        converged=value([status == CONVERGED for status in diagnostics["status"]]),
        iterations=value(diagnostics["iterations"]),
        residual=value(diagnostics["residual"]),
        minimum_distance=value(diagnostics["minimum_distance"]),
        contact_count=value(diagnostics["contact_count"]),
        motion_fraction=value(diagnostics["motion_fraction"]),
        seconds={phase: value(diagnostics[name]) for phase, name in _SECONDS.items()},
        counts={what: value(diagnostics[name]) for what, name in _COUNTS.items()},
        status=names if batched else names[0],
    )


def raise_on_failure(
    diagnostics: dict[str, Any], report: Report, *, throw: bool, batched: bool
) -> None:
    """Raise what is most wrong in any environment; without `throw` only what has no state."""
    status = np.array(diagnostics["status"])
    failures: list[tuple[type[SimulationError], np.ndarray[Any, Any], str]] = [
        (
            IntersectingState,
            status == INTERSECTING,
            "surfaces overlap in the given state",
        ),
        (
            InfeasibleMotion,
            (status == INFEASIBLE) & throw,
            "the prescribed motion cannot be completed without an intersection; move bodies and "
            "pins less far in a step, or make room for the cloth",
        ),
        (
            NotConverged,
            (status == UNCONVERGED) & throw,
            "the solver stopped before its tolerance was reached; raise "
            "SolverOptions.max_iterations or tolerance, or lower dt",
        ),
    ]
    for error, failed, sentence in failures:
        environments = np.flatnonzero(failed).tolist()
        if environments:
            first = environments[0]
            place = f"environments {environments}: " if batched else ""
            detail = diagnostics["message"][first]
            numbers = (
                f"iterations {diagnostics['iterations'][first]}, residual "
                f"{diagnostics['residual'][first]:.3g} m/s, motion fraction "
                f"{diagnostics['motion_fraction'][first]:.3g}"
            )
            text = f"step: {place}{sentence} ({detail + '; ' if detail else ''}{numbers})"
            raise error(text, report=report, environments=environments)
