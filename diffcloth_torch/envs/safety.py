"""Time steps with a safety stop: infeasible prescribed motions are held.

If a prescribed motion is infeasible, the time step is repeated from its start with all prescribed
motion held, as by the safety stop of a robot. The repeated step is feasible, because its start has
no intersection.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.model.quantities import CONTROL, PARAMETERS
from diffcloth_torch.sim.records.controls import Control, Parameters
from diffcloth_torch.sim.records.state import State, where
from diffcloth_torch.sim.simulator import Simulator

__all__ = ["SafetyStop"]

_INFEASIBLE = "infeasible_motion"
_PRESCRIBED = ("pins", "body_poses", "base_poses", "joint_positions", "joint_velocities")
_BY_VERTEX = ("pins", "soft_pins", "attachments", "attachment_weights")
_MOST_ITERATIONS = 200  # limit for a step with all prescribed motion held; steps need 5 to 40


class SafetyStop:
    """Time steps of a batch, with infeasible prescribed motions held.

    Attributes:
        simulator: Simulator of the steps.
        holding: Simulator of steps with all prescribed motion held, with a lower limit of
            iterations.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        options = simulator.solver
        most = min(options.max_iterations, _MOST_ITERATIONS)
        self.holding = Simulator(
            simulator.scene,
            simulator.dt,
            scheme=simulator.scheme,
            coupling=simulator.coupling,
            contact=simulator.contact,
            integrator=simulator.integrator,
            solver=replace(options, max_iterations=most),
        )

    def step(
        self, state: State, control: Control, parameters: Parameters | None, stopped: list[bool]
    ) -> State:
        """Make a time step.

        Args:
            state: State before the step.
            control: Control of all environments. If a motion is infeasible, pins, kinematic bodies,
                bases and driven joints keep their positions; forces, efforts and springs act
                unchanged, without derivatives with respect to them.
            parameters: Parameters of the simulation.
            stopped: True for environments with all prescribed motion held [B]; environments with a
                new infeasible motion are set to True.
        """
        free = [i for i, stop in enumerate(stopped) if not stop]
        moved = None
        if free:
            moved = _taken(self.simulator, state, control, parameters, free)
            report: Any = moved.report
            if _INFEASIBLE not in report.status and len(free) == len(stopped):
                return moved
            for i, status in zip(free, report.status, strict=True):
                stopped[i] = status == _INFEASIBLE
        rows = [i for i, stop in enumerate(stopped) if stop]
        if not rows and moved is not None:
            return moved
        held = _taken(self.holding, state, _held(control), parameters, rows)
        if moved is None:
            return held
        count = len(stopped)
        mask = cpu.tensor(stopped, dtype=torch.bool)
        return where(mask, held[_places(rows, count)], moved[_places(free, count)])


def _taken(
    simulator: Simulator,
    state: State,
    control: Control,
    parameters: Parameters | None,
    rows: Sequence[int],
) -> State:
    """A step of some environments."""
    count = len(state)
    if len(rows) == count:
        return simulator.step(state, control, parameters)
    chosen = cpu.tensor(list(rows), dtype=torch.int64)
    return simulator.step(
        state[chosen],
        _control_of(control, chosen),
        None if parameters is None else _parameters_of(parameters, chosen, count),
    )


def _held(control: Control) -> Control:
    """A control that holds everything prescribed and has no derivative."""
    free = {f.name: getattr(control, f.name) for f in fields(control) if f.name not in _PRESCRIBED}
    return Control(**{name: _each(value, Tensor.detach) for name, value in free.items()})


def _each(value: Any, change: Any) -> Any:
    """A field with `change` applied to its tensor, or to each of its tensors by name."""
    if isinstance(value, Mapping):
        return {name: change(tensor) for name, tensor in value.items()}
    return None if value is None else change(value)


def _places(rows: Sequence[int], count: int) -> Tensor:
    """Index of each environment in `rows`, 0 if it is not in `rows`; [B]."""
    places = cpu.zeros(count, dtype=torch.int64)
    places[list(rows)] = cpu.arange(len(rows))
    return places


def _control_of(control: Control, rows: Tensor) -> Control:
    """The control of some environments."""
    chosen: dict[str, Any] = {}
    for name, quantity in CONTROL.items():
        value, axes = getattr(control, name), len(quantity.axes[0])
        if isinstance(value, Mapping) and name not in _BY_VERTEX:
            axes -= 1

        def select(tensor: Any, axes: int = axes) -> Tensor:
            given = cpu.as_tensor(tensor)
            return given[rows] if given.dim() > axes else given

        chosen[name] = _each(value, select)
    return Control(**chosen)


def _parameters_of(parameters: Parameters, rows: Tensor, count: int) -> Parameters:
    """The parameters of some environments.

    A step has accepted the parameters, so the number of axes shows whether a tensor has a batch
    axis: it then has one axis more than its quantity.
    """
    chosen: dict[str, Any] = {}
    for name, quantity in PARAMETERS.items():
        value = getattr(parameters, name)
        if value is None or name in parameters._unbatched:
            continue
        ranks = {len(axes) for axes in quantity.axes}
        if isinstance(value, Mapping):
            ranks |= {0} if name == "friction" else {rank - 1 for rank in ranks}

        def select(tensor: Any, ranks: set[int] = ranks) -> Any:
            given = cpu.as_tensor(tensor)
            batched = given.shape[:1] == (count,) and given.dim() - 1 in ranks
            return given[rows] if batched else given

        chosen[name] = _each(value, select)
    return parameters.replace(**chosen) if chosen else parameters
