"""Functions of the core as operations of torch: values, tangents, and gradients."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from inspect import signature
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import _core
from diffcloth_torch._exit import note_caller
from diffcloth_torch.autograd.linear_map import LinearMap, apply_map
from diffcloth_torch.autograd.transforms import numbers_of, same_rows
from diffcloth_torch.errors import InvalidInput, SimulationError

__all__ = [
    "NO_CONSTANTS",
    "Arrays",
    "Constant",
    "CoreFunction",
    "as_array",
    "evaluate",
    "failing_as",
    "without_constants",
]

Arrays = dict[str, NDArray[np.float64]]


def as_array(tensor: Tensor) -> NDArray[np.float64]:
    """Return a contiguous array of a tensor's numbers; shares its memory if possible."""
    return np.ascontiguousarray(numbers_of(tensor))


class Constant(NamedTuple):
    """An input that cannot be edited from outside, and that needs no gradient.

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


NO_CONSTANTS: Mapping[str, Constant] = MappingProxyType({})


def without_constants(
    inputs: Mapping[str, Tensor], constants: Mapping[str, Constant]
) -> tuple[Arrays, dict[str, Tensor]]:
    """Split inputs into arrays of the constants among them, and all other inputs."""
    known = {n: c.array for n, c in constants.items() if inputs.get(n) is c.tensor}
    return known, {n: tensor for n, tensor in inputs.items() if n not in known}


@contextmanager
def failing_as(operation: str) -> Iterator[None]:
    """Add the name of the operation to errors of the core."""
    try:
        yield
    except _core.SimulationError as error:
        raise SimulationError(f"{operation}: {error}") from error


class CoreFunction(ABC):
    """A function of the core that is evaluated once, by `evaluate`.

    Attributes:
        owner: Name of the function in messages.
        names: Names of its differentiable inputs.
        constants: Arrays of all other inputs; the methods receive them among their inputs.
        tape: Further data for its derivatives, kept by the graph.
    """

    owner: str

    def __init__(self, names: tuple[str, ...], constants: Arrays | None = None) -> None:
        self.names, self.constants = names, {} if constants is None else constants
        self.tape: dict[str, Tensor] = {}

    def inputs(self, arrays: Iterable[NDArray[np.float64]]) -> Arrays:
        """Return all inputs by name, from arrays of the differentiable ones."""
        return self.constants | dict(zip(self.names, arrays, strict=True))

    @abstractmethod
    def values(self, inputs: Arrays) -> tuple[Tensor, ...]:
        """Compute all outputs, and fill the tape."""

    @abstractmethod
    def tangents(self, inputs: Arrays, tape: Arrays, given: Arrays, count: int) -> list[Tensor]:
        """Tangents of all outputs, [count, ...], from tangents of some inputs, [count, ...]."""

    @abstractmethod
    def gradients(
        self, inputs: Arrays, tape: Arrays, cotangents: list[Tensor], needs: list[str]
    ) -> list[Tensor]:
        """Gradients of some inputs, from cotangents of all outputs; both [losses, ...]."""


def evaluate(function: CoreFunction, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return the outputs of a function at its inputs, with a graph."""
    outputs: tuple[Tensor, ...] = _Evaluate.apply(function, *inputs)
    # From here on only the graph holds the tape: torch frees it after backward.
    function.tape = {}
    return outputs


class _Evaluate(torch.autograd.Function):
    @staticmethod
    def forward(function, *tensors):
        return function.values(function.inputs(map(as_array, tensors)))

    @staticmethod
    def setup_context(ctx, inputs, output):
        function, *tensors = inputs
        # Saves the inputs, not their arrays, because their version counters notice edits in place.
        saved = (*tensors, *function.tape.values())
        ctx.save_for_backward(*saved)
        ctx.save_for_forward(*saved)
        ctx.function = function
        ctx.saved_names = (*function.names, *function.tape)
        ctx.saved_shapes = [t.shape for t in saved]
        ctx.axes = output[0].ndim

    @staticmethod
    def vmap(info, in_dims, function, *tensors):
        """Evaluate once: all directions of `jacfwd` have equal copies of the inputs."""
        outputs = _Evaluate.apply(function, *same_rows(tensors, in_dims[1:]))
        return outputs, (None,) * len(outputs)

    @staticmethod
    def jvp(ctx, _, *tangents):
        given = {n: t for n, t in zip(ctx.function.names, tangents, strict=True) if t is not None}
        first = ctx.saved_shapes[ctx.saved_names.index(next(iter(given)))]
        linear = LinearMap(
            owner=ctx.function.owner,
            kind="tangent",
            saved_names=ctx.saved_names,
            saved_shapes=ctx.saved_shapes,
            axes=len(first),
            rows=partial(_tangents, ctx, tuple(given)),
        )
        return apply_map(linear, ctx.saved_tensors, tuple(given.values()))

    @staticmethod
    def backward(ctx, *cotangents):
        saved = ctx.saved_tensors  # first: raises torch's own error if the tape was freed
        names = ctx.function.names
        needs = [n for n, used in zip(names, ctx.needs_input_grad[1:], strict=True) if used]
        linear = LinearMap(
            owner=ctx.function.owner,
            kind="gradient",
            saved_names=ctx.saved_names,
            saved_shapes=ctx.saved_shapes,
            axes=ctx.axes,
            rows=partial(_gradients, ctx, needs),
        )
        found = dict(zip(needs, apply_map(linear, saved, cotangents), strict=True))
        return None, *(found.get(name) for name in names)


# torch calls `signature` in every call; without this attribute it inspects the function anew.
_Evaluate.forward.__signature__ = signature(_Evaluate.forward)  # type: ignore[attr-defined]


def _tangents(ctx, given, saved, directions):
    inputs, tape = _arrays(ctx, saved)
    rows = dict(zip(given, map(as_array, directions), strict=True))
    note_caller()
    with failing_as("tangent"):
        return ctx.function.tangents(inputs, tape, rows, len(directions[0]))


def _gradients(ctx, needs, saved, losses):
    inputs, tape = _arrays(ctx, saved)
    note_caller()
    try:
        with failing_as("backward"):
            return ctx.function.gradients(inputs, tape, losses, needs)
    except ValueError as error:  # hooks on saved tensors have changed numbers
        raise InvalidInput(f"backward: {error}") from error


def _arrays(ctx, saved):
    arrays = dict(zip(ctx.saved_names, map(as_array, saved), strict=True))
    inputs = ctx.function.inputs([arrays.pop(name) for name in ctx.function.names])
    return inputs, arrays
