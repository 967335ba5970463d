"""The energies that a scene stores, as one differentiable operation with one backward."""

from __future__ import annotations

from functools import partial

import torch

from diffcloth_torch import _core
from diffcloth_torch._exit import note_caller
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.sim.pull_back import Differentiated, needed, pull_back
from diffcloth_torch.sim.step import as_array

__all__ = ["stored_energy"]

# Motion, what acts on it and what dissipates it store nothing: no cotangent need go back there.
_STORES_NOTHING = frozenset(
    {
        "velocities",
        "body_targets",
        "pin_targets",
        "forces",
        "gravity",
        "density",
        "damping",
        "friction",
        "slip_velocity",
        "coordinate_ends",
        "coordinate_targets",
        "coordinate_metric",
        "friction_origins",
    }
)


def stored_energy(core: _core.Simulator, inputs: Fields) -> Fields:
    """What potentials and the barrier store at the positions of inputs, differentiable in these.

    Args:
        core: The simulator in C++.
        inputs: Float64 tensors, each with a leading axis of environments.

    Returns:
        Part -> energy [B] J.
    """
    storing = {n: t for n, t in inputs.items() if n not in _STORES_NOTHING}
    others = {n: as_array(t) for n, t in inputs.items() if n not in storing}
    # Inside Function.forward gradients are always off, so this is decided here.
    if not (torch.is_grad_enabled() and any(t.requires_grad for t in storing.values())):
        arrays = others | {name: as_array(t) for name, t in storing.items()}
        return {n: torch.from_numpy(e) for n, e in core.stored_energy(arrays).items()}
    parts: list[str] = []
    energies = _StoredEnergy.apply(core, others, tuple(storing), parts, *storing.values())
    return dict(zip(parts, energies, strict=True))


_PLAIN = 4  # arguments of _StoredEnergy.forward that are no tensors


class _StoredEnergy(torch.autograd.Function):
    @staticmethod
    def forward(ctx, core, others, names, parts, *tensors):
        arrays = {name: as_array(t) for name, t in zip(names, tensors, strict=True)}
        energies = core.stored_energy(others | arrays)
        ctx.save_for_backward(*tensors)
        ctx.core, ctx.others, ctx.names, ctx.parts = core, others, names, tuple(energies)
        ctx.shapes = [t.shape for t in tensors]
        parts.extend(energies)
        return tuple(map(torch.from_numpy, energies.values()))

    @staticmethod
    def backward(ctx, *cotangents):
        saved = ctx.saved_tensors  # first: raises torch's own error if they were freed
        needs = needed(ctx.names, ctx.needs_input_grad[_PLAIN:])
        function = Differentiated(
            owner="energy",
            names=ctx.names,
            shapes=ctx.shapes,
            axes=1,
            gradients=partial(_backward, ctx, needs),
        )
        found = dict(zip(needs, pull_back(function, saved, cotangents), strict=True))
        return *[None] * _PLAIN, *(found.get(name) for name in ctx.names)


def _backward(ctx, needs, saved, losses):
    note_caller()
    try:
        gradients = ctx.core.energy_backward(
            ctx.others | {n: as_array(t) for n, t in zip(ctx.names, saved, strict=True)},
            {part: as_array(c) for part, c in zip(ctx.parts, losses, strict=True)},
            len(losses[0]),
            needs,
            torch.get_num_threads(),
        )
    except _core.SimulationError as error:
        raise SimulationError(f"backward: {error}") from error
    except ValueError as error:  # numbers that hooks on saved tensors have changed
        raise InvalidInput(f"backward: {error}") from error
    return [torch.from_numpy(gradients[name]) for name in needs]
