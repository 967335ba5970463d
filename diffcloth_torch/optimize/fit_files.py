"""Files of fits: their results, without the functions of the residuals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checkpoint import (
    check_like,
    read_checkpoint,
    refusing_damage,
    write_checkpoint,
)
from diffcloth_torch.checks import check_choice
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.optimize.methods import METHODS, Options
from diffcloth_torch.optimize.problem import Trial
from diffcloth_torch.optimize.series import Layout
from diffcloth_torch.optimize.starts import End
from diffcloth_torch.optimize.variables import Prior, Space, Tie, Variable

__all__ = ["Solved", "read_fit", "write_fit"]

_KIND = "fit result"  # kind of the files
_PARTS = ("variables", "priors", "options", "ends", "robust", "held_out")
_ROWS = ("block", "series", "time")  # arrays of a layout


class Solved(NamedTuple):
    """Data from which a fit is assembled.

    Attributes:
        space: The searched space.
        options: Options of the solver.
        ends: End of each start.
        robust: Whether the covariance accounts for correlated residuals.
        held_out: Root mean square of the residuals of each trajectory that was kept out.
    """

    space: Space
    options: Options
    ends: list[End]
    robust: bool
    held_out: list[float]

    def without_functions(self) -> Solved:
        """Return a copy with "least_squares" in place of an optimizer of torch."""
        if isinstance(self.options.method, str):
            return self
        return self._replace(options=replace(self.options, method=METHODS[0]))


def write_fit(path: Path, solved: Solved) -> None:
    """Write a fit to a file.

    Raises:
        InvalidInput: If a tie is a function.
        OSError: If the file cannot be written.
    """
    options = solved.without_functions().options
    content = {
        "variables": {n: _described(n, v) for n, v in solved.space.given.items()},
        "priors": [
            {
                "means": {n: _tensor(mean) for n, mean in prior.means.items()},
                "covariance": _tensor(prior.covariance),
            }
            for prior in solved.space.priors
        ],
        "options": dict(vars(options)),
        "ends": [_end(end) for end in solved.ends],
        "robust": solved.robust,
        "held_out": solved.held_out,
    }
    write_checkpoint(path, _KIND, content)


def read_fit(owner: str, path: Path) -> Solved:
    """Read a file of `write_fit`.

    Raises:
        InvalidInput: If the file holds no fit.
        OSError: If the file cannot be read.
    """
    content = read_checkpoint(owner, path, _KIND)
    with refusing_damage(owner, path):
        check_like("the content", dict.fromkeys(content), dict.fromkeys(_PARTS))
        variables = {name: _variable(given) for name, given in content["variables"].items()}
        priors = [Prior(**prior) for prior in content["priors"]]
        space = Space(variables, priors)
        options = Options(**content["options"])
        check_choice("the method", options.method, METHODS)
        ends = [_read_end(k, end, space) for k, end in enumerate(content["ends"])]
        if not any(end.failure is None for end in ends):
            raise InvalidInput("it must have a start that could be simulated")
        return Solved(space, options, ends, bool(content["robust"]), list(content["held_out"]))


def _described(name: str, variable: Variable | Tie) -> dict[str, Any]:
    if isinstance(variable, Tie):
        if callable(variable.by):
            raise InvalidInput(
                f"Fit.save: the tie of {name!r} must be by a factor: functions are not kept"
            )
        return {"of": variable.of, "by": variable.by}
    prior: Any = variable.prior
    return {
        "value": _tensor(variable.value),
        "bounds": None if variable.bounds is None else list(variable.bounds),
        "scale": variable.scale,
        "free": variable.free,
        "spread": variable.spread,
        "prior": None if prior is None else [_tensor(part) for part in prior],
    }


def _variable(given: Mapping[str, Any]) -> Variable | Tie:
    return Tie(**given) if "of" in given else Variable(**given)


def _end(end: End) -> dict[str, Any]:
    layout = end.layout
    return {
        "first": _tensor(end.first),
        "theta": _tensor(end.theta),
        "residuals": _tensor(end.residuals),
        "jacobian": _tensor(end.jacobian),
        "cost": end.cost,
        "success": end.success,
        "message": end.message,
        "layout": None
        if layout is None
        else {
            "names": list(layout.names),
            **{name: torch.from_numpy(getattr(layout, name)) for name in _ROWS},
        },
        "history": [dict(vars(trial)) for trial in end.history],
    }


def _read_end(start: int, given: Mapping[str, Any], space: Space) -> End:
    failed = math.isinf(given["cost"])
    count, p = len(given["residuals"]), len(space)
    jacobian = cpu.zeros(0) if failed else cpu.zeros(count, p)
    example = {"first": cpu.zeros(p), "theta": cpu.zeros(p), "residuals": cpu.zeros(count)}
    numbers = {name: given[name] for name in (*example, "jacobian")}
    check_like(f"start {start}", numbers, example | {"jacobian": jacobian})
    return End(
        start=start,
        **{name: tensor.numpy() for name, tensor in numbers.items()},
        cost=float(given["cost"]),
        success=bool(given["success"]),
        message=str(given["message"]),
        history=[_trial(trial) for trial in given["history"]],
        layout=None if failed else _layout(given["layout"], count),
        failure=SimulationError(str(given["message"])) if failed else None,
    )


def _layout(given: Mapping[str, Any], count: int) -> Layout:
    rows = {name: given[name] for name in _ROWS}
    check_like("the layout", rows, dict.fromkeys(_ROWS, cpu.zeros(count, dtype=torch.int64)))
    names = [str(name) for name in given["names"]]
    block = rows["block"]
    if bool(((block < 0) | (block >= len(names))).any()):
        raise InvalidInput("the layout must number the blocks that it names")
    return Layout(names, *(tensor.numpy() for tensor in rows.values()))


def _trial(given: Mapping[str, Any]) -> Trial:
    if not all(isinstance(value, Tensor) for value in given["values"].values()):
        raise InvalidInput("values of an evaluation must be tensors")
    return Trial(**given)


def _tensor(numbers: object) -> Tensor:
    return torch.from_numpy(np.array(numbers, dtype=np.float64))
