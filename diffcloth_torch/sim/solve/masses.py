"""Masses of the cloths' vertices, their momentum and energy, as ordinary differentiable torch."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.dynamics.totals import Totals, ordered_sum
from diffcloth_torch.model.assembly import Assembly
from diffcloth_torch.model.quantities import Fields

__all__ = ["cloth_totals", "vertex_masses"]


def vertex_masses(assembly: Assembly, parameters: Fields) -> Tensor:
    """Mass of each vertex, a third of the mass of each adjacent face, [B or 1, N] kg."""
    if not assembly.cloth_count:
        return cpu.zeros(1, 0)
    density, rest = parameters["density"], parameters["rest_positions"]
    corners = torch.from_numpy(assembly.faces).long()
    a, b, c = rest[:, torch.from_numpy(assembly.rest_faces).long()].unbind(-2)
    area = torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2
    if density.shape[1] == assembly.cloth_count:
        counts = torch.from_numpy(np.diff(assembly.cloth_face_start)).long()
        density = density.repeat_interleave(counts, dim=1)
    parts = (density * area / 3).repeat_interleave(3, dim=1)
    zeros = cpu.zeros(len(parts), len(assembly.vertices))
    return zeros.scatter_add(1, corners.flatten().expand(len(parts), -1), parts)


def cloth_totals(assembly: Assembly, state: Fields, parameters: Fields) -> Totals:
    """Momentum and energy of all cloths."""
    if not assembly.cloth_count:
        return Totals.zero(len(state["positions"]))
    masses, velocities = vertex_masses(assembly, parameters), state["velocities"]
    momenta = masses[..., None] * velocities
    return Totals.of(
        state["positions"],
        torch.nn.functional.pad(momenta, (0, 3)),
        ordered_sum((momenta * velocities).flatten(-2)) / 2,
        masses,
        parameters["gravity"].reshape(-1, 3),
    )
