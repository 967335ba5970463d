"""Residuals as functions of the vector that a solver searches, with a store of evaluations."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import forward_ad

from diffcloth_torch import cpu
from diffcloth_torch.checkpoint import (
    check_like,
    read_checkpoint,
    refusing_damage,
    write_checkpoint,
)
from diffcloth_torch.checks import FloatArray
from diffcloth_torch.errors import InadmissibleMaterial, InvalidInput, SimulationError
from diffcloth_torch.model.quantities import PARAMETERS
from diffcloth_torch.optimize.compared import blocks_of, noting
from diffcloth_torch.optimize.series import Layout, layout_of
from diffcloth_torch.optimize.variables import Space
from diffcloth_torch.reprs import dataclass_text
from diffcloth_torch.sim.records.controls import Parameters

__all__ = [
    "FAILURES",
    "Failure",
    "Memory",
    "Problem",
    "Residuals",
    "Trial",
    "blocks_at",
    "parameters_of",
    "trajectories",
]

_CHECKPOINT = "fit"  # kind of the files of evaluations

Residuals = Callable[..., Tensor | Sequence[Tensor] | Mapping[str, Tensor]]

Failure = SimulationError | InadmissibleMaterial
FAILURES = (SimulationError, InadmissibleMaterial)
"""Errors that reject a trial step and do not end the fit. Bounds apply to each number separately,
and do not exclude combinations that belong to no material."""

# Parts of the messages of torch for `.numpy()` of a tensor that is being differentiated.
_NO_NUMBERS = ("call numpy() on Tensor", "access data pointer of Tensor")
_NO_DERIVATIVE = (
    "as it is differentiated: `.numpy()`, `.detach()`, `.item()`, `float()` and `torch.tensor()` "
    "of a state or a parameter keep no derivative; `dc.residuals` and the functions of torch do"
)


@dataclass(frozen=True, eq=False)
class Trial:
    """One evaluation of the residuals.

    Attributes:
        start: Index of the start.
        stage: Index of the stage.
        cost: Half the sum of squares; infinite if the simulation failed.
        values: Values of all variables.
        seconds: Wall time of the evaluation [s].
        failure: Error of the simulation; empty if it succeeded.
    """

    start: int
    stage: int
    cost: float
    values: dict[str, Tensor]
    seconds: float
    failure: str = ""

    __repr__ = dataclass_text


class Memory:
    """Evaluations of one start, stored in a file, from which a resumed fit reads them."""

    def __init__(self, file: Path | None, problem: Sequence[Any]) -> None:
        """Read the evaluations of an earlier run.

        Args:
            file: File of the evaluations; None stores nothing.
            problem: Description of the problem, in types that `torch.load` reads.

        Raises:
            InvalidInput: If the file belongs to another problem, or holds no evaluations.
        """
        self._file, self._problem = file, list(problem)
        self._records: dict[tuple[str, int, bytes], dict[str, Any]] = {}
        if file is None or not file.exists():
            return
        owner = "fit: `resume`"
        saved = read_checkpoint(owner, file, _CHECKPOINT)
        with refusing_damage(owner, file):
            check_like("the content", dict.fromkeys(saved), {"problem": None, "records": None})
            found = {_checked_key(record): record for record in saved["records"]}
            _check_sizes(found)
            if saved["problem"] != self._problem:
                raise InvalidInput(
                    f"it belongs to other variables or options: {saved['problem']}; "
                    f"these are {self._problem}"
                )
        self._records = found

    def recall(self, kind: str, stage: int, theta: FloatArray) -> dict[str, Any] | None:
        """Look up an evaluation of residuals or of their Jacobian."""
        return self._records.get((kind, stage, theta.tobytes()))

    def keep(self, kind: str, stage: int, theta: FloatArray, **found: Any) -> dict[str, Any]:
        """Add an evaluation, and write the file."""
        numbers = torch.from_numpy(np.array(theta))
        record = {"kind": kind, "stage": stage, "theta": numbers, **found}
        self._records[kind, stage, theta.tobytes()] = record
        if self._file is not None:
            content = {"problem": self._problem, "records": list(self._records.values())}
            write_checkpoint(self._file, _CHECKPOINT, content)
        return record


class Problem:
    """Residuals of one stage of one start, as functions of the free part of theta."""

    def __init__(
        self,
        space: Space,
        residuals: Residuals,
        *,
        at: FloatArray,
        rows: NDArray[np.int64],
        start: int,
        stage: int,
        memory: Memory,
        report: Callable[[Trial], None],
    ) -> None:
        """Fix all but some rows of theta.

        Args:
            space: Space of theta.
            residuals: The residuals of the stage.
            at: The whole theta at the beginning of the stage.
            rows: Free rows of theta.
            start: Index of the start.
            stage: Index of the stage.
            memory: Evaluations of the start.
            report: Called after each evaluation.
        """
        self.history: list[Trial] = []
        self._space, self._at, self._rows = space, torch.from_numpy(at.copy()), rows
        self._residuals, self._memory, self._report = residuals, memory, report
        self._start, self._stage, self._count = start, stage, 0
        self._means = torch.from_numpy(space.means)
        self._whitening = torch.from_numpy(space.whitening)
        self.layout: Layout | None = None
        self._last: tuple[bytes, FloatArray | Failure] | None = None

    @property
    def prior_count(self) -> int:
        """Number of residuals of priors, which are the last ones."""
        return len(self._whitening)

    def require(self, theta: FloatArray) -> None:
        """Evaluate at the first point of a stage; a failure here ends the start.

        A stored evaluation of this point is computed again and compared, since a fit must not be
        resumed with other observations.
        """
        kept = self._memory.recall("residuals", self._stage, theta)
        found = self._trial(theta)
        if kept is not None:
            self._require_kept(theta, kept)
        if isinstance(found, FAILURES):
            raise found
        self._count = len(found)
        if self._count == self.prior_count:
            raise InvalidInput("fit: `residuals` must return at least one number, got none")

    def _require_kept(self, theta: FloatArray, kept: Mapping[str, Any]) -> None:
        try:
            with torch.no_grad():
                now = self._call(torch.from_numpy(np.array(theta)))
        except FAILURES as error:
            same = kept["failure"] == _text(error)
        else:
            same = not kept["failure"] and torch.equal(now, kept["found"])
        if not same:
            raise InvalidInput(
                "fit: `resume`: `residuals` are not what they were when the fit was interrupted: "
                "the observations or the simulation have changed; delete the folder to begin anew"
            )

    def residuals(self, theta: FloatArray) -> FloatArray:
        """Residuals [M]; infinite if the simulation fails, so that the solver rejects the step."""
        found = self._trial(theta)
        return np.full(self._count, np.inf) if isinstance(found, FAILURES) else found

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Jacobian [M, p]: forward mode if there are at most as many numbers as residuals."""
        record = self._memory.recall("jacobian", self._stage, theta)
        if record is None:
            few = len(self._rows) <= self._count
            transform = torch.func.jacfwd if few else torch.func.jacrev
            call = partial(self._differentiated, backward=not few)
            found = transform(call)(torch.from_numpy(np.array(theta)))
            _check_derivative(found)
            record = self._memory.keep("jacobian", self._stage, theta, found=found)
        jacobian: FloatArray = record["found"].numpy()
        return jacobian

    def failure(self, theta: FloatArray) -> Failure:
        """Error of the simulation at a point where it fails."""
        found = self._trial(theta)
        assert isinstance(found, FAILURES)
        return found

    def cost_and_gradient(self, theta: FloatArray) -> tuple[float, FloatArray] | None:
        """Half the sum of squares and its gradient [p] by backward; None on failure."""
        found = self._trial(theta)
        if isinstance(found, FAILURES):
            return None
        record = self._memory.recall("gradient", self._stage, theta)
        if record is None:
            at = torch.from_numpy(np.array(theta)).requires_grad_()
            with torch.enable_grad():
                cost = 0.5 * self._differentiated(at, backward=True).square().sum()
                (gradient,) = torch.autograd.grad(cost, at)
            _check_derivative(gradient)
            record = self._memory.keep("gradient", self._stage, theta, found=gradient)
        return 0.5 * float(found @ found), record["found"].numpy()

    def _trial(self, theta: FloatArray) -> FloatArray | Failure:
        # The first point of the solver has just been evaluated by `require`.
        key = theta.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = key, self._evaluate(theta)
        return self._last[1]

    def _evaluate(self, theta: FloatArray) -> FloatArray | Failure:
        record = self._memory.recall("residuals", self._stage, theta)
        numbers = torch.from_numpy(np.array(theta))
        failure: Failure | None = None
        if record is None:
            begin = time.perf_counter()
            found = cpu.zeros(0)
            try:
                with torch.no_grad():
                    found = self._call(numbers)
            except FAILURES as error:
                failure = error
            if failure is None:
                self._check(found)
            record = self._memory.keep(
                "residuals",
                self._stage,
                theta,
                found=found,
                seconds=time.perf_counter() - begin,
                failure="" if failure is None else _text(failure),
            )
        elif record["failure"]:
            failure = SimulationError(record["failure"].partition(": ")[2])
        values: FloatArray = record["found"].numpy()
        trial = Trial(
            start=self._start,
            stage=self._stage,
            cost=float("inf") if failure else 0.5 * float(values @ values),
            values=self._space.values(self._whole(numbers)),
            seconds=record["seconds"],
            failure=record["failure"],
        )
        self.history.append(trial)
        self._report(trial)
        return values if failure is None else failure

    def _check(self, found: Tensor) -> None:
        wrong = (~torch.isfinite(found)).nonzero()
        if len(wrong):
            at = int(wrong[0])
            raise InvalidInput(
                f"fit: `residuals` must return finite numbers, got {float(found[at]):g} at [{at}]"
            )
        self._check_count(found)

    def _check_count(self, found: Tensor) -> None:
        if self._count not in (0, len(found)):
            raise InvalidInput(
                "fit: `residuals` must return as many numbers in every call, got "
                f"{len(found) - self.prior_count} after {self._count - self.prior_count}"
            )

    def _call(self, theta: Tensor) -> Tensor:
        with noting() as compared:
            blocks = blocks_at(self._residuals, self._space.values(self._whole(theta)))
        if self.layout is None:
            self.layout = layout_of(blocks, compared)
        return self._with_priors(list(blocks.values()), theta)

    def _differentiated(self, theta: Tensor, *, backward: bool) -> Tensor:
        """Residuals with derivatives in theta; refuses residuals that have none."""
        try:
            parts = trajectories(self._residuals, self._space.values(self._whole(theta)))
        except RuntimeError as error:
            if any(sign in str(error) for sign in _NO_NUMBERS):
                raise InvalidInput(
                    f"fit: `residuals` must compute with torch from the parameters to the result, "
                    f"not with NumPy, {_NO_DERIVATIVE}"
                ) from error
            raise
        if not any(p.requires_grad if backward else _has_tangent(p) for p in parts):
            raise InvalidInput(
                f"fit: `residuals` must depend on the variables that are free, {_NO_DERIVATIVE}"
            )
        found = self._with_priors(parts, theta)
        self._check_count(found)
        return found

    def _with_priors(self, parts: Sequence[Tensor], theta: Tensor) -> Tensor:
        found = [part.reshape(-1).to(torch.float64) for part in parts]
        return torch.cat([*found, self._whitening @ (self._whole(theta) - self._means)])

    def _whole(self, theta: Tensor) -> Tensor:
        return self._at.index_copy(0, torch.from_numpy(self._rows), theta)


def parameters_of(values: Mapping[str, Tensor]) -> Parameters:
    """Parameters from the variables named like fields of `Parameters`."""
    return Parameters(**{n: v for n, v in values.items() if n in PARAMETERS})  # type: ignore[arg-type]


def trajectories(residuals: Residuals, values: Mapping[str, Tensor]) -> list[Tensor]:
    """Residuals of each trajectory at values of all variables."""
    return list(blocks_at(residuals, values).values())


def blocks_at(residuals: Residuals, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Name of each block -> its residuals at values of all variables."""
    others = {n: v for n, v in values.items() if n not in PARAMETERS}
    parameters = parameters_of(values)
    found = residuals(parameters, others) if others else residuals(parameters)
    return blocks_of("fit: `residuals`", found)


def _has_tangent(part: Tensor) -> bool:
    unpack: Any = forward_ad.unpack_dual
    return unpack(part).tangent is not None


def _check_derivative(found: Tensor) -> None:
    if not torch.isfinite(found).all():
        raise InvalidInput(
            "fit: `residuals` must have finite derivatives, got infinite ones or NaN; a square "
            "root or a norm has none at 0"
        )


def _text(failure: Failure) -> str:
    return f"{type(failure).__name__}: {failure}"


_AXES = {"residuals": 1, "gradient": 1, "jacobian": 2}  # kind of a record -> axes of its numbers


def _checked_key(record: Any) -> tuple[str, int, bytes]:
    """The key of a record of a file.

    Raises:
        InvalidInput: If the argument is not a record of an evaluation.
    """
    example: dict[str, Any] = {"kind": "", "stage": 0, "theta": None, "found": None}
    if isinstance(record, dict) and record.get("kind") == "residuals":
        example |= {"seconds": 0.0, "failure": ""}
    plain = {n: None if isinstance(v, Tensor) else v for n, v in dict(record).items()}
    check_like("a record", plain, example)
    kind, theta, found = record["kind"], record["theta"], record["found"]
    if kind not in _AXES:
        raise InvalidInput(f"the kind of a record must be one of {', '.join(_AXES)}, got {kind!r}")
    for name, numbers, axes in (("theta", theta, 1), ("found", found, _AXES[kind])):
        if numbers.dim() != axes:
            raise InvalidInput(f"`{name}` must have {axes} axes, got {numbers.dim()}")
        check_like(f"`{name}`", numbers, cpu.zeros(*numbers.shape))
    return kind, record["stage"], theta.numpy().tobytes()


def _check_sizes(records: Mapping[tuple[str, int, bytes], Mapping[str, Any]]) -> None:
    """Require equal counts of residuals and of free numbers in all records of a stage."""
    counts: dict[tuple[str, int], int] = {}
    for (kind, stage, _), record in records.items():
        sizes = {"free": len(record["theta"])}
        if not record.get("failure"):
            rows, *columns = record["found"].shape
            sizes["free" if kind == "gradient" else "residuals"] = rows
            if columns and columns[0] != len(record["theta"]):
                raise InvalidInput("a Jacobian must have a column for each number of `theta`")
        for name, size in sizes.items():
            if counts.setdefault((name, stage), size) != size:
                raise InvalidInput(f"stage {stage} must have one number of {name}")
