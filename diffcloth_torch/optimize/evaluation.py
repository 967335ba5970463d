"""One rollout, its loss, and the gradient with respect to its variables."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from torch import Tensor

from diffcloth_torch.checkpoint import check_like
from diffcloth_torch.errors import (
    InfeasibleMotion,
    InvalidInput,
    NotConverged,
    SimulationError,
    TurnedTooFar,
)
from diffcloth_torch.operations import operation
from diffcloth_torch.optimize.statistics import rollout_statistics
from diffcloth_torch.reprs import dataclass_text
from diffcloth_torch.sim.records.state import State, check_state

__all__ = [
    "Evaluation",
    "Loss",
    "Simulate",
    "Variables",
    "check_record",
    "copies",
    "evaluate",
    "restored",
]

Variables = Mapping[str, Tensor]
"""Name -> leaf tensor that requires a gradient."""

Simulate = Callable[[Variables], Sequence[State]]
"""Function from variables to the states that the loss depends on."""

Loss = Callable[[Sequence[State]], Tensor]
"""Function from states to a loss of shape [], or [B] with one number per environment."""

_MAY_BE_UNKNOWN = ("minimum_distance", "cpu_seconds")
_CONVERGED = "converged"
_ERRORS: dict[str, type[SimulationError]] = {
    "infeasible_motion": InfeasibleMotion,
    "not_converged": NotConverged,
    "turned_too_far": TurnedTooFar,
}


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One rollout and its gradient.

    Attributes:
        loss: Value of the loss; if there is one for each environment, the mean over those that did
            not fail.
        variables: Copies of the variables of the rollout.
        states: States that the loss depends on, without a graph.
        gradient_norms: Name of a variable -> norm of the gradient of the loss.
        statistics: Statistics of the steps.
        forward_seconds: Time of the rollout [s].
        backward_seconds: Time of the gradient [s].
        environment_losses: Loss of each environment, None if it failed; empty if the loss is one
            number.
    """

    loss: float
    variables: dict[str, Tensor]
    states: list[State]
    gradient_norms: dict[str, float]
    statistics: dict[str, Any]
    forward_seconds: float
    backward_seconds: float
    environment_losses: list[float | None]

    __repr__ = dataclass_text

    @property
    def failed_environments(self) -> list[int]:
        """Indices of the environments that failed."""
        return [i for i, loss in enumerate(self.environment_losses) if loss is None]

    def is_better_than(self, other: Evaluation | None) -> bool:
        """Return whether fewer environments failed, or as many did and the loss is smaller."""
        if other is None:
            return True
        failures = [len(found.failed_environments) for found in (self, other)]
        return failures[0] < failures[1] or (failures[0] == failures[1] and self.loss < other.loss)

    def record(self) -> dict[str, Any]:
        """Return the numbers of this evaluation, in types that JSON has."""
        own = {"environment_losses": self.environment_losses} if self.environment_losses else {}
        return {
            "loss": self.loss,
            "gradient_norms": self.gradient_norms,
            "forward_seconds": self.forward_seconds,
            "backward_seconds": self.backward_seconds,
            **own,
            **self.statistics,
        }


def restored(name: str, given: Mapping[str, Any], variables: Mapping[str, Tensor]) -> Evaluation:
    """Make an evaluation from its fields, for a loop over variables like the given ones.

    Raises:
        InvalidInput: If fields are missing, unknown or do not fit; the message opens with the name.
    """
    names = [field.name for field in fields(Evaluation)]
    check_like(name, dict.fromkeys(given), dict.fromkeys(names))
    check_like(f"{name}: the variables", given["variables"], dict(variables))
    for k, state in enumerate(given["states"]):
        check_state(f"{name}: the state [{k}]", state)
    evaluation = Evaluation(**given)
    record = evaluation.record()
    check_record(name, record)
    check_like(f"{name}: the norms", record["gradient_norms"], dict.fromkeys(variables, 0.0))
    return evaluation


def check_record(name: str, given: Any) -> None:
    """Require the numbers of a `record` of an evaluation.

    Raises:
        InvalidInput: If an entry is missing or no number; the message opens with the name.
    """
    example = {"loss": 0.0, "forward_seconds": 0.0, "backward_seconds": 0.0, "gradient_norms": {}}
    example |= rollout_statistics([]) | {"cpu_seconds": 0.0}
    losses = given.get("environment_losses", [])
    if losses:
        example["environment_losses"] = []
    check_like(name, dict.fromkeys(given), dict.fromkeys(example))
    for key, like in example.items():
        value = given[key]
        if isinstance(like, dict):
            check_like(f"{name}[{key!r}]", value, dict.fromkeys(value, 0.0))
        elif isinstance(like, list):
            known = [loss for loss in value if loss is not None]
            check_like(f"{name}[{key!r}]", known, [0.0] * len(known))
        elif value is not None or key not in _MAY_BE_UNKNOWN:
            check_like(f"{name}[{key!r}]", value, 0.0 if like is None else like)


def evaluate(
    simulate: Simulate, loss: Loss, variables: Variables, per_environment: Collection[str] = ()
) -> Evaluation:
    """Simulate, and store the gradient of the loss in the `.grad` of the variables.

    If the loss has one number for each environment, failed environments are left out; with any
    other loss a failed environment is an error.

    Args:
        simulate: Function from variables to states.
        loss: Function from states to a loss of shape [] or [B].
        variables: Name -> leaf tensor.
        per_environment: Names of variables whose row i acts in environment i alone. Each row
            receives the gradient of its environment's loss; all other variables receive the
            gradient of the mean loss.

    Raises:
        InfeasibleMotion: If steps failed with this status, and no environment is left.
        NotConverged: Likewise.
        TurnedTooFar: Likewise.
        SimulationError: If the loss is not finite.
        InvalidInput: If the loss has another shape, or does not depend on a variable.
    """
    for tensor in variables.values():
        tensor.grad = None
    start = time.perf_counter()
    states = simulate(variables)
    values = loss(states)
    if not isinstance(values, Tensor):
        raise TypeError(f"descend: `loss` must return a tensor, got {type(values).__name__}")
    _check_shape(values, states)
    failures = _failures(states)
    total, own = _total(values, failures)
    if per_environment and not own:
        raise InvalidInput(
            "descend: `loss` must have shape [B], one number for each environment, where variables "
            f"are `per_environment`; got {list(values.shape)}"
        )
    between = time.perf_counter()
    if not total.requires_grad:
        raise InvalidInput("descend: `loss` must depend on `variables`, and depends on none")
    total.backward()  # type: ignore[no-untyped-call]
    succeeded = len(own) - len(failures)
    for name, tensor in variables.items():
        if own and name not in per_environment and tensor.grad is not None:
            tensor.grad /= succeeded
    end = time.perf_counter()
    return Evaluation(
        loss=total.item() / succeeded if own else total.item(),
        variables=copies(variables),
        states=[state.detach() for state in states],
        gradient_norms={name: _gradient(name, tensor) for name, tensor in variables.items()},
        statistics=rollout_statistics(states),
        forward_seconds=between - start,
        backward_seconds=end - between,
        environment_losses=own,
    )


def copies(variables: Variables) -> dict[str, Tensor]:
    """Copy variables without a graph."""
    return {name: tensor.detach().clone() for name, tensor in variables.items()}


def _check_shape(values: Tensor, states: Sequence[State]) -> None:
    batch = states[-1].batch_size if states else None
    accepted = [[]] if batch is None else [[], [batch]]
    if list(values.shape) not in accepted:
        raise InvalidInput(
            f"descend: `loss` must have the shape {' or '.join(map(str, accepted))}, "
            f"got {list(values.shape)}"
        )


def _failures(states: Sequence[State]) -> dict[int, tuple[int, str]]:
    """Failed environment -> index of the first state after the failed step, and its status."""
    failures: dict[int, tuple[int, str]] = {}
    for k, state in enumerate(states):
        status = () if state.report is None else state.report.status
        for i, text in enumerate((status,) if isinstance(status, str) else status):
            if text != _CONVERGED:
                failures.setdefault(i, (k, text))
    return failures


def _total(
    values: Tensor, failures: Mapping[int, tuple[int, str]]
) -> tuple[Tensor, list[float | None]]:
    """The loss to differentiate, and the loss of each environment (empty if shape [])."""
    left = [i for i in range(len(values)) if i not in failures] if values.dim() else []
    if failures and not left:
        raise _error(failures)
    kept = values[left] if failures else values
    numbers = kept.detach().reshape(-1).tolist()
    for number, i in zip(numbers, left or [0], strict=True):
        if not math.isfinite(number):
            where = f" in the environment [{i}]" if values.dim() else ""
            raise SimulationError(
                f"{operation('descend')}: the loss is {number}{where}: a gradient has no direction "
                "there"
            )
    if not values.dim():
        return kept, []
    by_environment = dict(zip(left, numbers, strict=True))
    return kept.sum(), [by_environment.get(i) for i in range(len(values))]


def _error(failures: Mapping[int, tuple[int, str]]) -> SimulationError:
    k, status = min(failures.values())
    environments = sorted(failures)
    # Any other status comes from a file: a step raises an error instead.
    kind = _ERRORS.get(status, SimulationError)
    return kind(
        f"the step to the state [{k}] of the rollout has the status {status!r}; environments "
        f"{environments} failed",
        environments=environments,
    )


def _gradient(name: str, tensor: Tensor) -> float:
    if tensor.grad is None:
        raise InvalidInput(f"the loss does not depend on the variable {name!r}")
    return float(tensor.grad.norm())
