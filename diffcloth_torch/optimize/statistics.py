"""Sums and extremes over the steps of rollouts, in types that JSON has."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from diffcloth_torch.sim.records.report import Report
from diffcloth_torch.sim.records.state import State

__all__ = ["finite_or_none", "reports_of", "rollout_statistics"]


def reports_of(states: Sequence[State]) -> list[Report]:
    """Reports of the steps that led to the given states."""
    return [state.report for state in states if state.report is not None]


def finite_or_none(value: float) -> float | None:
    """Replace values that JSON cannot write by None: distance of far surfaces, unknown time."""
    return value if math.isfinite(value) else None


def rollout_statistics(states: Sequence[State]) -> dict[str, Any]:
    """Sums and extremes over the steps, in all environments, that led to the given states."""
    reports = reports_of(states)

    def all_of(name: str) -> list[Any]:
        return [value for report in reports for value in _values(getattr(report, name))]

    seconds: dict[str, float] = {}
    for report in reports:
        for phase, numbers in report.seconds.items():
            for value in _values(numbers):
                seconds[phase] = seconds.get(phase, 0.0) + float(value)
    contacts = [int(count) for count in all_of("contact_count")]
    converged = all_of("converged")
    return {
        "steps": len(converged),
        "converged_steps": sum(bool(value) for value in converged),
        "newton_iterations": sum(int(value) for value in all_of("iterations")),
        "largest_residual": max(map(float, all_of("residual")), default=0.0),
        "minimum_distance": finite_or_none(
            min(map(float, all_of("minimum_distance")), default=math.inf)
        ),
        "largest_contact_count": max(contacts, default=0),
        "steps_with_contact": sum(count > 0 for count in contacts),
        "phase_seconds": seconds,
        "cpu_seconds": finite_or_none(sum(map(float, all_of("cpu_seconds")))),
    }


def _values(number: Any) -> list[Any]:
    """List the number of one environment, or the numbers of a batch."""
    return number.flatten().tolist() if isinstance(number, torch.Tensor) else [number]
