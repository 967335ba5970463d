"""The energies that a scene stores, as one differentiable operation with one backward."""

from __future__ import annotations

from functools import partial

import torch

from diffcloth_torch import _core
from diffcloth_torch._exit import note_caller
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.sim.pull_back import Differentiated, needed, pull_back
from diffcloth_torch.sim.push_forward import Directed, push_forward
from diffcloth_torch.sim.step import as_array
from diffcloth_torch.transforms import is_differentiated, same_row

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
    if not is_differentiated(storing.values()):
        arrays = others | {name: as_array(t) for name, t in storing.items()}
        return {n: torch.from_numpy(e) for n, e in core.stored_energy(arrays).items()}
    looked = _Looked(core, others, tuple(storing))
    energies = _StoredEnergy.apply(looked, *storing.values())
    return dict(zip(looked.parts, energies, strict=True))


class _Looked:
    """An evaluation of the energies: what is no tensor, for its derivatives."""

    def __init__(self, core, others, names):
        self.core, self.others, self.names = core, others, names
        self.parts: tuple[str, ...] = ()


class _StoredEnergy(torch.autograd.Function):
    @staticmethod
    def forward(looked, *tensors):
        arrays = {name: as_array(t) for name, t in zip(looked.names, tensors, strict=True)}
        energies = looked.core.stored_energy(looked.others | arrays)
        looked.parts = tuple(energies)
        return tuple(map(torch.from_numpy, energies.values()))

    @staticmethod
    def setup_context(ctx, inputs, output):
        looked, *tensors = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)
        ctx.core, ctx.others = looked.core, looked.others
        ctx.names, ctx.parts = looked.names, looked.parts
        ctx.shapes = [t.shape for t in tensors]

    @staticmethod
    def vmap(info, in_dims, looked, *tensors):
        rows = [
            t if axis is None else same_row(t.movedim(axis, 0))
            for t, axis in zip(tensors, in_dims[1:], strict=True)
        ]
        energies = _StoredEnergy.apply(looked, *rows)
        return energies, (None,) * len(energies)

    @staticmethod
    def jvp(ctx, _, *tangents):
        saved = ctx.saved_tensors
        given = {n: t for n, t in zip(ctx.names, tangents, strict=True) if t is not None}
        function = Directed(
            owner="energy",
            saved=len(saved),
            axes=[saved[ctx.names.index(name)].ndim for name in given],
            tangents=partial(_tangents, ctx, tuple(given)),
        )
        return push_forward(function, saved, tuple(given.values()))

    @staticmethod
    def backward(ctx, *cotangents):
        saved = ctx.saved_tensors  # first: raises torch's own error if they were freed
        needs = needed(ctx.names, ctx.needs_input_grad[1:])
        function = Differentiated(
            owner="energy",
            names=ctx.names,
            shapes=ctx.shapes,
            axes=1,
            gradients=partial(_backward, ctx, needs),
        )
        found = dict(zip(needs, pull_back(function, saved, cotangents), strict=True))
        return None, *(found.get(name) for name in ctx.names)


def _tangents(ctx, given, saved, directions):
    note_caller()
    try:
        tangents = ctx.core.energy_tangent(
            ctx.others | {n: as_array(t) for n, t in zip(ctx.names, saved, strict=True)},
            {name: as_array(d) for name, d in zip(given, directions, strict=True)},
            len(directions[0]),
            torch.get_num_threads(),
        )
    except _core.SimulationError as error:
        raise SimulationError(f"tangent: {error}") from error
    return [torch.from_numpy(tangents[part]) for part in ctx.parts]


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
