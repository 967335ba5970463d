"""Warning for inaccurate staggered couplings: a body touches heavy or stiff cloth."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.dynamics.dynamics import Dynamics
from diffcloth_torch.dynamics.staggering import StaggeredStep, added_mass_numbers
from diffcloth_torch.errors import AddedMassWarning, warn_caller
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.inputs.border import Given
from diffcloth_torch.sim.inputs.layout import Layout
from diffcloth_torch.sim.records.surfaces import Surfaces
from diffcloth_torch.sim.solve.cores import Core, arrays_of, rigid_inputs
from diffcloth_torch.sim.solve.masses import cloth_totals, vertex_masses
from diffcloth_torch.sim.solve.step import Outcome

__all__ = ["AddedMassWatch"]

_LARGEST_ADDED_MASS = 0.5
_LARGEST_GAIN = 0.01  # of the energy of motion and contact, in a step

# Inputs of the core for bodies and links.
_PLACED = (
    "body_poses",
    "body_targets",
    "coordinates",
    "coordinate_ends",
    "coordinate_targets",
    "coordinate_metric",
)


class AddedMassWatch:
    """Watches the steps of a staggered coupling and warns once."""

    def __init__(
        self,
        coupling: str,
        layout: Layout,
        surfaces: Surfaces,
        dynamics: Dynamics,
        cores: tuple[Core, Core],
    ) -> None:
        """Keep the data for checks of steps.

        Args:
            coupling: Name of the coupling.
            layout: Meaning of the rows.
            surfaces: The surfaces that a state places.
            dynamics: Dynamics of the bodies and robots.
            cores: Core of the cloths, and core of bodies and robots alone.
        """
        self._coupling, self._layout, self._surfaces = coupling, layout, surfaces
        self._dynamics = dynamics
        self._cloth, self._rigid = cores
        self._warned = False

    def look_at(
        self, given: Given, inputs: Fields, solved: StaggeredStep[Any, Any], *, blocked: bool
    ) -> None:
        """Judge a step.

        Args:
            given: Checked state, control and parameters of the step.
            inputs: Inputs of the core that do not concern bodies and robots.
            solved: Result of the step.
            blocked: True if a motion could not be completed.
        """
        cloth = solved.cloth.outcome
        if self._warned or not cloth.body_forces.any():
            return
        with torch.no_grad():
            passive = not blocked and self._is_passive(given.state, given.control)
            gain = self._gain(given.state, solved, given.parameters, inputs) if passive else 0.0
            self._warn(cloth, solved.fields, given.parameters, gain)

    def _is_passive(self, state: Fields, control: Fields) -> bool:
        """Return whether only gravity does work: no other force acts, prescribed objects rest."""
        springs = len(self._layout.assembly.springs) > 0
        if (
            springs
            or self._layout.robots
            or any(control[name].any() for name in ("forces", "body_wrenches", "wind"))
        ):
            return False
        pins = state["positions"][:, self._layout.pins]
        held = {"pins": pins, "soft_pins": state["soft_pin_targets"]}
        held["body_poses"] = state["body_poses"]
        return all(torch.equal(control[n].expand_as(rests), rests) for n, rests in held.items())

    def _gain(
        self,
        state: Fields,
        solved: StaggeredStep[Any, Any],
        parameters: Fields,
        inputs: Fields,
    ) -> float:
        """Largest rise of the energy over a step, relative to the energy of motion and contact."""
        cloth, moved = solved.cloth.outcome, solved.prediction
        after = {"positions": cloth.positions, "velocities": cloth.velocities, **solved.fields}
        here = inputs | moved.core_inputs()
        there = here | {
            "positions": cloth.positions,
            "body_poses": moved.body_targets,
            "coordinates": solved.rigid.coordinates,
        }
        before, (kinetic, contact, rest) = (
            self._energies(at, fields, parameters) for at, fields in ((here, state), (there, after))
        )
        rise = kinetic + contact + rest - sum(before)
        return float((rise / (kinetic + contact)).amax())

    def _energies(
        self, inputs: Fields, state: Fields, parameters: Fields
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Kinetic energy, energy of contact, and all other energy, [B] J."""
        stored = self._cloth.stored_energy(arrays_of(inputs))
        placed = {name: inputs[name] for name in _PLACED}
        alone = self._rigid.stored_energy(arrays_of(rigid_inputs(self._layout, inputs) | placed))
        totals = cloth_totals(self._layout.assembly, state, parameters)
        totals = totals.plus(self._dynamics.totals(state, parameters))
        contact = torch.from_numpy(stored.pop("contact") + alone["contact"])
        rest = totals.gravity_energy + sum(torch.from_numpy(part) for part in stored.values())
        return totals.kinetic_energy, contact, rest

    def _warn(self, cloth: Outcome, after: Fields, parameters: Fields, gain: float) -> None:
        """Warn once if a body touches cloth that is not light compared to the body.

        Args:
            cloth: Outcome of the cloths' solve.
            after: Fields of bodies and robots after the step.
            parameters: Checked parameters.
            gain: Relative increase of energy by the step.
        """
        assembly = self._layout.assembly
        numbers = added_mass_numbers(
            assembly,
            self._surfaces.surface_frames(after),
            self._surface_masses(parameters),
            cloth.positions,
            vertex_masses(assembly, parameters),
            cloth.body_forces,
            parameters["barrier_distance"].reshape(-1),
            self._dynamics.dt,
        ).amax(0)
        worst = int(numbers.argmax())
        if numbers[worst] > _LARGEST_ADDED_MASS or gain > _LARGEST_GAIN:
            self._warned = True
            name = assembly.surface_names[assembly.cloth_count + worst]
            if gain > _LARGEST_GAIN:
                sign = f"a step near {name!r} gained {gain:.2g} of the energy of motion and contact"
            else:
                sign = (
                    f"the added-mass number of {name!r} is about {float(numbers[worst]):.2g}, "
                    f"above {_LARGEST_ADDED_MASS:g}"
                )
            warn_caller(
                f"{operation()}: the coupling {self._coupling!r} gets inaccurate, and then "
                f"unstable, where what a body touches is heavy or stiff against it: {sign}; "
                'use coupling="monolithic", or a smaller dt',
                AddedMassWarning,
            )

    def _surface_masses(self, parameters: Fields) -> Tensor:
        """Masses of the surfaces of bodies and links, zero if not dynamic, [B or 1, K + Lc]."""
        layout = self._layout
        sizes = layout.assembly.sizes
        bodies, links = (cpu.zeros(1, sizes[n]) for n in "KL")
        bodies = parameters.get("body_mass", bodies)
        links = parameters.get("link_mass", links)[:, layout.shaped_links]
        environments = max(len(bodies), len(links))
        return torch.cat([m.expand(environments, -1) for m in (bodies, links)], dim=1)
