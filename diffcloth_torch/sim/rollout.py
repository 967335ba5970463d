"""Several steps, with the tapes of all of them or of one segment at a time."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from diffcloth_torch.autograd.transforms import in_backward_transform, numbers_of
from diffcloth_torch.checks import check_count
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.sim.records.controls import Control, Parameters, tensors_of
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.sim.records.trajectory import Trajectory

__all__ = ["Controls", "StepParameters", "roll_out"]

Controls = Sequence[Control | None] | Callable[[int, State], Control | None] | None
StepParameters = Parameters | Callable[[int, State], Parameters | None] | None
"""Parameters of all steps, or a function of the index of a step and the state before it."""

Digests = dict[str, bytes]


def roll_out(
    step: Callable[[State, Control | None, Parameters | None], State],
    state: State,
    controls: Controls,
    parameters: StepParameters,
    steps: int | None,
    checkpoint_every: int | None,
) -> Trajectory:
    """Compute successive steps; see `Simulator.rollout`."""
    count = _step_count(controls, steps)

    asked: dict[int, tuple[Digests, Digests]] = {}  # digests of the values that functions returned

    def advance(before: State, first: int, last: int, remember: bool = False) -> list[State]:
        states = []
        for k in range(first, last):
            control, given = _control_at(controls, k, before), _parameters_at(parameters, k, before)
            if k in asked:
                _require_same("controls", k, _digests(control), asked[k][0])
                _require_same("parameters", k, _digests(given), asked[k][1])
            before = step(before, control, given)
            if remember:
                asked[k] = _digests(control), _digests(given)
            states.append(before)
        return states

    if checkpoint_every is None:
        return Trajectory(advance(state, 0, count))
    check_count("rollout: `checkpoint_every`", checkpoint_every, 1)
    if in_backward_transform():
        raise InvalidInput(
            "rollout: `checkpoint_every` must be None inside torch.func.grad, vjp and jacrev, "
            "where torch has no checkpoints; call torch.autograd.grad instead"
        )
    states: list[State] = []
    for first in range(0, count, checkpoint_every):
        last = min(first + checkpoint_every, count)
        before = states[-1] if states else state
        if torch.is_grad_enabled():
            watched = [*tensors_of(before), *tensors_of(parameters)]
            if isinstance(controls, Sequence):
                watched += [t for control in controls[first:last] for t in tensors_of(control)]
            own = partial(advance, remember=callable(controls) or callable(parameters))
            states += _checkpointed(own, before, first, last, watched)
        else:
            states += advance(before, first, last)
    return Trajectory(states)


def _step_count(controls: Controls, steps: int | None) -> int:
    if isinstance(controls, Sequence):
        if steps is not None and steps != len(controls):
            raise InvalidInput(
                f"rollout: `steps` must be the number of controls, {len(controls)}, got {steps}"
            )
        return len(controls)
    if controls is not None and not callable(controls):
        raise TypeError(
            "rollout: `controls` must be a sequence of Control or None, a function "
            f"(k, state) -> Control, or None; got {type(controls).__name__}"
        )
    if steps is None:
        raise InvalidInput("rollout: `steps` must be given unless `controls` is a sequence")
    return check_count("rollout: `steps`", steps, 0)


def _control_at(controls: Controls, k: int, state: State) -> Control | None:
    if controls is None:
        return None
    return controls(k, state) if callable(controls) else controls[k]


def _parameters_at(parameters: StepParameters, k: int, state: State) -> Parameters | None:
    return parameters(k, state) if callable(parameters) else parameters


def _digests(record: Control | Parameters | None) -> Digests:
    """Digests of the values in a control or parameters, by the names of fields and entries."""
    digests = {}
    for field, value in ({} if record is None else vars(record)).items():
        if field.startswith("_"):
            continue
        entries = value if isinstance(value, Mapping) else {None: value}
        for key, entry in entries.items():
            if entry is not None:
                values = numbers_of(entry) if isinstance(entry, Tensor) else entry
                numbers = np.asarray(values, dtype=np.float64)
                content = hashlib.blake2b(numbers.tobytes(), digest_size=16).digest()
                name = field if key is None else f"{field}[{key!r}]"
                digests[name] = repr(numbers.shape).encode() + content
    return digests


def _require_same(argument: str, k: int, digests: Digests, first: Digests) -> None:
    """Refuse a function that returned other values in the rollout: gradients would be wrong."""
    other = [n for n in {**first, **digests} if digests.get(n) != first.get(n)]
    if other:
        raise InvalidInput(
            f"rollout: `{argument}` must return what it returned before when backward repeats a "
            f"step from a checkpoint, got another `{other[0]}` for the step [{k}]; what it depends "
            "on, as the weights of a policy, must not be edited before backward, and nothing in it "
            "may be random or count its calls"
        )


def _checkpointed(
    advance: Callable[[State, int, int], list[State]],
    before: State,
    first: int,
    last: int,
    watched: Sequence[Tensor],
) -> list[State]:
    """Compute steps first .. last - 1, drop their tapes, and repeat them in backward.

    Checkpointing hides the version counters of saved tensors, so an edit in place would go
    unnoticed and change the repeated steps; the counters are compared here.
    """
    versions = [tensor._version for tensor in watched]

    def run() -> list[State]:
        if [tensor._version for tensor in watched] != versions:
            raise RuntimeError(
                f"rollout: a tensor that steps {first} .. {last - 1} depend on was modified by an "
                "inplace operation before backward; clone it before editing it"
            )
        return advance(before, first, last)

    states: list[State] = checkpoint(run, use_reentrant=False)
    return states
