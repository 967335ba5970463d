"""Variables of a fit, and the space of numbers that a solver searches."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import (
    POSITIVE,
    FloatArray,
    Range,
    check_bool,
    check_choice,
    check_finite,
    check_number,
    check_range,
    check_shape,
    float_array,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.model.quantities import PARAMETERS

__all__ = ["Space", "Variable"]

_SCALES = ("log", "linear")
_SPREADS = Range(1.0)
_AT_BOUND = 1e-6  # distance of theta from a bound at which theta counts as at the bound
_REACH = 1e3  # default bounds on the scale "log": this factor to both sides of the first value


@dataclass(frozen=True, eq=False)
class Variable:
    """A variable of a fit: its first value and its range.

    Attributes:
        value: First value, a number or an array in the unit of the quantity.
        bounds: Lowest and highest value of each number. By default a variable on the scale "log"
            may change by a factor of 1000; any other variable has the accepted range of the
            parameter of its name.
        scale: "log" searches the logarithm, so steps are relative; "linear" searches the value
            itself. By default "log" for parameters that cannot be negative, if all values are
            positive.
        free: False keeps the value.
        spread: Factor, > 1, by which random starts on the scale "log" may differ from the first
            value; their logarithms are uniform. On the scale "linear" random starts are uniform
            between the bounds, or between zero and twice the first value if a bound is infinite.
        prior: Knowledge before any observation: (mean, deviation), numbers or arrays of the shape
            of the value. On the scale "log" the deviation is the deviation of the natural
            logarithm: 0.1 is about 10 %. The fit weighs the prior against the residuals, as one
            more observation of that standard deviation, and draws the random starts from it. None
            means that only the bounds are known.
    """

    value: object
    bounds: tuple[float, float] | None = None
    scale: Literal["log", "linear"] | None = None
    free: bool = True
    spread: float = 3.0
    prior: tuple[object, object] | None = None

    def __post_init__(self) -> None:
        numbers = float_array("Variable: `value`", self.value).copy()
        check_number("Variable: `spread`", self.spread, _SPREADS)
        check_finite("Variable: `value`", numbers)
        if not numbers.size:
            raise InvalidInput("Variable: `value` must be one or more numbers, got none")
        check_bool("Variable: `free`", self.free)
        object.__setattr__(self, "value", numbers)
        if self.scale is not None:
            check_choice("Variable: `scale`", self.scale, _SCALES)
        if self.bounds is not None:
            ends = _ends(self.bounds)
            object.__setattr__(self, "bounds", ends)
            _check_between("Variable: `value`", numbers, ends)
        if self.scale == "log":
            _check_positive("Variable: `value`", numbers)
        if self.prior is not None:
            object.__setattr__(self, "prior", _prior(self.prior, numbers.shape, self.bounds))


@dataclass(frozen=True, eq=False)
class _Axis:
    """A free variable, and its rows in the vector theta of all numbers."""

    name: str
    shape: tuple[int, ...]
    rows: slice
    log: bool
    low: float
    high: float
    spread: float
    prior: tuple[FloatArray, FloatArray] | None
    is_default: bool


class Space:
    """Vectors of numbers theta, one for each number of the free variables.

    Attributes:
        all_variables: Names of all variables, in their order.
        variables: Names of the free variables.
        names: Name of each number, as "stretch" or "velocity[0]".
        first: The first values, as theta.
        low: Lowest values of theta.
        high: Highest values of theta.
        means: Means of the priors, as theta; zero without a prior.
        precisions: Reciprocal standard deviations of the priors; zero without a prior.
    """

    def __init__(self, variables: Mapping[str, Variable]) -> None:
        """Lay out the free variables.

        Args:
            variables: Name -> variable.

        Raises:
            InvalidInput: If no variable is free.
            TypeError: If an entry is not a `Variable`.
        """
        if not isinstance(variables, Mapping):
            raise TypeError(
                "fit: `variables` must be a dict of name -> Variable, got "
                f"{type(variables).__name__}"
            )
        for name, variable in variables.items():
            if not isinstance(name, str):
                raise TypeError(f"fit: `variables` must have names as keys, got {name!r}")
            if not isinstance(variable, Variable):
                raise TypeError(
                    f"fit: variables[{name!r}] must be a Variable, got {type(variable).__name__}"
                )
        self._kept = {
            name: torch.from_numpy(_numbers(variable))
            for name, variable in variables.items()
            if not variable.free
        }
        self.all_variables = tuple(variables)
        self._axes, self.names, first = [], [], 0
        for name, variable in variables.items():
            if variable.free:
                axis = _axis(name, variable, first)
                first = axis.rows.stop
                self._axes.append(axis)
                self.names += _entries(name, axis.shape)
        if not self._axes:
            raise InvalidInput("fit: `variables` must have at least one that is free")
        self.variables = [axis.name for axis in self._axes]
        self.first = np.concatenate(
            [_to(axis, _numbers(variables[axis.name])) for axis in self._axes]
        )
        counts = [axis.rows.stop - axis.rows.start for axis in self._axes]
        self.low = np.repeat([_bound(axis, axis.low) for axis in self._axes], counts)
        self.high = np.repeat([_bound(axis, axis.high) for axis in self._axes], counts)
        self.means, self.precisions = np.zeros(len(self)), np.zeros(len(self))
        for axis in self._axes:
            if axis.prior is not None:
                mean, deviation = axis.prior
                self.means[axis.rows] = _to(axis, mean)
                self.precisions[axis.rows] = 1 / deviation.reshape(-1)

    def described(self) -> list[Any]:
        """Description of the space, to identify saved evaluations, in types of `torch.load`."""
        numbers = (self.low, self.high, self.means, self.precisions)
        kept = [[name, value.tolist()] for name, value in self._kept.items()]
        return [list(self.names), kept, *(found.tolist() for found in numbers)]

    def __len__(self) -> int:
        """Count the numbers."""
        return len(self.names)

    def rows(self, name: str) -> range:
        """Rows of theta that belong to a variable."""
        rows = next(axis.rows for axis in self._axes if axis.name == name)
        return range(rows.start, rows.stop)

    def values(self, theta: Tensor) -> dict[str, Tensor]:
        """Values of all variables by name, differentiable in theta."""
        free = {}
        for axis in self._axes:
            numbers = theta[axis.rows].reshape(axis.shape)
            free[axis.name] = numbers.exp() if axis.log else numbers
        return {name: free.get(name, self._kept.get(name)) for name in self.all_variables}  # type: ignore[misc]

    def at_bounds(self, theta: FloatArray) -> list[str]:
        """Names of the numbers at their lowest or highest value."""
        here = (theta <= self.low + _AT_BOUND) | (theta >= self.high - _AT_BOUND)
        return [name for name, is_here in zip(self.names, here, strict=True) if is_here]

    @property
    def default_bounds(self) -> list[str]:
        """Variables without given bounds, whose bounds are a factor from their first value."""
        return [axis.name for axis in self._axes if axis.log and axis.is_default]

    def rates(self, theta: FloatArray) -> FloatArray:
        """Derivative of each number with respect to its theta."""
        rates = np.ones(len(self))
        for axis in self._axes:
            if axis.log:
                rates[axis.rows] = np.exp(theta[axis.rows])
        return rates

    def from_theta(self, theta: FloatArray) -> FloatArray:
        """The numbers represented by theta."""
        numbers = np.array(theta)
        for axis in self._axes:
            if axis.log:
                numbers[axis.rows] = np.exp(theta[axis.rows])
        return numbers

    def units(self, theta: FloatArray) -> FloatArray:
        """Change of each theta that corresponds to its own size."""
        units = np.ones(len(self))
        for axis in self._axes:
            if not axis.log:
                size = max(float(np.abs(theta[axis.rows]).max()), 1e-300)
                span = axis.high - axis.low
                units[axis.rows] = span / 2 if math.isfinite(span) else size
        return units

    def draw(self, generator: np.random.Generator) -> FloatArray:
        """Draw a start: from priors, positive numbers around the first, others between bounds."""
        theta = np.array(self.first)
        for axis in self._axes:
            first, rows = self.first[axis.rows], axis.rows
            if axis.prior is not None:
                drawn = generator.normal(self.means[rows], 1 / self.precisions[rows])
                theta[rows] = np.clip(drawn, self.low[rows], self.high[rows])
                continue
            if axis.log:
                reach = math.log(axis.spread)
                low, high = first - reach, first + reach
            elif math.isfinite(axis.high - axis.low):
                low, high = np.full_like(first, axis.low), np.full_like(first, axis.high)
            else:
                low, high = first - np.abs(first), first + np.abs(first)
            low, high = np.maximum(low, self.low[rows]), np.minimum(high, self.high[rows])
            theta[rows] = generator.uniform(low, high)
        return theta


def _ends(bounds: object) -> tuple[float, float]:
    ends = float_array("Variable: `bounds`", bounds)
    if ends.shape != (2,) or not ends[0] < ends[1]:
        raise InvalidInput(f"Variable: `bounds` must be (low, high) with low < high, got {bounds}")
    return float(ends[0]), float(ends[1])


def _check_between(name: str, numbers: FloatArray, ends: tuple[float, float]) -> None:
    wrong = (numbers < ends[0]) | (numbers > ends[1])
    if wrong.any():
        at = [int(i) for i in np.argwhere(wrong)[0]]
        raise InvalidInput(
            f"{name} must be between its bounds {ends[0]:g} and {ends[1]:g}, "
            f"got {numbers[tuple(at)]:g}" + (f" at {at}" if at else "")
        )


def _check_positive(name: str, numbers: FloatArray) -> None:
    if not (numbers > 0).all():
        raise InvalidInput(
            f'{name} must be positive on the scale "log", got {float(numbers.min()):g}'
        )


def _prior(
    prior: object, shape: tuple[int, ...], bounds: tuple[float, float] | None
) -> tuple[FloatArray, FloatArray]:
    """Mean and deviation of each number."""
    if not isinstance(prior, tuple | list) or len(prior) != 2:
        raise InvalidInput(f"Variable: `prior` must be (mean, deviation), got {prior!r}")
    found = []
    for name, part in zip(("mean", "deviation"), prior, strict=True):
        numbers = float_array(f"Variable: the {name} of `prior`", part)
        check_shape(f"Variable: the {name} of `prior`", numbers.shape, [(), shape])
        found.append(np.broadcast_to(numbers, shape).copy())
    mean, deviation = found
    check_finite("Variable: the mean of `prior`", mean)
    check_range("Variable: the deviation of `prior`", deviation, POSITIVE)
    if bounds is not None:
        _check_between("Variable: the mean of `prior`", mean, bounds)
    return mean, deviation


def _numbers(variable: Variable) -> FloatArray:
    assert isinstance(variable.value, np.ndarray)
    return variable.value


def _axis(name: str, variable: Variable, first: int) -> _Axis:
    numbers = _numbers(variable)
    known = PARAMETERS.get(name)
    never_negative = known is not None and known.accepted.low == 0.0
    log = variable.scale == "log"
    if variable.scale is None:
        log = never_negative and bool((numbers > 0).all())
    prior: Any = variable.prior
    if log:
        _check_positive(f"fit: variables[{name!r}], `value`", numbers)
        if prior is not None:
            _check_positive(f"fit: variables[{name!r}], the mean of `prior`,", prior[0])
    if known is not None:
        check_range(f"fit: variables[{name!r}], `value`", numbers, known.accepted)
        if prior is not None:
            check_range(f"fit: variables[{name!r}], the mean of `prior`", prior[0], known.accepted)
    if variable.bounds is not None:
        low, high = variable.bounds
        if known is not None and not known.accepted.low <= low < high <= known.accepted.high:
            raise InvalidInput(
                f"fit: variables[{name!r}], `bounds` must be between {known.accepted.low:g} and "
                f"{known.accepted.high:g}, got {low:g} and {high:g}"
            )
    elif log:
        low, high = float(numbers.min()) / _REACH, float(numbers.max()) * _REACH
    elif known is not None:
        low, high = known.accepted.low, known.accepted.high
    else:
        low, high = -math.inf, math.inf
    return _Axis(
        name=name,
        shape=numbers.shape,
        rows=slice(first, first + numbers.size),
        log=log,
        low=max(low, 0.0) if log else low,
        high=high,
        spread=variable.spread,
        prior=prior,
        is_default=variable.bounds is None,
    )


def _to(axis: _Axis, numbers: FloatArray) -> FloatArray:
    flat = numbers.reshape(-1)
    return np.log(flat) if axis.log else flat.copy()


def _bound(axis: _Axis, value: float) -> float:
    if not axis.log:
        return value
    return math.log(value) if value > 0 else -math.inf


def _entries(name: str, shape: tuple[int, ...]) -> list[str]:
    if not shape:
        return [name]
    return [name + "".join(f"[{i}]" for i in index) for index in np.ndindex(*shape)]
