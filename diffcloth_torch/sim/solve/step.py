"""One step as one differentiable operation: a call into the core, and one for its derivatives.

A step finds the minimizer x(u) of a potential P(x, u), where u stands for all inputs. At the
minimizer the gradient vanishes, and so does its derivative along u:

    g(x, u) = dP/dx = 0,    H dx + (dg/du) du = 0,    H = dg/dx.

With the cotangent x_bar of x and all its functions, the gradient of the loss is

    H lambda = x_bar,    u_bar = -(dg/du)^T lambda + (explicit dependence of the outputs on u),

one solve with the Hessian of the same potential, and then products with mixed derivatives. The
velocities (x - x_n) / h and the contact forces on the bodies are such outputs; each friction
iteration adds one solve. The formulas of every term are in the C++ core.

Forward, a direction du of the inputs gives H dx = -(dg/du) du: one solve for each direction, with
the same Hessian, and one call of the core for all directions of a `vmap`.

The tape of a step consists of plain tensors, which torch saves together with the inputs: torch
frees them after backward, refuses a second backward without `retain_graph`, and notices inputs
edited in place. Constants of a scene, which nobody can edit, are not saved.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import _core
from diffcloth_torch._exit import note_caller
from diffcloth_torch.autograd.core_function import (
    NO_CONSTANTS,
    Arrays,
    Constant,
    CoreFunction,
    as_array,
    evaluate,
    failing_as,
    without_constants,
)
from diffcloth_torch.autograd.transforms import is_differentiated
from diffcloth_torch.errors import SimulationError
from diffcloth_torch.operations import operation

__all__ = [
    "CONVERGED",
    "CRITERIA",
    "DIAGNOSTICS",
    "INFEASIBLE",
    "INTERSECTING",
    "TURNED",
    "UNCONVERGED",
    "Outcome",
    "diagnostics_of",
    "take_step",
]

# Values of the core's `status`, per environment.
CONVERGED, UNCONVERGED, INFEASIBLE, INTERSECTING = 0, 1, 2, 3
TURNED = 4  # not from the core: bodies turn further than a step resolves

DIAGNOSTICS = tuple(_core.number_names)
"""Names of the core's numbers for each environment; some have a prefix for their kind."""

CRITERIA = tuple(_core.criteria)
"""Texts of a report for the core's number "criterion"."""

# The last one exists only in scenes that have coordinates.
_OUTPUTS = (
    "positions",
    "velocities",
    "body_forces",
    "contact_forces",
    "pin_forces",
    "coordinates",
)
_TAPE = "tape_"
_KEPT = "kept"


class Outcome(NamedTuple):
    """The result of a step, with fields as in `State`.

    Attributes:
        positions: [B, N, 3].
        velocities: [B, N, 3].
        body_forces: [B, V, 3].
        contact_forces: [B, N, 3].
        pin_forces: [B, P, 3].
        diagnostics: Lists of length B of the core: status, message and the entries of the report;
            "ended": environment whose motion stopped early -> poses of all roots there, [T, 7];
            "pairs": for each environment, (first, second, count, force) of each pair of surfaces in
            contact; and "points": for each environment, its contacts, see `contact_points.COLUMNS`.
        coordinates: Coordinates of bodies and robots at the end of the step, [B, n]; None if there
            are none.
    """

    positions: Tensor
    velocities: Tensor
    body_forces: Tensor
    contact_forces: Tensor
    pin_forces: Tensor
    diagnostics: dict[str, Any]
    coordinates: Tensor | None = None


def take_step(
    core: _core.Simulator,
    inputs: dict[str, Tensor],
    constants: Mapping[str, Constant] = NO_CONSTANTS,
) -> Outcome:
    """Compute one step; keep a tape only if a gradient may be requested.

    Args:
        core: The simulator in C++.
        inputs: Float64 tensors, each with a leading axis of environments.
        constants: Constants of the scene: an input that is one of these very tensors bypasses
            autograd.
    """
    known, given = without_constants(inputs, constants)
    # Checked here, because inside Function.forward gradients are always off.
    if not is_differentiated(given.values()):
        arrays = known | {name: as_array(t) for name, t in given.items()}
        result = _forward(core, arrays, tape=False)
        return _outcome(_outputs(result), diagnostics_of(result))
    step = _Step(core, known, tuple(given))
    outputs = evaluate(step, tuple(given.values()))
    return _outcome(outputs, step.diagnostics)


def _forward(core: _core.Simulator, arrays: dict[str, Any], *, tape: bool) -> dict[str, Any]:
    note_caller()
    with failing_as(operation()):
        return core.forward(arrays, tape, torch.get_num_threads())


def _outputs(result: dict[str, Any]) -> tuple[Tensor, ...]:
    return tuple(torch.from_numpy(result[name]) for name in _OUTPUTS if name in result)


def _outcome(outputs: tuple[Tensor, ...], diagnostics: dict[str, Any]) -> Outcome:
    x, v, of_bodies, of_contact, of_pins, *coordinates = outputs
    return Outcome(x, v, of_bodies, of_contact, of_pins, diagnostics, *coordinates)


def diagnostics_of(result: dict[str, Any]) -> dict[str, Any]:
    """Diagnostics of a step: for each name a list with one number or text per environment."""
    numbers = zip(DIAGNOSTICS, result["numbers"], strict=True)
    others = {name: result[name] for name in ("message", "ended", "pairs", "points")}
    return {**dict(numbers), **others}


class _Step(CoreFunction):
    """A step; the core frees its kept factors and contacts together with the graph."""

    owner = "step"

    def __init__(self, core: _core.Simulator, constants: Arrays, names: tuple[str, ...]) -> None:
        super().__init__(names, constants)
        self.core = core
        self.diagnostics: dict[str, Any] = {}
        self.kept: Any = None

    def values(self, inputs: Arrays) -> tuple[Tensor, ...]:
        result = _forward(self.core, inputs, tape=True)
        self.tape = {k: torch.from_numpy(v) for k, v in result.items() if k.startswith(_TAPE)}
        self.kept = result[_KEPT]
        self.diagnostics = diagnostics_of(result)
        return _outputs(result)

    def tangents(self, inputs: Arrays, tape: Arrays, given: Arrays, count: int) -> list[Tensor]:
        failed = [i for i, status in enumerate(self.diagnostics["status"]) if status]
        changed = [i for i in failed if any(_depends(d, i) for d in given.values())]
        if changed:
            raise SimulationError(
                f"{operation()}: the step of environments {changed} failed and has no tangent; "
                "give their inputs none",
                environments=changed,
            )
        threads = torch.get_num_threads()
        tangents = self.core.tangent(inputs, tape, self.kept, given, count, threads)
        return [torch.from_numpy(tangents[name]) for name in _OUTPUTS if name in tangents]

    def gradients(
        self, inputs: Arrays, tape: Arrays, cotangents: list[Tensor], needs: list[str]
    ) -> list[Tensor]:
        gradients = self.core.backward(
            inputs,
            tape,
            self.kept,
            dict(zip(_OUTPUTS, map(as_array, cotangents), strict=False)),
            len(cotangents[0]),
            needs,
            torch.get_num_threads(),
        )
        return [torch.from_numpy(gradients[name]) for name in needs]


def _depends(direction: NDArray[np.float64], environment: int) -> bool:
    """Return whether directions [K, B or 1, ...] change an input of an environment."""
    return bool(direction[:, min(environment, direction.shape[1] - 1)].any())
