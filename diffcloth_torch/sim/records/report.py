"""The report of a step: convergence, distances, contacts, time and counts."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.reprs import record_text, value_text
from diffcloth_torch.saved import saved
from diffcloth_torch.sim.records.contacts import Contacts
from diffcloth_torch.sim.records.environments import Choice, Combination, Selection, Stack

__all__ = ["Report", "combine_reports", "outcome_text", "unmade_report"]


def _nothing() -> None:
    return None


class _WithFields:
    """A class whose instances have a dictionary, which `Report.__dict__` completes first."""


_fields_of: Callable[[Any], dict[str, Any]] = vars(_WithFields)["__dict__"].__get__


@saved
@dataclass(frozen=True, eq=False)
class Report(_WithFields):
    """Outcome of a step, in Python numbers, or in tensors of shape [B] in a batch.

    Attributes:
        converged: True if every solve of the step ended in a local minimum: the exact Hessian is
            positive definite there, and the Newton step is below the tolerance. For Projective
            Dynamics, true if the residual is below the tolerance.
        iterations: Newton iterations of all solves of the step, including its prescribed motion.
        residual: Largest displacement of the last Newton step, as a velocity [m/s]; for Projective
            Dynamics, the largest change of velocity by the residual force. The largest value of all
            solves.
        minimum_distance: Smallest distance between mid-surfaces in contact [m]; for smooth bodies
            and links, between the round surfaces. Always above half the sum of their thicknesses;
            infinite if nothing is within the barrier's reach.
        contact_count: Contacts within the barrier distance: pairs of primitives between cloths;
            between a cloth and a body, features that are not hidden behind nearer ones; in
            "projective", vertices that stick or slip.
        motion_fraction: Fraction of the prescribed motion that was completed, 1 for all of it.
        seconds: Phase of the step -> wall-clock time [s], which includes the time of other work on
            the processor; the phases add up to the time in the core.
        counts: Event -> number of times: steps with the `exact` Hessian, `chord` steps with an
            older factor, steps with a `projected` Hessian, Hessians of `negative_curvature`,
            `local_global` iterations of Projective Dynamics, solves `left_to_newton` by Projective
            Dynamics, numeric `factorizations` including failed ones, factorizations `in_doubles`,
            and symbolic `analyses`; vertices in dry frictional contact that are `taking_off`,
            `sticking` and `slipping`.
        status: "converged", "not_converged", "infeasible_motion" or "turned_too_far"; in a batch a
            tuple of B texts. In the report of an `IntersectingState`, environments that intersect
            have "intersecting_state".
        cpu_seconds: Processor time of the step in the core [s], summed over all threads of the
            environment; NaN if unknown.
        contacts: Contacts by pairs of names of surfaces: `contacts["gripper/left", "shirt"]` has
            `count` and `force`.
        criterion: Criterion that ended the deciding solve of the core: the first that failed, else
            the last; in a batch a tuple of B texts. Converged: "tolerance", the Newton step or the
            residual of Projective Dynamics is below the tolerance; "rounding", likewise, and
            rounding hides further progress. Not converged: "iteration_limit"; "time_limit";
            "precision_limit", rounding hides steps above the tolerance; "no_descent", no step along
            the last direction lowers the energy; "blocked", collisions leave no part of the last
            direction; "indefinite", not even the projected Hessian has a factor; "not_finite",
            forces are not finite; "saddle", forces balance at an indefinite Hessian; "no_solution",
            the law of friction at vertices is not satisfied; "stuck_motion", the prescribed motion
            no longer advances. "no_solve" if surfaces intersect at the start, "unknown" in reports
            of earlier versions.
        certified: True if each solve of the step ended with a positive definite Hessian, see
            `SolverOptions.certify`. False for the iterations of Projective Dynamics, which form no
            Hessian, and for steps that have not converged.
    """

    converged: bool | Tensor
    iterations: int | Tensor
    residual: float | Tensor
    minimum_distance: float | Tensor
    contact_count: int | Tensor
    motion_fraction: float | Tensor
    seconds: dict[str, float | Tensor]
    counts: dict[str, int | Tensor] = field(default_factory=dict)
    # Factories, not defaults: the class has no attribute that hides a field not made yet.
    status: str | tuple[str, ...] = field(default_factory=tuple)  # default: from `converged`
    contacts: Contacts = field(default_factory=Contacts)
    cpu_seconds: float | Tensor | None = field(default_factory=_nothing)  # default: unknown
    criterion: str | tuple[str, ...] = field(default_factory=tuple)  # default: unknown
    certified: bool | Tensor | None = field(default_factory=_nothing)  # default: `converged`

    def __post_init__(self) -> None:
        if self.cpu_seconds is None:
            object.__setattr__(self, "cpu_seconds", _unknown_like(self.residual))
        if self.certified is None:
            object.__setattr__(self, "certified", self.converged)
        # Reports may come from files: errors are raised here, not where the report is used.
        for entry in _NUMERIC:
            _check_numbers(entry, self.__dict__.get(entry))
        if self.status == ():
            object.__setattr__(self, "status", _status_by(self.converged))
        if self.criterion == ():
            is_single = isinstance(self.status, str)
            unknown: Any = "unknown" if is_single else ("unknown",) * len(self.status)
            object.__setattr__(self, "criterion", unknown)
        contacts: Any = self.contacts
        if not isinstance(contacts, Contacts):
            kind = type(contacts).__name__
            raise TypeError(f"Report: `contacts` must be Contacts, got {kind}")
        for entry in _TEXTS:
            text = getattr(self, entry)
            names = (text,) if isinstance(text, str) else text
            if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names):
                raise TypeError(
                    f"Report: `{entry}` must be a str or a tuple of them, got {names!r}"
                )

    if not TYPE_CHECKING:  # a type checker knows the fields

        @property
        def __dict__(self) -> dict[str, Any]:
            own = _fields_of(self)
            make = own.get("_make")
            if make is not None:  # see `unmade_report`
                own.update(vars(make()))
                own.pop("_make", None)
            return own

        def __getattr__(self, name: str) -> Any:
            own = self.__dict__
            if name in own:
                return own[name]
            raise AttributeError(f"'Report' object has no attribute {name!r}")

    def __getstate__(self) -> dict[str, Any]:
        return dict(vars(self))

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Checks the fields, and completes a report of version 0.1, which lacks the last three.
        self.__init__(**state)  # type: ignore[misc]

    def __repr__(self) -> str:
        parts = [
            f"{name}={_range_text(getattr(self, name))}" for name in _NUMERIC if name not in _TABLES
        ]
        if self.status != _status_by(self.converged):
            parts.append(f"status={_status_text(self.status)}")
            parts.append(f"criterion={_status_text(self.criterion)}")
        for table in _TABLES:
            # Events that never happened are left out.
            texts = {name: _range_text(number) for name, number in getattr(self, table).items()}
            entries = [f"{name}: {text}" for name, text in texts.items() if text != "0"] or [""]
            entries[0] = f"{table}={{{entries[0]}"
            entries[-1] += "}"
            parts += entries
        return record_text("Report", parts)

    def check_environments(self, owner: str, count: int | None) -> None:
        """Require tensors of shape [count], or numbers if there is no batch axis."""
        shape = [] if count is None else [count]
        for name in (*_NUMERIC, *_TEXTS):
            value = getattr(self, name)
            for number in value.values() if name in _TABLES else [value]:
                if list(np.shape(number)) != shape:
                    raise InvalidInput(
                        f"{owner}: `report.{name}` must have shape {shape}, as the state "
                        f"has environments, got {list(np.shape(number))}"
                    )

    def select(self, index: int | slice | Tensor) -> Report:
        """Return the report of one environment of a batch, or of several."""
        selected = combine_reports(Selection(index, len(self.status)), [self])
        assert selected is not None  # one report agrees with itself
        return selected

    @staticmethod
    def stack(reports: Sequence[Report | None]) -> Report | None:
        """Return the report of a batch from its environments' reports; None if one is missing."""
        return combine_reports(Stack(len(reports)), reports)

    @staticmethod
    def where(mask: Tensor, a: Report | None, b: Report | None) -> Report | None:
        """Choose environments of `a` where `mask` is true, else of `b`; None if one is missing."""
        batched = [report is not None and not isinstance(report.status, str) for report in (a, b)]
        return combine_reports(Choice(mask, batched), [a, b])


def unmade_report(status: str | tuple[str, ...], make: Callable[[], Report]) -> Report:
    """Return a report that is made when another field than its status is first read.

    Args:
        status: Its status.
        make: Makes the report; called at most once by a thread.
    """
    report = object.__new__(Report)
    _fields_of(report).update(status=status, _make=make)
    return report


def combine_reports(how: Combination, reports: Sequence[Report | None]) -> Report | None:
    """Combine environments; None if a report is missing, or they hold different numbers."""
    present = [report for report in reports if report is not None]
    if len(present) < len(reports) or len({_names(report) for report in present}) > 1:
        return None

    def entries(name: str) -> list[Any]:
        return [getattr(report, name) for report in present]

    tables: dict[str, Any] = {
        name: {key: how.numbers([own[key] for own in entries(name)]) for key in first}
        for name in _TABLES
        for first in entries(name)[:1]
    }
    texts: dict[str, Any] = {}
    for name in _TEXTS:
        each = [(text,) if isinstance(text, str) else text for text in entries(name)]
        items = how.items(each)
        texts[name] = items[0] if how.size is None else items
    numbers = {n: how.numbers(entries(n)) for n in _NUMERIC if n not in _TABLES}
    contacts = Contacts.combined(how, entries("contacts"))
    return Report(**numbers, **tables, **texts, contacts=contacts)


def _check_numbers(entry: str, value: Any) -> None:
    """Require a number, or in a table a dict of numbers."""
    table = value if entry in _TABLES else {None: value}
    if not isinstance(table, dict):
        kind = type(table).__name__
        raise TypeError(f"Report: `{entry}` must be a dict of numbers, got {kind}")
    for name, number in table.items():
        if type(number) not in _NUMBERS and not isinstance(number, _NUMBERS):
            label = entry if name is None else f"{entry}[{name!r}]"
            kind = type(number).__name__
            raise TypeError(f"Report: `{label}` must be a number or a tensor, got {kind}")


def _unknown_like(residual: Any) -> Any:
    """NaN for each environment."""
    if isinstance(residual, Tensor):
        return cpu.full(tuple(residual.shape), math.nan)
    return math.nan


def outcome_text(report: Report | None) -> str:
    """Short text of a report, for use within another text."""
    if report is None:
        return "None"
    names = ("converged", "iterations")
    return f"Report({', '.join(f'{n}={_range_text(getattr(report, n))}' for n in names)}, ...)"


def _range_text(values: Any) -> str:
    """Text of a number, or of the range of the numbers of a batch."""
    if not isinstance(values, Tensor) or values.dim() == 0 or values.numel() == 0:
        return value_text(values)
    if values.dtype == torch.bool and values.any() and not values.all():
        return f"{int(values.sum())} of {values.numel()}"
    low, high = (value_text(values.aminmax()[i].item()) for i in range(2))
    return low if low == high else f"{low} .. {high}"


def _status_text(status: str | tuple[str, ...]) -> str:
    """Text of a status or criterion, or of the number of environments with each."""
    if isinstance(status, str):
        return repr(status)
    return f"{{{', '.join(f'{name}: {n}' for name, n in Counter(status).items())}}}"


def _status_by(converged: bool | Tensor) -> str | tuple[str, ...]:
    """Status of steps for which only `converged` is known."""
    names = ("not_converged", "converged")
    if isinstance(converged, Tensor) and converged.dim() > 0:
        return tuple(names[is_true] for is_true in converged.bool().flatten().tolist())
    return names[bool(converged)]


_FIELDS = tuple(entry.name for entry in fields(Report))
# Fields that hold a text, or one for each environment.
_TEXTS = ("status", "criterion")
_NUMERIC = tuple(name for name in _FIELDS if name not in (*_TEXTS, "contacts"))
_NUMBERS = (bool, int, float, Tensor)
# Fields that hold several numbers by name.
_TABLES = ("seconds", "counts")


def _names(report: Report) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(getattr(report, table)) for table in _TABLES)
