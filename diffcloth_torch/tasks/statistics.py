"""Numbers about rollouts, in types that JSON has."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from diffcloth_torch.sim.report import Report
from diffcloth_torch.sim.state import State

__all__ = ["replace_file", "rollout_statistics", "step_records", "write_metrics"]


def _reports(states: Sequence[State]) -> list[Report]:
    return [state.report for state in states if state.report is not None]


def rollout_statistics(states: Sequence[State]) -> dict[str, Any]:
    """Sums and extremes over the steps that led to some states."""
    reports = _reports(states)
    distances = [float(report.minimum_distance) for report in reports]
    seconds: dict[str, float] = {}
    for report in reports:
        for phase, value in report.seconds.items():
            seconds[phase] = seconds.get(phase, 0.0) + float(value)
    return {
        "steps": len(reports),
        "converged_steps": sum(bool(report.converged) for report in reports),
        "newton_iterations": sum(int(report.iterations) for report in reports),
        "largest_residual": max((float(report.residual) for report in reports), default=0.0),
        "minimum_distance": _finite(min(distances, default=math.inf)),
        "largest_contact_count": max((int(report.contact_count) for report in reports), default=0),
        "steps_with_contact": sum(int(report.contact_count) > 0 for report in reports),
        "phase_seconds": seconds,
    }


def step_records(states: Sequence[State]) -> list[dict[str, Any]]:
    """One record for each step that led to some states."""
    return [
        {
            "time": float(state.time),
            "converged": bool(report.converged),
            "iterations": int(report.iterations),
            "residual": float(report.residual),
            "minimum_distance": _finite(float(report.minimum_distance)),
            "contact_count": int(report.contact_count),
            "motion_fraction": float(report.motion_fraction),
            "seconds": sum(float(value) for value in report.seconds.values()),
        }
        for state, report in zip(states, _reports(states), strict=True)
    ]


def _finite(distance: float) -> float | None:
    """Replace the infinite distance of surfaces that are not near each other: JSON has none."""
    return distance if math.isfinite(distance) else None


def write_metrics(path: Path, metrics: dict[str, Any]) -> None:
    """Write numbers as JSON; the file is complete or the old one."""
    text = json.dumps(metrics, indent=2, allow_nan=False) + "\n"
    with replace_file(path) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Give a path to write to, which becomes `path` when all is written."""
    part = path.with_suffix(".part")
    yield part
    part.replace(path)
