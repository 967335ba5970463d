"""One step as one differentiable operation: a call into the core, and one for its derivatives.

A step finds the minimizer x(u) of a potential P(x, u), where u stands for all inputs. At the
minimizer the gradient vanishes, and so does its derivative along u:

    g(x, u) = dP/dx = 0,    H dx + (dg/du) du = 0,    H = dg/dx.

With the cotangent x_bar of everything that depends on x, the gradient of the loss is

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
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import _core
from diffcloth_torch._exit import note_caller
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.sim.pull_back import Differentiated, needed, pull_back
from diffcloth_torch.sim.push_forward import Directed, push_forward
from diffcloth_torch.transforms import is_differentiated, numbers_of, same_row

__all__ = [
    "CONVERGED",
    "DIAGNOSTICS",
    "INFEASIBLE",
    "INTERSECTING",
    "TURNED",
    "UNCONVERGED",
    "Constant",
    "Outcome",
    "are_within",
    "as_array",
    "diagnostics_of",
    "have_quaternions",
    "take_step",
]

# Values of the core's `status`, per environment.
CONVERGED, UNCONVERGED, INFEASIBLE, INTERSECTING = 0, 1, 2, 3
TURNED = 4  # not from the core: bodies turn further than a step resolves

DIAGNOSTICS = tuple(_core.number_names)
"""Names of the numbers that the core has for each environment; some open with what they are."""

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
_NO_CONSTANTS: Mapping[str, Constant] = MappingProxyType({})


class Outcome(NamedTuple):
    """The result of a step, with fields as in `State`.

    Attributes:
        positions: [B, N, 3].
        velocities: [B, N, 3].
        body_forces: [B, V, 3].
        contact_forces: [B, N, 3].
        pin_forces: [B, P, 3].
        diagnostics: Lists of length B of the core: status, message and the entries of the report;
            "ended": environment whose motion stopped early -> poses of all roots there, [T, 7]; and
            "pairs": for each environment, (first, second, count, force) of each pair of surfaces in
            contact.
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


class Constant(NamedTuple):
    """An input that nobody outside can edit, and that needs no gradient.

    Attributes:
        tensor: The tensor that identifies it.
        array: Its numbers.
    """

    tensor: Tensor
    array: NDArray[np.float64]

    @staticmethod
    def of(tensor: Tensor) -> Constant:
        """Make the constant of a tensor."""
        return Constant(tensor, as_array(tensor))


def take_step(
    core: _core.Simulator,
    inputs: dict[str, Tensor],
    constants: Mapping[str, Constant] = _NO_CONSTANTS,
) -> Outcome:
    """Take one step; keep a tape only if a gradient may be asked for.

    Args:
        core: The simulator in C++.
        inputs: Float64 tensors, each with a leading axis of environments.
        constants: Constants of the scene: an input that is one of these very tensors bypasses
            autograd.
    """
    known = {n: c.array for n, c in constants.items() if inputs.get(n) is c.tensor}
    given = {name: tensor for name, tensor in inputs.items() if name not in known}
    # Decided here, because inside Function.forward gradients are always off.
    if not is_differentiated(given.values()):
        arrays = known | {name: as_array(t) for name, t in given.items()}
        result = _forward(core, arrays, tape=False)
        return _outcome(_outputs(result), diagnostics_of(result))
    taken = _Taken(core, known, tuple(given))
    outputs = _Step.apply(taken, *given.values())
    return _outcome(outputs, taken.diagnostics)


def are_within(arrays: list[NDArray[np.float64]], largest: float) -> bool:
    """Whether all numbers are at most `largest` in magnitude; false for NaN."""
    return _core.are_within(arrays, largest)


def have_quaternions(poses: NDArray[np.float64], shortest: float) -> bool:
    """Whether all poses [..., 7] have quaternions longer than `shortest`."""
    return _core.have_quaternions(poses, shortest)


def as_array(tensor: Tensor) -> NDArray[np.float64]:
    """Contiguous array of a tensor's numbers; shares its memory if possible."""
    return np.ascontiguousarray(numbers_of(tensor))


def _forward(core: _core.Simulator, arrays: dict[str, Any], *, tape: bool) -> dict[str, Any]:
    note_caller()
    try:
        return core.forward(arrays, tape, torch.get_num_threads())
    except _core.SimulationError as error:
        raise SimulationError(f"step: {error}") from error


def _outputs(result: dict[str, Any]) -> tuple[Tensor, ...]:
    return tuple(torch.from_numpy(result[name]) for name in _OUTPUTS if name in result)


def _outcome(outputs: tuple[Tensor, ...], diagnostics: dict[str, Any]) -> Outcome:
    x, v, of_bodies, of_contact, of_pins, *coordinates = outputs
    return Outcome(x, v, of_bodies, of_contact, of_pins, diagnostics, *coordinates)


def diagnostics_of(result: dict[str, Any]) -> dict[str, Any]:
    """Diagnostics of a step: for each name a list with one number or text per environment."""
    numbers = zip(DIAGNOSTICS, result["numbers"], strict=True)
    others = {name: result[name] for name in ("message", "ended", "pairs")}
    return {**dict(numbers), **others}


class _Taken:
    """A step that has been taken, for its derivatives: what is no input and no output of it."""

    def __init__(
        self, core: _core.Simulator, constants: dict[str, Any], names: tuple[str, ...]
    ) -> None:
        self.core, self.constants, self.names = core, constants, names
        self.diagnostics: dict[str, Any] = {}
        self.tape: dict[str, Tensor] = {}
        # Factors and contacts, which the core frees together with the graph.
        self.kept: Any = None

    @property
    def tape_names(self) -> tuple[str, ...]:
        return tuple(self.tape)


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(taken, *tensors):
        arrays = {name: as_array(t) for name, t in zip(taken.names, tensors, strict=True)}
        result = _forward(taken.core, taken.constants | arrays, tape=True)
        taken.tape = {k: torch.from_numpy(v) for k, v in result.items() if k.startswith(_TAPE)}
        taken.kept = result[_KEPT]
        taken.diagnostics = diagnostics_of(result)
        return _outputs(result)

    @staticmethod
    def setup_context(ctx, inputs, output):
        taken, *tensors = inputs
        # Saves the inputs, not their arrays, because their version counters notice edits in place.
        ctx.save_for_backward(*tensors, *taken.tape.values())
        ctx.save_for_forward(*tensors, *taken.tape.values())
        ctx.shapes = [t.shape for t in (*tensors, *taken.tape.values())]
        ctx.core, ctx.constants, ctx.kept = taken.core, taken.constants, taken.kept
        ctx.names, ctx.tape_names = taken.names, taken.tape_names
        ctx.status = taken.diagnostics["status"]

    @staticmethod
    def vmap(info, in_dims, taken, *tensors):
        """All directions of `jacfwd` have copies of the same inputs: one step serves them."""
        rows = [
            t if axis is None else same_row(t.movedim(axis, 0))
            for t, axis in zip(tensors, in_dims[1:], strict=True)
        ]
        outputs = _Step.apply(taken, *rows)
        return outputs, (None,) * len(outputs)

    @staticmethod
    def jvp(ctx, _, *tangents):
        saved = ctx.saved_tensors
        given = {n: t for n, t in zip(ctx.names, tangents, strict=True) if t is not None}
        function = Directed(
            owner="step",
            saved=len(saved),
            axes=[saved[ctx.names.index(name)].ndim for name in given],
            tangents=partial(_tangents, ctx, tuple(given)),
        )
        return push_forward(function, saved, tuple(given.values()))

    @staticmethod
    def backward(ctx, *cotangents):
        saved = ctx.saved_tensors  # first: raises torch's own error if the tape was freed
        needs = needed(ctx.names, ctx.needs_input_grad[1:])
        function = Differentiated(
            owner="step",
            names=(*ctx.names, *ctx.tape_names),
            shapes=ctx.shapes,
            axes=3,  # positions: [B, N, 3]
            gradients=partial(_backward, ctx, needs),
        )
        found = dict(zip(needs, pull_back(function, saved, cotangents), strict=True))
        return None, *(found.get(name) for name in ctx.names)


def _tangents(step, given, saved, directions):
    arrays = [as_array(t) for t in saved]
    count = len(step.names)
    failed = [i for i, status in enumerate(step.status) if status]
    changed = [i for i in failed if any(_depends(d, i) for d in directions)]
    if changed:
        raise SimulationError(
            f"tangent: the step of environments {changed} failed and has no tangent; give their "
            "inputs none",
            environments=changed,
        )
    note_caller()
    try:
        tangents = step.core.tangent(
            step.constants | dict(zip(step.names, arrays[:count], strict=True)),
            dict(zip(step.tape_names, arrays[count:], strict=True)),
            step.kept,
            {name: as_array(d) for name, d in zip(given, directions, strict=True)},
            len(directions[0]),
            torch.get_num_threads(),
        )
    except _core.SimulationError as error:
        raise SimulationError(f"tangent: {error}") from error
    return [torch.from_numpy(tangents[name]) for name in _OUTPUTS if name in tangents]


def _depends(direction, environment):
    """Whether directions [K, B or 1, ...] change an input of an environment."""
    return bool(direction[:, min(environment, direction.shape[1] - 1)].count_nonzero())


def _backward(step, needs, saved, losses):
    arrays = [as_array(t) for t in saved]
    count = len(step.names)
    note_caller()
    try:
        gradients = step.core.backward(
            step.constants | dict(zip(step.names, arrays[:count], strict=True)),
            dict(zip(step.tape_names, arrays[count:], strict=True)),
            step.kept,
            {name: as_array(c) for name, c in zip(_OUTPUTS, losses, strict=False)},
            len(losses[0]),
            needs,
            torch.get_num_threads(),
        )
    except _core.SimulationError as error:
        raise SimulationError(f"backward: {error}") from error
    except ValueError as error:  # hooks on saved tensors have changed numbers
        raise InvalidInput(f"backward: {error}") from error
    return [torch.from_numpy(gradients[name]) for name in needs]
