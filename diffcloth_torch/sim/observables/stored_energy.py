"""The stored energies of a scene, as one differentiable operation with one backward."""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloth_torch import _core
from diffcloth_torch.autograd.core_function import Arrays, CoreFunction, as_array, evaluate
from diffcloth_torch.autograd.transforms import is_differentiated
from diffcloth_torch.model.quantities import STORING, Fields

__all__ = ["stored_energy"]


def stored_energy(core: _core.Simulator, inputs: Fields) -> Fields:
    """Energies of potentials and the barrier at the positions of inputs, differentiable in these.

    Args:
        core: The simulator in C++.
        inputs: Float64 tensors, each with a leading axis of environments.

    Returns:
        Part -> energy [B] J.
    """
    storing = {n: t for n, t in inputs.items() if n in STORING}
    others = {n: as_array(t) for n, t in inputs.items() if n not in storing}
    # Inside Function.forward gradients are always off, so this is decided here.
    if not is_differentiated(storing.values()):
        arrays = others | {name: as_array(t) for name, t in storing.items()}
        return {n: torch.from_numpy(e) for n, e in core.stored_energy(arrays).items()}
    energy = _StoredEnergy(core, others, tuple(storing))
    energies = evaluate(energy, tuple(storing.values()))
    return dict(zip(energy.parts, energies, strict=True))


class _StoredEnergy(CoreFunction):
    owner = "energy"

    def __init__(self, core: _core.Simulator, others: Arrays, names: tuple[str, ...]) -> None:
        super().__init__(names, others)
        self.core = core
        self.parts: tuple[str, ...] = ()

    def values(self, inputs: Arrays) -> tuple[Tensor, ...]:
        energies = self.core.stored_energy(inputs)
        self.parts = tuple(energies)
        return tuple(map(torch.from_numpy, energies.values()))

    def tangents(self, inputs: Arrays, tape: Arrays, given: Arrays, count: int) -> list[Tensor]:
        threads = torch.get_num_threads()
        tangents = self.core.energy_tangent(inputs, given, count, threads)
        return [torch.from_numpy(tangents[part]) for part in self.parts]

    def gradients(
        self, inputs: Arrays, tape: Arrays, cotangents: list[Tensor], needs: list[str]
    ) -> list[Tensor]:
        gradients = self.core.energy_backward(
            inputs,
            dict(zip(self.parts, map(as_array, cotangents), strict=True)),
            len(cotangents[0]),
            needs,
            torch.get_num_threads(),
        )
        return [torch.from_numpy(gradients[name]) for name in needs]
