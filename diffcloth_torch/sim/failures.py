"""Environments in which a step failed: their states have no gradient, and say so when asked."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from diffcloth_torch.errors import InfeasibleMotion, NotConverged, SimulationError
from diffcloth_torch.sim.step import INFEASIBLE, UNCONVERGED, vmap_level

__all__ = ["failures_of", "refuse_gradients"]

Failures = dict[int, type[SimulationError]]
"""Environments whose step failed -> the error that says so."""

_ERRORS = {UNCONVERGED: NotConverged, INFEASIBLE: InfeasibleMotion}
_REMEDIES: dict[type[SimulationError], str] = {
    InfeasibleMotion: "a step that did not complete the prescribed motion has no gradient; move "
    "bodies and pins less far in it",
    NotConverged: "a step that did not converge has no gradient; raise max_iterations",
}


def failures_of(diagnostics: dict[str, Any]) -> Failures:
    """Environments that failed, by the diagnostics of the core."""
    return {i: _ERRORS[status] for i, status in enumerate(diagnostics["status"]) if status}


def refuse_gradients(
    fields: dict[str, Tensor], failures: Failures, *, batched: bool
) -> dict[str, Tensor]:
    """The same fields of a state; backward raises where a loss depends on a failed environment."""
    if not failures:
        return fields
    return {
        name: _Guard.apply(tensor, failures, batched) if tensor.requires_grad else tensor
        for name, tensor in fields.items()
    }


class _Guard(torch.autograd.Function):
    """The identity, of which backward looks at what comes back."""

    @staticmethod
    def forward(ctx, tensor, failures, batched):
        ctx.failures, ctx.environment_axis = failures, -tensor.ndim if batched else None
        return tensor.clone()

    @staticmethod
    def backward(ctx, cotangent):
        plain = cotangent
        if torch._C._functorch.is_legacy_batchedtensor(cotangent):
            # As in `step`: the older vmap knows no rule of a Function.
            plain = torch._remove_batch_dim(cotangent, vmap_level(), 1, 0)
        seen = _Look.apply(plain, ctx.failures, ctx.environment_axis)
        return seen if plain is cotangent else cotangent, None, None


class _Look(torch.autograd.Function):
    """Raise where cotangents, which may have leading axes, are of a failed environment."""

    @staticmethod
    def forward(cotangent, failures, environment_axis):
        axis = environment_axis
        rows = cotangent[None] if axis is None else cotangent.movedim(axis, 0)
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
    def backward(ctx, cotangent):
        return cotangent, None, None
