"""Statistics of steps, in types that JSON has, and their files."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from diffcloth_torch.optimize.statistics import finite_or_none, reports_of
from diffcloth_torch.sim.records.state import State

__all__ = ["replace_file", "step_records", "write_metrics"]


def step_records(states: Sequence[State]) -> list[dict[str, Any]]:
    """One record for each step that led to the given states."""
    return [
        {
            "time": float(state.time),
            "converged": bool(report.converged),
            "iterations": int(report.iterations),
            "residual": float(report.residual),
            "minimum_distance": finite_or_none(float(report.minimum_distance)),
            "contact_count": int(report.contact_count),
            "motion_fraction": float(report.motion_fraction),
            "seconds": sum(float(value) for value in report.seconds.values()),
        }
        for state, report in zip(states, reports_of(states), strict=True)
    ]


def write_metrics(path: Path, metrics: dict[str, Any]) -> None:
    """Write numbers as JSON; the file is replaced completely or not at all."""
    text = json.dumps(metrics, indent=2, allow_nan=False) + "\n"
    with replace_file(path) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yield a path to write to, which replaces `path` when all is written."""
    part = path.with_suffix(".part")
    yield part
    part.replace(path)
