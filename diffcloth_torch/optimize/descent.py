"""The optimization loop: simulate, differentiate, and make a step of a torch optimizer."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checkpoint import check_generator, check_like, check_structure
from diffcloth_torch.checks import POSITIVE, check_count, check_number
from diffcloth_torch.errors import (
    InfeasibleMotion,
    InvalidInput,
    NotConverged,
    SimulationError,
    TurnedTooFar,
    renamed,
)
from diffcloth_torch.optimize.evaluation import (
    Evaluation,
    Loss,
    Simulate,
    Variables,
    check_record,
    copies,
    evaluate,
    restored,
)
from diffcloth_torch.optimize.progress import Progress
from diffcloth_torch.optimize.rows import Rows
from diffcloth_torch.reprs import dataclass_text

__all__ = ["Descent", "Optimizers", "TrialError", "descend"]

Optimizers = torch.optim.Optimizer | Callable[[list[Tensor]], torch.optim.Optimizer]
"""An optimizer of the variables, or a function from a list of them to an optimizer."""


class TrialError(SimulationError):
    """Raised by `simulate` or `loss` of `descend` to reject a trial for any reason."""


@dataclass(frozen=True, eq=False)
class Descent:
    """The results of a loop so far, and the state for a continuation.

    Attributes:
        first: Evaluation of the initial variables, without its states.
        best: Evaluation with the fewest failed environments and, among those, the smallest loss.
        history: Record of each evaluation, in order.
        failures: Message of each failure, with its iteration.
        seconds: Time since the start [s], without interruptions.
        next_variables: Variables of the next iteration.
        optimizer: State dict of the optimizer.
        random_state: State of the generator.
        best_rows: Name of a variable in `per_environment` -> rows with the smallest loss of each
            environment.
        best_losses: Smallest loss of each environment, shape [B]; infinite for environments
            without a loss.
    """

    first: Evaluation
    best: Evaluation
    history: list[dict[str, Any]]
    failures: list[dict[str, Any]]
    seconds: float
    next_variables: dict[str, Tensor]
    optimizer: dict[str, Any]
    random_state: Tensor
    best_rows: dict[str, Tensor]
    best_losses: Tensor

    __repr__ = dataclass_text

    def record(self) -> dict[str, Any]:
        """Return all fields in types that `torch.load` reads with `weights_only`."""
        return vars(self) | {"first": vars(self.first), "best": vars(self.best)}

    @staticmethod
    def restore(record: Mapping[str, Any]) -> Descent:
        """Make a Descent from its `record`.

        Raises:
            InvalidInput: If the contents of the record differ from a result of `record`.
        """
        names = [field.name for field in fields(Descent)]
        check_like("the record", dict.fromkeys(record), dict.fromkeys(names))
        variables, losses = record["next_variables"], record["best_losses"]
        check_structure("the next variables", variables, variables)
        check_like("the next variables", variables, variables)
        first, best = (restored(name, record[name], variables) for name in ("first", "best"))
        _check_progress(record, best.loss)
        check_generator("the random state", record["random_state"])
        shapes = {name: variables[name] for name in record["best_rows"]}
        check_like("the best rows", record["best_rows"], shapes)
        # Only the structure is checked: losses are infinite for environments without a loss.
        check_structure("the record", {"losses": losses}, {"losses": cpu.zeros(len(losses))})
        parts = {"state": None, "param_groups": None}
        check_like("the optimizer", dict.fromkeys(record["optimizer"]), parts)
        return Descent(**{**record, "first": first, "best": best})

    def metrics(self) -> dict[str, Any]:
        """Return the numbers of the loop, in types of JSON."""
        losses = [record["loss"] for record in self.history]
        distances = [
            record["minimum_distance"]
            for record in self.history
            if record["minimum_distance"] is not None
        ]
        contacts = [record["largest_contact_count"] for record in self.history]
        return {
            "iterations": len(losses),
            "seconds": self.seconds,
            "iterations_per_second": len(losses) / self.seconds,
            "initial_loss": losses[0],
            "final_loss": losses[-1],
            "best_loss": self.best.loss,
            "best_iteration": losses.index(self.best.loss),
            "losses": losses,
            "minimum_distance": min(distances, default=None),
            "largest_contact_count": max(contacts),
            "steps": sum(record["steps"] for record in self.history),
            "converged_steps": sum(record["converged_steps"] for record in self.history),
            "failed_attempts": len(self.failures),
            "failures": self.failures,
            "history": self.history,
        }


@renamed(report="progress", found="resume")
def descend(
    simulate: Simulate,
    loss: Loss,
    variables: Variables,
    optimizer: Optimizers,
    *,
    iterations: int,
    per_environment: Collection[str] = (),
    clip: float | None = None,
    restart: bool = False,
    failures: int = 6,
    stop_below: float | None = None,
    progress: Callable[[Descent], None] = lambda _: None,
    resume: Descent | None = None,
    generator: torch.Generator | None = None,
    bar: Progress | None = None,
) -> Descent:
    """Minimize a loss over inputs of a simulation: controls, parameters, starts, weights.

    >>> push = {"force": torch.zeros(20, 9, 3, dtype=torch.float64, requires_grad=True)}
    >>> found = dc.descend(
    ...     lambda v: simulator.rollout(start, [dc.Control(forces=f) for f in v["force"]]),
    ...     lambda states: (states[-1].positions.mean(dim=0) - goal).norm(),
    ...     push,
    ...     partial(torch.optim.Adam, lr=0.01),
    ...     iterations=50,
    ... )

    The variables are changed in place, as by all optimizers; `found.best.variables` has the values
    with the smallest loss.

    If a rollout fails, by an error or by a status under `SolverOptions(throw=False)`, the variables
    move halfway back to the best variables and are tried again, without momentum. If the loss has
    one number for each environment of a batch, it leaves failed environments out: their rows of
    `per_environment` variables move halfway back, and all other variables follow the remaining
    environments.

    Args:
        simulate: Function from the variables to the states for the loss; usually a `rollout`.
        loss: Function from these states to a loss of shape [], or of shape [B] with one number for
            each environment, whose mean is minimized.
        variables: Name -> leaf tensor of floats that requires a gradient.
        optimizer: Optimizer of torch over exactly these tensors, or a function from their list to
            such an optimizer. Optimizers that evaluate the loss themselves, such as LBFGS, are
            refused.
        iterations: Number of evaluations that do not fail, including evaluations of `resume`, >= 1.
        per_environment: Names of variables whose row i acts only in environment i. Each row follows
            the loss of its own environment; `clip` and `restart` apply to each row separately.
        clip: Largest norm of the gradient of each variable, > 0; None does not clip.
        restart: Whether to reset the optimizer's momentum whenever the loss has risen, to prevent
            oscillations across a narrow valley.
        failures: Number of successive attempts that may fail, >= 0.
        stop_below: Loss, > 0, below which the loop ends if no environment of the best evaluation
            failed.
        progress: Called after each iteration with the results so far.
        resume: Results reported by an earlier loop, to continue that loop. Variables, optimizer and
            generator are set to their states in `resume`; the result has the same bits as without
            the interruption.
        generator: Generator from which `simulate` and `loss` draw random numbers, seeded by the
            caller; torch's own by default. The loop itself draws none.
        bar: Progress bar of the caller.

    Returns:
        The best evaluation and the history of all evaluations.

    Raises:
        SimulationError: If the initial variables fail, or too many successive attempts do.
        InvalidInput: If an argument is not accepted, or the loss does not depend on a variable.
        TypeError: If a variable is not a tensor of floats, or `optimizer` makes no optimizer.

    References:
        O'Donoghue and Candès, "Adaptive restart for accelerated gradient schemes", Foundations of
        Computational Mathematics 15 (2015), the function scheme.
    """
    for name, function in (("simulate", simulate), ("loss", loss), ("progress", progress)):
        if not callable(function):
            raise TypeError(f"descend: `{name}` must be a function, got {type(function).__name__}")
    check_count("descend: `iterations`", iterations, 1)
    check_count("descend: `failures`", failures, 0)
    for name, value in (("clip", clip), ("stop_below", stop_below)):
        if value is not None:
            check_number(f"descend: `{name}`", value, POSITIVE)
    _check_variables(variables, per_environment)
    loop = _Loop(
        variables=variables,
        optimizer=_optimizer(optimizer, variables),
        rows=Rows({name: variables[name] for name in per_environment}, failures),
        generator=torch.default_generator if generator is None else generator,
        clip=clip,
        restart=restart,
        allowed=failures,
        found=resume,
    )
    with bar or Progress(iterations) as shown:
        shown.start(len(loop.history))
        while len(loop.history) < iterations and not _good_enough(loop.found, stop_below):
            try:
                evaluation = evaluate(simulate, loss, variables, per_environment)
            except (InfeasibleMotion, NotConverged, TurnedTooFar, TrialError) as error:
                loop.go_back(error)
                shown.failed(len(loop.failures))
                continue
            sofar = loop.advance(evaluation)
            shown.done(evaluation.loss, sofar.best.loss)
            progress(sofar)
    assert loop.found is not None  # at least one iteration
    return loop.found


def _check_progress(record: Mapping[str, Any], best: float) -> None:
    """Require the history, the failures and the seconds of a Descent."""
    for k, entry in enumerate(record["history"]):
        check_record(f"the history [{k}]", entry)
    for k, failure in enumerate(record["failures"]):
        check_like(f"the failures [{k}]", failure, {"iteration": 0, "error": ""})
    if best not in [entry["loss"] for entry in record["history"]]:
        raise InvalidInput("the history must have the best loss")
    check_like("the seconds", record["seconds"], 0.0)
    if record["seconds"] <= 0:
        raise InvalidInput(f"the seconds must be positive, got {record['seconds']}")


class _Loop:
    """The state that changes from one iteration to the next."""

    def __init__(
        self,
        *,
        variables: Variables,
        optimizer: torch.optim.Optimizer,
        rows: Rows,
        generator: torch.Generator,
        clip: float | None,
        restart: bool,
        allowed: int,
        found: Descent | None,
    ) -> None:
        self._variables, self._optimizer, self._rows = variables, optimizer, rows
        self._generator = generator
        self._clip, self._restart, self._allowed = clip, restart, allowed
        self._failed_in_a_row = 0
        self._begin = time.perf_counter()
        self._before = 0.0
        self.found = found
        self.history: list[dict[str, Any]] = []
        self.failures: list[dict[str, Any]] = []
        if found is not None:
            self.history, self.failures = list(found.history), list(found.failures)
            self._before = found.seconds
            _put(variables, found.next_variables)
            optimizer.load_state_dict(found.optimizer)
            generator.set_state(found.random_state)
            rows.restore(found.best_rows, found.best_losses)

    def go_back(self, error: SimulationError) -> None:
        """Move the variables halfway back to the best variables."""
        self._failed_in_a_row += 1
        self._note(f"{type(error).__name__}: {error}")
        if self.found is None or self._failed_in_a_row > self._allowed:
            raise error
        with torch.no_grad():
            for name, tensor in self._variables.items():
                tensor.add_(self._rows.best.get(name, self.found.best.variables[name])).div_(2)
        self._optimizer.state.clear()

    def advance(self, evaluation: Evaluation) -> Descent:
        """Make an optimizer step with the gradients of an evaluation."""
        self._failed_in_a_row = 0
        failed = evaluation.failed_environments
        if failed:
            self._note(f"environments {failed} failed and were left out of the loss")
        self._rows.look_at(evaluation, self.history)
        risen = bool(self.history) and evaluation.loss > self.history[-1]["loss"]
        self.history.append(evaluation.record())
        if self._restart:
            self._forget(risen)
        self._clip_gradients()
        with cpu.DEVICE:  # some optimizers create counters on torch's default device
            self._optimizer.step()
        self._rows.go_back(evaluation, self._optimizer)
        found = self.found
        self.found = Descent(
            first=replace(evaluation, states=[]) if found is None else found.first,
            best=evaluation
            if found is None or evaluation.is_better_than(found.best)
            else found.best,
            history=list(self.history),
            failures=list(self.failures),
            seconds=self._before + time.perf_counter() - self._begin,
            next_variables=copies(self._variables),
            optimizer=_detached(self._optimizer.state_dict()),
            random_state=self._generator.get_state(),
            best_rows=copies(self._rows.best),
            best_losses=self._rows.losses.clone(),
        )
        return self.found

    def _note(self, text: str) -> None:
        self.failures.append({"iteration": len(self.history), "error": text})

    def _forget(self, risen: bool) -> None:
        """Reset the optimizer's state of variables whose loss has risen."""
        for name, tensor in self._variables.items():
            if name in self._rows.best:
                self._rows.forget(self._optimizer, tensor, self._rows.risen)
            elif risen:
                self._optimizer.state.pop(tensor, None)

    def _clip_gradients(self) -> None:
        if self._clip is not None:
            for name, tensor in self._variables.items():
                if name in self._rows.best:
                    self._rows.clip(tensor, self._clip)
                else:
                    torch.nn.utils.clip_grad_norm_([tensor], self._clip)


def _good_enough(found: Descent | None, limit: float | None) -> bool:
    if found is None or limit is None or found.best.failed_environments:
        return False
    return found.best.loss < limit


def _put(variables: Variables, values: Variables) -> None:
    with torch.no_grad():
        for name, tensor in variables.items():
            tensor.copy_(values[name])


def _detached(value: Any) -> Any:
    """A copy of a state dict; the original shares its tensors with the optimizer."""
    if isinstance(value, Tensor):
        return value.detach().clone()
    if isinstance(value, dict):
        return {key: _detached(entry) for key, entry in value.items()}
    return [_detached(entry) for entry in value] if isinstance(value, list) else value


def _check_variables(variables: Variables, per_environment: Collection[str]) -> None:
    given: Any = variables
    if not isinstance(given, Mapping):
        raise TypeError(
            f"descend: `variables` must map names to tensors, got {type(given).__name__}"
        )
    if not given:
        raise InvalidInput("descend: `variables` must have at least one entry")
    for name, tensor in given.items():
        label = f"descend: `variables[{name!r}]`"
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise TypeError(f"{label} must be a tensor of floats, got {kind}")
        if not tensor.is_leaf or not tensor.requires_grad:
            raise InvalidInput(f"{label} must be a leaf that requires a gradient")
    if isinstance(per_environment, str):
        raise TypeError("descend: `per_environment` must be a list of names, got a str")
    for name in per_environment:
        if name not in variables:
            raise InvalidInput(
                f"descend: `per_environment` may name {', '.join(variables)}; got {name!r}"
            )
    if len({variables[name].shape[:1] for name in per_environment}) > 1:
        raise InvalidInput(
            "descend: variables that are `per_environment` must have equally many rows"
        )


def _optimizer(given: Optimizers, variables: Variables) -> torch.optim.Optimizer:
    tensors = list(variables.values())
    if not callable(given) and not isinstance(given, torch.optim.Optimizer):
        raise TypeError(
            "descend: `optimizer` must be an optimizer of torch or make one, "
            f"got {type(given).__name__}"
        )
    with cpu.DEVICE:  # some optimizers create tensors in their constructor
        made: Any = given if isinstance(given, torch.optim.Optimizer) else given(tensors)
    if not isinstance(made, torch.optim.Optimizer):
        raise TypeError(
            "descend: `optimizer` must be an optimizer of torch or make one, "
            f"got {type(made).__name__}"
        )
    if isinstance(made, torch.optim.LBFGS):
        raise InvalidInput(
            "descend: `optimizer` must step once for each evaluation, which LBFGS does not"
        )
    held = {id(tensor) for group in made.param_groups for tensor in group["params"]}
    if held != {id(tensor) for tensor in tensors}:
        raise InvalidInput(
            f"descend: `optimizer` must hold just the variables {', '.join(variables)}"
        )
    return made
