"""From the core's diagnostics to a report, or to the exception that a failed step raises."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.errors import (
    InfeasibleMotion,
    IntersectingState,
    NotConverged,
    SimulationError,
    TurnedTooFar,
)
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.records.contacts import Contacts
from diffcloth_torch.sim.records.report import Report, unmade_report
from diffcloth_torch.sim.solve.step import (
    CONVERGED,
    CRITERIA,
    DIAGNOSTICS,
    INFEASIBLE,
    INTERSECTING,
    TURNED,
    UNCONVERGED,
)

__all__ = ["lazy_report", "make_report", "raise_on_failure"]


def _named(prefix: str) -> dict[str, str]:
    """Name in a report -> full name, for the core's numbers with a prefix."""
    return {n.removeprefix(prefix): n for n in DIAGNOSTICS if n.startswith(prefix)}


# Texts of a report for the core's `status`.
_NAMES = {
    CONVERGED: "converged",
    UNCONVERGED: "not_converged",
    INFEASIBLE: "infeasible_motion",
    INTERSECTING: "intersecting_state",
    TURNED: "turned_too_far",
}
_SECONDS = _named("seconds_")
_COUNTS = _named("count_")
# Fields of a report that are numbers of the core, by type, with the entries of its tables.
_INTEGERS = ("iterations", "contact_count")
_REALS = ("residual", "minimum_distance", "motion_fraction", "cpu_seconds")
_ROWS: dict[type, tuple[str, ...]] = {
    np.int64: (*_INTEGERS, *_COUNTS.values()),
    np.float64: (*_REALS, *_SECONDS.values()),
}
_REPORTED = tuple(name for names in _ROWS.values() for name in names)


def lazy_report(diagnostics: dict[str, Any], surfaces: Sequence[str], *, batched: bool) -> Report:
    """Return the report of `make_report`, made when it is read: most steps of a loop are not."""
    names = tuple([_NAMES[status] for status in diagnostics["status"]])
    make = partial(make_report, diagnostics, surfaces, batched=batched)
    return unmade_report(names if batched else names[0], make)


def make_report(diagnostics: dict[str, Any], surfaces: Sequence[str], *, batched: bool) -> Report:
    """Make a report of the core's numbers, with the names of the surfaces."""
    names = tuple(_NAMES[status] for status in diagnostics["status"])
    criteria = tuple(CRITERIA[criterion] for criterion in diagnostics["criterion"])
    converged: list[bool] = [status == CONVERGED for status in diagnostics["status"]]
    certified = [
        done and bool(flag) for done, flag in zip(converged, diagnostics["certified"], strict=True)
    ]
    numbers = _tensors(diagnostics) if batched else {n: diagnostics[n][0] for n in _REPORTED}
    return Report(
        **{name: numbers[name] for name in (*_INTEGERS, *_REALS)},
        converged=torch.from_numpy(np.array(converged)) if batched else converged[0],
        seconds={phase: numbers[name] for phase, name in _SECONDS.items()},
        counts={what: numbers[name] for what, name in _COUNTS.items()},
        status=names if batched else names[0],
        criterion=criteria if batched else criteria[0],
        certified=torch.from_numpy(np.array(certified)) if batched else certified[0],
        contacts=Contacts.of(
            diagnostics["pairs"], diagnostics["points"], surfaces, batched=batched
        ),
    )


def _tensors(diagnostics: dict[str, Any]) -> dict[str, Tensor]:
    """The reported numbers of a batch, [B] each: numbers of one type are rows of one array."""
    rows: dict[str, Tensor] = {}
    for kind, names in _ROWS.items():
        table = torch.from_numpy(np.array([diagnostics[n] for n in names], dtype=kind))
        rows |= zip(names, table.unbind(), strict=True)
    return rows


def raise_on_failure(
    diagnostics: dict[str, Any], report: Report, *, throw: bool, batched: bool
) -> None:
    """Raise the worst failure of any environment; without `throw` only one without a state."""
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
            "the prescribed motion was not completed; move bodies and pins less far in a step, or "
            "make room for the cloth",
        ),
        (
            NotConverged,
            (status == UNCONVERGED) & throw,
            "the solver stopped before its tolerance was reached",
        ),
        (
            TurnedTooFar,
            (status == TURNED) & throw,
            "a body turns further than a step resolves",
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
                f"{_share(diagnostics['motion_fraction'][first])}"
            )
            text = f"{operation()}: {place}{sentence} ({detail + '; ' if detail else ''}{numbers})"
            raise error(text, report=report, environments=environments)


def _share(fraction: float) -> str:
    """Three digits; a fraction below one is not rounded to one."""
    left = 1.0 - fraction
    return f"1 - {left:.1g}" if 0.0 < left < 1e-3 else f"{fraction:.3g}"
