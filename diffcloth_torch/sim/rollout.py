"""Many steps, with the tapes of all of them or of one segment at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from diffcloth_torch.checks import check_count
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.sim.controls import Control, Parameters, tensors_of
from diffcloth_torch.sim.state import State

__all__ = ["Controls", "roll_out"]

Controls = Sequence[Control | None] | Callable[[int, State], Control | None] | None


def roll_out(
    step: Callable[[State, Control | None], State],
    state: State,
    controls: Controls,
    parameters: Parameters | None,
    steps: int | None,
    checkpoint_every: int | None,
) -> list[State]:
    """Take steps one after the other; see `Simulator.rollout`."""
    count = _step_count(controls, steps)

    def advance(before: State, first: int, last: int) -> list[State]:
        states = []
        for k in range(first, last):
            before = step(before, _control_at(controls, k, before))
            states.append(before)
        return states

    if checkpoint_every is None:
        return advance(state, 0, count)
    check_count("rollout: `checkpoint_every`", checkpoint_every, 1)
    states: list[State] = []
    for first in range(0, count, checkpoint_every):
        last = min(first + checkpoint_every, count)
        before = states[-1] if states else state
        if torch.is_grad_enabled():
            watched = [*tensors_of(before), *tensors_of(parameters)]
            if isinstance(controls, Sequence):
                watched += [t for control in controls[first:last] for t in tensors_of(control)]
            states += _checkpointed(advance, before, first, last, watched)
        else:
            states += advance(before, first, last)
    return states


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


def _checkpointed(
    advance: Callable[[State, int, int], list[State]],
    before: State,
    first: int,
    last: int,
    watched: Sequence[Tensor],
) -> list[State]:
    """Steps first .. last - 1 whose tapes are dropped now and made again in backward.

    Checkpointing hides the version counters of saved tensors, so that an edit in place would change
    what is repeated; the counters are compared here.
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
