"""Velocities of the second-order step, which are half a step before the positions."""

from __future__ import annotations

import weakref
from typing import Protocol

from diffcloth_torch.autograd.guards import guarded
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.sim.records.controls import Control, Parameters
from diffcloth_torch.sim.records.state import State, check_state
from diffcloth_torch.sim.records.surfaces import Surfaces

__all__ = ["at_half_step", "remember", "with_half_step_velocities"]


class Simulator(Protocol):
    """The part of a simulator that computes a step."""

    integrator: str

    def _step(
        self, state: State, control: Control | None, parameters: Parameters | None
    ) -> State: ...


# Simulator of the states with these surfaces, as long as it lives.
_SIMULATORS: weakref.WeakKeyDictionary[Surfaces, weakref.ref[Simulator]] = (
    weakref.WeakKeyDictionary()
)


def remember(simulator: Simulator, surfaces: Surfaces) -> None:
    """Associate a simulator with the surfaces that its states hold."""
    _SIMULATORS[surfaces] = weakref.ref(simulator)


@guarded
def at_half_step(
    state: State,
    control: Control | None = None,
    parameters: Parameters | None = None,
    *,
    simulator: Simulator | None = None,
) -> State:
    """Convert velocities at the time of a state to the velocities of a second-order step.

    Simulators with `integrator="second_order"` use velocities of cloths half a time step before the
    positions. Velocities at the time of the positions change to

        v - (h / 2) a,    a = (v' - v) / h,

    with v' the velocities after one step. States from `initial_state`, `step` and `rollout` need no
    conversion. In contact a is the mean over the whole step: do not start in the step of an impact.
    Velocities of bodies and joints are unchanged.

    Args:
        state: State of a simulator with `integrator="second_order"`, with or without a batch axis.
            Differentiable, like `control` and `parameters`.
        control: Control of the first step; None holds pins and bodies.
        parameters: Physical parameters; None: the scene's.
        simulator: The simulator; None: the simulator that made `state`.

    Returns:
        The state with `velocities` at the half step.

    Raises:
        InvalidInput: If the simulator is not known, or integrates by implicit Euler.
        SimulationError: As for `Simulator.step`.
    """
    check_state("at_half_step: `state`", state)
    if simulator is None and state._surfaces is not None:
        known = _SIMULATORS.get(state._surfaces)
        simulator = None if known is None else known()
    if simulator is None:
        raise InvalidInput(
            "at_half_step: the simulator of `state` is not known, as for states from files; give "
            "it as `simulator`"
        )
    if simulator.integrator != "second_order":
        raise InvalidInput(
            "at_half_step: needs a simulator with integrator 'second_order', got "
            f"{simulator.integrator!r}, whose velocities have the time of the positions"
        )
    return with_half_step_velocities(state, simulator._step(state, control, parameters))


def with_half_step_velocities(state: State, after: State) -> State:
    """Replace velocities v of a state by v - (v' - v) / 2, v' the velocities one step later."""
    return state.replace(velocities=1.5 * state.velocities - 0.5 * after.velocities)
