"""Environments in which a step failed: their states have no gradient; backward raises an error."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from diffcloth_torch.autograd import torch_private
from diffcloth_torch.autograd.transforms import is_differentiated, same_rows
from diffcloth_torch.errors import (
    InfeasibleMotion,
    NotConverged,
    SimulationError,
    TurnedTooFar,
)
from diffcloth_torch.model.quantities import Fields
from diffcloth_torch.sim.solve.step import CONVERGED, INFEASIBLE, TURNED, UNCONVERGED

__all__ = ["failures_of", "mark", "refuse_gradients"]

Failures = dict[int, type[SimulationError]]
"""Environments whose step failed -> the error to raise."""

_ERRORS = {UNCONVERGED: NotConverged, INFEASIBLE: InfeasibleMotion, TURNED: TurnedTooFar}
_REMEDIES: dict[type[SimulationError], str] = {
    InfeasibleMotion: "a step that did not complete the prescribed motion has no gradient; move "
    "bodies and pins less far in it",
    NotConverged: "a step that did not converge has no gradient; lower dt",
    TurnedTooFar: "a step in which a body turns further than contact resolves has no gradient; "
    "lower dt",
}


def mark(diagnostics: dict[str, Any], messages: Mapping[int, str], status: int) -> None:
    """Mark environments as failed with a status and its message, unless they failed before."""
    for environment, message in messages.items():
        if diagnostics["status"][environment] == CONVERGED:
            diagnostics["status"][environment] = status
            diagnostics["message"][environment] = message


def failures_of(diagnostics: dict[str, Any]) -> Failures:
    """Environments that failed, according to the diagnostics of the core."""
    return {i: _ERRORS[status] for i, status in enumerate(diagnostics["status"]) if status}


def refuse_gradients(fields: Fields, failures: Failures) -> Fields:
    """Return the same fields [B, ...]; a derivative that depends on a failed environment raises."""
    if not failures:
        return fields
    return {
        name: _Guard.apply(tensor, failures) if is_differentiated((tensor,)) else tensor
        for name, tensor in fields.items()
    }


class _Guard(torch.autograd.Function):
    """The identity; checks the cotangents of backward, and tangents."""

    @staticmethod
    def forward(tensor, failures):
        return tensor.clone()

    @staticmethod
    def setup_context(ctx, inputs, output):
        tensor, ctx.failures = inputs
        ctx.environment_axis = -tensor.ndim

    @staticmethod
    def vmap(info, in_dims, tensor, failures):
        return _Guard.apply(*same_rows([tensor], in_dims[:1]), failures), None

    @staticmethod
    def jvp(ctx, tangent, _):
        return _Look.apply(tangent, ctx.failures, ctx.environment_axis)

    @staticmethod
    def backward(ctx, cotangent):
        plain = cotangent
        if torch_private.is_batched_by_older_vmap(cotangent):
            # As in `apply_map`: the older vmap ignores the rules of a Function.
            plain = torch_private.without_older_axis(cotangent)
        seen = _Look.apply(plain, ctx.failures, ctx.environment_axis)
        return seen if plain is cotangent else cotangent, None


class _Look(torch.autograd.Function):
    """Raise if cotangents, which may have leading axes, belong to a failed environment."""

    @staticmethod
    def forward(cotangent, failures, environment_axis):
        rows = cotangent.movedim(environment_axis, 0)
        wanted = [i for i in failures if rows[i].count_nonzero()]
        for error, remedy in _REMEDIES.items():
            environments = [i for i in wanted if failures[i] is error]
            if environments:
                raise error(
                    f"backward: {remedy}, or leave environments {environments} out of the loss "
                    "with diffcloth_torch.where",
                    environments=environments,
                )
        return cotangent.clone()

    @staticmethod
    def setup_context(ctx, inputs, output):
        pass

    @staticmethod
    def vmap(info, in_dims, cotangent, *rest):
        return _Look.apply(cotangent.movedim(in_dims[0], 0), *rest), 0

    @staticmethod
    def jvp(ctx, tangent, *_):
        return tangent.clone()

    @staticmethod
    def backward(ctx, cotangent):
        return cotangent, None, None
