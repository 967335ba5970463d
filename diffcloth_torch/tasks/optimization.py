"""Optimization of the actions of a task, by the options of its configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from diffcloth_torch.config.schema import OptimizerSection
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.optimize.descent import Descent, descend
from diffcloth_torch.optimize.evaluation import Evaluation, Simulate, Variables
from diffcloth_torch.optimize.evaluation import evaluate as evaluate_variables
from diffcloth_torch.optimize.progress import Progress
from diffcloth_torch.sim.records.controls import Control
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.task import Actions, OptimizableTask

__all__ = ["evaluate", "optimize", "position_gradients"]


def optimize(
    task: OptimizableTask,
    report: Callable[[Descent], None] = lambda _: None,
    *,
    start: Actions | None = None,
    found: Descent | None = None,
) -> Descent:
    """Minimize the loss of a task by gradient descent; see `descend`.

    Args:
        task: The task.
        report: Called after each iteration with the results so far.
        start: Actions to start from, leaf tensors; by default the task's actions.
        found: Results that an earlier loop over the same task reported, to continue it.

    Raises:
        SimulationError: If the initial actions fail, or too many successive attempts do.
        InvalidInput: If the learning rates do not fit the actions.
    """
    options = task.optimizer
    actions = task.actions() if start is None else start
    optimizer = _optimizer(actions, options)
    if found is not None:
        # The configuration may have changed since the interruption.
        groups = optimizer.state_dict()["param_groups"]
        found = replace(found, optimizer={**found.optimizer, "param_groups": groups})
    with Progress(options.iterations, task.steps, "step") as bar:
        return descend(
            _simulation(task, bar.step),
            task.loss,
            actions,
            optimizer,
            iterations=options.iterations,
            clip=options.clip,
            restart=options.restart,
            failures=options.failures,
            stop_below=options.stop_below,
            progress=report,
            resume=found,
            bar=bar,
        )


def evaluate(task: OptimizableTask, actions: Actions) -> Evaluation:
    """Roll a task out and store the gradient of its loss in the `.grad` of the actions."""
    return evaluate_variables(_simulation(task, lambda _: None), task.loss, actions)


def position_gradients(task: OptimizableTask, actions: Mapping[str, Tensor]) -> list[Tensor]:
    """Gradients of the loss of a task by the positions after each step, [N, 3] each.

    Each gradient is a total derivative: a change of positions changes all later states.
    """
    leaves = {name: tensor.detach().clone().requires_grad_() for name, tensor in actions.items()}
    states = _simulation(task, lambda _: None)(leaves)
    positions = [state.positions for state in states]
    return list(torch.autograd.grad(task.loss(states), positions, materialize_grads=True))


def _simulation(task: OptimizableTask, on_step: Callable[[int], None]) -> Simulate:
    def simulate(actions: Variables) -> list[State]:
        controller = task.controller(actions)
        forward = True

        def control_at(k: int, state: State) -> Control:
            if forward:  # backward repeats steps of a checkpointed rollout
                on_step(k)
            return controller(k, state)

        states = task.simulator.rollout(
            task.initial_state(),
            control_at,
            steps=task.steps,
            checkpoint_every=task.optimizer.checkpoint_every,
        )
        forward = False
        return states

    return simulate


def _optimizer(actions: Actions, options: OptimizerSection) -> torch.optim.SGD:
    rates = options.learning_rates
    if set(rates) != set(actions):
        raise InvalidInput(
            f"`optimizer.learning_rates` must have the keys {', '.join(actions)}, "
            f"got {', '.join(rates) or 'none'}"
        )
    groups = [{"params": [tensor], "lr": rates[name]} for name, tensor in actions.items()]
    return torch.optim.SGD(groups, momentum=options.momentum, nesterov=options.nesterov)
