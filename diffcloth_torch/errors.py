"""The exceptions and warnings of the package. A wrong dtype or device is a plain `TypeError`."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Sequence
from functools import wraps
from types import FrameType
from typing import Any, ParamSpec, TypeVar

__all__ = [
    "AddedMassWarning",
    "BarrierStartWarning",
    "CorrelatedResidualsWarning",
    "InadmissibleMaterial",
    "InfeasibleMotion",
    "IntersectingState",
    "InvalidInput",
    "MeshBiasWarning",
    "ModelErrorWarning",
    "NoiseWarning",
    "NotConverged",
    "SimulationError",
    "StepBiasWarning",
    "TurnedTooFar",
    "WorkerError",
]


P = ParamSpec("P")
T = TypeVar("T")


class InvalidInput(ValueError):  # noqa: N818 - names of the public contract
    """An argument has a wrong shape, value or name; the message names it and accepted values."""


class InadmissibleMaterial(InvalidInput):
    """Numbers within their ranges that together describe no material."""


class SimulationError(RuntimeError):
    """The simulation itself failed; the given state is unchanged.

    Attributes:
        report: Report of the failed step, or None if no step was computed.
        environments: Indices of the environments that failed in this way, (0,) without a batch
            axis; `report.status` has the status of all.
    """

    def __init__(
        self, message: str, *, report: Any = None, environments: Sequence[int] = ()
    ) -> None:
        super().__init__(message)
        self.report = report
        self.environments = tuple(environments)


class IntersectingState(SimulationError):  # noqa: N818
    """Two surfaces overlap at the start: they intersect, touch, or are closer than allowed."""


class InfeasibleMotion(SimulationError):  # noqa: N818
    """The prescribed motion of bodies, joints and pins was not completed.

    Raised by a step, or by backward through a step whose failure was returned as a value.
    """


class NotConverged(SimulationError):  # noqa: N818
    """The solver stopped above its tolerance; the message gives the reason.

    Raised by a step, or by backward through a step whose failure was returned as a value.
    """


class TurnedTooFar(SimulationError):  # noqa: N818
    """A dynamic body turns further in a step than contact resolves; the message names it.

    Raised by a step, or by backward through a step whose failure was returned as a value.
    """


class WorkerError(RuntimeError):
    """The workers of a piece of work died, or missed its deadline, repeatedly."""


class AddedMassWarning(UserWarning):
    """In a staggered coupling, a body or a link is too light for the cloth that it touches."""


class BarrierStartWarning(UserWarning):
    """Surfaces start so deep in the barrier that it throws them apart; the message names them."""


class StepBiasWarning(UserWarning):
    """The time step shifts fitted numbers by more than the half width of their intervals."""


class MeshBiasWarning(UserWarning):
    """The mesh shifts fitted numbers by more than the half width of their intervals."""


class ModelErrorWarning(UserWarning):
    """Residuals of a fit are too large for their noise: its intervals need not hold the truth."""


class NoiseWarning(UserWarning):
    """Residuals of a fit are too small for the noise that was given."""


class CorrelatedResidualsWarning(UserWarning):
    """Residuals of a fit are correlated along their series, and its intervals account for it."""


def warn_caller(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the line outside of the package, and of torch, that called it."""
    frame = sys._getframe(1)
    level = 2  # level of that frame
    while frame.f_back is not None and _is_inside(frame):
        frame = frame.f_back
        level += 1
    warnings.warn(message, category, stacklevel=level)


def renamed(**names: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Take keywords under their earlier names, too, with a warning.

    Args:
        **names: Earlier name -> name.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        @wraps(function)
        def call(*args: P.args, **keywords: P.kwargs) -> T:
            for earlier in names.keys() & keywords.keys():
                name = names[earlier]
                owner = function.__name__
                if name in keywords:
                    raise TypeError(f"{owner}: `{earlier}` is `{name}`, which is given, too")
                warn_caller(f"{owner}: `{earlier}` is named `{name}` since 0.2.0", FutureWarning)
                keywords[name] = keywords.pop(earlier)
            return function(*args, **keywords)

        return call

    return decorate


def _is_inside(frame: FrameType) -> bool:
    module: str = frame.f_globals.get("__name__", "")
    return module.partition(".")[0] in ("diffcloth_torch", "torch")
