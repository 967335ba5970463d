"""Residuals extrapolated to a time step of zero, from simulations with several time steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from diffcloth_torch.checks import POSITIVE, Range, check_number
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.optimize.compared import Comparison, blocks_of, note, noting

__all__ = ["RATIOS", "extrapolated", "require_linear"]

_OWNER = "residuals.extrapolated"
RATIOS = Range(1.0)
"""Accepted ratios of two time steps or edge lengths."""


@dataclass(frozen=True, eq=False)
class _Extrapolated:
    """Weighted sum of residuals, one function for each time step; can be pickled."""

    levels: tuple[Callable[..., Any], ...]
    weights: tuple[float, ...]

    def __call__(self, *arguments: Any) -> dict[str, Tensor]:
        """Evaluate every level, and combine block by block."""
        found, notes = [], []
        for level in self.levels:
            with noting() as compared:
                blocks = blocks_of(f"{_OWNER}: every level", level(*arguments))
            require_linear(_OWNER, compared)
            found.append(blocks)
            notes.append(compared)
        _check_shapes(found)
        if len({len(compared) for compared in notes}) == 1:
            for comparisons in zip(*notes, strict=True):
                note(self._compared(comparisons))
        return {name: self._sum([blocks[name] for blocks in found]) for name in found[0]}

    def _sum(self, parts: Sequence[Any]) -> Any:
        return sum(weight * part for weight, part in zip(self.weights, parts, strict=True))

    def _compared(self, levels: Sequence[Comparison]) -> Comparison:
        """Comparison of extrapolated with observed positions."""
        frames = zip(*(level.simulated for level in levels), strict=True)
        return replace(levels[-1], simulated=[self._sum(frame) for frame in frames])


def extrapolated(
    coarse: Callable[..., Any],
    fine: Callable[..., Any],
    finer: Callable[..., Any] | None = None,
    *,
    ratio: float = 2.0,
    order: float = 1.0,
) -> Callable[..., dict[str, Tensor]]:
    """Residuals of a simulation with the time step h, extrapolated to a time step of zero.

    Implicit Euler has an error of first order, r(h) = r(0) + a h + b h^2 + ... where the motion is
    smooth. A combination of two time steps, `2 fine - coarse` for the ratio 2, has an error of
    second order; a combination of three has third order (Richardson, 1911). For
    `integrator="second_order"` use `order=2`: the weights of two time steps are then 4/3 and -1/3.
    Impacts, changes between sticking and slipping, and buckling are not smooth in h: check such a
    motion with a third time step.

    Only residuals that are linear in positions, such as `markers`, can be combined. `point_cloud`
    and `outline` choose the nearest vertex or edge anew in each simulation, and are refused.

    Args:
        coarse: Residuals of the simulation with the time step h, as for `fit`.
        fine: Residuals with the time step h / ratio, as many and in the same order.
        finer: Residuals with the time step h / ratio^2, likewise; None combines two time steps.
        ratio: Ratio of two successive time steps, > 1.
        order: Power of h in the error, > 0; the power of the next term is larger by one.

    Returns:
        A function for `fit`, which can be pickled if the given functions can.

    Raises:
        InvalidInput: If `ratio` or `order` is not accepted; in a call, if the residuals cannot be
            combined.
        TypeError: If one of the levels is not a function.
    """
    levels = (coarse, fine) if finer is None else (coarse, fine, finer)
    for name, level in zip(("coarse", "fine", "finer"), levels, strict=False):
        if not callable(level):
            raise TypeError(f"{_OWNER}: `{name}` must be a function, got {type(level).__name__}")
    base = check_number(f"{_OWNER}: `ratio`", ratio, RATIOS)
    q = base ** check_number(f"{_OWNER}: `order`", order, POSITIVE)
    a, b = -1 / (q - 1), q / (q - 1)
    weights: tuple[float, ...] = (a, b)
    if finer is not None:
        # The errors left by (coarse, fine) and (fine, finer) have the ratio q * base.
        once, r = ((a, b, 0.0), (0.0, a, b)), q * base
        weights = tuple((r * y - x) / (r - 1) for x, y in zip(*once, strict=True))
    return _Extrapolated(levels, weights)


def require_linear(owner: str, compared: Sequence[Comparison]) -> None:
    """Refuse residuals that are no linear function of positions."""
    for comparison in compared:
        if comparison.kind != "markers":
            raise InvalidInput(
                f"{owner}: residuals must be linear in positions, as those of `markers`; those of "
                f"`{comparison.kind}` choose the nearest point in each simulation anew"
            )


def _check_shapes(levels: Sequence[Mapping[str, Tensor]]) -> None:
    first, *others = ({n: tuple(b.shape) for n, b in blocks.items()} for blocks in levels)
    for k, shapes in enumerate(others, 1):
        if shapes != first:
            raise InvalidInput(
                f"{_OWNER}: every level must return residuals of the same shapes, level {k} has "
                f"{shapes} where level 0 has {first}"
            )
