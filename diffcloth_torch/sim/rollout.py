"""Many steps, with the tapes of all of them or of one segment at a time."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial

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

    asked: dict[int, dict[str, bytes]] = {}  # what a function has returned, by digests

    def advance(before: State, first: int, last: int, remember: bool = False) -> list[State]:
        states = []
        for k in range(first, last):
            control = _control_at(controls, k, before)
            if k in asked:
                _require_same(k, _digests(control), asked[k])
            before = step(before, control)
            if remember:
                asked[k] = _digests(control)
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
            own = partial(advance, remember=callable(controls))
            states += _checkpointed(own, before, first, last, watched)
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


def _digests(control: Control | None) -> dict[str, bytes]:
    """What a control sets, by the names of its fields and entries."""
    digests = {}
    for field, value in ({} if control is None else vars(control)).items():
        entries = value if isinstance(value, Mapping) else {None: value}
        for key, entry in entries.items():
            if entry is not None:
                numbers = torch.as_tensor(entry).detach().to(torch.float64).contiguous().numpy()
                content = hashlib.blake2b(numbers.tobytes(), digest_size=16).digest()
                name = field if key is None else f"{field}[{key!r}]"
                digests[name] = repr(numbers.shape).encode() + content
    return digests


def _require_same(k: int, digests: dict[str, bytes], first: dict[str, bytes]) -> None:
    """Refuse a control that is not the one of the rollout: its gradients would be of another."""
    other = [n for n in {**first, **digests} if digests.get(n) != first.get(n)]
    if other:
        raise InvalidInput(
            "rollout: `controls` must return what it returned before when backward repeats a step "
            f"from a checkpoint, got another `{other[0]}` for the step [{k}]; what it depends on, "
            "as the weights of a policy, must not be edited before backward, and nothing in it may "
            "be random or count its calls"
        )


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
