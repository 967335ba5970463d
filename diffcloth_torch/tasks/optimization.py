"""The one optimization loop: simulate, differentiate, and step the actions of a task."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Annotated, Any, Protocol

import torch
from annotated_types import Ge, Gt, Lt
from torch import Tensor
from tqdm import tqdm

from diffcloth_torch.config.schema import Positive, Section
from diffcloth_torch.errors import InfeasibleMotion, InvalidInput, NotConverged, SimulationError
from diffcloth_torch.sim.controls import Control
from diffcloth_torch.sim.simulator import Simulator
from diffcloth_torch.sim.state import State
from diffcloth_torch.tasks.statistics import rollout_statistics

__all__ = [
    "Actions",
    "Controller",
    "Evaluation",
    "Optimization",
    "OptimizerSection",
    "evaluate",
    "optimize",
]

Actions = dict[str, Tensor]
Controller = Callable[[int, State], Control]
"""From the index of a step and the state before it to its control."""


class OptimizerSection(Section):
    """Stochastic gradient descent.

    `learning_rates` has one entry for each tensor of actions. `clip` limits the norm of the
    gradient of each of them; by default nothing is clipped. With `restart`, momentum starts anew
    from zero where the loss has risen, so that much of it does not swing across a narrow valley.
    `failures` is how many attempts in a row may fail before the loop gives up. `stop_below` ends it
    when the loss is smaller.

    References:
        O'Donoghue and Candès, "Adaptive restart for accelerated gradient schemes", Foundations of
        Computational Mathematics 15 (2015), the function scheme.
    """

    iterations: Annotated[int, Ge(1)]
    learning_rates: dict[str, Annotated[float, Gt(0)]]
    momentum: Annotated[float, Ge(0), Lt(1)] = 0.0
    nesterov: bool = False
    restart: bool = False
    clip: Positive | None = None
    failures: Annotated[int, Ge(0)] = 6
    checkpoint_every: Annotated[int, Ge(1)] | None = None
    stop_below: Positive | None = None


class _Optimizable(Protocol):
    # Structural, so that the protocol of tasks can name the options above.
    @property
    def simulator(self) -> Simulator: ...
    @property
    def optimizer(self) -> OptimizerSection: ...
    @property
    def steps(self) -> int: ...
    def initial_state(self) -> State: ...
    def actions(self) -> Actions: ...
    def controller(self, actions: Mapping[str, Tensor]) -> Controller: ...
    def loss(self, states: Sequence[State]) -> Tensor: ...


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One rollout and its gradient.

    Attributes:
        loss: Value of the loss.
        actions: Actions that were rolled out; copies.
        states: States after each step, without a graph.
        gradient_norms: Name of actions -> norm of the gradient of the loss.
        statistics: Statistics of the steps.
        forward_seconds: Time of the rollout [s].
        backward_seconds: Time of the gradient [s].
    """

    loss: float
    actions: Actions
    states: list[State]
    gradient_norms: dict[str, float]
    statistics: dict[str, Any]
    forward_seconds: float
    backward_seconds: float

    def record(self) -> dict[str, Any]:
        """Numbers of this evaluation for a file."""
        return {
            "loss": self.loss,
            "gradient_norms": self.gradient_norms,
            "forward_seconds": self.forward_seconds,
            "backward_seconds": self.backward_seconds,
            **self.statistics,
        }


@dataclass(frozen=True, eq=False)
class Optimization:
    """What a loop has found so far, and what it needs to go on.

    Attributes:
        first: Evaluation of the initial actions, without its states.
        best: Evaluation with the smallest loss.
        history: Record of each evaluation, in order.
        failures: Message of each attempt that failed, with the iteration it was for.
        seconds: Time since the start [s], without interruptions.
        next_actions: Actions of the next iteration.
        momenta: Momentum of each tensor of actions; empty without momentum.
    """

    first: Evaluation
    best: Evaluation
    history: list[dict[str, Any]]
    failures: list[dict[str, Any]]
    seconds: float
    next_actions: Actions
    momenta: Actions

    def record(self) -> dict[str, Any]:
        """All of it, as what `torch.load` reads with `weights_only`."""
        return vars(self) | {"first": vars(self.first), "best": vars(self.best)}

    @staticmethod
    def restore(record: Mapping[str, Any]) -> Optimization:
        """Make one from its `record`."""
        first, best = (Evaluation(**record[name]) for name in ("first", "best"))
        return Optimization(**{**record, "first": first, "best": best})

    def metrics(self) -> dict[str, Any]:
        """Numbers of the loop for a file."""
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


def optimize(
    task: _Optimizable,
    report: Callable[[Optimization], None] = lambda _: None,
    *,
    start: Actions | None = None,
    found: Optimization | None = None,
) -> Optimization:
    """Minimize the loss of a task by gradient descent.

    An attempt whose rollout fails (`InfeasibleMotion`, `NotConverged`) is not skipped: the actions
    go back half way towards the best ones and are tried again, without momentum.

    Args:
        task: What to optimize.
        report: Called after each iteration with what was found so far.
        start: Actions to start from, leaf tensors; by default those of the task.
        found: What an earlier loop over the same task reported: it is continued, with the same
            bits that the earlier loop would have had.

    Returns:
        The evaluations and how they came about.

    Raises:
        SimulationError: If the initial actions fail, or too many attempts in a row do.
        InvalidInput: If the learning rates do not fit the actions.
    """
    options = task.optimizer
    actions = task.actions() if start is None else start
    history: list[dict[str, Any]] = []
    failures: list[dict[str, Any]] = []
    before = 0.0
    descent = _descent(actions, options)
    if found is not None:
        history, failures = list(found.history), list(found.failures)
        before = found.seconds
        _put(actions, found.next_actions)
        for name, momentum in found.momenta.items():
            descent.state[actions[name]]["momentum_buffer"] = momentum.clone()
    failed_in_a_row = 0
    begin = time.perf_counter()
    with _progress(task, options, len(history)) as progress:
        while len(history) < options.iterations and not _good_enough(found, options):
            try:
                evaluation = evaluate(task, actions, on_step=progress.step)
            except (InfeasibleMotion, NotConverged) as error:
                failed_in_a_row += 1
                failures.append({"iteration": len(history), "error": _message(error)})
                if found is None or failed_in_a_row > options.failures:
                    raise
                _halve_towards(actions, found.best.actions)
                descent = _descent(actions, options)
                progress.failed(len(failures))
                continue
            failed_in_a_row = 0
            risen = bool(history) and evaluation.loss > history[-1]["loss"]
            history.append(evaluation.record())
            if options.restart and risen:
                descent = _descent(actions, options)
            _clip(actions, options.clip)
            descent.step()
            better = found is None or evaluation.loss < found.best.loss
            found = Optimization(
                first=replace(evaluation, states=[]) if found is None else found.first,
                best=evaluation if better or found is None else found.best,
                history=history,
                failures=failures,
                seconds=before + time.perf_counter() - begin,
                next_actions=_copies(actions),
                momenta=_momenta(actions, descent),
            )
            progress.done(evaluation.loss, found.best.loss)
            report(found)
    assert found is not None  # at least one iteration
    return found


def _good_enough(found: Optimization | None, options: OptimizerSection) -> bool:
    limit = options.stop_below
    return found is not None and limit is not None and found.best.loss < limit


def evaluate(
    task: _Optimizable,
    actions: Actions,
    on_step: Callable[[int], None] = lambda _: None,
) -> Evaluation:
    """Roll a task out and leave the gradient of its loss in the `.grad` of the actions."""
    for tensor in actions.values():
        tensor.grad = None
    start = time.perf_counter()
    controller = task.controller(actions)
    forward = True

    def control_at(k: int, state: State) -> Control:
        if forward:  # backward asks again for the steps that it repeats
            on_step(k)
        return controller(k, state)

    states = task.simulator.rollout(
        task.initial_state(),
        control_at,
        steps=task.steps,
        checkpoint_every=task.optimizer.checkpoint_every,
    )
    loss = task.loss(states)
    value = loss.item()
    if not math.isfinite(value):
        raise SimulationError(f"the loss is {value}: a gradient has no direction there")
    forward = False
    between = time.perf_counter()
    loss.backward()  # type: ignore[no-untyped-call]
    end = time.perf_counter()
    return Evaluation(
        loss=value,
        actions=_copies(actions),
        states=[state.detach() for state in states],
        gradient_norms={name: _gradient(name, tensor) for name, tensor in actions.items()},
        statistics=rollout_statistics(states),
        forward_seconds=between - start,
        backward_seconds=end - between,
    )


def _gradient(name: str, tensor: Tensor) -> float:
    if tensor.grad is None:
        raise InvalidInput(f"the loss does not depend on the actions {name!r}")
    return float(tensor.grad.norm())


def _descent(actions: Actions, options: OptimizerSection) -> torch.optim.SGD:
    rates = options.learning_rates
    if set(rates) != set(actions):
        raise InvalidInput(
            f"`optimizer.learning_rates` must have the keys {', '.join(actions)}, "
            f"got {', '.join(rates) or 'none'}"
        )
    groups = [{"params": [tensor], "lr": rates[name]} for name, tensor in actions.items()]
    return torch.optim.SGD(groups, momentum=options.momentum, nesterov=options.nesterov)


def _copies(actions: Actions) -> Actions:
    return {name: tensor.detach().clone() for name, tensor in actions.items()}


def _momenta(actions: Actions, descent: torch.optim.SGD) -> Actions:
    # Without momentum SGD has no buffer.
    buffers = {name: descent.state[a].get("momentum_buffer") for name, a in actions.items()}
    return {name: buffer.clone() for name, buffer in buffers.items() if buffer is not None}


def _put(actions: Actions, values: Actions) -> None:
    with torch.no_grad():
        for name, tensor in actions.items():
            tensor.copy_(values[name])


def _halve_towards(actions: Actions, best: Actions) -> None:
    with torch.no_grad():
        for name, tensor in actions.items():
            tensor.add_(best[name]).div_(2)


def _clip(actions: Actions, limit: float | None) -> None:
    if limit is not None:
        for tensor in actions.values():
            torch.nn.utils.clip_grad_norm_([tensor], limit)


def _message(error: SimulationError) -> str:
    return f"{type(error).__name__}: {error}"


class _Progress:
    """A bar over the steps of all iterations."""

    def __init__(self, bar: tqdm[Any], steps: int, iterations: int) -> None:
        self._bar, self._steps = bar, steps
        self._iterations = iterations
        self._texts: dict[str, str] = {}

    def step(self, k: int) -> None:
        self._bar.n = self._iterations * self._steps + k
        self._bar.update(0)

    def done(self, loss: float, best: float) -> None:
        self._iterations += 1
        self._texts |= {"loss": f"{loss:.5f}", "best": f"{best:.5f}"}
        self._show()

    def failed(self, count: int) -> None:
        self._texts["failed"] = str(count)
        self._show()

    def _show(self) -> None:
        self._bar.n = self._iterations * self._steps
        self._bar.set_postfix(self._texts, refresh=False)
        self._bar.refresh()


@contextmanager
def _progress(task: _Optimizable, options: OptimizerSection, done: int) -> Iterator[_Progress]:
    total, initial = task.steps * options.iterations, task.steps * done
    # disable=None: quiet where the output is no terminal.
    with tqdm(total=total, initial=initial, desc="optimize", unit="step", disable=None) as bar:
        yield _Progress(bar, task.steps, done)
