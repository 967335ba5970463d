"""New tensors on the CPU, float64 by default, independent of torch's defaults.

`with torch.device(..)`, `torch.set_default_device` and `torch.set_default_dtype` affect tensors
that torch makes without a device or a type. The package therefore makes all tensors here, with
both. A temporary change of the defaults during an operation would not reach backward and other
threads, and would affect the functions of a caller, whose tensors follow the caller's defaults.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Generator, Tensor

__all__ = [
    "DEVICE",
    "arange",
    "as_tensor",
    "eye",
    "full",
    "generator",
    "linspace",
    "ones",
    "rand",
    "randint",
    "randn",
    "randperm",
    "tensor",
    "zeros",
]

DEVICE = torch.device("cpu")
_F64, _I64 = torch.float64, torch.int64


def tensor(values: Any, *, dtype: torch.dtype = _F64) -> Tensor:
    """Copy numbers into a tensor."""
    return torch.tensor(values, dtype=dtype, device=DEVICE)


def as_tensor(values: Any) -> Tensor:
    """Return a tensor unchanged, and other values in NumPy's type for them.

    Raises:
        TypeError: If NumPy reads no numbers.
        ValueError: If NumPy reads no rectangular array.
        RuntimeError: If the value is a list with tensors that require gradients.
    """
    return values if isinstance(values, Tensor) else torch.from_numpy(np.asarray(values).copy())


def zeros(*shape: Any, dtype: torch.dtype = _F64) -> Tensor:
    """Make zeros."""
    return torch.zeros(*shape, dtype=dtype, device=DEVICE)


def ones(*shape: Any, dtype: torch.dtype = _F64) -> Tensor:
    """Make ones."""
    return torch.ones(*shape, dtype=dtype, device=DEVICE)


def full(shape: tuple[int, ...], value: float, *, dtype: torch.dtype = _F64) -> Tensor:
    """Fill a shape with one number."""
    return torch.full(shape, value, dtype=dtype, device=DEVICE)


def eye(size: int) -> Tensor:
    """Make the identity [size, size]."""
    return torch.eye(size, dtype=_F64, device=DEVICE)


def arange(*ends: float, dtype: torch.dtype = _I64) -> Tensor:
    """Count from one end (0 by default) to the other, by an optional third number."""
    return torch.arange(*ends, dtype=dtype, device=DEVICE)


def linspace(first: float, last: float, count: int) -> Tensor:
    """Divide an interval evenly."""
    return torch.linspace(first, last, count, dtype=_F64, device=DEVICE)


def generator() -> Generator:
    """Make a generator of random numbers."""
    return Generator(device=DEVICE)


def rand(*shape: int, generator: Generator) -> Tensor:
    """Draw uniformly between 0 and 1."""
    return torch.rand(*shape, generator=generator, dtype=_F64, device=DEVICE)


def randn(*shape: int, generator: Generator, dtype: torch.dtype) -> Tensor:
    """Draw from the standard normal distribution."""
    return torch.randn(*shape, generator=generator, dtype=dtype, device=DEVICE)


def randint(high: int, shape: tuple[int, ...], *, generator: Generator) -> Tensor:
    """Draw integers of 0 .. high - 1."""
    return torch.randint(high, shape, generator=generator, dtype=_I64, device=DEVICE)


def randperm(count: int, *, generator: Generator) -> Tensor:
    """Draw a permutation."""
    return torch.randperm(count, generator=generator, dtype=_I64, device=DEVICE)
