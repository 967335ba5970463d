"""Validation of arguments: each helper returns the checked value or describes the error.

`name` is the prefix of the message, for example "Material: `stretch`".
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import _core
from diffcloth_torch.autograd.transforms import has_derivative, is_dense, numbers_of
from diffcloth_torch.errors import InvalidInput

__all__ = [
    "ANY_NUMBER",
    "LARGEST",
    "LARGEST_COUNT",
    "NON_NEGATIVE",
    "OVERLAPPING",
    "POISSON",
    "POSITIVE",
    "SMALLEST",
    "ArrayLike",
    "FloatArray",
    "IndexArray",
    "Range",
    "are_within",
    "check_bool",
    "check_choice",
    "check_count",
    "check_finite",
    "check_ignored_pairs",
    "check_name",
    "check_number",
    "check_pairs",
    "check_range",
    "check_shape",
    "float_array",
    "float_tensor",
    "frozen",
    "index_array",
    "refuse_gradient",
    "refuse_threads",
    "texts",
]

ArrayLike = npt.ArrayLike | Tensor
"""Numbers as given: an array, a tensor without a graph, a number, or lists of them."""

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int32]

_FLOAT64_BYTES = 8
# Counts reach the core as 32-bit integers.
LARGEST_COUNT = 2**31 - 1
_LARGEST_SHOWN = 10**30
# Integers are accepted as floats; float16, bfloat16 and float32 widen without loss.
_PROMOTABLE = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
_INTEGERS = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)


class Range(NamedTuple):
    """An interval of accepted numbers; `closed` includes its finite ends."""

    low: float = -math.inf
    high: float = math.inf
    closed: bool = False

    def outside(self, values: FloatArray) -> NDArray[np.bool_]:
        """Return a mask of values outside of the interval; NaN is outside."""
        if self.closed:
            inside = (values >= self.low) & (values <= self.high)
        else:
            inside = (values > self.low) & (values < self.high)
        return ~inside

    def holds(self, least: float, greatest: float) -> bool:
        """Return whether all numbers between two are inside; false for NaN."""
        if self.closed:
            return self.low <= least and greatest <= self.high
        return self.low < least and greatest < self.high

    def __str__(self) -> str:
        """Describe the range in words, to follow "must be"."""
        if math.isinf(self.low) and math.isinf(self.high):
            return "finite"
        if math.isinf(self.high):
            return f"finite and {'>=' if self.closed else '>'} {self.low:g}"
        ends = "inclusive" if self.closed else "exclusive"
        return f"between {self.low:g} and {self.high:g} ({ends})"


# The core multiplies up to ten numbers of one size (squares of volumes and their derivatives in
# distances, stiffness over squared time steps): within these bounds such products neither overflow
# nor vanish. They are far outside every system of units.
LARGEST = 1e30
SMALLEST = 1e-30

OVERLAPPING = "overlapping"
"""Used instead of pairs of surfaces that do not collide: all pairs that overlap at the start."""

ANY_NUMBER = Range()
POSITIVE = Range(0.0)
NON_NEGATIVE = Range(0.0, closed=True)
POISSON = Range(-1.0, 0.5)
UNIT_INTERVAL = Range(0.0, 1.0, closed=True)


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Mark an array as read-only; no caller may own it."""
    array.setflags(write=False)
    return array


def refuse_gradient(name: str, value: object, instead: str) -> None:
    """Refuse a tensor that is being differentiated if no derivative is available."""
    if isinstance(value, Tensor) and has_derivative(value):
        raise InvalidInput(
            f"{name} must not require a gradient: none flows there; {instead} instead"
        )


def float_array(name: str, value: object, *, instead: str = "pass a detached tensor") -> FloatArray:
    """Copy numbers into a new float64 array; promotes without loss and refuses everything else."""
    refuse_gradient(name, value, instead)
    if isinstance(value, Tensor):
        return np.array(numbers_of(float_tensor(name, value)), dtype=np.float64, order="C")
    array = _array(name, value, "numbers")
    if array.dtype.kind in "US" and array.size:
        text = str(array.reshape(-1)[0])
        raise TypeError(
            f"{name} must hold real numbers, got the text {text!r}; convert it with float(..), as "
            "YAML 1.1 reads 1e-3 as text, and 1.0e-3 as a number"
        )
    if array.dtype.kind not in "fiu" or array.dtype.itemsize > _FLOAT64_BYTES:
        raise TypeError(
            f"{name} must hold real numbers of at most 64 bits, got dtype {array.dtype}"
        )
    return np.array(array, dtype=np.float64, order="C")


def float_tensor(name: str, value: object) -> Tensor:
    """Promote to a float64 tensor on the CPU; a tensor keeps its graph, other values are copied."""
    if not isinstance(value, Tensor):
        return torch.from_numpy(float_array(name, value))
    _require_dense(name, value)
    if value.dtype not in _PROMOTABLE + _INTEGERS:
        raise TypeError(f"{name} must be a tensor of real numbers, got {value.dtype}")
    return value if value.dtype == torch.float64 else value.to(torch.float64)


def are_within(arrays: list[FloatArray], largest: float) -> bool:
    """Return true if all numbers are at most `largest` in magnitude, false for NaN."""
    return _core.are_within(arrays, largest)


def _require_dense(name: str, value: Tensor) -> None:
    if not is_dense(value):
        kind = "a nested tensor" if value.is_nested else str(value.layout)
        raise TypeError(f"{name} must be a dense tensor, got {kind}; make it dense first")
    if not value.is_cpu:
        raise TypeError(f"{name} must be on the CPU, got {value.device}; call .cpu() first")


def _array(name: str, value: object, content: str) -> NDArray[Any]:
    """Convert array-like values; refuse values that would lose information."""
    if isinstance(value, np.ma.MaskedArray):
        raise TypeError(
            f"{name} must not be a masked array, as its mask would be lost; fill it first"
        )
    if isinstance(value, Tensor):
        _require_dense(name, value)
        value = numbers_of(value)
    try:
        return np.asarray(value)
    except (ValueError, RuntimeError) as error:  # ragged lists; tensors with a graph inside lists
        raise InvalidInput(f"{name} must be a rectangular array of {content}: {error}") from error


def index_array(name: str, value: object, count: int) -> IndexArray:
    """Copy vertex indices into a new int32 array, each in 0 .. count - 1."""
    array = _array(name, value, "indices")
    if array.size and array.dtype.kind not in "iu":
        raise TypeError(f"{name} must hold integers, got dtype {array.dtype}")
    outside = (array < 0) | (array >= count)
    if outside.any():
        at = tuple(int(i) for i in np.argwhere(outside)[0])
        raise InvalidInput(
            f"{name} must be indices between 0 and {count - 1}, got {array[at]} at {list(at)}"
        )
    return np.array(array, dtype=np.int32, order="C")


def check_shape(
    name: str, got: Sequence[int], accepted: Iterable[Sequence[int | str]], hint: str = ""
) -> None:
    """Require one of the accepted shapes; a letter in a shape stands for any length."""
    shapes = tuple(accepted)
    for shape in shapes:
        if shape == got:  # for most tensors
            return
        if len(shape) == len(got) and all(
            n == m or isinstance(n, str) for n, m in zip(shape, got, strict=True)
        ):
            return
    texts = ["[" + ", ".join(str(n) for n in shape) + "]" for shape in shapes]
    raise InvalidInput(f"{name} must have shape {' or '.join(texts)}, got {list(got)}{hint}")


def check_finite(name: str, values: FloatArray) -> None:
    """Require finite numbers."""
    check_range(name, values, ANY_NUMBER)


def check_range(name: str, values: FloatArray, accepted: Range) -> None:
    """Require finite numbers in a range; the message holds the first offending index.

    Positive numbers must not be so small, and no number so large, that powers of them leave the
    range of float64.
    """
    smallest = SMALLEST if accepted.low == 0.0 and not accepted.closed else -LARGEST
    if values.size == 0:
        return
    # Each step checks all of its inputs: without an error, two numbers suffice.
    least, greatest = float(values.min()), float(values.max())
    if accepted.holds(least, greatest) and smallest <= least and greatest <= LARGEST:
        return
    _refuse(name, values, accepted.outside(values) | ~np.isfinite(values), str(accepted))
    too_large = f"at most {LARGEST:g} in size, as powers of it would overflow"
    _refuse(name, values, np.abs(values) > LARGEST, too_large)
    too_small = f"at least {SMALLEST:g}, as powers of it would vanish"
    _refuse(name, values, values < smallest, too_small)


def _refuse(name: str, values: FloatArray, wrong: NDArray[np.bool_], accepted: str) -> None:
    if wrong.any():
        at = [int(i) for i in np.argwhere(wrong)[0]]
        where = f" at {at}" if at else ""
        raise InvalidInput(f"{name} must be {accepted}, got {values[tuple(at)]:g}{where}")


def check_number(
    name: str, value: object, accepted: Range, *, instead: str = "pass a plain number"
) -> float:
    """Require one number in a range."""
    array = float_array(name, value, instead=instead)
    check_shape(name, array.shape, [()])
    check_range(name, array, accepted)
    return float(array)


def check_count(name: str, value: object, minimum: int, maximum: int = LARGEST_COUNT) -> int:
    """Require an integer of at least `minimum` and at most `maximum`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name} must be an integer, got {type(value).__name__}")
    count = int(value)
    if not minimum <= count <= maximum:
        # Python does not print integers of thousands of digits.
        got = f"{count}" if abs(count) < _LARGEST_SHOWN else f"one of {count.bit_length()} bits"
        bound = f"at least {minimum}" if count < minimum else f"at most {maximum}"
        raise InvalidInput(f"{name} must be {bound}, got {got}")
    return count


def check_bool(name: str, value: object) -> bool:
    """Require True or False."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, got {type(value).__name__}")
    return bool(value)


def check_choice(name: str, value: object, accepted: Sequence[str]) -> str:
    """Require one of the accepted words."""
    if not isinstance(value, str):
        kind = type(value).__name__
        raise TypeError(f"{name} must be a string, one of {texts(accepted)}, got {kind}")
    if value not in accepted:
        raise InvalidInput(f"{name} must be one of {texts(accepted)}, got {value!r}")
    return value


def refuse_threads(name: str, workers: object) -> None:
    """Refuse executors with threads of this process: torch has one number of threads for all.

    Forward derivatives of torch do not reach other threads either.
    """
    if isinstance(workers, ThreadPoolExecutor):
        raise InvalidInput(
            f"{name} must be processes or other machines, got threads of this process, which "
            "share what torch keeps for all of them"
        )


def check_name(name: str, value: object) -> str | None:
    """Require a printable name without a slash, which separates cloth and pin names, or None."""
    if value is None:
        return None
    if not isinstance(value, str):
        raise TypeError(f"{name} must be a string, got {type(value).__name__}")
    if not value or "/" in value or not value.isprintable():
        raise InvalidInput(f"{name} must be non-empty, printable and without '/', got {value!r}")
    return value


def check_pairs(name: str, value: Any, accepted: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Require an iterable of pairs of two different accepted names."""
    pairs = []
    if not isinstance(value, Iterable) or getattr(value, "ndim", 1) == 0:
        raise TypeError(f"{name} must be a list of pairs of names, got {type(value).__name__}")
    for i, pair in enumerate(value):
        if not isinstance(pair, list | tuple) or len(pair) != 2 or pair[0] == pair[1]:
            raise InvalidInput(f"{name} must hold pairs of two names, got {pair!r} at [{i}]")
        for entry in pair:
            if entry not in accepted:
                raise InvalidInput(
                    f"{name} has the names {texts(accepted)}; got {entry!r} at [{i}]"
                )
        pairs.append((pair[0], pair[1]))
    return tuple(pairs)


def check_ignored_pairs(
    name: str, value: Any, accepted: Sequence[str]
) -> tuple[tuple[str, str], ...] | str:
    """Require pairs of two different accepted names, or the word for all pairs that overlap."""
    if isinstance(value, str):
        return check_choice(name, value, (OVERLAPPING,))
    return check_pairs(name, value, accepted)


def texts(names: Iterable[object]) -> str:
    """List names in a message."""
    return ", ".join(map(repr, names)) or "none"
