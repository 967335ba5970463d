"""One step as one differentiable operation: a call into the core forward, and one backward.

A step finds the minimizer x(u) of a potential P(x, u), where u stands for all inputs. At the
minimizer the gradient vanishes, and so does its derivative along u:

    g(x, u) = dP/dx = 0,    H dx + (dg/du) du = 0,    H = dg/dx.

With the cotangents x_bar of everything that depends on x, the gradient of the loss is

    H lambda = x_bar,    u_bar = -(dg/du)^T lambda + (explicit dependence of the outputs on u),

one solve with the Hessian of the same potential, and then products with mixed derivatives. The
velocities (x - x_n) / h and the contact forces on the bodies are such outputs; each friction
iteration adds one solve. The formulas of every term are in the C++ core.

The tape of a step is plain tensors, saved by torch together with the inputs: torch frees them after
backward, refuses a second backward without `retain_graph`, and notices inputs edited in place.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import forward_ad

from diffcloth_torch import _core
from diffcloth_torch.checks import is_dense
from diffcloth_torch.errors import InvalidInput, NotConverged, SimulationError
from diffcloth_torch.sim.controls import tensors_of

__all__ = [
    "CONVERGED",
    "INFEASIBLE",
    "INTERSECTING",
    "UNCONVERGED",
    "Outcome",
    "as_array",
    "refuse_transforms",
    "take_step",
]

# Values of the core's `status`, per environment.
CONVERGED, UNCONVERGED, INFEASIBLE, INTERSECTING = 0, 1, 2, 3

# The last one only of scenes that have coordinates.
_OUTPUTS = ("positions", "velocities", "body_forces", "coordinates")
_TAPE = "tape_"
_KEPT = "kept"
_TRANSFORMS = (
    "step: torch.func transforms, forward-mode derivatives and vectorized Jacobians are not "
    "supported; use torch.autograd.grad or .backward(), and a loop over the rows of a Jacobian"
)
_SECOND_DERIVATIVES = (
    "step: second derivatives are not available; the gradient of a step cannot be differentiated "
    "again, detach it where it enters another loss"
)


class Outcome(NamedTuple):
    """What a step returns.

    Attributes:
        positions: [B, N, 3], or [N, 3] without a batch axis.
        velocities: Likewise.
        body_forces: [B, V, 3] or [V, 3].
        diagnostics: Arrays [B] of the core: status, message and the entries of the report.
        coordinates: Of bodies and robots at the end of the step, [B, n] or [n]; None where there
            are none.
    """

    positions: Tensor
    velocities: Tensor
    body_forces: Tensor
    diagnostics: dict[str, Any]
    coordinates: Tensor | None = None

    def first(self) -> Outcome:
        """The first environment, without its axis; the diagnostics stay."""
        return self._replace(
            positions=self.positions[0],
            velocities=self.velocities[0],
            body_forces=self.body_forces[0],
        )


def take_step(core: _core.Simulator, inputs: dict[str, Tensor], *, batched: bool) -> Outcome:
    """Take one step; a tape is kept only if a gradient may be asked for.

    Args:
        core: The simulator in C++.
        inputs: Float64 tensors, each with a leading axis of environments.
        batched: Whether the outputs keep that axis.
    """
    # Inside Function.forward gradients are always off, so this is decided here.
    needs_tape = torch.is_grad_enabled() and any(t.requires_grad for t in inputs.values())
    if not needs_tape:
        result = _forward(core, {name: as_array(t) for name, t in inputs.items()}, tape=False)
        return _outcome(_outputs(result, batched), _diagnostics(result))
    diagnostics: dict[str, Any] = {}
    outputs = _Step.apply(core, tuple(inputs), batched, diagnostics, *inputs.values())
    return _outcome(outputs, diagnostics)


def refuse_transforms(*records: object) -> None:
    """Raise where a gradient would be lost or wrong: under torch.func and forward-mode."""
    active = torch._C._are_functorch_transforms_active()
    tensors = (tensor for record in records for tensor in tensors_of(record))
    if active or any(forward_ad.unpack_dual(t).tangent is not None for t in tensors):
        raise NotImplementedError(_TRANSFORMS)


def as_array(tensor: Tensor) -> NDArray[np.float64]:
    """Contiguous array of a tensor's numbers; shares its memory where it can."""
    return np.ascontiguousarray(tensor.detach().numpy())


def _is_batched_by_vmap(tensor: Tensor) -> bool:
    functorch = torch._C._functorch  # vectorized Jacobians still use the older of the two
    return functorch.is_batchedtensor(tensor) or functorch.is_legacy_batchedtensor(tensor)


def _forward(core: _core.Simulator, arrays: dict[str, Any], *, tape: bool) -> dict[str, Any]:
    try:
        return core.forward(arrays, tape, torch.get_num_threads())
    except _core.SimulationError as error:
        raise SimulationError(f"step: {error}") from error


def _outputs(result: dict[str, Any], batched: bool) -> tuple[Tensor, ...]:
    arrays = (result[name] for name in _OUTPUTS if name in result)
    return tuple(torch.from_numpy(array if batched else array[0]) for array in arrays)


def _outcome(outputs: tuple[Tensor, ...], diagnostics: dict[str, Any]) -> Outcome:
    positions, velocities, body_forces, *coordinates = outputs
    return Outcome(positions, velocities, body_forces, diagnostics, *coordinates)


def _diagnostics(result: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in result.items() if k not in _OUTPUTS and not k.startswith(_TAPE)}


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(ctx, core, names, batched, diagnostics, *tensors):
        arrays = {name: as_array(t) for name, t in zip(names, tensors, strict=True)}
        result = _forward(core, arrays, tape=True)
        tape = {k: torch.from_numpy(v) for k, v in result.items() if k.startswith(_TAPE)}
        # The inputs themselves, not the arrays: their version counters notice edits in place.
        ctx.save_for_backward(*tensors, *tape.values())
        ctx.shapes = [t.shape for t in (*tensors, *tape.values())]
        ctx.core, ctx.names, ctx.tape_names, ctx.batched = core, names, tuple(tape), batched
        # Factors and contacts, which the core forgets when the graph goes.
        ctx.kept = result.pop(_KEPT)
        diagnostics.update(_diagnostics(result))
        ctx.unconverged = np.flatnonzero(result["status"] != CONVERGED).tolist()
        return _outputs(result, batched)

    @staticmethod
    def backward(ctx, *cotangents):
        saved = ctx.saved_tensors  # first: raises torch's own error if the tape was freed
        if any(map(_is_batched_by_vmap, cotangents)):
            raise NotImplementedError(_TRANSFORMS)
        _refuse_unconverged(ctx, cotangents)
        tensors = saved[: len(ctx.names)]
        # The first four arguments of forward are not tensors.
        needs = dict(zip(ctx.names, ctx.needs_input_grad[4:], strict=True))
        gradients = _backward(ctx, saved, cotangents, [name for name in needs if needs[name]])
        rows = [gradients.get(name) for name in ctx.names]
        if torch.is_grad_enabled():  # create_graph=True
            anchors = (*tensors, *cotangents)
            rows = [None if row is None else _Once.apply(row, *anchors) for row in rows]
        return None, None, None, None, *rows


def _refuse_unconverged(ctx, cotangents):
    """Raise if the loss depends on an environment that has no gradient; others do without it."""
    wanted = [
        i
        for i in ctx.unconverged
        if any((c[i] if ctx.batched else c).count_nonzero() for c in cotangents)
    ]
    if wanted:
        raise NotConverged(
            "backward: a step that did not converge has no gradient; raise max_iterations, or "
            f"leave environments {wanted} out of the loss with diffcloth_torch.where",
            environments=wanted,
        )


def _check_saved(ctx, saved):
    """Refuse what hooks on saved tensors return instead of what a step has saved."""
    for name, shape, tensor in zip((*ctx.names, *ctx.tape_names), ctx.shapes, saved, strict=True):
        if tensor.dtype != torch.float64 or tensor.device.type != "cpu" or not is_dense(tensor):
            raise TypeError(
                f"backward: saved `{name}` must come back as a dense float64 tensor on the CPU, "
                f"got {tensor.dtype} on {tensor.device}"
            )
        if tensor.shape != shape:
            raise InvalidInput(
                f"backward: saved `{name}` must come back with shape {list(shape)}, "
                f"got {list(tensor.shape)}"
            )


def _backward(ctx, saved, cotangents, needs):
    _check_saved(ctx, saved)
    arrays = [as_array(t) for t in saved]
    count = len(ctx.names)
    seeds = [c if ctx.batched else c.unsqueeze(0) for c in cotangents]
    try:
        gradients = ctx.core.backward(
            dict(zip(ctx.names, arrays[:count], strict=True)),
            dict(zip(ctx.tape_names, arrays[count:], strict=True)),
            ctx.kept,
            {name: as_array(c) for name, c in zip(_OUTPUTS, seeds, strict=False)},
            needs,
            torch.get_num_threads(),
        )
    except _core.SimulationError as error:
        raise SimulationError(f"backward: {error}") from error
    except ValueError as error:  # numbers that hooks on saved tensors have changed
        raise InvalidInput(f"backward: {error}") from error
    return {name: torch.from_numpy(gradients[name]) for name in needs}


class _Once(torch.autograd.Function):
    """Identity on a gradient, tied to all that it depends on, which refuses to be differentiated.

    `once_differentiable` is not enough: where the cotangent has no graph, as for `.sum()`, the
    gradient would come back as a constant, and a second derivative through it as zero.
    """

    @staticmethod
    def forward(ctx, gradient, *anchors):
        return gradient.view_as(gradient)

    @staticmethod
    def backward(ctx, *cotangents):
        raise RuntimeError(_SECOND_DERIVATIVES)
