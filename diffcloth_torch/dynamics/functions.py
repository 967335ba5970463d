"""Functions of bodies and robots over a step, evaluated by the core, as operations of torch.

The core records the operations of an evaluation and differentiates them in reverse, so that a
gradient costs a few evaluations for any number of inputs. There is no second derivative.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache

import numpy as np
import torch
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
    without_constants,
)
from diffcloth_torch.autograd.transforms import is_differentiated
from diffcloth_torch.model.kinematics import core_tree
from diffcloth_torch.model.mechanism import Mechanism
from diffcloth_torch.model.robot import ACTUATIONS, BASES

__all__ = ["body_functions", "outputs_of", "robot_functions"]

# Environments per thread; fewer would not pay for the thread.
_EACH = 16


@cache
def body_functions(count: int, dt: float) -> tuple[_core.SmoothFunction, _core.SmoothFunction]:
    """Functions for the prediction of free bodies, and for their state after the step is solved.

    Args:
        count: K.
        dt: h [s].
    """
    return _core.body_functions(count, dt)


def robot_functions(
    mechanism: Mechanism,
    dt: float,
    links: Tensor,
    points: Tensor,
    largest: float,
    *,
    is_at_rest: bool,
    bounds_weight: bool = False,
) -> tuple[_core.SmoothFunction, _core.SmoothFunction]:
    """Functions for the prediction of a robot, and for its state after the step is solved.

    Args:
        mechanism: Links and joints of the robot.
        dt: h [s].
        links: Index of the link of each vertex that may be in contact, shape [V].
        points: These vertices, in the frames of their links [m], shape [V, 3].
        largest: Value of limits that do not exist.
        is_at_rest: True for steps to an equilibrium.
        bounds_weight: If true, these steps use an upper bound for the stiffness of the weight, for
            steps from afar; otherwise the exact stiffness.
    """
    return _core.robot_functions(
        tree=core_tree(mechanism),
        base=BASES.index(mechanism.base),
        actuation=[ACTUATIONS.index(mode) for mode in mechanism.actuation],
        vertex_link=links.tolist(),
        points=np.array(points.numpy()),
        dt=dt,
        largest=largest,
        is_at_rest=is_at_rest,
        bounds_weight=bounds_weight,
    )


def outputs_of(
    function: _core.SmoothFunction,
    inputs: Mapping[str, Tensor],
    constants: Mapping[str, Constant] = NO_CONSTANTS,
) -> dict[str, Tensor]:
    """Return outputs [B, ...] by their names, with a graph if an input has one.

    Args:
        function: The function.
        inputs: Its arrays [B or 1, ...] by their names, without optional ones that are not given.
        constants: Constants of the scene: an input that is one of these very tensors bypasses
            autograd.
    """
    note_caller()
    known, given = without_constants(inputs, constants)
    if not is_differentiated(given.values()):
        arrays = known | {name: as_array(tensor) for name, tensor in given.items()}
        values = function.values(arrays, _threads(arrays.values()))
        return {name: torch.from_numpy(array) for name, array in values.items()}
    operation = _Operation(function, known, tuple(given))
    results = evaluate(operation, tuple(given.values()))
    return dict(zip(operation.outputs, results, strict=True))


class _Operation(CoreFunction):
    owner = "step"

    def __init__(
        self, function: _core.SmoothFunction, constants: Arrays, names: tuple[str, ...]
    ) -> None:
        super().__init__(names, constants)
        self._function = function
        self.outputs: tuple[str, ...] = ()

    def values(self, inputs: Arrays) -> tuple[Tensor, ...]:
        values = self._function.values(inputs, _threads(inputs.values()))
        self.outputs = tuple(values)
        return tuple(torch.from_numpy(array) for array in values.values())

    def tangents(self, inputs: Arrays, tape: Arrays, given: Arrays, count: int) -> list[Tensor]:
        threads = _threads(inputs.values())
        tangents = self._function.tangents(inputs, given, count, threads)
        return [torch.from_numpy(tangents[name]) for name in self.outputs]

    def gradients(
        self, inputs: Arrays, tape: Arrays, cotangents: list[Tensor], needs: list[str]
    ) -> list[Tensor]:
        given = dict(zip(self.outputs, map(as_array, cotangents), strict=True))
        losses, threads = len(cotangents[0]), _threads(inputs.values())
        gradients = self._function.gradients(inputs, given, losses, needs, threads)
        return [
            torch.from_numpy(gradients[name]).reshape(losses, *inputs[name].shape) for name in needs
        ]


def _threads(arrays: Iterable[np.ndarray]) -> int:
    environments = max(map(len, arrays))
    return min(torch.get_num_threads(), max(1, environments // _EACH))
