"""Fits of known values with many seeds of the noise: coverage of the confidence intervals.

    python -m benchmarks.identification
    python -m benchmarks.identification --seeds 2 configs/fit_cantilever.yaml
    python -m benchmarks.identification --seeds 40 configs/fit_throw.yaml      # chance, or a bias?
    python -m benchmarks.identification --compare         # other ways to the same numbers
    python -m benchmarks.identification --places          # ten starts: do they end at one place?
    python -m benchmarks.identification --foreign --seeds 20     # data of another simulator
    python -m benchmarks.identification --set scene.cloths.disk.shape.edge_length=0.014 ...

Each configuration makes synthetic observations on a finer mesh, with half the time step and noise
of 1 mm, and is fitted with ten seeds of this noise, from its first values. For each fitted number
the columns are: the true value, the median fitted value, the median half width of the 95 %
intervals, the bias without noise (due to mesh and time step), the number of seeds whose interval
contains the true value, with the 95 % interval of this share (Clopper and Pearson), and the share
expected with this bias: without bias it would be 95 %. The line above has the median root mean
square of the residuals, in units of the noise, and the median processor time.

With `--compare`, columns are evaluations of the residuals (an evaluation of a Jacobian by tangents
counts as one, its processor time is in the seconds), processor time [s], final cost over the lowest
cost of all methods, and the largest error of a number relative to its true value [%].

With `--foreign`, masses and springs are recorded with 2 mm of noise and 40 % of the markers hidden.
Each seed has its own true numbers. Columns count the intervals that hold the true value, by the
noise that they assume ("white", "robust"), and moved by the shifts of `Fit.step_bias` ("step") and
`Fit.mesh_bias` ("mesh"). The last row counts only fits without a `ModelErrorWarning`.
"""

from __future__ import annotations

import importlib.util
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
import torch
from tqdm import tqdm

import diffcloth_torch as dc
from benchmarks import foreign
from diffcloth_torch.errors import SimulationError
from diffcloth_torch.optimize.problem import trajectories
from diffcloth_torch.optimize.variables import Space
from diffcloth_torch.tasks.registry import read_config

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
QUIET = 1e-6  # noise [m] small enough to show the error of mesh and time step
ADAM_STEPS, ADAM_RATE = 100, 0.05
CMA_EVALUATIONS, CMA_SPREAD = 400, 0.3


class Found(NamedTuple):
    """A fit, its task and its processor time [s]."""

    fit: dc.Fit
    task: Any
    seconds: float

    def numbers(self) -> dict[str, tuple[float, float]]:
        """Name of each number -> fitted value and true value."""
        truth = self.task.config.fit.trajectories[0].synthetic.values
        pairs = {}
        for name in dict.fromkeys(n.partition("[")[0] for n in self.fit.names):
            found = self.fit.values[name].flatten().tolist()
            true = np.atleast_1d(np.asarray(truth[name], dtype=float)).tolist()
            names = [n for n in self.fit.names if n.partition("[")[0] == name]
            pairs |= dict(zip(names, zip(found, true, strict=True), strict=True))
        return pairs


def load(config: Path, seed: int, noise: float | None = None, *changes: str) -> Any:
    """The task of a configuration, with another seed for each of its trajectories."""
    count = len(read_config(config).fit.trajectories)
    assignments = [f"fit.trajectories.{k}.synthetic.seed={1000 * k + seed}" for k in range(count)]
    if noise is not None:
        assignments += [f"fit.trajectories.{k}.noise={noise}" for k in range(count)]
    return dc.load_config(config, [*assignments, *changes]).task


def fit(task: Any, **options: Any) -> Found:
    """Fit a task by its own options."""
    start = time.process_time()
    found = dc.fit(task.variables(), task.observed, **task.options() | options)
    return Found(found, task, time.process_time() - start)


def coverage(config: Path, first: int, seeds: int, changes: tuple[str, ...]) -> Iterator[str]:
    """Rows of the results over all seeds of the noise."""
    quiet = fit(load(config, 0, QUIET, *changes), starts=1).numbers()
    runs = [
        fit(load(config, seed, None, *changes), starts=1)
        for seed in tqdm(range(first, first + seeds), config.stem, leave=False, disable=None)
    ]
    rms = statistics.median((2 * r.fit.cost / len(r.fit.residuals)) ** 0.5 for r in runs)
    seconds = statistics.median(r.seconds for r in runs)
    yield f"\n{config.stem}: residuals {rms:.2f} of the noise, {seconds:.1f} s"
    yield f"{'':14} {'true':>10} {'median':>10} {'+-':>9} {'bias':>9}  true value inside"
    for name, (unbiased, true) in quiet.items():
        found = statistics.median(r.numbers()[name][0] for r in runs)
        widths = [(r.fit.intervals[name][1] - r.fit.intervals[name][0]) / 2 for r in runs]
        inside = [r.fit.intervals[name][0] <= true <= r.fit.intervals[name][1] for r in runs]
        yield (
            f"{name:14} {true:10.4g} {found:10.4g} {statistics.median(widths):9.2g} "
            f"{unbiased - true:+9.1g}  {shares(sum(inside), seeds)}; by the bias "
            f"{biased_share(unbiased - true, statistics.median(widths)):.0%}"
        )


def shares(inside: int, seeds: int) -> str:
    """A count, and the 95 % interval of the underlying probability."""
    from scipy.stats import binomtest

    low, high = binomtest(inside, seeds).proportion_ci()
    return f"{inside} of {seeds} ({low:.0%} to {high:.0%})"


def biased_share(bias: float, half_width: float) -> float:
    """Probability that a 95 % interval contains the truth if its middle has this bias.

    For a normal distribution, whose interval reaches 1.96 standard deviations.
    """
    from scipy.stats import norm

    reach, away = norm.ppf(0.975), abs(bias) / half_width * norm.ppf(0.975)
    return float(norm.cdf(reach - away) - norm.cdf(-reach - away))


def places(config: Path, seeds: int, changes: tuple[str, ...]) -> Iterator[str]:
    """Count the starts (first values and random ones) that end at the best point."""
    task = load(config, 0, None, *changes)
    numbers = len(Space(task.variables()))
    yield f"\n{config.stem}: {numbers} numbers, {len(task.observed)} trajectories"
    found = fit(task, starts=seeds, seed=1).fit
    at_best = sum(not start.apart for start in found.starts)
    yield f"{at_best} of {seeds} starts end at the same place"
    yield from (f"start {k}: {s.apart}" for k, s in enumerate(found.starts) if s.apart)


def foreign_coverage(case: foreign.Case, first: int, seeds: int) -> Iterator[str]:
    """Rows of the fits to another simulator over all seeds."""
    bar = tqdm(range(first, first + seeds), case.name, leave=False, disable=None)
    return foreign.table(case, [foreign.outcome(case, seed) for seed in bar])


class _Counted:
    """The cost as a function of theta, counted, for solvers that know no simulation."""

    def __init__(self, task: Any) -> None:
        self.task, self.space = task, Space(task.variables())
        self.count = 0

    def residuals(self, theta: Any) -> Any:
        self.count += 1
        with torch.no_grad():
            return self._call(torch.from_numpy(np.array(theta))).numpy()

    def cost(self, theta: Any) -> float:
        try:
            return 0.5 * float((self.residuals(theta) ** 2).sum())
        except SimulationError:
            return float("inf")  # the solver rejects the trial point

    def loss(self, theta: torch.Tensor) -> torch.Tensor:
        self.count += 1
        return 0.5 * self._call(theta).square().sum()

    def _call(self, theta: torch.Tensor) -> torch.Tensor:
        return torch.cat(trajectories(self.task.observed, self.space.values(theta)))


def by_differences(problem: _Counted) -> Any:
    from scipy.optimize import least_squares

    space = problem.space
    return least_squares(
        problem.residuals, space.first, bounds=(space.low, space.high), x_scale="jac"
    ).x


def by_adam(problem: _Counted) -> Any:
    theta = torch.from_numpy(problem.space.first.copy()).requires_grad_()
    optimizer = torch.optim.Adam([theta], lr=ADAM_RATE)
    best, lowest = theta.detach().clone(), float("inf")
    for _ in range(ADAM_STEPS):
        optimizer.zero_grad()
        loss = problem.loss(theta)
        if loss.item() < lowest:
            best, lowest = theta.detach().clone(), loss.item()
        loss.backward()
        optimizer.step()
    return best.numpy()


def by_cma(problem: _Counted) -> Any:
    import cma

    space = problem.space
    options = {
        "maxfevals": CMA_EVALUATIONS,
        "seed": 1,
        "verbose": -9,
        "bounds": [space.low.tolist(), space.high.tolist()],
        "tolfun": 1e-3,
    }
    return cma.fmin2(problem.cost, space.first, CMA_SPREAD, options)[0]


def compare(config: Path, changes: tuple[str, ...]) -> Iterator[str]:
    """Rows of the ways to the same numbers."""
    task = load(config, 0, None, *changes)
    ways: dict[str, Callable[[_Counted], Any]] = {
        "differences": by_differences,
        "Adam": by_adam,
        "CMA-ES": by_cma,
    }
    if importlib.util.find_spec("cma") is None:
        raise click.ClickException("--compare needs CMA-ES: pip install cma")
    ours = fit(task, starts=1)
    rows = [("tangents", ours.fit.history, ours.seconds, ours.fit.cost, _error(ours))]
    for name, way in ways.items():
        problem = _Counted(task)
        start = time.process_time()
        theta = way(problem)
        seconds = time.process_time() - start
        cost = _Counted(task).cost(theta)
        values = problem.space.values(torch.from_numpy(np.array(theta)))
        found = Found(_with(ours.fit, values), task, seconds)
        rows.append((name, range(problem.count), seconds, cost, _error(found)))
    lowest = min(row[3] for row in rows)
    yield f"\n{config.stem}"
    yield f"{'':12} {'evaluations':>11} {'seconds':>8} {'cost':>8} {'error':>8}"
    for name, evaluations, seconds, cost, error in rows:
        yield f"{name:12} {len(evaluations):11d} {seconds:8.1f} {cost / lowest:8.3f} {error:8.1%}"


def _error(found: Found) -> float:
    return max(abs(a - b) / max(abs(b), 1e-12) for a, b in found.numbers().values())


def _with(found: dc.Fit, values: dict[str, torch.Tensor]) -> dc.Fit:
    from dataclasses import replace

    return replace(found, values=values)


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.argument("configs", nargs=-1, type=click.Path(path_type=Path, exists=True))
@click.option("--seeds", default=10, type=click.IntRange(min=1), help="How many, of the noise.")
@click.option("--first", default=0, type=click.IntRange(min=0), help="The first of them.")
@click.option("--compare", "comparing", is_flag=True, help="Differences, Adam and CMA-ES.")
@click.option("--places", "placing", is_flag=True, help="Do random starts end at one place?")
@click.option("--foreign", "others", is_flag=True, help="Data of masses and springs.")
@click.option("--set", "changes", multiple=True, help="An assignment, as of `diffcloth fit`.")
def main(
    configs: tuple[Path, ...],
    seeds: int,
    first: int,
    comparing: bool,
    placing: bool,
    others: bool,
    changes: tuple[str, ...],
) -> None:
    if others and (configs or changes or comparing or placing):
        raise click.UsageError("--foreign has scenes of its own: only --seeds and --first")
    torch.set_num_threads(1)
    if others:
        for case in foreign.CASES:
            for row in foreign_coverage(case, first, seeds):
                click.echo(row)
        return
    for config in configs or sorted(CONFIGS.glob("fit_*.yaml")):
        if comparing:
            rows = compare(config, changes)
        elif placing:
            rows = places(config, seeds, changes)
        else:
            rows = coverage(config, first, seeds, changes)
        for row in rows:
            click.echo(row)


if __name__ == "__main__":
    main()
