"""Modes without stiffness at an equilibrium, and their names.

A step of length H from rest moves by dx = A^-1 (M/H) dv for small initial velocities dv, where A is
the Hessian of the step. A mode without stiffness moves by H dv, as without any forces.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.errors import SimulationError
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.sim.inputs.layout import Layout

__all__ = ["refuse_free_modes", "surface_of_vertex"]

# A mode is free if a velocity moves it by this fraction of its displacement without forces.
_FREE = 0.5
_PROBES = 16
_AXES = "xyz"
_OUTPUTS = ("positions", "body_poses", "joint_positions", "base_poses")


def refuse_free_modes(
    layout: Layout, fields: Fields, pushes: Fields, forces: Fields, length: float
) -> None:
    """Raise if the end of a step, weighted by signs, responds too much to initial velocities.

    Args:
        layout: Rows and names of the scene.
        fields: The end of the step.
        pushes: Its initial velocities, by field.
        forces: "joint_efforts" and "base_wrenches" of robots. A velocity of a joint has momentum in
            all joints; the response to efforts identifies the free one.
        length: H [s].

    Raises:
        SimulationError: If something is free to move, with its name.
    """
    outputs = [fields[n] for n in _OUTPUTS if n in fields and fields[n].requires_grad]
    if not outputs:
        return
    generator = cpu.generator().manual_seed(0)
    # Equal in all environments, so that a batch refuses the same environments as single ones.
    signs = [
        (2.0 * cpu.randint(2, (_PROBES, 1, *t.shape[1:]), generator=generator).double() - 1.0)
        .expand(-1, len(t), *t.shape[1:])
        .contiguous()
        for t in outputs
    ]
    inputs = pushes | forces
    found: tuple[Tensor | None, ...] = torch.autograd.grad(
        outputs,
        list(inputs.values()),
        signs,
        is_grads_batched=True,
        allow_unused=True,
    )
    responses = {
        n: cpu.zeros(_PROBES, *t.shape) if r is None else r
        for (n, t), r in zip(inputs.items(), found, strict=True)
    }
    for field in pushes:
        sizes = responses[field].flatten(2).norm(dim=2)
        # Some signs excite a mode little, so the mean square is used.
        mean = sizes.square().mean(dim=0).sqrt()
        count = responses[field][0, 0].numel() ** 0.5  # a rigid mode spreads its push
        free = mean * count > _FREE * length
        if not free.any():
            continue
        environments: list[int] = free.nonzero()[:, 0].tolist()
        first = environments[0]
        clearest = int(sizes[:, first].argmax())
        modes = {n: r[clearest, first] for n, r in responses.items()}
        named = field
        if field in ("joint_velocities", "base_velocities"):
            named = max(forces, key=lambda n: float(modes[n].abs().max()))
        raise SimulationError(
            f"equilibrium: {_sentence(layout, named, modes[named])}; nothing "
            "holds it, so that there is no single equilibrium; pin it, or give it friction",
            environments=environments,
        )


def surface_of_vertex(layout: Layout, vertex: int) -> str:
    """Name of the surface to which a row of all vertices belongs."""
    assembly = layout.assembly
    ends = [*assembly.cloth_vertex_start[1:]]
    ends += [len(assembly.vertices) + end for end in assembly.body_vertex_start[1:]]
    surface = next(s for s, end in enumerate(ends) if vertex < end)
    return assembly.surface_names[surface]


def _sentence(layout: Layout, field: str, mode: Tensor) -> str:
    """Describe the free object and its free motion."""
    assembly = layout.assembly
    if field == "joint_efforts":
        name = layout.joint_names[int(mode.abs().argmax())]
        return f"the joint {name!r} is free to move"
    if field == "velocities":
        vertex = int(mode.norm(dim=1).argmax())
        name = surface_of_vertex(layout, vertex)
        start = assembly.cloth_vertex_start
        k = assembly.surface_names.index(name)
        vector = mode[start[k] : start[k + 1]].mean(dim=0)
        if vector.norm() < 0.5 * mode[vertex].norm():
            return f"{name!r} is free to turn or to change its shape"
        return _free_along(name, "slide along", vector)
    row = int(mode.abs().amax(dim=1).argmax())
    linear, angular = torch.split(mode[row], 3)
    name = (assembly.bodies if field == "body_velocities" else assembly.robots)[row].name
    if angular.norm() > linear.norm():
        return _free_along(name, "turn about", angular)
    return _free_along(name, "slide along", linear)


def _free_along(name: str, way: str, vector: Tensor) -> str:
    axis = int(vector.abs().argmax())
    if vector[axis].abs() > 0.95 * vector.norm():
        return f"{name!r} is free to {way} {_AXES[axis]}"
    direction = ", ".join(f"{v:.2f}" for v in (vector / vector.norm()).tolist())
    return f"{name!r} is free to {way} ({direction})"
