"""Variables of a fit, and the space of numbers that a solver searches."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch.checks import (
    ANY_NUMBER,
    POSITIVE,
    ArrayLike,
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
from diffcloth_torch.reprs import dataclass_text

__all__ = ["Prior", "Space", "Tie", "Values", "Variable"]

_SCALES = ("log", "linear")
_SPREADS = Range(1.0)
_AT_BOUND = 1e-6  # distance of theta to a bound below which it is at the bound
_SHOWN = 20  # most numbers that are printed one by one
_REACH = 1e3  # default bounds on the scale "log": factor to both sides of the first value


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
            logarithm: 0.1 is about 10 %. The prior counts as one more observation with that
            standard deviation, and random starts are drawn from it. None means that only the bounds
            are known.
    """

    value: ArrayLike
    bounds: tuple[float, float] | None = None
    scale: Literal["log", "linear"] | None = None
    free: bool = True
    spread: float = 3.0
    prior: tuple[ArrayLike, ArrayLike] | None = None

    __repr__ = dataclass_text

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
class Tie:
    """A variable that follows another one, such as a weft that is 1.2 times as stiff as the warp.

    Attributes:
        of: Name of the variable to follow, which must not be a tie.
        by: Factor, or a function of the tensor of that variable; with `workers` the function must
            be picklable.
    """

    of: str
    by: float | Callable[[Tensor], Tensor] = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.of, str):
            raise TypeError(f"Tie: `of` must be a name, got {type(self.of).__name__}")
        if not callable(self.by):
            check_number("Tie: `by`", self.by, ANY_NUMBER)


@dataclass(frozen=True, eq=False)
class Prior:
    """Joint prior of several variables: means and a covariance.

    Attributes:
        means: Name of each variable -> its mean, of the shape of its value.
        covariance: Covariance of all numbers in the order of the names, symmetric and positive
            definite [n, n]; on the scale "log", of the natural logarithms.
    """

    means: Mapping[str, object]
    covariance: object

    def __post_init__(self) -> None:
        given: Any = self.means
        if not isinstance(given, Mapping) or not given:
            raise TypeError("Prior: `means` must be a dict of one or more name -> mean")
        means = {n: float_array(f"Prior: means[{n!r}]", v).copy() for n, v in self.means.items()}
        for name, mean in means.items():
            check_finite(f"Prior: means[{name!r}]", mean)
        count = sum(mean.size for mean in means.values())
        matrix = float_array("Prior: `covariance`", self.covariance).copy()
        check_shape("Prior: `covariance`", matrix.shape, [(count, count)])
        check_finite("Prior: `covariance`", matrix)
        if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0):
            raise InvalidInput("Prior: `covariance` must be symmetric")
        if np.linalg.eigvalsh(matrix)[0] <= 0.0:
            raise InvalidInput("Prior: `covariance` must be positive definite")
        object.__setattr__(self, "means", means)
        object.__setattr__(self, "covariance", matrix)


class Values(dict[str, Tensor]):
    """Values of variables by name; prints six digits of each number."""

    def __repr__(self) -> str:
        return "{" + ", ".join(f"{name!r}: {_digits(v)}" for name, v in self.items()) + "}"


def _digits(value: Tensor) -> str:
    if not value.dim():
        return f"{float(value):.6g}"
    if value.numel() > _SHOWN:
        low, high = float(value.min()), float(value.max())
        return f"{list(value.shape)} numbers from {low:.6g} to {high:.6g}"
    return "[" + ", ".join(map(_digits, value.unbind())) + "]"


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
        given: Name -> variable.
        priors: Priors of several variables.
        all_variables: Names of all variables, in their order.
        variables: Names of the free variables.
        names: Name of each number, such as "stretch" or "velocity[0]".
        first: The first values, as theta.
        low: Lowest values of theta.
        high: Highest values of theta.
        means: Means of the priors, as theta; zero for numbers without a prior.
        whitening: Matrix P [k, p] that makes P (theta - means) the residuals of the priors.
    """

    def __init__(
        self, variables: Mapping[str, Variable | Tie], priors: Sequence[Prior] = ()
    ) -> None:
        """Lay out the free variables.

        Args:
            variables: Name -> variable.
            priors: Priors of several variables.

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
            if not isinstance(variable, Variable | Tie):
                raise TypeError(
                    f"fit: variables[{name!r}] must be a Variable, got {type(variable).__name__}"
                )
        self.given, self.priors = dict(variables), tuple(priors)
        self.all_variables = tuple(variables)
        self._ties = {n: v for n, v in variables.items() if isinstance(v, Tie)}
        given = {n: v for n, v in variables.items() if isinstance(v, Variable)}
        for name, tie in self._ties.items():
            if tie.of not in given:
                raise InvalidInput(
                    f"fit: variables[{name!r}].of may name {', '.join(given)}; got {tie.of!r}"
                )
        self._kept = {
            name: torch.from_numpy(_numbers(variable))
            for name, variable in given.items()
            if not variable.free
        }
        self._axes, self.names, first = [], [], 0
        for name, variable in given.items():
            if variable.free:
                axis = _axis(name, variable, first)
                first = axis.rows.stop
                self._axes.append(axis)
                self.names += _entries(name, axis.shape)
        if not self._axes:
            raise InvalidInput("fit: `variables` must have at least one that is free")
        self.variables = [axis.name for axis in self._axes]
        self.first = np.concatenate([_to(axis, _numbers(given[axis.name])) for axis in self._axes])
        counts = [axis.rows.stop - axis.rows.start for axis in self._axes]
        self.low = np.repeat([_bound(axis, axis.low) for axis in self._axes], counts)
        self.high = np.repeat([_bound(axis, axis.high) for axis in self._axes], counts)
        self.means = np.zeros(len(self))
        self._joint: list[tuple[NDArray[np.int64], FloatArray]] = []
        for k, prior in enumerate(priors):
            self._joint.append(self._placed(k, prior))
        blocks: list[tuple[Any, FloatArray]] = []
        for axis in self._axes:
            if axis.prior is not None:
                mean, deviation = axis.prior
                self.means[axis.rows] = _to(axis, mean)
                blocks.append((axis.rows, np.diag(1 / deviation.reshape(-1))))
        # With the Cholesky factor L of a covariance, residuals are L^-1 (theta - means).
        for known, factor in self._joint:
            blocks.append((known, np.asarray(np.linalg.inv(factor), dtype=np.float64)))
        self.whitening = np.zeros((sum(len(block) for _, block in blocks), len(self)))
        first = 0
        for rows, block in blocks:
            self.whitening[first : first + len(block), rows] = block
            first += len(block)

    def _placed(self, k: int, prior: Prior) -> tuple[NDArray[np.int64], FloatArray]:
        """Rows of a prior of several variables, and the Cholesky factor of its covariance."""
        if not isinstance(prior, Prior):
            raise TypeError(f"fit: priors[{k}] must be a Prior, got {type(prior).__name__}")
        axes = {axis.name: axis for axis in self._axes}
        rows: list[int] = []
        for name, mean in prior.means.items():
            if name not in axes:
                raise InvalidInput(
                    f"fit: priors[{k}] may name {', '.join(axes)}, which are free; got {name!r}"
                )
            axis, numbers = axes[name], np.asarray(mean)
            taken = any(axis.rows.start in known for known, _ in self._joint)
            if axis.prior is not None or taken:
                raise InvalidInput(f"fit: priors[{k}] names {name!r}, which has a prior already")
            check_shape(f"fit: priors[{k}].means[{name!r}]", numbers.shape, [axis.shape])
            if axis.log:
                _check_positive(f"fit: priors[{k}].means[{name!r}]", numbers)
            self.means[axis.rows] = _to(axis, numbers)
            rows += range(axis.rows.start, axis.rows.stop)
        return np.array(rows), np.linalg.cholesky(np.asarray(prior.covariance))

    def described(self) -> list[Any]:
        """Return an identification of saved evaluations, in types that `torch.load` reads."""
        numbers = (self.low, self.high, self.means, self.whitening)
        kept = [[name, value.tolist()] for name, value in self._kept.items()]
        ties = [[n, t.of, "function" if callable(t.by) else t.by] for n, t in self._ties.items()]
        return [list(self.names), kept, ties, *(found.tolist() for found in numbers)]

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
        found = {**self._kept, **free}
        found |= {name: _tied(tie, found[tie.of]) for name, tie in self._ties.items()}
        return {name: found[name] for name in self.all_variables}

    def at_bounds(self, theta: FloatArray) -> list[str]:
        """Names of the numbers at their lowest or highest value."""
        here = (theta <= self.low + _AT_BOUND) | (theta >= self.high - _AT_BOUND)
        return [name for name, is_here in zip(self.names, here, strict=True) if is_here]

    @property
    def default_bounds(self) -> list[str]:
        """Variables on the scale "log" with default bounds, a factor from their first value."""
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

    def reach(self, factor: float) -> FloatArray:
        """Distance of theta for a factor on the scale "log", else for that many sizes."""
        distances = np.full(len(self), factor)
        for axis in self._axes:
            if axis.log:
                distances[axis.rows] = math.log(factor)
        return distances

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
                drawn = generator.normal(self.means[rows], axis.prior[1].reshape(-1))
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
        for known, factor in self._joint:
            drawn = self.means[known] + factor @ generator.standard_normal(len(known))
            theta[known] = np.clip(drawn, self.low[known], self.high[known])
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


def _tied(tie: Tie, value: Tensor) -> Tensor:
    return tie.by(value) if callable(tie.by) else tie.by * value


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
