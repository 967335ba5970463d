"""Derivatives of a fixed point x = S(x, p) of a map with known products with vectors.

The value of S at the fixed point has the derivative dS/dp, and the fixed point

    dx/dp = (1 - dS/dx)^-1 dS/dp = (1 + dS/dx + (dS/dx)^2 + ..) dS/dp.

The series converges as fast as the repetitions of S by which the fixed point was found. Backward
sums its terms. Forward repeats S as often as necessary, since torch has products with dS/dx only
when S is evaluated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext

import numpy as np
import torch
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks

from diffcloth_torch import cpu
from diffcloth_torch.autograd.core_function import Arrays, CoreFunction, evaluate
from diffcloth_torch.autograd.transforms import in_backward_transform, outside_transforms
from diffcloth_torch.errors import SimulationError

__all__ = ["Linearization", "as_fixed_point", "at_values"]

# Terms of the series are added until they are this small relative to their sum; largest number.
_SMALL = 1e-12
_TERMS = 500

Fields = dict[str, Tensor]


class Linearization:
    """S near a fixed point, as a function of x alone.

    Attributes:
        acts: Environments in which S depends on x, [B]; in others this dependence is ignored.
    """

    def __init__(
        self, function: Callable[[Fields], Mapping[str, Tensor]], at: Fields, acts: Tensor
    ) -> None:
        """Evaluate S at x = `at`, fields [B, ...]; the result has fields of the same names."""
        # Hooks of an enclosing checkpoint are not for this graph. Inside `torch.func.grad`
        # torch has no checkpoints, and refuses hooks.
        hooks: AbstractContextManager[None] = nullcontext()
        if not in_backward_transform():
            hooks = saved_tensors_hooks(torch.Tensor.detach, lambda tensor: tensor)
        with outside_transforms(), torch.enable_grad(), hooks:
            self._x = {n: t.detach().clone().requires_grad_() for n, t in at.items()}
            found = function(self._x)
        self._found = [found[name] for name in at]
        self.acts = acts

    def transposed(self, vectors: list[Tensor]) -> list[Tensor]:
        """Products (dS/dx)^T v of vectors [k, B, ...]."""
        pairs = [(f, v) for f, v in zip(self._found, vectors, strict=True) if f.requires_grad]
        if not pairs:
            return [torch.zeros_like(v) for v in vectors]
        is_one = len(vectors[0]) == 1
        masked = [self.masked(v) for _, v in pairs]
        with outside_transforms():
            products: tuple[Tensor | None, ...] = torch.autograd.grad(
                [f for f, _ in pairs],
                list(self._x.values()),
                [v[0] for v in masked] if is_one else masked,
                retain_graph=True,
                is_grads_batched=not is_one,
                allow_unused=True,
            )
        return [
            torch.zeros_like(v) if p is None else self.masked(p.reshape(v.shape))
            for v, p in zip(vectors, products, strict=True)
        ]

    def terms(self) -> Tensor:
        """Return the number of powers of dS/dx that are not small, in each environment, [B]."""
        # `torch.vmap` refuses random numbers of torch. All environments use equal ones.
        generator = np.random.default_rng(0)
        vectors = [
            torch.from_numpy(generator.standard_normal(x.shape[1:])).expand(1, *x.shape)
            for x in self._x.values()
        ]
        counts = cpu.zeros(len(self.acts), dtype=torch.long)
        first = _size(vectors)[0]
        for _ in range(_TERMS):
            vectors = self.transposed(vectors)
            remains = _size(vectors)[0] > _SMALL * first
            if not remains.any():
                return counts
            counts += remains
        raise _unsettled(remains)

    def masked(self, vectors: Tensor) -> Tensor:
        """Vectors [k, B, ...], set to zero in environments without dependence on x."""
        return torch.where(self.acts.reshape(-1, *[1] * (vectors.ndim - 2)), vectors, 0.0)


def as_fixed_point(found: Fields, linearization: Linearization, at: Fields) -> Fields:
    """Return the fixed point `at`, with its derivative from the derivative of `found` = S(x, p)."""
    return _evaluated(_FixedPoint(tuple(found), at, linearization), found)


def at_values(found: Fields, at: Fields) -> Fields:
    """The values of `at`, with the derivative of `found`."""
    return _evaluated(_FixedPoint(tuple(found), at, None), found)


def _evaluated(function: _FixedPoint, found: Fields) -> Fields:
    return dict(zip(found, evaluate(function, tuple(found.values())), strict=True))


class _FixedPoint(CoreFunction):
    owner = "equilibrium"

    def __init__(self, names: tuple[str, ...], at: Fields, linearization: Linearization | None):
        super().__init__(names)
        self._at, self._linearization = at, linearization

    def values(self, inputs: Arrays) -> tuple[Tensor, ...]:
        return tuple(self._at[name].clone() for name in self.names)

    def tangents(self, inputs: Arrays, tape: Arrays, given: Arrays, count: int) -> list[Tensor]:
        assert self._linearization is None  # it has no products with dS/dx
        zeros = {n: cpu.zeros(count, *t.shape) for n, t in self._at.items()}
        return [torch.from_numpy(given[n]) if n in given else zeros[n] for n in self.names]

    def gradients(
        self, inputs: Arrays, tape: Arrays, cotangents: list[Tensor], needs: list[str]
    ) -> list[Tensor]:
        sums = cotangents
        if self._linearization is not None:
            sums = _summed(self._linearization, cotangents)
        found = dict(zip(self.names, sums, strict=True))
        return [found[name].clone() for name in needs]


def _summed(linearization: Linearization, vectors: list[Tensor]) -> list[Tensor]:
    """The sum of all powers of (dS/dx)^T on vectors [k, B, ...]."""
    terms = [linearization.masked(v) for v in vectors]
    sums = [term.clone() for term in terms]
    for _ in range(_TERMS):
        terms = linearization.transposed(terms)
        remains = _size(terms) > _SMALL * _size(sums)
        if not remains.any():
            return sums
        for total, term in zip(sums, terms, strict=True):
            # Vectors and environments are independent of each other.
            mask = remains.reshape(*remains.shape, *[1] * (term.ndim - 2))
            term.masked_fill_(~mask, 0.0)
            total += term
    raise _unsettled(remains.any(dim=0))


def _size(vectors: list[Tensor]) -> Tensor:
    """Largest absolute entry of vectors [k, B, ...] in each environment, [k, B]."""
    sizes = [v.abs().flatten(2) for v in vectors if v[0, 0].numel()]
    return torch.stack([s.amax(dim=2) for s in sizes]).amax(dim=0)


def _unsettled(remains: Tensor) -> SimulationError:
    return SimulationError(
        "equilibrium: there is no derivative, as friction and normal forces do not settle where "
        "something changes a little",
        environments=remains.nonzero()[:, 0].tolist(),
    )
