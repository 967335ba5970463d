"""The border of `sim/`: checks inputs of a caller, and adds a leading axis of environments.

`axes.without_axis` removes that axis from results. Between the two every value has the axis, with
or without a batch.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from diffcloth_torch.autograd.core_function import as_array
from diffcloth_torch.model.defaults import check_barrier
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.inputs.control_fields import control_fields
from diffcloth_torch.sim.inputs.layout import Layout
from diffcloth_torch.sim.inputs.parameter_fields import parameter_fields, without_elasticity
from diffcloth_torch.sim.inputs.state_fields import state_fields
from diffcloth_torch.sim.records.controls import Control, Parameters
from diffcloth_torch.sim.records.state import State

__all__ = ["Border", "Given"]


class Given(NamedTuple):
    """The inputs of a step: checked, complete, with a leading axis of B environments or of one.

    Attributes:
        state: Fields of the state.
        control: Fields of the control.
        parameters: Fields of the parameters.
    """

    state: Fields
    control: Fields
    parameters: Fields

    def at_rest(self) -> Given:
        """Return the same inputs with zero velocities."""
        names = (name for name in self.state if name.endswith("velocities"))
        still = {name: torch.zeros_like(self.state[name]) for name in names}
        return self._replace(state=self.state | still)


class Border:
    """Checks states, controls and parameters of a scene.

    Attributes:
        defaults: Parameters of the scene, as fields; completed while a simulator is constructed.
    """

    def __init__(
        self, layout: Layout, defaults: Fields, nonadjacent_distance: float, *, self_contact: bool
    ) -> None:
        """Keep the data for checks of inputs.

        Args:
            layout: Shapes, and rows by name.
            defaults: Parameters of the scene, as fields.
            nonadjacent_distance: Smallest distance between parts of a cloth that share no vertex
                [m].
            self_contact: True if cloths collide with themselves.
        """
        self.defaults = without_elasticity(layout, defaults)
        self._layout = layout
        self._nonadjacent_distance, self._self_contact = nonadjacent_distance, self_contact

    def enter(
        self, state: State, control: Control | None, parameters: Parameters | None
    ) -> tuple[Given, int | None]:
        """Check all inputs; return them with the batch size, None without a batch axis."""
        before, batch = self.state(state)
        wanted = control_fields(self._layout, control, before, batch)
        return Given(before, wanted, self.parameters(parameters, batch)), batch

    def state(self, state: State) -> tuple[Fields, int | None]:
        """Check a state; return its fields and its batch size, None without a batch axis."""
        return state_fields(self._layout, state)

    def parameters(self, parameters: Parameters | None, batch: int | None) -> Fields:
        """Check parameters and complete them by the scene's, which are already checked."""
        if parameters is None:
            return self.defaults
        physical = parameter_fields(self._layout, parameters, self.defaults, batch)
        self.check_barrier(operation(), physical)
        return without_elasticity(self._layout, physical)

    def check_barrier(self, owner: str, inputs: Fields) -> None:
        """Refuse a barrier that reaches from one part of a cloth to the next.

        Args:
            owner: Prefix of the message.
            inputs: Fields of parameters.
        """
        assembly = self._layout.assembly
        cloths = assembly.cloth_count - assembly.deforming_count
        if cloths and "barrier_distance" in inputs and self._self_contact:
            thickness = as_array(inputs["thickness"])[:, :cloths]
            distance = as_array(inputs["barrier_distance"])
            check_barrier(owner, distance, thickness, self._nonadjacent_distance)
