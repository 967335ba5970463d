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
backward, refuses a second backward without `retain_graph`, and notices inputs edited in place. What
a scene holds constant, and nobody can edit, is not among them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
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
    "DIAGNOSTICS",
    "INFEASIBLE",
    "INTERSECTING",
    "UNCONVERGED",
    "Constant",
    "Outcome",
    "are_within",
    "as_array",
    "diagnostics_of",
    "have_quaternions",
    "refuse_transforms",
    "take_step",
    "unconverged",
]

# Values of the core's `status`, per environment.
CONVERGED, UNCONVERGED, INFEASIBLE, INTERSECTING = 0, 1, 2, 3

DIAGNOSTICS = tuple(_core.number_names)
"""Names of the numbers that the core has for each environment; some open with what they are."""

# The last one only of scenes that have coordinates.
_OUTPUTS = ("positions", "velocities", "body_forces", "coordinates")
_TAPE = "tape_"
_KEPT = "kept"
_NO_CONSTANTS: Mapping[str, Constant] = MappingProxyType({})
_TRANSFORMS = (
    "step: torch.func transforms and forward-mode derivatives are not supported; use "
    "torch.autograd.grad or .backward(), for many losses or a Jacobian with is_grads_batched=True, "
    "or torch.autograd.functional.jacobian(vectorize=True)"
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
        diagnostics: Lists of length B of the core: status, message and the entries of the report.
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


class Constant(NamedTuple):
    """An input that nobody outside can edit, and that needs no gradient.

    Attributes:
        tensor: By which it is known.
        array: Its numbers.
    """

    tensor: Tensor
    array: NDArray[np.float64]

    @staticmethod
    def of(tensor: Tensor) -> Constant:
        """Take the numbers from the tensor."""
        return Constant(tensor, as_array(tensor))


def take_step(
    core: _core.Simulator,
    inputs: dict[str, Tensor],
    constants: Mapping[str, Constant] = _NO_CONSTANTS,
    *,
    batched: bool,
) -> Outcome:
    """Take one step; a tape is kept only if a gradient may be asked for.

    Args:
        core: The simulator in C++.
        inputs: Float64 tensors, each with a leading axis of environments.
        constants: Those of the scene: where an input is that very tensor, autograd need not see it.
        batched: Whether the outputs keep that axis.
    """
    known = {n: c.array for n, c in constants.items() if inputs.get(n) is c.tensor}
    given = {name: tensor for name, tensor in inputs.items() if name not in known}
    # Inside Function.forward gradients are always off, so this is decided here.
    needs_tape = torch.is_grad_enabled() and any(t.requires_grad for t in given.values())
    if not needs_tape:
        arrays = known | {name: as_array(t) for name, t in given.items()}
        result = _forward(core, arrays, tape=False)
        return _outcome(_outputs(result, batched), diagnostics_of(result))
    diagnostics: dict[str, Any] = {}
    outputs = _Step.apply(core, known, tuple(given), batched, diagnostics, *given.values())
    return _outcome(outputs, diagnostics)


def refuse_transforms(*records: object) -> None:
    """Raise where a gradient would be lost or wrong: under torch.func and forward-mode."""
    if torch._C._are_functorch_transforms_active():
        raise NotImplementedError(_TRANSFORMS)
    if forward_ad._current_level < 0:  # no tensor has a tangent
        return
    tensors = (tensor for record in records for tensor in tensors_of(record))
    if any(forward_ad.unpack_dual(t).tangent is not None for t in tensors):
        raise NotImplementedError(_TRANSFORMS)


def are_within(arrays: list[NDArray[np.float64]], largest: float) -> bool:
    """Whether all numbers are at most `largest` in size; NaN is not."""
    return _core.are_within(arrays, largest)


def have_quaternions(poses: NDArray[np.float64], shortest: float) -> bool:
    """Whether all poses [..., 7] have quaternions longer than `shortest`."""
    return _core.have_quaternions(poses, shortest)


def as_array(tensor: Tensor) -> NDArray[np.float64]:
    """Contiguous array of a tensor's numbers; shares its memory where it can."""
    return np.ascontiguousarray((tensor.detach() if tensor.requires_grad else tensor).numpy())


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


def diagnostics_of(result: dict[str, Any]) -> dict[str, Any]:
    """What a core says of a step: for each name a list of the environments' numbers or texts."""
    numbers = zip(DIAGNOSTICS, result["numbers"], strict=True)
    return {**dict(numbers), "message": result["message"]}


def unconverged(diagnostics: dict[str, Any]) -> list[int]:
    """Environments whose solve did not converge."""
    return [i for i, status in enumerate(diagnostics["status"]) if status != CONVERGED]


_PLAIN = 5  # arguments of _Step.forward that are no tensors


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(ctx, core, constants, names, batched, diagnostics, *tensors):
        arrays = {name: as_array(t) for name, t in zip(names, tensors, strict=True)}
        result = _forward(core, constants | arrays, tape=True)
        tape = {k: torch.from_numpy(v) for k, v in result.items() if k.startswith(_TAPE)}
        # The inputs themselves, not the arrays: their version counters notice edits in place.
        ctx.save_for_backward(*tensors, *tape.values())
        ctx.shapes = [t.shape for t in (*tensors, *tape.values())]
        ctx.core, ctx.constants, ctx.batched = core, constants, batched
        ctx.names, ctx.tape_names = names, tuple(tape)
        # Factors and contacts, which the core forgets when the graph goes.
        ctx.kept = result[_KEPT]
        diagnostics.update(diagnostics_of(result))
        ctx.unconverged = unconverged(diagnostics)
        return _outputs(result, batched)

    @staticmethod
    def backward(ctx, *cotangents):
        saved = ctx.saved_tensors  # first: raises torch's own error if the tape was freed
        gradients = dict(zip(_needs(ctx), _pull_back(ctx, saved, cotangents), strict=True))
        return *[None] * _PLAIN, *(gradients.get(name) for name in ctx.names)


def _needs(ctx):
    """Names of the inputs that need a gradient."""
    needed = zip(ctx.names, ctx.needs_input_grad[_PLAIN:], strict=True)
    return [name for name, is_needed in needed if is_needed]


def _pull_back(ctx, saved, cotangents):
    if not any(map(torch._C._functorch.is_legacy_batchedtensor, cotangents)):
        return _PullBack.apply(ctx, *saved, *cotangents)
    # `is_grads_batched` and vectorized Jacobians still use the older vmap, which knows no rule of
    # a Function: take its batch axis off and put it on again.
    level = torch._C._vmapmode_increment_nesting() - 1
    torch._C._vmapmode_decrement_nesting()
    count = next(
        torch._remove_batch_dim(c, level, 1, 0).shape[0]
        for c in cotangents
        if torch._C._functorch.is_legacy_batchedtensor(c)
    )
    losses = [torch._remove_batch_dim(c, level, count, 0) for c in cotangents]
    gradients = _PullBack.apply(ctx, *saved, *losses)
    return [torch._add_batch_dim(gradient, 0, level) for gradient in gradients]


class _PullBack(torch.autograd.Function):
    """Gradients of a step's inputs from cotangents of its outputs, which may have leading axes.

    A Function of its own, so that all losses of a `vmap` go through one call of the core, and so
    that torch knows all that a gradient depends on. `once_differentiable` is not enough: where the
    cotangent has no graph, as for `.sum()`, the gradient would come back as a constant, and a
    second derivative through it as zero.
    """

    @staticmethod
    def forward(step, *tensors):
        saved, cotangents = tensors[: len(step.shapes)], tensors[len(step.shapes) :]
        _check_saved(step, saved)
        axes = cotangents[0].ndim - (3 if step.batched else 2)  # positions: [.., B, N, 3]
        leading = cotangents[0].shape[:axes]
        shape = (math.prod(leading), *(() if step.batched else (1,)))
        losses = [c.reshape(*shape, *c.shape[axes:]) for c in cotangents]
        _refuse_unconverged(step, losses)
        gradients = _backward(step, saved, losses)
        return tuple(g.reshape(*leading, *g.shape[1:]) for g in gradients)

    @staticmethod
    def setup_context(ctx, inputs, output):
        pass

    @staticmethod
    def vmap(info, in_dims, step, *tensors):
        count = len(step.shapes)
        if any(dim is not None for dim in in_dims[1 : 1 + count]):
            raise NotImplementedError(_TRANSFORMS)
        losses = [
            c.expand(info.batch_size, *c.shape) if dim is None else c.movedim(dim, 0)
            for c, dim in zip(tensors[count:], in_dims[1 + count :], strict=True)
        ]
        gradients = _PullBack.apply(step, *tensors[:count], *losses)
        return gradients, (0,) * len(gradients)

    @staticmethod
    def backward(ctx, *cotangents):
        raise RuntimeError(_SECOND_DERIVATIVES)


def _refuse_unconverged(step, losses):
    """Raise if a loss depends on an environment that has no gradient; others do without it."""
    wanted = [i for i in step.unconverged if any(c[:, i].count_nonzero() for c in losses)]
    if wanted:
        raise NotConverged(
            "backward: a step that did not converge has no gradient; raise max_iterations, or "
            f"leave environments {wanted} out of the loss with diffcloth_torch.where",
            environments=wanted,
        )


def _check_saved(step, saved):
    """Refuse what hooks on saved tensors return instead of what a step has saved."""
    for name, shape, tensor in zip(
        (*step.names, *step.tape_names), step.shapes, saved, strict=True
    ):
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


def _backward(step, saved, losses):
    arrays = [as_array(t) for t in saved]
    count, needs = len(step.names), _needs(step)
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
    except ValueError as error:  # numbers that hooks on saved tensors have changed
        raise InvalidInput(f"backward: {error}") from error
    return [torch.from_numpy(gradients[name]) for name in needs]
